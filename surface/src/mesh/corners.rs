//! Finds the triangles around each vertex.
//!
//! Vertices and triangles are split into chunks. First, the triangles that touch each chunk of vertices are
//! listed. Then one thread sorts the corners of a chunk's vertices, in memory that fits into its cache and is
//! reused for the next chunk:
//!
//! ```text
//!   triangles   chunk 0        chunk 1        chunk 2
//!               ╱    ╲          │   ╲           │            runs: indices of triangles within their chunk
//!   vertices  chunk 0   chunk 1    …                         corners:   [next, prev] by vertex
//! ```

use rayon::prelude::*;

use super::{CHUNK, Mesh};
use crate::parallel::Loops as _;

/// The triangles of one chunk that touch one chunk of vertices.
struct CornerRun {
    vertex_chunk: u32,
    triangle_chunk: u32,
    /// Start in the list of indices of the triangle chunk.
    start: u32,
    count: u32,
}

/// For each chunk of vertices, the triangles that touch it.
pub(super) struct TouchingTriangles {
    /// For each chunk of triangles, the indices of its triangles relative to the chunk, grouped by the vertex
    /// chunk that they touch.
    indices: Vec<Vec<u16>>,
    /// Sorted by chunk of vertices, then by chunk of triangles.
    runs: Vec<CornerRun>,
}

impl TouchingTriangles {
    pub(super) fn new(mesh: &Mesh) -> TouchingTriangles {
        let chunks = mesh.triangles.par_chunks(CHUNK).enumerate();
        let lists = chunks.halved().map(|(chunk, triangles)| list_of_chunk(triangles, chunk as u32));
        let (indices, runs): (Vec<_>, Vec<_>) = lists.unzip();
        let mut runs: Vec<CornerRun> = runs.into_iter().flatten().collect();
        runs.par_sort_unstable_by_key(|run| (run.vertex_chunk, run.triangle_chunk));
        TouchingTriangles { indices, runs }
    }

    /// The triangles that touch a chunk of vertices, in order.
    pub(super) fn triangles<'a>(
        &'a self,
        mesh: &'a Mesh,
        chunk: usize,
    ) -> impl Iterator<Item = [u32; 3]> + Clone + 'a {
        let first = self.runs.partition_point(|run| (run.vertex_chunk as usize) < chunk);
        let runs = self.runs[first..].iter();
        runs.take_while(move |run| run.vertex_chunk as usize == chunk).flat_map(|run| {
            let triangles = &mesh.triangles[run.triangle_chunk as usize * CHUNK..];
            let indices = &self.indices[run.triangle_chunk as usize][run.start as usize..];
            indices[..run.count as usize].iter().map(|&index| triangles[usize::from(index)])
        })
    }
}

/// The list of indices of a chunk of triangles, and its runs.
fn list_of_chunk(triangles: &[[u32; 3]], triangle_chunk: u32) -> (Vec<u16>, Vec<CornerRun>) {
    let least = triangles.iter().flatten().fold(u32::MAX, |least, &vertex| least.min(vertex));
    let most = triangles.iter().flatten().fold(0, |most, &vertex| most.max(vertex));
    let [first, last] = [least, most].map(|vertex| vertex / CHUNK as u32);
    let mut ends = vec![0u32; (last - first) as usize + 1];
    for triangle in triangles {
        touched(*triangle, |chunk| ends[(chunk - first) as usize] += 1);
    }
    let mut runs = Vec::new();
    let mut total = 0;
    for (vertex_chunk, end) in (first..).zip(&mut ends) {
        if *end > 0 {
            runs.push(CornerRun { vertex_chunk, triangle_chunk, start: total, count: *end });
        }
        // `end` becomes the start of the run, and advances as indices are inserted below.
        total += std::mem::replace(end, total);
    }
    let mut indices = vec![0; total as usize];
    for (index, triangle) in triangles.iter().enumerate() {
        touched(*triangle, |chunk| {
            let next = &mut ends[(chunk - first) as usize];
            indices[*next as usize] = index as u16;
            *next += 1;
        });
    }
    (indices, runs)
}

/// Calls `each` for each chunk of vertices that a triangle touches.
#[inline(always)]
fn touched(triangle: [u32; 3], mut each: impl FnMut(u32)) {
    let [a, b, c] = triangle.map(|vertex| vertex / CHUNK as u32);
    each(a);
    if b != a {
        each(b);
    }
    if c != a && c != b {
        each(c);
    }
}

/// The corners of a chunk of vertices, grouped by vertex.
#[derive(Default)]
pub(super) struct Corners {
    /// Start of each vertex's corners in `ends`; one entry more than there are vertices.
    starts: Vec<u32>,
    /// For each corner, the other two vertices of its triangle: `[next, prev]`.
    ends: Vec<[u32; 2]>,
}

impl Corners {
    /// Replaces the corners by those of the vertices from `first` on.
    pub(super) fn collect(
        &mut self,
        first: u32,
        count: usize,
        triangles: impl Iterator<Item = [u32; 3]> + Clone,
    ) {
        let is_own = |vertex: u32| vertex >= first && vertex - first < CHUNK as u32;
        let starts = &mut self.starts;
        starts.clear();
        starts.resize(count + 2, 0);
        triangles.clone().flatten().filter(|&vertex| is_own(vertex)).for_each(|vertex| {
            starts[(vertex - first) as usize + 2] += 1;
        });
        for vertex in 2..starts.len() {
            starts[vertex] += starts[vertex - 1];
        }
        // Each start advances as corners are inserted, and finally is the start of the next vertex.
        self.ends.resize(starts[count + 1] as usize, [0; 2]);
        triangles.for_each(|[a, b, c]| {
            for [vertex, next, prev] in [[a, b, c], [b, c, a], [c, a, b]] {
                if is_own(vertex) {
                    let index = &mut starts[(vertex - first) as usize + 1];
                    self.ends[*index as usize] = [next, prev];
                    *index += 1;
                }
            }
        });
    }

    /// The corners of a vertex, given by its index within the chunk.
    #[inline(always)]
    pub(super) fn of(&self, vertex: usize) -> &[[u32; 2]] {
        &self.ends[self.starts[vertex] as usize..self.starts[vertex + 1] as usize]
    }
}
