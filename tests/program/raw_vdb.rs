//! A plain writer of OpenVDB files with one float grid. The values need not be a valid narrow band.
//!
//! All leaves and tiles are in a single lower node: a cube of 128 voxels that starts at the origin. Values
//! are not compressed.

use crate::program::vdb_file::{grid_head, vdb_file};

/// The content of a cell of 8³ voxels in the cube.
pub(crate) enum Cell {
    /// A tile with one value, inactive.
    Tile(f32),
    /// A leaf: values with z fastest, all of them inactive.
    Leaf(Box<[f32; 512]>),
}

/// Cells along an edge of the cube.
const EDGE: i32 = 16;

/// The bytes of a level set with this background; `cell` returns the content of the cell with these
/// coordinates, 0 to 15.
pub(crate) fn raw_level_set(voxel_size: f64, background: f32, cell: impl Fn([i32; 3]) -> Cell) -> Vec<u8> {
    let (head, buffers) = grid(voxel_size, background, cell);
    vdb_file(&head, &buffers)
}

/// The bytes of the grid before the buffers of the leaves, and the buffers.
fn grid(voxel_size: f64, background: f32, cell: impl Fn([i32; 3]) -> Cell) -> (Vec<u8>, Vec<u8>) {
    let mut head = grid_head(0, voxel_size, background, 1); // no compression
    head.extend([0; 12]);
    // The upper node has one child, in its first slot.
    push_mask(32_768, |slot| slot == 0, &mut head);
    push_mask(32_768, |_| false, &mut head);
    push_values((0..32_768).map(|slot| if slot == 0 { 0.0 } else { background }), &mut head);
    let cells: Vec<Cell> =
        (0..EDGE.pow(3)).map(|slot| cell([slot / (EDGE * EDGE), slot / EDGE % EDGE, slot % EDGE])).collect();
    push_mask(4096, |slot| matches!(cells[slot], Cell::Leaf(_)), &mut head);
    push_mask(4096, |_| false, &mut head);
    let value = |cell: &Cell| if let Cell::Tile(value) = cell { *value } else { 0.0 };
    push_values(cells.iter().map(value), &mut head);
    let mut buffers = Vec::new();
    for values in
        cells.iter().filter_map(|cell| if let Cell::Leaf(values) = cell { Some(values) } else { None })
    {
        push_mask(512, |_| false, &mut head);
        push_mask(512, |_| false, &mut buffers);
        push_values(values.iter().copied(), &mut buffers);
    }
    (head, buffers)
}

fn push_mask(count: usize, is_on: impl Fn(usize) -> bool, out: &mut Vec<u8>) {
    for byte in 0..count / 8 {
        out.push((0..8).fold(0, |bits, bit| bits | u8::from(is_on(8 * byte + bit)) << bit));
    }
}

fn push_values(values: impl Iterator<Item = f32>, out: &mut Vec<u8>) {
    out.push(6); // all of them
    values.for_each(|value| out.extend(value.to_le_bytes()));
}
