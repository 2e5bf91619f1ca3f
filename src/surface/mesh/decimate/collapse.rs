//! What drawing a vertex onto a neighbour does to the surface.
//!
//! ```text
//!   seen along the mean normal of v's triangles:
//!
//!        c ─── b              c ─── b          old edges  v–a, v–b, …            heights h over the plane
//!       ╱ ╲   ╱ ╲            ╱  ╲    ╲         new edges  w–c, w–b
//!      d ── v ── a          d  ·  × ╌ ×  a
//!       ╲   │   ╱            ╲    ╲  ╱         the difference of both heights is linear between · (where v was)
//!        e ─ w               e ──── w          and × (where an old edge meets a new one): it is greatest at one of these
//! ```

use glam::{Vec2, Vec3};

use super::NEVER;
use super::rings::Rings;

/// A vertex is drawn onto a neighbour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Collapse {
    /// How far points of its triangles will have moved, at most.
    pub(super) bound: f32,
    /// The neighbour.
    pub(super) target: u32,
}

/// Vertices with more neighbours than this stay.
const RING_MAX: usize = 12;

/// Normals turn from the mean normal by no more than the angle with this cosine: 75°.
const LEAST_COSINE: f32 = 0.26;

/// A new triangle's shape (1 for an equilateral one, 0 for one without area) is no worse than this, or than the worst one
/// that was there.
const LEAST_SHAPE: f32 = 0.25;

/// Neighbours that are tried.
const TRIES: usize = 3;

/// Of the size of the patch, what 32-bit arithmetic may have been wrong by.
const ROUNDING: f32 = 4e-6;

/// The triangles around a vertex.
pub(super) struct Patch<'a> {
    vertex: u32,
    ring: &'a [u32],
    /// No point of the triangles has moved farther so far.
    pub(super) bound: f32,
    /// Neighbours relative to the vertex.
    around: [Vec3; RING_MAX],
    /// Doubled areas along normals of the triangles, by their first neighbour.
    normals: [Vec3; RING_MAX],
    mean_normal: Vec3,
    /// The neighbours as seen along the mean normal, and their heights.
    seen: [Vec2; RING_MAX],
    heights: [f32; RING_MAX],
    least_shape: f32,
}

impl<'a> Patch<'a> {
    /// The triangles of a vertex; `None` if it has no ring, too long a one, or one that is folded.
    #[inline(always)]
    pub(super) fn new(positions: &[Vec3], vertex: u32, ring: &'a [u32], bounds: &[f32]) -> Option<Patch<'a>> {
        let count = ring.len();
        if count == 0 || count > RING_MAX {
            return None;
        }
        let here = positions[vertex as usize];
        let mut around = [Vec3::ZERO; RING_MAX];
        let mut neighbor_bounds = [0.0; RING_MAX];
        for (place, &neighbor) in ring.iter().enumerate() {
            around[place] = positions[neighbor as usize] - here;
            neighbor_bounds[place] = bounds[neighbor as usize];
        }
        let mut normals = [Vec3::ZERO; RING_MAX];
        let (mut sum, mut bound, mut least_shape) = (Vec3::ZERO, 0.0f32, LEAST_SHAPE);
        for place in 0..count {
            let after = if place + 1 == count { 0 } else { place + 1 };
            normals[place] = around[place].cross(around[after]);
            sum += normals[place];
            // A triangle has moved no farther than each of its corners says.
            bound = bound.max(neighbor_bounds[place].min(neighbor_bounds[after]));
            least_shape = least_shape.min(shape(normals[place].length(), around[place], around[after]));
        }
        let bound = bound.min(bounds[vertex as usize]);
        let mean_normal = sum / sum.length();
        let is_unfolded = |normal: &Vec3| normal.dot(mean_normal) > LEAST_COSINE * normal.length();
        // A comparison with NaN is false.
        if !normals[..count].iter().all(is_unfolded) {
            return None;
        }
        let (right, up) = mean_normal.any_orthonormal_pair();
        let mut seen = [Vec2::ZERO; RING_MAX];
        let mut heights = [0.0; RING_MAX];
        for place in 0..count {
            seen[place] = Vec2::new(around[place].dot(right), around[place].dot(up));
            heights[place] = around[place].dot(mean_normal);
        }
        let crosses_right = |place: &usize| {
            let after = if *place + 1 == count { 0 } else { place + 1 };
            (seen[*place].y < 0.0) != (seen[after].y < 0.0) && seen[after].y >= 0.0
        };
        // Once around, and not twice.
        if (0..count).filter(crosses_right).count() != 1 {
            return None;
        }
        Some(Patch { vertex, ring, bound, around, normals, mean_normal, seen, heights, least_shape })
    }

    /// The neighbour that the vertex is best drawn onto, of those that disturb the triangles' planes least. Where there
    /// is none the bound is [`NEVER`].
    #[inline(always)]
    pub(super) fn best_collapse(&self, rings: &Rings) -> Collapse {
        let count = self.ring.len();
        let mut disturbances = [f32::INFINITY; RING_MAX];
        for (target, disturbance) in disturbances[..count].iter_mut().enumerate() {
            *disturbance = self.disturbance(target);
        }
        let mut best = Collapse { bound: NEVER, target: 0 };
        for _ in 0..TRIES.min(count) {
            let mut target = 0;
            for place in 1..count {
                if disturbances[place] < disturbances[target] {
                    target = place;
                }
            }
            disturbances[target] = f32::INFINITY;
            if rings.can_collapse(self.vertex, self.ring[target]) && self.is_sound(target) {
                best = Collapse { bound: self.bound_after(target), target: self.ring[target] };
                break;
            }
        }
        best
    }

    /// The quadric of the vertex's triangles at a neighbour: squared distances from their planes, weighted by area.
    #[inline(always)]
    fn disturbance(&self, target: usize) -> f32 {
        let count = self.ring.len();
        let to_target = self.around[target];
        let mut sum = 0.0;
        for normal in &self.normals[..count] {
            let product = normal.dot(to_target);
            // Not 0 / 0, if a triangle has no area.
            sum += product * product / normal.length().max(f32::MIN_POSITIVE);
        }
        sum
    }

    /// Whether the new triangles have a shape, and are seen from the same side as the old ones.
    #[inline(always)]
    fn is_sound(&self, target: usize) -> bool {
        let count = self.ring.len();
        let origin = self.around[target];
        let mut from = wrapped(target + 1, count);
        for _ in 2..count {
            let to = wrapped(from + 1, count);
            let (one, other) = (self.around[from] - origin, self.around[to] - origin);
            let normal = one.cross(other);
            let length = normal.length();
            let faces_out = normal.dot(self.mean_normal) > LEAST_COSINE * length;
            if !(faces_out && shape(length, one, other) >= self.least_shape) {
                return false;
            }
            from = to;
        }
        true
    }

    /// How far points of the triangles will have moved at most, if the vertex is drawn onto a neighbour.
    #[inline(always)]
    fn bound_after(&self, target: usize) -> f32 {
        let count = self.ring.len();
        // Neighbours from the target on, relative to it, as seen along the normal.
        let mut seen = [Vec2::ZERO; RING_MAX];
        let mut heights = [0.0; RING_MAX];
        let mut place = target;
        for index in 0..count {
            seen[index] = self.seen[place] - self.seen[target];
            heights[index] = self.heights[place] - self.heights[target];
            place = wrapped(place + 1, count);
        }
        let (here, here_height) = (-self.seen[target], -self.heights[target]);
        // The new triangle that lies where the vertex was: between neighbours `under` and the one after.
        let is_under =
            |&index: &usize| seen[index].perp_dot(here) >= 0.0 && here.perp_dot(seen[index + 1]) >= 0.0;
        let Some(under) = (1..count - 1).find(is_under) else { return NEVER };
        let doubled_area = seen[under].perp_dot(seen[under + 1]);
        let height = (here.perp_dot(seen[under + 1]) * heights[under]
            + seen[under].perp_dot(here) * heights[under + 1])
            / doubled_area;
        let mut farthest = (height - here_height).abs();
        for edge in 2..count - 1 {
            // Old edges to neighbours on the other side of the new edge than the vertex cross it.
            let crossed = if edge <= under { 1..edge } else { edge + 1..count };
            for other in crossed {
                let along = seen[edge];
                let (from, to) = (along.perp_dot(here), along.perp_dot(seen[other]));
                let part = (from / (from - to)).clamp(0.0, 1.0);
                let meeting = here + part * (seen[other] - here);
                let old = here_height + part * (heights[other] - here_height);
                let part_of_new = (meeting.dot(along) / along.length_squared()).clamp(0.0, 1.0);
                let difference = (old - part_of_new * heights[edge]).abs();
                // What is not a number is too far.
                farthest = if difference < NEVER { farthest.max(difference) } else { NEVER };
            }
        }
        let size = self.around[..count].iter().fold(0.0f32, |size, around| size.max(around.length_squared()));
        let bound = self.bound + farthest + ROUNDING * size.sqrt();
        if bound.is_finite() { bound } else { NEVER }
    }
}

/// A place in a ring that may be one too far.
#[inline(always)]
fn wrapped(place: usize, count: usize) -> usize {
    if place >= count { place - count } else { place }
}

/// How near to equilateral a triangle is, by its doubled area and two of its sides: from 0 to 1.
#[inline(always)]
fn shape(doubled_area: f32, one: Vec3, other: Vec3) -> f32 {
    let squares = one.length_squared() + other.length_squared() + one.distance_squared(other);
    2.0 * 3f32.sqrt() * doubled_area / squares
}
