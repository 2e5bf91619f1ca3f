//! Where the particles of a frame are in another frame.

use rayon::prelude::*;

use super::{OtherFrame, TemporalConfig};
use crate::motion::{Carrier, TrackedParticles};
use crate::parallel::Loops as _;
use crate::particles::{Attribute, AttributeValues, Role};

/// Values per particle: c u, c |u|², and c, where u is the displacement in voxels, and c from 0 to 1 says whether
/// the particle was followed. A mean of them over particles has the mean of u, its variance, and the share of the
/// particles that were followed.
pub(super) const COMPONENTS: usize = 5;

/// Half of the change of velocity over the time step, as a distance in spacings: a particle whose velocities at
/// both ends differ by more cannot be followed by them.
const TURN: [f32; 2] = [0.5, 1.5];

/// Longer displacements are not followed, in voxels.
const LONGEST_VOXELS: f64 = 1e6;

/// The displacements of all particles to another frame, as an attribute; `None` if they cannot be followed there.
pub(super) fn moves(from: &TrackedParticles, to: &OtherFrame, config: &TemporalConfig) -> Option<Attribute> {
    let steps = to.steps;
    let to = &to.frame.particles;
    let follows = |carrier| from.has(carrier) && to.has(carrier);
    let by_velocity = config.seconds.map(|seconds| seconds * f64::from(steps));
    let followed: Box<dyn Fn(usize) -> Option<Followed> + Sync> = if follows(Carrier::Ids) {
        Box::new(|particle| {
            let step = from.displacement_by_id(particle, to)?;
            Some(Followed { step, certainty: 1.0 })
        })
    } else {
        let seconds = by_velocity.filter(|&seconds| follows(Carrier::Velocities { seconds }))?;
        Box::new(move |particle| {
            let (position, here) = (from.positions().position(particle), from.velocity(particle)?);
            let [step, there] =
                TrackedParticles::displacement_by_velocity(to, position, here, seconds, config.spacing)?;
            let turn = 0.5 * (there - here).length() * seconds.abs() / config.spacing;
            Some(Followed { step, certainty: super::falling(turn as f32, TURN) })
        })
    };
    let voxels = config.lattice.voxel_size.recip();
    let values = |particle: usize| match followed(particle) {
        // A longer step leaves the range of 32-bit numbers, or of voxels, where it is squared or added.
        Some(Followed { step, certainty }) if (step * voxels).length() < LONGEST_VOXELS => {
            let step = (step * voxels).as_vec3();
            let [x, y, z] = (certainty * step).to_array();
            [x, y, z, certainty * step.length_squared(), certainty]
        }
        _ => [0.0; COMPONENTS],
    };
    let values: Vec<[f32; COMPONENTS]> =
        (0..from.positions().len()).into_par_iter().halved().map(values).collect();
    let values = AttributeValues::Numbers(values.into_flattened());
    Some(Attribute { name: String::new(), role: Role::Other, arity: COMPONENTS, values })
}

/// Where a particle goes.
struct Followed {
    /// Its displacement, world units.
    step: glam::DVec3,
    /// From 0 to 1.
    certainty: f32,
}
