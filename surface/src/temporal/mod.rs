//! Averages the level set of a frame with those of the frames before and after it, along the motion of the
//! particles.
//!
//! ```text
//!   frame t − 1            frame t              frame t + 1
//!     φ(x − u⁻)    ◀──────    x    ──────▶      φ(x + u⁺)       the particles carry a voxel x to both
//!         ⅓                   ⅓                     ⅓           equal weights
//! ```
//!
//! What a surface does not share with its neighbours in time is mostly noise of the reconstruction. The
//! particles carry the surface, so the noise can be averaged along their motion without moving the fluid:
//!
//! φ(x) += w Σ c_k(x) (φ_k(x + u_k(x)) − φ(x))
//!
//! Here w is 1 / (2 N + 1), u_k the mean displacement of the particles around x to the frame k steps away,
//! and c_k the confidence. The confidence falls to zero where particles appear or vanish, where the
//! displacements of neighbouring particles scatter, and where the level sets disagree by up to two spacings:
//! there the topology changes, ids were used again, or velocities are much too large.
//!
//! A voxel comes inside only beside one that was inside, so that nearly no piece appears where the frame has
//! no fluid: one remains only if the voxels beside it leave at the same time, or if restoring distances parts
//! it. `docs/results.md` has the measured number.
//!
//! The caller restores distances afterwards, and clamps φ to the bounds of the frame. So the guarantees are
//! those of a frame alone.
//!
//! Invariants: a voxel depends on its own particles within 2 d, or, if there are none, on the nearest within
//! 2 d + 4 h, of its nodes or of the points of the surface nearest to them (`TemporalConfig::reach_voxels`);
//! and on φ_k within two voxels of where they carry it. The result does not depend on the number of threads.
//! Without other frames, nothing changes.

mod moves;

use std::sync::Arc;

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::attributes::{BandAttribute, Support, interpolate_to_band};
use crate::cancel::checkpoint;
use crate::grid::{LEAF_VOXELS, Leaf, LeafMask, NO_LEAF, negative_masks, voxel_in_leaf};
use crate::level_set::{NarrowBand, Sampler};
use crate::motion::{MovingParticles, TrackedParticles};
use crate::parallel::Loops as _;
use crate::particles::{Attribute, Positions, Shapes};
use crate::space::Lattice;
use moves::{COMPONENTS, moves};

/// The most frames on each side that may be averaged.
pub const FRAMES_MAX: u32 = 3;

/// Radius of the mean displacement, in spacings.
const RADII: f64 = 2.0;

/// Voxels up to this far from the surface are averaged.
const HALF_WIDTH: f32 = 4.0;

/// The confidence falls smoothly from one to zero while its argument rises from the first to the second of
/// these numbers. Standard deviation of the displacements around a voxel, in spacings.
const SCATTER: [f32; 2] = [1.0, 2.0];

/// Difference between the level sets, in spacings. The second number is smaller if the band is too narrow for
/// such a difference: values at its ends are farther from the surface than they say.
const DISAGREEMENT: [f32; 2] = [1.0, 2.0];

/// Share of the particles around a voxel, by weight, that cannot be followed.
const LOST: [f32; 2] = [0.1, 0.5];

/// A frame with which its neighbours in time are averaged: its own level set, and its particles as given.
pub struct TimedFrame {
    band: Arc<NarrowBand>,
    particles: TrackedParticles,
}

impl TimedFrame {
    /// A frame from its smoothed level set, and its particles; `spacing` is their distance, world units.
    pub fn new(band: Arc<NarrowBand>, particles: MovingParticles, spacing: f64) -> TimedFrame {
        TimedFrame { band, particles: TrackedParticles::new(particles, RADII * spacing) }
    }

    /// Memory used, in bytes: approximate for the particles, which are sorted and have ids or velocities.
    pub fn size_bytes(&self) -> u64 {
        const LEAF_BYTES: usize = size_of::<Leaf>() + 80;
        const PARTICLE_BYTES: usize = 24 + 16 + 24;
        let particle_count = self.particles.positions().len();
        (self.band.phi.leaves.len() * LEAF_BYTES + particle_count * PARTICLE_BYTES) as u64
    }
}

/// Another frame of the sequence.
#[derive(Clone)]
pub struct OtherFrame {
    /// The frame.
    pub frame: Arc<TimedFrame>,
    /// By how many frames it is later; negative if it is earlier.
    pub steps: i32,
}

/// Those of the frames that have particles: with the rest, nothing can be averaged.
pub fn with_particles(others: &[OtherFrame]) -> impl Iterator<Item = &OtherFrame> {
    others.iter().filter(|other| !other.frame.particles.positions().is_empty())
}

/// What averaging needs besides the frames.
#[derive(Clone, Copy, Debug)]
pub struct TemporalConfig {
    /// The number of frames on each side: 1 to [`FRAMES_MAX`].
    pub frames: u32,
    /// Seconds between two frames, for particles without ids; `None` if it is unknown.
    pub seconds: Option<f64>,
    /// The particle spacing, world units.
    pub spacing: f64,
    /// The lattice of the level sets.
    pub lattice: Lattice,
}

impl TemporalConfig {
    /// The weight of each of the 2 N + 1 frames.
    fn weight(&self) -> f32 {
        ((2 * self.frames + 1) as f32).recip()
    }

    fn spacing_voxels(&self) -> f32 {
        (self.spacing / self.lattice.voxel_size) as f32
    }

    /// How far a change of one particle of the frame can change its averaged level set, in voxels, if it can
    /// change the smoothed one, in a band of this half width, up to `smoothed` voxels away. It has an effect
    /// farther away only if another particle has its id, or if it decides whether ids are used, or whether
    /// anything changes at all.
    ///
    /// ```text
    ///   voxel ── 1 ── node ── half width ── point of the surface ── 2 d, or 2 d + 4 h ── particle
    ///              └── 1 ── φ, which gives the slope and says whether the node has a value
    /// ```
    pub(crate) fn reach_voxels(&self, smoothed: u32, half_width: f32) -> u32 {
        let to_point = 1.0 + half_width;
        let to_particle = RADII as f32 * self.spacing_voxels() + HALF_WIDTH;
        smoothed.saturating_add(2).max((to_point + to_particle).ceil() as u32)
    }
}

/// What averaging did.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
#[non_exhaustive]
pub struct TemporalReport {
    /// The number of other frames.
    #[serde(rename = "frames")]
    pub frame_count: usize,
    /// The number of voxels near the surface.
    #[serde(rename = "voxels")]
    pub voxel_count: usize,
    /// The mean confidence in the other frames, from 0 to 1.
    pub confidence: f64,
    /// Root mean square of the change of φ, in voxels.
    #[serde(rename = "change_voxels")]
    pub change: f64,
}

/// Averages the level set of `frame` with those of the others. If it changes, distances and bounds have to be
/// restored afterwards.
pub fn average(
    band: &mut NarrowBand,
    particles: &TimedFrame,
    others: &[OtherFrame],
    config: &TemporalConfig,
) -> TemporalReport {
    let half_width = HALF_WIDTH.min(band.half_width - 1.0);
    let followed =
        with_particles(others).filter_map(|other| Some((other, moves(&particles.particles, other, config)?)));
    let (followed, moves): (Vec<&OtherFrame>, Vec<Attribute>) = followed.unzip();
    if followed.is_empty() {
        return TemporalReport::default();
    }
    let support = Support {
        radius_world: RADII * config.spacing,
        radius_max_world: RADII * config.spacing,
        margin_world: 0.0,
        shapes: &Shapes::Uniform,
        unsmoothed: None,
    };
    let positions = Positions::from(particles.particles.positions());
    let moves: Vec<&Attribute> = moves.iter().collect();
    let (moves, _) = interpolate_to_band(positions, &moves, band, &config.lattice, half_width, support);
    let carried = followed.iter().zip(moves).map(|(other, moves)| Carried { moves, band: &other.frame.band });
    let carried: Vec<Carried> = carried.collect();
    let apart = apart_from_fluid(band);
    let origins = band.topology.origins();
    let leaves = band.phi.leaves.par_iter_mut().zip(origins).enumerate().halved();
    let parts: Vec<Changes> = leaves
        .map(|(index, (leaf, &origin))| {
            checkpoint();
            average_leaf(leaf, index, origin, &carried, &apart[index], half_width, config)
        })
        .collect();
    let Changes { voxel_count, confidence, squares } =
        parts.into_iter().fold(Changes::default(), Changes::and);
    let count = voxel_count.max(1) as f64;
    TemporalReport {
        frame_count: carried.len(),
        voxel_count,
        confidence: confidence / (count * carried.len() as f64),
        change: (squares / count).sqrt(),
    }
}

/// Another frame, and where the particles carry each voxel.
struct Carried<'a> {
    moves: BandAttribute,
    band: &'a NarrowBand,
}

/// Sums over voxels.
#[derive(Clone, Copy, Default)]
struct Changes {
    voxel_count: usize,
    confidence: f64,
    squares: f64,
}

impl Changes {
    fn and(self, other: Changes) -> Changes {
        Changes {
            voxel_count: self.voxel_count + other.voxel_count,
            confidence: self.confidence + other.confidence,
            squares: self.squares + other.squares,
        }
    }
}

fn average_leaf(
    leaf: &mut Leaf,
    index: usize,
    origin: IVec3,
    carried: &[Carried],
    apart: &LeafMask,
    half_width: f32,
    config: &TemporalConfig,
) -> Changes {
    let mut changes = Changes::default();
    if leaf.values.iter().all(|phi| phi.abs() >= half_width) {
        return changes;
    }
    let spacing_voxels = config.spacing_voxels();
    let mut moves = [0.0; LEAF_VOXELS * COMPONENTS];
    let mut changed = [0.0; LEAF_VOXELS];
    for Carried { moves: of_band, band } in carried {
        of_band.fill(index, &mut moves);
        let mut sampler = Sampler::new(band);
        let disagreement = DISAGREEMENT.map(|most| most.min((band.half_width - 1.0) / spacing_voxels));
        for (offset, &phi) in leaf.values.iter().enumerate() {
            if phi.abs() >= half_width {
                continue;
            }
            let [x, y, z, square, followed] =
                std::array::from_fn(|component| moves[offset * COMPONENTS + component]);
            let kept = falling(1.0 - followed, LOST);
            if kept == 0.0 {
                continue;
            }
            let step = Vec3::new(x, y, z) / followed;
            let scatter = (square / followed - step.length_squared()).max(0.0).sqrt();
            let kept = kept * falling(scatter / spacing_voxels, SCATTER);
            if kept == 0.0 {
                continue;
            }
            let Some(other) = sampler.sample(origin + voxel_in_leaf(offset), step) else { continue };
            let difference = other - phi;
            let confidence = kept * falling(difference.abs() / spacing_voxels, disagreement);
            changed[offset] += confidence * difference;
            changes.confidence += f64::from(confidence);
        }
    }
    for (offset, (phi, changed)) in leaf.values.iter_mut().zip(changed).enumerate() {
        let changed = config.weight() * changed;
        let is_ghost = apart.contains(offset) && *phi + changed < 0.0;
        let changed = if is_ghost { 0.0 } else { changed };
        changes.voxel_count += usize::from(phi.abs() < half_width);
        changes.squares += f64::from(changed) * f64::from(changed);
        *phi += changed;
    }
    changes
}

/// The voxels that are outside, as are all their face neighbours. If one of them came inside, it might be a piece of its
/// own where the frame has no fluid. Any other one hardly can: an inside voxel beside it would have to leave.
fn apart_from_fluid(band: &NarrowBand) -> Vec<LeafMask> {
    let outside: Vec<LeafMask> = negative_masks(&band.phi).iter().map(LeafMask::complement).collect();
    let neighbors = band.topology.neighbors().par_iter().zip(&outside).halved();
    let apart = neighbors.map(|(neighbors, mask)| {
        mask.surrounded(neighbors.map(|neighbor| match neighbor {
            NO_LEAF => &LeafMask::FULL,
            neighbor => &outside[neighbor as usize],
        }))
    });
    apart.collect()
}

/// Falls from 1 to 0 while `value` rises from `from` to `to`, with zero slope at both ends.
fn falling(value: f32, [from, to]: [f32; 2]) -> f32 {
    let part = ((to - value) / (to - from)).clamp(0.0, 1.0);
    part * part * (3.0 - 2.0 * part)
}

#[cfg(test)]
mod tests;
