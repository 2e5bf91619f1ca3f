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

use super::{Mesh, PIECE};

/// The triangles of one chunk that touch one chunk of vertices.
struct Stretch {
    vertex_piece: u32,
    triangle_piece: u32,
    /// Start in the list of the triangles' chunk.
    start: u32,
    count: u32,
}

/// For each chunk of vertices, the triangles that touch it.
pub(super) struct Touching {
    /// For each chunk of triangles, the indices within it of its triangles, grouped by the vertex chunk they
    /// touch.
    places: Vec<Vec<u16>>,
    /// Sorted by chunk of vertices, then by chunk of triangles.
    stretches: Vec<Stretch>,
}

impl Touching {
    pub(super) fn new(mesh: &Mesh) -> Touching {
        let pieces = mesh.triangles.par_chunks(PIECE).enumerate();
        let lists = pieces.map(|(piece, triangles)| list_of_piece(triangles, piece as u32));
        let (places, stretches): (Vec<_>, Vec<_>) = lists.unzip();
        let mut stretches: Vec<Stretch> = stretches.into_iter().flatten().collect();
        stretches.par_sort_unstable_by_key(|stretch| (stretch.vertex_piece, stretch.triangle_piece));
        Touching { places, stretches }
    }

    /// The triangles that touch a chunk of vertices, in order.
    pub(super) fn triangles<'a>(
        &'a self,
        mesh: &'a Mesh,
        piece: usize,
    ) -> impl Iterator<Item = [u32; 3]> + Clone + 'a {
        let first = self.stretches.partition_point(|stretch| (stretch.vertex_piece as usize) < piece);
        let stretches = self.stretches[first..].iter();
        stretches.take_while(move |stretch| stretch.vertex_piece as usize == piece).flat_map(|stretch| {
            let triangles = &mesh.triangles[stretch.triangle_piece as usize * PIECE..];
            let places = &self.places[stretch.triangle_piece as usize][stretch.start as usize..];
            places[..stretch.count as usize].iter().map(|&place| triangles[usize::from(place)])
        })
    }
}

/// The list of a chunk of triangles, and its runs.
fn list_of_piece(triangles: &[[u32; 3]], triangle_piece: u32) -> (Vec<u16>, Vec<Stretch>) {
    let least = triangles.iter().flatten().fold(u32::MAX, |least, &vertex| least.min(vertex));
    let most = triangles.iter().flatten().fold(0, |most, &vertex| most.max(vertex));
    let [first, last] = [least, most].map(|vertex| vertex / PIECE as u32);
    let mut ends = vec![0u32; (last - first) as usize + 1];
    for triangle in triangles {
        touched(*triangle, |piece| ends[(piece - first) as usize] += 1);
    }
    let mut stretches = Vec::new();
    let mut total = 0;
    for (vertex_piece, end) in (first..).zip(&mut ends) {
        if *end > 0 {
            stretches.push(Stretch { vertex_piece, triangle_piece, start: total, count: *end });
        }
        // Advances as indices are inserted.
        total += std::mem::replace(end, total);
    }
    let mut places = vec![0; total as usize];
    for (place, triangle) in triangles.iter().enumerate() {
        touched(*triangle, |piece| {
            let next = &mut ends[(piece - first) as usize];
            places[*next as usize] = place as u16;
            *next += 1;
        });
    }
    (places, stretches)
}

/// Calls `each` for each chunk of vertices that a triangle touches.
#[inline(always)]
fn touched(triangle: [u32; 3], mut each: impl FnMut(u32)) {
    let [a, b, c] = triangle.map(|vertex| vertex / PIECE as u32);
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
    /// `[next, prev]` of each corner.
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
        let is_own = |vertex: u32| vertex >= first && vertex - first < PIECE as u32;
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
                    let place = &mut starts[(vertex - first) as usize + 1];
                    self.ends[*place as usize] = [next, prev];
                    *place += 1;
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
