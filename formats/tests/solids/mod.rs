//! Narrow-band level sets of solids, with the distance function from which they were made.

#![allow(dead_code, unreachable_pub, reason = "each test binary uses a part")]
#![allow(clippy::cast_possible_truncation, reason = "test numbers are small")]

use meniscus_formats::LevelSetView;

/// A narrow band in leaves, which also have values beyond the band, as a rasterizer produces them.
pub struct Solid {
    pub origins: Vec<[i32; 3]>,
    pub leaves: Vec<[f32; 512]>,
    pub half_width_voxels: f32,
    pub voxel_size: f64,
    pub distance: Box<dyn Fn([i32; 3]) -> f64 + Sync>,
}

impl Solid {
    /// Makes the leaves of a box of voxels: all leaves with a voxel in the band, and one in a hundred of the
    /// other leaves, as examples of leaves that need not be stored.
    pub fn new(
        min: i32,
        max: i32,
        half_width_voxels: f32,
        distance: impl Fn([i32; 3]) -> f64 + Sync + 'static,
    ) -> Solid {
        let mut solid = Solid {
            origins: Vec::new(),
            leaves: Vec::new(),
            half_width_voxels,
            voxel_size: 0.05,
            distance: Box::new(distance),
        };
        let range = || (min.div_euclid(8)..=max.div_euclid(8)).map(|c| c * 8);
        let mut odd = 0;
        for z in range() {
            for y in range() {
                for x in range() {
                    // Distances change by at most one per voxel, and the corner voxels of a leaf are at most
                    // 4 √3 from this centre.
                    let centre = (solid.distance)([x + 4, y + 4, z + 4]).abs();
                    odd += 1;
                    if centre < f64::from(half_width_voxels) + 8.0 || odd % 100 == 0 {
                        solid.origins.push([x, y, z]);
                        solid.leaves.push(solid.leaf([x, y, z]));
                    }
                }
            }
        }
        solid
    }

    pub fn leaf(&self, [x, y, z]: [i32; 3]) -> [f32; 512] {
        std::array::from_fn(|i| {
            let i = i as i32;
            (self.distance)([x + (i >> 6), y + (i >> 3 & 7), z + (i & 7)]) as f32
        })
    }

    pub fn view(&self) -> LevelSetView<'_> {
        LevelSetView {
            origins: &self.origins,
            leaves: &self.leaves,
            half_width_voxels: self.half_width_voxels,
            voxel_size: self.voxel_size,
            grids: &[],
        }
    }
}

pub fn norm([x, y, z]: [f64; 3]) -> f64 {
    (x * x + y * y + z * z).sqrt()
}

pub fn from([cx, cy, cz]: [f64; 3], [x, y, z]: [i32; 3]) -> [f64; 3] {
    [f64::from(x) - cx, f64::from(y) - cy, f64::from(z) - cz]
}

pub fn sphere(centre: [f64; 3], radius: f64) -> Solid {
    let reach = radius + 8.0;
    let min = centre.iter().fold(f64::MAX, |min, c| min.min(c - reach)) as i32;
    let max = centre.iter().fold(f64::MIN, |max, c| max.max(c + reach)) as i32;
    Solid::new(min, max, 3.0, move |voxel| norm(from(centre, voxel)) - radius)
}

/// A ball with a hole: outside, inside, then outside again.
pub fn shell(outer: f64, inner: f64) -> Solid {
    let reach = (outer + 8.0) as i32;
    Solid::new(-reach, reach, 3.0, move |voxel| {
        let r = norm(from([0.3, -0.2, 0.1], voxel));
        (r - outer).max(inner - r)
    })
}

pub fn cube(half_edge: f64) -> Solid {
    let reach = (half_edge + 8.0) as i32;
    Solid::new(-reach, reach, 3.0, move |voxel| {
        let q = voxel.map(|c| (f64::from(c) - 0.4).abs() - half_edge);
        norm(q.map(|c| c.max(0.0))) + q.into_iter().fold(f64::MIN, f64::max).min(0.0)
    })
}

pub fn empty() -> Solid {
    Solid::new(0, -1000, 3.0, |_| 1000.0)
}

/// All solids, by name.
pub fn all() -> Vec<(&'static str, Solid)> {
    vec![
        ("sphere", sphere([0.25, -0.5, 0.125], 20.0)),
        ("sphere across nodes", sphere([4100.5, 4090.25, 4099.0], 70.0)),
        ("negative sphere", sphere([-4097.0, -4095.5, -4096.5], 25.0)),
        ("shell", shell(60.0, 30.0)),
        ("cube", cube(90.0)),
        ("empty", empty()),
    ]
}

/// Reproducible pseudorandom numbers.
pub struct Dice(pub u64);

impl Dice {
    pub fn below(&mut self, end: usize) -> usize {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        ((self.0 >> 33) as usize) % end
    }
}
