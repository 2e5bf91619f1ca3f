//! Where the particles of a frame are in another frame.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::{OtherFrame, TemporalConfig};
use crate::motion::{Carrier, TrackedParticles};
use crate::parallel::Loops as _;
use crate::particles::{Attribute, AttributeValues, Role};

/// Values per particle: c u, c |u|², and c, where u is the displacement in voxels, and c from 0 to 1 says whether
/// the particle was followed. A mean of them over particles has the mean of u, its variance, and the share of the
/// particles that were followed.
pub(super) const COMPONENTS: usize = 5;

/// Values of ½ |Δv| Δt, in spacings, for a particle that is followed by its velocity: from the first the
/// certainty falls, and at the second it is 0. Δv is the difference between the velocities in the two frames,
/// and Δt the time between them.
const TURN: [f32; 2] = [0.5, 1.5];

/// Longer displacements are not followed, in voxels.
const LONGEST_VOXELS: f64 = 1e6;

/// The displacements of all particles to another frame, as an attribute; `None` if they cannot be followed there.
pub(super) fn moves(
    from: &TrackedParticles,
    other: &OtherFrame,
    config: &TemporalConfig,
) -> Option<Attribute> {
    let follow = follower(from, other, config)?;
    let voxels_per_unit = config.lattice.voxel_size.recip();
    let components_of = |particle: usize| {
        let Followed { displacement, certainty } = follow(particle)?;
        let displacement_voxels = displacement * voxels_per_unit;
        // A longer one leaves the range of 32-bit numbers, or of voxels, where it is squared or added.
        let is_usable = displacement_voxels.length() < LONGEST_VOXELS;
        is_usable.then(|| components(displacement_voxels.as_vec3(), certainty))
    };
    let rows: Vec<[f32; COMPONENTS]> = (0..from.positions().len())
        .into_par_iter()
        .halved()
        .map(|particle| components_of(particle).unwrap_or([0.0; COMPONENTS]))
        .collect();
    let values = AttributeValues::Numbers(rows.into_flattened());
    Some(Attribute { name: String::new(), role: Role::Other, arity: COMPONENTS, values })
}

/// The [values](COMPONENTS) of a particle.
fn components(displacement_voxels: Vec3, certainty: f32) -> [f32; COMPONENTS] {
    let [x, y, z] = (certainty * displacement_voxels).to_array();
    [x, y, z, certainty * displacement_voxels.length_squared(), certainty]
}

/// Where a particle goes.
struct Followed {
    /// World units.
    displacement: DVec3,
    /// From 0 to 1.
    certainty: f32,
}

/// Follows a particle to another frame; returns `None` for a particle that is not found there.
type Follower<'a> = Box<dyn Fn(usize) -> Option<Followed> + Sync + 'a>;

/// Follows particles by their ids, or else by their velocities; `None` if the frames have neither.
fn follower<'a>(
    from: &'a TrackedParticles,
    other: &'a OtherFrame,
    config: &TemporalConfig,
) -> Option<Follower<'a>> {
    let to = &other.frame.particles;
    let both_have = |carrier| from.has(carrier) && to.has(carrier);
    if both_have(Carrier::Ids) {
        return Some(Box::new(move |particle| {
            let displacement = from.displacement_by_id(particle, to)?;
            Some(Followed { displacement, certainty: 1.0 })
        }));
    }
    let seconds = config.seconds?;
    if !both_have(Carrier::Velocities { seconds }) {
        return None;
    }
    // Negative if the other frame is earlier.
    let frame_time = seconds * f64::from(other.steps);
    let spacing = config.spacing;
    Some(Box::new(move |particle| {
        let position = from.positions().position(particle);
        let velocity_from = from.velocity(particle)?;
        let [displacement, velocity_to] =
            TrackedParticles::displacement_by_velocity(to, position, velocity_from, frame_time, spacing)?;
        let turn = 0.5 * (velocity_to - velocity_from).length() * frame_time.abs() / spacing;
        Some(Followed { displacement, certainty: super::falling(turn as f32, TURN) })
    }))
}
