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
        if !values.is_empty() {
            self.storage.write(self.offset, bytemuck::cast_slice(values))?;
        }
        self.offset += size_of_val(values) as u64;
        Ok(())
    }

    pub(crate) fn read<T: Pod>(&mut self, count: usize) -> io::Result<Vec<T>> {
        let mut values = bytemuck::zeroed_vec(count);
        if count > 0 {
            self.storage.read(self.offset, bytemuck::cast_slice_mut(&mut values))?;
        }
        self.offset += size_of_val(&*values) as u64;
        Ok(values)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::sync::Mutex;

    use super::*;

    /// A storage in memory.
    #[derive(Default)]
    pub(crate) struct InMemory(Mutex<Vec<u8>>);

    impl Storage for InMemory {
        fn read(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
            let (stored, from) = (self.0.lock().unwrap(), offset as usize);
            let stored_bytes = stored.get(from..from + bytes.len()).ok_or(io::ErrorKind::UnexpectedEof)?;
            bytes.copy_from_slice(stored_bytes);
            Ok(())
        }

        fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
            let (mut stored, from) = (self.0.lock().unwrap(), offset as usize);
            let end = stored.len().max(from + bytes.len());
            stored.resize(end, 0);
            stored[from..from + bytes.len()].copy_from_slice(bytes);
            Ok(())
        }
    }
}
