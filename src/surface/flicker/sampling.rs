//! Points on a surface, evenly by area, the same for the same triangles.
//!
//! ```text
//!   |  1  |2|    3    |4|  5   |      the areas of the triangles, one behind the other
//!     ●   ● | ●   ●   ●   ●   ●       a point in the middle of each of N equal parts;
//!                                     within its triangle, the terms of a low-discrepancy sequence
//! ```
//!
//! Martin Roberts. The unreasonable effectiveness of quasirandom sequences. 2018

use glam::DVec3;

/// The parts that make the sequence: 1/g and 1/g², g³ = g + 1.
const STEPS: [f64; 2] = [0.754_877_666_246_692_7, 0.569_840_290_998_053_3];

/// `count` points on triangles that have an area, each with the normal of its triangle. Without triangles there are no points.
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
        let place = ends.partition_point(|&end| end <= along).min(triangles.len() - 1);
        let [a, b, c] = triangles[place];
        let [mut u, mut v] = STEPS.map(|step| (0.5 + step * index as f64).fract());
        // The other half of the parallelogram is turned onto this one.
        if u + v > 1.0 {
            (u, v) = (1.0 - u, 1.0 - v);
        }
        (a + (b - a) * u + (c - a) * v, (b - a).cross(c - a).normalize_or_zero())
    };
    (0..count).map(sample).collect()
}
