//! Places without a particle within the radius: the nearest one up to the limit.
//!
//! They are few, around particles that are larger than others, so all particles are sorted once more for them,
//! into cells of the limit.

use glam::DVec3;
use rayon::prelude::*;

use super::blend::Blended;
use super::source::Source;
use super::{NO_PARTICLE, TransferCounts};
use crate::neighbors::{NOBODY, Neighbors, Surroundings};

/// Gives lonely places what the nearest particle has. Returns how many there were, and how many are left.
pub(super) fn serve(
    source: &Source,
    blended: &mut Blended,
    place_of: &(impl Fn(usize) -> DVec3 + Sync),
) -> TransferCounts {
    let is_lonely = |place: &usize| blended.nearest[*place] == NO_PARTICLE;
    let lonely: Vec<usize> = (0..blended.nearest.len()).filter(is_lonely).collect();
    let mut counts = TransferCounts { empty_count: lonely.len(), ..TransferCounts::default() };
    if lonely.is_empty() || source.reach.limit_world <= source.reach.radius_world {
        return counts;
    }
    let neighbors = Neighbors::new(source.particles, source.reach.limit_world);
    let nearest: Vec<u32> = lonely
        .par_iter()
        .map_init(Surroundings::default, |around, &place| nearest(&neighbors, place_of(place), around))
        .collect();
    for (place, particle) in lonely.into_iter().zip(nearest) {
        if particle == NO_PARTICLE {
            continue;
        }
        counts.empty_count -= 1;
        counts.lonely_count += 1;
        blended.nearest[place] = particle;
        for (numbers, out) in source.numbers.iter().zip(&mut blended.numbers) {
            let out = &mut out[place * numbers.arity..(place + 1) * numbers.arity];
            for (out, &value) in out.iter_mut().zip(numbers.of(particle)) {
                if value.is_finite() {
                    *out = value;
                }
            }
        }
    }
    counts
}

/// The nearest particle within the limit; of several, the first.
fn nearest(neighbors: &Neighbors, place: DVec3, around: &mut Surroundings) -> u32 {
    let Some((cell, local)) = neighbors.locate(place) else { return NO_PARTICLE };
    around.gather(neighbors, cell, usize::MAX);
    let (mut least, mut found) = (1.0, NO_PARTICLE);
    for eight in around.eights() {
        for k in 0..8 {
            let [x, y, z] = eight.along.map(|along| along[k]);
            let distance_squared = (glam::Vec3::new(x, y, z) - local).length_squared();
            let index = eight.indices[k];
            let is_nearer = distance_squared < least || distance_squared == least && index < found;
            if index != NOBODY && is_nearer {
                (least, found) = (distance_squared, index);
            }
        }
    }
    found
}
