//! Selects the part of a frame that a close-up shows: the one with the most visible edges, sheets and drops.
//!
//! ```text
//!   ∙∙∙∙∙∙∙∙∙∙∙∙∙∙∙∙∙∙∙∙     visible cells: they have particles, and no other cell hides them
//!   ∙∙∙∙∙┌──────┐∙∙∙∙∙∙
//!   ▒▒▒▒▒│▚▞▘▝▞▚│▒▒▒▒▒▒     the box with the highest count: a crown has more than calm water
//!   ▒▒▒▒▒└──────┘▒▒▒▒▒▒
//! ```
//!
//! The count of a box is a sum over its visible cells: each adds the number of its free faces (those without
//! a neighbour cell), minus one. A cell at the surface of calm water has one free face, and so adds nothing.

use std::collections::BTreeMap;

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use crate::surface::grid::FACE_STEPS;
use crate::surface::particles::OwnedPositions;

/// Edge of a cell, in particle spacings: wide enough that the cells of a body of liquid have no gaps between
/// them.
const CELL_SPACINGS: f64 = 2.0;

/// Edge of the box, in cells. Boxes overlap by half.
const BOX_CELLS: i32 = 8;

/// A cell hides the cells behind it up to this distance, in cells.
const HIDING_CELLS: i32 = 3 * BOX_CELLS;

/// The box of a close-up of these particles, seen from the direction `to_eye`: minimum and maximum corner in
/// world units. `None` if all particles are in a box of twice its edge, or there are none.
pub fn close_up(particles: &OwnedPositions, spacing: f64, to_eye: DVec3) -> Option<[DVec3; 2]> {
    let edge = CELL_SPACINGS * spacing;
    let cell = |index: usize| (particles.position(index) / edge).floor().as_ivec3().to_array();
    let mut cells: Vec<[i32; 3]> = (0..particles.len()).into_par_iter().map(cell).collect();
    cells.par_sort_unstable();
    cells.dedup();
    let extent = (0..3).map(|axis| {
        let along = || cells.iter().map(|cell| i64::from(cell[axis]));
        along().max().zip(along().min()).map_or(0, |(most, least)| most - least + 1)
    });
    if extent.max().is_none_or(|extent| extent <= 2 * i64::from(BOX_CELLS)) {
        return None;
    }
    let is_occupied = |cell: IVec3| cells.binary_search(&cell.to_array()).is_ok();
    let is_seen = |cell: IVec3| {
        let hides = |step: i32| {
            let towards = (f64::from(step) * to_eye.normalize_or_zero()).round().as_ivec3();
            let neighbor = cell.saturating_add(towards);
            neighbor != cell && is_occupied(neighbor)
        };
        !(1..=HIDING_CELLS).any(hides)
    };
    let free_faces = |cell: IVec3| {
        let is_free = |step: &IVec3| !is_occupied(cell.saturating_add(*step));
        FACE_STEPS.iter().filter(|step| is_free(step)).count() as u32
    };
    let seen: Vec<(IVec3, u32)> = cells
        .par_iter()
        .map(|&cell| IVec3::from(cell))
        .map(|cell| (cell, free_faces(cell).saturating_sub(1)))
        .filter(|&(cell, count)| count > 0 && is_seen(cell))
        .collect();
    let mut counts: BTreeMap<[i32; 3], u32> = BTreeMap::new();
    let half = BOX_CELLS / 2;
    for (cell, count) in seen {
        let last = cell.div_euclid(IVec3::splat(half));
        for corner in 0..8 {
            let back = IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2);
            *counts.entry(last.saturating_sub(back).to_array()).or_default() += count;
        }
    }
    // Of several maxima the first is taken: `max_by_key` returns the last, so the order is reversed.
    let (most, _) = counts.iter().rev().max_by_key(|(_, count)| **count)?;
    let least = IVec3::from(*most).as_dvec3() * f64::from(half) * edge;
    Some([least, least + f64::from(BOX_CELLS) * edge])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A pool of 100 × 3 × 100 particles, and the particles `more`.
    fn pool(more: impl Iterator<Item = [f64; 3]>) -> OwnedPositions {
        let of_pool = (0..30_000)
            .map(|index| [index % 100, index / 100 % 3, index / 300].map(|along| f64::from(along) * 0.1));
        OwnedPositions::F64(of_pool.chain(more).collect())
    }

    #[test]
    fn close_up_of_a_pool_shows_its_crown() {
        let crown = (0..300).map(|index| {
            let (angle, height) = (f64::from(index % 60) / 60.0 * std::f64::consts::TAU, index / 60);
            [7.0 + 0.6 * angle.cos(), 0.3 + 0.1 * f64::from(height), 3.0 + 0.6 * angle.sin()]
        });
        let from_above = DVec3::new(0.3, 0.5, 0.8);
        let [least, greatest] = close_up(&pool(crown), 0.1, from_above).expect("large");
        let middle = DVec3::new(7.0, 0.4, 3.0);
        assert!(least.cmplt(middle).all() && greatest.cmpgt(middle).all(), "{least} {greatest}");
        assert!(((greatest - least) - 1.6).abs().max_element() < 1e-9);
    }

    #[test]
    fn hidden_cells_do_not_count() {
        // Loose particles below the pool, and fewer of them above.
        let loose = |count: usize, x: f64, y: f64| {
            (0..count).map(move |index| {
                let [a, b, c] = [index % 4, index / 4 % 4, index / 16].map(|along| 0.4 * along as f64);
                [x + a, y + b, 5.0 + c]
            })
        };
        let particles = pool(loose(64, 2.0, -2.0).chain(loose(32, 7.0, 0.5)));
        let [least, greatest] = close_up(&particles, 0.1, DVec3::Y).expect("large");
        assert!(least.x < 7.6 && greatest.x > 7.6, "{least} {greatest}");
    }

    #[test]
    fn small_frame_has_no_close_up() {
        assert_eq!(close_up(&OwnedPositions::F64(Vec::new()), 0.1, DVec3::Y), None);
        let few = OwnedPositions::F64((0..30).map(|index| [f64::from(index) * 0.1, 0.0, 0.0]).collect());
        assert_eq!(close_up(&few, 0.1, DVec3::Y), None);
    }
}
