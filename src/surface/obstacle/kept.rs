//! Leaves that are computed once: a frame asks for the same leaf in more than one stage, and of an obstacle that stands
//! still the next frame asks for it again.
//!
//! What is kept is what would be computed again, so nobody can tell whether it was. When the memory for it is used
//! up, what was kept makes room.

use std::sync::{Mutex, PoisonError};

use glam::IVec3;
use rustc_hash::FxHashMap;

use super::leaf::ObstacleLeaf;
use crate::surface::space::Lattice;

/// Leaves, in parts of which each has a lock of its own.
pub(super) struct KeptLeaves {
    shards: [Mutex<Shard>; SHARDS],
    /// What one part may take.
    most_bytes: usize,
}

#[derive(Default)]
struct Shard {
    leaves: FxHashMap<Key, ObstacleLeaf>,
    size_bytes: usize,
}

/// Origin, voxel size and half width.
type Key = (IVec3, u64, u32);

/// So many threads do not wait for each other.
const SHARDS: usize = 16;

/// What an entry of a map takes besides the leaf, with room to grow.
const ENTRY_BYTES: usize = 64;

impl KeptLeaves {
    pub(super) fn new(most_bytes: usize) -> KeptLeaves {
        KeptLeaves { shards: std::array::from_fn(|_| Mutex::default()), most_bytes: most_bytes / SHARDS }
    }

    /// The leaf that is kept, or the one that is computed.
    pub(super) fn get(
        &self,
        origin: IVec3,
        lattice: &Lattice,
        half_width: f32,
        compute: impl FnOnce() -> ObstacleLeaf,
    ) -> ObstacleLeaf {
        let key = (origin, lattice.voxel_size.to_bits(), half_width.to_bits());
        let place = (origin.x >> 3) ^ (origin.y >> 4) ^ (origin.z >> 5) ^ (origin.z >> 3);
        let shard = &self.shards[place.rem_euclid(SHARDS as i32) as usize];
        if let Some(leaf) = shard.lock().unwrap_or_else(PoisonError::into_inner).leaves.get(&key) {
            return leaf.clone();
        }
        let leaf = compute();
        let size = leaf.size_bytes() + ENTRY_BYTES;
        if size <= self.most_bytes {
            let mut shard = shard.lock().unwrap_or_else(PoisonError::into_inner);
            if shard.size_bytes + size > self.most_bytes {
                *shard = Shard::default();
            }
            // Another thread may have been first.
            if shard.leaves.insert(key, leaf.clone()).is_none() {
                shard.size_bytes += size;
            }
        }
        leaf
    }

    /// The memory that it takes, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        let size = |shard: &Mutex<Shard>| shard.lock().unwrap_or_else(PoisonError::into_inner).size_bytes;
        self.shards.iter().map(size).sum()
    }
    /// The memory that it may come to take, in bytes.
    pub(super) fn size_bytes_max(&self) -> usize {
        self.most_bytes.saturating_mul(SHARDS)
    }
}
