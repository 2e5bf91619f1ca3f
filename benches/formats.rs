//! Measures how fast files are read and written, compared with copying the same number of bytes.
//!
//! ```text
//!   read     bytes of a file in memory ──▶ ParticleFrame
//!   write    mesh, level set ──▶ bytes of a file in memory
//! ```
//!
//! No disk is involved. Each row is measured on one core and on all cores, alternating with a copy of as many
//! bytes in memory by one core. MB are 10⁶ bytes of the file. For .vdb, MB are 10⁶ bytes of the leaves, with
//! 4 bytes per voxel: the file contains only the active voxels, about a third of the voxels of the leaves.
//! Exits with 1 if a figure is below the project's target.
//!
//! ```text
//! cargo bench --bench formats                       everything
//! cargo bench --bench formats -- .vdb .csv          only rows whose name contains .vdb or .csv
//! ```

#![expect(clippy::print_stdout, reason = "a benchmark prints its results")]

use std::fmt::Write;
use std::hint::black_box;
use std::process::ExitCode;
use std::thread;
use std::time::Instant;

use meniscus_formats::{
    AttributeRole, FileAttribute, FilePositions, LevelSetView, Limits, MeshOptions, MeshView, OutputFormat,
    ParticleBatch, ParticleBatches, ParticleFrame, Values, bgeo, gltf, ply, read_particles, vdb,
};
use rayon::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};
use twox_hash::XxHash3_128;

const ROUND_COUNT: usize = 7;

/// Number of particles in binary files, and in text files.
const BINARY_PARTICLE_COUNT: usize = 1_000_000;
const TEXT_PARTICLE_COUNT: usize = 300_000;

/// Number of vertices along an edge of the height field that is written as a mesh.
const MESH_EDGE: usize = 700;

/// Radius of the ball that is written as a level set, in voxels.
const BALL_RADIUS: f32 = 220.0;

/// A measured operation.
struct Row<'a> {
    name: &'a str,
    /// Number of bytes that the speed in MB/s refers to.
    size_bytes: usize,
    target: Target,
    work: Box<dyn FnMut() + Send + 'a>,
}

/// The project's target: the minimum in MB/s, and the number of cores.
type Target = Option<(f64, Cores)>;

#[derive(Clone, Copy)]
enum Cores {
    One,
    All,
}

impl Cores {
    /// Selects the value for one core or for all cores.
    fn of<T>(self, one: T, all: T) -> T {
        match self {
            Cores::One => one,
            Cores::All => all,
        }
    }
}

fn main() -> ExitCode {
    let core_count = thread::available_parallelism().map_or(1, usize::from);
    let pools = [1, core_count]
        .map(|threads| ThreadPoolBuilder::new().num_threads(threads).build().expect("threads"));
    println!(
        "{core_count} cores, {ROUND_COUNT} rounds; MB/s, and as a fraction of the speed of a copy by one core"
    );
    println!("                                  one core:                 all cores:");
    println!(
        "                              MB  median    best  of copy   median    best  of copy  target, MB/s"
    );
    let reading = reading_rows(&pools);
    let writing = writing_rows(&pools);
    if reading && writing {
        return ExitCode::SUCCESS;
    }
    println!("a figure is below its target");
    ExitCode::FAILURE
}

/// Measures the readers. Returns whether they reach their targets.
fn reading_rows(pools: &[ThreadPool; 2]) -> bool {
    let frame = particles(BINARY_PARTICLE_COUNT);
    let files = [
        ("read binary .ply", "f.ply", ply_file(&frame, "binary_little_endian"), Some((1000.0, Cores::All))),
        ("read big-endian .ply", "f.ply", ply_file(&frame, "binary_big_endian"), Some((1000.0, Cores::All))),
        ("read classic .bgeo", "f.bgeo", bgeo_file(&frame), None),
        ("read .csv", "f.csv", csv_file(&particles(TEXT_PARTICLE_COUNT)), Some((250.0, Cores::One))),
        ("read ASCII .ply", "f.ply", ply_file(&particles(TEXT_PARTICLE_COUNT), "ascii"), None),
    ];
    let mut meets_target = true;
    for (name, file_name, bytes, target) in &files {
        let read = || {
            black_box(read_particles(bytes, file_name, &Limits::default()).expect("a good file"));
        };
        meets_target &=
            measure(Row { name, size_bytes: bytes.len(), target: *target, work: Box::new(read) }, pools);
    }
    let bytes = &files[0].2;
    let read = || {
        let batches =
            ParticleBatches::open(&bytes[..], "f.ply", &Limits::default(), 1 << 20).expect("a good file");
        let batches = batches.expect("of fixed records");
        let indices = (0..batches.batch_count()).into_par_iter();
        let read = |batch: &mut ParticleBatch, index| {
            batches.read_batch(index, batch).expect("a good file");
            black_box(&batch.positions);
        };
        indices.for_each_init(ParticleBatch::default, read);
    };
    let target = Some((1000.0, Cores::All));
    let row = Row { name: "read .ply in batches", size_bytes: bytes.len(), target, work: Box::new(read) };
    meets_target &= measure(row, pools);
    let hash = || {
        black_box(XxHash3_128::oneshot(bytes));
    };
    meets_target
        & measure(Row { name: "hash", size_bytes: bytes.len(), target: None, work: Box::new(hash) }, pools)
}

/// Measures the writers. Returns whether they reach their targets.
fn writing_rows(pools: &[ThreadPool; 2]) -> bool {
    let mesh = HeightField::new(MESH_EDGE);
    let mesh = mesh.view();
    let mut meets_target = true;
    type WriteMesh<'a> = &'a (dyn Fn(&mut Vec<u8>) + Sync);
    let writers: [(&str, Target, WriteMesh); 6] = [
        ("write .glb", Some((500.0, Cores::All)), &|out| {
            gltf::write_glb(&mesh, &MeshOptions::default(), &[], out).expect("written");
        }),
        ("write .gltf", None, &|out| {
            gltf::write_gltf(&mesh, &MeshOptions::default(), &[], out).expect("written");
        }),
        ("write .ply", None, &|out| ply::write::write_mesh(&mesh, &[], out).expect("written")),
        ("write .abc", None, &|out| {
            OutputFormat::Abc.write_mesh(&mesh, &MeshOptions::default(), &[], out).expect("written");
        }),
        ("write .obj", Some((150.0, Cores::All)), &|out| {
            OutputFormat::Obj.write_mesh(&mesh, &MeshOptions::default(), &[], out).expect("written");
        }),
        ("write .usdc", None, &|out| {
            OutputFormat::Usdc.write_mesh(&mesh, &MeshOptions::default(), &[], out).expect("written");
        }),
    ];
    for (name, target, write) in writers {
        let mut file = Vec::new();
        write(&mut file);
        let size_bytes = file.len();
        let work = Box::new(|| {
            file.clear();
            write(&mut file);
        });
        meets_target &= measure(Row { name, size_bytes, target, work }, pools);
    }
    let ball = Ball::new(BALL_RADIUS);
    for (name, compression, half) in [
        ("write .vdb, Blosc", vdb::Compression::Blosc, false),
        ("write .vdb, Blosc, 16 bits", vdb::Compression::Blosc, true),
        ("write .vdb, active", vdb::Compression::ActiveMask, false),
    ] {
        let options = vdb::WriteOptions { compression, half, ..vdb::WriteOptions::default() };
        let mut file = Vec::new();
        let work = Box::new(|| {
            file.clear();
            vdb::write(&ball.view(), &options, &[], &mut file).expect("written");
        });
        let size_bytes = 4 * ball.stored_voxel_count();
        meets_target &= measure(Row { name, size_bytes, target: Some((300.0, Cores::One)), work }, pools);
    }
    meets_target
}

/// Whether the arguments select a row: its name contains one of them, or there are no arguments.
fn is_wanted(name: &str) -> bool {
    let wanted: Vec<String> =
        std::env::args().skip(1).filter(|argument| !argument.starts_with('-')).collect();
    wanted.is_empty() || wanted.iter().any(|part| name.contains(part.as_str()))
}

/// Measures an operation alternating with a copy and prints its row. Returns whether it reaches its target.
fn measure(mut row: Row, pools: &[ThreadPool; 2]) -> bool {
    if !is_wanted(row.name) {
        return true;
    }
    let source = vec![1_u8; row.size_bytes];
    let mut target = vec![0_u8; row.size_bytes];
    let mut seconds: [Vec<f64>; 3] = Default::default();
    // Warm up: the first run is slower, because it requests memory from the system, and is not measured.
    pools[1].install(&mut row.work);
    for _ in 0..ROUND_COUNT {
        seconds[0].push(timed(|| black_box(&mut target).copy_from_slice(black_box(&source))));
        seconds[1].push(timed(|| pools[0].install(&mut row.work)));
        seconds[2].push(timed(|| pools[1].install(&mut row.work)));
    }
    let size_mb = row.size_bytes as f64 / 1e6;
    let [copy, one, all] = seconds.map(|seconds| speeds(size_mb, seconds));
    let mut line = format!("{:26}{size_mb:6.1}", row.name);
    for Speeds { median, best } in [&one, &all] {
        let _ = write!(line, "{median:8.0}{best:8.0}{:9.3} ", median / copy.median);
    }
    let meets_target = row.target.is_none_or(|(least, cores)| least <= cores.of(&one, &all).median);
    if let Some((least, cores)) = row.target {
        let _ = write!(line, "{least:5.0} {}", cores.of("on one core", "on all cores"));
        line += if meets_target { "" } else { ", BELOW TARGET" };
    }
    println!("{line}");
    meets_target
}

/// MB per second.
struct Speeds {
    median: f64,
    best: f64,
}

fn speeds(size_mb: f64, mut seconds: Vec<f64>) -> Speeds {
    seconds.sort_by(f64::total_cmp);
    Speeds { median: size_mb / seconds[seconds.len() / 2], best: size_mb / seconds[0] }
}

fn timed(work: impl FnOnce()) -> f64 {
    let start = Instant::now();
    work();
    start.elapsed().as_secs_f64()
}

/// Particles with velocities and ids. Their values have various digits, as those of a simulation.
fn particles(count: usize) -> ParticleFrame {
    let number = |index: usize, scale: f32| ((index as f32 * 0.618_034).fract() - 0.5) * scale;
    let vectors = |scale: f32| -> Vec<[f32; 3]> {
        (0..count).map(|index| [3 * index, 3 * index + 1, 3 * index + 2].map(|i| number(i, scale))).collect()
    };
    let ids = (0..count).filter_map(|index| i32::try_from(index).ok()).collect();
    let velocity = vectors(7.0).into_flattened();
    ParticleFrame {
        positions: FilePositions::F32(vectors(2.0)),
        attributes: vec![
            FileAttribute {
                name: "v".into(),
                arity: 3,
                role: Some(AttributeRole::Velocity),
                values: Values::F32(velocity),
            },
            FileAttribute {
                name: "id".into(),
                arity: 1,
                role: Some(AttributeRole::Id),
                values: Values::I32(ids),
            },
        ],
        notes: Vec::new(),
    }
}

/// Position, velocity and id of each particle.
fn rows(frame: &ParticleFrame) -> impl Iterator<Item = ([f32; 6], i32)> {
    let FilePositions::F32(positions) = &frame.positions else { unreachable!("made so") };
    let (Values::F32(velocities), Values::I32(ids)) =
        (&frame.attributes[0].values, &frame.attributes[1].values)
    else {
        unreachable!("made so")
    };
    let vectors = positions.iter().zip(velocities.as_chunks::<3>().0);
    vectors.zip(ids).map(|((&[x, y, z], &[u, v, w]), &id)| ([x, y, z, u, v, w], id))
}

fn ply_file(frame: &ParticleFrame, encoding: &str) -> Vec<u8> {
    let count = frame.positions.len();
    let mut header = format!("ply\nformat {encoding} 1.0\nelement vertex {count}\n");
    for name in ["x", "y", "z", "vx", "vy", "vz"] {
        let _ = writeln!(header, "property float {name}");
    }
    header += "property int id\nend_header\n";
    let mut file = header.into_bytes();
    for (reals, id) in rows(frame) {
        match encoding {
            "binary_little_endian" => {
                file.extend(reals.iter().flat_map(|real| real.to_le_bytes()));
                file.extend(id.to_le_bytes());
            }
            "binary_big_endian" => {
                file.extend(reals.iter().flat_map(|real| real.to_be_bytes()));
                file.extend(id.to_be_bytes());
            }
            _ => {
                let [x, y, z, u, v, w] = reals;
                file.extend(format!("{x} {y} {z} {u} {v} {w} {id}\n").bytes());
            }
        }
    }
    file
}

fn bgeo_file(frame: &ParticleFrame) -> Vec<u8> {
    let mut file = Vec::new();
    bgeo::write(frame, &mut file).expect("written");
    file
}

fn csv_file(frame: &ParticleFrame) -> Vec<u8> {
    let mut text = String::from("x,y,z,vx,vy,vz,id\n");
    for ([x, y, z, u, v, w], id) in rows(frame) {
        let _ = writeln!(text, "{x},{y},{z},{u},{v},{w},{id}");
    }
    text.into_bytes()
}

/// A square with waves.
struct HeightField {
    positions: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    triangles: Vec<[u32; 3]>,
}

impl HeightField {
    fn new(edge: usize) -> HeightField {
        let position = |index: usize| [index % edge, index / edge].map(|along| along as f32 * 0.013);
        let vertex = |index| {
            let [x, y] = position(index);
            [x, y, 0.3 * (x * 1.7).sin() * (y * 2.3).cos()]
        };
        let normal = |index| {
            let [x, y] = position(index);
            let slope = [-0.51 * (x * 1.7).cos() * (y * 2.3).cos(), 0.69 * (x * 1.7).sin() * (y * 2.3).sin()];
            let length = (slope[0] * slope[0] + slope[1] * slope[1] + 1.0).sqrt();
            [slope[0] / length, slope[1] / length, 1.0 / length]
        };
        let corners = |cell: usize| {
            let first = cell / (edge - 1) * edge + cell % (edge - 1);
            [first, first + 1, first + edge + 1, first + edge].map(|v| u32::try_from(v).expect("few"))
        };
        let count = edge * edge;
        HeightField {
            positions: (0..count).map(vertex).collect(),
            normals: (0..count).map(normal).collect(),
            triangles: (0..(edge - 1) * (edge - 1))
                .flat_map(|cell| {
                    let [a, b, c, d] = corners(cell);
                    [[a, b, c], [a, c, d]]
                })
                .collect(),
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
}

/// The narrow band of a sphere.
struct Ball {
    origins: Vec<[i32; 3]>,
    leaves: Vec<[f32; 512]>,
}

impl Ball {
    const HALF_WIDTH_VOXELS: f32 = 3.0;

    fn new(radius: f32) -> Ball {
        let leaf_radius = (radius / 8.0) as i32 + 2;
        let side = -leaf_radius..leaf_radius;
        let distance = |voxel: [i32; 3]| {
            let squares = voxel.map(|c| (c as f32) * (c as f32));
            (squares[0] + squares[1] + squares[2]).sqrt() - radius
        };
        let mut ball = Ball { origins: Vec::new(), leaves: Vec::new() };
        for x in side.clone() {
            for (y, z) in side.clone().flat_map(|y| side.clone().map(move |z| (y, z))) {
                let origin = [x, y, z].map(|c| c * 8);
                if distance(origin.map(|c| c + 4)).abs() > 10.0 {
                    continue;
                }
                let offsets = (0..8).flat_map(|x| (0..8).flat_map(move |y| (0..8).map(move |z| [x, y, z])));
                let mut leaf = [0.0; 512];
                for (value, [dx, dy, dz]) in leaf.iter_mut().zip(offsets) {
                    *value = distance([origin[0] + dx, origin[1] + dy, origin[2] + dz]);
                }
                ball.origins.push(origin);
                ball.leaves.push(leaf);
            }
        }
        ball.in_tree_order()
    }

    /// Sorts the leaves in the order of the file, as the program does.
    fn in_tree_order(self) -> Ball {
        let mut order: Vec<usize> = (0..self.origins.len()).collect();
        order.sort_by_key(|&index| [12, 7, 3].map(|log2| self.origins[index].map(|c| c >> log2)));
        Ball {
            origins: order.iter().map(|&index| self.origins[index]).collect(),
            leaves: order.iter().map(|&index| self.leaves[index]).collect(),
        }
    }

    fn stored_voxel_count(&self) -> usize {
        let is_active = |value: &f32| value.abs() < Ball::HALF_WIDTH_VOXELS;
        512 * self.leaves.iter().filter(|leaf| leaf.iter().any(is_active)).count()
    }

    fn view(&self) -> LevelSetView<'_> {
        LevelSetView {
            origins: &self.origins,
            leaves: &self.leaves,
            half_width_voxels: Ball::HALF_WIDTH_VOXELS,
            voxel_size: 0.025,
            grids: &[],
        }
    }
}
