//! Reads the groups, data and property headers of an archive, and checks all bounds.

use crate::error::{Error, Position, Result};

use super::FORMAT;
use super::document::{OBJECT_HASH_BYTES, Pod, bits};
use super::ogawa::{DATA, EMPTY_GROUP, Reference};
use crate::digest::DIGEST_BYTES;

/// The limit of properties in a compound: more than any mesh that this program writes has.
const PROPERTY_COUNT_MAX: usize = 1 << 16;

/// The bytes of a file, or of its end.
#[derive(Clone, Copy, Debug)]
pub(super) struct Container<'a> {
    pub(super) bytes: &'a [u8],
    /// The offset of the bytes in the file.
    base: u64,
}

/// The header of a property.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct PropertyHeader {
    pub(super) name: String,
    /// The index of the property's time sampling.
    pub(super) sampling: u32,
    pub(super) metadata: String,
    word: u32,
}

impl PropertyHeader {
    /// The type of the property's numbers; `None` for a compound.
    pub(super) fn pod(&self) -> Option<u32> {
        (self.word & bits::KIND != 0).then_some(self.word >> bits::POD_SHIFT & 0xf)
    }

    /// Fails unless the values have this type and extent.
    pub(super) fn check_type(&self, (pod, extent): (Pod, u8)) -> Result<()> {
        let kind = (self.word >> bits::POD_SHIFT & 0xf, self.word >> bits::EXTENT_SHIFT & 0xff);
        if kind == (u32::from(pod as u8), u32::from(extent)) && self.word & bits::KIND != 0 {
            return Ok(());
        }
        let what = format!(
            "{} has values of the type {} × {}; expected {pod:?} × {extent}",
            self.name, kind.0, kind.1
        );
        Err(Error::invalid(FORMAT, Position::File, what))
    }
}

impl<'a> Container<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Container<'a> {
        Container::of_end(bytes, 0)
    }

    /// The bytes of a file from the offset `base` on.
    pub(super) fn of_end(bytes: &'a [u8], base: u64) -> Container<'a> {
        Container { bytes, base }
    }

    /// The bytes from an offset on.
    fn from(&self, at: u64, what: &str) -> Result<&'a [u8]> {
        let start = at.checked_sub(self.base).and_then(|start| usize::try_from(start).ok());
        let start = start.filter(|start| *start < self.bytes.len());
        start.map(|start| &self.bytes[start..]).ok_or_else(|| self.truncated(at, what))
    }

    fn truncated(&self, at: u64, what: &str) -> Error {
        let end = self.base + self.bytes.len() as u64;
        let what = match self.base {
            0 => format!("{what} exceeds the file, which has {end} bytes"),
            base => format!("{what} is not in the last part of the file, from {base} to {end}"),
        };
        Error::truncated(FORMAT, Position::Offset(at), what)
    }

    /// The number at an offset.
    pub(super) fn number(&self, at: u64, what: &str) -> Result<u64> {
        let number = self.from(at, what)?.first_chunk().ok_or_else(|| self.truncated(at, what))?;
        Ok(u64::from_le_bytes(*number))
    }

    /// The bytes of the data at a reference.
    pub(super) fn data(&self, reference: Reference, what: &str) -> Result<&'a [u8]> {
        if reference & DATA == 0 {
            let found = format!("expected a data block for {what}, found a group");
            return Err(Error::invalid(FORMAT, Position::Offset(reference), found));
        }
        let at = reference & !DATA;
        if at == 0 {
            return Ok(&[]);
        }
        let length = self.number(at, what)?;
        let bytes = &self.from(at, what)?[8..];
        let length = usize::try_from(length).ok().filter(|length| *length <= bytes.len());
        length.map(|length| &bytes[..length]).ok_or_else(|| self.truncated(at, what))
    }

    /// The children of a group.
    pub(super) fn group(&self, reference: Reference, what: &str) -> Result<Vec<Reference>> {
        if reference & DATA != 0 {
            let found = format!("expected a group for {what}, found a data block");
            return Err(Error::invalid(FORMAT, Position::Offset(reference & !DATA), found));
        }
        if reference == EMPTY_GROUP {
            return Ok(Vec::new());
        }
        let count = self.number(reference, what)?;
        let children = &self.from(reference, what)?[8..];
        let count = usize::try_from(count).ok().filter(|count| *count <= children.len() / 8);
        let count = count.ok_or_else(|| self.truncated(reference, what))?;
        let children = children.as_chunks().0[..count].iter();
        Ok(children.map(|child| u64::from_le_bytes(*child)).collect())
    }

    /// The bytes of a sample without its digest, and their offset.
    pub(super) fn sample(&self, reference: Reference, what: &str) -> Result<(&'a [u8], u64)> {
        let (bytes, at) = (self.data(reference, what)?, reference & !DATA);
        match bytes.split_at_checked(DIGEST_BYTES) {
            Some((_, values)) => Ok((values, at + 8 + DIGEST_BYTES as u64)),
            None if bytes.is_empty() => Ok((bytes, at)),
            None => {
                let what = format!("a sample of {what} has {} bytes, fewer than its digest", bytes.len());
                Err(Error::invalid(FORMAT, Position::Offset(at), what))
            }
        }
    }

    /// The child object named `name`.
    pub(super) fn child_object(&self, object: Reference, name: &str) -> Result<Reference> {
        let children = self.group(object, "an object")?;
        // The first child is the compound of properties, the last one the data with the names of child
        // objects.
        let [_, objects @ .., headers] = &*children else { return Err(missing(object, name)) };
        let (at, headers) = (headers & !DATA, self.data(*headers, "the names of objects")?);
        let mut rest = Words {
            bytes: headers.get(..headers.len().saturating_sub(OBJECT_HASH_BYTES)).unwrap_or_default(),
            at,
        };
        for reference in objects {
            let length = rest.number(4)?;
            let found = rest.text(length)?;
            if rest.number(1)? == bits::METADATA_FOLLOW {
                let length = rest.number(4)?;
                rest.text(length)?;
            }
            if found == name {
                return Ok(*reference);
            }
        }
        Err(missing(object, name))
    }

    /// The properties in the object's compound property named `name`.
    pub(super) fn schema(&self, object: Reference, name: &str) -> Result<Vec<(PropertyHeader, Reference)>> {
        let properties = self.group(object, "an object")?.first().copied().unwrap_or(EMPTY_GROUP);
        let found = self.properties(properties)?.into_iter().find(|(header, _)| header.name == name);
        let (_, reference) = found.ok_or_else(|| missing(object, name))?;
        self.properties(reference)
    }

    /// The properties of a compound.
    pub(super) fn properties(&self, compound: Reference) -> Result<Vec<(PropertyHeader, Reference)>> {
        let children = self.group(compound, "a compound property")?;
        let Some((headers, references)) = children.split_last() else { return Ok(Vec::new()) };
        if references.len() > PROPERTY_COUNT_MAX {
            let what =
                format!("an object has {} properties; the limit is {PROPERTY_COUNT_MAX}", references.len());
            return Err(Error::too_large(FORMAT, what));
        }
        let bytes = self.data(*headers, "the headers of properties")?;
        let mut rest = Words { bytes, at: headers & !DATA };
        references.iter().map(|reference| Ok((rest.header()?, *reference))).collect()
    }
}

fn missing(object: Reference, name: &str) -> Error {
    Error::invalid(FORMAT, Position::Offset(object), format!("the object has no {name}"))
}

/// Reads headers, which are numbers and names one after the other.
struct Words<'a> {
    bytes: &'a [u8],
    /// The offset of the headers in the file, for errors.
    at: u64,
}

impl<'a> Words<'a> {
    fn take(&mut self, length: usize) -> Result<&'a [u8]> {
        let (taken, rest) = self.bytes.split_at_checked(length).ok_or_else(|| {
            let what = format!("expected {length} more bytes of headers, found {}", self.bytes.len());
            Error::invalid(FORMAT, Position::Offset(self.at), what)
        })?;
        self.bytes = rest;
        Ok(taken)
    }

    /// Reads a number of `width` bytes, at most four.
    fn number(&mut self, width: usize) -> Result<u32> {
        let mut number = [0; 4];
        number[..width].copy_from_slice(self.take(width)?);
        Ok(u32::from_le_bytes(number))
    }

    fn text(&mut self, length: u32) -> Result<String> {
        Ok(String::from_utf8_lossy(self.take(length as usize)?).into_owned())
    }

    fn header(&mut self) -> Result<PropertyHeader> {
        let word = self.number(4)?;
        let width = match word >> bits::WIDTH_SHIFT & 3 {
            0 => 1,
            1 => 2,
            _ => 4,
        };
        let mut sampling = 0;
        if word & bits::KIND != 0 {
            // Skip the number of samples, and the first and last sample that change: our writer stores all
            // samples.
            self.number(width)?;
            if word & bits::HAS_CHANGES != 0 {
                self.number(width)?;
                self.number(width)?;
            }
            if word & bits::HAS_TIMES != 0 {
                sampling = self.number(width)?;
            }
        }
        let length = self.number(width)?;
        let name = self.text(length)?;
        let mut metadata = String::new();
        if word >> bits::METADATA_SHIFT & bits::METADATA_FOLLOW == bits::METADATA_FOLLOW {
            let length = self.number(width)?;
            metadata = self.text(length)?;
        }
        Ok(PropertyHeader { name, sampling, metadata, word })
    }
}
