//! Samples: particles in a body, and points on a mesh.

use glam::{DVec3, IVec3};
use meniscus_formats::MeshData;

use super::flow::Flow;

/// About `count` points of a cubic lattice inside a body, and their spacing.
pub(crate) fn particles_in(flow: Flow, count: usize) -> (Vec<DVec3>, f64) {
    let mut spacing = 0.15 / 20.0;
    let mut nearest = (inside(flow, spacing), spacing);
    // The number of points of each lattice gives the spacing of the next. The number jumps by whole layers of
    // points, so the last lattice is not always the closest to `count`: keep the best.
    for _ in 0..20 {
        let points = inside(flow, spacing);
        let found = points.len();
        if found.abs_diff(count) < nearest.0.len().abs_diff(count) {
            nearest = (points, spacing);
        }
        spacing *= (found as f64 / count as f64).cbrt();
    }
    nearest
}

fn inside(flow: Flow, spacing: f64) -> Vec<DVec3> {
    let [low, high] = flow.bounds();
    let [low, high] = [low, high].map(|corner| (corner / spacing).floor().as_ivec3());
    let mut points = Vec::new();
    for z in low.z..=high.z {
        for y in low.y..=high.y {
            for x in low.x..=high.x {
                let point = (IVec3::new(x, y, z).as_dvec3() + 0.5) * spacing;
                if flow.distance(point) < -0.5 * spacing {
                    points.push(point);
                }
            }
        }
    }
    points
}

/// `count` points on a mesh, distributed evenly by area.
pub(crate) fn on_mesh(mesh: &MeshData, count: usize) -> Vec<DVec3> {
    let corners = |triangle: &[u32; 3]| triangle.map(|vertex| DVec3::from(mesh.positions[vertex as usize]));
    let area = |triangle: &[u32; 3]| {
        let [a, b, c] = corners(triangle);
        0.5 * (b - a).cross(c - a).length()
    };
    let total: f64 = mesh.triangles.iter().map(area).sum();
    let mut points = Vec::with_capacity(count);
    let mut passed = 0.0;
    for triangle in &mesh.triangles {
        passed += area(triangle);
        while points.len() < count && (points.len() as f64 + 0.5) * total <= passed * count as f64 {
            let [a, b, c] = corners(triangle);
            let [mut u, mut v] = SPREAD.map(|step| (step * points.len() as f64).fract());
            if u + v > 1.0 {
                (u, v) = (1.0 - u, 1.0 - v);
            }
            points.push(a + u * (b - a) + v * (c - a));
        }
    }
    points
}

/// The inverse of the plastic number, and its square: the fractional parts of their multiples fill a square
/// evenly.
const SPREAD: [f64; 2] = [0.754_877_666_246_692_7, 0.569_840_290_998_053_2];

/// A generator of random numbers that are the same on all machines.
///
/// Melissa E. O'Neill. PCG: A Family of Simple Fast Space-Efficient Statistically Good Algorithms for Random
/// Number Generation. 2014
pub(crate) struct Random {
    state: u64,
}

impl Random {
    /// A generator; each seed gives a different sequence.
    pub(crate) fn new(seed: u64) -> Random {
        let mut random = Random { state: seed };
        random.unit();
        random
    }

    /// A number from 0 to 1.
    pub(crate) fn unit(&mut self) -> f64 {
        self.state =
            self.state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let word = ((self.state >> 18 ^ self.state) >> 27) as u32;
        f64::from(word.rotate_right((self.state >> 59) as u32)) / 2f64.powi(32)
    }

    /// A uniformly distributed point in a ball around the origin.
    pub(crate) fn in_ball(&mut self, radius: f64) -> DVec3 {
        loop {
            let point = 2.0 * DVec3::from_array([(); 3].map(|()| self.unit())) - 1.0;
            if point.length() <= 1.0 {
                return radius * point;
            }
        }
    }
}
