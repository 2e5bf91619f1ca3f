//! Writes the container of an archive: a tree of groups whose leaves are data.
//!
//! ```text
//!   0    "Ogawa" │ 0xff if complete │ 0, 1: the version    8 bytes
//!   8    offset of the root group                          64 bits, like all numbers here
//!   16   data, groups ..
//!
//!   group   number of children │ a reference to each: its offset; the highest bit is set for data
//!   data    number of bytes │ bytes
//! ```
//!
//! The container starts with the offset of the root group, which is written last. To know this offset, the
//! writer first measures: it makes all calls once without writing, which needs sizes but no values. So the
//! output need not support seeking, and a frame need not be held in memory.

use std::io::{self, Write};

use crate::error::{Error, Position, Result};

use super::FORMAT;
use crate::digest::{DIGEST_BYTES, Hasher, SampleKey};

pub(super) const MAGIC: [u8; 5] = *b"Ogawa";

/// The first eight bytes of a complete archive.
pub(super) const START: [u8; 8] = [b'O', b'g', b'a', b'w', b'a', 0xff, 0, 1];

/// Size of the part before the first group or data.
pub(super) const HEADER_BYTES: u64 = 16;

/// A child of a group, as stored.
pub(super) type Reference = u64;

/// The bit that marks a reference to data. A reference with only this bit means empty data.
pub(super) const DATA: Reference = 1 << 63;

/// The reference to a group without children.
pub(super) const EMPTY_GROUP: Reference = 0;

/// A stored sample of a property.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sample {
    pub(super) data: Reference,
    /// The data with the dimensions; empty data if the dimensions follow from the number of bytes.
    pub(super) dimensions: Reference,
    pub(super) digest: SampleKey,
    /// The number of elements. Each has as many numbers as the property's extent.
    pub(super) elements: u64,
}

/// Writes the numbers of a sample as bytes.
pub(super) type Emit<'a> = dyn FnMut(&mut dyn Write) -> Result<()> + 'a;

/// Writes or measures a container.
pub(super) struct Ogawa<'a> {
    /// `None` while measuring.
    out: Option<&'a mut dyn Write>,
    at: u64,
}

impl Ogawa<'_> {
    /// Writes an archive, whose groups and data `build` writes. `build` is called twice, first to measure,
    /// and must make the same calls both times. It returns the children of the root group.
    ///
    /// # Errors
    /// Those of `build` and `out`; [`Error::Invalid`] if the calls differ.
    pub(super) fn write(
        build: impl Fn(&mut Ogawa) -> Result<Vec<Reference>>,
        out: &mut dyn Write,
    ) -> Result<()> {
        let mut measured = Ogawa { out: None, at: HEADER_BYTES };
        build(&mut measured)?;
        let root = measured.at;
        out.write_all(&START)?;
        out.write_all(&root.to_le_bytes())?;
        let mut written = Ogawa { out: Some(out), at: HEADER_BYTES };
        let children = build(&mut written)?;
        if written.at != root {
            return Err(changed());
        }
        written.group(&children)?;
        Ok(())
    }

    /// Whether this container only measures, which needs no values.
    pub(super) fn is_measuring(&self) -> bool {
        self.out.is_none()
    }

    /// Writes a group.
    pub(super) fn group(&mut self, children: &[Reference]) -> Result<Reference> {
        if children.is_empty() {
            return Ok(EMPTY_GROUP);
        }
        let at = self.at;
        self.put(&(children.len() as u64).to_le_bytes())?;
        for child in children {
            self.put(&child.to_le_bytes())?;
        }
        Ok(at)
    }

    /// Writes data.
    pub(super) fn data(&mut self, bytes: &[u8]) -> Result<Reference> {
        if bytes.is_empty() {
            return Ok(DATA);
        }
        let at = self.at;
        self.put(&(bytes.len() as u64).to_le_bytes())?;
        self.put(bytes)?;
        Ok(DATA | at)
    }

    /// Writes a sample of `elements` elements that take `byte_count` bytes in all. `emit` is called twice,
    /// for the digest and for the bytes, and not at all while measuring.
    ///
    /// # Errors
    /// Those of `emit` and the output; [`Error::Invalid`] if `emit` writes another number of bytes.
    pub(super) fn sample(&mut self, elements: u64, byte_count: u64, emit: &mut Emit) -> Result<Sample> {
        let mut sample = Sample { data: DATA, dimensions: DATA, digest: SampleKey::default(), elements };
        if byte_count == 0 {
            return Ok(sample);
        }
        sample.data = DATA | self.at;
        let stored = byte_count + DIGEST_BYTES as u64;
        let Some(out) = &mut self.out else {
            self.at += 8 + stored;
            return Ok(sample);
        };
        let mut hasher = Hasher::default();
        emit(&mut hasher)?;
        sample.digest = hasher.finish();
        out.write_all(&stored.to_le_bytes())?;
        out.write_all(&sample.digest)?;
        let mut counted = Counted { out: &mut **out, count: 0 };
        emit(&mut counted)?;
        if counted.count != byte_count {
            return Err(changed());
        }
        self.at += 8 + stored;
        Ok(sample)
    }

    /// Writes a sample of these bytes.
    pub(super) fn small_sample(&mut self, elements: u64, bytes: &[u8]) -> Result<Sample> {
        self.sample(elements, bytes.len() as u64, &mut |out| Ok(out.write_all(bytes)?))
    }

    fn put(&mut self, bytes: &[u8]) -> Result<()> {
        if let Some(out) = &mut self.out {
            out.write_all(bytes)?;
        }
        self.at += bytes.len() as u64;
        Ok(())
    }
}

fn changed() -> Error {
    Error::invalid(FORMAT, Position::File, "the frame changed while it was being written")
}

/// Counts the bytes of a sample.
struct Counted<'a> {
    out: &'a mut dyn Write,
    count: u64,
}

impl Write for Counted<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let count = self.out.write(bytes)?;
        self.count += count as u64;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}
