//! Particles sorted into the leaves they lie in.
//!
//! ```text
//!   topology    leaf 0      leaf 1   leaf 2          leaves that hold a particle
//!   starts      0           3        4        9
//!   positions   p p p       p        p p p p p       in voxels, relative to the leaf's origin
//! ```
//!
//! Positions relative to the leaf are small numbers: 32 bits lose nothing that matters, however far
//! from the world's origin the particles are.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::grid::{LEAF_EDGE, Topology};
use crate::particles::Particles;
use crate::space::Lattice;

/// Particles by leaf.
#[derive(Clone, Debug, Default)]
pub struct ParticleBins {
    /// The leaves that hold at least one particle.
    pub topology: Topology,
    /// Where each leaf's particles start in `positions`; one more entry than leaves.
    starts: Vec<u32>,
    /// Positions in voxels relative to the origin of their leaf, 0 to 8 on each axis.
    positions: Vec<Vec3>,
    /// Particles left out: positions that are not finite, or outside the grid's range of indices.
    pub dropped_count: usize,
}

impl ParticleBins {
    /// Sorts the particles into leaves.
    pub fn new(particles: &Particles, lattice: &Lattice) -> ParticleBins {
        let placed: Vec<Option<(IVec3, Vec3)>> =
            (0..particles.len()).into_par_iter().map(|index| place(particles, index, lattice)).collect();
        let mut origins: Vec<IVec3> = placed.par_iter().flatten().map(|&(origin, _)| origin).collect();
        origins.dedup();
        let topology = Topology::new(origins);
        let leaf_of: Vec<u32> = placed
            .par_iter()
            .flatten()
            .map(|&(origin, _)| topology.find(origin).expect("the leaf was made for this particle") as u32)
            .collect();
        let mut starts = vec![0u32; topology.len() + 1];
        for &leaf in &leaf_of {
            starts[leaf as usize + 1] += 1;
        }
        for leaf in 0..topology.len() {
            starts[leaf + 1] += starts[leaf];
        }
        let mut cursor = starts.clone();
        let mut positions = vec![Vec3::ZERO; leaf_of.len()];
        for (&(_, local), &leaf) in placed.iter().flatten().zip(&leaf_of) {
            positions[cursor[leaf as usize] as usize] = local;
            cursor[leaf as usize] += 1;
        }
        let dropped_count = particles.len() - positions.len();
        ParticleBins { topology, starts, positions, dropped_count }
    }

    /// The particles of a leaf, relative to its origin, in voxels.
    pub fn in_leaf(&self, leaf: usize) -> &[Vec3] {
        &self.positions[self.starts[leaf] as usize..self.starts[leaf + 1] as usize]
    }

    /// The number of particles that were not dropped.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether every particle was dropped, or there was none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}

/// The leaf that a particle lies in, and its position relative to that, in voxels.
pub(super) fn place(particles: &Particles, index: usize, lattice: &Lattice) -> Option<(IVec3, Vec3)> {
    let position = lattice.index_from_world(particles.position(index))?;
    let edge = f64::from(LEAF_EDGE);
    let origin = (position / edge).floor() * edge;
    Some((origin.as_ivec3(), (position - origin).as_vec3()))
}
