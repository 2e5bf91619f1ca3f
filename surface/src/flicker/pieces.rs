//! The pieces of a surface, and those that no fluid explains.
//!
//! ```text
//!    ╭─────────╮    ╭──╮   ╭╮
//!    │ ∙  ∙  ∙ │    │  │   │∙∙      a ghost encloses no particles, or less than half of their volume:
//!    │  ∙  ∙   │    ╰──╯   ╰╯       an average over time can leave such pieces where fluid was, or will be
//!    ╰─────────╯   ghost   ghost
//! ```
//!
//! A piece is what edges join. A particle belongs to the piece that is nearest to it, if it is inside. Pieces with
//! negative volume are the walls of cavities.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::FlickerFrame;
use crate::parallel::Loops as _;

/// What a surface encloses.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Enclosed {
    /// The volume in cubic spacings.
    pub volume: f64,
    /// The number of pieces.
    pub piece_count: usize,
    /// The number of ghosts among them.
    pub ghost_count: usize,
}

/// A piece with a smaller share of its particles' volume is a ghost.
const GHOST_SHARE: f64 = 0.5;

/// Measures the surface of a frame whose particles are `spacing` apart, world units.
pub fn enclosed(frame: &FlickerFrame, spacing: f64) -> Enclosed {
    let triangles = frame.surface.triangles();
    let (piece_of, piece_count) = pieces(triangles);
    // Volumes relative to a corner of each piece, to keep precision far from the origin.
    let mut origins: Vec<Option<DVec3>> = vec![None; piece_count];
    let mut volumes = vec![0.0; piece_count];
    for ([a, b, c], &piece) in triangles.iter().zip(&piece_of) {
        let origin = *origins[piece].get_or_insert(*a);
        volumes[piece] += (a - origin).dot((b - origin).cross(c - origin)) / 6.0;
    }
    let mut counts = vec![0_usize; piece_count];
    for piece in particles_inside(frame, &piece_of).into_iter().flatten() {
        counts[piece] += 1;
    }
    let particle_volume = spacing * spacing * spacing;
    let is_ghost = |(volume, count): (&f64, &usize)| {
        *volume > 0.0 && (*count == 0 || *volume < GHOST_SHARE * particle_volume * *count as f64)
    };
    Enclosed {
        volume: volumes.iter().sum::<f64>() / particle_volume,
        piece_count: volumes.iter().filter(|volume| **volume > 0.0).count(),
        ghost_count: volumes.iter().zip(&counts).filter(|piece| is_ghost(*piece)).count(),
    }
}

/// The piece of each particle; `None` for those outside.
fn particles_inside(frame: &FlickerFrame, piece_of: &[usize]) -> Vec<Option<usize>> {
    let positions = frame.particles.positions();
    let piece = |index: usize| {
        let position = positions.position(index);
        let (distance, triangle) =
            frame.surface.distance_and_triangle(position.is_finite().then_some(position)?)?;
        (distance <= 0.0).then(|| piece_of[triangle])
    };
    (0..positions.len()).into_par_iter().halved().map(piece).collect()
}

/// The piece of each triangle, and the number of pieces.
fn pieces(triangles: &[[DVec3; 3]]) -> (Vec<usize>, usize) {
    let mut parents: Vec<u32> = (0..triangles.len() as u32).collect();
    fn root(parents: &mut [u32], mut index: u32) -> u32 {
        while parents[index as usize] != index {
            parents[index as usize] = parents[parents[index as usize] as usize];
            index = parents[index as usize];
        }
        index
    }
    // Adding 0 makes −0 equal to 0.
    let key = |corner: DVec3| (corner + 0.0).to_array().map(f64::to_bits);
    let mut first: FxHashMap<[[u64; 3]; 2], u32> = FxHashMap::default();
    for (corners, index) in triangles.iter().zip(0..) {
        let keys = corners.map(key);
        for [one, other] in [[0, 1], [1, 2], [2, 0]] {
            let edge = [keys[one].min(keys[other]), keys[one].max(keys[other])];
            let joined = *first.entry(edge).or_insert(index);
            let roots = [joined, index].map(|index| root(&mut parents, index));
            parents[roots[1] as usize] = roots[0];
        }
    }
    let mut numbers: FxHashMap<u32, usize> = FxHashMap::default();
    let mut number_of = |index: u32| {
        let root = root(&mut parents, index);
        let next = numbers.len();
        *numbers.entry(root).or_insert(next)
    };
    let piece_of = (0..triangles.len() as u32).map(&mut number_of).collect();
    (piece_of, numbers.len())
}
