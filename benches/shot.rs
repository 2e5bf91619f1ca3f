//! Measures a shot of 240 frames of about 500,000 triangles: `meniscus sequence` combines them into one .usdc
//! file, in one pass. The speed is compared with that of writing the same frames as binary .ply, and the
//! memory with the arrays of a frame.
//!
//! ```text
//!   .ply     arrays in memory ──▶ 240 files
//!   .usdc    240 .glb files ──meniscus sequence──▶ 1 file
//! ```
//!
//! Both write to the same disk, alternately, and both sync their files, as the program always does. The files
//! of both remain until all are written, so that both take as much new memory for the system's cache. The time
//! of .usdc includes the start of the program and reading the frames. MB are 10⁶ bytes of the written files.
//! All frames have different arrays, because .usdc stores equal ones once. Exits with 1 if a figure misses
//! the project's target. Needs python3, and 8 GB of disk space.
//!
//! `cargo bench --bench shot`

#![expect(clippy::print_stdout, reason = "a benchmark prints its results")]

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::time::Instant;

use meniscus::pipeline::write_atomically;
use meniscus::surface::{Options, Surface, reconstruct};
use meniscus_formats::{MeshOptions, MeshView, gltf, ply};

const FRAME_COUNT: usize = 240;
const ROUND_COUNT: usize = 3;

/// Number of particles along the edges of the pool.
const POOL: [usize; 3] = [138, 138, 3];

/// Targets: the speed as a fraction of that of .ply, and the peak memory above that of an empty run, in
/// multiples of the arrays of a frame.
const SPEED_MIN: f64 = 0.4;
const MEMORY_MAX: f64 = 3.0;

fn main() -> ExitCode {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("shot");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("a folder");
    let shot = Shot::new();
    let arrays_mb = shot.array_bytes() as f64 / 1e6;
    println!("{FRAME_COUNT} frames, {} triangles, {arrays_mb:.1} MB of arrays each", shot.triangles.len());
    let frames: Vec<PathBuf> = (0..FRAME_COUNT).map(|index| shot.write_glb(index, &folder)).collect();
    let empty = empty_frame(&folder);
    let empty_run = combine(&[empty], &folder);

    println!("   .ply MB/s  .usdc MB/s     ratio   memory/arrays   .usdc MB");
    let mut ratios = Vec::new();
    let mut memory: f64 = 0.0;
    for _ in 0..ROUND_COUNT {
        let ply = shot.ply_speed(&folder);
        let usdc = combine(&frames, &folder);
        ratios.push(usdc.speed() / ply);
        let multiple = (usdc.peak_mb - empty_run.peak_mb) / arrays_mb;
        memory = memory.max(multiple);
        let (speed, size) = (usdc.speed(), usdc.size_mb);
        println!("{ply:12.0}{speed:12.0}{:10.2}{multiple:16.2}{size:11.0}", speed / ply);
    }
    ratios.sort_by(f64::total_cmp);
    let ratio = ratios[ROUND_COUNT / 2];
    println!("speed: {ratio:.2} of that of .ply, target at least {SPEED_MIN}");
    println!("memory: {memory:.2} times the arrays of a frame, target at most {MEMORY_MAX}");
    fs::remove_dir_all(&folder).expect("removed");
    if ratio >= SPEED_MIN && memory <= MEMORY_MAX {
        return ExitCode::SUCCESS;
    }
    println!("a figure misses its target");
    ExitCode::FAILURE
}

/// A run of `meniscus sequence`.
struct Run {
    seconds: f64,
    peak_mb: f64,
    size_mb: f64,
}

impl Run {
    fn speed(&self) -> f64 {
        self.size_mb / self.seconds
    }
}

/// Combines frames into a .usdc file.
fn combine(frames: &[PathBuf], folder: &Path) -> Run {
    let shot = folder.join("shot.usdc");
    let measure = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/one_process.py");
    let mut command = Command::new("python3");
    command.args(["-I", "-S"]).arg(measure).arg(env!("CARGO_BIN_EXE_meniscus"));
    command.arg("sequence").args(frames).arg("--out").arg(&shot);
    let output = command.output().expect("python3");
    // [seconds, CPU seconds, peak memory in bytes, exit status]
    let text = String::from_utf8(output.stdout).expect("text");
    let numbers: Vec<f64> = text
        .trim()
        .trim_matches(['[', ']'])
        .split(", ")
        .map(|number| number.parse().expect("a number"))
        .collect();
    let &[seconds, _, peak_bytes, 0.0] = &numbers[..] else {
        panic!("meniscus sequence failed: {text}{}", String::from_utf8_lossy(&output.stderr));
    };
    let size_mb = shot.metadata().expect("written").len() as f64 / 1e6;
    fs::remove_file(&shot).expect("removed");
    Run { seconds, peak_mb: peak_bytes / 1e6, size_mb }
}

/// A frame without a mesh.
fn empty_frame(folder: &Path) -> PathBuf {
    let path = folder.join("empty.0001.glb");
    let view = MeshView { positions: &[], normals: &[], triangles: &[], origin: [0.0; 3], attributes: &[] };
    write_atomically(&path, |out| gltf::write_glb(&view, &MeshOptions::default(), &[], out))
        .expect("written");
    path
}

/// The surface of a pool of particles, which waves move.
struct Shot {
    positions: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    triangles: Vec<[u32; 3]>,
}

impl Shot {
    fn new() -> Shot {
        let [width, depth, height] = POOL;
        let scattered = |index: usize, axis: usize| ((3 * index + axis) as f32 * 0.618_034).fract() * 0.3;
        let particles: Vec<[f32; 3]> = (0..width * depth * height)
            .map(|index| {
                let along = [index % width, index / width % depth, index / (width * depth)];
                std::array::from_fn(|axis| along[axis] as f32 + scattered(index, axis))
            })
            .collect();
        let options = Options { spacing: Some(1.0), ..Options::default() };
        let Surface { positions, normals, triangles, .. } =
            reconstruct(&particles, &options).expect("a surface");
        Shot {
            positions: positions.iter().map(|position| position.as_vec3().to_array()).collect(),
            normals: normals.iter().map(|normal| normal.to_array()).collect(),
            triangles,
        }
    }

    fn array_bytes(&self) -> usize {
        size_of_val(&*self.positions) + size_of_val(&*self.normals) + size_of_val(&*self.triangles)
    }

    /// The arrays of a frame, which differ from those of all other frames.
    fn frame(&self, index: usize) -> Shot {
        let phase = index as f32 * 0.1;
        let moved = |&[x, y, z]: &[f32; 3]| [x, y, z + 0.5 * (0.2 * x + phase).sin()];
        let turned = |&[x, y, z]: &[f32; 3]| {
            let length = (x * x + y * y + (z + 0.1 * phase.sin()).powi(2)).sqrt();
            [x, y, z + 0.1 * phase.sin()].map(|part| part / length)
        };
        let mut triangles = self.triangles.clone();
        triangles.rotate_left(index);
        Shot {
            positions: self.positions.iter().map(moved).collect(),
            normals: self.normals.iter().map(turned).collect(),
            triangles,
        }
    }

    fn view(&self) -> MeshView<'_> {
        MeshView {
            positions: &self.positions,
            normals: &self.normals,
            triangles: &self.triangles,
            origin: [0.0; 3],
            attributes: &[],
        }
    }

    fn write_glb(&self, index: usize, folder: &Path) -> PathBuf {
        let path = folder.join(format!("frame.{:04}.glb", index + 1));
        let frame = self.frame(index);
        let options = MeshOptions::default();
        write_atomically(&path, |out| gltf::write_glb(&frame.view(), &options, &[], out)).expect("written");
        path
    }

    /// Writes all frames as .ply, and returns the MB per second.
    fn ply_speed(&self, folder: &Path) -> f64 {
        let (mut seconds, mut size_mb) = (0.0, 0.0);
        let path_of = |index: usize| folder.join(format!("frame.{:04}.ply", index + 1));
        for index in 0..FRAME_COUNT {
            let path = path_of(index);
            let frame = self.frame(index);
            let start = Instant::now();
            write_atomically(&path, |out| ply::write::write_mesh(&frame.view(), &[], out)).expect("written");
            seconds += start.elapsed().as_secs_f64();
            size_mb += path.metadata().expect("written").len() as f64 / 1e6;
        }
        (0..FRAME_COUNT).for_each(|index| fs::remove_file(path_of(index)).expect("removed"));
        size_mb / seconds
    }
}
