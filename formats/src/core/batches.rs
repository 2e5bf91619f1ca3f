//! Reads particles in batches from a file that does not fit into memory.
//!
//! ```text
//!   header │ record record record ‥ │ record record ‥ │ ‥ │ other data
//!          └──────── batch 0 ───────┴──── batch 1 ────┴───┘
//! ```
//!
//! If records have a fixed length, their offsets can be computed. Any batch can then be read at any time,
//! repeatedly, and by several threads at once, each into its own buffer. This works for binary PLY without
//! lists before the end of the vertices, and for classic BGEO. Text and compressed files must be read whole.
//! Positions, attributes and errors are exactly those of [`crate::read_particles`].

use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};
use std::{fmt, io};

use crate::core::data::{FilePositions, ParticleFrame};
use crate::core::error::{Error, Position, Result};

/// The particles of an open file, read batch by batch.
#[derive(Debug)]
pub struct ParticleBatches<F> {
    file: F,
    records: Records,
    batch_particle_count: usize,
}

/// One batch and its buffer, which can be reused for another batch.
#[derive(Debug, Default)]
pub struct ParticleBatch {
    /// Particle positions in the precision of the file, not yet checked for being finite.
    pub positions: FilePositions,
    records: Vec<u8>,
}

impl<F: ReadAt> ParticleBatches<F> {
    /// The batches of a file with these records.
    pub(crate) fn of(file: F, records: Records, batch_bytes: usize) -> ParticleBatches<F> {
        let batch_particle_count = (batch_bytes / records.stride).max(1);
        ParticleBatches { file, records, batch_particle_count }
    }

    /// The number of particles.
    pub fn particle_count(&self) -> usize {
        self.records.count
    }

    /// The number of batches, 0 if there are no particles.
    pub fn batch_count(&self) -> usize {
        self.records.count.div_ceil(self.batch_particle_count)
    }

    /// The particle indices of a batch; empty if the batch does not exist.
    pub fn particle_range(&self, batch: usize) -> Range<usize> {
        let at = |batch: usize| batch.saturating_mul(self.batch_particle_count).min(self.records.count);
        at(batch)..at(batch.saturating_add(1))
    }

    /// Reads a batch by its index.
    ///
    /// # Errors
    /// [`Error::Io`] if reading fails, [`Error::Truncated`] if the file has become shorter.
    pub fn read_batch(&self, index: usize, batch: &mut ParticleBatch) -> Result<()> {
        let ParticleBatch { positions, records } = batch;
        self.read_records(index, records)?;
        (self.records.gather)(records, positions);
        Ok(())
    }

    /// Reads a batch by its index, with all attributes. Without a batch of this index, the attributes have no
    /// values. Their notes are those of the batch.
    ///
    /// # Errors
    /// As for [`read_batch`](Self::read_batch).
    pub fn read_frame(&self, index: usize) -> Result<ParticleFrame> {
        let mut records = Vec::new();
        self.read_records(index, &mut records)?;
        (self.records.frame)(&records)
    }

    fn read_records(&self, index: usize, records: &mut Vec<u8>) -> Result<()> {
        let Records { format, offset, stride, .. } = self.records;
        let particles = self.particle_range(index);
        records.resize(particles.len() * stride, 0);
        let start = offset + particles.start as u64 * stride as u64;
        self.file.read_exact_at(records, start).map_err(|error| match error.kind() {
            io::ErrorKind::UnexpectedEof => {
                let what =
                    format!("expected {} bytes of records, but the file has become shorter", records.len());
                Error::truncated(format, Position::Offset(start), what)
            }
            _ => error.into(),
        })
    }

    /// Notes for the user on a file that was read successfully. They do not cover the values of attributes.
    pub fn notes(&self) -> &[String] {
        &self.records.notes
    }

    /// The name of the velocity attribute, if there is one.
    pub fn velocity(&self) -> Option<&str> {
        self.records.velocity.as_deref()
    }
}

// Random access to files whose particles are fixed-size records.

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

/// A file that has one position for all reads.
pub(crate) struct SeekFile<F>(pub(crate) Mutex<F>);

impl<F: Read + Seek + Send> ReadAt for SeekFile<F> {
    fn size_bytes(&self) -> io::Result<u64> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).seek(SeekFrom::End(0))
    }

    fn read_exact_at(&self, out: &mut [u8], offset: u64) -> io::Result<()> {
        let mut file = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(offset))?;
        file.read_exact(out)
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
    /// Extracts positions from whole records.
    pub(crate) gather: Arc<GatherPositions>,
    /// Extracts positions and attributes from whole records.
    pub(crate) frame: Arc<FrameOfRecords>,
    /// Notes for the user.
    pub(crate) notes: Vec<String>,
    /// The name of the velocity attribute, if there is one.
    pub(crate) velocity: Option<String>,
}

/// Extracts positions from the bytes of whole records; replaces the positions that are there.
pub(crate) type GatherPositions = dyn Fn(&[u8], &mut FilePositions) + Send + Sync;

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
