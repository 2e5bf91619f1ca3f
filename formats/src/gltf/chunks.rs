//! Splits a GLB file into its chunks, and parses JSON into types.

use serde::Deserialize;

use super::{CHUNK_BIN, CHUNK_JSON, FORMAT, GLB_MAGIC, GLB_VERSION};
use crate::error::{Error, Position, Result};

/// Parses JSON.
pub(super) fn parse<'a, T: Deserialize<'a>>(json: &'a [u8]) -> Result<T> {
    serde_json::from_slice(json).map_err(|error| invalid_json(&error))
}

pub(super) fn invalid_json(error: &serde_json::Error) -> Error {
    Error::invalid(FORMAT, Position::Line(error.line() as u64), error.to_string())
}

/// The JSON chunk and, if present, the binary chunk. A file without the GLB signature is JSON as a whole.
pub(super) fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>)> {
    let error = |offset: u64, what: &str| Err(Error::invalid(FORMAT, Position::Offset(offset), what));
    if !bytes.starts_with(&GLB_MAGIC) {
        return Ok((bytes, None));
    }
    let Some((header, _)) = bytes.split_first_chunk::<12>() else {
        return error(0, "the GLB header is truncated");
    };
    let number = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    if number(4) != GLB_VERSION {
        return Err(Error::unsupported(
            FORMAT,
            format!("the GLB version is {}; only 2 is supported", number(4)),
        ));
    }
    let Some(bytes) = bytes.get(..number(8) as usize) else {
        return error(8, "the file is shorter than its GLB header declares");
    };
    let (mut json, mut bin, mut at) = (None, None, 12);
    while let Some(([a, b, c, d, kind @ ..], rest)) = bytes.get(at..).and_then(|b| b.split_first_chunk::<8>())
    {
        let length = u32::from_le_bytes([*a, *b, *c, *d]) as usize;
        let Some(chunk) = rest.get(..length) else {
            return error(at as u64, "a GLB chunk extends beyond the end of the file");
        };
        match *kind {
            CHUNK_JSON if json.is_none() => json = Some(chunk),
            CHUNK_BIN if bin.is_none() => bin = Some(chunk),
            _ => {} // readers must skip unknown chunks
        }
        at += 8 + length;
    }
    match json {
        Some(json) => Ok((json, bin)),
        None => error(12, "the GLB file has no JSON chunk"),
    }
}
