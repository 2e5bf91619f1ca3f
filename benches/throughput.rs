//! Measures the overhead of the daemon under load: frames through `watch --once`, compared with the same
//! frames through the stages in a plain loop.
//!
//! ```text
//!   daemon   start, scan, records ─▶ frames in parallel, each on one core if several wait ─▶ end
//!   loop     start ─▶ read, rasterize, smooth, contour, write, one frame after the other ─▶ end
//! ```
//!
//! Both run as separate processes with the same number of threads, alternately, so that both see the same
//! state of the machine. Exits with 1 if the median of the ratios exceeds the project's target.
//!
//! `cargo bench --bench throughput`

#![expect(clippy::print_stdout, reason = "a benchmark prints its results")]

mod block;

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::thread;
use std::time::Instant;

use meniscus::pipeline::{AttributeRequest, parse_particles, read_file, write_atomically};
use meniscus::surface::options::{MethodOptions, Settings};
use meniscus::surface::reconstruction::{FrameSurface, reconstruct_frame};
use meniscus_formats::{LevelSetView, MeshOptions, MeshView, gltf, vdb};
use rayon::ThreadPoolBuilder;

use block::block_ply;

/// The frames to convert: their number, and the block of particles in each.
struct Load {
    frame_count: usize,
    block: [usize; 3],
}

const LOADS: [Load; 2] =
    [Load { frame_count: 60, block: [20, 15, 10] }, Load { frame_count: 20, block: [50, 25, 20] }];

const ROUND_COUNT: usize = 7;
const RATIO_MAX: f64 = 1.05;
const VOXEL_SIZE: f64 = 0.05;

/// Argument with which this program runs itself as the plain loop.
const PLAIN: &str = "--plain-loop";

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().collect();
    if let [_, plain, folder] = &arguments[..]
        && plain == PLAIN
    {
        plain_loop(Path::new(folder));
        return ExitCode::SUCCESS;
    }
    let threads = thread::available_parallelism().map_or(1, usize::from);
    println!("`watch --once` against a plain loop, {threads} threads, {ROUND_COUNT} rounds, medians");
    println!("  frames  particles    loop s  daemon s     ratio   lowest  highest");
    let ratios = LOADS.map(|load| measure(&load));
    if ratios.iter().all(|&ratio| ratio <= RATIO_MAX) {
        return ExitCode::SUCCESS;
    }
    println!("a ratio is above {RATIO_MAX}");
    ExitCode::FAILURE
}

/// Measures daemon and loop alternately, prints a row, and returns the median of the ratios.
fn measure(load: &Load) -> f64 {
    let folder = tempfile::tempdir().expect("a folder");
    let watched = folder.path().join("in");
    fs::create_dir(&watched).expect("made");
    for number in 0..load.frame_count {
        let bytes = block_ply(load.block, 0.01 * number as f32);
        fs::write(watched.join(format!("dam.{number}.ply")), bytes).expect("written");
    }
    // Warm up, not measured. Meanwhile the files become old enough for the daemon to count them as stable.
    run_plain_loop(folder.path());
    let times = (0..ROUND_COUNT).map(|_| [run_plain_loop(folder.path()), run_daemon(folder.path())]);
    let times: Vec<[f64; 2]> = times.collect();
    let sorted = |figure: &dyn Fn(&[f64; 2]) -> f64| {
        let mut figures: Vec<f64> = times.iter().map(figure).collect();
        figures.sort_by(f64::total_cmp);
        figures
    };
    let ratios = sorted(&|[of_loop, of_daemon]| of_daemon / of_loop);
    let ratio = ratios[ROUND_COUNT / 2];
    println!(
        "{:8}{:11}{:10.3}{:10.3}{:10.3}{:9.3}{:9.3}",
        load.frame_count,
        load.block.iter().product::<usize>(),
        sorted(&|times| times[0])[ROUND_COUNT / 2],
        sorted(&|times| times[1])[ROUND_COUNT / 2],
        ratio,
        ratios[0],
        ratios[ROUND_COUNT - 1],
    );
    ratio
}

fn run_plain_loop(folder: &Path) -> f64 {
    let mut command = Command::new(env::current_exe().expect("this program"));
    command.arg(PLAIN).arg(folder);
    run_timed(folder, command)
}

fn run_daemon(folder: &Path) -> f64 {
    let mut command = Command::new(env!("CARGO_BIN_EXE_meniscus"));
    let voxel_size = VOXEL_SIZE.to_string();
    command.args(["watch", "in", "--out", "out", "--once", "--preset", "paper", "--voxel-size", &voxel_size]);
    run_timed(folder, command)
}

/// The seconds from the start of a process to its end, with an empty output folder.
fn run_timed(folder: &Path, mut command: Command) -> f64 {
    let out = folder.join("out");
    fs::create_dir(&out).expect("made");
    command.current_dir(folder).env_remove("NOTIFY_SOCKET").stdin(Stdio::null()).stderr(Stdio::null());
    let start = Instant::now();
    let status = command.status().expect("it starts");
    let seconds = start.elapsed().as_secs_f64();
    assert!(status.success(), "{status}");
    fs::remove_dir_all(&out).expect("removed");
    seconds
}

/// Converts the frames in `folder`/`in` one after the other, with all threads on each stage.
fn plain_loop(folder: &Path) {
    let settings = Settings::paper(VOXEL_SIZE, &MethodOptions::default()).expect("valid");
    let pool = ThreadPoolBuilder::new().build().expect("threads");
    let mut inputs: Vec<PathBuf> = fs::read_dir(folder.join("in"))
        .expect("the folder exists")
        .map(|entry| entry.expect("an entry").path())
        .collect();
    inputs.sort();
    for input in inputs {
        let content = read_file(&input).expect("readable");
        let stem = input.file_stem().expect("a name").to_string_lossy().into_owned();
        pool.install(|| {
            let read = parse_particles(&input, content, &AttributeRequest::default()).expect("particles");
            let surface = reconstruct_frame(&read.cloud.positions, &settings);
            write_surface(&surface, &settings, &folder.join("out"), &stem);
        });
    }
}

/// Writes the default outputs of the daemon.
fn write_surface(surface: &FrameSurface, settings: &Settings, folder: &Path, stem: &str) {
    let mesh = MeshView {
        positions: bytemuck::cast_slice(&surface.mesh.positions),
        normals: bytemuck::cast_slice(&surface.mesh.normals),
        triangles: &surface.mesh.triangles,
        origin: surface.mesh.origin.to_array(),
        attributes: &[],
    };
    write_atomically(&folder.join(format!("{stem}.glb")), |out| {
        gltf::write_glb(&mesh, &MeshOptions::default(), &[], out)
    })
    .expect("written");
    let origins: Vec<[i32; 3]> =
        surface.band.topology.origins().iter().map(|origin| origin.to_array()).collect();
    let levels = LevelSetView {
        origins: &origins,
        leaves: surface.band.phi.as_arrays(),
        half_width_voxels: 3.0,
        voxel_size: settings.voxel_size,
        grids: &[],
    };
    let options = vdb::WriteOptions::default();
    write_atomically(&folder.join(format!("{stem}.vdb")), |out| vdb::write(&levels, &options, &[], out))
        .expect("written");
}
