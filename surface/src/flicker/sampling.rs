//! Samples points on a surface, evenly by area. The same triangles give the same points.
//!
//! ```text
//!   |  1  |2|    3    |4|  5   |      the areas of the triangles, end to end
//!     ●   ● | ●   ●   ●   ●   ●       N points: one in the middle of each of N equal parts of the area;
//!                                     its position in its triangle is a term of a low-discrepancy sequence
//! ```
//!
//! Martin Roberts. The unreasonable effectiveness of quasirandom sequences. 2018

use glam::DVec3;

/// The fractions that define the sequence: 1/g and 1/g², with g³ = g + 1.
const STEPS: [f64; 2] = [0.754_877_666_246_692_7, 0.569_840_290_998_053_3];

/// `count` points on triangles of positive total area, each with the normal of its triangle. Empty if there
/// are no triangles.
pub(super) fn samples(triangles: &[[DVec3; 3]], count: usize) -> Vec<(DVec3, DVec3)> {
    let mut ends = Vec::with_capacity(triangles.len());
    let mut area = 0.0;
    for [a, b, c] in triangles {
        area += 0.5 * (*b - a).cross(*c - a).length();
        ends.push(area);
    }
    if triangles.is_empty() {
        return Vec::new();
    }
    let sample = |index: usize| {
        let along = area * (index as f64 + 0.5) / count as f64;
        let triangle = ends.partition_point(|&end| end <= along).min(triangles.len() - 1);
        let [a, b, c] = triangles[triangle];
        let [mut u, mut v] = STEPS.map(|step| (0.5 + step * index as f64).fract());
        // Mirror the other half of the parallelogram onto this triangle.
        if u + v > 1.0 {
            (u, v) = (1.0 - u, 1.0 - v);
        }
        (a + (b - a) * u + (c - a) * v, (b - a).cross(c - a).normalize_or_zero())
    };
    (0..count).map(sample).collect()
}
