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

use crate::data::Positions;
use crate::error::{Error, Place, Result};
use crate::limits::Limits;
use crate::probe::{Kind, Probe, probe};
use crate::records::{Records, read};

pub use crate::records::ReadAt;

/// The particles of an open file, batch by batch.
#[derive(Debug)]
pub struct ParticleBatches<F> {
    file: F,
    records: Records,
    batch_particle_count: usize,
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
        (self.records.gather)(records, stride, particles.len(), positions);
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
        let head = read(&file, 0..head_bytes.min(file_bytes))?;
        let may_go_on = |error: &Error| error.is_short() && (head.len() as u64) < file_bytes;
        let Probe { kind: Kind::Format(format), codec: None } = probe(&head, file_name) else {
            return Ok(None);
        };
        let Some(find) = format.row().particles.as_ref().and_then(|particles| particles.find_records) else {
            return Ok(None);
        };
        match find(&head, file_bytes, &file, limits) {
            Err(error) if may_go_on(&error) => {}
            found => return found?,
        }
    }
    Ok(None)
}

/// Bytes of a head that has most headers.
const HEAD_BYTES: u64 = 64 << 10;

/// Larger records are not read in batches.
const STRIDE_MAX: usize = 1 << 20;
