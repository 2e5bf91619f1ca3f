//! Small .vdb files whose nodes are full of tiles: the memory must stay within `--memory`.

use crate::hostile::scene::{Scene, print_line};
use crate::program::vdb_file::{grid_head, vdb_file};

const VOXEL_SIZE: f64 = 0.1;
const BACKGROUND: f32 = 0.3;

/// Voxels along an edge of an upper node.
const NODE_EDGE: i32 = 4096;

/// Allowance for the memory of the program itself, and for memory that the allocator keeps.
const BASE_BYTES: u64 = 40 << 20;

/// A level set with `node_count` upper nodes along z, each of 32³ tiles of 128³ voxels; `value` returns the
/// value of the tile with these coordinates (0 to 31). A node whose tiles all have the same value takes 8 kB.
/// tile with these coordinates (0 to 31). A node whose tiles all have the same value takes 8 kB.
fn tiles(node_count: i32, value: impl Fn([usize; 3]) -> f32) -> Vec<u8> {
    let values: Vec<f32> = (0..32_768).map(|slot| value([slot / 1024, slot / 32 % 32, slot % 32])).collect();
    // Compression 2: only active values are stored.
    let mut grid = grid_head(2, VOXEL_SIZE, BACKGROUND, node_count as u32);
    for node in 0..node_count {
        [0, 0, node * NODE_EDGE].iter().for_each(|at| grid.extend(at.to_le_bytes()));
        grid.extend([0; 2 * 4096]); // no children, no active tiles
        if values.iter().all(|&value| value == values[0]) {
            grid.push(2);
            grid.extend(values[0].to_le_bytes());
        } else {
            grid.push(6);
            values.iter().for_each(|value| grid.extend(value.to_le_bytes()));
        }
    }
    vdb_file(&grid, &[])
}

/// Converts a level set, or particles around it, with this memory limit.
fn convert(scene: &Scene, is_obstacle: bool, memory: &str) -> crate::hostile::scene::RunResult {
    let common = ["convert", "--out", "out", "--format", "obj", "--memory", memory];
    let inputs: &[&str] = if is_obstacle {
        &["in/dam.1.ply", "--voxel-size", "0.1", "--obstacle", "grid.vdb"]
    } else {
        &["grid.vdb"]
    };
    scene.run(&[&common[..], inputs].concat())
}

/// The MiB of memory that are necessary according to an error message.
fn needed_mebibytes(err: &str) -> u64 {
    let needed = err.split("use --memory ").nth(1).and_then(|rest| rest.split("MiB").next());
    needed.and_then(|needed| needed.parse().ok()).unwrap_or_else(|| panic!("{err}"))
}

#[test]
fn small_file_with_millions_of_tiles_stays_within_memory() {
    let scene = Scene::new();
    // No tile is inside, so nothing has to be rebuilt.
    let bytes = tiles(60, |_| 0.5 * BACKGROUND);
    assert!(bytes.len() < 1 << 20, "{}", bytes.len());
    scene.write("grid.vdb", bytes);
    for is_obstacle in [false, true] {
        let result = convert(&scene, is_obstacle, "64MiB");
        assert_ne!(result.status, Some(0), "{}", result.err);
        assert!(result.err.contains("grid.vdb") && result.err.contains("tiles"), "{}", result.err);
        print_line(&format!("refused with {} MiB", result.peak_bytes >> 20));
        assert!(result.peak_bytes <= BASE_BYTES + (64 << 20), "{}", result.peak_bytes);
        let needed = needed_mebibytes(&result.err);
        let result = convert(&scene, is_obstacle, &format!("{}MiB", needed));
        assert_eq!(result.status, Some(0), "{}", result.err);
        print_line(&format!("{needed} MiB allowed: {} MiB", result.peak_bytes >> 20));
        assert!(result.peak_bytes <= BASE_BYTES + (needed << 20), "{} of {needed} MiB", result.peak_bytes);
    }
}

#[test]
fn rebuilt_obstacle_stays_within_memory() {
    let scene = Scene::new();
    // The surface of a cube of 128³ voxels passes between tiles: rebuilding it takes about 6,000 leaves,
    // which are 50 MiB.
    let is_inside = |tile: [usize; 3]| tile == [4; 3];
    scene.write("grid.vdb", tiles(1, |tile| if is_inside(tile) { -BACKGROUND } else { BACKGROUND }));
    let result = convert(&scene, true, "32MiB");
    assert_ne!(result.status, Some(0), "{}", result.err);
    assert!(result.err.contains("grid.vdb") && result.err.contains("--memory"), "{}", result.err);
    print_line(&format!("refused with {} MiB", result.peak_bytes >> 20));
    assert!(result.peak_bytes <= BASE_BYTES + (32 << 20), "{}", result.peak_bytes);
    let result = convert(&scene, true, "128MiB");
    assert_eq!(result.status, Some(0), "{}", result.err);
    print_line(&format!("128 MiB allowed: {} MiB", result.peak_bytes >> 20));
    assert!(result.peak_bytes <= BASE_BYTES + (128 << 20), "{}", result.peak_bytes);
}
