//! The particles around a cell, in packets of eight.
//!
//! ```text
//!   cells around       ∙∙∙  ∙∙∙∙∙  ∙  ∙∙∙∙        relative to the corner of the particle's own cell
//!   packets            ∙∙∙∙∙∙∙∙ ∙∙∙∙∙○○○          all relative to the corner of the middle cell;
//!                                                ○: at infinity, so that every packet is full
//! ```
//!
//! The particles are gathered once for all points in the cell, and a kernel processes them eight at a time.
//!
//! With very many particles in a cell, comparing all pairs would take too long: a frame with all particles in
//! one position would never finish. So a cell with very many particles contributes only a sample, spread over
//! its particles in file order. Each sampled particle represents several; their number is its multiplicity.

use std::ops::Range;

use glam::IVec3;

use super::Neighbors;

/// Eight particles. Unused lanes are at infinity and have a multiplicity of 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Particle8 {
    /// x, y and z in edges of a cell, from the lower corner of the middle cell.
    pub along: [[f32; 8]; 3],
    /// The multiplicity: how many particles each lane represents.
    pub multiplicity: [f32; 8],
    /// The particles' indices in the input of the grid; [`NO_PARTICLE`] for an unused lane.
    pub indices: [u32; 8],
}

/// The index of an unused lane.
pub const NO_PARTICLE: u32 = u32::MAX;

impl Particle8 {
    const EMPTY: Particle8 =
        Particle8 { along: [[f32::INFINITY; 8]; 3], multiplicity: [0.0; 8], indices: [NO_PARTICLE; 8] };
}

/// The particles in a cell and its 26 neighbours.
#[derive(Clone, Debug, Default)]
pub struct NeighborPackets {
    eights: Vec<Particle8>,
    len: usize,
}

impl NeighborPackets {
    /// Replaces the contents by the particles around this cell, in the order of [`Neighbors::runs`]. Takes at
    /// most `cell_max` particles of each cell; a `cell_max` of 0 counts as 1.
    pub fn gather(&mut self, neighbors: &Neighbors, cell: IVec3, cell_max: usize) {
        self.eights.clear();
        self.len = 0;
        let cell_max = cell_max.max(1);
        for run in neighbors.runs(cell) {
            let step = run.step.as_vec3().to_array();
            if run.slots.len() <= cell_max {
                self.extend(neighbors, run.slots, step, 1.0);
                continue;
            }
            let multiplicity = run.slots.len() as f32 / cell_max as f32;
            for part in 0..cell_max {
                let slot = run.slots.start + chosen(run.slots.len(), part, cell_max);
                self.extend(neighbors, slot..slot + 1, step, multiplicity);
            }
        }
    }

    /// The packets.
    pub fn eights(&self) -> &[Particle8] {
        &self.eights
    }

    /// The number of particles.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    fn extend(&mut self, neighbors: &Neighbors, slots: Range<usize>, step: [f32; 3], multiplicity: f32) {
        let mut rest = slots;
        while !rest.is_empty() {
            let at = self.len % 8;
            if at == 0 {
                self.eights.push(Particle8::EMPTY);
            }
            let Some(eight) = self.eights.last_mut() else { return };
            let count = rest.len().min(8 - at);
            let from = rest.start..rest.start + count;
            for ((along, locals), step) in eight.along.iter_mut().zip(neighbors.locals()).zip(step) {
                for (along, local) in along[at..at + count].iter_mut().zip(&locals[from.clone()]) {
                    *along = local + step;
                }
            }
            eight.multiplicity[at..at + count].fill(multiplicity);
            eight.indices[at..at + count].copy_from_slice(&neighbors.indices()[from]);
            self.len += count;
            rest.start += count;
        }
    }
}

/// Splits `count` particles into `part_count` parts, and returns the particle that represents a part. It is
/// pseudo-random within the part, but always the same. One particle per part covers the whole file evenly; a
/// fixed stride would alias with rows in the file.
fn chosen(count: usize, part: usize, part_count: usize) -> usize {
    let bound = |part: usize| (part as u128 * count as u128 / part_count as u128) as usize;
    let (first, end) = (bound(part), bound(part + 1));
    // Multiplying by the golden ratio spreads consecutive numbers.
    let spread = (part as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
    first + ((spread as u128 * (end - first) as u128) >> 32) as usize
}
