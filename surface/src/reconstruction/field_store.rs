//! Out-of-core fields: φ, its auxiliary fields and its bounds, in files.
//!
//! ```text
//!   slot        0        1        2        3            a leaf has the same slot in every file
//!   φ        [leaf]   [leaf]   [leaf]   [leaf] …        two files: before and after the current operation
//!   first    [leaf]   [leaf]   [leaf]   [leaf] …        two files
//!   second   [leaf]   [leaf]   [leaf]   [leaf] …        two files
//!   lower    [leaf]   [leaf]   [leaf]   [leaf] …        one file
//!   upper    [leaf]   [leaf]   [leaf]   [leaf] …        one file
//! ```
//!
//! A tile must read the values that its neighbors had before the current operation, in whatever order tiles
//! are processed. So the fields that change are double-buffered.

use std::io;
use std::ops::Range;

use crate::grid::{Field, LEAF_VOXELS, Leaf};
use crate::smooth::FieldSet;

/// Random-access storage for data that does not fit into memory, usually a temporary file. Offsets are
/// absolute. Calls may come from several threads. Callers only read bytes that were written.
pub trait Storage: Send + Sync {
    /// Reads `bytes.len()` bytes at `offset`.
    ///
    /// # Errors
    /// Returns the error of the operating system.
    fn read(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()>;

    /// Writes `bytes` at `offset`.
    ///
    /// # Errors
    /// Returns the error of the operating system, such as a full disk.
    fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()>;
}

/// The fields of a frame, with one storage for each file in the drawing above.
pub(super) struct FieldStore {
    storages: Vec<Box<dyn Storage>>,
    /// For each changing field, which of its two buffers holds the current values.
    current: [usize; 3],
}

/// Number of storages that a frame needs.
pub const FIELD_STORE_FILES: usize = 8;

/// Indices of the bounds' storages, after two for each changing field.
const LOWER: usize = 6;
const UPPER: usize = 7;

impl FieldStore {
    /// Creates an empty store.
    pub(super) fn new(storages: Vec<Box<dyn Storage>>) -> FieldStore {
        assert_eq!(storages.len(), FIELD_STORE_FILES, "one storage per file");
        FieldStore { storages, current: [0; 3] }
    }

    /// Writes φ and the bounds of consecutive leaves, from slot `first` on.
    pub(super) fn put(&self, first: usize, [phi, lower, upper]: [&Field; 3]) -> io::Result<()> {
        for (file, field) in [(self.current[0], phi), (LOWER, lower), (UPPER, upper)] {
            write_run(&*self.storages[file], first, &field.leaves)?;
        }
        Ok(())
    }

    /// Reads the current values of a changing field in these slots.
    pub(super) fn read(&self, field: usize, slots: &[Range<usize>]) -> io::Result<Field> {
        read_runs(&*self.storages[2 * field + self.current[field]], slots)
    }

    /// Reads the bounds in these slots.
    pub(super) fn read_bounds(&self, slots: &[Range<usize>]) -> io::Result<[Field; 2]> {
        Ok([read_runs(&*self.storages[LOWER], slots)?, read_runs(&*self.storages[UPPER], slots)?])
    }

    /// Writes the next values of a changing field. They become current with [`swap`](FieldStore::swap).
    pub(super) fn write(&self, field: usize, first: usize, leaves: &[Leaf]) -> io::Result<()> {
        write_run(&*self.storages[2 * field + 1 - self.current[field]], first, leaves)
    }

    /// Swaps the buffers of these fields.
    pub(super) fn swap(&mut self, written: FieldSet) {
        for (current, written) in self.current.iter_mut().zip(written) {
            *current ^= usize::from(written);
        }
    }
}

/// Size of a leaf in storage, in bytes.
const LEAF_BYTES: u64 = (LEAF_VOXELS * size_of::<f32>()) as u64;

fn write_run(storage: &dyn Storage, first: usize, leaves: &[Leaf]) -> io::Result<()> {
    storage.write(first as u64 * LEAF_BYTES, bytemuck::cast_slice(leaves))
}

fn read_runs(storage: &dyn Storage, slots: &[Range<usize>]) -> io::Result<Field> {
    let mut field = Field::splat(slots.iter().map(Range::len).sum(), 0.0);
    let mut rest = &mut field.leaves[..];
    for run in slots {
        let (leaves, after) = std::mem::take(&mut rest).split_at_mut(run.len());
        storage.read(run.start as u64 * LEAF_BYTES, bytemuck::cast_slice_mut(leaves))?;
        rest = after;
    }
    Ok(field)
}
