//! The pieces of a surface, and those that no fluid explains.
//!
//! ```text
//!    ╭─────────╮    ╭──╮   ╭╮
//!    │ ∙  ∙  ∙ │    │  │   │∙∙      a ghost encloses no particles, or less than half of their volume:
//!    │  ∙  ∙   │    ╰──╯   ╰╯       an average over time can leave such pieces where fluid was, or will be
//!    ╰─────────╯   ghost   ghost
//! ```
//!
//! A shell is a set of triangles that are connected by common edges. A shell with positive volume is a piece;
//! one with negative volume is the wall of a cavity. A particle belongs to the nearest shell, if it is inside.

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
    /// The number of pieces. The wall of a cavity is not one.
    pub piece_count: usize,
    /// The number of ghosts among them.
    pub ghost_count: usize,
}

/// A piece with a smaller share of its particles' volume is a ghost.
const GHOST_SHARE: f64 = 0.5;

/// Measures the surface of a frame whose particles are `spacing` apart, world units.
pub fn enclosed(frame: &FlickerFrame, spacing: f64) -> Enclosed {
    let triangles = frame.surface.triangles();
    let (shell_of, shell_count) = shells(triangles);
    // Volumes relative to a corner of each shell, to keep precision far from the origin.
    let mut origins: Vec<Option<DVec3>> = vec![None; shell_count];
    let mut volumes = vec![0.0; shell_count];
    for ([a, b, c], &shell) in triangles.iter().zip(&shell_of) {
        let origin = *origins[shell].get_or_insert(*a);
        volumes[shell] += (a - origin).dot((b - origin).cross(c - origin)) / 6.0;
    }
    let mut counts = vec![0_usize; shell_count];
    for shell in shells_of_particles(frame, &shell_of).into_iter().flatten() {
        counts[shell] += 1;
    }
    let particle_volume = spacing * spacing * spacing;
    let is_ghost = |(volume, count): (&f64, &usize)| {
        *volume > 0.0 && (*count == 0 || *volume < GHOST_SHARE * particle_volume * *count as f64)
    };
    Enclosed {
        volume: volumes.iter().sum::<f64>() / particle_volume,
        piece_count: volumes.iter().filter(|volume| **volume > 0.0).count(),
        ghost_count: volumes.iter().zip(&counts).filter(|shell| is_ghost(*shell)).count(),
    }
}

/// The shell of each particle; `None` for those outside. `shell_of` is the shell of each triangle.
fn shells_of_particles(frame: &FlickerFrame, shell_of: &[usize]) -> Vec<Option<usize>> {
    let positions = frame.particles.positions();
    let shell = |index: usize| {
        let position = positions.position(index);
        if !position.is_finite() {
            return None;
        }
        let (distance, triangle) = frame.surface.distance_and_triangle(position)?;
        let is_inside = distance <= 0.0;
        is_inside.then(|| shell_of[triangle])
    };
    (0..positions.len()).into_par_iter().halved().map(shell).collect()
}

/// The shell of each triangle, and the number of shells.
fn shells(triangles: &[[DVec3; 3]]) -> (Vec<usize>, usize) {
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
    let shell_of = (0..triangles.len() as u32).map(&mut number_of).collect();
    (shell_of, numbers.len())
}
