//! The nodes of the band at which means are computed: every second voxel along each axis.
//!
//! ```text
//!   ● ∙ ● ∙ ● ∙ ● ∙ ┊ ●      ● node. A leaf has 4 nodes along each axis. A voxel between two nodes gets the
//!   ∙ ∙ ∙ ∙ ∙ ∙ ∙ ∙ ┊        mean of both, so a leaf also needs the first nodes of the next leaves.
//!   ● ∙ ● ∙ ● ∙ ● ∙ ┊ ●
//! ```

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use crate::grid::{Leaf, NO_LEAF, Topology, offset_in_leaf};
use crate::level_set::NarrowBand;
use crate::parallel::Loops as _;
use crate::simd::{Kernel, Lanes, dispatch};
use crate::space::Lattice;

/// Nodes along an edge of a leaf.
pub(super) const NODE_EDGE: usize = 4;

/// For each leaf, a mask of its nodes that any voxel of the band needs: bit `x·16 + y·4 + z`.
pub(super) fn needed_nodes(band: &NarrowBand, half_width_voxels: f32) -> Vec<u64> {
    let leaves = &band.phi.leaves;
    let active: Vec<[u8; 64]> =
        leaves.par_iter().halved().map(|leaf| dispatch(ActiveRows { leaf, half_width_voxels })).collect();
    (0..leaves.len()).into_par_iter().halved().map(|leaf| needed_of(&band.topology, &active, leaf)).collect()
}

/// Kernel: for each row of a leaf, a mask of the voxels in the band.
struct ActiveRows<'a> {
    leaf: &'a Leaf,
    half_width_voxels: f32,
}

impl Kernel for ActiveRows<'_> {
    type Output = [u8; 64];

    #[inline(always)]
    fn run<V: Lanes>(self) -> [u8; 64] {
        let mut rows = [0; 64];
        for (row, bits) in rows.iter_mut().enumerate() {
            *bits = V::bits(V::load(self.leaf.row(row)).abs().lt(V::splat(self.half_width_voxels)));
        }
        rows
    }
}

/// A mask of the needed nodes of a leaf: the nodes with a voxel of the band among the 27 voxels around them.
/// These voxels may be in a previous leaf.
fn needed_of(topology: &Topology, active: &[[u8; 64]], leaf: usize) -> u64 {
    let around = topology.neighborhood(leaf);
    let row = |x: i32, y: i32, leaf_z: i32| {
        let step = IVec3::new(i32::from(x >= 0), i32::from(y >= 0), 1 + leaf_z);
        match around[(9 * step.x + 3 * step.y + step.z) as usize] {
            NO_LEAF => 0,
            leaf => active[leaf as usize][((x & 7) << 3 | y & 7) as usize],
        }
    };
    let mut columns = [[0u8; 9]; 9];
    for (x, columns) in (-1..).zip(&mut columns) {
        for (y, column) in (-1..).zip(columns) {
            let here = row(x, y, 0);
            *column = (here | here << 1 | here >> 1 | row(x, y, -1) >> 7) & 0b0101_0101;
        }
    }
    let mut needed = 0;
    for x in 0..NODE_EDGE {
        for y in 0..NODE_EDGE {
            let near = columns[2 * x..2 * x + 3].iter().flat_map(|columns| &columns[2 * y..2 * y + 3]);
            let bits = near.fold(0, |any, column| any | column);
            for z in 0..NODE_EDGE {
                needed |= u64::from(bits >> (2 * z) & 1) << (16 * x + 4 * y + z);
            }
        }
    }
    needed
}

/// World positions of the needed nodes, leaf by leaf. For a node outside the fluid, the nearest point on the
/// surface.
pub(super) fn node_points(band: &NarrowBand, lattice: &Lattice, needed: &[u64]) -> Vec<DVec3> {
    let points = needed.par_iter().enumerate().halved().flat_map_iter(|(leaf, &nodes)| {
        let around = if nodes == 0 { [NO_LEAF; 27] } else { band.topology.neighborhood(leaf) };
        (0..64).filter(move |node| nodes >> node & 1 == 1).map(move |node: i32| {
            let voxel = IVec3::new(node >> 4, node >> 2 & 3, node & 3) * 2;
            let offset_from_surface = offset_from_surface(band, &around, leaf, voxel);
            ((band.topology.origins()[leaf] + voxel).as_dvec3() - offset_from_surface.as_dvec3())
                * lattice.voxel_size
        })
    });
    points.collect()
}

/// The vector from the nearest point on the surface to an outside voxel; zero for an inside voxel.
fn offset_from_surface(band: &NarrowBand, around: &[u32; 27], leaf: usize, voxel: IVec3) -> Vec3 {
    let leaves = &band.phi.leaves;
    let phi = leaves[leaf].values[offset_in_leaf(voxel)];
    if phi <= 0.0 {
        return Vec3::ZERO;
    }
    // The one-sided difference toward the neighbor that is nearer to the surface. Between two surfaces, this
    // picks one of them.
    let slope = |axis: usize| {
        let mut before = voxel;
        before[axis] -= 1;
        let mut after = voxel;
        after[axis] += 1;
        // A node is never the last voxel of a leaf, so the voxel after it is in the same leaf.
        let after = phi - leaves[leaf].values[offset_in_leaf(after)];
        let other = if before[axis] < 0 { around[CENTER - WEIGHTS[axis]] } else { leaf as u32 };
        before[axis] &= 7;
        let before = match other {
            NO_LEAF => 0.0,
            other => phi - leaves[other as usize].values[offset_in_leaf(before)],
        };
        if before > 0.0 && before >= after { before } else { -after.max(0.0) }
    };
    let slope = Vec3::new(slope(0), slope(1), slope(2));
    if slope == Vec3::ZERO { Vec3::ZERO } else { slope.normalize() * phi }
}

/// Slot of a leaf in its own neighborhood, and the strides of the slots along each axis.
const CENTER: usize = 13;
const WEIGHTS: [usize; 3] = [9, 3, 1];
