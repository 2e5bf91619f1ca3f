//! Reads the ends of a file without its arrays: which properties have time samples, which a stage declares,
//! and the summary of a sequence.

use std::io::{Read, Seek, SeekFrom};

use crate::bytes::piece;
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::usd::{FORMAT, LayerInfo, SampledProperty};

use super::contents::{BOOTSTRAP_BYTES, TABLE_BYTES, check_contents_at, contents_at, read_contents};
use super::read::UsdcLayer;
use super::read_array::Source;
use super::read_tables::LayerTables;
use super::tables::SpecType;
use super::value::ValueType;

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
    let (_, tables) = read_tables(file, limits)?;
    let mut found = Vec::new();
    for spec in &tables.specs {
        if spec.kind == SpecType::Attribute as i32 && spec.field("timeSamples").is_some() {
            let kind = tables.word(spec.field("typeName"), &spec.name)?;
            found.extend(SampledProperty::checked(kind, &spec.name));
        }
    }
    Ok(found)
}

/// The offset of the tables of a file, and the tables.
fn read_tables(file: &mut (impl Read + Seek), limits: &Limits) -> Result<(u64, LayerTables)> {
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
    Ok((start, LayerTables::in_sections(&source, &sections)?))
}

/// Reads the summary of a file of this crate, and the names of its vertex attributes, except normals. Reads
/// only its two ends.
///
/// # Errors
///
/// As [`read_sampled_properties`].
pub fn read_layer_info(file: &mut (impl Read + Seek), limits: &Limits) -> Result<(LayerInfo, Vec<String>)> {
    let (end, tables) = read_tables(file, limits)?;
    let data = tables.specs[0].field("customLayerData");
    // The values of the properties follow this one, except arrays. What it refers to is just before it.
    let start = data.and_then(|data| data.offset(ValueType::Dictionary)).unwrap_or(end).min(end);
    let start = start.saturating_sub(NESTED_BYTES_MAX);
    if end - start > TABLES_BYTES_MAX {
        let what =
            format!("its values have {} bytes, more than the limit of {TABLES_BYTES_MAX}", end - start);
        return Err(Error::too_large(FORMAT, what));
    }
    let bytes = piece(file, start, end - start)?;
    let layer = UsdcLayer::of_parts(Source::of_end(&bytes, start, limits), tables)?;
    let names = layer.attribute_names().map(str::to_owned).collect();
    Ok((layer.info(), names))
}

/// The maximum size of provenance.
const NESTED_BYTES_MAX: u64 = 64 << 10;
