//! Checks that particles are inside the mesh.
//!
//! A particle is inside if all corners of its cell are inside and no triangle passes through the cell. Signs
//! are stored as bits, so a few operations find these cells for a whole leaf:
//!
//! ```text
//!   signs    ○●●●●●●●│● next leaf        ● inside
//!   shifted  ●●●●●●●●│                   and: cells with both corners inside, on each axis
//! ```
//!
//! This settles nearly all particles. For the few others, [rays](super::rays) are cast through the mesh.
//! Where the mesh leaks, which means that it does not follow φ, particles count as outside.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::distances::is_inside_one;
use super::mesh_cells::{corner, with_all_corners};
use super::particle_checks::CheckedRegion;
use super::rays::not_enclosed;
use super::surfaces::ShapedParticles;
use crate::grid::{LEAF_EDGE, LeafMask, offset_in_leaf};
use crate::level_set::NarrowBand;
use crate::parallel::Loops as _;
use crate::simd::{Kernel, Lanes, dispatch};

/// The particles of a part that the mesh does not enclose, in voxels relative to the origin of their leaf,
/// and the number of exempt particles.
pub(super) fn particles_outside(part: &CheckedRegion) -> (Vec<(IVec3, Vec3)>, usize) {
    let shaped = ShapedParticles::of(part.bins);
    let shaped = shaped.as_ref();
    let origins = part.bins.topology.origins().par_iter().enumerate();
    let owned = origins.halved().filter(|(_, origin)| part.owned.contains(**origin));
    let found = owned.map(|(leaf, &origin)| dispatch(LeafParticles { part, leaf, origin }));
    let found: Vec<Undecided> = found.collect();
    let exempt_count = found.iter().map(|found| found.exempt_count).sum();
    let (leaking, others): (Vec<Undecided>, Vec<Undecided>) =
        found.into_iter().partition(|found| part.cells.is_leaking(found.origin));
    let particles = |found: Undecided| {
        let origin = found.origin;
        found.particles.into_iter().map(move |local| (origin, local))
    };
    let mut outside: Vec<(IVec3, Vec3)> = leaking.into_iter().flat_map(particles).collect();
    let doubtful: Vec<(IVec3, Vec3)> = others.into_iter().flat_map(particles).collect();
    outside.extend(not_enclosed(part, shaped, &doubtful));
    (outside, exempt_count)
}

/// How far outside the surface a particle is according to φ, in voxels; 0 if it is inside. φ is interpolated
/// between voxels. The particle must be outside the mesh; its position is relative to the origin of its leaf.
pub(super) fn depth_outside(band: &NarrowBand, origin: IVec3, local: Vec3) -> f32 {
    let cell = local.floor().as_ivec3();
    let part = local - cell.as_vec3();
    let depth: f32 = (0..8)
        .map(|number| {
            let step = corner(number);
            let weights = Vec3::select(step.cmpeq(IVec3::ONE), part, 1.0 - part);
            let phi = match band.topology.find_voxel(origin + cell + step) {
                Some((leaf, local)) => band.phi.leaves[leaf].values[offset_in_leaf(local)],
                // No surface is near an unstored voxel. The particle is outside the mesh, so the voxel counts
                // as outside, too.
                None => band.half_width,
            };
            weights.element_product() * phi
        })
        .sum();
    depth.max(0.0)
}

/// The particles of a leaf for which the cell masks do not prove that they are inside.
struct Undecided {
    origin: IVec3,
    particles: Vec<Vec3>,
    exempt_count: usize,
}

/// Finds the particles of a leaf that may be outside.
struct LeafParticles<'a> {
    part: &'a CheckedRegion<'a>,
    leaf: usize,
    origin: IVec3,
}

impl Kernel for LeafParticles<'_> {
    type Output = Undecided;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Undecided {
        let [known, with_unstored] = match self.part.cells.is_leaking(self.origin) {
            true => [LeafMask::EMPTY; 2],
            false => self.inside_cells(),
        };
        let exempt = self.part.exempt;
        let mut unsettled = Undecided { origin: self.origin, particles: Vec::new(), exempt_count: 0 };
        let CheckedRegion { bins, radii, .. } = self.part;
        for (index, &particle) in bins.range(self.leaf).zip(bins.in_leaf(self.leaf)) {
            // Particles in removed regions are not checked: φ is not stored there, so nothing is known about
            // them.
            if !exempt.is_empty() && exempt.particle(self.origin, particle) {
                unsettled.exempt_count += 1;
                continue;
            }
            let cell = particle.floor().as_ivec3();
            // Rounding may have moved a particle to the leaf's far side, into a cell of the next leaf.
            let is_in =
                |mask: &LeafMask| cell.max_element() < LEAF_EDGE && mask.contains(offset_in_leaf(cell));
            let is_sure = || radii.init * bins.shapes.inner_radius(index) > SURE_RADIUS;
            if !(is_in(&known) || is_in(&with_unstored) && is_sure()) {
                unsettled.particles.push(particle);
            }
        }
        unsettled
    }
}

/// An unstored voxel is inside if it lies in a particle. A ball with a radius above √3 voxels, the diagonal
/// of a cell, contains all corners of the cell that its centre lies in, wherever in the cell that is.
const SURE_RADIUS: f32 = 1.75;

impl LeafParticles<'_> {
    /// The cells of the leaf that no triangle passes through and whose corners are all inside: first with
    /// unstored voxels counted as outside, then with unstored voxels counted as inside.
    #[inline(always)]
    fn inside_cells(&self) -> [LeafMask; 2] {
        let CheckedRegion { band, cells, bins, .. } = self.part;
        [LeafMask::EMPTY, LeafMask::FULL].map(|unstored| {
            let masks = std::array::from_fn(|number| {
                let origin = self.origin + corner(number) * LEAF_EDGE;
                match band.topology.find(origin) {
                    Some(leaf) => cells.signs[leaf],
                    None if bins.is_deep(origin) => LeafMask::FULL,
                    None => unstored,
                }
            });
            let mut inside = with_all_corners(masks);
            if let Some(leaf) = band.topology.find(self.origin) {
                inside.remove_all(cells.of_leaf(leaf));
            }
            inside
        })
    }
}

/// Whether a voxel is inside. Where φ is stored, its sign decides. Elsewhere no surface is near, so the sign
/// of φ_0 decides. For example, a sphere may be so small that it contains no voxel: φ_0 is then positive at
/// all voxels around it, so none of them is stored for it, and they are outside.
pub(super) fn is_voxel_inside(part: &CheckedRegion, shaped: Option<&ShapedParticles>, voxel: IVec3) -> bool {
    if let Some((leaf, local)) = part.band.topology.find_voxel(voxel) {
        return part.cells.signs[leaf].contains(offset_in_leaf(local));
    }
    let local = voxel & IVec3::splat(LEAF_EDGE - 1);
    part.bins.is_deep(voxel - local)
        || is_inside_one(part.bins, shaped, voxel - local, local.as_vec3(), part.radii.init)
}
