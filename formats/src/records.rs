//! Files whose particles are records of one length: where they are, and how a piece of a file is read.

use std::fmt;
use std::io;
use std::ops::Range;
use std::sync::Arc;

use crate::data::Positions;
use crate::error::Result;

/// What can be read at any position, by several threads at once: a file, or bytes in memory.
pub trait ReadAt: Sync {
    /// Bytes.
    ///
    /// # Errors
    /// When the system refuses.
    fn size_bytes(&self) -> io::Result<u64>;

    /// Fills `out` with the bytes from `offset` on.
    ///
    /// # Errors
    /// When the system refuses; `UnexpectedEof` where the file ends before.
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

/// Where the particles of a file are.
#[derive(Clone)]
pub(crate) struct Records {
    /// The format's name in errors.
    pub(crate) format: &'static str,
    /// Where the first record begins, bytes from the start of the file.
    pub(crate) offset: u64,
    /// Bytes from one record to the next; never 0.
    pub(crate) stride: usize,
    /// Records, all of which are there.
    pub(crate) count: usize,
    /// Takes the positions from records of this stride.
    pub(crate) gather: Arc<Gather>,
    /// What a user should know.
    pub(crate) notes: Vec<String>,
    /// The name of the attribute that is the velocity.
    pub(crate) velocity: Option<String>,
}

/// Takes positions from so many records of this stride.
pub(crate) type Gather = dyn Fn(&[u8], usize, usize, &mut Positions) + Send + Sync;

impl fmt::Debug for Records {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Records { format, offset, stride, count, .. } = self;
        write!(f, "{count} records of {format}, {stride} bytes each, from byte {offset} on")
    }
}

/// A piece of the file, which is not long.
pub(crate) fn read(file: &dyn ReadAt, range: Range<u64>) -> Result<Vec<u8>> {
    let length =
        usize::try_from(range.end - range.start).map_err(|_| io::Error::from(io::ErrorKind::OutOfMemory))?;
    let mut bytes = vec![0; length];
    file.read_exact_at(&mut bytes, range.start)?;
    Ok(bytes)
}
