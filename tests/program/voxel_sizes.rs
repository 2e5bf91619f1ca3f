//! Voxel sizes and radii that do not fit the particles: impossible values are errors, doubtful values cause
//! warnings, and sensible values cause neither.

use std::f64::consts::TAU;
use std::fs;
use std::path::Path;

use meniscus::surface::obstacle::Obstacles;
use meniscus::surface::options::{MethodOptions, Settings};
use meniscus::surface::particles::OwnedPositions;
use meniscus::surface::reconstruction::{
    MemoryPlan, MemoryPlanError, PlanInputs, PrecisionLimit, plan_memory, reconstruct_frame,
};
use tempfile::tempdir;

use crate::program::scene::{RunResult, block, meniscus, names_in, write_ply};

/// The plan for these particles, whose spacing is 0.1, with a voxel size in spacings. If the voxel size gives
/// a smaller r_min than 0.87 spacings, r_min is 0.87 spacings.
fn planned(particles: &[[f64; 3]], spacings: f64) -> Result<MemoryPlan, MemoryPlanError> {
    let voxel_size = 0.1 * spacings;
    let radius_min = (0.02..0.5).contains(&spacings).then_some(0.087);
    let radius_ratio = (spacings < 0.1).then_some(1.25);
    let choices =
        MethodOptions { radius_min: radius_min.map(Into::into), radius_ratio, ..MethodOptions::default() };
    let settings = Settings::paper(voxel_size, &choices).expect("settings");
    let around = PlanInputs { obstacles: &Obstacles::default(), attribute_bytes: 0.0, allows_tiles: true };
    let Ok(planned) = plan_memory(&OwnedPositions::F64(particles.to_vec()), &settings, around, u64::MAX);
    planned
}

fn is_too_fine(particles: &[[f64; 3]], spacings: f64) -> bool {
    matches!(planned(particles, spacings), Err(MemoryPlanError::VoxelTooSmall(_)))
}

#[test]
fn voxels_below_the_precision_of_positions_are_refused() {
    let cloud = block(12, 0.0);
    for spacings in [1.0, 0.5, 0.125, 1.0 / 16.0, 1.0 / 50.0, 1e-3, 1e-5] {
        assert!(!is_too_fine(&cloud, spacings), "{spacings}");
    }
    for spacings in [1e-6, 1e-8, 1e-10, 1e-12, 1e-30] {
        let Err(MemoryPlanError::VoxelTooSmall(too_small)) = planned(&cloud, spacings) else {
            panic!("{spacings}")
        };
        assert!((too_small.spacing / 0.1 - 1.0).abs() < 0.2, "{too_small}");
        let named = [too_small.least, 0.999 * too_small.least].map(|size| is_too_fine(&cloud, 10.0 * size));
        assert_eq!(named, [false, true], "{too_small}");
    }
}

#[test]
fn error_for_a_frame_beyond_the_grid_has_its_distance() {
    let Err(MemoryPlanError::VoxelTooSmall(too_small)) = planned(&block(6, 1e9), 0.5) else {
        panic!("it is in the grid")
    };
    let message = too_small.to_string();
    assert_eq!(too_small.limit, PrecisionLimit::Reach);
    assert!(message.contains("so far from the origin") && !message.contains("usual"), "{message}");
}

/// Larger voxels would not help: the positions are lost.
#[test]
fn error_for_positions_rounded_far_from_the_origin_has_the_step() {
    let in_32_bits = |[x, y, z]: [f64; 3]| [x + 1e9, y, z].map(|along| f64::from(along as f32));
    let rounded: Vec<[f64; 3]> = block(6, 0.0).into_iter().map(in_32_bits).collect();
    let Err(MemoryPlanError::VoxelTooSmall(too_small)) = planned(&rounded, 0.5) else {
        panic!("it is in the grid")
    };
    let message = too_small.to_string();
    assert_eq!(too_small.limit, PrecisionLimit::Rounding(64.0));
    assert!(message.contains("rounded to steps of 64,") && !message.contains("--voxel-size"), "{message}");
}

#[test]
fn escaped_particles_do_not_make_voxels_too_small() {
    let cloud = block(6, 0.0);
    let with = |others: &[[f64; 3]]| [&cloud[..], others].concat();
    let outliers = [1e7, -1e12, f64::NAN].map(|x| [x, 1.0, -x]);
    // Add as many particles again, scattered everywhere or in a second cloud.
    let sprayed: Vec<[f64; 3]> =
        (0..200).map(|index| [1e6, 3e5, -7e5].map(|step| step * f64::from(index))).collect();
    for others in [&outliers[..], &vec![[f64::NAN; 3]; 1000], &block(5, 1e7), &sprayed] {
        assert!(!is_too_fine(&with(others), 0.5), "{:?}", others[0]);
        assert!(is_too_fine(&with(others), 1e-8), "{:?}", others[0]);
    }
    // A single particle has no spacing.
    assert!(!is_too_fine(&sprayed[..1], 0.5));
    assert!(is_too_fine(&sprayed[..40], 0.5));
    // The result does not depend on the position, as long as the grid has indices there.
    assert!(!is_too_fine(&block(6, 1e7), 0.5));
    assert!(is_too_fine(&block(6, 1e9), 0.5));
}

#[test]
fn every_command_refuses_voxels_that_are_too_small() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    fs::create_dir(path.join("in")).expect("made");
    write_ply(&path.join("in/a.ply"), &block(6, 0.0));
    for command in [
        &["convert", "in/a.ply", "--out", "out"][..],
        &["render", "in/a.ply", "-o", "a.png"],
        &["tune", "in/a.ply", "-o", "tune.png", "--vary", "offset=0,0.1d"],
        &["watch", "in", "--out", "seen", "--once", "--settle", "0s"],
    ] {
        let result = meniscus(path, &[command, &["--voxel-size", "1e-9"]].concat());
        assert_ne!(result.status, 0, "{command:?}: {}{}", result.out, result.err);
        for words in ["the blend is 0.", "to 6.4e-8, ", " to 64 voxels: choose another voxel size"] {
            assert!(result.err.contains(words), "{command:?}: {}{}", result.out, result.err);
        }
        let result = meniscus(path, &[command, &["--preset", "paper", "--voxel-size", "1e-9"]].concat());
        assert_ne!(result.status, 0, "{command:?}: {}{}", result.out, result.err);
        for word in [
            "a.ply",
            "the voxel size 1e-9 (--voxel-size) is too small",
            "particles are 0.1",
            "the minimum is",
        ] {
            assert!(
                result.err.contains(word),
                "{command:?} does not say {word}: {}{}",
                result.out,
                result.err
            );
        }
    }
    assert_eq!(names_in(path), ["in", "out", "seen"]);
    assert_eq!(names_in(&path.join("out")), [""; 0]);
}

/// The output of the command for these particles.
fn warnings_of(folder: &Path, particles: &[[f64; 3]], options: &[&str]) -> String {
    write_ply(&folder.join("a.ply"), particles);
    let RunResult { status, err, .. } =
        meniscus(folder, &[&["convert", "a.ply", "--out", "out", "--format", "glb"], options].concat());
    assert_eq!(status, 0, "{err}");
    err
}

#[test]
fn empty_surface_causes_a_warning_with_a_remedy() {
    let folder = tempdir().expect("a folder");
    let small = ["--preset", "paper", "--voxel-size", "0.05", "--radius-min", "0.001"];
    let options = [&small[..], &["--allow-violations"]].concat();
    let warnings = warnings_of(folder.path(), &block(6, 0.013), &options);
    for word in ["all particles fall between the voxels", "are 0.02 and 0.04 voxels", "--radius-min 0.0866"] {
        assert!(warnings.contains(word), "it does not say {word}: {warnings}");
    }
    let inward = ["--spacing", "0.1", "--offset", "-0.6d", "--allow-violations"];
    let of_offset = warnings_of(folder.path(), &[[0.5; 3]], &inward);
    for word in ["the offset -0.06 removed the whole surface", "--blend", "1 of 1 particle is outside"] {
        assert!(of_offset.contains(word), "it does not say {word}: {of_offset}");
    }
    write_ply(&folder.path().join("a.ply"), &block(6, 0.013));
    let command = ["convert", "a.ply", "--out", "out"];
    let result = meniscus(folder.path(), &[&command[..], &small].concat());
    assert_eq!(result.status, 1, "{}", result.err);
    assert!(
        result.err.ends_with(
            "error: 1 of 1 frame failed validation; outputs were kept; --allow-violations accepts them\n"
        ),
        "{}",
        result.err
    );
    let (_, named) = warnings.split_once("use --radius-min ").expect("a radius");
    let radius: String = named.chars().take_while(|&c| c == '.' || c.is_ascii_digit()).collect();
    assert_eq!(
        warnings_of(
            folder.path(),
            &block(6, 0.013),
            &["--preset", "paper", "--voxel-size", "0.05", "--radius-min", &radius]
        ),
        ""
    );
}

/// A position on a circle around the origin that is divided into this many.
fn on_circle(index: usize, count: usize, radius: f64) -> [f64; 3] {
    let angle = TAU * index as f64 / count as f64;
    [radius * angle.cos(), radius * angle.sin(), 0.0]
}

/// A block whose particles are moved by up to 0.03, a third of their spacing.
fn shaken_block() -> Vec<[f64; 3]> {
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f64 / (1u64 << 24) as f64 - 0.5
    };
    block(9, 0.0).into_iter().map(|position| position.map(|x| x + 0.06 * random())).collect()
}

#[test]
fn only_a_torn_surface_causes_a_warning() {
    let folder = tempdir().expect("a folder");
    let has_warning = |particles: &[[f64; 3]], options: &[&str]| {
        let warnings = warnings_of(folder.path(), particles, options);
        let is_planar = |line: &&str| line.contains("all particles have z = 0");
        let warnings: String = warnings.lines().filter(|line| !is_planar(line)).collect();
        assert_eq!(
            warnings.contains("too small for the particle spacing"),
            warnings.contains("warning"),
            "{warnings}"
        );
        warnings.contains("too small for the particle spacing")
    };
    let shaken = shaken_block();
    let mut spray = shaken.clone();
    spray.extend((0..150).map(|i| [1.0 + 0.7 * f64::from(i), f64::from(i % 7), f64::from(i % 5)]));
    // A ring has a hole and a bubble has a hollow, which are parts of their shapes.
    let ring: Vec<[f64; 3]> = (0..48).map(|i| on_circle(i, 48, 0.76)).collect();
    let bubble: Vec<[f64; 3]> = (0..6)
        .flat_map(|row| {
            let [height, radius, _] = on_circle(row, 10, 0.2);
            (0..8).map(move |i| {
                let [x, y, _] = on_circle(i, 8, radius + 1e-3);
                [x, y, height]
            })
        })
        .collect();
    let settings = Settings::paper(0.04, &MethodOptions::default()).expect("settings");
    assert_eq!(
        reconstruct_frame(&OwnedPositions::F64(bubble.clone()), &settings).mesh.measure().component_count,
        2
    );
    for (particles, options, expected) in [
        (&ring, &["--voxel-size", "0.05"][..], false),
        (&bubble, &["--voxel-size", "0.04"], false),
        (&shaken, &["--voxel-size", "0.015"], true),
        (&shaken, &["--voxel-size", "0.02"], true),
        (&shaken, &["--voxel-size", "0.05", "--radius-min", "0.09"], false),
        (&shaken, &["--voxel-size", "0.02", "--radius-min", "0.087"], false),
        (&shaken, &["--voxel-size", "0.03"], false),
        (&shaken, &[], false),
        (&shaken, &["--preset", "granular"], false),
        (&spray, &["--voxel-size", "0.05"], false),
        (&spray, &["--voxel-size", "0.02"], true),
    ] {
        let paper: &[&str] = if options.contains(&"--preset") { &[] } else { &["--preset", "paper"] };
        let options = [paper, options].concat();
        assert_eq!(has_warning(particles, &options), expected, "{} {options:?}", particles.len());
    }
}

#[test]
fn only_small_voxels_tear_the_examples() {
    let folder = tempdir().expect("a folder");
    let frames = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/frames");
    for (name, size, expected) in [
        ("dam.0001.bgeo", "0.01", "holes: unless the fluid really has them"),
        ("dam.0001.bgeo", "0.0125", "holes: unless the fluid really has them"),
        ("dam.0008.bgeo", "0.01", "holes: unless the fluid really has them"),
        ("dam.0001.bgeo", "0.015", ""),
        ("dam.0008.bgeo", "0.015", ""),
        ("dam.0008.bgeo", "0.025", ""),
    ] {
        let frame = frames.join(name);
        let frame = frame.to_str().expect("text");
        let paper = ["--preset", "paper", "--voxel-size", size];
        let result = meniscus(folder.path(), &[&["convert", frame, "--out", "out"], &paper[..]].concat());
        assert!(
            result.err.contains(expected) && result.err.is_empty() == expected.is_empty(),
            "{name} {size}: {}",
            result.err
        );
    }
}

#[test]
fn ratio_that_suits_no_voxel_size_is_refused_with_its_limit() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    write_ply(&path.join("a.ply"), &block(6, 0.0));
    let result =
        meniscus(path, &["convert", "a.ply", "--out", "out", "--preset", "paper", "--radius-ratio", "1000"]);
    let words = "r_max is 1732.05 voxels; it must be at most 64: choose a smaller ratio";
    assert!(result.status != 0 && result.err.contains(words), "{}{}", result.out, result.err);
    assert!(!result.err.contains("voxel size of at least"), "{}", result.err);
}
