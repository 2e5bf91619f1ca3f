//! Typed metadata entries of a file or a grid.

use super::FORMAT;
use super::cursor::VdbCursor;
use crate::error::{Error, Result};

/// A value of OpenVDB metadata.
#[derive(Clone, Debug, PartialEq)]
pub enum MetaValue {
    /// `string`.
    String(String),
    /// `bool`.
    Bool(bool),
    /// `int32` and `int64`.
    Integer(i64),
    /// `float` and `double`.
    Real(f64),
    /// `vec3i`.
    Vec3i([i32; 3]),
    /// `vec3s` and `vec3d`.
    Vec3d([f64; 3]),
    /// Any other type: its name and its size in bytes.
    Other(String, usize),
}

/// Metadata to write, in order.
#[derive(Default)]
pub(super) struct MetaWriter {
    count: u32,
    entries: Vec<u8>,
}

impl MetaWriter {
    pub(super) fn push(&mut self, name: &str, type_name: &str, value: &[u8]) {
        self.count += 1;
        push_string(&mut self.entries, name.as_bytes());
        push_string(&mut self.entries, type_name.as_bytes());
        push_string(&mut self.entries, value);
    }

    pub(super) fn string(&mut self, name: &str, value: &str) {
        self.push(name, "string", value.as_bytes());
    }

    pub(super) fn int64(&mut self, name: &str, value: i64) {
        self.push(name, "int64", &value.to_le_bytes());
    }

    pub(super) fn vec3i(&mut self, name: &str, value: [i32; 3]) {
        self.push(name, "vec3i", &value.map(i32::to_le_bytes).concat());
    }

    pub(super) fn append_to(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(&self.count.to_le_bytes());
        out.extend_from_slice(&self.entries);
    }
}

/// Appends a u32 length and the bytes.
pub(super) fn push_string(out: &mut Vec<u8>, bytes: &[u8]) {
    // The writer only stores names and provenance; an overlong string is truncated to keep the file readable.
    let length = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
    out.extend_from_slice(&length.to_le_bytes());
    out.extend_from_slice(&bytes[..length as usize]);
}

/// Reads the entries of a file or a grid.
pub(super) fn read_metadata(cursor: &mut VdbCursor) -> Result<Vec<(String, MetaValue)>> {
    const ENTRY_BYTES_MIN: usize = 12;
    const ENTRY_COUNT_MAX: usize = 1 << 16; // real files have a few dozen
    let count = cursor.u32("the number of metadata entries")? as usize;
    if count > cursor.remaining() / ENTRY_BYTES_MIN {
        return Err(cursor.error(format!(
            "the file declares {count} metadata entries of at least {ENTRY_BYTES_MIN} bytes each, \
             but only {} bytes follow",
            cursor.remaining()
        )));
    }
    if count > ENTRY_COUNT_MAX {
        return Err(Error::too_large(
            FORMAT,
            format!("the file has {count} metadata entries, more than the limit of {ENTRY_COUNT_MAX}"),
        ));
    }
    let mut entries = Vec::with_capacity(count);
    for _ in 0..count {
        let name = cursor.string("the name of a metadata entry")?;
        let type_name = cursor.string("the type of a metadata entry")?;
        let byte_count = cursor.u32("the size of a metadata entry")? as usize;
        let bytes = cursor.take(byte_count, "the value of a metadata entry")?;
        if !type_name.starts_with("__") {
            entries.push((name, read_value(&type_name, bytes)));
        }
    }
    Ok(entries)
}

fn read_value(type_name: &str, bytes: &[u8]) -> MetaValue {
    let mut cursor = VdbCursor::new(bytes);
    let value = match (type_name, bytes.len()) {
        ("string", _) => Ok(MetaValue::String(String::from_utf8_lossy(bytes).into_owned())),
        ("bool", 1) => Ok(MetaValue::Bool(bytes[0] != 0)),
        ("int32", 4) => cursor.i32("").map(|value| MetaValue::Integer(value.into())),
        ("int64", 8) => cursor.i64("").map(MetaValue::Integer),
        ("float", 4) => cursor.f32("").map(|value| MetaValue::Real(value.into())),
        ("double", 8) => cursor.f64("").map(MetaValue::Real),
        ("vec3i", 12) => cursor.coord("").map(MetaValue::Vec3i),
        ("vec3s", 12) => read_vector(|| cursor.f32("").map(f64::from)),
        ("vec3d", 24) => read_vector(|| cursor.f64("")),
        _ => Ok(MetaValue::Other(type_name.into(), bytes.len())),
    };
    value.unwrap_or_else(|_| MetaValue::Other(type_name.into(), bytes.len()))
}

fn read_vector(mut next: impl FnMut() -> Result<f64>) -> Result<MetaValue> {
    Ok(MetaValue::Vec3d([next()?, next()?, next()?]))
}
