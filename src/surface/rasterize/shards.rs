//! What is told of leaves by many threads at once.
//!
//! Particles of one leaf may be in any batch, and a shuffled file has some of every leaf in each. So what is
//! told goes straight to where the leaf is, in one of so many maps that threads seldom wait for each other. It must
//! not matter in which order it comes.

use std::sync::{Mutex, PoisonError};

use glam::IVec3;
use rustc_hash::FxHashMap;

use crate::surface::grid::LEAF_EDGE;

/// Maps from the origins of leaves, to be filled by many threads.
pub(super) struct Shards<T>(Vec<Mutex<Shard<T>>>);

/// What is told lies in one block of memory, which goes back to the system at once when it is freed; there are millions of leaves.
struct Shard<T> {
    /// Where what is told of each leaf is.
    places: FxHashMap<IVec3, u32>,
    told: Vec<T>,
}

/// Neighbours are in different maps.
const SHARD_COUNT: usize = 64;

impl<T> Shards<T> {
    pub(super) fn new() -> Shards<T> {
        let shard = || Mutex::new(Shard { places: FxHashMap::default(), told: Vec::new() });
        Shards((0..SHARD_COUNT).map(|_| shard()).collect())
    }

    /// Adds to what is known of a leaf, of which `first` is made where nothing is known yet.
    pub(super) fn add(&self, origin: IVec3, first: impl FnOnce() -> T, add: impl FnOnce(&mut T)) {
        // What is told is told whole, whatever panicked beside it.
        let mut shard = self.0[shard_of(origin)].lock().unwrap_or_else(PoisonError::into_inner);
        let Shard { places, told } = &mut *shard;
        let place = *places.entry(origin).or_insert_with(|| {
            told.push(first());
            told.len() as u32 - 1
        });
        add(&mut told[place as usize]);
    }

    /// Everything that was told.
    pub(super) fn into_told(self) -> Told<T> {
        let open = |shard: Mutex<_>| shard.into_inner().unwrap_or_else(PoisonError::into_inner);
        Told(self.0.into_iter().map(open).collect())
    }
}

/// What was told, by leaf.
pub(super) struct Told<T>(Vec<Shard<T>>);

impl<T> Told<T> {
    /// What was told of the leaf with this origin.
    pub(super) fn get(&self, origin: IVec3) -> Option<&T> {
        let Shard { places, told } = &self.0[shard_of(origin)];
        places.get(&origin).map(|&place| &told[place as usize])
    }

    /// Forgets a leaf, and returns what was told of it.
    pub(super) fn remove(&mut self, origin: IVec3) -> Option<&T> {
        let Shard { places, told } = &mut self.0[shard_of(origin)];
        places.remove(&origin).map(|place| &told[place as usize])
    }

    /// The leaves of which something was told, in no order.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&IVec3, &T)> {
        self.0.iter().flat_map(|Shard { places, told }| {
            places.iter().map(|(origin, &place)| (origin, &told[place as usize]))
        })
    }

    /// How many they are.
    pub(super) fn len(&self) -> usize {
        self.0.iter().map(|shard| shard.places.len()).sum()
    }
}

fn shard_of(origin: IVec3) -> usize {
    let [x, y, z] = (origin / LEAF_EDGE).to_array().map(|along| (along & 3) as usize);
    x * 16 + y * 4 + z
}
