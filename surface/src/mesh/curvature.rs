//! The curvature of a mesh at its vertices.
//!
//! ```text
//!        n_v ↑   ↗ n_w       the normal curvature along an edge v–w is (n_w − n_v)·(w − v) / |w − v|²
//!        v ──┴── w
//! ```
//!
//! Euler: κ(c, s) = e c² + 2f c s + g s² along the direction (c, s) of the tangent plane. The mean over all directions is
//! (e + g) / 2, the mean curvature. e, f and g are fitted to the edges around a vertex, so that the result does not depend
//! on how evenly the edges point in all directions.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::corners::{Corners, TouchingTriangles};
use super::{CHUNK, Mesh};
use crate::parallel::Loops as _;

impl Mesh {
    /// The mean of the normal curvature over all directions at each vertex, in 1 / world units: 1/r on a ball of radius r,
    /// negative in dents, 0 at vertices without triangles. Uses the normals.
    ///
    /// Panics if a triangle refers to a vertex that does not exist, or a vertex has no normal.
    pub fn curvatures(&self) -> Vec<f32> {
        let touching = TouchingTriangles::new(self);
        let mut curvatures = vec![0.0; self.positions.len()];
        let chunks = curvatures.par_chunks_mut(CHUNK).enumerate();
        chunks.halved().for_each_init(Corners::default, |corners, (chunk, curvatures)| {
            let first = chunk * CHUNK;
            corners.collect(first as u32, curvatures.len(), touching.triangles(self, chunk));
            for (vertex, curvature) in curvatures.iter_mut().enumerate() {
                *curvature = curvature_at(self, first + vertex, corners.of(vertex)) as f32;
            }
        });
        curvatures
    }
}

fn curvature_at(mesh: &Mesh, vertex: usize, corners: &[[u32; 2]]) -> f64 {
    let [here, normal] = [mesh.positions[vertex], mesh.normals[vertex]].map(|of| of.as_dvec3());
    let (along, across) = normal.normalize_or(DVec3::Z).any_orthonormal_pair();
    let (mut products, mut sums, mut count, mut total) = (DMat3::ZERO, DVec3::ZERO, 0.0, 0.0);
    for other in corners.iter().flatten().map(|other| *other as usize) {
        let edge = mesh.positions[other].as_dvec3() - here;
        let (length_squared, tangent) = (edge.length_squared(), [edge.dot(along), edge.dot(across)]);
        let flat = (tangent[0] * tangent[0] + tangent[1] * tangent[1]).sqrt();
        if length_squared == 0.0 || flat == 0.0 {
            continue;
        }
        let curvature = (mesh.normals[other].as_dvec3() - normal).dot(edge) / length_squared;
        let [c, s] = tangent.map(|part| part / flat);
        let row = DVec3::new(c * c, 2.0 * c * s, s * s);
        products += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
        sums += row * curvature;
        (count, total) = (count + 1.0, total + curvature);
    }
    if count == 0.0 {
        return 0.0;
    }
    // Edges in fewer than three directions leave some of the three numbers open.
    if products.determinant() <= OPEN * count * count * count {
        return total / count;
    }
    let fitted = products.inverse() * sums;
    0.5 * (fitted.x + fitted.z)
}

/// Determinants below this, for each edge, leave the fit open: for edges in evenly spread directions it is 1/64.
const OPEN: f64 = 1e-5;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    /// A grid of n × n vertices on a surface, with its normals.
    fn grid(n: u32, at: impl Fn(f64, f64) -> (DVec3, DVec3)) -> Mesh {
        let place = |index: u32| {
            let (row, column) = (f64::from(index / n), f64::from(index % n));
            // Uneven steps in both directions.
            let uneven = |step: f64| step + 0.3 * (1.7 * step).sin();
            at(uneven(row) / f64::from(n), 0.4 * uneven(column) / f64::from(n))
        };
        let (positions, normals): (Vec<Vec3>, Vec<Vec3>) =
            (0..n * n).map(place).map(|(at, normal)| (at.as_vec3(), normal.as_vec3())).unzip();
        let cells = (0..n - 1).flat_map(|row| (0..n - 1).map(move |column| row * n + column));
        let triangles = cells.flat_map(|v| [[v, v + 1, v + n + 1], [v, v + n + 1, v + n]]).collect();
        Mesh { positions, normals, triangles, origin: DVec3::ZERO }
    }

    #[test]
    fn curvatures_are_those_of_balls_cylinders_and_saddles() {
        let ball = grid(40, |u, v| {
            let normal = DVec3::new(u.cos() * v.cos(), u.sin() * v.cos(), v.sin());
            (0.25 * normal, normal)
        });
        let cylinder = grid(40, |u, v| {
            let normal = DVec3::new(u.cos(), u.sin(), 0.0);
            (2.0 * normal + DVec3::new(0.0, 0.0, v), -normal)
        });
        let saddle = grid(40, |u, v| {
            let (x, y) = (u - 0.5, v - 0.2);
            (DVec3::new(x, y, 2.0 * x * y), DVec3::new(-2.0 * y, -2.0 * x, 1.0).normalize())
        });
        for (name, mesh, expected, most) in [
            ("ball", ball, 4.0, 0.001),
            ("hollow cylinder", cylinder, -0.25, 0.001),
            ("saddle", saddle, 0.0, 0.3),
        ] {
            let found = mesh.curvatures();
            let inner = (0..1600).filter(|v| (1..39).contains(&(v / 40)) && (1..39).contains(&(v % 40)));
            for vertex in inner {
                let error = (f64::from(found[vertex]) - expected).abs();
                assert!(error < most, "{name}: {} at {}", found[vertex], mesh.positions[vertex]);
            }
        }
    }

    #[test]
    fn vertices_with_few_edges_have_finite_curvatures() {
        let positions = vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z, Vec3::ZERO];
        let mesh = Mesh {
            normals: vec![Vec3::Z; 5],
            positions,
            triangles: vec![[0, 1, 2], [0, 4, 1]],
            origin: DVec3::ZERO,
        };
        assert_eq!(mesh.curvatures(), [0.0; 5]);
    }
}
