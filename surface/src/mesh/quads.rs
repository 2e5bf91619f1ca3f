//! Detects pairs of triangles that are halves of a quad.
//!
//! ```text
//!    d ─── c        Dual contouring makes a quad around each crossed grid edge and splits the quad along a
//!    │ ╲   │        diagonal. It writes the halves consecutively: (a b d) (b c d). The second half starts at
//!    │   ╲ │        either end of the diagonal.
//!    a ─── b
//! ```
//!
//! So triangles 2i and 2i + 1 would be the halves of one quad, but a few quads are not split into halves:
//! where sheets almost touch, quads with additional vertices on their sides become fans of five to eight
//! triangles around a vertex in the middle. Two consecutive triangles never look like halves if one of them
//! is in a fan, or if they belong to different quads, because no two quads share a diagonal.

use rayon::prelude::*;

use super::Mesh;
use crate::parallel::Loops as _;

/// Number of triangles per task.
const CHUNK: usize = 1 << 14;

impl Mesh {
    /// For each triangle, true if it and the next one are the halves of a quad. Intended for meshes from dual
    /// contouring; in other meshes, two unrelated triangles may look like halves.
    pub fn quads(&self) -> Vec<bool> {
        let count = self.triangles.len();
        let mut quads = vec![false; count];
        quads.par_chunks_mut(CHUNK).enumerate().halved().for_each(|(chunk, quads)| {
            for (quad, index) in quads.iter_mut().zip(chunk * CHUNK..) {
                let next = self.triangles.get(index + 1);
                *quad = next.is_some_and(|&next| are_halves(self.triangles[index], next));
            }
        });
        // A triangle is half of only one quad.
        let mut is_second = false;
        for quad in &mut quads {
            *quad &= !is_second;
            is_second = *quad;
        }
        quads
    }
}

/// True if two consecutive triangles are halves of a quad.
fn are_halves(one: [u32; 3], other: [u32; 3]) -> bool {
    let [a, b, c] = one;
    let from_diagonal = other[0] == c && other[2] == a;
    let is_reversed = other[0] == b && other[1] == a;
    from_diagonal || is_reversed
}
