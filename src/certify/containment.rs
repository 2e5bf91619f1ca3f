//! Whether particles are inside the surface.
//!
//! A particle is inside where φ, interpolated in its cell, is negative. Where all corners of the cell are inside,
//! that is plain; signs are bits, and bits tell of a whole leaf at once in which of its cells that is so:
//!
//! ```text
//!   signs    ○●●●●●●●│● next leaf        ● inside
//!   shifted  ●●●●●●●●│                   both: cells with both corners inside, and so on each axis
//! ```
//!
//! Nearly all particles are settled so. The few others are looked at one by one.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::distances::is_inside_one;
use super::particle_checks::Part;
use super::surfaces::Bodies;
use crate::grid::{LEAF_EDGE, LeafMask, negative_masks, offset_in_leaf};
use crate::simd::{Kernel, Lanes, dispatch};

/// How many particles of a part have φ ≥ 0, interpolated trilinearly, though they should not; and how many are exempt.
pub(super) fn particles_outside(part: &Part) -> [usize; 2] {
    let signs = negative_masks(&part.band.phi);
    let bodies = Bodies::of(part.bins);
    let bodies = bodies.as_ref();
    let origins = part.bins.topology.origins().par_iter().enumerate();
    let owned = origins.filter(|(_, origin)| part.owned.contains(**origin));
    let counts =
        owned.map(|(leaf, &origin)| dispatch(LeafParticles { part, bodies, signs: &signs, leaf, origin }));
    counts.reduce(|| [0; 2], |one, other| [one[0] + other[0], one[1] + other[1]])
}

/// Counts the particles of a leaf that are outside.
struct LeafParticles<'a> {
    part: &'a Part<'a>,
    bodies: Option<&'a Bodies<'a>>,
    /// For each leaf of the band the voxels inside.
    signs: &'a [LeafMask],
    leaf: usize,
    origin: IVec3,
}

impl Kernel for LeafParticles<'_> {
    type Output = [usize; 2];

    #[inline(always)]
    fn run<V: Lanes>(self) -> [usize; 2] {
        let inside = self.inside_cells();
        let is_outside = |position: &&Vec3| {
            let cell = position.floor().as_ivec3();
            // Rounding may have put a particle on the leaf's far side, into a cell of the next one.
            let is_settled = cell.max_element() < LEAF_EDGE && inside.contains(offset_in_leaf(cell));
            !is_settled && phi_at(self.part, self.bodies, self.origin, **position) >= 0.0
        };
        let (particles, exempt) = (self.part.bins.in_leaf(self.leaf), self.part.exempt);
        if exempt.is_nothing() {
            return [particles.iter().filter(is_outside).count(), 0];
        }
        // What was taken away is not looked for: where nothing is stored any more, nobody knows what was.
        let (gone, asked): (Vec<Vec3>, Vec<Vec3>) =
            particles.iter().partition(|particle| exempt.particle(self.origin, **particle));
        [asked.iter().filter(is_outside).count(), gone.len()]
    }
}

/// Unstored voxels are inside if a particle is nearer than r_init. With a larger one they are at all corners of a
/// particle's cell, the diagonal of which is √3.
const SURE_RADIUS: f32 = 1.75;

impl LeafParticles<'_> {
    /// The leaf's cells that have all corners inside.
    #[inline(always)]
    fn inside_cells(&self) -> LeafMask {
        let beyond = if self.part.radii.init * self.part.radii.shortest > SURE_RADIUS {
            LeafMask::FULL
        } else {
            LeafMask::EMPTY
        };
        let topology = &self.part.band.topology;
        let mut masks = [beyond; 8];
        for (place, mask) in masks.iter_mut().enumerate() {
            if let Some(leaf) = topology.find(self.origin + corner(place) * LEAF_EDGE) {
                *mask = self.signs[leaf];
            }
        }
        // Along z, then y, then x; of the leaves after, just their nearest voxels count.
        for place in [0, 2, 4, 6] {
            let after = masks[place + 1].words;
            masks[place].words.iter_mut().zip(after).for_each(|(word, after)| {
                *word &= *word >> 1 & !LAST_Z | after << 7 & LAST_Z;
            });
        }
        for place in [0, 4] {
            let after = masks[place + 2].words;
            masks[place]
                .words
                .iter_mut()
                .zip(after)
                .for_each(|(word, after)| *word &= *word >> 8 | after << 56);
        }
        let [mut cells, .., after, _, _, _] = masks;
        for x in 0..8 {
            cells.words[x] &= if x < 7 { cells.words[x + 1] } else { after.words[0] };
        }
        cells
    }
}

/// In each row of a word the voxel that is last along z.
const LAST_Z: u64 = 0x8080_8080_8080_8080;

/// Corner `4x + 2y + z` of a cell.
fn corner(number: usize) -> IVec3 {
    IVec3::new((number >> 2) as i32, (number >> 1 & 1) as i32, (number & 1) as i32)
}

/// φ at a particle, given relative to a leaf's origin, in voxels.
fn phi_at(part: &Part, bodies: Option<&Bodies>, origin: IVec3, position: Vec3) -> f64 {
    let cell = position.floor();
    let fraction = (position - cell).as_dvec3();
    let mut phi = 0.0;
    for step in (0..8).map(corner) {
        let weight = DVec3::select(step.cmpeq(IVec3::ONE), fraction, 1.0 - fraction).element_product();
        if weight > 0.0 {
            phi += weight * f64::from(phi_at_voxel(part, bodies, origin + cell.as_ivec3() + step));
        }
    }
    phi
}

/// φ at a voxel. Where it is not stored there is no surface near: deep inside if φ_0 is negative,
/// and outside otherwise, as around spheres so small that they fall between the voxels.
fn phi_at_voxel(part: &Part, bodies: Option<&Bodies>, voxel: IVec3) -> f32 {
    if let Some((leaf, local)) = part.band.topology.find_voxel(voxel) {
        return part.band.phi.leaves[leaf].values[offset_in_leaf(local)];
    }
    let local = voxel & IVec3::splat(LEAF_EDGE - 1);
    let is_inside = is_inside_one(part.bins, bodies, voxel - local, local.as_vec3(), part.radii.init);
    if is_inside { -part.band.half_width } else { part.band.half_width }
}
