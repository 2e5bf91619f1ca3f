//! Particles of a file that is never in memory whole.
//!
//! ```text
//!   header │ record record record ‥ │ record record ‥ │ ‥ │ whatever follows
//!          └──────── batch 0 ───────┴──── batch 1 ────┴───┘
//! ```
//!
//! Where records are of one length, each is where it can be computed to be. So any batch of them can be read at
//! any time, again and again, and by several threads at once: each reads into memory of its own. Binary PLY
//! without lists up to the vertices is such a file, and classic BGEO; text and what is packed must be read whole.
//! The positions are those of [`crate::read_particles`], bit by bit, and so are the errors.

use std::io;
use std::ops::Range;
use std::sync::Arc;

use crate::bytes::Endian;
use crate::data::Positions;
use crate::error::{Error, Place, Result};
use crate::limits::Limits;
use crate::probe::{Kind, Probe, probe};
use crate::{bgeo, ply};

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

/// The particles of an open file, batch by batch.
#[derive(Debug)]
pub struct ParticleBatches<F> {
    file: F,
    records: Records,
    batch_particle_count: usize,
}

/// Where the particles of a file are.
#[derive(Clone, Debug)]
pub(crate) struct Records {
    /// The format's name in errors.
    pub(crate) format: &'static str,
    /// Where the first record begins, bytes from the start of the file.
    pub(crate) offset: u64,
    /// Bytes from one record to the next; never 0.
    pub(crate) stride: usize,
    /// Records, all of which are there.
    pub(crate) count: usize,
    pub(crate) position: PositionInRecord,
    /// What a user should know.
    pub(crate) notes: Vec<String>,
    /// The name of the attribute that is the velocity.
    pub(crate) velocity: Option<String>,
}

/// How to take a position from a record.
#[derive(Clone, Debug)]
pub(crate) enum PositionInRecord {
    Ply { columns: ply::PositionColumns, endian: Endian },
    Bgeo,
}

/// One batch, and the memory in which it was read. It can be used again for another.
#[derive(Debug, Default)]
pub struct ParticleBatch {
    /// Where the particles are, in the precision of the file. Not yet checked for being finite.
    pub positions: Positions,
    records: Vec<u8>,
}

impl<F: ReadAt> ParticleBatches<F> {
    /// Opens a file whose records can be read one by one; `None` for any other, which has to be
    /// [read whole](crate::read_particles). A batch has about `batch_bytes` bytes of the file, at least one record.
    ///
    /// # Errors
    /// [`Error::Io`] if reading fails; else those of the format's reader. That all records are there is checked
    /// here, so later only a file that has changed is short.
    pub fn open(
        file: F,
        file_name: &str,
        limits: &Limits,
        batch_bytes: usize,
    ) -> Result<Option<ParticleBatches<F>>> {
        let records = match records(&file, file_name, limits)? {
            Some(records) if records.stride <= STRIDE_MAX => records,
            _ => return Ok(None),
        };
        let batch_particle_count = (batch_bytes / records.stride).max(1);
        Ok(Some(ParticleBatches { file, records, batch_particle_count }))
    }

    /// All particles.
    pub fn particle_count(&self) -> usize {
        self.records.count
    }

    /// The batches: none if there is no particle.
    pub fn batch_count(&self) -> usize {
        self.records.count.div_ceil(self.batch_particle_count)
    }

    /// Which particles are in a batch; none in one that does not exist.
    pub fn particles_of(&self, batch: usize) -> Range<usize> {
        let at = |batch: usize| batch.saturating_mul(self.batch_particle_count).min(self.records.count);
        at(batch)..at(batch.saturating_add(1))
    }

    /// Reads a batch by its index.
    ///
    /// # Errors
    /// [`Error::Io`] if reading fails, [`Error::Short`] if the file has become shorter.
    pub fn read_batch(&self, index: usize, batch: &mut ParticleBatch) -> Result<()> {
        let Records { format, offset, stride, .. } = self.records;
        let particles = self.particles_of(index);
        let ParticleBatch { positions, records } = batch;
        records.resize(particles.len() * stride, 0);
        let start = offset + particles.start as u64 * stride as u64;
        self.file.read_exact_at(records, start).map_err(|error| match error.kind() {
            io::ErrorKind::UnexpectedEof => {
                let what =
                    format!("expected {} bytes of records, which are not there any more", records.len());
                Error::short(format, Place::Offset(start), what)
            }
            _ => error.into(),
        })?;
        match &self.records.position {
            PositionInRecord::Ply { columns, endian } => {
                columns.gather(records, stride, *endian, particles.len(), positions);
            }
            PositionInRecord::Bgeo => bgeo::gather_batch(records, stride, positions),
        }
        Ok(())
    }

    /// What a user should know though the file can be read. What is wrong with attributes is not known here.
    pub fn notes(&self) -> &[String] {
        &self.records.notes
    }

    /// The name of the attribute that is the particles' velocity, if there is one.
    pub fn velocity(&self) -> Option<&str> {
        self.records.velocity.as_deref()
    }
}

/// Finds the records, if the format has such.
fn records(file: &impl ReadAt, file_name: &str, limits: &Limits) -> Result<Option<Records>> {
    let file_bytes = file.size_bytes()?;
    // A byte more than a header may have, so that the reader of headers can tell that it has too many.
    for head_bytes in [HEAD_BYTES, limits.header_bytes.saturating_add(1)] {
        let head = read(file, 0..head_bytes.min(file_bytes))?;
        let may_go_on = |error: &Error| error.is_short() && (head.len() as u64) < file_bytes;
        match probe(&head, file_name) {
            Probe { kind: Kind::Ply, packing: None } => match ply::read_header(&head, limits) {
                Err(error) if may_go_on(&error) => {}
                header => return ply::records(&header?, file_bytes, limits),
            },
            Probe { kind: Kind::ClassicBgeo, packing: None } => match bgeo::header_within(&head, limits) {
                Err(error) if may_go_on(&error) => {}
                header => {
                    let header = header?;
                    let rest = match file_bytes.checked_sub(header.expected_bytes) {
                        Some(0) => read(file, header.points_end()..file_bytes)?,
                        _ => Vec::new(),
                    };
                    return bgeo::records(&header, file_bytes, &rest).map(Some);
                }
            },
            _ => return Ok(None),
        }
    }
    Ok(None)
}

/// A piece of the file, which is not long.
fn read(file: &impl ReadAt, range: Range<u64>) -> Result<Vec<u8>> {
    let length =
        usize::try_from(range.end - range.start).map_err(|_| io::Error::from(io::ErrorKind::OutOfMemory))?;
    let mut bytes = vec![0; length];
    file.read_exact_at(&mut bytes, range.start)?;
    Ok(bytes)
}

/// Bytes of a head that has most headers.
const HEAD_BYTES: u64 = 64 << 10;

/// Larger records are not read in batches.
const STRIDE_MAX: usize = 1 << 20;
