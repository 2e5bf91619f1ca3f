//! Handles isolated points, without a particle within the radius: they get the values of the nearest particle
//! that reaches them.
//!
//! Such points occur around large particles: usually few, or the whole surface with per-particle radii. Only
//! particles that reach farther than the radius can serve them, so only these are sorted into a
//! [tree](super::tree). A point then visits a small part of them, however far they reach.

use glam::DVec3;
use rayon::prelude::*;

use super::blend::Blended;
use super::source::Source;
use super::tree::{Seen, Tree};
use super::{NO_PARTICLE, TransferCounts};

/// Assigns the values of the nearest particle to isolated points. Returns the number of isolated points, and
/// how many are left.
pub(super) fn serve(
    source: &Source,
    blended: &mut Blended,
    place_of: &(impl Fn(usize) -> DVec3 + Sync),
) -> TransferCounts {
    let is_lonely = |place: &usize| blended.nearest[*place] == NO_PARTICLE;
    let lonely: Vec<usize> = (0..blended.nearest.len()).filter(is_lonely).collect();
    let mut counts = TransferCounts { empty_count: lonely.len(), ..TransferCounts::default() };
    if lonely.is_empty() {
        return counts;
    }
    let see = |particle: u32| Seen {
        position: source.particles.position(particle as usize),
        limit_world: source.reach.limit_world(particle),
    };
    let tree = Tree::new(reaching(source, &see), &see);
    let nearest: Vec<u32> = lonely.par_iter().map(|&place| tree.nearest(place_of(place), see)).collect();
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

/// The particles that reach farther than the radius.
fn reaching(source: &Source, see: &(impl Fn(u32) -> Seen + Sync)) -> Vec<u32> {
    let end = u32::try_from(source.particles.len()).unwrap_or(NO_PARTICLE);
    let is_reaching = |&particle: &u32| {
        let Seen { position, limit_world } = see(particle);
        source.reach.radius_world < limit_world && position.is_finite()
    };
    (0..end).into_par_iter().filter(is_reaching).collect()
}
