//! Fields that are not in memory.
//!
//! ```text
//!   place       0        1        2        3            a leaf's place is the same on every shelf
//!   φ        [leaf]   [leaf]   [leaf]   [leaf] …        now, and as the act under way leaves it
//!   first    [leaf]   [leaf]   [leaf]   [leaf] …        likewise
//!   second   [leaf]   [leaf]   [leaf]   [leaf] …        likewise
//!   lower    [leaf]   [leaf]   [leaf]   [leaf] …
//!   upper    [leaf]   [leaf]   [leaf]   [leaf] …
//! ```
//!
//! Tiles read what their neighbours were before the act, whichever tile is first: so the fields that acts
//! change have two shelves each, which take turns.

use std::io;
use std::ops::Range;

use crate::surface::grid::{Field, LEAF_VOXELS, Leaf};
use crate::surface::smooth::FieldSet;

/// A place for what does not fit into memory: usually a temporary file. Reads and writes are at absolute offsets and may come
/// from several threads; what was never written is never read.
pub trait Storage: Send + Sync {
    /// Fills `bytes` with what was written at `offset`.
    ///
    /// # Errors
    /// When the system refuses.
    fn read(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()>;

    /// Writes `bytes` at `offset`.
    ///
    /// # Errors
    /// When the system refuses: a full disk, most likely.
    fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()>;
}

/// The fields of a frame on storage, one of these for each shelf.
pub(super) struct Shelves {
    storages: Vec<Box<dyn Storage>>,
    /// Which of the two shelves of each changing field holds what is now.
    turn: [usize; 3],
}

/// How many storages a frame needs.
pub const SHELF_COUNT: usize = 8;

/// The shelves of the bounds: after two for each of the fields that acts change.
const LOWER: usize = 6;
const UPPER: usize = 7;

impl Shelves {
    /// Empty shelves on so many storages as there are shelves.
    pub(super) fn new(storages: Vec<Box<dyn Storage>>) -> Shelves {
        assert_eq!(storages.len(), SHELF_COUNT, "a storage for each shelf");
        Shelves { storages, turn: [0; 3] }
    }

    /// Puts φ and the bounds of some leaves at the places from `first` on.
    pub(super) fn put(&self, first: usize, [phi, lower, upper]: [&Field; 3]) -> io::Result<()> {
        for (shelf, field) in [(self.turn[0], phi), (LOWER, lower), (UPPER, upper)] {
            write_run(&*self.storages[shelf], first, &field.leaves)?;
        }
        Ok(())
    }

    /// One of the changing fields as it is now, of the leaves at these places in turn.
    pub(super) fn read(&self, field: usize, places: &[Range<usize>]) -> io::Result<Field> {
        read_runs(&*self.storages[2 * field + self.turn[field]], places)
    }

    /// The bounds of the leaves at these places.
    pub(super) fn read_bounds(&self, places: &[Range<usize>]) -> io::Result<[Field; 2]> {
        Ok([read_runs(&*self.storages[LOWER], places)?, read_runs(&*self.storages[UPPER], places)?])
    }

    /// Writes one of the changing fields as it will be once the fields were [turned](Shelves::turn).
    pub(super) fn write(&self, field: usize, first: usize, leaves: &[Leaf]) -> io::Result<()> {
        write_run(&*self.storages[2 * field + 1 - self.turn[field]], first, leaves)
    }

    /// Makes what was written to these fields what is read.
    pub(super) fn turn(&mut self, written: FieldSet) {
        for (turn, written) in self.turn.iter_mut().zip(written) {
            *turn ^= usize::from(written);
        }
    }
}

/// Bytes of a leaf in storage.
const LEAF_BYTES: u64 = (LEAF_VOXELS * size_of::<f32>()) as u64;

fn write_run(storage: &dyn Storage, first: usize, leaves: &[Leaf]) -> io::Result<()> {
    storage.write(first as u64 * LEAF_BYTES, bytemuck::cast_slice(leaves))
}

fn read_runs(storage: &dyn Storage, places: &[Range<usize>]) -> io::Result<Field> {
    let mut field = Field::splat(places.iter().map(Range::len).sum(), 0.0);
    let mut rest = &mut field.leaves[..];
    for run in places {
        let (leaves, after) = std::mem::take(&mut rest).split_at_mut(run.len());
        storage.read(run.start as u64 * LEAF_BYTES, bytemuck::cast_slice_mut(leaves))?;
        rest = after;
    }
    Ok(field)
}
