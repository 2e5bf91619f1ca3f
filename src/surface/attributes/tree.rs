//! The nearest particle that reaches a place: boxes in boxes.
//!
//! ```text
//!   ┌─────────┬──────┐     Particles are halved across the longest side of the box around them, and each half again,
//!   │∙ ∙    ∙ │    ∙ │     until a box has few. A place asks the nearer box first, and no box that is farther than
//!   │  ∙   ∙  ├──────┤     what is found already, or than all in it reach: so it looks at a small part of the particles,
//!   │     ∙   │ ∙  ∙ │     however far away they are. Cells of one size cannot do that: they are too large for the
//!   └─────────┴──────┘     crowd, or too small for what is alone.
//! ```
//!
//! Invariants: what is found is the least of (distance², index) of those that reach the place, in 64 bits, whatever the
//! boxes are. So particles that do not reach it change nothing.

use glam::DVec3;

use super::NO_PARTICLE;

/// What is to be known of a particle.
#[derive(Clone, Copy)]
pub(super) struct Seen {
    /// Finite.
    pub(super) position: DVec3,
    /// It serves places nearer than this.
    pub(super) limit_world: f64,
}

/// Particles in boxes.
pub(super) struct Tree {
    /// Those of a box are next to each other.
    particles: Vec<u32>,
    /// A box, all those in its first half, all those in its other half.
    boxes: Vec<Bounds>,
}

/// What a box holds.
#[derive(Clone, Copy)]
struct Bounds {
    min: DVec3,
    max: DVec3,
    /// The greatest of its particles.
    limit_world: f64,
    /// The least index.
    first: u32,
}

/// Particles of a box that is not halved, at most.
const LEAF_MAX: usize = 16;

impl Tree {
    /// Sorts these particles.
    pub(super) fn new(mut particles: Vec<u32>, see: &(impl Fn(u32) -> Seen + Sync)) -> Tree {
        let mut leaf_count = usize::from(!particles.is_empty());
        while leaf_count * LEAF_MAX < particles.len() {
            leaf_count *= 2;
        }
        let mut boxes = vec![Bounds::EMPTY; (2 * leaf_count).saturating_sub(1)];
        halve(&mut boxes, &mut particles, see);
        Tree { particles, boxes }
    }

    /// The nearest particle that reaches a place; of several, the first. [`NO_PARTICLE`] where there is none.
    pub(super) fn nearest(&self, place: DVec3, see: impl FnMut(u32) -> Seen) -> u32 {
        let mut search = Search { place, see, nearest: (f64::INFINITY, NO_PARTICLE) };
        if place.is_finite() {
            search.descend(&self.boxes, &self.particles);
        }
        search.nearest.1
    }
}

fn halve(boxes: &mut [Bounds], particles: &mut [u32], see: &(impl Fn(u32) -> Seen + Sync)) {
    let Some((bounds, rest)) = boxes.split_first_mut() else { return };
    *bounds = Bounds::of(particles, see);
    if rest.is_empty() {
        return;
    }
    let axis = (bounds.max - bounds.min).max_position();
    let along = |particle: &u32| see(*particle).position[axis];
    let middle = particles.len() / 2;
    particles.select_nth_unstable_by(middle, |one, other| along(one).total_cmp(&along(other)));
    let (one, other) = particles.split_at_mut(middle);
    let (boxes_of_one, boxes_of_other) = rest.split_at_mut(rest.len() / 2);
    rayon::join(|| halve(boxes_of_one, one, see), || halve(boxes_of_other, other, see));
}

impl Bounds {
    const EMPTY: Bounds = Bounds {
        min: DVec3::INFINITY,
        max: DVec3::NEG_INFINITY,
        limit_world: f64::NEG_INFINITY,
        first: NO_PARTICLE,
    };

    fn of(particles: &[u32], see: &impl Fn(u32) -> Seen) -> Bounds {
        particles.iter().fold(Bounds::EMPTY, |bounds, &particle| {
            let Seen { position, limit_world } = see(particle);
            Bounds {
                min: bounds.min.min(position),
                max: bounds.max.max(position),
                limit_world: bounds.limit_world.max(limit_world),
                first: bounds.first.min(particle),
            }
        })
    }

    /// The least that any of its particles can have: rounding is monotone, so none has less by a bit.
    fn least(&self, place: DVec3) -> (f64, u32) {
        let outside = (self.min - place).max(place - self.max).max(DVec3::ZERO);
        (outside.length_squared(), self.first)
    }
}

/// What one place looks for.
struct Search<See> {
    place: DVec3,
    see: See,
    /// The distance², and whose it is.
    nearest: (f64, u32),
}

impl<See: FnMut(u32) -> Seen> Search<See> {
    /// Searches a box; the parts are as [`halve`] made them.
    fn descend(&mut self, boxes: &[Bounds], particles: &[u32]) {
        let Some((bounds, rest)) = boxes.split_first() else { return };
        if !self.is_nearer(bounds.least(self.place), bounds.limit_world) {
            return;
        }
        if rest.is_empty() {
            particles.iter().for_each(|&particle| self.look_at(particle));
            return;
        }
        let (one, other) = particles.split_at(particles.len() / 2);
        let (boxes_of_one, boxes_of_other) = rest.split_at(rest.len() / 2);
        let mut halves = [(boxes_of_one, one), (boxes_of_other, other)];
        if boxes_of_other[0].least(self.place) < boxes_of_one[0].least(self.place) {
            halves.reverse();
        }
        for (boxes, particles) in halves {
            self.descend(boxes, particles);
        }
    }

    fn look_at(&mut self, particle: u32) {
        let Seen { position, limit_world } = (self.see)(particle);
        let found = ((position - self.place).length_squared(), particle);
        if self.is_nearer(found, limit_world) {
            self.nearest = found;
        }
    }

    fn is_nearer(&self, found: (f64, u32), limit_world: f64) -> bool {
        found.0 < limit_world * limit_world && found < self.nearest
    }
}
