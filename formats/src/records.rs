//! Random access to files whose particles are fixed-size records.

use std::fmt;
use std::io;
use std::ops::Range;
use std::sync::Arc;

use crate::data::{FilePositions, ParticleFrame};
use crate::error::Result;

/// Random access from several threads at once: a file, or bytes in memory.
pub trait ReadAt: Sync {
    /// The size in bytes.
    ///
    /// # Errors
    /// Those of the operating system.
    fn size_bytes(&self) -> io::Result<u64>;

    /// Fills `out` with the bytes from `offset` on.
    ///
    /// # Errors
    /// Those of the operating system; `UnexpectedEof` if the file ends too early.
    fn read_exact_at(&self, out: &mut [u8], offset: u64) -> io::Result<()>;
}

impl ReadAt for [u8] {
    fn size_bytes(&self) -> io::Result<u64> {
        Ok(self.len() as u64)
    }

    fn read_exact_at(&self, out: &mut [u8], offset: u64) -> io::Result<()> {
        let rest = usize::try_from(offset).ok().and_then(|offset| self.get(offset..));
        let bytes = rest.and_then(|rest| rest.get(..out.len())).ok_or(io::ErrorKind::UnexpectedEof)?;
        out.copy_from_slice(bytes);
        Ok(())
    }
}

impl<T: ReadAt + ?Sized> ReadAt for &T {
    fn size_bytes(&self) -> io::Result<u64> {
        (**self).size_bytes()
    }

    fn read_exact_at(&self, out: &mut [u8], offset: u64) -> io::Result<()> {
        (**self).read_exact_at(out, offset)
    }
}

impl<T: ReadAt + Send + ?Sized> ReadAt for Arc<T> {
    fn size_bytes(&self) -> io::Result<u64> {
        (**self).size_bytes()
    }

    fn read_exact_at(&self, out: &mut [u8], offset: u64) -> io::Result<()> {
        (**self).read_exact_at(out, offset)
    }
}

/// The location and layout of a file's particle records.
#[derive(Clone)]
pub(crate) struct Records {
    /// The format's name in errors.
    pub(crate) format: &'static str,
    /// Offset of the first record, in bytes from the start of the file.
    pub(crate) offset: u64,
    /// Bytes from one record to the next; never 0.
    pub(crate) stride: usize,
    /// Number of records; the file contains all of them.
    pub(crate) count: usize,
    /// Extracts positions from records with this stride.
    pub(crate) gather: Arc<GatherPositions>,
    /// Extracts positions and attributes from records with this stride.
    pub(crate) frame: Arc<FrameOfRecords>,
    /// Notes for the user.
    pub(crate) notes: Vec<String>,
    /// The name of the velocity attribute, if there is one.
    pub(crate) velocity: Option<String>,
}

/// Extracts positions from records. Arguments: bytes, stride, number of records, output.
pub(crate) type GatherPositions = dyn Fn(&[u8], usize, usize, &mut FilePositions) + Send + Sync;

/// Extracts all data of particles from the bytes of whole records.
pub(crate) type FrameOfRecords = dyn Fn(&[u8]) -> Result<ParticleFrame> + Send + Sync;

impl fmt::Debug for Records {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Records { format, offset, stride, count, .. } = self;
        write!(f, "{count} records of {format}, {stride} bytes each, from byte {offset} on")
    }
}

/// Reads a short piece of the file.
pub(crate) fn read(file: &dyn ReadAt, range: Range<u64>) -> Result<Vec<u8>> {
    let length =
        usize::try_from(range.end - range.start).map_err(|_| io::Error::from(io::ErrorKind::OutOfMemory))?;
    let mut bytes = vec![0; length];
    file.read_exact_at(&mut bytes, range.start)?;
    Ok(bytes)
}
