//! Reads the structure of any archive in the container Ogawa: objects, properties, samples and their times.
//!
//! Only what is asked for is read: a file can be larger than memory. Every reference is an offset, so the
//! reader checks that the target is inside the file. A valid file uses each byte of structure once. The reader
//! counts them, so references that form a cycle, or share groups, end with an error.

use std::cell::Cell;
use std::rc::Rc;

use super::FORMAT;
use super::document::{
    ACYCLIC, APPLICATION, DATA, EMPTY_GROUP, HEADER_BYTES, MAGIC, NUMBER_TYPES, OBJECT_HASH_BYTES, Pod,
    ROOT_CHILDREN, Reference, START, bits,
};
use crate::abc::digest::DIGEST_BYTES;
use crate::core::batches::ReadAt;
use crate::core::bytes::Endian;
use crate::core::data::Values;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::number::{distinct_strings, gathered};
use crate::core::provenance::from_escaped;
use crate::core::text::excerpt;

/// The start of a file in the older container.
pub(crate) const HDF5: &[u8] = b"\x89HDF\r\n\x1a\n";

/// Times closer than this, in seconds, are the same time: programs round them in different ways.
pub(super) const TIME_TOLERANCE: f64 = 1e-6;

/// Checks the first bytes of a file.
pub(super) fn check_start(bytes: &[u8]) -> Result<()> {
    if bytes.starts_with(HDF5) {
        let what = "this archive is in HDF5, Alembic's older container: save it again as Ogawa, for example with abcconvert -toOgawa";
        return Err(Error::unsupported(FORMAT, what));
    }
    let magic_length = bytes.len().min(MAGIC.len());
    if bytes[..magic_length] != MAGIC[..magic_length] {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected Ogawa"));
    }
    let position = Position::Offset(magic_length as u64);
    match bytes.get(magic_length..START.len()) {
        None | Some([0, ..]) => {
            let what = "the program that writes this file did not complete it";
            Err(Error::truncated(FORMAT, position, what))
        }
        Some(version) if version != &START[MAGIC.len()..] => {
            let what = format!("expected version 1 of Ogawa, found the bytes {version:02x?}");
            Err(Error::invalid(FORMAT, position, what))
        }
        Some(_) => Ok(()),
    }
}

/// The provenance in the metadata of an archive; `None` if another program wrote the archive.
pub(super) fn own_metadata(metadata: &[u8]) -> Option<Vec<(String, String)>> {
    let text = std::str::from_utf8(metadata).ok()?;
    let mut entries = text.split(';').filter_map(|entry| entry.split_once('='));
    entries.next().filter(|(key, value)| *key == APPLICATION && value.starts_with("meniscus "))?;
    Some(from_escaped(entries))
}

/// The value of a key in metadata; empty without it.
pub(super) fn entry<'m>(metadata: &'m str, key: &str) -> &'m str {
    let entries = metadata.split(';').filter_map(|entry| entry.split_once('='));
    entries.into_iter().find(|(name, _)| *name == key).map_or("", |(_, value)| value)
}

/// The times of samples, in seconds: those of a cycle, which repeats.
#[derive(Debug)]
struct TimeSampling {
    per_cycle: f64,
    times: Vec<f64>,
}

impl TimeSampling {
    fn time(&self, index: u32) -> f64 {
        let (index, count) = (index as usize, self.times.len().max(1));
        if self.per_cycle == ACYCLIC {
            return self.times.get(index).or(self.times.last()).copied().unwrap_or_default();
        }
        let start = self.times.get(index % count).copied().unwrap_or_default();
        start + (index / count) as f64 * self.per_cycle
    }
}

/// An object, before its group is read.
pub(super) struct ObjectHeader {
    pub(super) name: String,
    pub(super) metadata: Rc<str>,
    pub(super) reference: Reference,
}

/// The header of a property, and a reference to its samples.
#[derive(Clone, Debug)]
pub(super) struct PropertyHeader {
    pub(super) name: String,
    pub(super) metadata: Rc<str>,
    pub(super) sample_count: u32,
    /// The first and last sample that differ from the one before. Samples outside this range are not stored.
    changes: [u32; 2],
    /// The index of the property's time sampling.
    pub(super) sampling: u32,
    word: u32,
    reference: Reference,
}

impl PropertyHeader {
    /// Alembic's code for the type of the property's numbers; `None` for a compound.
    pub(super) fn pod(&self) -> Option<u32> {
        (self.word & bits::KIND != 0).then_some(self.word >> bits::POD_SHIFT & 0xf)
    }

    /// Numbers per element.
    pub(super) fn extent(&self) -> usize {
        (self.word >> bits::EXTENT_SHIFT & 0xff) as usize
    }

    /// Fails unless the values have this type and extent.
    fn check_type(&self, pod: Pod, extent: usize) -> Result<()> {
        if self.pod() == Some(pod as u32) && self.extent() == extent {
            return Ok(());
        }
        let (name, kind) = (excerpt(&self.name), self.pod().unwrap_or_default());
        let what =
            format!("{name} has values of the type {kind} × {}; expected {pod:?} × {extent}", self.extent());
        Err(Error::invalid(FORMAT, Position::Offset(self.reference), what))
    }

    /// Whether a sample differs from the one before.
    pub(super) fn is_changing(&self) -> bool {
        self.changes[1] > 0
    }

    /// The position of a sample among those that are stored.
    fn stored_index(&self, index: u32) -> u64 {
        let [first, last] = self.changes;
        let stored = match index {
            _ if last == 0 => 0,
            index if index < first => 0,
            index => index.min(last).saturating_sub(first) + 1,
        };
        stored.into()
    }
}

/// An open archive.
pub(super) struct Archive<'a> {
    file: &'a dyn ReadAt,
    limits: &'a Limits,
    pub(super) file_bytes: u64,
    /// Bytes of structure that a valid file may still have.
    structure_bytes: Cell<u64>,
    /// Memory that values needed so far.
    value_bytes: Cell<u64>,
    pub(super) metadata: Vec<u8>,
    shared_metadata: Vec<Rc<str>>,
    samplings: Vec<TimeSampling>,
    pub(super) top: Reference,
}

impl<'a> Archive<'a> {
    pub(super) fn open(file: &'a dyn ReadAt, limits: &'a Limits) -> Result<Archive<'a>> {
        let file_bytes = file.size_bytes()?;
        let mut archive = Archive {
            file,
            limits,
            file_bytes,
            structure_bytes: Cell::new(file_bytes),
            value_bytes: Cell::new(0),
            metadata: Vec::new(),
            shared_metadata: Vec::new(),
            samplings: Vec::new(),
            top: EMPTY_GROUP,
        };
        check_start(&archive.read(0, file_bytes.min(HEADER_BYTES), "the header")?)?;
        let root = archive.group(archive.number(8, "the offset of the root group")?, "the root group")?;
        let [_, _, top, metadata, samplings, shared, ..] = *root else {
            let what = format!("the root group has {} children; expected {ROOT_CHILDREN}", root.len());
            return Err(Error::invalid(FORMAT, Position::Offset(8), what));
        };
        archive.top = top;
        archive.metadata = archive.data(metadata, "the metadata")?;
        archive.samplings = archive.read_samplings(samplings)?;
        let bytes = archive.data(shared, "the shared metadata")?;
        let mut rest = Words { bytes: &bytes, at: shared & !DATA };
        while !rest.bytes.is_empty() {
            let length = rest.number(1)?;
            archive.shared_metadata.push(rest.text(length)?.into());
        }
        Ok(archive)
    }

    fn read_samplings(&self, reference: Reference) -> Result<Vec<TimeSampling>> {
        let bytes = self.data(reference, "the time samplings")?;
        let mut rest = Words { bytes: &bytes, at: reference & !DATA };
        let mut samplings = Vec::new();
        while !rest.bytes.is_empty() {
            rest.number(4)?; // the number of samples, which each property states as well
            let per_cycle = rest.real()?;
            let count = rest.number(4)? as usize;
            let times = rest.take(count.saturating_mul(8))?.as_chunks().0;
            let times = times.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
            samplings.push(TimeSampling { per_cycle, times });
        }
        Ok(samplings)
    }

    // Times.

    /// The time of a sample of a property, in seconds.
    pub(super) fn time(&self, sampling: u32, index: u32) -> f64 {
        self.samplings.get(sampling as usize).map_or(0.0, |sampling| sampling.time(index))
    }

    /// The last sample of a property at or before a time or, if there is none or no time is given, the first.
    pub(super) fn index_at(&self, property: &PropertyHeader, time: Option<f64>) -> u32 {
        let Some(time) = time else { return 0 };
        let (mut first, mut end) = (0, property.sample_count);
        while end.saturating_sub(first) > 1 {
            let middle = first + (end - first) / 2;
            if self.time(property.sampling, middle) <= time + TIME_TOLERANCE {
                first = middle;
            } else {
                end = middle;
            }
        }
        first
    }

    // Objects and properties.

    /// The properties of an object, and its children.
    pub(super) fn object(&self, reference: Reference) -> Result<(Vec<PropertyHeader>, Vec<ObjectHeader>)> {
        let group = self.group(reference, "an object")?;
        // The first child is the compound of properties, the last one the data with the names of child
        // objects.
        let Some((properties, rest)) = group.split_first() else { return Ok(Default::default()) };
        let properties = self.properties(*properties)?;
        let Some((headers, references)) = rest.split_last() else { return Ok((properties, Vec::new())) };
        let bytes = self.data(*headers, "the names of objects")?;
        let names = bytes.get(..bytes.len().saturating_sub(OBJECT_HASH_BYTES)).unwrap_or_default();
        let mut rest = Words { bytes: names, at: headers & !DATA };
        let mut child = |reference: &Reference| {
            let length = rest.number(4)?;
            let name = rest.text(length)?;
            let metadata = self.metadata_of(rest.number(1)?, 4, &mut rest)?;
            Ok(ObjectHeader { name, metadata, reference: *reference })
        };
        let children: Result<_> = references.iter().map(&mut child).collect();
        Ok((properties, children?))
    }

    /// The properties in a compound property.
    pub(super) fn compound(&self, property: &PropertyHeader) -> Result<Vec<PropertyHeader>> {
        if property.pod().is_some() {
            let what = format!("expected {} to be a compound property", excerpt(&property.name));
            return Err(Error::invalid(FORMAT, Position::Offset(property.reference), what));
        }
        self.properties(property.reference)
    }

    fn properties(&self, compound: Reference) -> Result<Vec<PropertyHeader>> {
        let children = self.group(compound, "a compound property")?;
        let Some((headers, references)) = children.split_last() else { return Ok(Vec::new()) };
        let bytes = self.data(*headers, "the headers of properties")?;
        let mut rest = Words { bytes: &bytes, at: headers & !DATA };
        references.iter().map(|reference| self.property(&mut rest, *reference)).collect()
    }

    fn property(&self, rest: &mut Words, reference: Reference) -> Result<PropertyHeader> {
        let word = rest.number(4)?;
        let width = match word >> bits::WIDTH_SHIFT & 3 {
            0 => 1,
            1 => 2,
            _ => 4,
        };
        let (mut sample_count, mut changes, mut sampling) = (0, [0; 2], 0);
        if word & bits::KIND != 0 {
            sample_count = rest.number(width)?;
            if word & bits::HAS_CHANGES != 0 {
                changes = [rest.number(width)?, rest.number(width)?];
            } else if word & bits::IS_CONSTANT == 0 {
                changes = [1, sample_count.saturating_sub(1)];
            }
            if word & bits::HAS_TIMES != 0 {
                sampling = rest.number(width)?;
            }
        }
        let length = rest.number(width)?;
        let name = rest.text(length)?;
        let metadata = self.metadata_of(word >> bits::METADATA_SHIFT & bits::METADATA_FOLLOW, width, rest)?;
        Ok(PropertyHeader { name, metadata, sample_count, changes, sampling, word, reference })
    }

    /// The metadata with an index among the shared ones; entry 0, which is not stored, is empty.
    fn metadata_of(&self, index: u32, width: usize, rest: &mut Words) -> Result<Rc<str>> {
        if index == bits::METADATA_FOLLOW {
            let length = rest.number(width)?;
            return Ok(rest.text(length)?.into());
        }
        let Some(index) = (index as usize).checked_sub(1) else { return Ok("".into()) };
        self.shared_metadata.get(index).cloned().ok_or_else(|| {
            let what = format!("there is no shared metadata {}", index + 1);
            Error::invalid(FORMAT, Position::Offset(rest.at), what)
        })
    }

    // Samples.

    /// The data of a sample of a property; `None` without samples.
    pub(super) fn sample(&self, property: &PropertyHeader, index: u32) -> Result<Option<Reference>> {
        if property.sample_count == 0 {
            return Ok(None);
        }
        let per_sample = if property.word & bits::ARRAY != 0 { 2 } else { 1 };
        let (child, at) = (per_sample * property.stored_index(index), property.reference);
        let count = if at == EMPTY_GROUP || at & DATA != 0 { 0 } else { self.number(at, "samples")? };
        if child >= count {
            let what = format!(
                "{} has {count} references to samples; expected {}",
                excerpt(&property.name),
                child + 1
            );
            return Err(Error::invalid(FORMAT, Position::Offset(at & !DATA), what));
        }
        self.number(at.saturating_add(8 + 8 * child), "samples").map(Some)
    }

    /// The number of bytes of a sample, without its digest.
    pub(super) fn sample_bytes(&self, sample: Option<Reference>) -> Result<u64> {
        let Some(reference) = sample.filter(|reference| *reference != DATA) else { return Ok(0) };
        let at = reference & !DATA;
        let length = self.number(at, "a sample")?;
        match length.checked_sub(DIGEST_BYTES as u64).filter(|_| reference & DATA != 0) {
            Some(length) if self.holds(at + 8, length) => Ok(length),
            Some(_) => Err(self.truncated(at, "a sample")),
            None => {
                let what = format!("a sample has {length} bytes, fewer than its digest");
                Err(Error::invalid(FORMAT, Position::Offset(at), what))
            }
        }
    }

    /// The bytes of a sample without its digest. `memory` is what its values need per byte.
    fn sample_data(&self, property: &PropertyHeader, index: u32, memory: u64) -> Result<Vec<u8>> {
        let sample = self.sample(property, index)?;
        let length = self.sample_bytes(sample)?;
        self.claim(length.saturating_mul(1 + memory))?;
        let at = sample.unwrap_or(DATA) & !DATA;
        self.read(at.saturating_add(8 + DIGEST_BYTES as u64), length, "a sample")
    }

    /// Counts the memory of values before it is allocated: many objects may share a sample.
    fn claim(&self, bytes: u64) -> Result<()> {
        let total = self.value_bytes.get().saturating_add(bytes);
        self.value_bytes.set(total);
        self.limits.check_decompressed(FORMAT, total, self.file_bytes)
    }

    /// The elements of a sample, each of `N` bytes, of values of this type.
    pub(super) fn elements<const N: usize>(
        &self,
        property: &PropertyHeader,
        (pod, extent): (Pod, usize),
        index: u32,
    ) -> Result<Vec<[u8; N]>> {
        property.check_type(pod, extent)?;
        let bytes = self.sample_data(property, index, 1)?;
        match bytes.as_chunks() {
            (elements, []) => Ok(elements.to_vec()),
            _ => {
                let (name, length) = (excerpt(&property.name), bytes.len());
                let what = format!("{name} has {length} bytes, not a multiple of {N}");
                Err(Error::invalid(FORMAT, Position::Offset(property.reference), what))
            }
        }
    }

    /// The numbers of a sample; for strings, each of them.
    fn values(&self, property: &PropertyHeader, index: u32) -> Result<Values> {
        let pod = property.pod().unwrap_or_default() as usize;
        if pod == Pod::String as usize {
            return Ok(distinct_strings(self.strings(property, index)?));
        }
        let Some(number) = NUMBER_TYPES.get(pod) else {
            let what = format!("{} has values of the unsupported type {pod}", excerpt(&property.name));
            return Err(Error::unsupported(FORMAT, what));
        };
        let memory = (8 / number.size()) as u64;
        Ok(number.decode(&self.sample_data(property, index, memory)?, Endian::Little))
    }

    fn strings(&self, property: &PropertyHeader, index: u32) -> Result<Vec<String>> {
        // In the file, an empty string is a single byte. Invalid UTF-8 becomes longer.
        let bytes = self.sample_data(property, index, 8)?;
        let count = bytes.iter().filter(|byte| **byte == 0).count() + 1;
        self.claim((2 * count * size_of::<(String, i32)>()) as u64)?;
        Ok(String::from_utf8_lossy(&bytes).split_terminator('\0').map(str::to_owned).collect())
    }

    /// The number of values per particle of a geometry parameter at a time, and all values: an array, or values and
    /// indices into them.
    pub(super) fn param(&self, property: &PropertyHeader, time: Option<f64>) -> Result<(usize, Values)> {
        let parts = if property.pod().is_none() { self.compound(property)? } else { Vec::new() };
        let part = |name: &str| parts.iter().find(|part| part.name == name);
        let values = part(".vals").unwrap_or(property);
        let elements = entry(&property.metadata, "arrayExtent").parse().unwrap_or(1).max(1);
        let (extent, index) = (values.extent().max(1), self.index_at(values, time));
        let arity = extent.saturating_mul(elements);
        if values.pod().is_none() {
            let what = format!("{} has no values", excerpt(&property.name));
            return Err(Error::invalid(FORMAT, Position::Offset(property.reference), what));
        }
        let Some(of_values) = part(".indices") else {
            return Ok((arity, self.values(values, index)?));
        };
        let indices = self.elements::<4>(of_values, (Pod::U32, 1), self.index_at(of_values, time))?;
        self.claim((indices.len() as u64).saturating_mul(8 * extent as u64))?;
        let indices: Vec<u32> = indices.into_iter().map(u32::from_le_bytes).collect();
        if values.pod() == Some(Pod::String as u32) {
            let table = self.strings(values, index)?;
            let is_string = |index: &i32| usize::try_from(*index).is_ok_and(|index| index < table.len());
            let index = |index: u32| i32::try_from(index).ok().filter(is_string).unwrap_or(-1);
            let indices = indices.into_iter().map(index).collect();
            return Ok((arity, Values::Strings { table, indices }));
        }
        let values = gathered(&self.values(values, index)?, extent, &indices).ok_or_else(|| {
            let what = format!("an index of {} is beyond its values", excerpt(&property.name));
            Error::invalid(FORMAT, Position::Offset(property.reference), what)
        })?;
        Ok((arity, values))
    }

    // Groups and data.

    /// Whether these bytes are inside the file.
    fn holds(&self, at: u64, length: u64) -> bool {
        at.checked_add(length).is_some_and(|end| end <= self.file_bytes)
    }

    fn truncated(&self, at: u64, subject: &str) -> Error {
        let what = format!("{subject} exceeds the file, which has {} bytes", self.file_bytes);
        Error::truncated(FORMAT, Position::Offset(at), what)
    }

    fn read(&self, at: u64, length: u64, subject: &str) -> Result<Vec<u8>> {
        let count = usize::try_from(length).ok().filter(|_| length == 0 || self.holds(at, length));
        let mut bytes = vec![0; count.ok_or_else(|| self.truncated(at, subject))?];
        if length > 0 {
            self.file.read_exact_at(&mut bytes, at)?;
        }
        Ok(bytes)
    }

    /// The number at an offset.
    fn number(&self, at: u64, subject: &str) -> Result<u64> {
        let mut bytes = [0; 8];
        bytes.copy_from_slice(&self.read(at, 8, subject)?);
        Ok(u64::from_le_bytes(bytes))
    }

    /// Reads a part of the structure, of `length` bytes after its own size.
    fn structure(&self, at: u64, length: u64, subject: &str) -> Result<Vec<u8>> {
        if !self.holds(at.saturating_add(8), length) {
            return Err(self.truncated(at, subject));
        }
        let rest = self.structure_bytes.get().checked_sub(length.saturating_add(8)).ok_or_else(|| {
            let what = format!("{subject} is used more than once: the references form a cycle");
            Error::invalid(FORMAT, Position::Offset(at), what)
        })?;
        self.structure_bytes.set(rest);
        self.read(at.saturating_add(8), length, subject)
    }

    /// The bytes of the data at a reference.
    fn data(&self, reference: Reference, subject: &str) -> Result<Vec<u8>> {
        let at = reference & !DATA;
        if reference & DATA == 0 {
            let what = format!("expected a data block for {subject}, found a group");
            return Err(Error::invalid(FORMAT, Position::Offset(at), what));
        }
        if at == 0 {
            return Ok(Vec::new());
        }
        self.structure(at, self.number(at, subject)?, subject)
    }

    /// The children of a group.
    fn group(&self, reference: Reference, subject: &str) -> Result<Vec<Reference>> {
        if reference & DATA != 0 {
            let what = format!("expected a group for {subject}, found a data block");
            return Err(Error::invalid(FORMAT, Position::Offset(reference & !DATA), what));
        }
        if reference == EMPTY_GROUP {
            return Ok(Vec::new());
        }
        let count = self.number(reference, subject)?;
        let children = self.structure(reference, count.saturating_mul(8), subject)?;
        Ok(children.as_chunks().0.iter().map(|child| u64::from_le_bytes(*child)).collect())
    }
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

    fn real(&mut self) -> Result<f64> {
        let mut number = [0; 8];
        number.copy_from_slice(self.take(8)?);
        Ok(f64::from_le_bytes(number))
    }

    fn text(&mut self, length: u32) -> Result<String> {
        Ok(String::from_utf8_lossy(self.take(length as usize)?).into_owned())
    }
}
