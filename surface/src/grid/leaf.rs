//! Leaves of values, and the order of the voxels in them.

use bytemuck::{Pod, Zeroable};
use glam::IVec3;
use rayon::prelude::*;

use crate::parallel::Loops as _;

/// Voxels along an edge of a leaf: level sets are stored in blocks of 8³ voxels.
pub const LEAF_EDGE: i32 = 8;

/// Voxels in a leaf: 8³.
pub const LEAF_VOXELS: usize = 512;

/// Maximum number of leaves per task in loops that take microseconds per leaf. While no thread is idle, rayon
/// splits a loop into few tasks; without a limit, threads would wait while one of them finishes the last task.
pub const LEAVES_PER_TASK: usize = 16;

/// The 8 values of a row.
pub type Row = [f32; 8];

/// The 512 values of one leaf, z fastest.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C, align(64))]
pub struct Leaf {
    /// Value of voxel (x, y, z) at `x·64 + y·8 + z`.
    pub values: [f32; LEAF_VOXELS],
}

impl Leaf {
    /// A leaf with one value everywhere.
    pub const fn splat(value: f32) -> Leaf {
        Leaf { values: [value; LEAF_VOXELS] }
    }

    /// Row `x·8 + y`: the 8 values along z.
    #[inline(always)]
    pub fn row(&self, row: usize) -> &Row {
        &self.values.as_chunks::<8>().0[row]
    }

    /// Mutable row `x·8 + y`.
    #[inline(always)]
    pub fn row_mut(&mut self, row: usize) -> &mut Row {
        &mut self.values.as_chunks_mut::<8>().0[row]
    }

    /// The eight rows at `x` modulo 8.
    #[inline(always)]
    pub fn slab(&self, x: usize) -> &[Row; 8] {
        let slabs: &[[Row; 8]; 8] = bytemuck::cast_ref(&self.values);
        &slabs[x & 7]
    }

    /// The eight mutable rows at `x` modulo 8.
    #[inline(always)]
    pub fn slab_mut(&mut self, x: usize) -> &mut [Row; 8] {
        let slabs: &mut [[Row; 8]; 8] = bytemuck::cast_mut(&mut self.values);
        &mut slabs[x & 7]
    }
}

/// One value for every voxel of the leaves of a [`Topology`](crate::Topology), in the topology's
/// order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Field {
    /// One entry per leaf.
    pub leaves: Vec<Leaf>,
}

impl Field {
    /// A field of `leaf_count` leaves with the same value everywhere.
    pub fn splat(leaf_count: usize, value: f32) -> Field {
        // In parallel, because the first write to a page takes longest.
        Field { leaves: rayon::iter::repeat_n(Leaf::splat(value), leaf_count).collect() }
    }

    /// Copies the values of another field, and reuses this field's memory if that is large enough.
    pub fn copy_from(&mut self, other: &Field) {
        other.leaves.par_iter().copied().halved().collect_into_vec(&mut self.leaves);
    }

    /// The leaves as plain arrays, for writers that do not depend on the grid types.
    pub fn as_arrays(&self) -> &[[f32; LEAF_VOXELS]] {
        bytemuck::cast_slice(&self.leaves)
    }
}

/// Offset in its leaf of a voxel given relative to the leaf's origin (0 ..= 7 on each axis).
pub fn offset_in_leaf(voxel: IVec3) -> usize {
    debug_assert!(voxel.cmpge(IVec3::ZERO).all() && voxel.cmplt(IVec3::splat(LEAF_EDGE)).all());
    (voxel.x as usize) << 6 | (voxel.y as usize) << 3 | voxel.z as usize
}

/// The voxel at an offset in its leaf, relative to the leaf's origin.
pub fn voxel_in_leaf(offset: usize) -> IVec3 {
    debug_assert!(offset < LEAF_VOXELS);
    IVec3::new((offset >> 6) as i32, (offset >> 3 & 7) as i32, (offset & 7) as i32)
}
