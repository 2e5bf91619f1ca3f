//! Follows the particles of a sequence from one frame to another, by ids or by velocities.
//!
//! With ids, the displacement of a particle is known. With velocities, it is the time step times the mean of
//! the velocities at both ends (the trapezoidal rule), which is exact for a constant acceleration. The
//! velocity at the far end is evaluated twice: at a predicted position and at the corrected one. With the
//! velocity at the start only, a drop in free fall would be off by g dt²/2.

use glam::{DVec3, Vec3};
use rustc_hash::{FxHashMap, FxHashSet};

use crate::neighbors::Neighbors;
use crate::particles::{Attribute, OwnedPositions, find_attribute, ids_of, rows, rows_of, unique_ids};

/// How points are carried to the frame before and the frame after.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Carrier {
    /// By the positions of particles with the same id.
    Ids,
    /// By the velocities of particles.
    Velocities {
        /// The time between the frames, in the time unit of the velocities.
        seconds: f64,
    },
}

impl Carrier {
    /// The carrier between frames that are `lag` times as far apart.
    pub fn over(self, lag: u32) -> Carrier {
        match self {
            Carrier::Ids => Carrier::Ids,
            Carrier::Velocities { seconds } => Carrier::Velocities { seconds: f64::from(lag) * seconds },
        }
    }
}

/// The particles of a frame, and their motion.
#[derive(Clone, Debug)]
pub struct MovingParticles {
    /// Positions, world units.
    pub positions: OwnedPositions,
    /// The id of each particle, constant over time. Ids that several particles share are not used.
    pub ids: Option<Vec<i64>>,
    /// Velocities, world units per second.
    pub velocities: Option<Vec<[f32; 3]>>,
}

impl MovingParticles {
    /// Particles with the ids and the velocities among their attributes: those in the attribute `id`, or else in the
    /// first whose role this is.
    pub fn of(positions: OwnedPositions, attributes: &[Attribute]) -> MovingParticles {
        let ids = ids_of(attributes).map(<[i64]>::to_vec);
        let velocities =
            find_attribute(attributes, "velocity", 3).and_then(|attribute| attribute.values.numbers());
        let velocities = velocities.map(|numbers| numbers.as_chunks::<3>().0.to_vec());
        MovingParticles { positions, ids, velocities }
    }

    /// Those that are not among the others, by their ids or, without ids, by their positions.
    pub fn without(self, others: &MovingParticles) -> MovingParticles {
        let MovingParticles { positions, ids, velocities } = self;
        let is_kept: Vec<bool> = match (&ids, &others.ids) {
            (Some(ids), Some(other_ids)) => {
                let others: FxHashSet<i64> = other_ids.iter().copied().collect();
                ids.iter().map(|id| !others.contains(id)).collect()
            }
            _ => {
                let place = |positions: &OwnedPositions, index| {
                    positions.position(index).as_vec3().to_array().map(f32::to_bits)
                };
                let others: FxHashSet<[u32; 3]> =
                    (0..others.positions.len()).map(|index| place(&others.positions, index)).collect();
                (0..positions.len()).map(|index| !others.contains(&place(&positions, index))).collect()
            }
        };
        let (positions, _) = rows_of(&(&positions).into(), &[], &is_kept);
        let ids = ids.map(|ids| rows(&ids, 1, &is_kept));
        MovingParticles {
            positions,
            ids,
            velocities: velocities.map(|velocities| rows(&velocities, 1, &is_kept)),
        }
    }
}

/// The particles of a frame, indexed so that they can be found by place and by id.
pub(crate) struct TrackedParticles {
    particles: MovingParticles,
    neighbors: Neighbors,
    /// The particle of each id that only one particle has.
    index_of_id: FxHashMap<i64, u32>,
}

impl TrackedParticles {
    /// Particles to search within this radius, world units: positive and finite.
    ///
    /// Ids and velocities are ignored unless there are as many as positions.
    pub(crate) fn new(mut particles: MovingParticles, search_radius: f64) -> TrackedParticles {
        let count = particles.positions.len();
        particles.ids = particles.ids.filter(|ids| ids.len() == count);
        particles.velocities = particles.velocities.filter(|velocities| velocities.len() == count);
        let neighbors = Neighbors::new(&particles.positions, search_radius);
        let index_of_id = unique_ids(particles.ids.as_deref().unwrap_or_default());
        TrackedParticles { particles, neighbors, index_of_id }
    }

    /// The positions of the particles.
    pub(crate) fn positions(&self) -> &OwnedPositions {
        &self.particles.positions
    }

    /// Whether the particles of this frame can be followed this way: by ids, if at least half of them have an
    /// id that no other has; by velocities, if they have velocities. True without particles. `flicker`
    /// chooses for a whole sequence by its first frame with particles, and averages choose for each pair of
    /// frames.
    pub(crate) fn has(&self, carrier: Carrier) -> bool {
        let count = self.particles.positions.len();
        match carrier {
            Carrier::Ids => 2 * self.index_of_id.len() >= count,
            Carrier::Velocities { .. } => count == 0 || self.particles.velocities.is_some(),
        }
    }

    /// The displacement of a particle to another frame, by its id; `None` if no particle there has that id,
    /// or several have.
    pub(crate) fn displacement_by_id(&self, particle: usize, to: &TrackedParticles) -> Option<DVec3> {
        let id = *self.particles.ids.as_deref()?.get(particle)?;
        let [here, there] = [self.position_of_id(id)?, to.position_of_id(id)?];
        Some(there - here)
    }

    /// The position of the particle with this id; `None` if no particle has it, or several have.
    fn position_of_id(&self, id: i64) -> Option<DVec3> {
        self.index_of_id.get(&id).map(|&index| self.particles.positions.position(index as usize))
    }

    /// The velocity of a particle, if it has one.
    pub(crate) fn velocity(&self, particle: usize) -> Option<DVec3> {
        let velocities = self.particles.velocities.as_deref()?;
        velocities.get(particle).map(|&velocity| Vec3::from(velocity).as_dvec3())
    }

    /// The displacement of a point that moves with the velocity `here` to another frame, `step` time units
    /// later; before, if negative. Also returns the velocity that was found there. `None` if no particle there
    /// is within its search radius of the predicted position. `spacing` is the particle spacing, world units.
    pub(crate) fn displacement_by_velocity(
        to: &TrackedParticles,
        from: DVec3,
        here: DVec3,
        step: f64,
        spacing: f64,
    ) -> Option<[DVec3; 2]> {
        let limit = to.neighbors.edge_world();
        let velocity_at =
            |position: DVec3| Some(to.mean(position, limit, spacing, |index| to.velocity(index))?.vector);
        let first = velocity_at(from + step * here)?;
        let second = velocity_at(from + step * 0.5 * (here + first))?;
        Some([step * 0.5 * (here + second), second])
    }

    /// The means over the particles around a point for which `vector_of` returns a value. `None` if the nearest
    /// of these particles is farther than `limit`, in world units.
    pub(crate) fn mean(
        &self,
        point: DVec3,
        limit: f64,
        spacing: f64,
        vector_of: impl Fn(usize) -> Option<DVec3>,
    ) -> Option<Mean> {
        // The unit of the grid's coordinates is the cell edge, which is the search radius.
        let grid = &self.neighbors;
        let (cell, point_in_cell) = grid.locate(point)?;
        let [x, y, z] = grid.locals();
        let edge = grid.edge_world();
        let mut found: Vec<(f64, DVec3, DVec3)> = Vec::new();
        for run in grid.runs(cell) {
            let to_corner = run.step.as_vec3() - point_in_cell;
            for slot in run.slots {
                let offset = (to_corner + Vec3::new(x[slot], y[slot], z[slot])).as_dvec3();
                if offset.length_squared() <= 1.0
                    && let Some(vector) = vector_of(grid.indices()[slot] as usize).filter(|v| v.is_finite())
                {
                    found.push((offset.length() * edge, offset * edge, vector));
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
}

/// Weighted means over particles.
pub(crate) struct Mean {
    /// The mean of a vector of the particles.
    pub(crate) vector: DVec3,
    /// Their mean position, world units.
    pub(crate) position: DVec3,
}

/// Particles are weighted up to this distance beyond the nearest one, in spacings.
pub(crate) const BEYOND_NEAREST: f64 = 1.0;
