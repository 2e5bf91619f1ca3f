//! Selects the particles to measure: those with the smallest hashes.

use std::collections::BTreeSet;

use glam::DVec3;

/// Up to `count` distinct points: those with the smallest hashes. The order of the points does not matter,
/// and neither does their position in the world, as long as differences are exact.
pub(super) fn sample(points: &[DVec3], count: usize) -> Vec<DVec3> {
    let Some(anchor) = componentwise_median(points) else { return Vec::new() };
    let extent = points.iter().fold(DVec3::ZERO, |extent, &point| extent.max((point - anchor).abs()));
    let unit = extent.max_element();
    let mut least: BTreeSet<(u64, [u64; 3])> = BTreeSet::new();
    for &point in points {
        let entry = (hash_without_scale(point - anchor, unit), point.to_array().map(f64::to_bits));
        if least.len() < count {
            least.insert(entry);
        } else if least.last().is_some_and(|&greatest| entry < greatest) && least.insert(entry) {
            least.pop_last();
        }
    }
    least.into_iter().map(|(_, bits)| DVec3::from(bits.map(f64::from_bits))).collect()
}

/// A position in the middle of the points. Unlike a corner of their box, it does not follow an outlier:
/// relative to an outlier, all other points would have nearly the same offset.
fn componentwise_median(points: &[DVec3]) -> Option<DVec3> {
    let mut values = Vec::with_capacity(points.len());
    let mut median = DVec3::ZERO;
    for axis in 0..3 {
        values.clear();
        values.extend(points.iter().map(|point| point[axis]));
        let middle = values.len() / 2;
        if values.is_empty() {
            return None;
        }
        median[axis] = *values.select_nth_unstable_by(middle, f64::total_cmp).1;
    }
    Some(median)
}

/// A hash of an offset. Exponents are taken relative to that of `unit`, so scaling all points by a power of
/// two does not change the hash.
fn hash_without_scale(offset: DVec3, unit: f64) -> u64 {
    const EXPONENT: u64 = 0x7ff0_0000_0000_0000;
    let unit = unit.to_bits() & EXPONENT;
    offset.to_array().into_iter().fold(0, |hash, along| {
        let relative = if along == 0.0 { 0 } else { along.to_bits().wrapping_sub(unit) };
        mix(hash ^ relative)
    })
}

/// The finalizer of SplitMix64: every bit of the result depends on every bit of `value`.
pub(super) fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ value >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ value >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ value >> 31
}
