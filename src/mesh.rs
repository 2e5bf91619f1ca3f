//! A plain triangle mesh, and what can be measured on it.
//!
//! ```text
//!              prev          corner: a triangle as its vertex v sees it, (v, next, prev)
//!             ╱   ╲
//!            ╱     ╲         the corners of v, turned by v → next → prev, tell all: an edge v–w is
//!           v ───▶ next      sound if w is `next` once and `prev` once; v is sound if going from
//!                            corner to corner over such edges passes through all of them
//! ```
//!
//! Bending energy is ∫H² with the mean curvature vector by cotangents, over mixed Voronoi areas:
//!
//! ```text
//!   2 H n·A = ½ Σ (cot α + cot β)(v − w)      so   ∫H² ≈ Σ |½ Σ (cot α + cot β)(v − w)|² / 4A
//! ```
//!
//! The area and the energy are from:
//! Mark Meyer, Mathieu Desbrun, Peter Schröder, Alan Barr. Discrete Differential-Geometry Operators
//! for Triangulated 2-Manifolds. 2003

use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// A triangle mesh in world units.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Vertex positions relative to `origin`.
    pub positions: Vec<Vec3>,
    /// Unit vertex normals, pointing outward; one a vertex.
    pub normals: Vec<Vec3>,
    /// Three vertex indices a triangle, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// World position that `positions` are relative to: zero unless the frame is so far from the
    /// world's origin that 32-bit positions would lose what matters. Always whole voxels.
    pub origin: DVec3,
}

/// What [`Mesh::measure`] finds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MeshMeasures {
    /// Area, world units squared.
    pub area: f64,
    /// Enclosed volume, world units cubed; negative if the mesh is inside out.
    pub volume: f64,
    /// ∫H² from the mesh's angles. Without unit: 4π for a sphere.
    pub bending_energy: f64,
    /// Vertices, whether a triangle uses them or not.
    pub vertex_count: usize,
    /// Triangles.
    pub triangle_count: usize,
    /// Edges in one triangle only.
    pub boundary_edge_count: usize,
    /// Edges in more than two triangles, or in two that run along it in the same direction.
    pub non_manifold_edge_count: usize,
    /// Vertices whose triangles form more than one fan.
    pub non_manifold_vertex_count: usize,
    /// Triangles that repeat a vertex, or whose height is below a billionth of their longest edge.
    pub degenerate_triangle_count: usize,
    /// Pieces that are connected through vertices.
    pub component_count: usize,
    /// Vertices that are used − edges + triangles.
    pub euler_characteristic: i64,
}

impl MeshMeasures {
    /// Whether each edge is in two triangles with opposite directions, the triangles around each
    /// vertex form one ring, and each has an area.
    pub fn is_closed_manifold(&self) -> bool {
        self.boundary_edge_count == 0
            && self.non_manifold_edge_count == 0
            && self.non_manifold_vertex_count == 0
            && self.degenerate_triangle_count == 0
    }
}

impl Mesh {
    /// Measures the mesh. The same mesh gives the same bits on any number of threads.
    ///
    /// Panics if a triangle names a vertex that does not exist.
    pub fn measure(&self) -> MeshMeasures {
        let corners = Corners::new(self);
        let vertices = sum_in_pieces(self.positions.len(), |vertex| measure_vertex(self, &corners, vertex));
        let triangles = sum_in_pieces(self.triangles.len(), |index| measure_triangle(self, index));
        let edge_count = vertices.edge_count as i64;
        MeshMeasures {
            area: triangles.area,
            volume: triangles.volume,
            bending_energy: vertices.bending_energy,
            vertex_count: self.positions.len(),
            triangle_count: self.triangles.len(),
            boundary_edge_count: vertices.boundary_edge_count,
            non_manifold_edge_count: vertices.non_manifold_edge_count,
            non_manifold_vertex_count: vertices.non_manifold_vertex_count,
            degenerate_triangle_count: triangles.degenerate_triangle_count,
            component_count: component_count(self, vertices.used_vertex_count),
            euler_characteristic: vertices.used_vertex_count as i64 - edge_count
                + self.triangles.len() as i64,
        }
    }
}

/// Vertices or triangles in a piece of work. Sums are taken piece by piece, so that they do not
/// depend on the number of threads.
const PIECE: usize = 4096;

/// What is summed over vertices and triangles.
#[derive(Clone, Copy, Default)]
struct Sums {
    area: f64,
    volume: f64,
    bending_energy: f64,
    edge_count: usize,
    boundary_edge_count: usize,
    non_manifold_edge_count: usize,
    non_manifold_vertex_count: usize,
    degenerate_triangle_count: usize,
    used_vertex_count: usize,
}

fn sum_in_pieces(count: usize, measure: impl Fn(usize) -> Sums + Sync) -> Sums {
    let add = |sums: Sums, one: Sums| Sums {
        area: sums.area + one.area,
        volume: sums.volume + one.volume,
        bending_energy: sums.bending_energy + one.bending_energy,
        edge_count: sums.edge_count + one.edge_count,
        boundary_edge_count: sums.boundary_edge_count + one.boundary_edge_count,
        non_manifold_edge_count: sums.non_manifold_edge_count + one.non_manifold_edge_count,
        non_manifold_vertex_count: sums.non_manifold_vertex_count + one.non_manifold_vertex_count,
        degenerate_triangle_count: sums.degenerate_triangle_count + one.degenerate_triangle_count,
        used_vertex_count: sums.used_vertex_count + one.used_vertex_count,
    };
    let pieces: Vec<Sums> = (0..count.div_ceil(PIECE))
        .into_par_iter()
        .map(|piece| {
            let range = piece * PIECE..count.min((piece + 1) * PIECE);
            range.map(&measure).fold(Sums::default(), add)
        })
        .collect();
    pieces.into_iter().fold(Sums::default(), add)
}

/// All corners of a mesh, by vertex.
struct Corners {
    /// Where each vertex's corners start in `ends`, and at last where the last one's end.
    starts: Vec<usize>,
    /// `[next, prev]` of each corner.
    ends: Vec<[u32; 2]>,
}

impl Corners {
    fn new(mesh: &Mesh) -> Corners {
        let mut starts = vec![0; mesh.positions.len() + 2];
        mesh.triangles.iter().flatten().for_each(|&vertex| starts[vertex as usize + 2] += 1);
        for vertex in 2..starts.len() {
            starts[vertex] += starts[vertex - 1];
        }
        // Each start moves up as its corners are put in, and so becomes the next vertex's start.
        let mut ends = vec![[0; 2]; mesh.triangles.len() * 3];
        for &[a, b, c] in &mesh.triangles {
            for [vertex, next, prev] in [[a, b, c], [b, c, a], [c, a, b]] {
                let place = &mut starts[vertex as usize + 1];
                ends[*place] = [next, prev];
                *place += 1;
            }
        }
        Corners { starts, ends }
    }

    fn of(&self, vertex: usize) -> &[[u32; 2]] {
        &self.ends[self.starts[vertex]..self.starts[vertex + 1]]
    }
}

fn measure_vertex(mesh: &Mesh, corners: &Corners, vertex: usize) -> Sums {
    let corners = corners.of(vertex);
    if corners.is_empty() {
        return Sums::default();
    }
    let mut sums = Sums { used_vertex_count: 1, ..Sums::default() };
    for (place, corner) in corners.iter().enumerate() {
        for (side, &other) in corner.iter().enumerate() {
            // Each edge once: from its lesser end, at the first corner that has it.
            let is_seen = corners[..place].iter().any(|corner| corner.contains(&other));
            if (other as usize) < vertex || is_seen || side == 1 && corner[0] == other {
                continue;
            }
            let next_count = corners.iter().filter(|corner| corner[0] == other).count();
            let prev_count = corners.iter().filter(|corner| corner[1] == other).count();
            sums.edge_count += 1;
            match (next_count, prev_count) {
                (1, 1) => {}
                (1, 0) | (0, 1) => sums.boundary_edge_count += 1,
                _ => sums.non_manifold_edge_count += 1,
            }
        }
    }
    sums.non_manifold_vertex_count = usize::from(!is_one_fan(corners));
    sums.bending_energy = vertex_energy(mesh, corners, vertex);
    sums
}

/// Whether one walk over shared edges passes through all corners of a vertex.
fn is_one_fan(corners: &[[u32; 2]]) -> bool {
    let step = |corner: &[u32; 2]| corners.iter().position(|other| other[0] == corner[1]);
    // An open fan is walked from its first corner, a ring from any.
    let is_first = |corner: &[u32; 2]| !corners.iter().any(|other| other[1] == corner[0]);
    let start = corners.iter().position(is_first).unwrap_or(0);
    let mut at = start;
    for passed in 1..=corners.len() {
        match step(&corners[at]) {
            Some(next) if next != start => at = next,
            _ => return passed == corners.len(),
        }
    }
    false
}

/// The part of ∫H² around a vertex.
fn vertex_energy(mesh: &Mesh, corners: &[[u32; 2]], vertex: usize) -> f64 {
    let here = mesh.positions[vertex].as_dvec3();
    let (mut area, mut curvature_vector) = (0.0, DVec3::ZERO);
    for corner in corners {
        let [to_next, to_prev] = corner.map(|end| mesh.positions[end as usize].as_dvec3() - here);
        let across = to_prev - to_next;
        let doubled_area = to_next.cross(to_prev).length();
        if doubled_area <= 0.0 {
            continue;
        }
        // The products whose signs tell acute from obtuse; over the area, cotangents.
        let [at_here, at_next, at_prev] = [to_next.dot(to_prev), -to_next.dot(across), to_prev.dot(across)];
        curvature_vector -= 0.5 * (at_prev * to_next + at_next * to_prev) / doubled_area;
        area += if at_here < 0.0 {
            doubled_area / 4.0
        } else if at_next < 0.0 || at_prev < 0.0 {
            doubled_area / 8.0
        } else {
            (at_prev * to_next.length_squared() + at_next * to_prev.length_squared()) / (8.0 * doubled_area)
        };
    }
    if area > 0.0 { curvature_vector.length_squared() / (4.0 * area) } else { 0.0 }
}

/// Triangles lower than this part of their longest edge count as degenerate.
const LEAST_HEIGHT: f64 = 1e-9;

fn measure_triangle(mesh: &Mesh, index: usize) -> Sums {
    let [a, b, c] = mesh.triangles[index].map(|vertex| mesh.positions[vertex as usize].as_dvec3());
    let normal = (b - a).cross(c - a);
    let longest_squared = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
    let is_degenerate = normal.length() <= LEAST_HEIGHT * longest_squared;
    Sums {
        area: 0.5 * normal.length(),
        volume: a.dot(b.cross(c)) / 6.0,
        degenerate_triangle_count: usize::from(is_degenerate),
        ..Sums::default()
    }
}

/// How many pieces the used vertices are in.
fn component_count(mesh: &Mesh, used_vertex_count: usize) -> usize {
    let mut parents: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    let find = |vertex: u32, parents: &mut Vec<u32>| {
        let mut root = vertex;
        while parents[root as usize] != root {
            let parent = parents[root as usize];
            parents[root as usize] = parents[parent as usize];
            root = parent;
        }
        root
    };
    let mut joined_count = 0;
    for &[a, b, c] in &mesh.triangles {
        for [one, other] in [[a, b], [b, c]] {
            let (one, other) = (find(one, &mut parents), find(other, &mut parents));
            if one != other {
                parents[one.max(other) as usize] = one.min(other);
                joined_count += 1;
            }
        }
    }
    used_vertex_count - joined_count
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mesh(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Mesh {
        let positions = positions.iter().map(|&position| Vec3::from_array(position)).collect();
        Mesh { positions, triangles: triangles.to_vec(), ..Mesh::default() }
    }

    const CORNERS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    const TETRAHEDRON: [[u32; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

    #[test]
    fn a_tetrahedron_is_closed() {
        let measures = mesh(&CORNERS, &TETRAHEDRON).measure();
        assert!(measures.is_closed_manifold());
        assert!((measures.volume - 1.0 / 6.0).abs() < 1e-12);
        assert!((measures.area - (1.5 + 0.75f64.sqrt())).abs() < 1e-12);
        assert_eq!((measures.component_count, measures.euler_characteristic), (1, 2));
    }

    #[test]
    fn a_missing_triangle_leaves_a_boundary() {
        let measures = mesh(&CORNERS, &TETRAHEDRON[1..]).measure();
        assert_eq!((measures.boundary_edge_count, measures.non_manifold_edge_count), (3, 0));
        assert_eq!((measures.non_manifold_vertex_count, measures.euler_characteristic), (0, 1));
    }

    #[test]
    fn a_turned_triangle_is_not_manifold() {
        let mut triangles = TETRAHEDRON;
        triangles[0].swap(1, 2);
        let measures = mesh(&CORNERS, &triangles).measure();
        assert_eq!((measures.boundary_edge_count, measures.non_manifold_edge_count), (0, 3));
    }

    #[test]
    fn tetrahedra_may_not_share_an_edge_or_a_vertex() {
        let mut positions = CORNERS.to_vec();
        positions.extend(CORNERS.map(|[x, y, z]| [-x, -y, z + 2.0]));
        let other = |map: [u32; 4]| TETRAHEDRON.map(|triangle| triangle.map(|corner| map[corner as usize]));
        let measure = |map| mesh(&positions, &[TETRAHEDRON, other(map)].concat()).measure();
        let apart = measure([4, 5, 6, 7]);
        assert!(apart.is_closed_manifold() && apart.component_count == 2 && apart.euler_characteristic == 4);
        let at_vertex = measure([0, 5, 6, 7]);
        assert_eq!((at_vertex.non_manifold_edge_count, at_vertex.non_manifold_vertex_count), (0, 1));
        assert_eq!(at_vertex.component_count, 1);
        let at_edge = measure([0, 1, 6, 7]);
        assert_eq!(at_edge.non_manifold_edge_count, 1);
        assert!(at_edge.non_manifold_vertex_count > 0);
    }

    #[test]
    fn flat_and_repeating_triangles_are_degenerate() {
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]];
        assert_eq!(mesh(&positions, &[[0, 1, 2], [0, 1, 1]]).measure().degenerate_triangle_count, 2);
    }
}
