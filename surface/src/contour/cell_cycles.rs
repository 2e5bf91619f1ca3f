//! Determines how the surface cuts a cell, from the signs of the cell's corners alone.
//!
//! On each face of a cell, the surface is drawn as segments between the midpoints of crossed edges: one
//! segment around each run of consecutive inside corners along the boundary of the face.
//!
//! ```text
//!    ○─────○     ●──┼──○     ●──┼──○     ●──┼──○      ● inside   ○ outside
//!    │     │     │  │  │     │   ╲ │     ┼─╯   │      ┼ crossed edge
//!    ┼─╮   │     │  │  │     │    ╲┼     │   ╭─┼
//!    ●──┼──○     ●──┼──○     ●─────●     ○──┼──●      the last face is ambiguous: its inside corners are
//!                                                     separated
//! ```
//!
//! The rule depends only on the four signs of the face, so both cells of a face draw the same segments. A
//! crossed edge lies on two faces of its cell, and on each of them one segment ends at the edge. Hence the
//! segments of a crossed cell form one to four simple closed *cycles*, each around one sheet of the surface.
//!
//! Numbering: corner `4x + 2y + z` is at x, y and z. Edge `4a + 2b + c` is along axis a, at b and c on the
//! two axes that follow a in the order x, y, z, x, y. Face `2a + side` is normal to axis a.

use std::sync::LazyLock;

/// Value of an edge without a cycle.
pub(super) const NO_CYCLE: u8 = u8::MAX;

/// The cycles of a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CellCycles {
    /// Number of cycles, 0 to 4.
    pub(super) count: usize,
    /// For each cycle, a mask of the edges it passes through.
    pub(super) edges: [u16; 4],
    /// For each edge, the index of its cycle, or [`NO_CYCLE`] if the edge is not crossed.
    pub(super) of_edge: [u8; 12],
    /// A mask of the ambiguous faces whose two segments belong to the same cycle.
    pub(super) joined_faces: u8,
}

/// The cycles of a cell whose inside corners are the set bits of `signs`.
#[inline(always)]
pub(super) fn cell_cycles(signs: u8) -> &'static CellCycles {
    static TABLE: LazyLock<[CellCycles; 256]> =
        LazyLock::new(|| std::array::from_fn(|signs| trace_cycles(signs as u8)));
    &TABLE[usize::from(signs)]
}

/// The bit of an axis in a corner number.
pub(super) const fn corner_bit(axis: usize) -> usize {
    4 >> axis
}

/// The first and last corner of an edge.
pub(super) const fn edge_corners(edge: usize) -> (usize, usize) {
    let (axis, b, c) = (edge / 4, edge / 2 % 2, edge % 2);
    let start = b * corner_bit((axis + 1) % 3) + c * corner_bit((axis + 2) % 3);
    (start, start + corner_bit(axis))
}

fn trace_cycles(signs: u8) -> CellCycles {
    let segments: Vec<(usize, [usize; 2])> = (0..6)
        .flat_map(|face| segments_on(face, signs).into_iter().map(move |segment| (face, segment)))
        .collect();
    let mut cycles = CellCycles { count: 0, edges: [0; 4], of_edge: [NO_CYCLE; 12], joined_faces: 0 };
    for first_edge in 0..12 {
        let is_crossed = segments.iter().any(|(_, ends)| ends.contains(&first_edge));
        if !is_crossed || cycles.of_edge[first_edge] != NO_CYCLE {
            continue;
        }
        let mut edges: u16 = 1 << first_edge;
        // A cycle has at most 12 edges, so 12 rounds reach all of it.
        for _ in 0..12 {
            for (_, [one, other]) in &segments {
                if edges & (1 << one | 1 << other) != 0 {
                    edges |= 1 << one | 1 << other;
                }
            }
        }
        for edge in (0..12).filter(|edge| edges >> edge & 1 == 1) {
            cycles.of_edge[edge] = cycles.count as u8;
        }
        cycles.edges[cycles.count] = edges;
        cycles.count += 1;
    }
    for pair in segments.windows(2) {
        let [(face, one), (other_face, other)] = [pair[0], pair[1]];
        if face == other_face && cycles.of_edge[one[0]] == cycles.of_edge[other[0]] {
            cycles.joined_faces |= 1 << face;
        }
    }
    cycles
}

/// The segments on a face: for each run of inside corners along its boundary, the crossed edges where the run
/// begins and ends.
fn segments_on(face: usize, signs: u8) -> Vec<[usize; 2]> {
    let (axis, side) = (face / 2, face % 2);
    let (b, c) = (corner_bit((axis + 1) % 3), corner_bit((axis + 2) % 3));
    let face_corners = [0, b, b | c, c].map(|corner| corner + side * corner_bit(axis));
    let is_inside = |k: usize| signs >> face_corners[k % 4] & 1 == 1;
    let edge_after = |k: usize| edge_between(face_corners[k % 4], face_corners[(k + 1) % 4]);
    (0..4)
        .filter(|&k| is_inside(k) && !is_inside(k + 3))
        .map(|first| {
            let last = (first..first + 4).find(|&k| !is_inside(k + 1)).unwrap_or(first);
            [edge_after(first + 3), edge_after(last)]
        })
        .collect()
}

fn edge_between(one: usize, other: usize) -> usize {
    let ends = (one.min(other), one.max(other));
    (0..12).find(|&edge| edge_corners(edge) == ends).expect("adjacent corners of a face share an edge")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crossed_edges_are_in_exactly_one_cycle() {
        for signs in 0..=255u8 {
            let cycles = cell_cycles(signs);
            for edge in 0..12 {
                let (start, end) = edge_corners(edge);
                let is_crossed = (signs >> start ^ signs >> end) & 1 == 1;
                assert_eq!(is_crossed, cycles.of_edge[edge] != NO_CYCLE, "{signs:#010b} edge {edge}");
            }
            let all = cycles.edges.iter().fold(0, |all, edges| {
                assert_eq!(all & edges, 0);
                all | edges
            });
            let lengths = cycles.edges[..cycles.count].iter().map(|edges| edges.count_ones());
            assert!(lengths.clone().all(|length| length >= 3), "{signs:#010b}");
            assert_eq!(lengths.sum::<u32>(), u32::from(all).count_ones());
        }
    }

    #[test]
    fn ambiguous_faces_separate_the_inside_corners() {
        // Four inside corners, no two of them adjacent.
        assert_eq!(cell_cycles(0b0110_1001).count, 4);
        // Two diagonally opposite inside corners of a face are separated. In the complement, the other six
        // corners are inside, and one sheet surrounds both outside corners.
        assert_eq!(cell_cycles(0b0000_1001).count, 2);
        assert_eq!(cell_cycles(0b1111_0110).count, 1);
        assert_eq!(cell_cycles(0b1111_0110).joined_faces.count_ones(), 1);
    }
}
