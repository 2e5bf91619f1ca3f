//! Smooths vertex normals.
//!
//! ```text
//!        c ─── b
//!       ╱ ╲   ╱ ╲        the normals over the triangles of v, interpolated linearly on each, averaged with a weight
//!      d ── v ── a       that falls from 1 at v to 0 at its neighbors:
//!       ╲   │   ╱
//!        ── e ──         n ← Σ area · (2 n(v) + n(next) + n(prev))
//! ```
//!
//! The weights are positive, and half of their sum belongs to v itself, so further rounds smooth more and
//! never amplify noise. Positions do not change, only shading. The result does not depend on the number of
//! threads, and each round extends the influence of a normal by one edge.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::corners::{Corners, TouchingTriangles};
use super::{CHUNK, Mesh};
use crate::interrupt::checkpoint;
use crate::parallel::Loops as _;

impl Mesh {
    /// Averages each normal with its neighbors, `rounds` times. Normals stay unit vectors; a normal whose
    /// average vanishes is left unchanged.
    ///
    /// Panics if a triangle refers to a vertex that does not exist or has no normal.
    pub fn smooth_normals(&mut self, rounds: u32) {
        if rounds == 0 {
            return;
        }
        let touching = TouchingTriangles::new(self);
        for _ in 0..rounds {
            checkpoint();
            let mut smoothed = self.normals.clone();
            let chunks = smoothed.par_chunks_mut(CHUNK).enumerate();
            chunks.halved().for_each_init(Corners::default, |corners, (chunk, smoothed)| {
                let first = chunk * CHUNK;
                corners.collect(first as u32, smoothed.len(), touching.triangles(self, chunk));
                for (index, normal) in smoothed.iter_mut().enumerate() {
                    *normal = self.average(first + index, corners.of(index)).unwrap_or(*normal);
                }
            });
            self.normals = smoothed;
        }
    }

    /// The average of the normals around a vertex with corners `[next, prev]`; `None` if it vanishes.
    fn average(&self, vertex: usize, corners: &[[u32; 2]]) -> Option<Vec3> {
        // 64 bits, so that areas in any unit are in range.
        let to = |other: u32| self.positions[other as usize].as_dvec3() - self.positions[vertex].as_dvec3();
        let normal = |vertex: u32| self.normals[vertex as usize].as_dvec3();
        let mut sum = DVec3::ZERO;
        for &[next, prev] in corners {
            let area = to(next).cross(to(prev)).length();
            sum += area * (2.0 * normal(vertex as u32) + normal(next) + normal(prev));
        }
        Some(sum.try_normalize()?.as_vec3())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sphere of subdivided triangles with normals that are off by up to about 20°.
    fn rough_ball() -> Mesh {
        let mut mesh = Mesh::default();
        let (rows, columns) = (60u32, 120u32);
        for row in 0..=rows {
            for column in 0..columns {
                let polar = std::f32::consts::PI * (row as f32 + 0.5) / (rows as f32 + 1.0);
                let around = std::f32::consts::TAU * column as f32 / columns as f32;
                let outward = Vec3::new(polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos());
                let noise = |seed: u32| ((row * 7919 + column * 104_729 + seed) as f32).sin();
                mesh.positions.push(outward);
                mesh.normals.push((outward + 0.25 * Vec3::new(noise(1), noise(2), noise(3))).normalize());
            }
        }
        for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
            let [a, b] = [column, (column + 1) % columns].map(|column| row * columns + column);
            mesh.triangles.extend([[a, a + columns, b], [b, a + columns, b + columns]]);
        }
        mesh
    }

    fn roughness(mesh: &Mesh) -> f32 {
        let off = mesh
            .normals
            .iter()
            .zip(&mesh.positions)
            .map(|(normal, outward)| normal.distance_squared(*outward));
        (off.sum::<f32>() / mesh.normals.len() as f32).sqrt()
    }

    #[test]
    fn smoothing_reduces_noise_and_keeps_unit_length() {
        let rough = rough_ball();
        let mut before = roughness(&rough);
        assert!(before > 0.2);
        for rounds in [1, 3, 10] {
            let mut mesh = rough.clone();
            mesh.smooth_normals(rounds);
            assert!(roughness(&mesh) < 0.75 * before, "{rounds}: {} {before}", roughness(&mesh));
            before = roughness(&mesh);
            assert!(mesh.normals.iter().all(|normal| (normal.length() - 1.0).abs() < 1e-6));
            assert!(mesh.positions == rough.positions && mesh.triangles == rough.triangles);
        }
        let threads = |count: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build().expect("a thread pool");
            let mut mesh = rough.clone();
            pool.install(|| mesh.smooth_normals(4));
            mesh
        };
        assert!(threads(1) == threads(3));
        let mut same = rough.clone();
        same.smooth_normals(0);
        assert!(same == rough);
    }

    #[test]
    fn normals_without_average_are_unchanged() {
        let mesh = |triangles: &[[u32; 3]]| Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::NAN, Vec3::ONE],
            normals: vec![Vec3::Z, Vec3::NEG_Z, Vec3::NEG_Z, Vec3::X, Vec3::Y],
            triangles: triangles.to_vec(),
            ..Mesh::default()
        };
        // Two pairs that cancel, and vertices without triangles.
        let mut cancelling = mesh(&[[0, 1, 2]]);
        cancelling.smooth_normals(1);
        assert_eq!(cancelling.normals[0], Vec3::Z);
        assert_eq!(cancelling.normals[3..], [Vec3::X, Vec3::Y]);
        let mut degenerate = mesh(&[[0, 1, 2], [0, 3, 1], [2, 2, 0]]);
        degenerate.smooth_normals(3);
        assert!(
            degenerate.normals.iter().all(|normal| (normal.length() - 1.0).abs() < 1e-6),
            "{degenerate:?}"
        );
    }
}
