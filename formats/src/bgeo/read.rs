//! Gathers point records into one vector per attribute.
//!
//! Records have a fixed length, so each attribute is gathered with its own stride. This is done for a block
//! of records at a time, while the block is in the first-level cache.

use std::sync::Arc;

use super::header::{AttributeHeader, AttributeKind, BgeoHeader, header_within};
use super::{FORMAT, POSITION_WORDS, TRAILER};

use crate::columns::{roles_of, with_role};
use crate::records::Records;
use crate::{
    AttributeRole, Error, FileAttribute, FilePositions, Limits, ParticleFrame, Position, Result, Values,
};

/// Bytes per block of records, from which all attributes are gathered. A block fits into the first-level
/// cache, so that only the first attribute waits for memory.
const BLOCK_BYTES: usize = 16 << 10;

/// Reads the points of an uncompressed classic BGEO file.
///
/// Divides positions by their weight w unless it is 0. Ignores everything after the points.
///
/// # Errors
///
/// Those of [`super::header`], [`Error::TooLarge`] beyond `limits`, and [`Error::Truncated`] if points are
/// missing.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let header = header_within(bytes, limits)?;
    let points_bytes = checked_points_bytes(&header, bytes.len() as u64)?;
    let (records, rest) = bytes[header.points_offset..].split_at(points_bytes);
    Ok(frame_of_records(header, records, rest))
}

/// The points in these records, which may be a part of those of the file.
fn frame_of_records(header: BgeoHeader, records: &[u8], rest: &[u8]) -> ParticleFrame {
    let mut notes = notes(&header, rest);
    let (positions, mut columns) = gather(records, &header);
    for (column, attribute) in columns.iter_mut().zip(&header.attributes) {
        clear_strings_outside(column, attribute, &mut notes);
    }
    let attributes = attributes(header.attributes, columns);
    ParticleFrame { positions: FilePositions::F32(positions), attributes, notes }
}

/// Locates the points of a file of `file_bytes`, so that they can be read in batches. `rest` is the data
/// after the points; the caller may pass an empty slice unless this data is exactly as long as the trailer.
///
/// # Errors
///
/// Those of [`read`] that do not concern the header.
pub(super) fn records(header: &BgeoHeader, file_bytes: u64, rest: &[u8]) -> Result<Records> {
    checked_points_bytes(header, file_bytes)?;
    let (of_batch, rest) = (header.clone(), rest.to_vec());
    Ok(Records {
        format: FORMAT,
        offset: header.points_offset as u64,
        stride: header.record_bytes,
        count: header.point_count,
        gather: Arc::new(|records, stride, _, positions| gather_batch(records, stride, positions)),
        notes: notes(header, &rest),
        frame: Arc::new(move |records| Ok(frame_of_records(of_batch.clone(), records, &rest))),
        velocity: velocity_name(header),
    })
}

fn velocity_name(header: &BgeoHeader) -> Option<String> {
    let named: Vec<(&str, usize)> =
        header.attributes.iter().map(|attribute| (attribute.name.as_str(), attribute.arity)).collect();
    let index = roles_of(&named).iter().position(|role| *role == Some(AttributeRole::Velocity))?;
    Some(header.attributes[index].name.clone())
}

/// Size of all points in bytes, after checking that the file has them.
fn checked_points_bytes(header: &BgeoHeader, file_bytes: u64) -> Result<usize> {
    let remaining = file_bytes.saturating_sub(header.points_offset as u64);
    let points_bytes = header.points_bytes();
    usize::try_from(points_bytes).ok().filter(|_| points_bytes <= remaining).ok_or_else(|| {
        let what = format!(
            "expected {} points of {} bytes each, {points_bytes} bytes in all, but {remaining} remain",
            header.point_count, header.record_bytes,
        );
        Error::truncated(FORMAT, Position::Offset(header.points_offset as u64), what)
    })
}

fn notes(header: &BgeoHeader, rest: &[u8]) -> Vec<String> {
    let mut notes = Vec::new();
    if header.expected_bytes_is_exact && rest != TRAILER {
        notes.push("the end of the file is invalid, but all points are complete".into());
    }
    for attribute in header.attributes.iter().filter(|attribute| attribute.arity == 0) {
        notes.push(format!("skipped the point attribute {:?}: it has no values", attribute.name));
    }
    notes
}

/// An attribute under construction: 32-bit words, already in native byte order.
enum WordColumn {
    Reals(Vec<f32>),
    Integers(Vec<i32>),
}

fn gather(records: &[u8], header: &BgeoHeader) -> (Vec<[f32; 3]>, Vec<WordColumn>) {
    let stride = header.record_bytes;
    let count = records.len() / stride;
    let mut positions = Vec::with_capacity(count);
    let mut columns: Vec<WordColumn> = header
        .attributes
        .iter()
        .map(|attribute| match attribute.kind {
            AttributeKind::Float | AttributeKind::Vector => {
                WordColumn::Reals(Vec::with_capacity(count * attribute.arity))
            }
            AttributeKind::Int | AttributeKind::Strings(_) => {
                WordColumn::Integers(Vec::with_capacity(count * attribute.arity))
            }
        })
        .collect();

    let records_per_block = (BLOCK_BYTES / stride).max(1);
    for block in records.chunks(records_per_block * stride) {
        gather_positions(block, stride, &mut positions);
        let mut offset = 4 * POSITION_WORDS;
        for (column, attribute) in columns.iter_mut().zip(&header.attributes) {
            match column {
                WordColumn::Reals(values) => {
                    gather_words(block, stride, offset, attribute.arity, f32::from_be_bytes, values);
                }
                WordColumn::Integers(values) => {
                    gather_words(block, stride, offset, attribute.arity, i32::from_be_bytes, values);
                }
            }
            offset += 4 * attribute.arity;
        }
    }
    (positions, columns)
}

/// Reads the positions of a batch of records.
fn gather_batch(records: &[u8], stride: usize, positions: &mut FilePositions) {
    let mut gathered = match std::mem::take(positions) {
        FilePositions::F32(gathered) => gathered,
        FilePositions::F64(_) => Vec::new(),
    };
    gathered.clear();
    gather_positions(records, stride, &mut gathered);
    *positions = FilePositions::F32(gathered);
}

fn gather_positions(block: &[u8], stride: usize, positions: &mut Vec<[f32; 3]>) {
    positions.extend(block.chunks_exact(stride).map(|record| {
        let [x, y, z, w] = words::<4, f32>(record, f32::from_be_bytes);
        if w == 0.0 || w == 1.0 { [x, y, z] } else { [x / w, y / w, z / w] }
    }));
}

/// Appends the `arity` words at `offset` of each record.
fn gather_words<T: Copy + Default>(
    block: &[u8],
    stride: usize,
    offset: usize,
    arity: usize,
    decode: impl Fn([u8; 4]) -> T + Copy,
    values: &mut Vec<T>,
) {
    let records = block.chunks_exact(stride).map(|record| &record[offset..]);
    match arity {
        1 => values.extend(records.map(|record| words::<1, T>(record, decode)[0])),
        2 => values.extend(records.flat_map(|record| words::<2, T>(record, decode))),
        3 => values.extend(records.flat_map(|record| words::<3, T>(record, decode))),
        4 => values.extend(records.flat_map(|record| words::<4, T>(record, decode))),
        _ => {
            for record in records {
                let (quads, _) = record[..4 * arity].as_chunks::<4>();
                values.extend(quads.iter().map(|&quad| decode(quad)));
            }
        }
    }
}

/// The first `N` words of a record.
#[inline(always)]
fn words<const N: usize, T: Copy + Default>(record: &[u8], decode: impl Fn([u8; 4]) -> T) -> [T; N] {
    let (quads, _) = record[..4 * N].as_chunks::<4>();
    std::array::from_fn(|index| decode(quads[index]))
}

/// Replaces string indices outside the table by −1, and adds a note if there are any other than −1 itself,
/// the usual mark for "no string".
fn clear_strings_outside(column: &mut WordColumn, attribute: &AttributeHeader, notes: &mut Vec<String>) {
    let (WordColumn::Integers(indices), AttributeKind::Strings(table)) = (column, &attribute.kind) else {
        return;
    };
    let mut outside_count = 0usize;
    for index in indices {
        if usize::try_from(*index).map_or(true, |index| table.len() <= index) {
            outside_count += usize::from(*index != -1);
            *index = -1;
        }
    }
    if outside_count != 0 {
        let (name, count) = (&attribute.name, table.len());
        notes.push(format!(
            "the point attribute {name:?} has {count} strings; {outside_count} indices are outside this range and are ignored"
        ));
    }
}

fn attributes(headers: Vec<AttributeHeader>, columns: Vec<WordColumn>) -> Vec<FileAttribute> {
    let named: Vec<(&str, usize)> =
        headers.iter().map(|header| (header.name.as_str(), header.arity)).collect();
    let roles = roles_of(&named);
    let mut attributes = Vec::with_capacity(headers.len());
    for ((header, column), role) in headers.into_iter().zip(columns).zip(roles) {
        if header.arity == 0 {
            continue;
        }
        let values = match (header.kind, column) {
            (AttributeKind::Strings(table), WordColumn::Integers(indices)) => {
                Values::Strings { table, indices }
            }
            (_, WordColumn::Integers(values)) => Values::I32(values),
            (_, WordColumn::Reals(values)) => Values::F32(values),
        };
        attributes.push(with_role(header.name, header.arity, role, values));
    }
    attributes
}
