//! Writes particles as a classic BGEO file, uncompressed and without primitives.

use super::{FORMAT, MAGIC, TRAILER, VERSION, narrow};
use crate::{AttributeRole, Error, FileAttribute, FilePositions, ParticleFrame, Position, Result, Values};
use std::io::Write;

/// Writes `frame`. The format has only 32-bit types: 64-bit floats become 32-bit floats, and bytes and 64-bit
/// integers become 32-bit integers.
///
/// Houdini reads `.bgeo` as its newer format; the extension `.bhclassic` selects the right reader.
///
/// # Errors
///
/// [`Error::Io`] from `out`; [`Error::Invalid`] for an attribute without `arity` values per particle;
/// [`Error::TooLarge`] for data beyond the format's limits, such as an integer beyond 32 bits.
pub fn write(frame: &ParticleFrame, out: &mut impl Write) -> Result<()> {
    let point_count = frame.positions.len();
    for attribute in &frame.attributes {
        check(attribute, point_count)?;
    }
    out.write_all(MAGIC)?;
    out.write_all(&VERSION.to_be_bytes())?;
    let counts = [point_count, 0, 0, 0, frame.attributes.len(), 0, 0, 0];
    for count in counts {
        out.write_all(&count_i32(count, "points or attributes")?.to_be_bytes())?;
    }
    for attribute in &frame.attributes {
        write_dictionary_entry(attribute, out)?;
    }
    let mut record = Vec::new();
    for point in 0..point_count {
        record.clear();
        encode_position(&frame.positions, point, &mut record);
        for attribute in &frame.attributes {
            encode_values(attribute, point, &mut record);
        }
        out.write_all(&record)?;
    }
    out.write_all(&TRAILER)?;
    Ok(())
}

/// Fails if the attribute has the wrong number of values, or the format cannot store them.
fn check(attribute: &FileAttribute, point_count: usize) -> Result<()> {
    let (name, arity) = (&attribute.name, attribute.arity);
    let value_count = match &attribute.values {
        Values::F32(values) => values.len(),
        Values::F64(values) => values.len(),
        Values::U8(values) => values.len(),
        Values::I32(values) => values.len(),
        Values::I64(values) => values.len(),
        Values::Strings { indices, .. } => indices.len(),
    };
    if value_count != point_count.saturating_mul(arity) {
        let what = format!(
            "the attribute {name:?} has {value_count} values, expected {arity} for each of {point_count} points"
        );
        return Err(Error::invalid(FORMAT, Position::File, what));
    }
    if u16::try_from(arity).is_err() {
        let what =
            format!("the attribute {name:?} has {arity} values per point; the format's limit is 65535");
        return Err(Error::too_large(FORMAT, what));
    }
    if let Values::I64(values) = &attribute.values
        && let Some(value) = values.iter().find(|&&value| i32::try_from(value).is_err())
    {
        let what =
            format!("the attribute {name:?} has the value {value}, which exceeds the format's 32 bits");
        return Err(Error::too_large(FORMAT, what));
    }
    Ok(())
}

fn write_dictionary_entry(attribute: &FileAttribute, out: &mut impl Write) -> Result<()> {
    let turns_with_object = matches!(
        attribute.role,
        Some(AttributeRole::Velocity | AttributeRole::Acceleration | AttributeRole::Normal)
    );
    let kind: i32 = match attribute.values {
        Values::F32(_) | Values::F64(_) if turns_with_object => 5,
        Values::F32(_) | Values::F64(_) => 0,
        Values::U8(_) | Values::I32(_) | Values::I64(_) => 1,
        Values::Strings { .. } => 4,
    };
    write_string(&attribute.name, out)?;
    let size = u16::try_from(attribute.arity).unwrap_or(u16::MAX); // checked before
    out.write_all(&size.to_be_bytes())?;
    out.write_all(&kind.to_be_bytes())?;
    if let Values::Strings { table, .. } = &attribute.values {
        out.write_all(&count_i32(table.len(), "strings")?.to_be_bytes())?;
        for string in table {
            write_string(string, out)?;
        }
    } else {
        out.write_all(&vec![0; 4 * attribute.arity])?; // defaults
    }
    Ok(())
}

fn write_string(string: &str, out: &mut impl Write) -> Result<()> {
    match i16::try_from(string.len()) {
        Ok(length) => out.write_all(&length.to_be_bytes())?,
        Err(_) => {
            out.write_all(&[0xff; 2])?;
            out.write_all(&count_i32(string.len(), "characters")?.to_be_bytes())?;
        }
    }
    out.write_all(string.as_bytes())?;
    Ok(())
}

fn count_i32(count: usize, items: &str) -> Result<i32> {
    i32::try_from(count).map_err(|_| {
        Error::too_large(FORMAT, format!("the frame has {count} {items}; the format's limit is {}", i32::MAX))
    })
}

fn encode_position(positions: &FilePositions, point: usize, record: &mut Vec<u8>) {
    let [x, y, z] = match positions {
        FilePositions::F32(positions) => positions[point],
        FilePositions::F64(positions) => positions[point].map(narrow),
    };
    for coordinate in [x, y, z, 1.0] {
        record.extend(coordinate.to_be_bytes());
    }
}

fn encode_values(attribute: &FileAttribute, point: usize, record: &mut Vec<u8>) {
    let range = point * attribute.arity..(point + 1) * attribute.arity;
    match &attribute.values {
        Values::F32(values) => record.extend(values[range].iter().flat_map(|value| value.to_be_bytes())),
        Values::F64(values) => {
            record.extend(values[range].iter().flat_map(|&value| narrow(value).to_be_bytes()));
        }
        Values::U8(values) => {
            record.extend(values[range].iter().flat_map(|&value| i32::from(value).to_be_bytes()));
        }
        Values::I32(values) | Values::Strings { indices: values, .. } => {
            record.extend(values[range].iter().flat_map(|value| value.to_be_bytes()));
        }
        Values::I64(values) => {
            // All values were checked to fit.
            let narrow = |&value: &i64| i32::try_from(value).unwrap_or(i32::MAX).to_be_bytes();
            record.extend(values[range].iter().flat_map(narrow));
        }
    }
}
