//! Carries points along with the particles.
//!
//! ```text
//!     ∙   ∙   ∙
//!      ∙  ●──────▶ ○      the mean displacement of the particles around the point, weighted by (1 − r²/R²)³:
//!     ∙   ∙   ∙           r is a particle's distance, R the distance of the nearest one plus one spacing
//! ```
//!
//! With ids, the displacement of a particle is known. With velocities, it is the time step times the mean of
//! the velocities at both ends (the trapezoidal rule), which is exact for a constant acceleration. The
//! velocity at the far end is evaluated twice: at a predicted position and at the corrected one. With the
//! velocity at the start only, a drop in free fall would flicker by g dt².

use glam::{DVec3, Vec3};

use super::{Carrier, FlickerFrame};

/// A point is carried if a particle is closer than this, in spacings. With strong smoothing, surfaces are
/// this far from their particles.
pub const CARRY_REACH: f64 = 3.0;

/// Particles are weighted up to this distance beyond the nearest one, in spacings.
const BEYOND_NEAREST: f64 = 1.0;

/// Search radius for the weighted particles, in spacings. It is also the limit for the distance of the
/// nearest particle from a predicted position, because the prediction may be off by this much.
pub(super) const SEARCH_RADIUS: f64 = CARRY_REACH + BEYOND_NEAREST;

/// The position of a point of `from` in the frame `to`, the next one (`direction` 1) or the previous one
/// (−1). `None` if no particle within reach carries it.
pub(super) fn carry(
    from: &FlickerFrame,
    to: &FlickerFrame,
    carrier: Carrier,
    direction: f64,
    point: DVec3,
    spacing: f64,
) -> Option<DVec3> {
    let limit = CARRY_REACH * spacing;
    let displacement = match carrier {
        Carrier::Ids => {
            let ids = from.particles.ids.as_deref()?;
            let displacement = |index: usize| {
                let id = ids.get(index)?;
                // Ids that several particles share are not in the table.
                let (other, own) = (*to.index_of.get(id)?, *from.index_of.get(id)?);
                let position =
                    |frame: &FlickerFrame, index: u32| frame.particles.positions.position(index as usize);
                Some(position(to, other) - position(from, own))
            };
            mean(from, point, (limit, spacing), displacement)?.vector
        }
        Carrier::Velocities { seconds } => {
            let step = direction * seconds;
            // Evaluated at the particles' mean position instead of on the surface, because more particles
            // surround the mean position.
            let Mean { vector: here, position } = mean(from, point, (limit, spacing), velocity_in(from))?;
            let velocity_at = |position: DVec3| {
                Some(mean(to, position, (SEARCH_RADIUS * spacing, spacing), velocity_in(to))?.vector)
            };
            let first = velocity_at(position + step * here)?;
            let second = velocity_at(position + step * 0.5 * (here + first))?;
            step * 0.5 * (here + second)
        }
    };
    Some(point + displacement).filter(|position| position.is_finite())
}

fn velocity_in(frame: &FlickerFrame) -> impl Fn(usize) -> Option<DVec3> {
    let velocities = frame.particles.velocities.as_deref().unwrap_or_default();
    |index| velocities.get(index).map(|&velocity| Vec3::from(velocity).as_dvec3())
}

/// Weighted means over particles.
struct Mean {
    /// The mean of a vector of the particles.
    vector: DVec3,
    /// Their mean position, world units.
    position: DVec3,
}

/// The means over the particles around a point for which `vector_of` returns a value. `None` if the nearest
/// of these particles is farther than `limit`, in world units.
fn mean(
    frame: &FlickerFrame,
    point: DVec3,
    (limit, spacing): (f64, f64),
    vector_of: impl Fn(usize) -> Option<DVec3>,
) -> Option<Mean> {
    let near = &frame.near;
    let (cell, local) = near.locate(point)?;
    let [x, y, z] = near.locals();
    let edge = near.edge_world();
    let mut found: Vec<(f64, DVec3, DVec3)> = Vec::new();
    for run in near.runs(cell) {
        let corner = run.step.as_vec3() - local;
        for slot in run.slots {
            // In units of the cell edge, which is the search radius of the grid.
            let apart = (corner + Vec3::new(x[slot], y[slot], z[slot])).as_dvec3();
            if apart.length_squared() <= 1.0
                && let Some(vector) = vector_of(near.indices()[slot] as usize).filter(|v| v.is_finite())
            {
                found.push((apart.length() * edge, apart * edge, vector));
            }
        }
    }
    let nearest = found.iter().map(|&(distance, ..)| distance).fold(f64::INFINITY, f64::min);
    if nearest > limit {
        return None;
    }
    let radius = nearest + BEYOND_NEAREST * spacing;
    let (mut vectors, mut offsets, mut weights) = (DVec3::ZERO, DVec3::ZERO, 0.0);
    for (distance, offset, vector) in found {
        let part = (1.0 - (distance / radius).powi(2)).max(0.0);
        let weight = part * part * part;
        vectors += weight * vector;
        offsets += weight * offset;
        weights += weight;
    }
    Some(Mean { vector: vectors / weights, position: point + offsets / weights })
}
