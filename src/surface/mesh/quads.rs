//! Which triangles are halves of quads.
//!
//! ```text
//!    d ─── c        Dual contouring makes a quad around each crossed grid edge, cuts it along one of its diagonals, and
//!    │ ╲   │        writes the halves one after the other: (a b d) (b c d), the second from one end of the
//!    │   ╲ │        diagonal or from the other.
//!    a ─── b
//! ```
//!
//! So triangles 2i and 2i + 1 would be the halves of one quad, if it were not for the few quads that have vertices on their
//! sides, where sheets all but touch: they are fans of five to eight triangles about a vertex in the middle. Two triangles in a row
//! of which either is in a fan never look like halves, nor does the second half of a quad with the first of the next: no two quads
//! have a diagonal in common.

use rayon::prelude::*;

use super::Mesh;

/// Triangles in a piece of work.
const PIECE: usize = 1 << 14;

impl Mesh {
    /// For each triangle whether it and the next one are the halves of a quad. Meant for meshes as dual contouring makes
    /// them: in others two triangles may look so that never were one.
    pub fn quads(&self) -> Vec<bool> {
        let count = self.triangles.len();
        let mut quads = vec![false; count];
        quads.par_chunks_mut(PIECE).enumerate().for_each(|(piece, quads)| {
            for (quad, index) in quads.iter_mut().zip(piece * PIECE..) {
                let next = self.triangles.get(index + 1);
                *quad = next.is_some_and(|&next| are_halves(self.triangles[index], next));
            }
        });
        // A half belongs to one quad.
        let mut is_second = false;
        for quad in &mut quads {
            *quad &= !is_second;
            is_second = *quad;
        }
        quads
    }
}

/// Whether two triangles are halves of a quad, as they are written.
fn are_halves(one: [u32; 3], other: [u32; 3]) -> bool {
    let [a, b, c] = one;
    let from_diagonal = other[0] == c && other[2] == a;
    let turned = other[0] == b && other[1] == a;
    from_diagonal || turned
}
