//! Readers survive damaged files: they return a result or an error, never panic, and never allocate memory
//! for data that is not in the file.
//!
//! Every file of the corpus is truncated at many lengths, and gets random bit flips. A reader may return any
//! result, but it must return, and it must never use more than 64 MiB in addition to the size of its input.
//! The files have a few kilobytes, so a reader that uses more memory trusted a count in the file.

#![allow(clippy::cast_possible_truncation, reason = "sizes and small random numbers")]

mod fixtures;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use meniscus_formats::{
    AttributeRole, BandGrid, ContainerFile, FileAttribute, Format, LeafValues, LevelSetView, Limits,
    MeshOptions, MeshView, OutputFormat, ParticleBatch, ParticleBatches, ProbedKind, ReadAt, Result, Values,
    abc, bgeo, container, csv, hdf5, lammps, particles_of, ply, read_mesh, read_obstacle, read_particles,
    to_glb, vdb, xdmf,
};
use peak_alloc::PeakAlloc;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Number of bytes of memory that a reader may use in addition to the size of its input.
const ALLOWED_BYTES: usize = 64 << 20;
/// Number of lengths to which each file is truncated.
const CUT_COUNT: usize = 200;
/// Number of variants of each file with flipped bits; four times as many with `MENISCUS_LONG=1`.
const FLIP_COUNT: u64 = 500;

#[test]
fn damaged_ply_files_do_not_panic() {
    let _alone = alone();
    for (name, bytes) in corpus(&[".ply"]) {
        sweep(&name, &bytes, |bytes| ply::read(bytes, &Limits::default()));
        sweep(&name, &bytes, |bytes| ply::read_mesh(bytes, &Limits::default()));
    }
}

#[test]
fn damaged_bgeo_files_do_not_panic() {
    let _alone = alone();
    let source = corpus(&["taichi_000007.ply"]).remove(0).1;
    let mut frame = ply::read(&source, &Limits::default()).unwrap();
    frame.attributes.push(FileAttribute {
        name: "material".into(),
        arity: 1,
        role: None,
        values: Values::Strings {
            table: vec!["water".into(), "oil".into()],
            indices: vec![1; frame.positions.len()],
        },
    });
    let mut bytes = Vec::new();
    bgeo::write(&frame, &mut bytes).unwrap();
    sweep("written.bgeo", &bytes, |bytes| bgeo::read(bytes, &Limits::default()));
}

#[test]
fn damaged_delimited_text_does_not_panic() {
    let _alone = alone();
    for (name, bytes) in corpus(&[".csv", ".txt", ".dat", ".xyz", ".pts", ".tsv", ".dump"]) {
        sweep(&name, &bytes, |bytes| csv::read(bytes, &Limits::default()));
    }
}

#[test]
fn damaged_files_do_not_panic_in_batches() {
    let _alone = alone();
    let read = |bytes: &[u8]| {
        let Some(batches) = ParticleBatches::open(bytes, "f", &Limits::default(), 1 << 16)? else {
            return Ok(());
        };
        let mut batch = ParticleBatch::default();
        (0..batches.batch_count()).try_for_each(|index| batches.read_batch(index, &mut batch))
    };
    for (name, bytes) in corpus(&[".ply"]) {
        sweep(&name, &bytes, read);
    }
    let source = corpus(&["taichi_000007.ply"]).remove(0).1;
    let mut bytes = Vec::new();
    bgeo::write(&ply::read(&source, &Limits::default()).unwrap(), &mut bytes).unwrap();
    sweep("written.bgeo", &bytes, read);
}

#[test]
fn damaged_files_of_any_kind_do_not_panic() {
    let _alone = alone();
    for (name, bytes) in corpus(&[""]) {
        sweep(&name, &bytes, |bytes| read_particles(bytes, &name, &Limits::default()));
    }
    for (name, bytes) in corpus(&["taichi", "plyfile_ascii", "vtkDelimited"]) {
        sweep(&name, &gzipped(&bytes), |bytes| read_particles(bytes, &name, &Limits::default()));
        sweep(&name, &zstd_packed(&bytes), |bytes| read_particles(bytes, &name, &Limits::default()));
    }
}

#[test]
fn damaged_files_of_other_formats_do_not_panic() {
    let _alone = alone();
    for (name, bytes) in fixtures::all() {
        sweep(&name, &bytes, |bytes| read_particles(bytes, &name, &Limits::default()));
    }
}

/// The lists are damaged, and the files that they name.
#[test]
fn damaged_lists_of_files_do_not_panic() {
    let _alone = alone();
    let file = fixtures::vtk_list(
        "PolyData",
        "<Piece NumberOfPoints=\"1\"><Points><DataArray type=\"Float32\" NumberOfComponents=\"3\" format=\"ascii\">1 2 3</DataArray></Points></Piece>",
    );
    let lists = fixtures::vtk_lists();
    let frames = |list: &[u8], file: &[u8]| {
        let open = |path: &str| -> std::io::Result<Box<dyn ReadAt>> {
            let nested = lists.iter().find(|(name, _)| name == path).map(|(_, bytes)| &bytes[..]);
            Ok(Box::new(Arc::<[u8]>::from(nested.unwrap_or(file))))
        };
        let (kind, limits) = (ProbedKind::Format(Format::VtkIndex), Limits::default());
        let container = ContainerFile { file: &list, name: "list", open: &open };
        let found = container::frames(kind, &container, &limits)?;
        (0..found.samples.len().min(3)).try_for_each(|index| {
            let loaded = container::read_sample(kind, &container, &found, index, &limits)?;
            particles_of(loaded, "list", &[], &limits).map(drop)
        })
    };
    for (name, bytes) in &lists {
        frames(bytes, file.as_bytes()).unwrap_or_else(|error| panic!("{name}: {error}"));
        sweep(name, bytes, |bytes| frames(bytes, file.as_bytes()));
    }
    sweep("a.vtp", file.as_bytes(), |bytes| frames(&lists[0].1, bytes));
}

/// The frames of a container of this size that is damaged: all of the first few are read.
fn read_all(
    bytes: &[u8],
    frames: fn(&ContainerFile, &Limits) -> Result<container::ContainerFrames>,
) -> Result<()> {
    let other = fixtures::hdf5_files().swap_remove(0).1; // for each name
    let open = |_: &str| Ok(Box::new(Arc::<[u8]>::from(&other[..])) as Box<dyn ReadAt>);
    let container = ContainerFile { file: &bytes, name: "a", open: &open };
    let limits = Limits::default();
    let found = frames(&container, &limits)?;
    (0..found.samples.len().clamp(1, 3))
        .try_for_each(|index| found.read(&container, index, &limits).map(drop))
}

#[test]
fn damaged_hdf5_files_do_not_panic() {
    let _alone = alone();
    for (name, bytes) in fixtures::hdf5_files() {
        sweep(&name, &bytes, |bytes| read_all(bytes, hdf5::frames));
    }
}

#[test]
fn damaged_xdmf_files_do_not_panic() {
    let _alone = alone();
    for turn in 0..10 {
        sweep(&format!("{turn}.xmf"), fixtures::XDMF.as_bytes(), |bytes| read_all(bytes, xdmf::frames));
    }
}

/// Files of some megabytes in which a few bytes cause the largest possible use of memory or time:
/// description, content and expected words of the error.
fn worst_files() -> Vec<(&'static str, Vec<u8>, &'static str)> {
    let bytes_of =
        |numbers: &[u64]| numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>();
    let zeros = fixtures::zlib_packed(&vec![0; 128 << 20]);
    let last_block = [
        b"<VTKFile type=\"PolyData\" header_type=\"UInt64\" compressor=\"vtkZLibDataCompressor\"><PolyData><Piece \
          NumberOfPoints=\"1\"><Points><DataArray type=\"UInt8\" NumberOfComponents=\"3\" format=\"appended\" offset=\"0\"/>\
          </Points></Piece></PolyData><AppendedData encoding=\"raw\">_",
        &bytes_of(&[1, 1, 1 << 40, zeros.len() as u64])[..],
        &zeros,
        b"</AppendedData></VTKFile>",
    ];
    let columns = |fortran| fixtures::array(1, "'|u1'", fortran, "(1, 8388608)", &vec![0; 8 << 20]);
    let legacy = "# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS 0 float\n";
    let geometry = |points: u32, attributes: &[u8]| {
        let mut bytes = b"\x7fNSJb[\x27\x0apointcount\x14".to_vec();
        bytes.extend(u64::from(points).to_le_bytes());
        bytes.extend(b"\x27\x0aattributes[\x27\x0fpointattributes[");
        [&bytes, attributes, b"]]]"].concat()
    };
    let one_piece = |code: u8, count: u32, payload: Vec<u8>| {
        [&[0x40, code, 0xf4][..], &count.to_le_bytes(), &payload].concat()
    };
    let position = b"[[\x27\x04type\x27\x07numeric\x27\x04name\x27\x01P][\x27\x06values[\x27\x04size\x11\x03\
                     \x27\x07storage\x27\x08fpreal64";
    let narrow = one_piece(0x11, 24 << 20, vec![1; 24 << 20]);
    let narrow = [&position[..], b"\x27\x0brawpagedata", &narrow, b"]]]"].concat();
    let flags = one_piece(0x10, 32 << 20, vec![0; 4 << 20]);
    let flags =
        [&position[..], b"\x27\x08pagesize\x11\x01\x27\x11constantpageflags[", &flags.repeat(7), b"]]]]"]
            .concat();
    let word = [&b"\x2b\x00\xf4"[..], &(1u32 << 20).to_le_bytes(), &vec![b'a'; 1 << 20]].concat();
    let texts = b"[[\x27\x04type\x27\x06string\x27\x04name\x27\x01s][\x27\x07strings";
    let texts = [&word, &texts[..], &one_piece(0x26, 1 << 16, vec![0; 1 << 16]), b"]]"].concat();
    vec![
        ("a last block of VTK", last_block.concat(), "the last block has"),
        ("columns of NumPy", columns(false), "does not have so many columns"),
        ("columns of Fortran", columns(true), "does not have so many columns"),
        (
            "notes of VTK",
            [legacy, "POINT_DATA 0\nFIELD f 2000000\n", &"a 1 1 int\n1\n".repeat(2_000_000)].concat().into(),
            "more arrays than",
        ),
        ("notes of Houdini", geometry(1, &b"[[]\x00]".repeat(6 << 20)), "more than the limit of 4096"),
        ("narrow numbers of Houdini", geometry(8 << 20, &narrow), "the arrays expand to more than"),
        ("flags of Houdini", geometry(u32::MAX, &flags), "the arrays expand to more than"),
        ("words of Houdini", geometry(1, &texts), "the strings of an array have"),
        (
            "names of JSON",
            format!("{{{}", names_of_json(500_000)).into(),
            "names, more than the limit of 4096",
        ),
        ("depth of JSON", [b"{\"a\":".to_vec(), vec![b'['; 8 << 20]].concat(), "the file ends where"),
        ("depth of a list of JSON", vec![b'['; 8 << 20], "save each frame as a file"),
        (
            "row of JSON",
            ["[[", &"0,".repeat(4 << 20), "0]]"].concat().into(),
            "expected a list of 3 numbers, found 33",
        ),
        (
            "channels of PRT",
            fixtures::prt(1, &[], 1, &[("Position", 4, 3, 0); 4096], &[0; 12]),
            "the channels overlap",
        ),
        (
            "zeros of PRT",
            fixtures::prt(1, &[], 1 << 23, &[("Position", 4, 3, 0)], &vec![0; 12 << 23]),
            "expands to more than 200 times",
        ),
    ]
}

/// Names with values that are skipped, each with a note.
fn names_of_json(count: usize) -> String {
    (0..count).map(|n| format!("\"{n}\":[\"\"],")).collect()
}

#[test]
fn worst_case_files_are_errors_with_little_memory() {
    let _alone = alone();
    for (name, bytes, words) in worst_files() {
        let read = |bytes: &[u8]| read_particles(bytes, "worst", &Limits::default());
        check_within(name, &bytes, 4 * bytes.len() + ALLOWED_BYTES, &read);
        let error = read(&bytes).expect_err(name).to_string();
        assert!(error.contains(words), "{name}: expected `{words}` in: {error}");
    }
}

/// A reader must not scan the blank space at the end of the file again for each step.
#[test]
fn blanks_after_many_steps_are_scanned_once() {
    let _alone = alone();
    let steps = "ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n0\nITEM: ATOMS x y z\n".repeat(100_000);
    let text = steps + &" ".repeat(8 << 20);
    let count =
        |bytes: &[u8]| lammps::steps(bytes, &Limits::default()).map(|steps| assert_eq!(steps.len(), 100_000));
    check("blank.dump", text.as_bytes(), &count);
}

/// A decompression bomb must be rejected early, whatever the format of its contents is.
#[test]
fn decompression_bombs_are_errors() {
    let _alone = alone();
    let starts: [&[u8]; 4] = [
        b"",
        b"x,y,z\n",
        b"ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nproperty float y\n\
          property float z\nend_header\n",
        b"BgeoV\0\0\0\x05\x70\0\0\0",
    ];
    for (start, filling) in starts.into_iter().flat_map(|start| [(start, 0), (start, b'1'), (start, b'\n')]) {
        let bomb = gzipped(&[start, &vec![filling; 100 << 20]].concat());
        let limits = Limits::default();
        check("bomb", &bomb, &|bytes| read_particles(bytes, "bomb.gz", &limits));
        assert!(read_particles(&bomb, "bomb.gz", &limits).is_err(), "{:?}", shown(start));
        let bomb = zstd_packed(&[start, &vec![filling; 100 << 20]].concat());
        check("bomb", &bomb, &|bytes| read_particles(bytes, "bomb.zst", &limits));
        assert!(read_particles(&bomb, "bomb.zst", &limits).is_err(), "{:?}", shown(start));
    }
}

#[test]
fn damaged_level_sets_do_not_panic() {
    let _alone = alone();
    let origins: Vec<[i32; 3]> =
        (0..8).map(|n| [n >> 2, n >> 1 & 1, n & 1].map(|side| (side - 1) * 8)).collect();
    let phi = |origin: [i32; 3], offset: usize| {
        let voxel = [offset >> 6, offset >> 3 & 7, offset & 7];
        let squares = (0..3).map(|axis| (origin[axis] + voxel[axis] as i32).pow(2));
        (squares.sum::<i32>() as f32).sqrt() - 4.5
    };
    let leaves: Vec<[f32; 512]> =
        origins.iter().map(|&origin| std::array::from_fn(|offset| phi(origin, offset))).collect();
    let levels = LevelSetView {
        origins: &origins,
        leaves: &leaves,
        half_width_voxels: 3.0,
        voxel_size: 0.1,
        grids: &[BandGrid { name: "v", role: Some(AttributeRole::Velocity), arity: 3, values: &OneVelocity }],
    };
    for compression in [vdb::Compression::None, vdb::Compression::ActiveMask, vdb::Compression::Blosc] {
        let mut bytes = Vec::new();
        let options = vdb::WriteOptions { compression, half: true, ..vdb::WriteOptions::default() };
        vdb::write(&levels, &options, &[], &mut bytes).unwrap();
        sweep("written.vdb", &bytes, |bytes| vdb::read_level_set(bytes, None, &Limits::default()));
        sweep("written.vdb", &bytes, |bytes| vdb::grids(bytes, &Limits::default()));
        sweep("written.vdb", &bytes, |bytes| vdb::read_vectors(bytes, &["velocity"], &Limits::default()));
    }
}

#[derive(Debug)]
struct OneVelocity;

impl LeafValues for OneVelocity {
    fn fill(&self, _leaf: usize, out: &mut [f32]) {
        out.as_chunks_mut().0.fill([1.0, 2.0, 3.0]);
    }
}

/// Thousands of small grids, each of which declares the rest of the file as its metadata.
#[test]
fn overlapping_grids_are_an_error() {
    let _alone = alone();
    let bytes = overlapping_grids(3000);
    assert!(bytes.len() < 400 << 10, "{}", bytes.len());
    check("overlapping.vdb", &bytes, &|bytes| vdb::grids(bytes, &Limits::default()));
    let error = vdb::grids(&bytes, &Limits::default()).unwrap_err().to_string();
    assert!(error.contains("the value of a metadata entry"), "{error}");
    let mut stream = bytes;
    stream[20] = 0; // no offsets: each grid directly follows the one before
    check("stream.vdb", &stream, &|bytes| vdb::grids(bytes, &Limits::default()));
}

fn overlapping_grids(count: usize) -> Vec<u8> {
    const ENTRY_BYTES: usize = 4 + 4 + (4 + 1) + (4 + 6) + 4; // compression, entries, name, type, size
    const DESCRIPTOR_BYTES: usize = 3 * 4 + 3 * 8;
    let mut bytes = b" BDV\0\0\0\0".to_vec();
    bytes.extend([224_u32, 10, 0].iter().flat_map(|number| number.to_le_bytes()));
    bytes.push(1); // has offsets
    bytes.extend([b'0'; 36]);
    bytes.extend(0_u32.to_le_bytes()); // no metadata
    bytes.extend((count as u32).to_le_bytes());
    let total = bytes.len() + count * (DESCRIPTOR_BYTES + ENTRY_BYTES);
    for _ in 0..count {
        bytes.extend([0; 12]); // no name, no type, no parent
        let start = (bytes.len() + 24) as u64;
        let end = start + ENTRY_BYTES as u64;
        bytes.extend([start, start, end].iter().flat_map(|offset| offset.to_le_bytes()));
        bytes.extend([0, 1, 1].iter().flat_map(|number: &u32| number.to_le_bytes()));
        bytes.extend(b"a");
        bytes.extend(6_u32.to_le_bytes());
        bytes.extend(b"string");
        let rest = total - bytes.len() - 4;
        bytes.extend((rest as u32).to_le_bytes());
    }
    bytes
}

#[test]
fn damaged_points_of_alembic_do_not_panic() {
    let _alone = alone();
    let bytes = include_bytes!("../../tests/fuzz/corpus/abc/points.abc");
    for index in 0..3 {
        sweep(&format!("points.{index}.abc"), bytes, |bytes| {
            abc::read_points(bytes, index, &Limits::default())
        });
    }
    sweep("points.abc", bytes, |bytes| read_particles(bytes, "points.abc", &Limits::default()));
}

#[test]
fn damaged_meshes_do_not_panic() {
    let _alone = alone();
    let positions = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let normals = [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let triangles = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
    let mesh = MeshView {
        positions: &positions,
        normals: &normals,
        triangles: &triangles,
        origin: [0.0; 3],
        attributes: &[],
    };
    let limits = Limits::default();
    for format in OutputFormat::ALL.into_iter().filter(|format| format.is_mesh()) {
        let (mut bytes, name) = (Vec::new(), format!("written.{format}"));
        format.write_mesh(&mesh, &MeshOptions::default(), &[], &mut bytes).unwrap();
        sweep(&name, &bytes, |bytes| read_mesh(bytes, &name, &limits, &|_| Ok(Vec::new())));
        match format {
            OutputFormat::Abc => sweep(&name, &bytes, |bytes| to_glb(bytes, &limits)),
            OutputFormat::Usdc => sweep(&name, &bytes, |bytes| to_glb(bytes, &limits)),
            _ => {}
        }
    }
}

/// More often than other files, because a stage has many parts.
#[test]
fn damaged_stages_do_not_panic() {
    let _alone = alone();
    let limits = Limits::default();
    for (name, bytes) in fixtures::usd::all() {
        for round in 0..10 {
            sweep(&format!("{name} {round}"), &bytes, |bytes| read_particles(bytes, &name, &limits));
        }
        sweep(&name, &bytes, |bytes| read_mesh(bytes, &name, &limits, &|_| Ok(bytes.to_vec())));
    }
}

#[test]
fn damaged_obstacles_do_not_panic() {
    let _alone = alone();
    let read_external = |_: &str| Ok(vec![7; 96]);
    let read = |name: &'static str| {
        move |bytes: &[u8]| read_obstacle(bytes, name, &Limits::default(), &read_external).map(|_| ())
    };
    let text =
        b"# two objects\nmtllib a.mtl\no one\nv 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\n\
        usemtl red\nf 1/1/1 2//1 -2 -1\ng two\nv 0 0 1 1\nf -1/-1/-1 1/1 2 \\\n 3 4\nl 1 2\nf 1 2 5\n";
    sweep("two.obj", text, read("two.obj"));
    let sparse = br#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],
        "nodes":[{"mesh":0,"children":[1],"translation":[1e9,0,0]},{"mesh":0,"rotation":[0,0,1,0],"scale":[2,2,2]}],
        "meshes":[{"primitives":[{"attributes":{"POSITION":0},"mode":5,"indices":1}]}],
        "accessors":[{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","sparse":{"count":2,
        "indices":{"bufferView":1,"componentType":5121},"values":{"bufferView":2}}},
        {"bufferView":3,"componentType":5123,"count":4,"type":"SCALAR"}],
        "bufferViews":[{"buffer":0,"byteLength":48},{"buffer":1,"byteLength":2},{"buffer":0,"byteLength":24,"byteOffset":8},
        {"buffer":1,"byteLength":16,"byteOffset":4,"byteStride":4}],
        "buffers":[{"byteLength":96,"uri":"some%20where.bin"},{"byteLength":20,"uri":"data:;base64,AAIAAAAAAAABAAAAAgAAAAMAAAA="}]}"#;
    assert!(read("sparse.gltf")(sparse).is_ok());
    sweep("sparse.gltf", sparse, read("sparse.gltf"));
    for (name, bytes) in corpus(&["mesh"]) {
        sweep(&name, &bytes, |bytes| {
            read_obstacle(bytes, &name, &Limits::default(), &read_external).map(|_| ())
        });
    }
}

/// Held by a running test: memory is measured for the whole process, so only one test may run at a time.
fn alone() -> MutexGuard<'static, ()> {
    static TURN: Mutex<()> = Mutex::new(());
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The valid and invalid files of the corpus whose names contain one of the parts.
fn corpus(parts: &[&str]) -> Vec<(String, Vec<u8>)> {
    let mut files = Vec::new();
    for folder in ["valid", "invalid", "delimited/valid", "delimited/invalid"] {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(folder);
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            if !name.ends_with(".expected") && parts.iter().any(|part| name.contains(part)) {
                files.push((name, std::fs::read(&path).unwrap()));
            }
        }
    }
    assert!(!files.is_empty(), "no file of the corpus is called {parts:?}");
    files.sort();
    files
}

/// Reads many damaged variants of the file.
fn sweep<T>(name: &str, bytes: &[u8], read: impl Fn(&[u8]) -> Result<T>) {
    check(name, bytes, &read);
    for cut in 0..CUT_COUNT {
        check(name, &bytes[..bytes.len() * cut / CUT_COUNT], &read);
    }
    if bytes.is_empty() {
        return;
    }
    let mut random = Random(name.bytes().fold(1, |seed, byte| seed * 31 % 1_000_003 + u64::from(byte)));
    let flip_count = if std::env::var_os("MENISCUS_LONG").is_some() { 4 * FLIP_COUNT } else { FLIP_COUNT };
    for _ in 0..flip_count {
        let mut damaged = bytes.to_vec();
        // Every other flip is in the header, where it has the largest effect.
        let ranges = [damaged.len(), damaged.len().min(512)];
        for _ in 0..=random.below(3) {
            let range = ranges[random.below(2)];
            let at = random.below(range);
            damaged[at] ^= 1 << random.below(8);
        }
        check(name, &damaged, &read);
    }
}

/// Reads once; fails on a panic or if too much memory is used.
fn check<T>(name: &str, bytes: &[u8], read: &impl Fn(&[u8]) -> Result<T>) {
    check_within(name, bytes, bytes.len() + ALLOWED_BYTES, read);
}

fn check_within<T>(name: &str, bytes: &[u8], allowed_bytes: usize, read: &impl Fn(&[u8]) -> Result<T>) {
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    let outcome = catch_unwind(AssertUnwindSafe(|| read(bytes)));
    let held = MEMORY.peak_usage().saturating_sub(before);
    let length = bytes.len();
    assert!(outcome.is_ok(), "{name}: panicked on {length} bytes: {:?}", shown(bytes));
    assert!(held <= allowed_bytes, "{name}: held {held} for {length} bytes: {:?}", shown(bytes));
}

/// The start of a file, to identify the case.
fn shown(bytes: &[u8]) -> String {
    bytes[..bytes.len().min(600)].escape_ascii().to_string()
}

fn gzipped(bytes: &[u8]) -> Vec<u8> {
    use std::io::Write;
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

fn zstd_packed(bytes: &[u8]) -> Vec<u8> {
    ruzstd::encoding::compress_to_vec(bytes, ruzstd::encoding::CompressionLevel::Fastest)
}

/// A small generator that gives the same numbers on every machine.
/// Steele, Lea, Flood. Fast splittable pseudorandom number generators. 2014
struct Random(u64);

impl Random {
    fn below(&mut self, bound: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^= mixed >> 31;
        (mixed % bound as u64) as usize
    }
}
