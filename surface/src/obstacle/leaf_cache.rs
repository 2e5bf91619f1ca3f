//! A cache of leaves: a frame requests the same leaf in more than one stage, and if an obstacle is static the
//! next frame requests it again.
//!
//! A cached leaf equals the recomputed one, so the cache does not change results. A shard is cleared when it
//! would exceed its memory limit.

use std::sync::{Mutex, PoisonError};

use glam::IVec3;
use rustc_hash::FxHashMap;

use super::leaf::ObstacleLeaf;
use crate::space::Lattice;

/// The cache, in shards with one lock each.
pub(super) struct LeafCache {
    shards: [Mutex<CacheShard>; SHARDS],
    /// Memory limit of a shard, in bytes.
    shard_bytes_max: usize,
}

#[derive(Default)]
struct CacheShard {
    leaves: FxHashMap<CacheKey, ObstacleLeaf>,
    size_bytes: usize,
}

/// Origin of the leaf, and voxel size and half width as bits.
type CacheKey = (IVec3, u64, u32);

/// Number of shards: with more threads than this, some may wait for each other.
const SHARDS: usize = 16;

/// Estimated memory of a map entry besides the leaf, with spare capacity.
const ENTRY_BYTES: usize = 64;

impl LeafCache {
    pub(super) fn new(shard_bytes_max: usize) -> LeafCache {
        LeafCache {
            shards: std::array::from_fn(|_| Mutex::default()),
            shard_bytes_max: shard_bytes_max / SHARDS,
        }
    }

    /// Returns the cached leaf, or computes and caches it.
    pub(super) fn get(
        &self,
        origin: IVec3,
        lattice: &Lattice,
        half_width: f32,
        compute: impl FnOnce() -> ObstacleLeaf,
    ) -> ObstacleLeaf {
        let key = (origin, lattice.voxel_size.to_bits(), half_width.to_bits());
        let hash = (origin.x >> 3) ^ (origin.y >> 4) ^ (origin.z >> 5) ^ (origin.z >> 3);
        let shard = &self.shards[hash.rem_euclid(SHARDS as i32) as usize];
        if let Some(leaf) = shard.lock().unwrap_or_else(PoisonError::into_inner).leaves.get(&key) {
            return leaf.clone();
        }
        let leaf = compute();
        let size = leaf.size_bytes() + ENTRY_BYTES;
        if size <= self.shard_bytes_max {
            let mut shard = shard.lock().unwrap_or_else(PoisonError::into_inner);
            if shard.size_bytes + size > self.shard_bytes_max {
                *shard = CacheShard::default();
            }
            // Another thread may have inserted the leaf first.
            if shard.leaves.insert(key, leaf.clone()).is_none() {
                shard.size_bytes += size;
            }
        }
        leaf
    }

    /// The memory of the cache, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        let size =
            |shard: &Mutex<CacheShard>| shard.lock().unwrap_or_else(PoisonError::into_inner).size_bytes;
        self.shards.iter().map(size).sum()
    }
    /// Upper limit of the memory of the cache, in bytes.
    pub(super) fn size_bytes_max(&self) -> usize {
        self.shard_bytes_max.saturating_mul(SHARDS)
    }
}
