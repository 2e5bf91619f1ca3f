//! Restores the signed-distance property of a narrow band.
//!
//! Smoothing moves the surface but lets the slope of φ drift from one; the linear operators of the
//! smoother need it near one (paper, Fig. 10). So, now and then, every value is replaced by the
//! distance to the zero set, with its sign kept.
//!
//! ```text
//!   before   −3.0  −1.2   0.2   0.9   4.0     any slope
//!   after    −2.1  −1.1   0.1   1.0   2.0     slope one, the crossing where it was
//!                   └─pinned─┘
//! ```
//!
//! Voxels near the zero set are *pinned* to |φ| / |∇φ|, which is exact to second order where φ is
//! smooth; the others are swept outward from them by the upwind Eikonal update, in Jacobi order, so
//! that the result depends on nothing but the values. A sweep carries distances one voxel farther.
//!
//! Pinning decides how far the surface moves and how smooth it stays. Taking the nearest crossing on
//! an axis, as is common, leaves noise at the scale of the grid, which the first-order sweeps carry outward.
//! Measured on a dam break of 6 859 particles, ∫H² of the result through OpenVDB's mesher:
//!
//! ```text
//!   the nearest crossing on one axis                                283
//!   the crossings of all axes combined                              291
//!   |φ| / |∇φ| beside the sign change                               244
//!   the same, and wherever the slope is near one within 1.5 voxels  239
//! ```
//!
//! The last is done here; a redistancing then moves the zero set by 0.005 voxels in the mean.
//! Pinning farther out smooths more still, but |φ| / |∇φ| is then no longer the distance.
//!
//! This work is based on:
//! Hongkai Zhao. A fast sweeping method for Eikonal equations. 2005

use rayon::prelude::*;

use super::NarrowBand;
use crate::grid::{Field, Leaf, LeafMask, Neighborhood, ROW_COUNT, Row, Topology};

/// In place of a distance: nothing has reached this voxel yet.
pub const UNREACHED: f32 = f32::INFINITY;

/// Replaces every φ in the band by the distance to its zero set, keeping the sign. Values farther
/// than `band.half_width`, and voxels that `sweep_count` sweeps do not reach, become ± half width.
pub fn redistance(band: &mut NarrowBand, sweep_count: u32) {
    let (mut distance, pinned) = pin(band);
    extend(&band.topology, &mut distance, &pinned, sweep_count);
    let half_width = band.half_width;
    band.phi.leaves.par_iter_mut().zip(&distance.leaves).for_each(|(phi, distance)| {
        for (phi, &distance) in phi.values.iter_mut().zip(&distance.values) {
            let distance = distance.min(half_width);
            *phi = if *phi < 0.0 { -distance } else { distance };
        }
    });
}

/// Sweeps unsigned distances outward from the voxels in `fixed` (Zhao 2005, Eq. 2.3), each sweep
/// one voxel farther. Voxels that are not fixed may start at any value from above, or [`UNREACHED`].
pub fn extend(topology: &Topology, distance: &mut Field, fixed: &[LeafMask], sweep_count: u32) {
    let mut next = distance.clone();
    for _ in 0..sweep_count {
        let neighbors = topology.neighbors();
        next.leaves.par_iter_mut().zip(fixed).enumerate().for_each(|(leaf, (next, fixed))| {
            sweep_leaf(&Neighborhood::new(&distance.leaves, neighbors, leaf), fixed, next);
        });
        std::mem::swap(distance, &mut next);
    }
}

/// Beside a sign change no voxel is farther than this from the zero set.
const BESIDE_MAX: f32 = 1.0;

/// Voxels not beside a sign change are pinned up to this distance, if φ is smooth there.
const PINNED_MAX: f32 = 1.5;

/// Slopes that count as smooth: near one, as they are wherever φ was a distance before.
const SMOOTH_SLOPES: std::ops::Range<f32> = 0.8..1.25;

/// Unsigned distances of the voxels near the zero set, and which these are.
fn pin(band: &NarrowBand) -> (Field, Vec<LeafMask>) {
    let neighbors = band.topology.neighbors();
    let leaf_count = band.topology.len();
    let mut distance = Field::splat(leaf_count, UNREACHED);
    let mut pinned = vec![LeafMask::EMPTY; leaf_count];
    distance.leaves.par_iter_mut().zip(&mut pinned).enumerate().for_each(|(leaf, (distance, pinned))| {
        let around = Neighborhood::new(&band.phi.leaves, neighbors, leaf);
        for row in 0..ROW_COUNT {
            for (z, known) in pin_row(&around, row).into_iter().enumerate() {
                if let Some(known) = known {
                    distance.values[row * 8 + z] = known;
                    pinned.insert(row * 8 + z);
                }
            }
        }
    });
    (distance, pinned)
}

/// The distances of a row's voxels that can be told from φ around them.
fn pin_row(around: &Neighborhood, row: usize) -> [Option<f32>; 8] {
    let c = around.row(row);
    let [xm, xp, ym, yp] = around.side_rows(row);
    let [zm, zp] = around.shifted_rows(row);
    let slopes = around.gradient_norm(row);
    std::array::from_fn(|z| {
        let inside = c[z] < 0.0;
        let beside = [xm[z], xp[z], ym[z], yp[z], zm[z], zp[z]].iter().any(|&n| (n < 0.0) != inside);
        let distance = c[z].abs() / slopes[z];
        if beside {
            // Not 0 / 0: a zero in a flat place is the zero set.
            Some(if c[z] == 0.0 { 0.0 } else { distance.min(BESIDE_MAX) })
        } else {
            (SMOOTH_SLOPES.contains(&slopes[z]) && c[z].abs() < PINNED_MAX && distance < PINNED_MAX)
                .then_some(distance)
        }
    })
}

fn sweep_leaf(around: &Neighborhood, fixed: &LeafMask, next: &mut Leaf) {
    for row in 0..ROW_COUNT {
        let old = around.row(row);
        let fixed = fixed.row(row);
        let updated = if fixed == u8::MAX { *old } else { upwind_row(around, row) };
        let next = &mut next.values[row * 8..row * 8 + 8];
        for z in 0..8 {
            next[z] = if fixed >> z & 1 == 1 { old[z] } else { old[z].min(updated[z]) };
        }
    }
}

/// The upwind solution of |∇d| = 1 at each voxel of a row from its six neighbours.
fn upwind_row(around: &Neighborhood, row: usize) -> Row {
    let [xm, xp, ym, yp] = around.side_rows(row);
    let [zm, zp] = around.shifted_rows(row);
    std::array::from_fn(|z| {
        let (a, b, c) = sorted(xm[z].min(xp[z]), ym[z].min(yp[z]), zm[z].min(zp[z]));
        // Relative to the nearest neighbour, so that nothing large is squared.
        let (b_rel, c_rel) = (b - a, c - a);
        let one = a + 1.0;
        let two = a + 0.5 * (b_rel + (2.0 - b_rel * b_rel).max(0.0).sqrt());
        let sum = b_rel + c_rel;
        let three =
            a + (sum + (sum * sum - 3.0 * (b_rel * b_rel + c_rel * c_rel - 1.0)).max(0.0).sqrt()) / 3.0;
        if one <= b {
            one
        } else if two <= c {
            two
        } else {
            three
        }
    })
}

fn sorted(x: f32, y: f32, z: f32) -> (f32, f32, f32) {
    let (low, high) = (x.min(y), x.max(y));
    let middle = low.max(z);
    (low.min(z), middle.min(high), middle.max(high))
}
