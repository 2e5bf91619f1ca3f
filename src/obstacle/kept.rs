//! Leaves that are computed once: an obstacle that stands still has the same distances in every frame.
//!
//! What is kept is what would be computed again, so nobody can tell whether it was. When the memory for it is used
//! up, what is new is not kept.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};

use glam::IVec3;
use rustc_hash::FxHashMap;

use super::leaf::ObstacleLeaf;
use crate::space::Lattice;

/// Leaves of one lattice and half width.
pub(super) struct KeptLeaves {
    /// What the leaves are of: those of the first one.
    of: OnceLock<(Lattice, f32)>,
    shards: [Mutex<FxHashMap<IVec3, ObstacleLeaf>>; SHARDS],
    size_bytes: AtomicUsize,
    most_bytes: usize,
}

/// So many threads do not wait for each other.
const SHARDS: usize = 16;

/// What an entry of a map takes besides the leaf: its origin, and room to grow.
const ENTRY_BYTES: usize = 32;

impl KeptLeaves {
    pub(super) fn new(most_bytes: usize) -> KeptLeaves {
        KeptLeaves {
            of: OnceLock::new(),
            shards: std::array::from_fn(|_| Mutex::default()),
            size_bytes: AtomicUsize::new(0),
            most_bytes,
        }
    }

    /// The leaf that is kept, or the one that is computed.
    pub(super) fn get(
        &self,
        origin: IVec3,
        lattice: &Lattice,
        half_width: f32,
        compute: impl FnOnce() -> ObstacleLeaf,
    ) -> ObstacleLeaf {
        if *self.of.get_or_init(|| (*lattice, half_width)) != (*lattice, half_width) {
            return compute();
        }
        let place = (origin.x >> 3) ^ (origin.y >> 4) ^ (origin.z >> 5) ^ (origin.z >> 3);
        let shard = &self.shards[place.rem_euclid(SHARDS as i32) as usize];
        if let Some(leaf) = shard.lock().unwrap_or_else(PoisonError::into_inner).get(&origin) {
            return leaf.clone();
        }
        let leaf = compute();
        let size = leaf.size_bytes() + ENTRY_BYTES;
        if self.size_bytes.fetch_add(size, Ordering::Relaxed) + size <= self.most_bytes {
            let mut leaves = shard.lock().unwrap_or_else(PoisonError::into_inner);
            if leaves.insert(origin, leaf.clone()).is_none() {
                return leaf;
            }
        }
        // Another thread was first, or there is no room.
        self.size_bytes.fetch_sub(size, Ordering::Relaxed);
        leaf
    }

    /// The memory that it takes, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.size_bytes.load(Ordering::Relaxed)
    }
}
