//! Assigns values to isolated points, which have no particle within the radius: the values of the nearest
//! particle that reaches the point.
//!
//! Isolated points occur around large particles. Usually they are few; with per-particle radii, they may be
//! the whole surface. Only particles that reach farther than the radius can reach an isolated point, so only
//! these particles are sorted into a [tree](super::tree). The search for a point then visits a small part of
//! them, however far they reach.

use glam::DVec3;
use rayon::prelude::*;

use super::interpolate::Interpolated;
use super::source::TransferSource;
use super::tree::{Tree, TreeParticle};
use super::{NO_PARTICLE, TransferCounts};
use crate::interrupt::checkpoint;
use crate::parallel::Loops as _;

/// Assigns the values of the nearest particle to isolated points. Returns the number of points that got
/// values, and the number of points that no particle reaches.
pub(super) fn assign_nearest(
    source: &TransferSource,
    interpolated: &mut Interpolated,
    point_of: &(impl Fn(usize) -> DVec3 + Sync),
) -> TransferCounts {
    let is_isolated = |point: &usize| interpolated.nearest[*point] == NO_PARTICLE;
    let isolated: Vec<usize> = (0..interpolated.nearest.len()).filter(is_isolated).collect();
    let mut counts = TransferCounts { empty_count: isolated.len(), ..TransferCounts::default() };
    if isolated.is_empty() {
        return counts;
    }
    let particle_at = |particle: u32| TreeParticle {
        position: source.particles.position(particle as usize),
        limit_world: source.support.limit_world(particle),
    };
    let tree = Tree::new(reaching(source, &particle_at), &particle_at);
    let nearest = |&point: &usize| {
        checkpoint();
        tree.nearest(point_of(point), particle_at)
    };
    let nearest: Vec<u32> = isolated.par_iter().halved().map(nearest).collect();
    for (point, particle) in isolated.into_iter().zip(nearest) {
        if particle == NO_PARTICLE {
            continue;
        }
        counts.empty_count -= 1;
        counts.isolated_count += 1;
        interpolated.nearest[point] = particle;
        for (numbers, out) in source.numbers.iter().zip(&mut interpolated.numbers) {
            let out = &mut out[point * numbers.arity..(point + 1) * numbers.arity];
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
fn reaching(source: &TransferSource, particle_at: &(impl Fn(u32) -> TreeParticle + Sync)) -> Vec<u32> {
    let end = u32::try_from(source.particles.len()).unwrap_or(NO_PARTICLE);
    let is_reaching = |&particle: &u32| {
        let TreeParticle { position, limit_world } = particle_at(particle);
        source.support.radius_world < limit_world && position.is_finite()
    };
    (0..end).into_par_iter().halved().filter(is_reaching).collect()
}
