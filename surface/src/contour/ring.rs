//! The cells around an edge, and the faces between these cells that need an additional vertex per segment.
//! (Segments and cycles are defined in `cell_cycles.rs`.)
//!
//! ```text
//!      ●──┼──○          An ambiguous face whose two segments belong to one cycle in both of its cells is
//!      │   · ┼          *joined*: the dual mesh would have two edges between the same two vertices, so
//!      ┼ ·   │          each of its segments gets an additional vertex in its middle (·).
//!      ○──┼──●
//! ```
//!
//! Only thin sheets and noise have such faces. All functions here depend on signs alone.

use glam::IVec3;

use super::cell_cycles::{CellCycles, cell_cycles, corner_bit};
use super::neighborhood::SignRows;
use crate::grid::{offset_in_leaf, voxel_in_leaf};

/// The segments on the joined faces of a leaf, in the order of [`segment_key`]. Each is given by the cell
/// after the face, the axis normal to the face, and the inside corner that the segment cuts off. The corner
/// has coordinates on the two axes that follow the normal.
pub(super) fn joined_segments(rows: &SignRows) -> impl Iterator<Item = (IVec3, usize, [usize; 2])> + '_ {
    let cells: Vec<usize> = rows.crossed_cells().iter().collect();
    let cells = cells.into_iter().map(voxel_in_leaf).filter(|&cell| cycles_at(rows, cell).joined_faces != 0);
    let faces = cells.flat_map(|cell| (0..3).map(move |axis| (cell, axis)));
    let joined = faces.filter(|&(cell, axis)| is_joined(rows, cell, axis));
    joined.flat_map(|(cell, axis)| {
        inside_corners(rows.cell_signs(cell), axis).map(move |corner| (cell, axis, corner))
    })
}

fn cycles_at(rows: &SignRows, cell: IVec3) -> &'static CellCycles {
    cell_cycles(rows.cell_signs(cell))
}

/// True if both segments of the face between `cell` and the cell before it along `axis` belong to one cycle
/// in both cells.
fn is_joined(rows: &SignRows, cell: IVec3, axis: usize) -> bool {
    let is_joined_at =
        |cell: IVec3, side: usize| cycles_at(rows, cell).joined_faces >> (2 * axis + side) & 1 == 1;
    is_joined_at(cell, 0) && is_joined_at(cell - IVec3::AXES[axis], 1)
}

/// The inside corners of a cell on its near face along `axis`, as coordinates on the two following axes.
fn inside_corners(signs: u8, axis: usize) -> impl Iterator<Item = [usize; 2]> {
    let (b, c) = (corner_bit((axis + 1) % 3), corner_bit((axis + 2) % 3));
    [[0, 0], [0, 1], [1, 0], [1, 1]].into_iter().filter(move |[i, j]| signs >> (i * b + j * c) & 1 == 1)
}

/// Key of a segment of an ambiguous face within its leaf: the face's first voxel and normal, and the inside
/// corner that the segment cuts off. (The two inside corners differ on both axes, so one coordinate
/// suffices.)
pub(super) fn segment_key(first_voxel: IVec3, normal_axis: usize, corner: [usize; 2]) -> u16 {
    (offset_in_leaf(first_voxel) * 8 + normal_axis * 2 + corner[0]) as u16
}

/// The four cells around a crossed edge, counter-clockwise as seen from its end.
///
/// ```text
///        c             a: the edge's axis, toward the reader
///    1   │   0         b, c: the axes after it
///   ─────┼───── b      side k: the face between cell k and cell k + 1
///    2   │   3
/// ```
pub(super) struct Ring {
    pub(super) axis: usize,
    pub(super) cells: [IVec3; 4],
    /// Bit k: side k is joined, see [`is_joined`].
    pub(super) joined_sides: u8,
}

/// The edge's position in each cell of a ring, as `2b + c`.
pub(super) const RING_CELLS: [usize; 4] = [0, 2, 3, 1];

/// For each side of a ring: the step from the ring's axis to the axis normal to the side (1 for b, 2 for c),
/// and the cell on its far side, which has the same first voxel as the face.
pub(super) const RING_SIDES: [(usize, usize); 4] = [(1, 0), (2, 1), (1, 3), (2, 0)];

impl Ring {
    pub(super) fn new(rows: &SignRows, start: IVec3, axis: usize) -> Ring {
        let (b, c) = (IVec3::AXES[(axis + 1) % 3], IVec3::AXES[(axis + 2) % 3]);
        let cells = [start, start - b, start - b - c, start - c];
        let around: [&CellCycles; 4] = std::array::from_fn(|k| cycles_at(rows, cells[k]));
        let mut joined_sides = 0;
        if around.iter().any(|cycles| cycles.joined_faces != 0) {
            for (side, (turn, far)) in RING_SIDES.into_iter().enumerate() {
                let normal_axis = (axis + turn) % 3;
                let near = if far == side { (side + 1) % 4 } else { side };
                let is_joined = around[far].joined_faces >> (2 * normal_axis)
                    & around[near].joined_faces >> (2 * normal_axis + 1)
                    & 1;
                joined_sides |= is_joined << side;
            }
        }
        Ring { axis, cells, joined_sides }
    }
}
