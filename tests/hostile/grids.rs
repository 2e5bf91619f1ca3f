//! Small .vdb files whose nodes are full of tiles: memory stays within `--memory`.

use crate::scene::{Scene, tell};

const VOXEL_SIZE: f64 = 0.1;
const BACKGROUND: f32 = 0.3;

/// Voxels along an edge of an upper node.
const NODE_EDGE: i32 = 4096;

/// The program itself, and what the allocator keeps.
const BESIDE_BYTES: u64 = 40 << 20;

fn push_string(text: &str, out: &mut Vec<u8>) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

/// A level set with `node_count` upper nodes in a row along z, each of 32³ tiles of 128³ voxels; `value` gives the value of the
/// tile with these coordinates (0 to 31). A node whose tiles all have the same value takes 8 kB.
fn tiles(node_count: i32, value: impl Fn([usize; 3]) -> f32) -> Vec<u8> {
    let values: Vec<f32> = (0..32_768).map(|slot| value([slot / 1024, slot / 32 % 32, slot % 32])).collect();
    let mut grid = 2u32.to_le_bytes().to_vec(); // only active values are stored
    grid.extend(1u32.to_le_bytes());
    for text in ["class", "string", "level set", "UniformScaleMap"] {
        push_string(text, &mut grid);
    }
    let (inverse, square) = (1.0 / VOXEL_SIZE, 1.0 / VOXEL_SIZE / VOXEL_SIZE);
    for number in [VOXEL_SIZE, VOXEL_SIZE, inverse, square, 0.5 * inverse] {
        (0..3).for_each(|_| grid.extend(number.to_le_bytes()));
    }
    grid.extend(1u32.to_le_bytes()); // buffers for each leaf
    grid.extend(BACKGROUND.to_le_bytes());
    grid.extend(0u32.to_le_bytes()); // tiles of the root
    grid.extend(node_count.to_le_bytes());
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
    let mut file = vec![0x20, 0x42, 0x44, 0x56, 0, 0, 0, 0];
    for number in [224u32, 10, 0] {
        file.extend(number.to_le_bytes());
    }
    file.push(1); // offsets follow
    file.extend([b'0'; 36]); // in place of a UUID
    file.extend(0u32.to_le_bytes()); // metadata
    file.extend(1u32.to_le_bytes()); // grids
    for text in ["surface", "Tree_float_5_4_3", ""] {
        push_string(text, &mut file);
    }
    let (start, end) = (file.len() + 24, file.len() + 24 + grid.len());
    for offset in [start, end, end] {
        file.extend((offset as u64).to_le_bytes());
    }
    [file, grid].concat()
}

/// Converts a level set, or particles around it, with so much memory.
fn convert(scene: &Scene, is_obstacle: bool, memory: &str) -> crate::scene::Ran {
    let common = ["convert", "--out", "out", "--format", "obj", "--memory", memory];
    let inputs: &[&str] = match is_obstacle {
        true => &["in/dam.1.ply", "--voxel-size", "0.1", "--obstacle", "grid.vdb"],
        false => &["grid.vdb"],
    };
    scene.run(&[&common[..], inputs].concat())
}

/// The MiB that an error asks for.
fn asked_mebibytes(err: &str) -> u64 {
    let asked = err.split("use --memory ").nth(1).and_then(|rest| rest.split("MiB").next());
    asked.and_then(|asked| asked.parse().ok()).unwrap_or_else(|| panic!("{err}"))
}

#[test]
fn small_file_with_millions_of_tiles_stays_within_memory() {
    let scene = Scene::new();
    // No tile is inside, so nothing has to be rebuilt.
    let bytes = tiles(60, |_| 0.5 * BACKGROUND);
    assert!(bytes.len() < 1 << 20, "{}", bytes.len());
    scene.write("grid.vdb", bytes);
    for is_obstacle in [false, true] {
        let ran = convert(&scene, is_obstacle, "64MiB");
        assert_ne!(ran.status, Some(0), "{}", ran.err);
        assert!(ran.err.contains("grid.vdb") && ran.err.contains("tiles"), "{}", ran.err);
        tell(&format!("refused with {} MiB", ran.peak_bytes >> 20));
        assert!(ran.peak_bytes <= BESIDE_BYTES + (64 << 20), "{}", ran.peak_bytes);
        let asked = asked_mebibytes(&ran.err);
        let ran = convert(&scene, is_obstacle, &format!("{}MiB", asked));
        assert_eq!(ran.status, Some(0), "{}", ran.err);
        tell(&format!("{asked} MiB allowed: {} MiB", ran.peak_bytes >> 20));
        assert!(ran.peak_bytes <= BESIDE_BYTES + (asked << 20), "{} of {asked} MiB", ran.peak_bytes);
    }
}

#[test]
fn rebuilt_obstacle_stays_within_memory() {
    let scene = Scene::new();
    // The surface of a cube of 128³ voxels passes between tiles: rebuilding it takes about 6,000 leaves, which are 50 MiB.
    let is_inside = |tile: [usize; 3]| tile == [4; 3];
    scene.write("grid.vdb", tiles(1, |tile| if is_inside(tile) { -BACKGROUND } else { BACKGROUND }));
    let ran = convert(&scene, true, "32MiB");
    assert_ne!(ran.status, Some(0), "{}", ran.err);
    assert!(ran.err.contains("grid.vdb") && ran.err.contains("--memory"), "{}", ran.err);
    tell(&format!("refused with {} MiB", ran.peak_bytes >> 20));
    assert!(ran.peak_bytes <= BESIDE_BYTES + (32 << 20), "{}", ran.peak_bytes);
    let ran = convert(&scene, true, "128MiB");
    assert_eq!(ran.status, Some(0), "{}", ran.err);
    tell(&format!("128 MiB allowed: {} MiB", ran.peak_bytes >> 20));
    assert!(ran.peak_bytes <= BESIDE_BYTES + (128 << 20), "{}", ran.peak_bytes);
}
