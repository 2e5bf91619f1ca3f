//! Valid files with very many elements: the memory must be in proportion to the size of the file.

use std::fmt::Write as _;

use meniscus_formats::LevelSetView;
use meniscus_formats::vdb::{WriteOptions, write};

use crate::hostile::scene::{Scene, print_line};

/// Number of steps: enough to measure the memory per step.
const STEPS: usize = 20_000;

/// Limit of the memory: for the program, the file, and the data per step.
const INFO_BYTES_MAX: u64 = 32 << 20;

fn steps(count: usize) -> String {
    let mut text = String::new();
    for step in 0..count {
        writeln!(text, "ITEM: TIMESTEP\n{step}\nITEM: NUMBER OF ATOMS\n0\nITEM: ATOMS id x y z")
            .expect("room");
    }
    text
}

#[test]
fn info_of_many_steps_takes_little_memory() {
    let scene = Scene::new();
    scene.write("many.lammpstrj", steps(STEPS));
    for arguments in [&["info", "many.lammpstrj"][..], &["info", "--json", "many.lammpstrj"]] {
        let result = scene.run(arguments);
        assert_eq!(result.status, Some(0), "{}", result.err);
        assert_eq!(result.out.matches("many.lammpstrj/step=").count(), STEPS);
        print_line(&format!("{} steps: {} MiB", STEPS, result.peak_bytes >> 20));
        assert!(result.peak_bytes <= INFO_BYTES_MAX, "{} of {INFO_BYTES_MAX} bytes", result.peak_bytes);
    }
}

/// With four times as many steps, the program may read four times as many bytes. If it read the file from the
/// start for each step, it would read 16 times as many.
#[test]
fn reading_many_steps_is_linear_in_the_file_size() {
    let scene = Scene::new();
    let convert = ["convert", "many.lammpstrj", "--out", "out", "--voxel-size", "0.1", "--format", "obj"];
    for (arguments, few) in [(&["info", "many.lammpstrj"][..], 5_000), (&convert, 300)] {
        let [of_few, of_many] = [few, 4 * few].map(|count| {
            scene.write("many.lammpstrj", steps(count));
            let result = scene.run(arguments);
            assert_eq!(result.status, Some(0), "{}", result.err);
            print_line(&format!("{} of {count} steps: {} kB read", arguments[0], result.read_bytes >> 10));
            result.read_bytes
        });
        assert!(of_few > 0 && of_many <= 6 * of_few, "{arguments:?}: {of_few}, then {of_many} bytes");
    }
}

/// A level set with `edge_count`³ leaves that are not neighbours; each has one voxel inside.
fn scattered(edge_count: i32) -> Vec<u8> {
    let mut origins = Vec::new();
    for x in 0..edge_count {
        for y in 0..edge_count {
            origins.extend((0..edge_count).map(|z| [x, y, z].map(|at| 32 * at)));
        }
    }
    let leaf: [f32; 512] = std::array::from_fn(|offset| if offset == 292 { -0.5 } else { 0.5 });
    let leaves = vec![leaf; origins.len()];
    let view = LevelSetView {
        origins: &origins,
        leaves: &leaves,
        half_width_voxels: 3.0,
        voxel_size: 0.1,
        grids: &[],
    };
    let mut bytes = Vec::new();
    write(&view, &WriteOptions::default(), &[], &mut bytes).expect("written");
    bytes
}

/// Allowance for the memory of the program itself, and for memory that the allocator keeps.
const BASE_BYTES: u64 = 40 << 20;

#[test]
fn scattered_voxels_stay_within_the_memory_that_is_allowed() {
    let scene = Scene::new();
    scene.write("scattered.vdb", scattered(6));
    let convert = |memory: &str| {
        let smoothing = ["--max-deviation", "1", "--steps", "1", "--laplacian-steps", "1"];
        let arguments = ["convert", "scattered.vdb", "--out", "out", "--format", "obj", "--memory", memory];
        scene.run(&[&arguments[..], &smoothing].concat())
    };
    let result = convert("32MiB");
    assert_eq!(result.status, Some(2), "{}", result.err);
    assert!(result.peak_bytes <= (32 << 20) + BASE_BYTES, "{}", result.peak_bytes);
    let needed = result.err.split("use --memory ").nth(1).and_then(|rest| rest.split("MiB").next());
    let needed: u64 =
        needed.and_then(|needed| needed.parse().ok()).unwrap_or_else(|| panic!("{}", result.err));
    let result = convert(&format!("{needed}MiB"));
    assert_eq!(result.status, Some(0), "{}", result.err);
    print_line(&format!("{needed} MiB allowed: {} MiB", result.peak_bytes >> 20));
    assert!(result.peak_bytes <= (needed << 20) + BASE_BYTES, "{} of {needed} MiB", result.peak_bytes);
}
