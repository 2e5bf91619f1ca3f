//! Finds the nearest particle that reaches a point, with a tree of bounding boxes.
//!
//! ```text
//!   ┌─────────┬──────┐     Particles are split in half across the longest side of their bounding box,
//!   │∙ ∙    ∙ │    ∙ │     recursively, until a box contains few particles.
//!   │  ∙   ∙  ├──────┤
//!   │     ∙   │ ∙  ∙ │
//!   └─────────┴──────┘
//! ```
//!
//! A search visits the nearer box first. It skips a box that is farther away than the nearest particle so
//! far, or that is so far away that none of its particles reaches the point. So it visits a small part of the
//! particles, however far away they are. A grid with a fixed cell size cannot do that: its cells are too
//! large for dense clusters or too small for isolated particles.
//!
//! Invariant: the result is the minimum of (distance², index) over the particles that reach the point,
//! computed in 64 bits, whatever the boxes are. So particles that do not reach the point have no influence.

use glam::DVec3;

use crate::interrupt::checkpoint;

use super::NO_PARTICLE;

/// A particle as seen by the tree.
#[derive(Clone, Copy)]
pub(super) struct TreeParticle {
    /// Must be finite.
    pub(super) position: DVec3,
    /// The particle reaches points nearer than this.
    pub(super) limit_world: f64,
}

/// A tree of particles.
pub(super) struct Tree {
    /// Indices of the particles; those of a box are contiguous.
    particles: Vec<u32>,
    /// The boxes in preorder: a box is followed by all boxes in its first half, then all boxes in its second
    /// half.
    boxes: Vec<NodeBounds>,
}

/// Bounds over the particles of a box.
#[derive(Clone, Copy)]
struct NodeBounds {
    min: DVec3,
    max: DVec3,
    /// The maximum of `limit_world` over the particles of the box.
    limit_world: f64,
    /// The minimum index of a particle in the box.
    first: u32,
}

/// Maximum number of particles of a box that is not split.
const LEAF_MAX: usize = 16;

impl Tree {
    /// Builds the tree of these particles.
    pub(super) fn new(mut particles: Vec<u32>, particle_at: &(impl Fn(u32) -> TreeParticle + Sync)) -> Tree {
        let mut leaf_count = usize::from(!particles.is_empty());
        while leaf_count * LEAF_MAX < particles.len() {
            leaf_count *= 2;
        }
        let mut boxes = vec![NodeBounds::EMPTY; (2 * leaf_count).saturating_sub(1)];
        halve(&mut boxes, &mut particles, particle_at);
        Tree { particles, boxes }
    }

    /// The nearest particle that reaches a point; on ties, the one with the lowest index. [`NO_PARTICLE`] if
    /// no particle reaches the point.
    pub(super) fn nearest(&self, point: DVec3, particle_at: impl FnMut(u32) -> TreeParticle) -> u32 {
        let mut search = NearestSearch { point, particle_at, nearest: (f64::INFINITY, NO_PARTICLE) };
        if point.is_finite() {
            search.descend(&self.boxes, &self.particles);
        }
        search.nearest.1
    }
}

fn halve(
    boxes: &mut [NodeBounds],
    particles: &mut [u32],
    particle_at: &(impl Fn(u32) -> TreeParticle + Sync),
) {
    checkpoint();
    let Some((bounds, rest)) = boxes.split_first_mut() else { return };
    *bounds = NodeBounds::of(particles, particle_at);
    if rest.is_empty() {
        return;
    }
    let axis = (bounds.max - bounds.min).max_position();
    let along = |particle: &u32| particle_at(*particle).position[axis];
    let middle = particles.len() / 2;
    particles.select_nth_unstable_by(middle, |one, other| along(one).total_cmp(&along(other)));
    let (one, other) = particles.split_at_mut(middle);
    let (boxes_of_one, boxes_of_other) = rest.split_at_mut(rest.len() / 2);
    rayon::join(|| halve(boxes_of_one, one, particle_at), || halve(boxes_of_other, other, particle_at));
}

impl NodeBounds {
    const EMPTY: NodeBounds = NodeBounds {
        min: DVec3::INFINITY,
        max: DVec3::NEG_INFINITY,
        limit_world: f64::NEG_INFINITY,
        first: NO_PARTICLE,
    };

    fn of(particles: &[u32], particle_at: &impl Fn(u32) -> TreeParticle) -> NodeBounds {
        particles.iter().fold(NodeBounds::EMPTY, |bounds, &particle| {
            let TreeParticle { position, limit_world } = particle_at(particle);
            NodeBounds {
                min: bounds.min.min(position),
                max: bounds.max.max(position),
                limit_world: bounds.limit_world.max(limit_world),
                first: bounds.first.min(particle),
            }
        })
    }

    /// A lower bound of (distance², index) for the particles of the box. Rounding is monotone, so no particle
    /// is below this bound by even a bit.
    fn least(&self, point: DVec3) -> (f64, u32) {
        let outside = (self.min - point).max(point - self.max).max(DVec3::ZERO);
        (outside.length_squared(), self.first)
    }
}

/// The search for one point.
struct NearestSearch<F> {
    point: DVec3,
    particle_at: F,
    /// The squared distance and the index of the nearest particle so far.
    nearest: (f64, u32),
}

impl<F: FnMut(u32) -> TreeParticle> NearestSearch<F> {
    /// Searches the box `boxes[0]`. The boxes of its halves follow it, arranged by [`halve`].
    fn descend(&mut self, boxes: &[NodeBounds], particles: &[u32]) {
        let Some((bounds, rest)) = boxes.split_first() else { return };
        if !self.is_nearer(bounds.least(self.point), bounds.limit_world) {
            return;
        }
        if rest.is_empty() {
            particles.iter().for_each(|&particle| self.visit(particle));
            return;
        }
        let (one, other) = particles.split_at(particles.len() / 2);
        let (boxes_of_one, boxes_of_other) = rest.split_at(rest.len() / 2);
        let mut halves = [(boxes_of_one, one), (boxes_of_other, other)];
        if boxes_of_other[0].least(self.point) < boxes_of_one[0].least(self.point) {
            halves.reverse();
        }
        for (boxes, particles) in halves {
            self.descend(boxes, particles);
        }
    }

    fn visit(&mut self, particle: u32) {
        let TreeParticle { position, limit_world } = (self.particle_at)(particle);
        let found = ((position - self.point).length_squared(), particle);
        if self.is_nearer(found, limit_world) {
            self.nearest = found;
        }
    }

    fn is_nearer(&self, found: (f64, u32), limit_world: f64) -> bool {
        found.0 < limit_world * limit_world && found < self.nearest
    }
}
