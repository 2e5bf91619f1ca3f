//! Random-access storage for data that does not fit into memory.

use std::io;

use bytemuck::Pod;

/// Random-access storage, usually a temporary file. Offsets are absolute. Calls may come from several threads.
/// Callers only read bytes that were written.
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

/// Writes values one after the other, and reads them back in the same order.
pub(crate) struct StorageCursor<'a> {
    pub(crate) storage: &'a dyn Storage,
    /// Where the next values are, in bytes.
    pub(crate) offset: u64,
}

impl StorageCursor<'_> {
    pub(crate) fn write<T: Pod>(&mut self, values: &[T]) -> io::Result<()> {
        self.storage.write(self.offset, bytemuck::cast_slice(values))?;
        self.offset += size_of_val(values) as u64;
        Ok(())
    }

    pub(crate) fn read<T: Pod>(&mut self, count: usize) -> io::Result<Vec<T>> {
        let mut values = vec![T::zeroed(); count];
        self.storage.read(self.offset, bytemuck::cast_slice_mut(&mut values))?;
        self.offset += size_of_val(&*values) as u64;
        Ok(values)
    }
}
