//! Neighbour search in a sorted uniform grid.
//!
//! ```text
//!   ┌───┬───┬───┐     Cells are world-anchored, and their edge is the search radius: all particles within
//!   │ ∙ │∙ ∙│   │     the radius of a point in the middle cell are in one of these nine cells (27 in 3D).
//!   ├───┼───┼───┤
//!   │∙  │ ● │∙∙ │     x  y  z  index      sorted by cell, then in file order. x, y and z are relative
//!   ├───┼───┼───┤     x  y  z  index      to the cell's lower corner, in edge lengths: 0 to 1, so 32 bits
//!   │  ∙│∙  │  ∙│     …                   are precise enough, however far from the origin the cell is
//!   └───┴───┴───┘
//! ```
//!
//! Cells are sorted by x, then y, then z. Cells in a column along z are therefore adjacent, and one lookup
//! finds a whole column; empty cells take no memory.
//!
//! Invariants: the order depends on the particles only, not on threads. The data of a cell and its particles
//! depends on nothing outside the cell. Scaling positions and edge by a power of two changes no bit of the
//! data.

use std::ops::Range;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::cancel::checkpoint;
use crate::parallel::Loops as _;
use crate::particles::OwnedPositions;
use crate::space::{INDEX_LIMIT, Lattice};

/// Particles sorted into cells.
#[derive(Clone, Debug)]
pub struct Neighbors {
    cells: Lattice,
    /// Cells with particles, sorted.
    coords: Vec<IVec3>,
    /// Index of each cell's first particle; the last entry is the number of particles.
    starts: Vec<usize>,
    /// For each column (x, y), the range of its cells in `coords`.
    columns: FxHashMap<[i32; 2], Range<usize>>,
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
    indices: Vec<u32>,
    /// Number of particles left out: positions that are not finite or outside the range of indices, and all
    /// particles after the first 2³² − 1.
    pub dropped_count: usize,
}

/// The particles of a cell around another cell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CellRun {
    /// From the middle cell to this one: −1, 0 or 1 on each axis.
    pub step: IVec3,
    /// The indices of this cell's particles in the sorted order.
    pub slots: Range<usize>,
}

impl Neighbors {
    /// Sorts these particles into cells of this edge, world units. If the edge is not positive, the grid is
    /// empty.
    pub fn new(particles: &OwnedPositions, edge_world: f64) -> Neighbors {
        let cells = Lattice { voxel_size: edge_world };
        let keys = sorted_keys(particles, &cells);
        let (coords, starts) = cells_of(&keys);
        let columns = columns_of(&coords);
        let count = keys.len();
        let (mut x, mut y, mut z) = (vec![0.0; count], vec![0.0; count], vec![0.0; count]);
        let mut indices = vec![0; count];
        let axes = x.par_chunks_mut(PIECE).zip(y.par_chunks_mut(PIECE)).zip(z.par_chunks_mut(PIECE));
        axes.zip(indices.par_chunks_mut(PIECE)).zip(keys.par_chunks(PIECE)).halved().for_each(
            |((((x, y), z), indices), keys)| {
                checkpoint();
                for (slot, &key) in keys.iter().enumerate() {
                    let index = index_of(key);
                    // The particle was located when it was sorted, so this succeeds again.
                    let (_, local) =
                        cell_and_offset(particles.position(index as usize), &cells).unwrap_or_default();
                    (x[slot], y[slot], z[slot], indices[slot]) = (local.x, local.y, local.z, index);
                }
            },
        );
        let dropped_count = particles.len() - count;
        Neighbors { cells, coords, starts, columns, x, y, z, indices, dropped_count }
    }

    /// The edge of a cell, world units: the largest search radius for which all neighbours are found.
    pub fn edge_world(&self) -> f64 {
        self.cells.voxel_size
    }

    /// The cell that contains a world position, and the position relative to the cell's lower corner, in
    /// units of the edge. `None` if the position is not finite or outside the range of indices. Such a
    /// position has no neighbours.
    pub fn locate(&self, world: DVec3) -> Option<(IVec3, Vec3)> {
        cell_and_offset(world, &self.cells)
    }

    /// Cells with particles, sorted by x, then y, then z.
    pub fn cells(&self) -> &[IVec3] {
        &self.coords
    }

    /// The index range of the particles of `cells()[cell]`, in the sorted order.
    pub fn slots(&self, cell: usize) -> Range<usize> {
        self.starts[cell]..self.starts[cell + 1]
    }

    /// The cell of a particle in the sorted order, as an index into `cells()`; `cells().len()` if `slot` is
    /// past the last particle.
    pub fn cell_at(&self, slot: usize) -> usize {
        // The first cell starts at 0.
        self.starts.partition_point(|&start| start <= slot) - 1
    }

    /// For each particle in the sorted order, its index in the input.
    pub fn indices(&self) -> &[u32] {
        &self.indices
    }

    /// For each particle in the sorted order, x, y and z relative to its cell's lower corner, in units of the
    /// edge (0 to 1).
    pub fn locals(&self) -> [&[f32]; 3] {
        [&self.x, &self.y, &self.z]
    }

    /// The particles in a cell and its 26 neighbours, cell by cell, in cell order. They include all particles
    /// within one edge length of any point in the cell. Add `run.step` to their positions to make the
    /// positions relative to the lower corner of `cell`.
    pub fn runs(&self, cell: IVec3) -> impl Iterator<Item = CellRun> {
        COLUMNS.iter().flat_map(move |&[x, y]| {
            let column = self.columns.get(&[cell.x + x, cell.y + y]).cloned().unwrap_or_default();
            let first = column.start + self.coords[column.clone()].partition_point(|at| at.z < cell.z - 1);
            let near = (first..column.end).take_while(move |&other| self.coords[other].z <= cell.z + 1);
            near.map(move |other| CellRun { step: self.coords[other] - cell, slots: self.slots(other) })
        })
    }
}

impl CellRun {
    /// Some of the particles, evenly chosen, if there are very many; and how many each of them stands for.
    pub fn sampled(&self) -> (impl Iterator<Item = usize> + use<>, f64) {
        let stride = self.slots.len().div_ceil(SAMPLED_MAX).max(1);
        let multiplicity = self.slots.len() as f64 / self.slots.len().div_ceil(stride).max(1) as f64;
        (self.slots.clone().step_by(stride), multiplicity)
    }
}

/// The most particles of a run that are looked at.
const SAMPLED_MAX: usize = 512;

/// Number of particles per task.
const PIECE: usize = 1 << 13;

/// Steps in x and y to the columns around a cell.
const COLUMNS: [[i32; 2]; 9] = [[-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 0], [0, 1], [1, -1], [1, 0], [1, 1]];

/// A cell and the index of a particle in one number: x, y and z with 31 bits each, and the index with 35.
/// Sorting the keys sorts by cell, then by index.
type CellKey = u128;

const INDEX_BITS: u32 = 35;
const COORD_BITS: u32 = 31;

fn key_of(cell: IVec3, index: u32) -> CellKey {
    // Positions are in range, so no coordinate is negative after adding the limit.
    let [x, y, z] = cell.to_array().map(|along| CellKey::from(along.wrapping_add(INDEX_LIMIT) as u32));
    ((x << COORD_BITS | y) << COORD_BITS | z) << INDEX_BITS | CellKey::from(index)
}

fn index_of(key: CellKey) -> u32 {
    key as u32
}

fn cell_of(key: CellKey) -> IVec3 {
    let along = |above: u32| ((key >> (INDEX_BITS + above)) as u32 & (u32::MAX >> 1)) as i32 - INDEX_LIMIT;
    IVec3::new(along(2 * COORD_BITS), along(COORD_BITS), along(0))
}

fn sorted_keys(particles: &OwnedPositions, cells: &Lattice) -> Vec<CellKey> {
    let count = u32::try_from(particles.len()).unwrap_or(u32::MAX);
    let key = |index: u32| {
        let (cell, _) = cell_and_offset(particles.position(index as usize), cells)?;
        Some(key_of(cell, index))
    };
    let mut keys: Vec<CellKey> = (0..count).into_par_iter().halved().filter_map(key).collect();
    keys.par_sort_unstable();
    keys
}

fn cell_and_offset(world: DVec3, cells: &Lattice) -> Option<(IVec3, Vec3)> {
    let index = cells.index_from_world(world)?;
    let corner = index.floor();
    Some((corner.as_ivec3(), (index - corner).as_vec3()))
}

/// The cells, and for each cell the index of its first key; the last entry is the number of keys.
fn cells_of(keys: &[CellKey]) -> (Vec<IVec3>, Vec<usize>) {
    let (mut coords, mut starts) = (Vec::new(), Vec::new());
    for (slot, &key) in keys.iter().enumerate() {
        if slot == 0 || keys[slot - 1] >> INDEX_BITS != key >> INDEX_BITS {
            coords.push(cell_of(key));
            starts.push(slot);
        }
    }
    starts.push(keys.len());
    (coords, starts)
}

fn columns_of(coords: &[IVec3]) -> FxHashMap<[i32; 2], Range<usize>> {
    let mut columns = FxHashMap::default();
    let mut first = 0;
    for column in coords.chunk_by(|one, next| one.x == next.x && one.y == next.y) {
        columns.insert([column[0].x, column[0].y], first..first + column.len());
        first += column.len();
    }
    columns
}

// The particles around a cell, in packets of eight.
//
//   cells around       ∙∙∙  ∙∙∙∙∙  ∙  ∙∙∙∙        relative to the corner of the particle's own cell
//   packets            ∙∙∙∙∙∙∙∙ ∙∙∙∙∙○○○          all relative to the corner of the middle cell;
//                                                ○: at infinity, so that every packet is full
//
// The particles are gathered once for all points in the cell, and a kernel processes them eight at a time.
//
// With very many particles in a cell, comparing all pairs would take too long: a frame with all particles in
// one position would never finish. So a cell with very many particles contributes only a sample, spread over
// its particles in file order. Each sampled particle represents several; their number is its multiplicity.

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

#[cfg(test)]
mod tests;
