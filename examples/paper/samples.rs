//! Particles within a body, and points on its surface.

use glam::{DVec3, IVec3};

use super::flow::Flow;

/// The points of a cubic lattice that are inside, about so many, and their spacing.
pub(crate) fn particles_in(flow: Flow, count: usize) -> (Vec<DVec3>, f64) {
    // The volume tells the spacing; and a first lattice tells the volume.
    let first = 0.15 / 40.0;
    let volume = inside(flow, first).len() as f64 * first.powi(3);
    let spacing = (volume / count as f64).cbrt();
    (inside(flow, spacing), spacing)
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

/// Points on a surface about the body at first, of which the distances are given: so many or, where it is open, fewer, evenly on a
/// spiral around its middle.
pub(crate) fn on_surface(flow: Flow, count: usize, distance: impl Fn(DVec3) -> f64) -> Vec<DVec3> {
    let [low, high] = flow.bounds();
    let (middle, radius) = (0.5 * (low + high), 0.5 * (high - low).max_element());
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let on_sphere = |index: usize| {
        let z = 1.0 - (2.0 * index as f64 + 1.0) / count as f64;
        let (sine, cosine) = (golden * index as f64).sin_cos();
        DVec3::new((1.0 - z * z).sqrt() * cosine, (1.0 - z * z).sqrt() * sine, z)
    };
    (0..count).filter_map(|index| towards(&distance, middle, on_sphere(index), radius)).collect()
}

/// Where a ray from outside meets it; `None` for one that comes to the middle through an opening.
fn towards(distance: &impl Fn(DVec3) -> f64, middle: DVec3, direction: DVec3, radius: f64) -> Option<DVec3> {
    let mut left = 1.5 * radius;
    // Distances are never too long, so no step leads through the surface.
    while left > 0.0 {
        let step = distance(middle + left * direction);
        if step < 1e-9 * radius {
            return Some(middle + left * direction);
        }
        left -= step;
    }
    None
}

/// Numbers that come out the same everywhere.
///
/// Melissa E. O'Neill. PCG: A Family of Simple Fast Space-Efficient Statistically Good Algorithms for Random Number Generation.
/// 2014
pub(crate) struct Random {
    state: u64,
}

impl Random {
    /// Others for another seed.
    pub(crate) fn new(seed: u64) -> Random {
        let mut random = Random { state: seed };
        random.unit();
        random
    }

    /// From 0 to 1.
    pub(crate) fn unit(&mut self) -> f64 {
        self.state =
            self.state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let word = ((self.state >> 18 ^ self.state) >> 27) as u32;
        f64::from(word.rotate_right((self.state >> 59) as u32)) / 2f64.powi(32)
    }

    /// Anywhere in a ball around the origin.
    pub(crate) fn in_ball(&mut self, radius: f64) -> DVec3 {
        loop {
            let point = 2.0 * DVec3::from_array([(); 3].map(|()| self.unit())) - 1.0;
            if point.length() <= 1.0 {
                return radius * point;
            }
        }
    }
}
