//! Reads which properties have time samples, without their values: a stage declares them.

use std::io::{Read, Seek, SeekFrom};

use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::usd::{FORMAT, SampledProperty};

use super::contents::{BOOTSTRAP_BYTES, TABLE_BYTES, check_contents_at, contents_at, read_contents};
use super::read_array::Source;
use super::read_tables::LayerTables;
use super::tables::SpecType;

/// The maximum size of the tables. They are a few kilobytes, and more only if an attribute has very many
/// different strings.
const TABLES_BYTES_MAX: u64 = 64 << 20;

/// Reads the properties with time samples from a file of this crate. Reads only its two ends: the bootstrap,
/// and the tables.
///
/// # Errors
///
/// [`Error::Io`] if the file cannot be read; [`Error::Truncated`] if it is truncated; [`Error::Unsupported`]
/// if another program wrote or changed it; [`Error::Invalid`] if it is damaged; [`Error::TooLarge`] if it
/// exceeds the limits.
pub fn read_sampled_properties(
    file: &mut (impl Read + Seek),
    limits: &Limits,
) -> Result<Vec<SampledProperty>> {
    let head = piece(file, 0, BOOTSTRAP_BYTES as u64)?;
    let at = contents_at(&head)?;
    let file_bytes = file.seek(SeekFrom::End(0))?;
    check_contents_at(at, file_bytes)?;
    let sections = read_contents(&piece(file, at, TABLE_BYTES as u64)?, at)?;
    let start = sections.iter().map(|(start, _)| *start).min().unwrap_or(at);
    // The sections lie before the table of contents.
    let tables_bytes = at.saturating_sub(start);
    if tables_bytes > TABLES_BYTES_MAX {
        let what = format!("its tables have {tables_bytes} bytes, more than the limit of {TABLES_BYTES_MAX}");
        return Err(Error::too_large(FORMAT, what));
    }
    let bytes = piece(file, start, tables_bytes)?;
    let source = Source::of_end(&bytes, start, limits);
    let tables = LayerTables::in_sections(&source, &sections)?;
    let mut found = Vec::new();
    for spec in &tables.specs {
        if spec.kind == SpecType::Attribute as i32 && spec.field("timeSamples").is_some() {
            let kind = tables.word(spec.field("typeName"), &spec.name)?;
            found.extend(SampledProperty::checked(kind, &spec.name));
        }
    }
    Ok(found)
}

/// At most `length` bytes from the offset `at` on; fewer at the end of the file.
fn piece(file: &mut (impl Read + Seek), at: u64, length: u64) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    file.seek(SeekFrom::Start(at))?;
    file.take(length).read_to_end(&mut bytes)?;
    Ok(bytes)
}
