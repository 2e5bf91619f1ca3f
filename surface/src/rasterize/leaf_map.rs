//! A map from leaf origins to values that many threads fill concurrently.
//!
//! Particles of one leaf can be in any batch, and in a shuffled file every batch has particles of every leaf.
//! So threads update the leaf's entry directly. The entries are in many shards with a lock each, so threads
//! seldom wait for each other. Updates arrive in any order, so the result must not depend on the order.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use glam::IVec3;
use rustc_hash::FxHashMap;

use crate::grid::LEAF_EDGE;

/// A sharded map from leaf origins to values, writable by many threads.
pub(super) struct ConcurrentLeafMap<T> {
    shards: Vec<Mutex<Shard<T>>>,
    leaf_count: AtomicUsize,
}

/// The values lie in one large memory block per shard, not in millions of small ones, so that freeing it
/// returns the memory to the system.
struct Shard<T> {
    /// Index in `values` of each leaf.
    slots: FxHashMap<IVec3, u32>,
    values: Vec<T>,
}

/// Number of shards. Adjacent leaves are in different shards.
const SHARD_COUNT: usize = 64;

impl<T> ConcurrentLeafMap<T> {
    pub(super) fn new() -> ConcurrentLeafMap<T> {
        let shard = || Mutex::new(Shard { slots: FxHashMap::default(), values: Vec::new() });
        ConcurrentLeafMap {
            shards: (0..SHARD_COUNT).map(|_| shard()).collect(),
            leaf_count: AtomicUsize::new(0),
        }
    }

    /// Number of leaves so far.
    pub(super) fn leaf_count(&self) -> usize {
        self.leaf_count.load(Ordering::Relaxed)
    }

    /// Updates the value of a leaf with `add`; creates it with `first` if it does not exist.
    pub(super) fn add(&self, origin: IVec3, first: impl FnOnce() -> T, add: impl FnOnce(&mut T)) {
        // Each update is applied under the lock, so a shard is consistent even if its lock is poisoned.
        let mut shard = self.shards[shard_of(origin)].lock().unwrap_or_else(PoisonError::into_inner);
        let Shard { slots, values } = &mut *shard;
        let slot = *slots.entry(origin).or_insert_with(|| {
            values.push(first());
            self.leaf_count.fetch_add(1, Ordering::Relaxed);
            values.len() as u32 - 1
        });
        add(&mut values[slot as usize]);
    }

    /// Turns the map into its read-only form.
    pub(super) fn freeze(self) -> LeafMap<T> {
        let open = |shard: Mutex<_>| shard.into_inner().unwrap_or_else(PoisonError::into_inner);
        LeafMap(self.shards.into_iter().map(open).collect())
    }
}

/// A map from leaf origins to values, without locks.
pub(super) struct LeafMap<T>(Vec<Shard<T>>);

impl<T> LeafMap<T> {
    /// The value of the leaf with this origin.
    pub(super) fn get(&self, origin: IVec3) -> Option<&T> {
        let Shard { slots, values } = &self.0[shard_of(origin)];
        slots.get(&origin).map(|&slot| &values[slot as usize])
    }

    /// Removes a leaf's key and returns its value.
    pub(super) fn remove(&mut self, origin: IVec3) -> Option<&T> {
        let Shard { slots, values } = &mut self.0[shard_of(origin)];
        slots.remove(&origin).map(|slot| &values[slot as usize])
    }

    /// All leaves and their values, unordered.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&IVec3, &T)> {
        self.0.iter().flat_map(|Shard { slots, values }| {
            slots.iter().map(|(origin, &slot)| (origin, &values[slot as usize]))
        })
    }
}

fn shard_of(origin: IVec3) -> usize {
    let [x, y, z] = (origin / LEAF_EDGE).to_array().map(|along| (along & 3) as usize);
    x * 16 + y * 4 + z
}
