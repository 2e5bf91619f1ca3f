//! Unions of spheres and redistancing on the dense grid, by the rules that the modules of the program
//! state.

use glam::DVec3;
use meniscus::rasterize::Radii;

use super::dense::Grid;

/// φ and the interval it may move in.
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
    let (phi, mut lower, upper) = (union(init), union(max), union(min));
    for (lower, upper) in lower.iter_mut().zip(&upper) {
        *lower = lower.min(*upper);
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

    /// Replaces φ by the distance to its zero set, keeping the sign; then the bounds hold again.
    pub(super) fn redistance(&mut self) {
        let (mut distance, mut pinned) = (vec![f64::INFINITY; self.grid.len()], vec![false; self.grid.len()]);
        for &index in &self.grid.interior {
            if let Some(known) = self.known_distance(index) {
                (distance[index], pinned[index]) = (known, true);
            }
        }
        sweep(&self.grid, &mut distance, &pinned, REDISTANCE_SWEEPS);
        for (phi, distance) in self.phi.iter_mut().zip(distance) {
            *phi = distance.min(self.half_width) * if *phi < 0.0 { -1.0 } else { 1.0 };
        }
        self.clamp();
    }

    /// The distance to the zero set, where the voxel is so near to it that φ and its slope tell.
    fn known_distance(&self, index: usize) -> Option<f64> {
        let here = self.phi[index];
        let slope = self.grid.slope(&self.phi, index);
        let faces = self.grid.faces(index);
        let beside = faces.as_flattened().iter().any(|&face| (self.phi[face] < 0.0) != (here < 0.0));
        let distance = if here == 0.0 { 0.0 } else { here.abs() / slope };
        if beside {
            return Some(distance.min(1.0));
        }
        let smooth = (0.8..1.25).contains(&slope);
        (smooth && here.abs() < 1.5 && distance < 1.5).then_some(distance)
    }
}

/// Distances to the nearest particle, where it is within reach; infinite elsewhere.
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

/// The signed distance to the union of spheres: told by the nearest centre outside and beside the
/// surface, swept elsewhere.
fn signed_distance(grid: &Grid, nearest: &[f64], radius: f64, half_width: f64) -> Vec<f64> {
    let (mut distance, mut known) = (vec![f64::INFINITY; grid.len()], vec![false; grid.len()]);
    for &index in &grid.interior {
        let outside = nearest[index] >= radius;
        let beside = grid.faces(index).as_flattened().iter().any(|&face| nearest[face] >= radius);
        if (outside && nearest[index].is_finite()) || (!outside && beside) {
            (distance[index], known[index]) = ((nearest[index] - radius).abs(), true);
        }
    }
    let sweeps = (3f64.sqrt() * half_width).ceil() as usize;
    sweep(grid, &mut distance, &known, sweeps);
    let signed = |(distance, &nearest): (f64, &f64)| {
        if nearest < radius { -distance.min(half_width) } else { distance.min(half_width) }
    };
    distance.into_iter().zip(nearest).map(signed).collect()
}

/// Sweeps distances outward from the voxels where they are known (Zhao 2005), in Jacobi order.
fn sweep(grid: &Grid, distance: &mut Vec<f64>, known: &[bool], sweep_count: usize) {
    let unknown: Vec<usize> = grid.interior.iter().copied().filter(|&index| !known[index]).collect();
    for _ in 0..sweep_count {
        let mut next = distance.clone();
        for &index in &unknown {
            let nearer = grid.faces(index).map(|[low, high]| distance[low].min(distance[high]));
            next[index] = next[index].min(eikonal(nearer));
        }
        *distance = next;
    }
}

/// The d that solves Σ max(d − neighbour, 0)² = 1, given the nearer neighbour on each axis.
fn eikonal(mut nearer: [f64; 3]) -> f64 {
    nearer.sort_by(f64::total_cmp);
    let [a, b, c] = nearer;
    let mut solution = a + 1.0;
    if solution > b {
        solution = (a + b + (2.0 - (a - b).powi(2)).sqrt()) / 2.0;
    }
    if solution > c {
        let sum = a + b + c;
        solution = (sum + (sum * sum - 3.0 * (a * a + b * b + c * c - 1.0)).sqrt()) / 3.0;
    }
    solution
}
