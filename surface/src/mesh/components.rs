//! Connected components of a mesh.
//!
//! - First, union-find joins the vertices within each chunk, in parallel. `parents` then has the root of each
//!   vertex's part.
//! - Then the parts of different chunks are joined sequentially. Every vertex has its root, so only a few
//!   different pairs of roots are left to join.

use rayon::prelude::*;

use super::{CHUNK, Mesh};
use crate::parallel::Loops as _;

/// Joins the vertices of one chunk along the edges within the chunk. Overwrites `parents`: each entry becomes
/// the root of its vertex. Returns the number of joins.
pub(super) fn join_chunk(
    parents: &mut [u32],
    first: u32,
    triangles: impl Iterator<Item = [u32; 3]>,
) -> usize {
    let count = parents.len() as u32;
    for (parent, vertex) in parents.iter_mut().zip(0..) {
        *parent = vertex;
    }
    let mut joined_count = 0;
    triangles.for_each(|[a, b, c]| {
        let [a, b, c] = [a.wrapping_sub(first), b.wrapping_sub(first), c.wrapping_sub(first)];
        for [one, other] in [[a, b], [b, c]] {
            // Usually both entries are already roots.
            let are_own = one < count && other < count;
            if are_own && parents[one as usize] != parents[other as usize] {
                joined_count += usize::from(join(parents, one, other));
            }
        }
    });
    for vertex in 0..parents.len() {
        // Roots come before the vertices of their tree.
        let root = parents[parents[vertex] as usize];
        parents[vertex] = root;
    }
    parents.iter_mut().for_each(|parent| *parent += first);
    joined_count
}

/// Joins chunks along the edges between them, after each chunk has been joined internally. Returns the number
/// of joins.
pub(super) fn join_chunks(mesh: &Mesh, parents: &mut [u32]) -> usize {
    let roots: &[u32] = parents;
    let pairs_of = |triangles: &[[u32; 3]]| {
        let mut pairs = Vec::new();
        for &[a, b, c] in triangles {
            for [one, other] in [[a, b], [b, c]] {
                if one / CHUNK as u32 != other / CHUNK as u32 {
                    let (one, other) = (roots[one as usize], roots[other as usize]);
                    let pair = [one.min(other), one.max(other)];
                    if pairs.last() != Some(&pair) {
                        pairs.push(pair);
                    }
                }
            }
        }
        pairs.sort_unstable();
        pairs.dedup();
        pairs
    };
    let pairs: Vec<Vec<[u32; 2]>> = mesh.triangles.par_chunks(CHUNK).halved().map(pairs_of).collect();
    pairs.into_iter().flatten().filter(|&[one, other]| join(parents, one, other)).count()
}

/// The volume of each component, in the order of first vertices; negative for the inside of a cavity.
/// Single-threaded: for meshes that are known to have several components.
pub(super) fn component_volumes(mesh: &Mesh) -> Vec<f64> {
    let mut parents: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    for &[a, b, c] in &mesh.triangles {
        join(&mut parents, a, b);
        join(&mut parents, b, c);
    }
    let mut volumes = vec![None; parents.len()];
    for &[a, b, c] in &mesh.triangles {
        let root = find(&mut parents, a);
        // Relative to a vertex of the component, so that a small, distant component loses no precision.
        let corner =
            |vertex: u32| (mesh.positions[vertex as usize] - mesh.positions[root as usize]).as_dvec3();
        let volume = corner(a).dot(corner(b).cross(corner(c))) / 6.0;
        *volumes[root as usize].get_or_insert(0.0) += volume;
    }
    volumes.into_iter().flatten().collect()
}

/// Joins the trees of two vertices. Returns true if they were separate. The smaller root stays the root.
fn join(parents: &mut [u32], one: u32, other: u32) -> bool {
    let (one, other) = (find(parents, one), find(parents, other));
    if one != other {
        parents[one.max(other) as usize] = one.min(other);
    }
    one != other
}

/// The root of a vertex. Compresses the path.
fn find(parents: &mut [u32], vertex: u32) -> u32 {
    let mut root = vertex;
    while parents[root as usize] != root {
        let parent = parents[root as usize];
        parents[root as usize] = parents[parent as usize];
        root = parent;
    }
    root
}
