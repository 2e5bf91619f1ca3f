//! Where the particles of a sequence appeared, by their ids.
//!
//! ```text
//!   frame      3        4        5          the origin of ○ is its place in frame 3, that of ● in frame 4
//!              ○──▶     ○──▶     ○
//!                       ●──▶     ●
//! ```
//!
//! The origin of a particle is in the first frame that has its id. So it is the same whether only the frames before a
//! frame were added, or later ones, too.

use rustc_hash::FxHashMap;

use crate::particles::{OwnedPositions, unique_ids};

/// The first frame of each particle, and its position there.
#[derive(Clone, Debug, Default)]
pub struct Origins {
    by_id: FxHashMap<i64, Origin>,
}

#[derive(Clone, Copy, Debug)]
struct Origin {
    position: [f64; 3],
    number: i64,
}

impl Origins {
    /// Adds the frame with this number. All frames before it must have been added. Ids that several of its particles have
    /// are left out, and so are positions that are not finite.
    pub fn add(&mut self, ids: &[i64], positions: &OwnedPositions, number: i64) {
        for (id, index) in unique_ids(ids) {
            let position = positions.position(index as usize);
            if position.is_finite() {
                self.by_id.entry(id).or_insert(Origin { position: position.to_array(), number });
            }
        }
    }

    /// Where the particles of the frame with this number appeared: x, y and z of each. One without an origin appears in
    /// this frame, and so do those that share an id.
    pub fn positions(&self, ids: &[i64], positions: &OwnedPositions, number: i64) -> Vec<f32> {
        let unique = unique_ids(ids);
        let origin = |(id, index): (&i64, usize)| {
            let own = || positions.position(index).to_array();
            self.before(*id, number, &unique)
                .map_or_else(own, |origin| origin.position)
                .map(|along| along as f32)
        };
        ids.iter().zip(0..).flat_map(origin).collect()
    }

    /// The origin of a particle of this frame, if no other one of the frame has its id.
    fn before(&self, id: i64, number: i64, unique: &FxHashMap<i64, u32>) -> Option<Origin> {
        let origin = self.by_id.get(&id).copied();
        origin.filter(|origin| origin.number < number && unique.contains_key(&id))
    }

    /// The approximate memory, in bytes.
    pub fn size_bytes(&self) -> u64 {
        (self.by_id.capacity() * (size_of::<(i64, Origin)>() + 1)) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: &[f64]) -> OwnedPositions {
        OwnedPositions::F64(x.iter().map(|x| [*x, 0.0, 1.0]).collect())
    }

    #[test]
    fn particles_keep_the_place_where_they_appeared() {
        let mut origins = Origins::default();
        origins.add(&[7, 8, 8, 9], &at(&[0.0, 1.0, 2.0, f64::NAN]), 3);
        origins.add(&[9, 7, 8], &at(&[10.0, 11.0, 12.0]), 5);
        let ids = [8, 7, 1, 9];
        let expected = [12.0, 0.0, 22.0, 10.0].map(|x| [x, 0.0, 1.0]);
        let known = |origins: &Origins| origins.positions(&ids, &at(&[20.0, 21.0, 22.0, 23.0]), 6);
        assert_eq!(known(&origins), expected.as_flattened());
        // Later frames change nothing.
        origins.add(&[1, 2], &at(&[30.0, 31.0]), 7);
        assert_eq!(known(&origins), expected.as_flattened());
        // Particles that share an id have no origin.
        let own = [[21.0, 0.0, 1.0], [22.0, 0.0, 1.0]];
        let found = origins.positions(&[7, 9, 9], &at(&[20.0, 21.0, 22.0]), 6);
        assert_eq!(found, [&[0.0, 0.0, 1.0][..], own.as_flattened()].concat());
    }
}
