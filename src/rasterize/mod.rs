//! Particles to level sets: the union of spheres, three times (paper, Eq. 1 and 2).
//!
//! ```text
//!      r_max ─────────────    S_max    φ_max = lower bound of φ
//!     r_init ─ ─ ─ ─ ─ ─ ─    S_0      φ_0   = where smoothing starts
//!      r_min ─────────────    S_min    φ_min = upper bound of φ
//!                  ●          particle
//! ```
//!
//! Outside a union of equal spheres, the distance to the nearest centre less the radius is the
//! exact signed distance, and is kept as it is. Inside it is not: it saturates at about half the
//! spacing of the particles. There only the voxels beside the surface keep it, and the others are
//! swept from them. So the zero sets of the bounds are those of the spheres themselves.

mod bin;
mod footprint;
mod sphere;

use std::sync::Arc;

use glam::IVec3;
use rayon::prelude::*;

pub use bin::ParticleBins;
pub use footprint::{Footprint, footprint};

use crate::grid::{Field, LEAF_EDGE, Leaf, LeafMask, Neighborhood, ROW_COUNT, Topology, voxel_in_leaf};
use crate::level_set::{Bounds, NarrowBand, Sweeps, UNREACHED, extend};
use crate::space::CoordBox;
use sphere::{OUT_OF_REACH, nearest_distances};

/// The radii of the three unions of spheres, in voxels: `min` ≤ `init` ≤ `max`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Radii {
    /// r_min: the surface stays outside these.
    pub min: f32,
    /// r_init: where it starts.
    pub init: f32,
    /// r_max: the surface stays inside these.
    pub max: f32,
}

/// Exact distances are kept so far beyond r_max, in voxels; farther ones are swept.
const EXACT_MARGIN: f32 = 2.0;

impl Radii {
    /// Half the thickness of the band that smoothing may need (Eq. 7), in voxels: it reads values
    /// up to 5 voxels from the surface, and the surface may move to either bound.
    pub fn half_width(&self) -> f32 {
        // Radii that differ by whole voxels but for rounding need no voxel more.
        5.0 + ((self.max - self.init).max(self.init - self.min) - 1e-4).max(0.0).ceil()
    }

    /// How far a particle can change φ_0 and the bounds, in voxels: its exact distances; φ_0 swept from
    /// them, two voxels a sweep; the leaves that come and go with φ_0; and the bounds swept on those.
    pub fn reach_voxels(&self) -> u32 {
        let swept = 2 * sweep_count(self.half_width());
        (self.max + EXACT_MARGIN).ceil() as u32 + swept + 2 * LEAF_EDGE as u32 + swept
    }
}

/// The band around the initial surface, with φ_0, and the bounds on the same leaves.
pub fn rasterize(bins: &ParticleBins, radii: Radii) -> (NarrowBand, Bounds) {
    let (reached, nearest) = nearest_distances(bins, radii.max + EXACT_MARGIN);
    let half_width = radii.half_width();
    let topology = Topology::new(leaves_near_surface(&reached, &nearest, radii.init, half_width as i32 + 1));
    let nearest = restrict(&reached, &nearest, &topology);
    let phi = signed_distance(&topology, &nearest, radii.init, half_width);
    let (topology, kept) = prune(&topology, &phi, half_width);
    let keep = |field: &Field| Field { leaves: kept.par_iter().map(|&leaf| field.leaves[leaf]).collect() };
    let (phi, nearest) = (keep(&phi), keep(&nearest));
    let mut bounds = Bounds {
        lower: signed_distance(&topology, &nearest, radii.max, half_width),
        upper: signed_distance(&topology, &nearest, radii.min, half_width),
    };
    order(&mut bounds);
    let mut band = NarrowBand { topology: Arc::new(topology), phi, half_width };
    bounds.clamp(&mut band.phi);
    (band, bounds)
}

/// Origins of all leaves with a voxel within `margin` voxels, on every axis, of a change of sign of
/// `nearest − radius`; with duplicates.
fn leaves_near_surface(topology: &Topology, nearest: &Field, radius: f32, margin: i32) -> Vec<IVec3> {
    let near = |(leaf, &origin): (usize, &IVec3)| {
        let around = Neighborhood::new(&nearest.leaves, topology.neighbors(), leaf);
        // Beyond a leaf that is not stored no particle is within reach: outside.
        let open = topology.neighbors()[leaf].map(|neighbor| neighbor == crate::grid::NO_LEAF);
        let mut surface = CoordBox::EMPTY;
        for row in 0..ROW_COUNT {
            for z in bits(crossings(&around, row, radius) | border_crossings(&around, row, open, radius)) {
                surface.include(voxel_in_leaf(row * 8 + z));
            }
        }
        leaves_of_box(origin, surface, margin)
    };
    topology.origins().par_iter().enumerate().flat_map_iter(near).collect()
}

/// The bits of a row's voxels inside the sphere union that have a face neighbour outside.
fn crossings(around: &Neighborhood, row: usize, radius: f32) -> u8 {
    let c = around.row(row);
    let [xm, xp, ym, yp] = around.side_rows(row);
    let [zm, zp] = around.shifted_rows(row);
    (0..8).fold(0, |found, z| {
        let outside = [xm[z], xp[z], ym[z], yp[z], zm[z], zp[z]].iter().any(|&n| n >= radius);
        found | u8::from(c[z] < radius && outside) << z
    })
}

/// The bits of a row's inside voxels on a face of the leaf beyond which there is no leaf.
fn border_crossings(around: &Neighborhood, row: usize, open: [bool; 6], radius: f32) -> u8 {
    let (x, y) = (row >> 3, row & 7);
    let whole = (open[0] && x == 0) || (open[1] && x == 7) || (open[2] && y == 0) || (open[3] && y == 7);
    let ends = if whole { 0xff } else { u8::from(open[4]) | u8::from(open[5]) << 7 };
    let inside = around.row(row).iter().enumerate().fold(0, |bits, (z, &d)| bits | u8::from(d < radius) << z);
    inside & ends
}

fn bits(byte: u8) -> impl Iterator<Item = usize> {
    (0..8).filter(move |bit| byte >> bit & 1 == 1)
}

/// Origins of the leaves that a box, given relative to `origin` and grown by `margin`, touches.
fn leaves_of_box(origin: IVec3, voxels: CoordBox, margin: i32) -> Vec<IVec3> {
    if voxels.is_empty() {
        return Vec::new();
    }
    let grown = voxels.expanded(margin);
    let edge = IVec3::splat(LEAF_EDGE);
    let (first, last) = (grown.min.div_euclid(edge), grown.max.div_euclid(edge));
    let mut origins = Vec::new();
    for x in first.x..=last.x {
        for y in first.y..=last.y {
            origins.extend((first.z..=last.z).map(|z| origin + IVec3::new(x, y, z) * LEAF_EDGE));
        }
    }
    origins
}

/// The field on other leaves: [`OUT_OF_REACH`] where it has none.
fn restrict(from: &Topology, field: &Field, to: &Topology) -> Field {
    let leaf =
        |&origin: &IVec3| from.find(origin).map_or(Leaf::splat(OUT_OF_REACH), |leaf| field.leaves[leaf]);
    Field { leaves: to.origins().par_iter().map(leaf).collect() }
}

/// The signed distance to the union of spheres of this radius, within ± half width.
fn signed_distance(topology: &Topology, nearest: &Field, radius: f32, half_width: f32) -> Field {
    let (mut distance, fixed) = known_distances(topology, nearest, radius);
    extend(topology, &mut distance, &fixed, Sweeps::accurate(sweep_count(half_width)));
    distance.leaves.par_iter_mut().for_each(|distance| {
        for distance in &mut distance.values {
            *distance = distance.clamp(-half_width, half_width);
        }
    });
    distance
}

/// Sweeps after which every voxel within the half width has its distance: a sweep goes one voxel
/// along the axes, and the diagonal is √3 as long.
fn sweep_count(half_width: f32) -> u32 {
    (3f32.sqrt() * half_width).ceil() as u32
}

/// Signed distances where the nearest centre tells them (outside, and beside the surface), and which
/// voxels these are; elsewhere the sign only.
fn known_distances(topology: &Topology, nearest: &Field, radius: f32) -> (Field, Vec<LeafMask>) {
    let known = |leaf: usize| {
        let around = Neighborhood::new(&nearest.leaves, topology.neighbors(), leaf);
        let mut distance = Leaf::splat(0.0);
        let mut fixed = LeafMask::EMPTY;
        for row in 0..ROW_COUNT {
            let beside = crossings(&around, row, radius);
            for (z, &nearest) in around.row(row).iter().enumerate() {
                let outside = nearest >= radius && nearest != OUT_OF_REACH;
                if outside || beside >> z & 1 == 1 {
                    distance.values[row * 8 + z] = nearest - radius;
                    fixed.insert(row * 8 + z);
                } else {
                    distance.values[row * 8 + z] = if nearest < radius { -UNREACHED } else { UNREACHED };
                }
            }
        }
        (distance, fixed)
    };
    let (leaves, fixed) = (0..topology.len()).into_par_iter().map(known).unzip();
    (Field { leaves }, fixed)
}

/// The topology of the leaves that hold a value nearer than the half width, and their places in
/// the old one.
fn prune(topology: &Topology, phi: &Field, half_width: f32) -> (Topology, Vec<usize>) {
    let near = |&leaf: &usize| phi.leaves[leaf].values.iter().any(|phi| phi.abs() < half_width);
    let kept: Vec<usize> = (0..topology.len()).into_par_iter().filter(near).collect();
    (Topology::new(kept.iter().map(|&leaf| topology.origins()[leaf]).collect()), kept)
}

/// Makes `lower` ≤ `upper` at every voxel, which sweeping each by itself does not promise.
fn order(bounds: &mut Bounds) {
    bounds.lower.leaves.par_iter_mut().zip(&bounds.upper.leaves).for_each(|(lower, upper)| {
        for (lower, upper) in lower.values.iter_mut().zip(&upper.values) {
            *lower = lower.min(*upper);
        }
    });
}
