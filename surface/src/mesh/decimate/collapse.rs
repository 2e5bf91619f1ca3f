//! Bounds how far the surface moves when a vertex is collapsed into a neighbor.
//!
//! ```text
//!   seen along the mean normal of v's triangles:
//!
//!        c ─── b              c ─── b          old edges  v–a, v–b, …            heights h above the plane
//!       ╱ ╲   ╱ ╲            ╱  ╲    ╲         new edges  w–c, w–b
//!      d ── v ── a          d  ·  × ╌ ×  a
//!       ╲   │   ╱            ╲    ╲  ╱         the difference of the heights is linear between
//!        e ─ w               e ──── w          · (where v was) and × (where an old and a new edge cross),
//!                                              so it is maximal at one of these points
//! ```

use glam::{Vec2, Vec3};

use super::NEVER;
use super::rings::Rings;

/// A collapse of a vertex into a neighbor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Collapse {
    /// Upper bound of the displacement of points of the vertex's triangles, including this collapse.
    pub(super) bound: f32,
    /// The neighbor.
    pub(super) target: u32,
}

/// Vertices with more neighbors than this are not collapsed.
const RING_MAX: usize = 12;

/// Cosine of the maximum angle between triangle normals and the mean normal: 75°.
const COSINE_MIN: f32 = 0.26;

/// Minimum shape quality of a new triangle (1 if equilateral, 0 without area), unless an old triangle was
/// worse.
const SHAPE_MIN: f32 = 0.25;

/// Maximum number of neighbors that are tried as targets.
const TRIES: usize = 3;

/// Upper bound of the rounding error of 32-bit arithmetic, relative to the size of the patch.
const ROUNDING: f32 = 4e-6;

/// The triangles around a vertex.
pub(super) struct VertexStar<'a> {
    vertex: u32,
    ring: &'a [u32],
    /// Upper bound of the displacement of the triangles' points so far.
    pub(super) bound: f32,
    /// Positions of the neighbors relative to the vertex.
    around: [Vec3; RING_MAX],
    /// Normals of the triangles with the length of twice the area, by the triangle's first neighbor.
    normals: [Vec3; RING_MAX],
    mean_normal: Vec3,
    /// Projections of the neighbors along the mean normal, and their heights.
    projected: [Vec2; RING_MAX],
    heights: [f32; RING_MAX],
    least_shape: f32,
}

impl<'a> VertexStar<'a> {
    /// The triangles of a vertex; `None` if it has no ring, or its ring is too long or folded.
    #[inline(always)]
    pub(super) fn new(
        positions: &[Vec3],
        vertex: u32,
        ring: &'a [u32],
        bounds: &[f32],
    ) -> Option<VertexStar<'a>> {
        let count = ring.len();
        if count == 0 || count > RING_MAX {
            return None;
        }
        let here = positions[vertex as usize];
        let mut around = [Vec3::ZERO; RING_MAX];
        let mut neighbor_bounds = [0.0; RING_MAX];
        for (i, &neighbor) in ring.iter().enumerate() {
            around[i] = positions[neighbor as usize] - here;
            neighbor_bounds[i] = bounds[neighbor as usize];
        }
        let mut normals = [Vec3::ZERO; RING_MAX];
        let (mut sum, mut bound, mut least_shape) = (Vec3::ZERO, 0.0f32, SHAPE_MIN);
        for i in 0..count {
            let after = if i + 1 == count { 0 } else { i + 1 };
            normals[i] = around[i].cross(around[after]);
            sum += normals[i];
            // Each corner has a bound for all its triangles, so the smallest of the three holds for a
            // triangle.
            bound = bound.max(neighbor_bounds[i].min(neighbor_bounds[after]));
            least_shape = least_shape.min(shape(normals[i].length(), around[i], around[after]));
        }
        let bound = bound.min(bounds[vertex as usize]);
        let mean_normal = sum / sum.length();
        let is_unfolded = |normal: &Vec3| normal.dot(mean_normal) > COSINE_MIN * normal.length();
        // Comparison with NaN is false, so NaN counts as folded.
        if !normals[..count].iter().all(is_unfolded) {
            return None;
        }
        let (right, up) = mean_normal.any_orthonormal_pair();
        let mut projected = [Vec2::ZERO; RING_MAX];
        let mut heights = [0.0; RING_MAX];
        for i in 0..count {
            projected[i] = Vec2::new(around[i].dot(right), around[i].dot(up));
            heights[i] = around[i].dot(mean_normal);
        }
        let crosses_right = |i: &usize| {
            let after = if *i + 1 == count { 0 } else { i + 1 };
            (projected[*i].y < 0.0) != (projected[after].y < 0.0) && projected[after].y >= 0.0
        };
        // The projected ring must wind around the vertex exactly once.
        if (0..count).filter(crosses_right).count() != 1 {
            return None;
        }
        Some(VertexStar {
            vertex,
            ring,
            bound,
            around,
            normals,
            mean_normal,
            projected,
            heights,
            least_shape,
        })
    }

    /// Tries the [`TRIES`] neighbors that change the triangles' planes least, best first, and returns the
    /// first possible collapse. If none is possible, the bound is [`NEVER`].
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
            for i in 1..count {
                if disturbances[i] < disturbances[target] {
                    target = i;
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

    /// The quadric of the vertex's triangles at a neighbor: its squared distances from the triangles' planes,
    /// weighted by twice their areas.
    #[inline(always)]
    fn disturbance(&self, target: usize) -> f32 {
        let count = self.ring.len();
        let to_target = self.around[target];
        let mut sum = 0.0;
        for normal in &self.normals[..count] {
            let product = normal.dot(to_target);
            // Avoids 0 / 0 if a triangle has no area.
            sum += product * product / normal.length().max(f32::MIN_POSITIVE);
        }
        sum
    }

    /// True if the new triangles are well shaped and face the same side as the old ones.
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
            let faces_out = normal.dot(self.mean_normal) > COSINE_MIN * length;
            if !(faces_out && shape(length, one, other) >= self.least_shape) {
                return false;
            }
            from = to;
        }
        true
    }

    /// Upper bound of the displacement of the triangles' points after the collapse into a neighbor.
    #[inline(always)]
    fn bound_after(&self, target: usize) -> f32 {
        let count = self.ring.len();
        // The neighbors from the target on, relative to the target, projected along the normal.
        let mut projected = [Vec2::ZERO; RING_MAX];
        let mut heights = [0.0; RING_MAX];
        let mut i = target;
        for index in 0..count {
            projected[index] = self.projected[i] - self.projected[target];
            heights[index] = self.heights[i] - self.heights[target];
            i = wrapped(i + 1, count);
        }
        let (here, here_height) = (-self.projected[target], -self.heights[target]);
        // The new triangle over the old position of the vertex: its corners are the target, neighbor `under`
        // and the next neighbor.
        let is_under = |&index: &usize| {
            projected[index].perp_dot(here) >= 0.0 && here.perp_dot(projected[index + 1]) >= 0.0
        };
        let Some(under) = (1..count - 1).find(is_under) else { return NEVER };
        let doubled_area = projected[under].perp_dot(projected[under + 1]);
        let height = (here.perp_dot(projected[under + 1]) * heights[under]
            + projected[under].perp_dot(here) * heights[under + 1])
            / doubled_area;
        let mut farthest = (height - here_height).abs();
        for edge in 2..count - 1 {
            // The new edge crosses the old edges to neighbors on its other side.
            let crossed = if edge <= under { 1..edge } else { edge + 1..count };
            for other in crossed {
                let along = projected[edge];
                let (from, to) = (along.perp_dot(here), along.perp_dot(projected[other]));
                let part = (from / (from - to)).clamp(0.0, 1.0);
                let meeting = here + part * (projected[other] - here);
                let old = here_height + part * (heights[other] - here_height);
                let part_of_new = (meeting.dot(along) / along.length_squared()).clamp(0.0, 1.0);
                let difference = (old - part_of_new * heights[edge]).abs();
                // NaN counts as too far.
                farthest = if difference < NEVER { farthest.max(difference) } else { NEVER };
            }
        }
        let size = self.around[..count].iter().fold(0.0f32, |size, around| size.max(around.length_squared()));
        let bound = self.bound + farthest + ROUNDING * size.sqrt();
        if bound.is_finite() { bound } else { NEVER }
    }
}

/// Wraps an index that may be one past the end of a ring.
#[inline(always)]
fn wrapped(i: usize, count: usize) -> usize {
    if i >= count { i - count } else { i }
}

/// Shape quality of a triangle from its doubled area and two of its sides: 0 to 1 (equilateral).
#[inline(always)]
fn shape(doubled_area: f32, one: Vec3, other: Vec3) -> f32 {
    let squares = one.length_squared() + other.length_squared() + one.distance_squared(other);
    2.0 * 3f32.sqrt() * doubled_area / squares
}
