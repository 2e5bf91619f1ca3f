//! The particles around a cell, by eights.
//!
//! ```text
//!   cells around       ∙∙∙  ∙∙∙∙∙  ∙  ∙∙∙∙        each counts from its own corner
//!   surroundings       ∙∙∙∙∙∙∙∙ ∙∙∙∙∙○○○          all count from the corner of the cell in the middle;
//! ```                                              ○: at infinity, so that every eight is full
//!
//! Gathered once, they serve every place in the cell, and a kernel goes through them eight at a time.
//!
//! Where cells hold very many particles, all pairs of them would take too long: a frame with all particles in one
//! place would take forever. So no more than some are taken of each cell, here and there in the order of the file,
//! and each stands for as many as there are for each that is taken.

use std::ops::Range;

use glam::IVec3;

use super::Neighbors;

/// Eight particles. Where there are fewer, the others are at infinity and stand for none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Eight {
    /// x, y and z in edges of a cell, from the least corner of the cell in the middle.
    pub along: [[f32; 8]; 3],
    /// How many particles each stands for.
    pub stands_for: [f32; 8],
    /// Their indices in what the grid was made from; [`NOBODY`] where there is none.
    pub indices: [u32; 8],
}

/// In place of the index of a particle: there is none.
pub const NOBODY: u32 = u32::MAX;

impl Eight {
    const EMPTY: Eight = Eight { along: [[f32::INFINITY; 8]; 3], stands_for: [0.0; 8], indices: [NOBODY; 8] };
}

/// The particles in a cell and in the 26 around it.
#[derive(Clone, Debug, Default)]
pub struct Surroundings {
    eights: Vec<Eight>,
    len: usize,
}

impl Surroundings {
    /// Takes the particles around this cell in place of what was here. They come in the order of [`Neighbors::runs`],
    /// and of each cell at most `cell_max`, but one.
    pub fn gather(&mut self, neighbors: &Neighbors, cell: IVec3, cell_max: usize) {
        self.eights.clear();
        self.len = 0;
        let cell_max = cell_max.max(1);
        for run in neighbors.runs(cell) {
            let step = run.step.as_vec3().to_array();
            if run.places.len() <= cell_max {
                self.extend(neighbors, run.places, step, 1.0);
                continue;
            }
            let stands_for = run.places.len() as f32 / cell_max as f32;
            for part in 0..cell_max {
                let place = run.places.start + chosen(run.places.len(), part, cell_max);
                self.extend(neighbors, place..place + 1, step, stands_for);
            }
        }
    }

    /// The particles.
    pub fn eights(&self) -> &[Eight] {
        &self.eights
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    fn extend(&mut self, neighbors: &Neighbors, places: Range<usize>, step: [f32; 3], stands_for: f32) {
        let mut rest = places;
        while !rest.is_empty() {
            let at = self.len % 8;
            if at == 0 {
                self.eights.push(Eight::EMPTY);
            }
            let Some(eight) = self.eights.last_mut() else { return };
            let count = rest.len().min(8 - at);
            let from = rest.start..rest.start + count;
            for ((along, locals), step) in eight.along.iter_mut().zip(neighbors.locals()).zip(step) {
                for (along, local) in along[at..at + count].iter_mut().zip(&locals[from.clone()]) {
                    *along = local + step;
                }
            }
            eight.stands_for[at..at + count].fill(stands_for);
            eight.indices[at..at + count].copy_from_slice(&neighbors.indices()[from]);
            self.len += count;
            rest.start += count;
        }
    }
}

/// Which of `count` is taken for one of so many parts of them: at random within the part, but always the same. One in
/// each part, so that no stretch of a file is left out; not every so many, for files have rows.
fn chosen(count: usize, part: usize, part_count: usize) -> usize {
    let bound = |part: usize| (part as u128 * count as u128 / part_count as u128) as usize;
    let (first, end) = (bound(part), bound(part + 1));
    // Multiplied by the golden ratio, numbers in a row are spread.
    let spread = (part as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
    first + ((spread as u128 * (end - first) as u128) >> 32) as usize
}
