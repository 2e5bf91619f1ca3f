//! Opens files that are read in batches, whose types are in `core/batches.rs`.

use crate::core::batches::{ParticleBatches, ReadAt, Records, read};
use crate::core::error::{Error, Result};
use crate::core::limits::Limits;
use crate::table::probe::{Probe, ProbedKind, probe};

impl<F: ReadAt> ParticleBatches<F> {
    /// Opens a file with fixed-length records; `None` for any other file, which must be [read
    /// whole](crate::read_particles). A batch covers about `batch_bytes` bytes of the file, and at least one
    /// record.
    ///
    /// # Errors
    /// [`Error::Io`] if reading fails, otherwise the errors of the format's reader. This also checks that the
    /// file contains all records, so a later [`Error::Truncated`] means that the file has changed.
    pub fn open(
        file: F,
        file_name: &str,
        limits: &Limits,
        batch_bytes: usize,
    ) -> Result<Option<ParticleBatches<F>>> {
        let records = records(&file, file_name, limits)?.filter(|records| records.stride <= STRIDE_MAX);
        Ok(records.map(|records| ParticleBatches::of(file, records, batch_bytes)))
    }
}

/// Locates the records, if the format has fixed-length ones.
fn records(file: &impl ReadAt, file_name: &str, limits: &Limits) -> Result<Option<Records>> {
    let file_bytes = file.size_bytes()?;
    // The second attempt reads one byte more than the longest allowed header, so that the header's reader can
    // report a header that is too long.
    for head_bytes in [HEAD_BYTES, limits.header_bytes.saturating_add(1)] {
        let head = read(&file, 0..head_bytes.min(file_bytes))?;
        let may_go_on = |error: &Error| error.is_truncated() && (head.len() as u64) < file_bytes;
        let Probe { kind: ProbedKind::Format(format), codec: None } = probe(&head, file_name) else {
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

/// Number of bytes that the first attempt reads; most headers are shorter.
const HEAD_BYTES: u64 = 64 << 10;

/// Files with longer records are not read in batches.
const STRIDE_MAX: usize = 1 << 20;
