//! Files of other programs, which are too many and too large for this repository. If they are found next to
//! the repository, every file with points must be read, or rejected for the reason in a list here.

use std::io::Write;
use std::path::{Path, PathBuf};

use meniscus_formats::{FilePositions, Limits, ParticleFrame, looks_like_particles, read_particles};

/// The folder of the files; prints a message if it is missing.
fn data() -> Option<PathBuf> {
    let default_folder = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared");
    let data = std::env::var_os("MENISCUS_SHARED").map_or_else(default_folder, PathBuf::from).join("data");
    if !data.is_dir() {
        let _ = writeln!(std::io::stderr(), "not tested, absent: {}", data.display());
        return None;
    }
    Some(data)
}

fn files_below(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files_below(&path, files);
        } else {
            files.push(path);
        }
    }
}

fn read(path: &Path) -> Result<ParticleFrame, String> {
    let bytes = std::fs::read(path).unwrap();
    let name = path.file_name().unwrap().to_string_lossy();
    read_particles(&bytes, &name, &Limits::default()).map_err(|error| error.to_string())
}

/// The minimum and maximum coordinate along each axis.
fn bounds(frame: &ParticleFrame) -> [[f64; 3]; 2] {
    let positions: Vec<[f64; 3]> = match &frame.positions {
        FilePositions::F32(positions) => positions.iter().map(|position| position.map(f64::from)).collect(),
        FilePositions::F64(positions) => positions.clone(),
    };
    let along = |start, pick: fn(f64, f64) -> f64| {
        let all = |axis: usize| positions.iter().map(|position| position[axis]).fold(start, pick);
        [all(0), all(1), all(2)]
    };
    [along(f64::INFINITY, f64::min), along(f64::NEG_INFINITY, f64::max)]
}

#[test]
fn point_files_are_read_or_rejected_with_the_listed_reason() {
    let Some(data) = data() else { return };
    let mut files = Vec::new();
    for folder in ["ours", "third-party"] {
        files_below(&data.join(folder), &mut files);
    }
    let mut faults = Vec::new();
    let (mut read_count, mut refused_count) = (0, 0);
    for path in &files {
        let bytes = std::fs::read(path).unwrap();
        if !looks_like_particles(&bytes, &path.file_name().unwrap().to_string_lossy()) {
            continue;
        }
        let shown = path.strip_prefix(&data).unwrap().to_string_lossy().replace('\\', "/");
        let refusal = REFUSED.iter().find(|(part, _)| shown.contains(part)).map(|(_, words)| words);
        match (read(path), refusal) {
            (Ok(_), None) => read_count += 1,
            (Err(error), Some(words)) if error.contains(words) => refused_count += 1,
            (Ok(_), Some(words)) => faults.push(format!("{shown} was read, not rejected for `{words}`")),
            (Err(error), _) => faults.push(format!("{shown}: {error}")),
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(
        read_count >= 100 && refused_count == REFUSED_COUNT,
        "{read_count} read, {refused_count} rejected"
    );
}

#[test]
fn counts_and_bounds_match_other_programs() {
    let Some(data) = data() else { return };
    for &(path, count, lowest, highest) in BOUNDS {
        let frame = read(&data.join(path)).unwrap_or_else(|error| panic!("{path}: {error}"));
        assert_eq!(frame.positions.len(), count, "{path}");
        let [low, high] = bounds(&frame);
        for axis in 0..3 {
            let is_near =
                |found: f64, expected: f64| (found - expected).abs() < 2e-6 * (1.0 + expected.abs());
            assert!(
                is_near(low[axis], lowest[axis]) && is_near(high[axis], highest[axis]),
                "{path}: {low:?} {high:?}"
            );
        }
    }
}

/// Files that must be rejected: parts of their paths, and words of the expected error.
const REFUSED: &[(&str, &str)] = &[
    ("laika/packed_points_simple_16_5", "packed primitives (PackedGeometry): its 2 points are their pivots"),
    ("laika/psoup_simple_16", "surfaces or curves (PolySoup): its 8 points belong to them"),
    ("sidefxlabs/curve_sweep", "surfaces or curves (Poly): its 453 points belong to them"),
    ("sidefxlabs/delete_small_parts", "surfaces or curves (Poly): its 464 points belong to them"),
];

/// Number of files that match the list above.
const REFUSED_COUNT: usize = 4;

/// Part of a path, number of points, minimum and maximum corner. VTK's own readers, and the text forms of
/// Houdini's files, give these values.
type Bounds = (&'static str, usize, [f64; 3], [f64; 3]);
const BOUNDS: &[Bounds] = &[
    ("third-party/partio/test.bgeo", 5, [0.0, 0.1, 0.2], [0.4, 0.5, 0.6]),
    ("third-party/sidefxlabs/attribute_value_replace.bgeo.sc", 10, [0.0; 3], [0.0; 3]),
    ("third-party/splashsurf/cube_2366_particles.vtk", 2366, [0.85, 0.04999, 0.85], [1.45, 0.69999, 1.45]),
    (
        "third-party/splashsurf/double_dam_break_frame_26_4732_particles.vtk",
        4732,
        [-1.515269, -0.015251, -1.51509],
        [1.515213, 1.016847, 1.515228],
    ),
    (
        "third-party/splashsurf/fluid_250_particles.vtu",
        250,
        [0.113318, 0.147773, 0.109714],
        [5.070789, 1.139398, 1.090189],
    ),
    ("ours/vtk/meshio.vtk", 64, [0.005825, 0.007092, 0.016723], [0.999026, 0.988219, 0.980737]),
    ("ours/vtk/meshio_ascii.vtu", 64, [0.005825, 0.007092, 0.016723], [0.999026, 0.988219, 0.980737]),
    ("ours/vtk/meshio_v42.vtk", 64, [0.005825, 0.007092, 0.016723], [0.999026, 0.988219, 0.980737]),
    ("ours/vtk/pyvista.vtk", 64, [0.005825, 0.007092, 0.016723], [0.999026, 0.988219, 0.980737]),
    ("ours/vtk/vtk_poly_ascii.vtp", 64, [0.005825, 0.007092, 0.016723], [0.999026, 0.988219, 0.980737]),
    ("ours/vtk/vtk_poly_default.vtp", 64, [0.005825, 0.007092, 0.016723], [0.999026, 0.988219, 0.980737]),
    (
        "ours/vtk/vtk_poly_legacy42_bin.vtk",
        64,
        [0.005825, 0.007092, 0.016723],
        [0.999026, 0.988219, 0.980737],
    ),
    (
        "ours/vtk/vtk_poly_legacy51_ascii.vtk",
        64,
        [0.005825, 0.007092, 0.016723],
        [0.999026, 0.988219, 0.980737],
    ),
    ("ours/vtk/vtk_poly_raw_lz4.vtp", 64, [0.005825, 0.007092, 0.016723], [0.999026, 0.988219, 0.980737]),
    (
        "ours/vtk/vtk_poly_raw_nocomp_u64.vtp",
        64,
        [0.005825, 0.007092, 0.016723],
        [0.999026, 0.988219, 0.980737],
    ),
    ("ours/vtk/vtk_ug_default.vtu", 64, [0.005825, 0.007092, 0.016723], [0.999026, 0.988219, 0.980737]),
    ("ours/vtk/vtk_ug_legacy51_bin.vtk", 64, [0.005825, 0.007092, 0.016723], [0.999026, 0.988219, 0.980737]),
    (
        "third-party/laika/points_noprim.bgeo",
        10,
        [-1.070957, -0.549227, -0.611521],
        [0.342897, 0.245003, 0.34955],
    ),
    (
        "third-party/laika/points_noprim_16_5.bgeo",
        10,
        [-1.070957, -0.549227, -0.611521],
        [0.342897, 0.245003, 0.34955],
    ),
    (
        "third-party/laika/points_partsys_16.bgeo",
        10,
        [-1.070957, -0.549227, -0.611521],
        [0.342897, 0.245003, 0.34955],
    ),
    (
        "third-party/laika/simple_partanim.0017.bgeo",
        10,
        [-12.047755, -1.023486, -8.970262],
        [18.668245, 11.764528, 14.964128],
    ),
    (
        "third-party/laika/simple_partanim_16.0017.bgeo",
        10,
        [-12.047755, -1.023486, -8.970262],
        [18.668245, 11.764528, 14.964128],
    ),
    (
        "third-party/laika/simple_partanim_16_5.bgeo",
        10,
        [-12.047755, -1.023486, -8.970262],
        [18.668245, 11.764528, 14.964128],
    ),
];
