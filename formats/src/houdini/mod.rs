//! Houdini's geometry since version 12: `.bgeo` and `.bgeo.sc`.
//!
//! A JSON document in Houdini's own binary encoding, which can be compressed in blocks:
//!
//! ```text
//!   .bgeo       7f 4e 53 4a 62 5b ..                                     tokens: a type byte and a payload
//!   .bgeo.sc    scf1 .. (the above, in Blosc frames) .. index 1fcs       see `container`
//! ```
//!
//! Most objects of the document are flat lists of keys and values. Only the point attributes and the point
//! groups describe particles:
//!
//! ```text
//!   ["pointcount", 10, "attributes", ["pointattributes", [
//!       [["type", "numeric", "name", "P"], ["size", 3, "storage", "fpreal32", "values", [..]]],
//!       [["type", "string", "name", "part"], ["size", 1, "strings", ["a", "b"], "indices", [..]]], ..]],
//!    "primitives", [[["type", "Part"], ..]],
//!    "pointgroups", [[["name", "fluid"], ["selection", [..]]], ..]]
//! ```
//!
//! Points without primitives are particles, and so are the points of particle systems. All other points are
//! corners of polygons, or locations of packed geometry or volumes; the reader rejects files with such
//! points.
//!
//! The layout was derived from files of Houdini 13 to 18.5 and their text versions.

pub mod bgeo;
mod tokens;
mod values;

use std::borrow::Cow;
use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::core::blosc::decode_frame;
use crate::core::bytes::{Cursor, Endian};
use crate::core::columns::role_of;
use crate::core::data::{FileAttribute, FilePositions, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::named_arrays::frame_of;
use crate::core::number::{self, NumberType, components, divided};
use crate::core::row::{FormatRow, ParticleReader};
use tokens::{JsonToken, TokenWalk, is_binary, text_count_max};
use values::{numbers, tuples};

/// The format's name in errors.
const FORMAT: &str = "Houdini geometry";

/// What to do with geometry as text.
pub(crate) const TEXT_REFUSAL: &str = "only binary geometry is supported: save it as .bgeo or .bgeo.sc";

/// Reads the points of binary geometry.
///
/// # Errors
///
/// [`crate::Error::Truncated`] if the document ends too early, [`crate::Error::Invalid`] if it is malformed
/// or inconsistent, [`crate::Error::Unsupported`] if the points are not particles, [`crate::Error::TooLarge`]
/// beyond `limits`.
pub fn read_binary(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    read(TokenWalk::new(bytes)?, limits)
}

/// Reads the points of geometry compressed in blocks.
///
/// # Errors
///
/// Those of [`read_binary`], with offsets into the decompressed data, and those of the container.
pub fn read_container(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let decompressed = decompress(bytes, limits)?;
    if is_binary(&decompressed) {
        read_binary(&decompressed, limits)
    } else {
        Err(Error::unsupported(FORMAT, TEXT_REFUSAL))
    }
}

/// The row of binary files in the table of formats. The second signature is that of big-endian machines.
pub(crate) static BINARY: FormatRow = FormatRow {
    signatures: &[b"\x7fNSJb", b"\x7fbJSN"],
    beginnings: &[b"\x7fNSJb", b"\x7fbJSN"],
    particles: Some(ParticleReader::needs_reading(read_binary)),
    ..FormatRow::new("Houdini geometry (binary JSON)", &["bgeo"])
};

/// The row of compressed files in the table of formats.
pub(crate) static CONTAINER: FormatRow = FormatRow {
    signatures: &[b"scf1"],
    beginnings: &[b"scf1"],
    particles: Some(ParticleReader::needs_reading(read_container)),
    ..FormatRow::new("Houdini geometry (.sc, Blosc-compressed)", &["bgeo.sc"])
};

// Reads the document: counts, point attributes and the types of the primitives.

/// The content found so far.
#[derive(Default)]
struct FoundGeometry {
    point_count: Option<usize>,
    positions: Option<FilePositions>,
    arrays: Vec<FileAttribute>,
    notes: Vec<String>,
    /// Number of primitives of each type.
    primitives: BTreeMap<String, u64>,
}

/// Limit on the number of primitive types; geometry has a few.
const PRIMITIVE_TYPE_COUNT_MAX: usize = 1024;

/// Reads the points.
fn read(mut walk: TokenWalk, limits: &Limits) -> Result<ParticleFrame> {
    let mut found = FoundGeometry::default();
    walk.object("", |walk, key| match key {
        "pointcount" if found.point_count.is_some() => Err(walk.invalid("pointcount occurs twice")),
        "pointcount" => {
            found.point_count = Some(point_count(walk, limits)?);
            Ok(())
        }
        "attributes" => walk.object(key, |walk, key| match key {
            "pointattributes" => point_attributes(walk, &mut found, limits),
            _ => walk.skip(),
        }),
        "pointgroups" => point_groups(walk, &mut found, limits),
        "primitives" => walk.items(key, |walk, token| primitive(walk, &token, &mut found.primitives)),
        _ => walk.skip(),
    })?;
    walk.finish()?;
    let count = found.point_count.ok_or_else(|| walk.invalid("pointcount is missing"))?;
    check_primitives(&found.primitives, count)?;
    let positions = match found.positions {
        Some(positions) => positions,
        None if count == 0 => FilePositions::default(),
        None => return Err(walk.invalid("the point attribute P is missing")),
    };
    // With positions given, a frame is always returned.
    let mut frame = frame_of(Some(positions), found.arrays).unwrap_or_default();
    frame.notes.append(&mut found.notes);
    Ok(frame)
}

fn point_count(walk: &mut TokenWalk, limits: &Limits) -> Result<usize> {
    let count = walk.count()?;
    limits.check_particles(FORMAT, count)?;
    usize::try_from(count).map_err(|_| walk.invalid("pointcount is too large"))
}

/// Reads the point groups as attributes, which are 1 for the members and 0 for other points. A group whose
/// name has another meaning for attributes gets the prefix `group_`.
fn point_groups(walk: &mut TokenWalk, found: &mut FoundGeometry, limits: &Limits) -> Result<()> {
    let count = found.point_count.ok_or_else(|| walk.invalid("the groups come before the pointcount"))?;
    walk.items("pointgroups", |walk, token| {
        if token != JsonToken::Open {
            return Err(walk.unexpected("a group", &token));
        }
        found.check_limit(limits)?;
        match point_group(walk, count, limits)? {
            (name, Some(members)) => {
                let is_taken = found.arrays.iter().any(|array| array.name == name);
                let prefix = if is_taken || role_of(&name, 1).is_some() { "group_" } else { "" };
                let name = format!("{prefix}{name}");
                found.arrays.push(FileAttribute::new(name, 1, Values::U8(members)));
            }
            (name, None) => {
                found.notes.push(format!("skipped the point group {name:?}: its encoding is not supported"));
            }
        }
        Ok(())
    })
}

impl FoundGeometry {
    /// Fails if there is no room for another attribute or group.
    fn check_limit(&self, limits: &Limits) -> Result<()> {
        limits.check_attributes(FORMAT, self.arrays.len() + self.notes.len() + 1, "attributes or more")
    }
}

fn point_attributes(walk: &mut TokenWalk, found: &mut FoundGeometry, limits: &Limits) -> Result<()> {
    let count = found.point_count.ok_or_else(|| walk.invalid("the attributes come before the pointcount"))?;
    walk.items("pointattributes", |walk, token| {
        if token != JsonToken::Open {
            return Err(walk.unexpected("an attribute", &token));
        }
        found.check_limit(limits)?;
        match point_attribute(walk, count, limits)? {
            PointAttribute::Read(array) if array.name == "P" => {
                let arity = array.arity;
                let no_positions =
                    || walk.invalid(format!("P must have 3 or 4 numbers per point, found {arity} values"));
                found.positions = Some(positions(array).ok_or_else(no_positions)?);
            }
            PointAttribute::Read(array) if array.arity == 0 => {
                found.notes.push(format!("skipped the point attribute {:?}: it has no values", array.name));
            }
            PointAttribute::Read(array) => found.arrays.push(array),
            PointAttribute::LeftOut { name, kind } => {
                found.notes.push(format!(
                    "skipped the point attribute {name:?}: its type {kind:?} is not supported"
                ));
            }
        }
        Ok(())
    })
}

/// Counts a primitive, or a run of primitives, by type.
fn primitive(walk: &mut TokenWalk, token: &JsonToken, primitives: &mut BTreeMap<String, u64>) -> Result<()> {
    if *token != JsonToken::Open {
        return Err(walk.unexpected("a primitive", token));
    }
    let mut kind = String::new();
    walk.object("primitive", |walk, key| {
        match key {
            // A run of primitives states their type as `runtype`, which takes precedence.
            "type" if kind.is_empty() => kind = long_name(&walk.text()?).to_owned(),
            "runtype" => kind = long_name(&walk.text()?).to_owned(),
            _ => walk.skip()?,
        }
        Ok(())
    })?;
    if primitives.len() < PRIMITIVE_TYPE_COUNT_MAX || primitives.contains_key(&kind) {
        *primitives.entry(kind).or_default() += 1;
    }
    walk.close()
}

/// The full name of an abbreviated type.
fn long_name(kind: &str) -> &str {
    match kind {
        "p_r" => "Poly", // a run of polygons
        other => other,
    }
}

/// Fails if the points are not particles.
fn check_primitives(primitives: &BTreeMap<String, u64>, point_count: usize) -> Result<()> {
    let is_particles = |kind: &str| matches!(kind, "Part" | "ParticleSystem");
    let Some(kind) = primitives.keys().find(|kind| !is_particles(kind)) else { return Ok(()) };
    let lower = kind.to_ascii_lowercase();
    let what = if lower.contains("packed") || lower.contains("alembic") {
        format!(
            "the file contains packed primitives ({kind}): its {point_count} points are their pivots, not particles; \
             unpack them before saving"
        )
    } else if lower.contains("vdb") || lower.contains("volume") {
        format!(
            "the file contains volumes ({kind}): its {point_count} points are their locations, not particles; use \
             the particles from which the volumes were made"
        )
    } else {
        format!(
            "the file contains surfaces or curves ({kind}): its {point_count} points belong to them and are not \
             particles; delete the primitives and keep the points, or use the original particles"
        )
    };
    Err(Error::unsupported(FORMAT, what))
}

// Reads a point attribute: its name and its values.

/// A point attribute, or the reason for skipping it.
enum PointAttribute {
    Read(FileAttribute),
    LeftOut { name: String, kind: String },
}

/// Reads the definition and the body of an attribute: a list whose start the caller has consumed.
fn point_attribute(walk: &mut TokenWalk, count: usize, limits: &Limits) -> Result<PointAttribute> {
    let (mut name, mut kind) = (String::new(), String::new());
    walk.object("definition", |walk, key| {
        match key {
            "name" => name = short_text(walk)?,
            "type" => kind = short_text(walk)?,
            _ => walk.skip()?,
        }
        Ok(())
    })?;
    let attribute = match kind.as_str() {
        "numeric" => walk.within(&name.clone(), |walk| numeric(walk, name, count, limits))?,
        "string" => walk.within(&name.clone(), |walk| strings(walk, name, count, limits))?,
        _ => {
            walk.skip()?;
            PointAttribute::LeftOut { name, kind }
        }
    };
    walk.close()?;
    Ok(attribute)
}

/// Maximum length in bytes of the name or type of an attribute. The format stores a repeated string
/// once, as a word: without this limit, many attributes could each copy the same long word.
const NAME_BYTES_MAX: usize = 1024;

fn short_text(walk: &mut TokenWalk) -> Result<String> {
    let text = walk.text()?;
    if text.len() <= NAME_BYTES_MAX {
        Ok(text.into_owned())
    } else {
        Err(Error::too_large(
            FORMAT,
            format!("a name has {} bytes, more than the limit of {NAME_BYTES_MAX} bytes", text.len()),
        ))
    }
}

fn numeric(walk: &mut TokenWalk, name: String, count: usize, limits: &Limits) -> Result<PointAttribute> {
    let mut found = None;
    walk.object("body", |walk, key| match key {
        "values" => {
            found = Some(tuples(walk, key, count, limits)?);
            Ok(())
        }
        _ => walk.skip(),
    })?;
    let found = found.ok_or_else(|| walk.invalid("the attribute has no values"))?;
    Ok(PointAttribute::Read(FileAttribute::new(name, found.size, found.values)))
}

fn strings(walk: &mut TokenWalk, name: String, count: usize, limits: &Limits) -> Result<PointAttribute> {
    let mut table: Vec<String> = Vec::new();
    let mut found = None;
    walk.object("body", |walk, key| {
        match key {
            "strings" => table = texts(walk)?,
            "indices" => found = Some(tuples(walk, key, count, limits)?),
            _ => walk.skip()?,
        }
        Ok(())
    })?;
    let found = found.ok_or_else(|| walk.invalid("the attribute has no indices"))?;
    let indices = match found.values {
        Values::I32(indices) => indices,
        Values::I64(indices) => indices.into_iter().map(|index| i32::try_from(index).unwrap_or(-1)).collect(),
        Values::U8(indices) => indices.into_iter().map(i32::from).collect(),
        _ => return Err(walk.invalid("the indices are not integers")),
    };
    Ok(PointAttribute::Read(FileAttribute::new(name, found.size, Values::Strings { table, indices })))
}

/// Reads the next value as a list of strings.
fn texts(walk: &mut TokenWalk) -> Result<Vec<String>> {
    let mut texts = Vec::new();
    let token = walk.next()?;
    if let JsonToken::Texts(found) = token {
        check_texts(walk, &found)?;
        return Ok(found.into_iter().map(|text| text.into_owned()).collect());
    }
    if token != JsonToken::Open {
        return Err(walk.unexpected("a list of strings", &token));
    }
    loop {
        let most = text_count_max(walk.file_bytes());
        if texts.len() > most {
            return Err(Error::too_large(
                FORMAT,
                format!("a list has {} or more strings, more than the limit of {most}", texts.len()),
            ));
        }
        match walk.next()? {
            JsonToken::Close => return Ok(texts),
            JsonToken::Text(text) => {
                check_texts(walk, std::slice::from_ref(&text))?;
                texts.push(text.into_owned());
            }
            JsonToken::Texts(found) => {
                check_texts(walk, &found)?;
                texts.extend(found.into_iter().map(|text| text.into_owned()));
            }
            other => return Err(walk.unexpected("a string", &other)),
        }
    }
}

/// Fails if the strings need too much memory: many strings can refer to the same word.
fn check_texts(walk: &mut TokenWalk, texts: &[Cow<str>]) -> Result<()> {
    walk.check_widened(texts.iter().map(|text| size_of::<String>() + text.len()).sum())
}

/// Converts the attribute `P` to positions. Of four floats per point, the fourth divides the first three.
fn positions(array: FileAttribute) -> Option<FilePositions> {
    match (array.arity, array.values) {
        (3, values) => number::positions(values),
        (4, Values::F32(values)) => {
            Some(FilePositions::F32(values.as_chunks::<4>().0.iter().copied().map(divided).collect()))
        }
        (4, Values::F64(values)) => {
            Some(FilePositions::F64(values.as_chunks::<4>().0.iter().copied().map(divided).collect()))
        }
        (4, values) => number::positions(components(&values, 4, 0..3)),
        _ => None,
    }
}

// Reads a point group: its name and its members.
//
//   [["name", "fluid"], ["selection", ["unordered", ["i8", [1, 1, 0, 0]]]]]               a flag per point
//                        "selection", ["unordered", ["boolRLE", [2, true, 2, false]]]     runs of flags
//                        "selection", ["ordered", [0, 1]]                                 indices of points

/// Reads the definition and the body of a group: a list whose start the caller has consumed. Returns its
/// name, and 1 or 0 for each of `count` points; `None` for an unknown encoding.
fn point_group(walk: &mut TokenWalk, count: usize, limits: &Limits) -> Result<(String, Option<Vec<u8>>)> {
    let (mut name, mut members) = (String::new(), None);
    walk.object("definition", |walk, key| match key {
        "name" => {
            name = short_text(walk)?;
            Ok(())
        }
        _ => walk.skip(),
    })?;
    walk.within(&name, |walk| {
        walk.object("group", |walk, key| match key {
            "selection" => {
                members = selection(walk, count, limits)?;
                Ok(())
            }
            _ => walk.skip(),
        })
    })?;
    walk.close()?;
    Ok((name, members))
}

fn selection(walk: &mut TokenWalk, count: usize, limits: &Limits) -> Result<Option<Vec<u8>>> {
    let mut members = None;
    walk.object("selection", |walk, key| match key {
        "unordered" => walk.object(key, |walk, key| {
            match key {
                "i8" => members = Some(flags(walk, key, count)?),
                "boolRLE" => members = Some(runs(walk, key, count, limits)?),
                _ => walk.skip()?,
            }
            Ok(())
        }),
        "ordered" => {
            members = Some(indices(walk, key, count, limits)?);
            Ok(())
        }
        _ => walk.skip(),
    })?;
    Ok(members)
}

fn flags(walk: &mut TokenWalk, key: &str, count: usize) -> Result<Vec<u8>> {
    match numbers(walk, key, NumberType::U8, count)? {
        Values::U8(mut flags) if flags.len() == count => {
            flags.iter_mut().for_each(|flag| *flag = u8::from(*flag != 0));
            Ok(flags)
        }
        _ => Err(walk.invalid(format!("the group does not have {count} flags"))),
    }
}

/// Reads pairs of a number of points and their flag.
fn runs(walk: &mut TokenWalk, key: &str, count: usize, limits: &Limits) -> Result<Vec<u8>> {
    let Values::I64(pairs) = numbers(walk, key, NumberType::I64, count.saturating_mul(2).max(2))? else {
        return Err(walk.invalid("the runs of the group are not integers"));
    };
    walk.check_spread(count as u64, limits)?;
    let mut flags = Vec::with_capacity(count);
    for [length, flag] in pairs.as_chunks::<2>().0 {
        let end = usize::try_from(*length).ok().and_then(|length| flags.len().checked_add(length));
        let end = end.filter(|end| *end <= count);
        let end = end.ok_or_else(|| walk.invalid(format!("the runs of the group exceed {count} points")))?;
        flags.resize(end, u8::from(*flag != 0));
    }
    if flags.len() == count && pairs.len() % 2 == 0 {
        Ok(flags)
    } else {
        Err(walk.invalid(format!("the runs of the group do not cover {count} points")))
    }
}

fn indices(walk: &mut TokenWalk, key: &str, count: usize, limits: &Limits) -> Result<Vec<u8>> {
    let Values::I64(indices) = numbers(walk, key, NumberType::I64, count)? else {
        return Err(walk.invalid("the members of the group are not integers"));
    };
    walk.check_spread(count as u64, limits)?;
    let mut flags = vec![0; count];
    for index in indices {
        let flag = usize::try_from(index).ok().and_then(|index| flags.get_mut(index));
        *flag.ok_or_else(|| walk.invalid(format!("the group has the point {index} of {count}")))? = 1;
    }
    Ok(flags)
}

// The container of `.sc` files: Blosc frames with an index for seeking. Each frame contains one block of
// data.
//
//   scf1 │ u64 M │ M bytes of metadata │ frame frame frame .. │ index │ u64 bytes of the index │ 1fcs
//
//   index   u64 × (frames − 1): offset of each frame but the first, relative to the first frame
//           u64 decompressed bytes of a block │ u64 decompressed bytes of the last block
//
// Integers are big-endian, except within frames, where they are little-endian. The last four bytes show that
// the file is complete.

const CONTAINER_FORMAT: &str = "Houdini geometry (.sc)";
const START: &[u8; 4] = b"scf1";
const END: &[u8; 4] = b"1fcs";

/// Size in bytes of a frame without data: the Blosc header.
const FRAME_BYTES_MIN: usize = 16;

/// Decompresses the content into one buffer.
///
/// # Errors
///
/// [`Error::Truncated`] if the end is missing, [`Error::Invalid`] if the index or a frame is invalid,
/// [`Error::TooLarge`] beyond `limits`.
fn decompress(bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
    if !bytes.ends_with(END) {
        let position = Position::Offset(bytes.len() as u64);
        return Err(Error::truncated(CONTAINER_FORMAT, position, "the file ends without its index"));
    }
    let Index { frames, block_bytes, bytes: unpacked_bytes } = index(bytes)?;
    let packed_bytes: usize = frames.iter().map(|(_, frame)| frame.len()).sum();
    limits.check_decompressed(CONTAINER_FORMAT, unpacked_bytes as u64, packed_bytes as u64)?;
    let mut decompressed = vec![0; unpacked_bytes];
    let blocks = decompressed.par_chunks_mut(block_bytes.max(1)).zip(&frames);
    blocks.try_for_each(|(block, &(at, frame))| {
        decode_frame(frame, block).map_err(|error| error.of_format(CONTAINER_FORMAT, at as u64))
    })?;
    Ok(decompressed)
}

/// The parsed index.
struct Index<'a> {
    /// Offset and bytes of each frame.
    frames: Vec<(usize, &'a [u8])>,
    block_bytes: usize,
    /// Decompressed size of all blocks.
    bytes: usize,
}

fn index(bytes: &[u8]) -> Result<Index<'_>> {
    let invalid =
        |at: usize, what: String| Error::invalid(CONTAINER_FORMAT, Position::Offset(at as u64), what);
    let mut cursor = Cursor::new(CONTAINER_FORMAT, Endian::Big, bytes, 0);
    if cursor.take(4, "the signature")? != START {
        return Err(invalid(0, "expected the signature scf1".into()));
    }
    let metadata_bytes = length(&mut cursor)?;
    let metadata_at = cursor.at();
    let footer_at = bytes.len().checked_sub(12).filter(|&at| at >= metadata_at);
    let footer_at = footer_at.ok_or_else(|| invalid(metadata_at, "the file has no index".into()))?;
    let index_bytes = length(&mut Cursor::new(CONTAINER_FORMAT, Endian::Big, bytes, footer_at))?;
    let first = metadata_at.checked_add(metadata_bytes);
    let index_at = footer_at.checked_sub(index_bytes);
    let (Some(first), Some(index_at)) =
        (first, index_at.filter(|at| first.is_some_and(|first| first <= *at)))
    else {
        let what = format!(
            "the file declares {metadata_bytes} bytes of metadata and an index of {index_bytes} bytes, but has only {} bytes",
            bytes.len()
        );
        return Err(invalid(footer_at, what));
    };
    if index_bytes < 16 || !index_bytes.is_multiple_of(8) {
        return Err(invalid(footer_at, format!("the index has an invalid size of {index_bytes} bytes")));
    }
    let frame_count = index_bytes / 8 - 1;
    let mut entries = Cursor::new(CONTAINER_FORMAT, Endian::Big, bytes, index_at);
    let mut starts = vec![first];
    for _ in 1..frame_count {
        starts.push(length(&mut entries)?.saturating_add(first));
    }
    let [block_bytes, last_bytes] = [length(&mut entries)?, length(&mut entries)?];
    let mut frames = Vec::with_capacity(frame_count);
    for (index, &start) in starts.iter().enumerate() {
        let end = starts.get(index + 1).copied().unwrap_or(index_at);
        match bytes.get(start..end) {
            Some(frame) if frame.len() >= FRAME_BYTES_MIN && end <= index_at => frames.push((start, frame)),
            _ => {
                return Err(invalid(
                    index_at,
                    format!("frame {index} of {frame_count} lies outside the frame data"),
                ));
            }
        }
    }
    let before = block_bytes.checked_mul(frame_count - 1);
    let bytes =
        before.and_then(|before| before.checked_add(last_bytes)).filter(|_| last_bytes <= block_bytes);
    let bytes = bytes.ok_or_else(|| {
        invalid(
            index_at,
            format!("invalid block sizes: {block_bytes} bytes, and {last_bytes} for the last block"),
        )
    })?;
    Ok(Index { frames, block_bytes, bytes })
}

/// Reads a size or an offset in bytes. Saturates: a value beyond the address space is invalid anyway.
fn length(cursor: &mut Cursor) -> Result<usize> {
    let length = cursor.u64("a length")?;
    Ok(usize::try_from(length).unwrap_or(usize::MAX))
}
