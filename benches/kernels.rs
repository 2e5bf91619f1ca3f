//! Measures how close the kernels come to the limits of the machine.
//!
//! ```text
//!   ceilings   triad     a = b + s·c        on arrays with the total size that a smoothing pass streams
//!              update    a = a + s·b        the same, without the cache lines that a triad fetches to overwrite
//!              mul, add  x = x·m + a        in registers, twelve at a time, each rounded separately
//!   kernels    smoothing passes over shells of several sizes; sweeps of a redistancing
//! ```
//!
//! For each leaf with a free voxel, a pass reads φ, the initial φ, the previous values and both bounds, and
//! writes one field: 12 kB per leaf. The rows with a free voxel have fewer bytes; their size is printed, too.
//! A pass takes 22 operations per free voxel: two Laplacians of 7, and 8 for the step. The roofline time of a
//! pass is the longer of two times: to move its bytes at the bandwidth of the triad (in arrays with the same
//! total size, on the same threads), and to do its operations at the speed of the loop in registers. No
//! kernel fuses multiplications with additions, so that all processors give the same results; that loop does
//! not fuse them, either.
//!
//! A triad moves more bytes than its usual count, because it also fetches the cache lines that it overwrites.
//! An update and a pass do not. So the bandwidth of an update is higher, and a pass is a smaller fraction of
//! its roofline; this fraction is printed, too. Fields that fit into a cache are streamed from the cache. So
//! each shell is also compared with the triad of the largest shell, which runs from memory. Exits with 1 if
//! the largest shell is below the required fraction of its triad's roofline, or of the speed in a cache.
//!
//! ```text
//! cargo bench --bench kernels
//! ```

#![expect(clippy::print_stdout, reason = "a benchmark prints its results")]

use std::hint::black_box;
use std::process::{Command, ExitCode};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use glam::{IVec3, Vec3};
use meniscus::surface::grid::{Field, LEAF_EDGE, Leaf, LeafMask, ROW_COUNT, Topology, voxel_in_leaf};
use meniscus::surface::level_set::{Bounds, NarrowBand, Sweeps, UNREACHED, extend};
use meniscus::surface::simd::{self, Kernel, LEVEL_VARIABLE, Lanes, SimdLevel};
use meniscus::surface::smooth::{SmoothConfig, SmoothContext, SmoothOp, SmoothSteps, Workspace};
use rayon::{ThreadPool, ThreadPoolBuilder};

/// Radii of the shells, in voxels. Their passes stream 1, 14 and 200 MB: these sizes fit into a core's own
/// cache, into the shared cache, and only into memory.
const SHELL_RADII: [f32; 3] = [14.0, 55.0, 220.0];

/// The shell for measuring sweeps and comparing SIMD levels.
const MIDDLE_SHELL: usize = 1;

/// Target and minimum, as fractions of the roofline.
const ROOF_TARGET: f64 = 0.5;
const ROOF_FLOOR: f64 = 0.25;

/// The least speed of the largest shell on all threads, as a fraction of that of the fastest shell, which is
/// in a cache.
const IN_CACHE_TARGET: f64 = 0.7;
const IN_CACHE_FLOOR: f64 = 0.5;

/// Argument with which this program runs itself to measure one SIMD level.
const LEVEL_FIGURES: &str = "--level-figures";

/// Minimum duration and number of measurements. The best measurement counts, as in STREAM: it is the one with
/// the fewest interruptions by other processes. Kernels and ceilings are measured the same way.
const MEASURE_S: f64 = 0.5;
const MEASURE_COUNT: usize = 7;

/// Number of passes per measurement: few, so that at least some measurements run without an interruption.
const TIMED_PASSES: u32 = 10;

/// Number of fields that a pass streams: five are read and one is written.
const STREAMED_FIELDS: usize = 6;

/// Number of operations of a pass per free voxel.
const PASS_OPERATIONS: f64 = 22.0;

fn main() -> ExitCode {
    if std::env::args().any(|argument| argument == LEVEL_FIGURES) {
        print_level_figures();
        return ExitCode::SUCCESS;
    }
    let pools = [1, 2].map(pool);
    println!(
        "SIMD level: {}; the best of at least {MEASURE_COUNT} measurements",
        SimdLevel::current().name()
    );
    let meets_target = print_passes(&pools);
    print_sweeps(&pools);
    print_levels();
    if meets_target {
        return ExitCode::SUCCESS;
    }
    println!("the largest shell is below a floor");
    ExitCode::FAILURE
}

fn pool(threads: usize) -> ThreadPool {
    ThreadPoolBuilder::new().num_threads(threads).build().expect("threads")
}

/// Measures smoothing passes and ceilings. Returns whether the largest shell reaches the minimum.
fn print_passes(pools: &[ThreadPool; 2]) -> bool {
    let shells = SHELL_RADII.map(Shell::new);
    println!(
        "\nsmoothing passes               streamed     rows     triad   update  mul, add    passes x free         % of the roofline of"
    );
    println!(
        "threads  free voxels  leaves         MB       MB      GB/s     GB/s   Gflop/s  voxels, M/s     GB/s   triad  update  memory"
    );
    let mut meets_target = true;
    let mut rates = Vec::new();
    for (threads, pool) in (1..).zip(pools) {
        rates.clear();
        let operations = mul_add_rate(pool);
        let ceilings = shells.each_ref().map(|shell| Ceilings::measure(pool, shell.streamed_bytes()));
        let [.., of_memory] = &ceilings;
        for (shell, ceilings) in shells.iter().zip(&ceilings) {
            let rate = pass_rate(shell, pool);
            rates.push(rate);
            let part = |bandwidth: f64| rate * shell.least_seconds(bandwidth, operations);
            println!(
                "{threads:7}{:13}{:8}{:11.1}{:9.1}{:10.1}{:9.1}{:10.1}{:13.1}{:9.1}{:8.0}{:8.0}{:8.0}",
                shell.free_count,
                shell.touched_count,
                shell.streamed_bytes() as f64 / 1e6,
                shell.row_bytes() as f64 / 1e6,
                ceilings.triad / 1e9,
                ceilings.update / 1e9,
                operations / 1e9,
                rate / 1e6,
                rate * shell.bytes_per_voxel() / 1e9,
                100.0 * part(ceilings.triad),
                100.0 * part(ceilings.update),
                100.0 * part(of_memory.triad),
            );
            // Only the largest shell, the last of each pool, must reach the minimum.
            meets_target &= !std::ptr::eq(ceilings, of_memory) || part(ceilings.triad) >= ROOF_FLOOR;
        }
    }
    println!(
        "largest shell, compared with the triad: target {:.0} %, floor {:.0} %",
        100.0 * ROOF_TARGET,
        100.0 * ROOF_FLOOR
    );
    let in_cache = rates.iter().copied().fold(0.0, f64::max);
    let of_in_cache = rates.last().map_or(0.0, |largest| largest / in_cache);
    println!(
        "largest shell on two threads, compared with the fastest shell: {:.0} %, target {:.0} %, floor {:.0} %",
        100.0 * of_in_cache,
        100.0 * IN_CACHE_TARGET,
        100.0 * IN_CACHE_FLOOR
    );
    meets_target && of_in_cache >= IN_CACHE_FLOOR
}

fn print_sweeps(pools: &[ThreadPool; 2]) {
    let shell = Shell::new(SHELL_RADII[MIDDLE_SHELL]);
    let rows = swept_row_count(&shell);
    println!(
        "\nsweeps of a redistancing, {} leaves, {rows} rows updated in {SWEEP_COUNT} sweeps",
        shell.leaf_count()
    );
    println!("threads  rows, M/s  voxels, M/s");
    for (threads, pool) in (1..).zip(pools) {
        let rate = sweep_rate(&shell, rows, pool);
        println!("{threads:7}{:11.2}{:13.1}", rate / 1e6, 8.0 * rate / 1e6);
    }
}

/// Runs this program at each SIMD level, because a process selects its level once.
fn print_levels() {
    println!(
        "\nSIMD level, 1 thread           passes x free voxels, M/s  speedup    sweeps: rows, M/s  speedup"
    );
    let mut plain = None;
    for level in SimdLevel::ALL.into_iter().filter(|level| level.is_available()) {
        let program = std::env::current_exe().expect("this program");
        let output = Command::new(program).arg(LEVEL_FIGURES).env(LEVEL_VARIABLE, level.name()).output();
        let output = output.expect("it starts");
        let text = String::from_utf8_lossy(&output.stdout);
        let figures: Vec<f64> = text.split_whitespace().filter_map(|word| word.parse().ok()).collect();
        let [passes, sweeps] = figures[..] else { panic!("two figures from {}: {text}", level.name()) };
        let [passes_plain, sweeps_plain] = *plain.get_or_insert([passes, sweeps]);
        println!(
            "{:26}{:30.1}{:9.2}{:21.2}{:9.2}",
            level.name(),
            passes / 1e6,
            passes / passes_plain,
            sweeps / 1e6,
            sweeps / sweeps_plain,
        );
    }
}

/// The child process of [`print_levels`].
fn print_level_figures() {
    let shell = Shell::new(SHELL_RADII[MIDDLE_SHELL]);
    let pool = pool(1);
    let (passes, sweeps) = (pass_rate(&shell, &pool), sweep_rate(&shell, swept_row_count(&shell), &pool));
    println!("{passes} {sweeps}");
}

/// The narrow band of a sphere with ripples, and bounds as far apart as those of particles.
struct Shell {
    band: NarrowBand,
    bounds: Bounds,
    free_count: usize,
    /// Number of leaves with a free voxel.
    touched_count: usize,
    /// Number of rows with a free voxel.
    row_count: usize,
}

/// Voxels closer to the surface are free.
const FREE_WIDTH: f32 = 3.0;
const HALF_WIDTH: f32 = 6.0;

/// Half of the default r_max − r_min, in voxels.
const BOUND_DISTANCE: f32 = 0.866;

impl Shell {
    fn new(radius: f32) -> Shell {
        let edge = (radius + HALF_WIDTH) as i32 / LEAF_EDGE + 1;
        let axis = || -edge..edge;
        let origins = axis()
            .flat_map(|x| axis().flat_map(move |y| axis().map(move |z| IVec3::new(x, y, z) * LEAF_EDGE)));
        let topology = Topology::new(origins.filter(|&origin| is_near(origin, radius)).collect());
        let sphere = Field {
            leaves: topology.origins().iter().map(|&origin| leaf_of_sphere(origin, radius)).collect(),
        };
        let moved = |by: &dyn Fn(usize) -> f32| -> Field {
            let leaf =
                |leaf: &Leaf| Leaf { values: std::array::from_fn(|offset| leaf.values[offset] + by(offset)) };
            Field { leaves: sphere.leaves.iter().map(leaf).collect() }
        };
        let bounds = Bounds::new(moved(&|_| -BOUND_DISTANCE), moved(&|_| BOUND_DISTANCE));
        // The amplitude is that of the bounds, so that they clamp some voxels.
        let phi = moved(&|offset| BOUND_DISTANCE * (offset as f32 * 0.7).sin());
        let is_free = |phi: &&f32| phi.abs() <= FREE_WIDTH;
        let rows = phi
            .leaves
            .iter()
            .map(|leaf| (0..ROW_COUNT).filter(|&row| leaf.row(row).iter().any(|phi| is_free(&phi))).count());
        let rows: Vec<usize> = rows.collect();
        Shell {
            free_count: phi.leaves.iter().flat_map(|leaf| &leaf.values).filter(is_free).count(),
            touched_count: rows.iter().filter(|&&count| count > 0).count(),
            row_count: rows.iter().sum(),
            band: NarrowBand { topology: Arc::new(topology), phi, half_width: HALF_WIDTH },
            bounds,
        }
    }

    fn leaf_count(&self) -> usize {
        self.band.topology.len()
    }

    /// The bytes that a pass streams.
    fn streamed_bytes(&self) -> usize {
        STREAMED_FIELDS * size_of::<Leaf>() * self.touched_count
    }

    /// The bytes that a pass would stream if it read and wrote only the rows with a free voxel.
    fn row_bytes(&self) -> usize {
        STREAMED_FIELDS * size_of::<[f32; 8]>() * self.row_count
    }

    fn bytes_per_voxel(&self) -> f64 {
        self.streamed_bytes() as f64 / self.free_count as f64
    }

    /// Lower bound of the seconds of a pass per free voxel, at this bandwidth (bytes per second) and speed
    /// (operations per second).
    fn least_seconds(&self, bandwidth: f64, operations: f64) -> f64 {
        (self.bytes_per_voxel() / bandwidth).max(PASS_OPERATIONS / operations)
    }
}

/// Whether a leaf may contain a voxel of the band.
fn is_near(origin: IVec3, radius: f32) -> bool {
    let middle = origin.as_vec3() + 3.5;
    let corner = Vec3::splat(3.5).length();
    (middle.length() - radius).abs() < HALF_WIDTH + corner
        && leaf_of_sphere(origin, radius).values.iter().any(|phi| phi.abs() < HALF_WIDTH)
}

fn leaf_of_sphere(origin: IVec3, radius: f32) -> Leaf {
    let phi = |offset| {
        ((origin + voxel_in_leaf(offset)).as_vec3().length() - radius).clamp(-HALF_WIDTH, HALF_WIDTH)
    };
    Leaf { values: std::array::from_fn(phi) }
}

/// Updates of free voxels per second, over all threads: passes times free voxels.
fn pass_rate(shell: &Shell, pool: &ThreadPool) -> f64 {
    let steps = SmoothSteps { steps: 1, step_size: 20.0, ..SmoothSteps::default() };
    let config = SmoothConfig { smoothing: steps, ..SmoothConfig::default() };
    let mut band = shell.band.clone();
    let mut memory = Workspace::new(shell.leaf_count());
    let mut op = |count: u32| {
        band.phi.leaves.copy_from_slice(&shell.band.phi.leaves);
        let start = Instant::now();
        let mut work = SmoothContext {
            config: &config,
            band: &mut band,
            bounds: &shell.bounds,
            workspace: &mut memory,
            own: None,
        };
        let counts =
            pool.install(|| work.apply(SmoothOp::Passes { step: 0, first: 0, count, pins_peaks: false }));
        (start.elapsed().as_secs_f64(), counts.voxel_update_count)
    };
    // The difference between runs with several passes and with one is the time of the passes alone, without
    // finding the free voxels and initializing.
    let mut moved_counts = [0; 2];
    let [several, one] = [0, 1].map(|which| {
        best(|| {
            let (seconds, moved_count) = op([1 + TIMED_PASSES, 1][which]);
            moved_counts[which] = moved_count;
            seconds
        })
    });
    (moved_counts[0] - moved_counts[1]) as f64 / (several - one)
}

/// Number of sweeps of a redistancing.
const SWEEP_COUNT: u32 = 8;

/// Row updates by sweeps per second, over all threads.
fn sweep_rate(shell: &Shell, row_count: usize, pool: &ThreadPool) -> f64 {
    let (distance, fixed) = pinned(shell);
    let timed = |count: u32| {
        let mut distance = distance.clone();
        let start = Instant::now();
        pool.install(|| extend(&shell.band.topology, &mut distance, &fixed, sweeps(count)));
        black_box(&distance);
        start.elapsed().as_secs_f64()
    };
    // Subtract the time without sweeps, which includes allocating memory.
    let [all, none] = [SWEEP_COUNT, 0].map(|count| best(|| timed(count)));
    row_count as f64 / (all - none)
}

/// The parameters of the sweeps after a step of the fast integrator.
fn sweeps(count: u32) -> Sweeps {
    Sweeps { second_order_within: 1.2, ..Sweeps::accurate(count) }
}

/// The distances of the voxels within a voxel of the sphere, and a mask of these voxels. All other voxels
/// have only the sign.
fn pinned(shell: &Shell) -> (Field, Vec<LeafMask>) {
    let is_pinned = |phi: f32| phi.abs() < 1.0;
    let distance = |leaf: &Leaf| Leaf {
        values: leaf.values.map(|phi| if is_pinned(phi) { phi } else { UNREACHED.copysign(phi) }),
    };
    let leaves = &shell.band.phi.leaves;
    let fixed =
        leaves.iter().map(|leaf| LeafMask::from_fn(|offset| is_pinned(leaf.values[offset]))).collect();
    (Field { leaves: leaves.iter().map(distance).collect() }, fixed)
}

/// Number of row updates in all sweeps: each sweep updates the rows within two voxels, along an axis, of a
/// voxel that the last sweep changed; the first sweep starts from the known voxels. Rows that no distance has
/// reached yet are counted, although a sweep only looks at them.
fn swept_row_count(shell: &Shell) -> usize {
    let (start, fixed) = pinned(shell);
    let mut changed = fixed.clone();
    let (mut row_count, mut last) = (0, start.clone());
    for count in 1..=SWEEP_COUNT {
        row_count += dependent_row_count(&shell.band.topology, &changed);
        let mut distance = start.clone();
        extend(&shell.band.topology, &mut distance, &fixed, sweeps(count));
        let differing = |(one, other): (&Leaf, &Leaf)| {
            LeafMask::from_fn(|offset| one.values[offset] != other.values[offset])
        };
        changed = distance.leaves.iter().zip(&last.leaves).map(differing).collect();
        last = distance;
    }
    row_count
}

fn dependent_row_count(topology: &Topology, changed: &[LeafMask]) -> usize {
    let is_changed = |voxel: IVec3, along_z: u8| {
        let found = topology.find_voxel(voxel);
        found.is_some_and(|(leaf, local)| changed[leaf].row((local.x * 8 + local.y) as usize) & along_z != 0)
    };
    // The steps to the rows that a row reads, and which of their voxels it reads.
    let steps: Vec<(IVec3, u8)> = [-2, -1, 0, 1, 2]
        .into_iter()
        .flat_map(|step| [(IVec3::new(step, 0, 0), 0xff), (IVec3::new(0, step, 0), 0xff)])
        .chain([(IVec3::new(0, 0, -LEAF_EDGE), 0b1100_0000), (IVec3::new(0, 0, LEAF_EDGE), 0b0000_0011)])
        .collect();
    let depends = |first: &IVec3| steps.iter().any(|&(step, along_z)| is_changed(*first + step, along_z));
    let rows = topology
        .origins()
        .iter()
        .flat_map(|&origin| (0..64).map(move |row| origin + IVec3::new(row >> 3, row & 7, 0)));
    rows.filter(depends).count()
}

/// The streaming speed of the machine, from memory or a cache.
struct Ceilings {
    /// Bytes per second of a triad, by the usual count: two arrays read, one written.
    triad: f64,
    /// Bytes per second of an update.
    update: f64,
}

impl Ceilings {
    /// Measures arrays with this total size.
    fn measure(pool: &ThreadPool, size_bytes: usize) -> Ceilings {
        let [triad, update] = [Streaming::Triad, Streaming::Update].map(|kind| kind.rate(pool, size_bytes));
        Ceilings { triad, update }
    }
}

#[derive(Clone, Copy)]
enum Streaming {
    Triad,
    Update,
}

impl Streaming {
    /// Bytes per second; each thread has its own arrays.
    fn rate(self, pool: &ThreadPool, size_bytes: usize) -> f64 {
        let array_count = match self {
            Streaming::Triad => 3,
            Streaming::Update => 2,
        };
        let length = size_bytes / pool.current_num_threads() / array_count / size_of::<[f32; 8]>();
        let arrays = || std::array::from_fn(|index| vec![[index as f32; 8]; length]);
        let of_thread: Vec<Mutex<[Vec<[f32; 8]>; 3]>> = pool.broadcast(|_| Mutex::new(arrays()));
        // Enough repetitions that starting the threads does not matter.
        let repeat_count = (64 << 20) / size_bytes + 1;
        let seconds = best(|| {
            let start = Instant::now();
            pool.broadcast(|context| {
                let mut arrays = of_thread[context.index()].lock().unwrap_or_else(PoisonError::into_inner);
                let [a, b, c] = &mut *arrays;
                for _ in 0..repeat_count {
                    simd::dispatch(Stream { kind: self, a: black_box(a), b: black_box(b), c: black_box(c) });
                }
            });
            start.elapsed().as_secs_f64()
        });
        let moved_bytes = 3 * length * size_of::<[f32; 8]>() * pool.current_num_threads() * repeat_count;
        moved_bytes as f64 / seconds
    }
}

struct Stream<'a> {
    kind: Streaming,
    a: &'a mut [[f32; 8]],
    b: &'a [[f32; 8]],
    c: &'a [[f32; 8]],
}

impl Kernel for Stream<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let scale = V::splat(0.5);
        match self.kind {
            Streaming::Triad => {
                for ((a, b), c) in self.a.iter_mut().zip(self.b).zip(self.c) {
                    V::load(b).add(scale.mul(V::load(c))).store(a);
                }
            }
            Streaming::Update => {
                for (a, b) in self.a.iter_mut().zip(self.b) {
                    V::load(a).add(scale.mul(V::load(b))).store(a);
                }
            }
        }
    }
}

/// Multiplications and additions per second in registers, over all threads.
fn mul_add_rate(pool: &ThreadPool) -> f64 {
    const ROUNDS: usize = 4_000_000;
    let seconds = best(|| {
        let start = Instant::now();
        pool.broadcast(|_| black_box(simd::dispatch(MulAdd { rounds: ROUNDS })));
        start.elapsed().as_secs_f64()
    });
    (ROUNDS * MUL_ADD_CHAINS * 8 * 2 * pool.current_num_threads()) as f64 / seconds
}

/// Enough chains to hide the latency, and few enough for sixteen registers.
const MUL_ADD_CHAINS: usize = 12;

struct MulAdd {
    rounds: usize,
}

impl Kernel for MulAdd {
    type Output = f32;

    #[inline(always)]
    fn run<V: Lanes>(self) -> f32 {
        let (factor, term) = (V::splat(black_box(0.75)), V::splat(black_box(0.25)));
        let mut chains: [V; MUL_ADD_CHAINS] = std::array::from_fn(|chain| V::splat(chain as f32));
        for _ in 0..self.rounds {
            for chain in &mut chains {
                *chain = chain.mul(factor).add(term);
            }
        }
        let mut row = [0.0; 8];
        chains.into_iter().fold(V::splat(0.0), V::add).store(&mut row);
        row.iter().sum()
    }
}

/// The smallest result of `measure`, seconds.
fn best(mut measure: impl FnMut() -> f64) -> f64 {
    let (start, mut least, mut count) = (Instant::now(), f64::INFINITY, 0);
    while count < MEASURE_COUNT || start.elapsed().as_secs_f64() < MEASURE_S {
        least = least.min(measure());
        count += 1;
    }
    least
}
