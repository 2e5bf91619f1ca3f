//! Determines which of the empty regions are inside.
//!
//! A narrow band stores leaves only near the surface. The regions between them are entirely outside or
//! inside, and a file must record which, in as few tiles as possible.
//!
//! ```text
//!   one row of leaves along z          . . [+-] = = = [-+] . . [+-][-+] . .
//!                                           │   inside  │
//!                                    its last face   its first face
//!                                    is negative     is negative
//! ```
//!
//! A gap between two leaves of a row is inside if both faces next to it are. A surface cannot cross a gap
//! without leaves there, so for a closed surface the two faces agree. For a surface with holes, a gap where
//! they disagree stays outside, so the error stays within one row instead of flooding the world.
//!
//! The same rule applies at all levels of the tree. At the next level, the parents are the cells: a face of a
//! parent is inside if inside gaps cross most of its rows. No level visits voxels or cells that are not
//! stored, so the time depends on the number of leaves and not on the volume.

use super::slot_of;

/// A stored part of the grid: a leaf, or a node that contains some.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FloodCell {
    /// Position, in cells of this level.
    pub(super) coord: [i32; 3],
    /// Whether the region just before it along z is inside.
    pub(super) low_inside: bool,
    /// Whether the region just after it along z is inside.
    pub(super) high_inside: bool,
}

/// An inside gap in a row along z: between two cells, excluding both.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct InsideGap {
    pub(super) xy: [i32; 2],
    /// The z of the cell before the gap.
    pub(super) low_cell: i32,
    /// The z of the cell after the gap.
    pub(super) high_cell: i32,
}

/// A node of the next level, with the slots that lie in inside gaps.
#[derive(Clone, Debug)]
pub(super) struct Parent {
    /// Position, in nodes of this level.
    pub(super) coord: [i32; 3],
    /// One bit per slot without a cell: whether it is inside.
    pub(super) inside: Vec<u64>,
    /// Number of inside gaps that cross the face at the lowest z, and at the highest.
    low_crossings: u32,
    high_crossings: u32,
}

impl Parent {
    /// The node as a cell of the next level.
    pub(super) fn as_cell(&self, log2: u32) -> FloodCell {
        let rows = 1 << (2 * log2);
        FloodCell {
            coord: self.coord,
            low_inside: 2 * self.low_crossings > rows,
            high_inside: 2 * self.high_crossings > rows,
        }
    }

    /// Marks a slot as inside.
    pub(super) fn insert(&mut self, slot: usize) {
        self.inside[slot >> 6] |= 1 << (slot & 63);
    }

    /// Marks a run of slots along z. It lies in a single word, because rows have 16 or 32 slots.
    fn insert_row(&mut self, first_slot: usize, count: i32) {
        self.inside[first_slot >> 6] |= ((1 << count) - 1) << (first_slot & 63);
    }
}

/// The parents of `cells`, with the slots in inside gaps. The cells must be sorted by x, then y, then z; the
/// parents have the same order.
pub(super) fn parents(cells: &[FloodCell], log2: u32) -> Vec<Parent> {
    let edge = 1 << log2;
    let mut coords: Vec<[i32; 3]> = cells.iter().map(|cell| cell.coord.map(|c| c >> log2)).collect();
    coords.sort_unstable();
    coords.dedup();
    let words = (1 << (3 * log2)) / 64;
    let mut parents: Vec<Parent> = coords
        .into_iter()
        .map(|coord| Parent { coord, inside: vec![0; words], low_crossings: 0, high_crossings: 0 })
        .collect();
    for InsideGap { xy: [x, y], low_cell, high_cell } in inside_gaps(cells) {
        let index_at = |parents: &[Parent], z: i32| {
            let coord = [x >> log2, y >> log2, z >> log2];
            parents.partition_point(|parent| parent.coord < coord)
        };
        let (first, last) = (index_at(&parents, low_cell), index_at(&parents, high_cell));
        for (index, parent) in parents.iter_mut().enumerate().take(last + 1).skip(first) {
            let start = parent.coord[2] << log2;
            let (crosses_low, crosses_high) = (index > first, index < last);
            let from = if crosses_low { 0 } else { low_cell - start + 1 };
            let to = if crosses_high { edge } else { high_cell - start };
            parent.insert_row(slot_of([x, y, start + from], log2), to - from);
            parent.low_crossings += u32::from(crosses_low);
            parent.high_crossings += u32::from(crosses_high);
        }
    }
    parents
}

/// The inside gaps between cells, which must be sorted by x, then y, then z.
pub(super) fn inside_gaps(cells: &[FloodCell]) -> impl Iterator<Item = InsideGap> + '_ {
    cells.windows(2).filter_map(|pair| {
        let ([ax, ay, az], [bx, by, bz]) = (pair[0].coord, pair[1].coord);
        let inside = ax == bx && ay == by && bz - az > 1 && pair[0].high_inside && pair[1].low_inside;
        inside.then_some(InsideGap { xy: [ax, ay], low_cell: az, high_cell: bz })
    })
}
