//! Lines of JSON with a checksum, for files that are appended to.
//!
//! ```text
//!   8f3a09c1d2e4b576 {"frame":{"input":"/sim/dam.0012.bgeo", … }}⏎
//!   xxh3-64 of the   one JSON object
//!   rest, in hex
//! ```
//!
//! Records are lines of text, so that people can read and search them. The checksum detects lines that were
//! written partially or overwritten: a record is read completely or not at all.

use std::io;

use serde::Serialize;
use twox_hash::XxHash3_64;

/// Digits of a checksum.
const CHECKSUM_DIGITS: usize = 16;

/// Appends the line of a record to `out`.
///
/// # Errors
/// When the record cannot be serialized; `out` is unchanged then.
pub(crate) fn push_line(out: &mut Vec<u8>, record: &impl Serialize) -> io::Result<()> {
    let record = serde_json::to_vec(record)?;
    let checksum = XxHash3_64::oneshot(&record);
    out.extend_from_slice(format!("{checksum:0CHECKSUM_DIGITS$x} ").as_bytes());
    out.extend_from_slice(&record);
    out.push(b'\n');
    Ok(())
}

/// The JSON of a line without its line break; `None` if the checksum does not match.
pub(crate) fn record_of_line(line: &[u8]) -> Option<&[u8]> {
    let (checksum, rest) = line.split_at_checked(CHECKSUM_DIGITS)?;
    let record = rest.strip_prefix(b" ")?;
    let checksum = u64::from_str_radix(str::from_utf8(checksum).ok()?, 16).ok()?;
    (checksum == XxHash3_64::oneshot(record)).then_some(record)
}
