//! Reads the provenance in the head of a glTF document, without reading the rest.

use std::fmt;

use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, MapAccess, Visitor};

use super::{CHUNK_JSON, FORMAT, GLB_MAGIC};
use crate::error::{Error, Position, Result};

/// The JSON chunk of a `.glb`, or the part of it that the head contains.
pub(crate) fn json_of_glb_head(head: &[u8]) -> Result<&[u8]> {
    const HEADER_BYTES: usize = 12;
    if !head.starts_with(&GLB_MAGIC) {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected a GLB header"));
    }
    match head.get(HEADER_BYTES..).and_then(|chunk| chunk.split_first_chunk::<8>()) {
        Some(([a, b, c, d, kind @ ..], json)) if *kind == CHUNK_JSON => {
            let length = u32::from_le_bytes([*a, *b, *c, *d]) as usize;
            Ok(&json[..length.min(json.len())])
        }
        _ => {
            Err(Error::invalid(FORMAT, Position::Offset(HEADER_BYTES as u64), "the first chunk is not JSON"))
        }
    }
}

/// The file size that the header of a `.glb` declares; `None` if the header is truncated.
pub(crate) fn glb_bytes_declared(head: &[u8]) -> Result<Option<u64>> {
    const LENGTH_AT: usize = 8;
    if !head.starts_with(&GLB_MAGIC) {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected a GLB header"));
    }
    let length = head.get(LENGTH_AT..).and_then(|rest| rest.first_chunk::<4>());
    Ok(length.map(|&length| u64::from(u32::from_le_bytes(length))))
}

/// The provenance that this crate stores in `asset.extras`. `json` can be truncated anywhere after it.
pub(crate) fn read_provenance(json: &[u8]) -> Result<Vec<(String, String)>> {
    let mut asset = None;
    let mut deserializer = serde_json::Deserializer::from_slice(json);
    let outcome = AssetOf(&mut asset).deserialize(&mut deserializer);
    match (asset, outcome) {
        // Parsing stops after `asset`, which the deserializer reports as an error.
        (Some(ReadAsset { extras: Some(ReadExtras::Ours { meniscus }) }), _) => Ok(meniscus.0),
        (Some(_), _) => Ok(Vec::new()),
        (None, Err(error)) if !error.is_eof() => {
            Err(Error::invalid(FORMAT, Position::Line(error.line() as u64), error.to_string()))
        }
        (None, _) => Ok(Vec::new()),
    }
}

#[derive(Deserialize)]
struct ReadAsset {
    #[serde(default)]
    extras: Option<ReadExtras>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum ReadExtras {
    Ours { meniscus: ReadEntries },
    Others(IgnoredAny),
}

/// Names and values in file order.
struct ReadEntries(Vec<(String, String)>);

impl<'de> Deserialize<'de> for ReadEntries {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<ReadEntries, D::Error> {
        struct Pairs;
        impl<'de> Visitor<'de> for Pairs {
            type Value = ReadEntries;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("names and values")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<ReadEntries, A::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(ReadEntries(entries))
            }
        }
        deserializer.deserialize_map(Pairs)
    }
}

/// Deserializes a document up to its `asset`, and stores the asset in the option.
struct AssetOf<'a>(&'a mut Option<ReadAsset>);

impl<'de> DeserializeSeed<'de> for AssetOf<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> std::result::Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for AssetOf<'_> {
    type Value = ();
    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a glTF document")
    }
    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<(), A::Error> {
        while let Some(key) = map.next_key::<String>()? {
            if key == "asset" {
                *self.0 = Some(map.next_value()?);
                return Ok(());
            }
            map.next_value::<IgnoredAny>()?;
        }
        Ok(())
    }
}
