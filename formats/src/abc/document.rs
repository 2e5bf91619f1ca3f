//! Writes the content of the container: an archive of objects with properties.
//!
//! ```text
//!   archive    file version │ library version │ top object │ metadata │ times │ shared metadata, none here
//!   object     compound property │ a group for each child object │ their names, and two hashes
//!   compound   a group for each property │ their headers
//!   array      a sample and its dimensions, for each time
//!   scalar     a sample for each time
//! ```
//!
//! A property that never changes has one stored sample, whatever the number of times.

use std::io::{self, Write};

use super::FORMAT;
use crate::abc::digest::{DIGEST_BYTES, Hasher, SampleKey};
use crate::core::data::Provenance;
use crate::core::error::{Error, Position, Result};
use crate::core::number::NumberType;
use crate::core::provenance::{GENERATOR, escape, prefixed};

/// The version of Alembic's layout of archives in the container.
const FILE_VERSION: i32 = 0;

/// The version of the Alembic library whose files have the same layout as ours: 1.8.0.
const LIBRARY_VERSION: i32 = 10_800;

/// The metadata key of the program that wrote an archive.
pub(crate) const APPLICATION: &str = "_ai_Application";

const FPS: &str = "_ai_DCC_FPS";

/// Alembic's value of the time per cycle for acyclic sampling, which lists the time of each sample.
pub(crate) const ACYCLIC: f64 = f64::MAX / 32.0;

/// A type of values ("plain old data"), with Alembic's code for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Pod {
    Bool = 0,
    U8 = 1,
    U32 = 5,
    I32 = 6,
    U64 = 7,
    I64 = 8,
    F32 = 10,
    F64 = 11,
    String = 12,
}

/// The types of numbers, by Alembic's codes.
pub(crate) const NUMBER_TYPES: [NumberType; 12] = [
    NumberType::Bool,
    NumberType::U8,
    NumberType::I8,
    NumberType::U16,
    NumberType::I16,
    NumberType::U32,
    NumberType::I32,
    NumberType::U64,
    NumberType::I64,
    NumberType::F16,
    NumberType::F32,
    NumberType::F64,
];

/// Bits of a property header.
pub(crate) mod bits {
    pub(crate) const SCALAR: u32 = 1;
    pub(crate) const ARRAY: u32 = 2;
    pub(crate) const KIND: u32 = 3;
    /// The width of the numbers after this word: 0 for 8 bits, 1 for 16, 2 for 32.
    pub(crate) const WIDTH_SHIFT: u32 = 2;
    pub(crate) const POD_SHIFT: u32 = 4;
    pub(crate) const HAS_TIMES: u32 = 0x100;
    pub(crate) const HAS_CHANGES: u32 = 0x200;
    pub(crate) const IS_HOMOGENEOUS: u32 = 0x400;
    pub(crate) const IS_CONSTANT: u32 = 0x800;
    pub(crate) const EXTENT_SHIFT: u32 = 12;
    pub(crate) const METADATA_SHIFT: u32 = 20;
    /// The value of the metadata bits if the metadata follow the name.
    pub(crate) const METADATA_FOLLOW: u32 = 0xff;
}

/// The times of the samples.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Times {
    /// One sample, valid at all times.
    Static,
    /// Samples at these times, in frames. They increase; there is at least one.
    Frames { times: Vec<f64>, fps: f64 },
}

impl Times {
    /// The number of samples of a property.
    fn count(&self) -> usize {
        match self {
            Times::Static => 1,
            Times::Frames { times, .. } => times.len(),
        }
    }

    /// The index of the time sampling. Index 0 is always the sampling of static properties.
    fn index(&self) -> u32 {
        match self {
            Times::Static => 0,
            Times::Frames { .. } => 1,
        }
    }

    /// The time samplings as stored. Each has its number of samples, the time per cycle, the number of times
    /// in a cycle, and these times.
    #[expect(clippy::cast_possible_truncation, reason = "there are fewer than 2³² frames")]
    fn stored(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut put = |count: usize, per_cycle: f64, times: &[f64]| {
            bytes.extend((count as u32).to_le_bytes());
            bytes.extend(per_cycle.to_le_bytes());
            bytes.extend((times.len() as u32).to_le_bytes());
            times.iter().for_each(|time| bytes.extend(time.to_le_bytes()));
        };
        put(1, 1.0, &[0.0]);
        if let Times::Frames { times, fps } = self {
            let seconds: Vec<f64> = times.iter().map(|time| time / fps).collect();
            if times.windows(2).all(|pair| pair[1] - pair[0] == 1.0) {
                put(times.len(), 1.0 / fps, &seconds[..1]);
            } else {
                put(times.len(), ACYCLIC, &seconds);
            }
        }
        bytes
    }
}

/// An object of the archive.
pub(crate) struct AbcObject {
    pub(crate) name: String,
    pub(crate) metadata: String,
    pub(crate) properties: Vec<AbcProperty>,
    pub(crate) children: Vec<AbcObject>,
}

/// A property of an object, whose samples are already written.
#[derive(Clone)]
pub(crate) struct AbcProperty {
    name: String,
    metadata: String,
    content: PropertyContent,
}

#[derive(Clone)]
enum PropertyContent {
    Compound(Vec<AbcProperty>),
    /// There is either one sample for all times, or one per time.
    Values {
        is_array: bool,
        pod: Pod,
        extent: u8,
        samples: Vec<StoredSample>,
    },
}

impl AbcProperty {
    fn new(name: &str, metadata: &str, content: PropertyContent) -> AbcProperty {
        AbcProperty { name: name.to_owned(), metadata: metadata.to_owned(), content }
    }

    pub(crate) fn compound(name: &str, metadata: &str, properties: Vec<AbcProperty>) -> AbcProperty {
        AbcProperty::new(name, metadata, PropertyContent::Compound(properties))
    }

    pub(crate) fn scalar(
        name: &str,
        metadata: &str,
        (pod, extent): (Pod, u8),
        samples: Vec<StoredSample>,
    ) -> AbcProperty {
        AbcProperty::new(name, metadata, PropertyContent::Values { is_array: false, pod, extent, samples })
    }

    pub(crate) fn array(
        name: &str,
        metadata: &str,
        (pod, extent): (Pod, u8),
        samples: Vec<StoredSample>,
    ) -> AbcProperty {
        AbcProperty::new(name, metadata, PropertyContent::Values { is_array: true, pod, extent, samples })
    }

    /// Appends the samples of the same property at later times.
    pub(crate) fn append(&mut self, later: &AbcProperty) {
        match (&mut self.content, &later.content) {
            (PropertyContent::Compound(properties), PropertyContent::Compound(later)) => {
                properties.iter_mut().zip(later).for_each(|(property, later)| property.append(later));
            }
            (PropertyContent::Values { samples, .. }, PropertyContent::Values { samples: later, .. }) => {
                samples.extend(later);
            }
            // They are the same property.
            (PropertyContent::Compound(_), PropertyContent::Values { .. })
            | (PropertyContent::Values { .. }, PropertyContent::Compound(_)) => {}
        }
    }

    /// Writes the groups of the property. Returns a reference to it, and a hash of its content.
    fn write(&self, times: &Times, ogawa: &mut Ogawa) -> Result<(Reference, SampleKey)> {
        let mut hasher = Hasher::default();
        hasher.update(self.name.as_bytes());
        hasher.update(self.metadata.as_bytes());
        let group = match &self.content {
            PropertyContent::Compound(properties) => {
                let (group, hash) = write_compound(properties, times, ogawa)?;
                hasher.update(&hash);
                group
            }
            PropertyContent::Values { is_array, pod, extent, samples } => {
                hasher.update(&[u8::from(*is_array), *pod as u8, *extent]);
                let mut children = Vec::new();
                for sample in samples {
                    hasher.update(&sample.digest);
                    hasher.update(&sample.elements.to_le_bytes());
                    children.push(sample.data);
                    children.extend(is_array.then_some(sample.dimensions));
                }
                ogawa.group(&children)?
            }
        };
        Ok((group, hasher.finish()))
    }

    /// The header of the property: a word of bits, numbers, name and metadata.
    #[expect(clippy::cast_possible_truncation, reason = "there are fewer than 2³² frames; names are short")]
    fn header(&self, times: &Times) -> Vec<u8> {
        let count = times.count();
        let mut numbers = Vec::new();
        let mut word = bits::METADATA_FOLLOW << bits::METADATA_SHIFT;
        if let PropertyContent::Values { is_array, pod, extent, samples } = &self.content {
            let is_scalar_like = !is_array || samples.iter().all(|sample| sample.elements == 1);
            word |= if *is_array { bits::ARRAY } else { 0 } | if is_scalar_like { bits::SCALAR } else { 0 };
            word |= u32::from(*pod as u8) << bits::POD_SHIFT | u32::from(*extent) << bits::EXTENT_SHIFT;
            if samples.windows(2).all(|pair| pair[0].elements == pair[1].elements) {
                word |= bits::IS_HOMOGENEOUS;
            }
            if samples.len() == 1 {
                word |= bits::IS_CONSTANT;
            }
            numbers.push(count as u32);
            if times.index() > 0 {
                word |= bits::HAS_TIMES;
                numbers.push(times.index());
            }
        }
        let widest = [self.name.len(), self.metadata.len(), count].into_iter().max().unwrap_or_default();
        let width = match widest {
            0..=0xff => 0,
            0x100..=0xffff => 1,
            _ => 2,
        };
        let put = |bytes: &mut Vec<u8>, number: u32| bytes.extend(&number.to_le_bytes()[..1 << width]);
        let mut bytes = (word | width << bits::WIDTH_SHIFT).to_le_bytes().to_vec();
        numbers.into_iter().for_each(|number| put(&mut bytes, number));
        for text in [&self.name, &self.metadata] {
            put(&mut bytes, text.len() as u32);
            bytes.extend(text.as_bytes());
        }
        bytes
    }
}

fn write_compound(
    properties: &[AbcProperty],
    times: &Times,
    ogawa: &mut Ogawa,
) -> Result<(Reference, SampleKey)> {
    let (mut children, mut hasher, mut headers) = (Vec::new(), Hasher::default(), Vec::new());
    for property in properties {
        let (group, hash) = property.write(times, ogawa)?;
        hasher.update(&hash);
        children.push(group);
        headers.extend(property.header(times));
    }
    if !properties.is_empty() {
        children.push(ogawa.data(&headers)?);
    }
    Ok((ogawa.group(&children)?, hasher.finish()))
}

/// The number of bytes of the hashes after the names of child objects.
pub(crate) const OBJECT_HASH_BYTES: usize = 32;

/// Writes an object. Returns a reference to it, and the hash of everything in it.
#[expect(clippy::cast_possible_truncation, reason = "names and metadata are short")]
fn write_object(object: &AbcObject, times: &Times, ogawa: &mut Ogawa) -> Result<(Reference, SampleKey)> {
    let (properties, own_hash) = write_compound(&object.properties, times, ogawa)?;
    let mut children = vec![properties];
    let (mut headers, mut hasher) = (Vec::new(), Hasher::default());
    for child in &object.children {
        let (group, hash) = write_object(child, times, ogawa)?;
        children.push(group);
        hasher.update(&hash);
        headers.extend((child.name.len() as u32).to_le_bytes());
        headers.extend(child.name.as_bytes());
        headers.extend(bits::METADATA_FOLLOW.to_le_bytes().first());
        headers.extend((child.metadata.len() as u32).to_le_bytes());
        headers.extend(child.metadata.as_bytes());
    }
    let child_hash = if object.children.is_empty() { SampleKey::default() } else { hasher.finish() };
    headers.extend(own_hash);
    headers.extend(child_hash);
    children.push(ogawa.data(&headers)?);
    Ok((ogawa.group(&children)?, Hasher::digest(&[own_hash, child_hash].concat())))
}

/// The number of children of the root group.
pub(crate) const ROOT_CHILDREN: u64 = 6;

/// Writes an archive with objects under the top object. The metadata come first, so that readers find them in
/// the head of the file.
///
/// # Errors
/// Those of `objects` and `out`.
pub(crate) fn write_archive(
    provenance: &Provenance,
    times: &Times,
    objects: impl Fn(&mut Ogawa) -> Result<Vec<AbcObject>>,
    out: &mut dyn Write,
) -> Result<()> {
    let metadata = metadata(provenance, times);
    let build = |ogawa: &mut Ogawa| {
        let metadata = ogawa.data(metadata.as_bytes())?;
        let file_version = ogawa.data(&FILE_VERSION.to_le_bytes())?;
        let library_version = ogawa.data(&LIBRARY_VERSION.to_le_bytes())?;
        let samplings = ogawa.data(&times.stored())?;
        let (properties, children) = (Vec::new(), objects(ogawa)?);
        let top = AbcObject { name: "ABC".to_owned(), metadata: String::new(), properties, children };
        let (top, _) = write_object(&top, times, ogawa)?;
        Ok(vec![file_version, library_version, top, metadata, samplings, ogawa.data(&[])?])
    };
    Ogawa::write(build, out)
}

/// The metadata of the archive: `key=value;key=value`.
fn metadata(provenance: &Provenance, times: &Times) -> String {
    let mut entries = vec![format!("{APPLICATION}={GENERATOR}")];
    if let Times::Frames { fps, .. } = times {
        entries.push(format!("{FPS}={fps}"));
    }
    entries
        .extend(provenance.iter().map(|(key, value)| format!("{}={}", prefixed(&entry(key)), entry(value))));
    entries.join(";")
}

/// Escapes a key or a value, including the separators `;` and `=`.
fn entry(text: &str) -> String {
    escape(text).replace(';', "\\u{3b}").replace('=', "\\u{3d}")
}

// Writes the container of an archive: a tree of groups whose leaves are data.
//
//   0    "Ogawa" │ 0xff if complete │ 0, 1: the version    8 bytes
//   8    offset of the root group                          64 bits, like all numbers here
//   16   data, groups ..
//
//   group   number of children │ a reference to each: its offset; the highest bit is set for data
//   data    number of bytes │ bytes
//
// The container starts with the offset of the root group, which is written last. To know this offset, the
// writer first measures: it makes all calls once without writing, which needs sizes but no values. So the
// output need not support seeking, and a frame need not be held in memory.

pub(crate) const MAGIC: [u8; 5] = *b"Ogawa";

/// The first eight bytes of a complete archive.
pub(crate) const START: [u8; 8] = [b'O', b'g', b'a', b'w', b'a', 0xff, 0, 1];

/// Size of the part before the first group or data.
pub(crate) const HEADER_BYTES: u64 = 16;

/// A child of a group, as stored.
pub(crate) type Reference = u64;

/// The bit that marks a reference to data. A reference with only this bit means empty data.
pub(crate) const DATA: Reference = 1 << 63;

/// The reference to a group without children.
pub(crate) const EMPTY_GROUP: Reference = 0;

/// A stored sample of a property.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StoredSample {
    pub(crate) data: Reference,
    /// The data with the dimensions; empty data if the dimensions follow from the number of bytes.
    pub(crate) dimensions: Reference,
    pub(crate) digest: SampleKey,
    /// The number of elements. Each has as many numbers as the property's extent.
    pub(crate) elements: u64,
}

/// Writes the numbers of a sample as bytes.
type Emit<'a> = dyn FnMut(&mut dyn Write) -> Result<()> + 'a;

/// Writes or measures a container.
pub(crate) struct Ogawa<'a> {
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
    pub(crate) fn write(
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
    pub(crate) fn is_measuring(&self) -> bool {
        self.out.is_none()
    }

    /// Writes a group.
    pub(crate) fn group(&mut self, children: &[Reference]) -> Result<Reference> {
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
    pub(crate) fn data(&mut self, bytes: &[u8]) -> Result<Reference> {
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
    pub(crate) fn sample(&mut self, elements: u64, byte_count: u64, emit: &mut Emit) -> Result<StoredSample> {
        let mut sample =
            StoredSample { data: DATA, dimensions: DATA, digest: SampleKey::default(), elements };
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
    pub(crate) fn small_sample(&mut self, elements: u64, bytes: &[u8]) -> Result<StoredSample> {
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
