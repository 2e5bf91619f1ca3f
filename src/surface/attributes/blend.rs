//! The mean of the particles around a place, and the nearest of them.
//!
//! Places are taken cell by cell: the particles around a cell are gathered once. Their distances from a place are
//! computed eight at a time; the few that are within the radius go on a list, and the list gives the means.

use glam::{DVec3, IVec3, Vec3};

use super::NO_PARTICLE;
use super::source::{Numbers, Source};
use crate::surface::neighbors::{Eight, Surroundings};
use crate::surface::simd::{Kernel, Lanes, dispatch};

/// What was found at some places.
pub(super) struct Blended {
    /// The means of each attribute that is numbers, place by place.
    pub(super) numbers: Vec<Vec<f32>>,
    /// The nearest particle of each place, or [`NO_PARTICLE`].
    pub(super) nearest: Vec<u32>,
}

/// Memory for one piece after the other.
#[derive(Default)]
pub(super) struct Scratch {
    places: Vec<Place>,
    around: Surroundings,
    near: Vec<Near>,
}

/// A place in a cell.
struct Place {
    cell: IVec3,
    /// From the cell's corner, in radii.
    local: Vec3,
    index: u32,
}

/// A particle within the radius of a place.
#[derive(Clone, Copy)]
struct Near {
    /// In radii, less than 1.
    distance_squared: f32,
    /// Its index among those near any place.
    particle: u32,
}

/// The means at these places.
pub(super) fn blend(source: &Source, places: &[DVec3], scratch: &mut Scratch) -> Blended {
    let Scratch { places: located, around, near } = scratch;
    let mut blended = Blended::empty(source, places.len());
    located.clear();
    located.extend((0u32..).zip(places).filter_map(|(index, &place)| {
        let (cell, local) = source.neighbors.locate(place)?;
        Some(Place { cell, local, index })
    }));
    located.sort_unstable_by_key(|place| (place.cell.to_array(), place.index));
    for group in located.chunk_by(|one, next| one.cell == next.cell) {
        around.gather(&source.neighbors, group[0].cell, usize::MAX);
        dispatch(CellKernel { source, eights: around.eights(), group, near, blended: &mut blended });
    }
    blended
}

impl Blended {
    /// Zeros, and no particle.
    pub(super) fn empty(source: &Source, count: usize) -> Blended {
        let numbers = source.numbers.iter().map(|numbers| vec![0.0; count * numbers.arity]).collect();
        Blended { numbers, nearest: vec![NO_PARTICLE; count] }
    }

    /// What was found in all pieces, in order.
    pub(super) fn joined(source: &Source, pieces: &[Blended]) -> Blended {
        let joined = |number: usize| {
            let pieces: Vec<&[f32]> = pieces.iter().map(|piece| &*piece.numbers[number]).collect();
            pieces.concat()
        };
        let nearest: Vec<&[u32]> = pieces.iter().map(|piece| &*piece.nearest).collect();
        Blended { numbers: (0..source.numbers.len()).map(joined).collect(), nearest: nearest.concat() }
    }
}

/// The places in one cell.
struct CellKernel<'a> {
    source: &'a Source<'a>,
    eights: &'a [Eight],
    group: &'a [Place],
    near: &'a mut Vec<Near>,
    blended: &'a mut Blended,
}

impl Kernel for CellKernel<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let CellKernel { source, eights, group, near, blended } = self;
        for place in group {
            collect_near::<V>(eights, place.local, near);
            if near.is_empty() {
                continue;
            }
            let index = place.index as usize;
            blended.nearest[index] = source.original(nearest_of(near));
            // From here on distances are weights.
            for near in near.iter_mut() {
                let rest = 1.0 - near.distance_squared;
                near.distance_squared = rest * rest * rest;
            }
            means::<V>(source, near, index, blended);
        }
    }
}

/// The particles within the radius of a place.
#[inline(always)]
fn collect_near<V: Lanes>(eights: &[Eight], place: Vec3, near: &mut Vec<Near>) {
    let [x, y, z] = place.to_array().map(V::splat);
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
            near.push(Near { distance_squared: stored[k], particle: eight.indices[k] });
            bits &= bits - 1;
        }
    }
}

/// The nearest of some; of several, the one with the least index.
#[inline(always)]
fn nearest_of(near: &[Near]) -> u32 {
    let mut nearest = Near { distance_squared: f32::INFINITY, particle: NO_PARTICLE };
    for other in near {
        let is_nearer = other.distance_squared < nearest.distance_squared
            || other.distance_squared == nearest.distance_squared && other.particle < nearest.particle;
        if is_nearer {
            nearest = *other;
        }
    }
    nearest.particle
}

/// The means of all attributes at a place, by weights in place of distances.
#[inline(always)]
fn means<V: Lanes>(source: &Source, near: &[Near], index: usize, blended: &mut Blended) {
    let mut total = 0.0;
    for near in near {
        total += near.distance_squared;
    }
    for row in 0..source.row_count {
        let mean = mean_row::<V>(source, near, row, total);
        for (numbers, out) in source.numbers.iter().zip(&mut blended.numbers) {
            let Some(column) = numbers.column else { continue };
            // The part of the attribute that is in this row.
            let first = column.max(8 * row);
            let end = (column + numbers.arity).min(8 * row + 8);
            for at in first..end {
                out[index * numbers.arity + at - column] = mean[at - 8 * row];
            }
        }
    }
    for (numbers, out) in source.numbers.iter().zip(&mut blended.numbers) {
        if numbers.column.is_none() {
            let out = &mut out[index * numbers.arity..(index + 1) * numbers.arity];
            mean_of_sound(source, numbers, near, out);
        }
    }
}

/// The means of a row of eight numbers.
#[inline(always)]
fn mean_row<V: Lanes>(source: &Source, near: &[Near], row: usize, total: f32) -> [f32; 8] {
    let mut sum = V::splat(0.0);
    let (mut least, mut greatest) = (V::splat(f32::INFINITY), V::splat(f32::NEG_INFINITY));
    for near in near {
        let values = V::load(&source.rows[near.particle as usize * source.row_count + row]);
        sum = sum.add(values.mul(V::splat(near.distance_squared)));
        least = least.min(values);
        greatest = greatest.max(values);
    }
    let mut mean = [0.0; 8];
    // Where the sum is beyond all numbers, what comes of it is cut like the rest.
    sum.div(V::splat(total)).min(greatest).max(least).store(&mut mean);
    mean
}

/// The means of an attribute over those particles whose values are finite; what was there if there is none.
#[inline(always)]
fn mean_of_sound(source: &Source, numbers: &Numbers, near: &[Near], out: &mut [f32]) {
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
