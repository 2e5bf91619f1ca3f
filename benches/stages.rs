//! Measures the time of the stages per particle and per free voxel as frames grow.
//!
//! ```text
//!   frames are growing pieces of the same sponge, with the same spacing, so that only the size changes:
//!
//!     ▒▒ ▒▒      ▒▒ ▒▒ ▒▒      ▒▒ ▒▒ ▒▒ ▒▒
//!     ▒▒ ▒▒      ▒▒ ▒▒ ▒▒      ▒▒ ▒▒ ▒▒ ▒▒
//! ```
//!
//! h is half the spacing. Each frame is reconstructed alternately on one thread and on two. The seconds of
//! smoothing per free voxel, and those of rasterization per particle, should be the same for all sizes, and
//! two threads should smooth nearly twice as fast as one. Exits with 1 if a minimum is missed.
//!
//! Then the benchmark measures the time to compute the anisotropic shapes of 600 000 particles, compared with
//! a plain loop that only sums the moments of their neighborhoods.
//!
//! ```text
//! cargo bench --bench stages                10⁶ to 10⁷ free voxels
//! cargo bench --bench stages -- 1e8         to 10⁸: some minutes, and 10 GB of memory
//! ```

#![expect(clippy::print_stdout, reason = "a benchmark prints its results")]

#[path = "../examples/solid/sponge.rs"]
mod sponge;

use std::f64::consts::{PI, TAU};
use std::process::ExitCode;
use std::time::Instant;

use glam::Vec3;
use meniscus::surface::anisotropy::{KernelConfig, NeighborConfig, Stretch, from_neighbors};
use meniscus::surface::neighbors::Neighbors;
use meniscus::surface::options::{MethodOptions, Settings};
use meniscus::surface::particles::OwnedPositions;
use meniscus::surface::reconstruction::reconstruct_frame_observed;
use meniscus::surface::report::ReconstructionReport;
use rayon::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

use sponge::Sponge;

const FREE_MIN: f64 = 1e6;
const FREE_MAX: f64 = 1e7;

/// Approximate number of free voxels per particle at h = spacing/2: 8.6 in the smallest frame, where more of
/// the surface belongs to the ball that closes the sponge, and 7.5 at 10⁷ free voxels.
const FREE_PER_PARTICLE: f64 = 8.0;

/// Spacings per period of the gyroid. Walls and gaps are then a dozen spacings wide, so layers of free voxels
/// do not meet.
const SPACINGS_PER_PERIOD: f64 = 24.0;

/// The fraction of a ball of radius R + 1 that the solid fills; R is the radius of the sponge.
const FILLED_PART: f64 = 0.517;

/// Number of rounds for the smallest frame; larger ones have fewer.
const ROUND_COUNT: usize = 5;

/// Target and minimum of the speedup of smoothing on two threads.
const SPEEDUP_TARGET: f64 = 1.85;
const SPEEDUP_FLOOR: f64 = 1.7;

/// Target and minimum of the relative deviation of the seconds per free voxel, or per particle, from those of
/// the smallest frame.
const GROWTH_TARGET: f64 = 0.15;
const GROWTH_FLOOR: f64 = 0.30;

fn main() -> ExitCode {
    let given = std::env::args().filter_map(|argument| argument.parse::<f64>().ok()).next();
    let free_max = given.unwrap_or(FREE_MAX).max(FREE_MIN);
    let pools = [1, 2].map(|threads| ThreadPoolBuilder::new().num_threads(threads).build().expect("threads"));
    println!(
        "                                     seconds in each stage        ns a particle:  ns a free voxel:"
    );
    println!("threads  particles  free voxels  rasterize   smooth  contour   rasterize      smooth  contour");
    let mut rows: Vec<[Row; 2]> = Vec::new();
    let mut free_wanted = FREE_MIN;
    while free_wanted < 1.5 * free_max {
        rows.push(measure(free_wanted.min(free_max), &pools));
        free_wanted *= 10f64.sqrt();
    }
    let is_fast = print_speedups(&rows);
    let is_flat = print_growth(&rows);
    print_shapes(&pools);
    if is_fast && is_flat { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// The median times of a frame on a number of threads.
struct Row {
    particle_count: f64,
    free_count: f64,
    /// Seconds to rasterize, smooth and contour.
    seconds: [f64; 3],
}

impl Row {
    /// Nanoseconds of rasterization per particle.
    fn rasterize_ns(&self) -> f64 {
        1e9 * self.seconds[0] / self.particle_count
    }

    /// Nanoseconds of smoothing per free voxel.
    fn smooth_ns(&self) -> f64 {
        1e9 * self.seconds[1] / self.free_count
    }
}

/// Reconstructs a frame alternately on both pools.
fn measure(free_wanted: f64, pools: &[ThreadPool; 2]) -> [Row; 2] {
    let (particles, spacing) = frame(free_wanted / FREE_PER_PARTICLE);
    let settings = Settings::paper(spacing / 2.0, &MethodOptions::default()).expect("valid");
    let round_count = ((ROUND_COUNT as f64 * FREE_MIN / free_wanted).ceil() as usize).max(1);
    let mut reports: [Vec<Measured>; 2] = Default::default();
    for _ in 0..round_count {
        for (pool, reports) in pools.iter().zip(&mut reports) {
            reports.push(pool.install(|| reconstructed(&particles, &settings)));
        }
    }
    let rows = reports.map(|reports| row(&reports));
    for (threads, row) in (1..).zip(&rows) {
        println!(
            "{threads:7}{:11}{:13}{:11.3}{:9.3}{:9.3}{:12.1}{:12.1}{:9.1}",
            row.particle_count,
            row.free_count,
            row.seconds[0],
            row.seconds[1],
            row.seconds[2],
            row.rasterize_ns(),
            row.smooth_ns(),
            1e9 * row.seconds[2] / row.free_count,
        );
    }
    rows
}

/// About this many particles on one lattice, and their spacing.
fn frame(particle_count: f64) -> (OwnedPositions, f64) {
    let spacing = TAU / SPACINGS_PER_PERIOD;
    let ball = particle_count * spacing.powi(3) / FILLED_PART;
    let solid = Sponge::new((ball * 3.0 / 4.0 / PI).cbrt() - 1.0, spacing);
    let planes = (0..solid.plane_count()).into_par_iter().map(|x| {
        let mut plane = Vec::with_capacity(solid.count_in_plane(x));
        solid.for_each_in_plane(x, |particle| plane.push(particle));
        plane
    });
    (OwnedPositions::F32(planes.flatten_iter().collect()), solid.spacing)
}

/// A reconstruction, with the seconds of its three stages.
struct Measured {
    report: ReconstructionReport,
    seconds: [f64; 3],
}

fn reconstructed(particles: &OwnedPositions, settings: &Settings) -> Measured {
    let mut starts = Vec::new();
    let surface = reconstruct_frame_observed(particles, settings, &mut |_| starts.push(Instant::now()));
    starts.push(Instant::now());
    let report = surface.report;
    assert!(report.certificate.holds(), "{:?}", report.certificate);
    Measured { report, seconds: [0, 1, 2].map(|stage| (starts[stage + 1] - starts[stage]).as_secs_f64()) }
}

fn row(runs: &[Measured]) -> Row {
    let median = |stage: usize| {
        let mut seconds: Vec<f64> = runs.iter().map(|run| run.seconds[stage]).collect();
        seconds.sort_by(f64::total_cmp);
        seconds[seconds.len() / 2]
    };
    Row {
        particle_count: runs[0].report.particle_count as f64,
        free_count: runs[0].report.smoothing.free_voxel_count as f64,
        seconds: [0, 1, 2].map(median),
    }
}

/// Prints the speedups of two threads. Returns whether smoothing reaches the minimum.
fn print_speedups(rows: &[[Row; 2]]) -> bool {
    println!("\nspeedup of two threads over one\n  free voxels  rasterize   smooth  contour");
    let mut is_kept = true;
    for [one, two] in rows {
        let [rasterize, smooth, contour] = [0, 1, 2].map(|stage| one.seconds[stage] / two.seconds[stage]);
        let target_label = target_label(smooth >= SPEEDUP_TARGET, smooth >= SPEEDUP_FLOOR);
        println!("{:13}{rasterize:11.2}{smooth:9.2}{contour:9.2}   {target_label}", one.free_count);
        is_kept &= smooth >= SPEEDUP_FLOOR;
    }
    println!("smoothing: target {SPEEDUP_TARGET}, floor {SPEEDUP_FLOOR}");
    is_kept
}

/// Prints how the times per unit change from the smallest frame. Returns whether they stay within the limit
/// on two threads.
fn print_growth(rows: &[[Row; 2]]) -> bool {
    println!("\nchange of the times from those of the smallest frame");
    println!("              rasterize / particle    smooth / free voxel");
    println!("  free voxels  1 thread  2 threads    1 thread  2 threads");
    let mut is_kept = true;
    for row in &rows[1..] {
        let off = |threads: usize, ns: fn(&Row) -> f64| ns(&row[threads]) / ns(&rows[0][threads]) - 1.0;
        let rasterize = [0, 1].map(|threads| off(threads, Row::rasterize_ns));
        let smooth = [0, 1].map(|threads| off(threads, Row::smooth_ns));
        let most = rasterize[1].abs().max(smooth[1].abs());
        println!(
            "{:13}{:+8.0} %{:+9.0} %{:+10.0} %{:+9.0} %   {}",
            row[0].free_count,
            100.0 * rasterize[0],
            100.0 * rasterize[1],
            100.0 * smooth[0],
            100.0 * smooth[1],
            target_label(most <= GROWTH_TARGET, most <= GROWTH_FLOOR),
        );
        is_kept &= most <= GROWTH_FLOOR;
    }
    println!("target: ± {:.0} %, floor: ± {:.0} %", 100.0 * GROWTH_TARGET, 100.0 * GROWTH_FLOOR);
    is_kept
}

/// Number of particles for the measurement of shapes.
const SHAPED_COUNT: f64 = 6e5;

/// Measures and prints the time for shapes from neighbours.
fn print_shapes(pools: &[ThreadPool; 2]) {
    let (particles, spacing) = frame(SHAPED_COUNT);
    // As with the default settings, where the reach of kernels is 1.7 spacings, and h 0.32.
    let config = NeighborConfig {
        radius_world: 2.8 * spacing,
        weight_scale: 1.0,
        own_spacing: 1.0,
        stretch: Some(Stretch {
            max_stretch: 2.0,
            floor: 0.5,
            kernels: Some(KernelConfig {
                per_reach: 2.8 / 1.7,
                room_least: 0.03 / 0.32,
                room_most: 0.45 / 0.32,
            }),
        }),
    };
    let count = particles.len() as f64;
    println!("\nshapes of {count} particles by their neighbours: ns a particle");
    println!("threads  sorted into cells      shapes  of a plain loop");
    for (threads, pool) in (1..).zip(pools) {
        let [sort, shapes, plain] = pool.install(|| {
            [
                median_s(|| Neighbors::new(&particles, config.radius_world).cells().len() as f32),
                median_s(|| from_neighbors(&particles, |_| true, None, &config).shapes[0].longest),
                median_s(|| plain_moments(&Neighbors::new(&particles, config.radius_world))),
            ]
        });
        println!(
            "{threads:7}{:19.0}{:12.0}{:15.0} %",
            1e9 * sort / count,
            1e9 * shapes / count,
            100.0 * shapes / plain
        );
    }
}

/// The median over some rounds.
fn median_s(mut work: impl FnMut() -> f32) -> f64 {
    let mut seconds: Vec<f64> = (0..ROUND_COUNT)
        .map(|_| {
            let start = Instant::now();
            std::hint::black_box(work());
            start.elapsed().as_secs_f64()
        })
        .collect();
    seconds.sort_by(f64::total_cmp);
    seconds[ROUND_COUNT / 2]
}

/// Computes the moments around each particle, pair by pair. Returns a value that depends on all of them.
fn plain_moments(neighbors: &Neighbors) -> f32 {
    let [x, y, z] = neighbors.locals();
    let local = |slot: usize| Vec3::new(x[slot], y[slot], z[slot]);
    let of_cell = |cell: usize| {
        let runs: Vec<_> = neighbors.runs(neighbors.cells()[cell]).collect();
        let mut sum = 0.0;
        for slot in neighbors.slots(cell) {
            let mut moments = [0.0f32; 10];
            for run in &runs {
                let from = local(slot) - run.step.as_vec3();
                for other in run.slots.clone() {
                    let apart = local(other) - from;
                    let squared = apart.length_squared();
                    if squared < 1.0 {
                        let weight = 1.0 - squared * squared.sqrt();
                        let [x, y, z] = (apart * weight).to_array();
                        let second = [x * apart.x, y * apart.y, z * apart.z];
                        let mixed = [x * apart.y, x * apart.z, y * apart.z];
                        moments[0] += weight;
                        let terms = [x, y, z].into_iter().chain(second).chain(mixed);
                        moments[1..].iter_mut().zip(terms).for_each(|(moment, term)| *moment += term);
                    }
                }
            }
            sum += moments.iter().sum::<f32>();
        }
        sum
    };
    (0..neighbors.cells().len()).into_par_iter().map(of_cell).sum()
}

fn target_label(is_target: bool, is_floor: bool) -> &'static str {
    match (is_target, is_floor) {
        (true, _) => "target",
        (_, true) => "floor",
        _ => "BELOW THE FLOOR",
    }
}
