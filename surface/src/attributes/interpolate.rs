//! The weighted mean of the particles around a point, and the nearest of them.
//!
//! Points are processed cell by cell: the particles around a cell are gathered once. Their distances from a
//! point are computed eight at a time. The few particles within the radius are collected in a list, and the
//! means are computed from this list.

use glam::{DVec3, IVec3, Vec3};

use super::NO_PARTICLE;
use super::source::{NumericAttribute, TransferSource};
use crate::neighbors::{NeighborPackets, Particle8};
use crate::simd::{Kernel, Lanes, dispatch};

/// The interpolated values at some points.
pub(super) struct Interpolated {
    /// The means of each numeric attribute, point by point.
    pub(super) numbers: Vec<Vec<f32>>,
    /// The nearest particle of each point, or [`NO_PARTICLE`].
    pub(super) nearest: Vec<u32>,
}

/// Memory that is reused between chunks.
#[derive(Default)]
pub(super) struct Scratch {
    points: Vec<CellPoint>,
    around: NeighborPackets,
    near: Vec<WeightedParticle>,
}

/// A point in a cell.
struct CellPoint {
    cell: IVec3,
    /// Position relative to the cell's corner, in units of the radius.
    local: Vec3,
    index: u32,
}

/// A particle within the radius of a point.
#[derive(Clone, Copy)]
struct WeightedParticle {
    /// The squared distance, in units of the squared radius: less than 1. Later replaced by the weight.
    distance_squared: f32,
    /// Index among the near particles of the source.
    particle: u32,
}

/// The means at these points.
pub(super) fn interpolate(source: &TransferSource, points: &[DVec3], scratch: &mut Scratch) -> Interpolated {
    let Scratch { points: located, around, near } = scratch;
    let mut interpolated = Interpolated::empty(source, points.len());
    located.clear();
    located.extend((0u32..).zip(points).filter_map(|(index, &point)| {
        let (cell, local) = source.neighbors.locate(point)?;
        Some(CellPoint { cell, local, index })
    }));
    located.sort_unstable_by_key(|point| (point.cell.to_array(), point.index));
    for group in located.chunk_by(|one, next| one.cell == next.cell) {
        around.gather(&source.neighbors, group[0].cell, usize::MAX);
        dispatch(CellKernel {
            source,
            eights: around.eights(),
            group,
            near,
            interpolated: &mut interpolated,
        });
    }
    interpolated
}

impl Interpolated {
    /// Zeros, and no nearest particle.
    pub(super) fn empty(source: &TransferSource, count: usize) -> Interpolated {
        let numbers = source.numbers.iter().map(|numbers| vec![0.0; count * numbers.arity]).collect();
        Interpolated { numbers, nearest: vec![NO_PARTICLE; count] }
    }

    /// The results of all chunks, in order.
    pub(super) fn joined(source: &TransferSource, chunks: &[Interpolated]) -> Interpolated {
        let joined = |number: usize| {
            let chunks: Vec<&[f32]> = chunks.iter().map(|chunk| &*chunk.numbers[number]).collect();
            chunks.concat()
        };
        let nearest: Vec<&[u32]> = chunks.iter().map(|chunk| &*chunk.nearest).collect();
        Interpolated { numbers: (0..source.numbers.len()).map(joined).collect(), nearest: nearest.concat() }
    }
}

/// Kernel: the points in one cell.
struct CellKernel<'a> {
    source: &'a TransferSource<'a>,
    eights: &'a [Particle8],
    group: &'a [CellPoint],
    near: &'a mut Vec<WeightedParticle>,
    interpolated: &'a mut Interpolated,
}

impl Kernel for CellKernel<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let CellKernel { source, eights, group, near, interpolated } = self;
        for point in group {
            collect_near::<V>(eights, point.local, near);
            if near.is_empty() {
                continue;
            }
            let index = point.index as usize;
            interpolated.nearest[index] = source.original(nearest_of(near));
            // Replaces squared distances by weights.
            for near in near.iter_mut() {
                let rest = 1.0 - near.distance_squared;
                near.distance_squared = rest * rest * rest;
            }
            means::<V>(source, near, index, interpolated);
        }
    }
}

/// Collects the particles within the radius of a point.
#[inline(always)]
fn collect_near<V: Lanes>(eights: &[Particle8], point: Vec3, near: &mut Vec<WeightedParticle>) {
    let [x, y, z] = point.to_array().map(V::splat);
    near.clear();
    for eight in eights {
        let [dx, dy, dz] = [
            V::load(&eight.along[0]).sub(x),
            V::load(&eight.along[1]).sub(y),
            V::load(&eight.along[2]).sub(z),
        ];
        let distance_squared = dx.mul(dx).add(dy.mul(dy)).add(dz.mul(dz));
        let mut bits = V::bits(distance_squared.lt(V::splat(1.0)));
        if bits == 0 {
            continue;
        }
        let mut stored = [0.0; 8];
        distance_squared.store(&mut stored);
        while bits != 0 {
            let k = bits.trailing_zeros() as usize & 7;
            near.push(WeightedParticle { distance_squared: stored[k], particle: eight.indices[k] });
            bits &= bits - 1;
        }
    }
}

/// The nearest particle; on ties, the one with the lowest index.
#[inline(always)]
fn nearest_of(near: &[WeightedParticle]) -> u32 {
    let mut nearest = WeightedParticle { distance_squared: f32::INFINITY, particle: NO_PARTICLE };
    for other in near {
        let is_nearer = other.distance_squared < nearest.distance_squared
            || other.distance_squared == nearest.distance_squared && other.particle < nearest.particle;
        if is_nearer {
            nearest = *other;
        }
    }
    nearest.particle
}

/// The means of all attributes at a point. Squared distances have been replaced by weights.
#[inline(always)]
fn means<V: Lanes>(
    source: &TransferSource,
    near: &[WeightedParticle],
    index: usize,
    interpolated: &mut Interpolated,
) {
    let mut total = 0.0;
    for near in near {
        total += near.distance_squared;
    }
    for row in 0..source.row_count {
        let mean = mean_row::<V>(source, near, row, total);
        for (numbers, out) in source.numbers.iter().zip(&mut interpolated.numbers) {
            let Some(column) = numbers.column else { continue };
            // The columns of the attribute that are in this row.
            let first = column.max(8 * row);
            let end = (column + numbers.arity).min(8 * row + 8);
            for at in first..end {
                out[index * numbers.arity + at - column] = mean[at - 8 * row];
            }
        }
    }
    for (numbers, out) in source.numbers.iter().zip(&mut interpolated.numbers) {
        if numbers.column.is_none() {
            let out = &mut out[index * numbers.arity..(index + 1) * numbers.arity];
            mean_of_sound(source, numbers, near, out);
        }
    }
}

/// The means of a row of eight numbers.
#[inline(always)]
fn mean_row<V: Lanes>(
    source: &TransferSource,
    near: &[WeightedParticle],
    row: usize,
    total: f32,
) -> [f32; 8] {
    let mut sum = V::splat(0.0);
    let (mut least, mut greatest) = (V::splat(f32::INFINITY), V::splat(f32::NEG_INFINITY));
    for near in near {
        let values = V::load(&source.rows[near.particle as usize * source.row_count + row]);
        sum = sum.add(values.mul(V::splat(near.distance_squared)));
        least = least.min(values);
        greatest = greatest.max(values);
    }
    let mut mean = [0.0; 8];
    // If the sum overflows, the result is clamped to the range of the values, like any other result.
    sum.div(V::splat(total)).min(greatest).max(least).store(&mut mean);
    mean
}

/// The mean of an attribute over the particles with finite values. Without such particles, `out` is
/// unchanged.
#[inline(always)]
fn mean_of_sound(
    source: &TransferSource,
    numbers: &NumericAttribute,
    near: &[WeightedParticle],
    out: &mut [f32],
) {
    for (component, out) in out.iter_mut().enumerate() {
        let (mut sum, mut total) = (0.0, 0.0);
        let (mut least, mut greatest) = (f32::INFINITY, f32::NEG_INFINITY);
        for near in near {
            let value = numbers.of(source.original(near.particle))[component];
            if value.is_finite() {
                sum += value * near.distance_squared;
                total += near.distance_squared;
                least = least.min(value);
                greatest = greatest.max(value);
            }
        }
        if total > 0.0 {
            *out = (sum / total).min(greatest).max(least);
        }
    }
}
