//! Unions of spheres and redistancing on the dense grid, by the rules in the documentation of the program's
//! modules.

use glam::DVec3;
use meniscus_surface::rasterize::Radii;

use super::dense::Grid;

/// φ, and the interval in which it may move.
pub(super) struct LevelSet {
    pub(super) grid: Grid,
    pub(super) phi: Vec<f64>,
    pub(super) lower: Vec<f64>,
    pub(super) upper: Vec<f64>,
    half_width: f64,
}

/// Jacobi sweeps of a redistancing (paper, §3.4).
const REDISTANCE_SWEEPS: usize = 8;

/// The three unions of spheres (paper, Eq. 1 and 2) as signed distances.
pub(super) fn rasterized(positions: &[DVec3], radii: Radii) -> LevelSet {
    let [min, init, max] = [radii.min, radii.init, radii.max].map(f64::from);
    let half_width = f64::from(radii.half_width());
    let grid = Grid::around(positions);
    let nearest = nearest_distances(&grid, positions, max + 2.0);
    let union = |radius| signed_distance(&grid, &nearest, radius, half_width);
    let (phi, mut lower, mut upper) = (union(init), union(max), union(min));
    // Bounds are open where they are farther than this from their zero sets.
    const REACH: f64 = 1.5;
    for (lower, upper) in lower.iter_mut().zip(&mut upper) {
        *upper = if *upper > REACH { half_width } else { upper.max(-REACH) };
        *lower = if *lower < -REACH { -half_width } else { lower.min(REACH) }.min(*upper);
    }
    let mut level_set = LevelSet { grid, phi, lower, upper, half_width };
    level_set.clamp();
    level_set
}

impl LevelSet {
    /// Moves every value into its interval (paper, Eq. 6).
    pub(super) fn clamp(&mut self) {
        for ((phi, lower), upper) in self.phi.iter_mut().zip(&self.lower).zip(&self.upper) {
            *phi = upper.min(lower.max(*phi));
        }
    }

    /// The last operation on a result: moves values that are nearer to zero than 1/128 voxel away from zero,
    /// as far as their bounds allow.
    pub(super) fn keep_off_zero(&mut self) {
        for phi in self.phi.iter_mut().filter(|phi| phi.abs() < 1.0 / 128.0) {
            *phi = (1.0f64 / 128.0).copysign(*phi);
        }
        self.clamp();
    }

    /// Replaces φ by the signed distance from its zero set, and then clamps it to its bounds. Differences to
    /// neighbours that are nearer to the surface than this many voxels are of second order.
    pub(super) fn redistance(&mut self, second_order_within: f64) {
        let sign = |phi: f64| if phi < 0.0 { -1.0 } else { 1.0 };
        let mut distance: Vec<f64> = self.phi.iter().map(|&phi| sign(phi) * f64::INFINITY).collect();
        let mut pinned = vec![false; self.grid.len()];
        for &index in &self.grid.interior {
            if let Some(known) = self.known_distance(index) {
                (distance[index], pinned[index]) = (sign(self.phi[index]) * known, true);
            }
        }
        sweep(&self.grid, &mut distance, &pinned, REDISTANCE_SWEEPS, second_order_within);
        self.phi =
            distance.iter().map(|distance| distance.clamp(-self.half_width, self.half_width)).collect();
        self.clamp();
    }

    /// The distance from the zero set, if the voxel is near enough to estimate it from φ and its slope.
    fn known_distance(&self, index: usize) -> Option<f64> {
        let here = self.phi[index];
        let slope = self.grid.slope(&self.phi, index);
        let faces = self.grid.faces(index);
        let is_adjacent = faces.as_flattened().iter().any(|&face| (self.phi[face] < 0.0) != (here < 0.0));
        // A neighbour is one voxel away. Beyond the surface it counts as distance 0.
        let side = if here < 0.0 { -1.0 } else { 1.0 };
        let nearest = faces.as_flattened().iter().map(|&face| (side * self.phi[face]).max(0.0));
        let farthest = 1.0 + nearest.fold(f64::INFINITY, f64::min);
        let distance = if here == 0.0 { 0.0 } else { (here.abs() / slope).min(farthest) };
        is_adjacent.then_some(distance)
    }
}

/// Distances from the nearest particle; infinite if it is farther than `reach`.
fn nearest_distances(grid: &Grid, positions: &[DVec3], reach: f64) -> Vec<f64> {
    let mut nearest = vec![f64::INFINITY; grid.len()];
    for &position in positions {
        let (low, high) = ((position - reach).floor().as_ivec3(), (position + reach).ceil().as_ivec3());
        for (voxel, index) in grid.voxels_between(low, high) {
            let distance = voxel.as_dvec3().distance(position);
            if distance <= reach {
                nearest[index] = nearest[index].min(distance);
            }
        }
    }
    nearest
}

/// The signed distance to the union of spheres: computed from the nearest centre outside and near the
/// surface, swept elsewhere.
fn signed_distance(grid: &Grid, nearest: &[f64], radius: f64, half_width: f64) -> Vec<f64> {
    let side = |nearest: &f64| if *nearest < radius { -f64::INFINITY } else { f64::INFINITY };
    let mut distance: Vec<f64> = nearest.iter().map(side).collect();
    let mut known = vec![false; grid.len()];
    for &index in &grid.interior {
        let outside = nearest[index] >= radius;
        let is_adjacent = grid.faces(index).as_flattened().iter().any(|&face| nearest[face] >= radius);
        if (outside && nearest[index].is_finite()) || (!outside && is_adjacent) {
            (distance[index], known[index]) = (nearest[index] - radius, true);
        }
    }
    let sweeps = (3f64.sqrt() * half_width).ceil() as usize;
    sweep(grid, &mut distance, &known, sweeps, f64::INFINITY);
    distance.into_iter().map(|distance| distance.clamp(-half_width, half_width)).collect()
}

/// Sweeps signed distances outward from the voxels where they are known, in Jacobi order.
fn sweep(grid: &Grid, distance: &mut Vec<f64>, known: &[bool], sweep_count: usize, second_order_within: f64) {
    let unknown: Vec<usize> = grid.interior.iter().copied().filter(|&index| !known[index]).collect();
    for _ in 0..sweep_count {
        let mut next = distance.clone();
        for &index in &unknown {
            let side = distance[index].signum();
            let slopes = grid.faces(index).map(|faces| {
                let [low, high] = faces.map(|face| side * distance[face]);
                let nearer = if high < low { faces[1] } else { faces[0] };
                one_sided(low.min(high), side * distance[2 * nearer - index], second_order_within)
            });
            next[index] = side * eikonal(slopes);
        }
        *distance = next;
    }
}

/// The slope from the nearer neighbour on an axis, as (d − from) / step. The slope is of second order,
/// (3 d − 4 near + far) / 2, if the neighbour is near enough to the surface, and its neighbour even nearer.
fn one_sided(near: f64, far: f64, second_order_within: f64) -> [f64; 2] {
    if far <= near && near < second_order_within {
        [(4.0 * near - far) / 3.0, 2.0 / 3.0]
    } else {
        [near, 1.0]
    }
}

/// The d at which the squares of the slopes add up to one, over the axes whose neighbours are below d.
fn eikonal(mut slopes: [[f64; 2]; 3]) -> f64 {
    slopes.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let mut solution = f64::INFINITY;
    // W d² − 2 A d + B = 1
    let (mut w, mut a, mut b) = (0.0, 0.0, 0.0);
    for [from, step] in slopes {
        if solution <= from {
            break;
        }
        let weight = 1.0 / (step * step);
        (w, a, b) = (w + weight, a + weight * from, b + weight * from * from);
        solution = (a + (a * a - w * (b - 1.0)).sqrt()) / w;
    }
    solution
}
