//! NumPy arrays: one array in a `.npy` file, several named ones in a `.npz` file.
//!
//! ```text
//!   93 N U M P Y  1 0  u16        signature, version 1.0 to 3.0, length of the header (u32 from 2.0 on)
//!   {'descr': '<f4', 'fortran_order': False, 'shape': (1000, 3), }   a Python dictionary, padded with blanks
//!   numbers                       row by row, or column by column in Fortran order
//! ```
//!
//! An array of shape (N, 3) contains the positions. If it has more columns, the first three are the position,
//! unless the first has different integers: see `first_column.rs`. An array of shape (T, N, 3) has T
//! frames. The shape (3, N) is refused for N > 4: its rows are x, y and z, and three particles with many
//! attributes are rare.
//!
//! A structured array has a name per field, and an archive has a name per array. The names are interpreted as
//! in all formats: `pos` or `x`, `y`, `z` for the position, `vel`, `radius` and so on. Arrays without a value
//! per particle, such as a time step saved along with the rest, are skipped with a note.

mod header;

use std::borrow::Cow;
use std::io::Read;
use std::sync::Arc;

use crate::bytes::{Cursor, Endian};
use crate::columns::position_rank;
use crate::data::{ParticleFrame, Values};
use crate::error::{Error, Position, Result};
use crate::first_column::{self, FirstColumn};
use crate::limits::Limits;
use crate::named_arrays::{ArrayShape, NamedArray, frame_of, position_count, unnamed_position_count};
use crate::number::{self, NumberType, components, interleaved};
use crate::row::{Completeness, FormatRow, HeadCheck, ParticleReader};
use crate::steps::{FoundStep, StepSource};
use crate::text::{excerpt, excerpts};
use header::{ArrayHeader, COLUMNS_MAX, ElementLayout, StructField};

/// The format's name in errors.
const FORMAT: &str = "NumPy array";
const ARCHIVE: &str = "NumPy archive";

/// Reads the particles of a `.npy` file.
///
/// # Errors
///
/// [`Error::Invalid`] for a malformed header or an array that is not a list of positions,
/// [`Error::Truncated`] if data is missing, [`Error::Unsupported`] for non-numeric types and for several
/// frames, which [`crate::steps::find_steps`] locates; [`Error::TooLarge`] beyond `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let header = header::read(bytes, limits)?;
    check_shape(&header)?;
    let data = header.data(bytes)?;
    if header.frame_count().is_some() {
        let found = header.shown();
        let what = if header.is_fortran {
            format!(
                "{found} has several frames, and in Fortran order they cannot be read separately: save \
                 numpy.ascontiguousarray(array)"
            )
        } else {
            format!("{found} has several frames: read each frame separately")
        };
        return Err(Error::unsupported(FORMAT, what));
    }
    let (arrays, mut notes) = arrays_of(&header, data, limits)?;
    let is_structured = matches!(header.layout, ElementLayout::Fields { .. });
    let mut frame = if is_structured {
        frame_of(None, arrays).ok_or_else(|| no_position(&header))?
    } else {
        let is_list = |array: &NamedArray| array.arity >= 3 && header.shape.len() >= 2;
        let array = arrays.into_iter().find(is_list);
        unnamed_frame(array.ok_or_else(|| no_position(&header))?)?
    };
    frame.notes.append(&mut notes);
    Ok(frame)
}

/// Finds the frames of an array.
fn steps_of_array(source: StepSource, steps: &mut Vec<FoundStep>, limits: &Limits) -> Result<()> {
    let bytes = source.first_bytes(limits.header_bytes)?;
    // The reader reports what is wrong with an array.
    let frame = header::read(&bytes, limits).ok().and_then(|header| {
        let (head, frame_bytes) = header.of_frame(&bytes)?;
        Some((Arc::from(head), header.data_offset as u64, frame_bytes, header.frame_count()?))
    });
    let Some((head, data_offset, frame_bytes, count)) = frame else { return Ok(()) };
    for index in 0..count {
        limits.check_step(FORMAT, steps.len())?;
        let start = data_offset + index * frame_bytes;
        let range = start..start + frame_bytes;
        steps.push(FoundStep {
            number: i64::try_from(index).ok(),
            head: Arc::clone(&head),
            range,
            lines_before: 0,
        });
    }
    Ok(())
}

/// Refuses images, matrices, and arrays with a column for each particle: with four columns or fewer, the rows
/// of a (3, N) array are particles.
fn check_shape(header: &ArrayHeader) -> Result<()> {
    let ElementLayout::Plain { number, .. } = header.layout else { return Ok(()) };
    if let [3, columns] = header.shape[..]
        && columns > 4
    {
        let what = format!(
            "expected positions as an array of shape (N, 3), found {}, which has a column for each particle: save its \
             transpose, `array.T`",
            header.shown()
        );
        return Err(Error::invalid(FORMAT, Position::File, what));
    }
    let is_byte = matches!(number, NumberType::U8 | NumberType::Bool);
    let reason = match header.shape[..] {
        [_, _, _, ..] if is_byte => "8-bit numbers in three dimensions are a picture",
        [_, columns] if columns > COLUMNS_MAX => "a list of particles does not have so many columns",
        [_, _, columns] if !(3..=COLUMNS_MAX).contains(&columns) => {
            "the last dimension must be that of x, y and z"
        }
        [_, _, _, _, ..] => "there are too many dimensions",
        _ => return Ok(()),
    };
    let what = format!(
        "expected positions as an array of shape (N, 3), with more columns, or (T, N, 3) for T frames, found {}: \
         {reason}; reshape it, for example with array.reshape(-1, 3)",
        header.shown()
    );
    Err(Error::invalid(FORMAT, Position::File, what))
}

/// Reads the particles of a `.npz` file.
///
/// # Errors
///
/// The errors of [`read`] for each array, and [`Error::Invalid`] for a damaged archive.
pub fn read_archive(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let mut arrays = Vec::new();
    let mut notes = Vec::new();
    let (mut pickled, mut last_unfit) = (Vec::new(), None);
    let mut totals = ArchiveTotals::default();
    for member in members(bytes, limits)? {
        let Some(name) = member.name.strip_suffix(".npy") else { continue };
        let content = member.content(bytes, limits, &mut totals)?;
        let within = |error| within_member(error, name);
        let header = header::read(&content, limits).map_err(within)?;
        if let ElementLayout::Unread(what) = &header.layout {
            notes.push(format!("skipped `{}`: it contains {what}", excerpt(name)));
            pickled.push(name.to_owned());
            continue;
        }
        let mut unfit = check_shape(&header).map_err(within).err();
        if header.frame_count().is_some() {
            let what = format!(
                "the array `{}` has several frames, with {}: save it alone, as .npy, or each frame as a file of its own",
                excerpt(name),
                header.shown()
            );
            unfit = Some(Error::unsupported(ARCHIVE, what));
        }
        // Arrays that are not the position may have any shape. The position may be a field of records.
        let may_be_position =
            position_rank(name).is_some() || matches!(header.layout, ElementLayout::Fields { .. });
        if may_be_position && let Some(error) = unfit {
            return Err(error);
        }
        let data = header.data(&content).map_err(within)?;
        let (parts, more) = match (arrays_of(&header, data, limits).map_err(within), &unfit) {
            (Err(_), Some(_)) => {
                (Vec::new(), vec![format!("skipped `{}`: it is {}", excerpt(name), header.shown())])
            }
            (read, _) => read?,
        };
        // A skipped array does not change why the only other one can be unfit.
        if arrays.is_empty() || !parts.is_empty() {
            last_unfit = unfit;
        }
        notes.extend(more);
        arrays.extend(parts.into_iter().map(|array| {
            if array.name.is_empty() { NamedArray { name: name.into(), ..array } } else { array }
        }));
    }
    if let ([] | [_], Some(error)) = (&arrays[..], last_unfit) {
        return Err(error);
    }
    let mut frame = frame_of_archive(arrays, &mut notes)
        .map_err(|error| if pickled.is_empty() { error } else { of_pickled(&pickled) })?;
    frame.notes.append(&mut notes);
    Ok(frame)
}

/// The error of an archive without positions, in which these arrays are not numeric.
fn of_pickled(names: &[String]) -> Error {
    let is_pysph = ["particles", "solver_data"].iter().all(|name| names.iter().any(|found| found == name));
    let what = if is_pysph {
        "this is output of PySPH, with pickled Python objects: convert it with `pysph dump_vtk`, or save \
         it as HDF5 with `pysph.solver.utils.dump`"
            .to_owned()
    } else {
        format!(
            "no array has positions, and these arrays are not numeric, or pickled Python objects: {}; save the \
             positions as an array `pos` of numbers",
            excerpts(names)
        )
    };
    Error::unsupported(ARCHIVE, what)
}

/// An error in an array of an archive, with offsets within the array.
fn within_member(error: Error, name: &str) -> Error {
    match error {
        // The array is complete: the archive's checksum confirmed it.
        Error::Truncated { position, what, .. } | Error::Invalid { position, what, .. } => Error::invalid(
            ARCHIVE,
            Position::File,
            format!("the array `{}`, {position}: {what}", excerpt(name)),
        ),
        Error::TooLarge { what, .. } => {
            Error::too_large(ARCHIVE, format!("the array `{}`: {what}", excerpt(name)))
        }
        other => other,
    }
}

/// The fields of a structured array, or the array itself without a name.
fn arrays_of(header: &ArrayHeader, data: &[u8], limits: &Limits) -> Result<(Vec<NamedArray>, Vec<String>)> {
    let mut notes = Vec::new();
    match &header.layout {
        ElementLayout::Plain { number, endian } => {
            limits.check_particles(FORMAT, header.row_count())?;
            let columns = header.column_count();
            limits.check_attributes(FORMAT, columns, "columns")?;
            let values = if header.is_fortran && columns > 1 {
                let column = |part| number.decode(part, *endian);
                let parts: Vec<_> = data.chunks_exact((data.len() / columns).max(1)).map(column).collect();
                interleaved(&parts.iter().collect::<Vec<_>>()).unwrap_or_else(|| column(&[]))
            } else {
                number.decode(data, *endian)
            };
            Ok((vec![NamedArray { name: String::new(), arity: columns, values }], notes))
        }
        ElementLayout::Fields { fields, stride } => {
            limits.check_particles(FORMAT, header.element_count()?)?;
            let mut arrays = Vec::new();
            for StructField { name, offset, arity, number } in fields {
                match number {
                    Some((number, endian)) => arrays.push(NamedArray {
                        name: name.clone(),
                        arity: *arity,
                        values: number.decode_strided(data, *endian, *stride, *offset, *arity),
                    }),
                    None => notes.push(format!("skipped the field `{}`: it is not numeric", excerpt(name))),
                }
            }
            Ok((arrays, notes))
        }
        ElementLayout::Unread(what) => Err(Error::unsupported(
            FORMAT,
            format!("the array contains {what}: save numbers, such as float32"),
        )),
    }
}

/// A frame from an array without names: its first three columns are the position, unless the first is an id.
/// All others are attributes.
pub(crate) fn unnamed_frame(array: NamedArray) -> Result<ParticleFrame> {
    let NamedArray { arity, values, .. } = array;
    let skipped = match FirstColumn::of(first_numbers(&values, arity).into_iter(), arity) {
        FirstColumn::Coordinate => 0,
        FirstColumn::Id => 1,
        FirstColumn::Unclear => {
            let what = "the array has no names, and its first column has a different integer in each row: it may \
                        be an id or a position; save a structured array with names, such as id, x, y and z";
            return Err(Error::invalid(FORMAT, Position::File, what));
        }
    };
    if arity == 3 {
        let positions = number::positions(values).unwrap_or_default();
        return Ok(ParticleFrame { positions, ..ParticleFrame::default() });
    }
    let positions = number::positions(components(&values, arity, skipped..skipped + 3)).unwrap_or_default();
    let column = |index| NamedArray {
        name: if index == 0 { "id".to_owned() } else { format!("column_{}", index + 1) },
        arity: 1,
        values: components(&values, arity, index..index + 1),
    };
    let others = (0..skipped).chain(skipped + 3..arity).map(column).collect();
    let mut frame = frame_of(Some(positions), others).unwrap_or_default();
    frame.notes.push(match skipped {
        0 => format!(
            "the array has no names: the first 3 of {arity} columns are used as the position, the others are named \
             column_4 and so on"
        ),
        _ => format!(
            "the array has no names, and its first column has a different integer in each row: it is used as the \
             id, and the next 3 of {arity} columns as the position"
        ),
    });
    Ok(frame)
}

/// The first four numbers of the first rows; NaN in a column that does not exist.
fn first_numbers(values: &Values, arity: usize) -> Vec<[f64; 4]> {
    let row_count = (values.len() / arity.max(1)).min(first_column::ROWS_MAX);
    let numbers = number::wide(&number::slice(values, 0..row_count * arity));
    let first = |row: &[f64]| std::array::from_fn(|column| row.get(column).copied().unwrap_or(f64::NAN));
    numbers.chunks_exact(arity.max(1)).map(first).collect()
}

/// The frame of an archive. Skips arrays that do not have a value for each particle, with a note.
fn frame_of_archive(mut arrays: Vec<NamedArray>, notes: &mut Vec<String>) -> Result<ParticleFrame> {
    let described: Vec<_> = arrays.iter().map(ArrayShape::of).collect();
    let count = match position_count(&described).or_else(|| unnamed_position_count(&described)) {
        Some(count) => count,
        None => return frame_of_only(arrays, notes),
    };
    arrays.retain(|array| {
        let is_kept = array.particle_count() == count && array.arity != 0;
        if !is_kept {
            let found = array.particle_count();
            notes.push(format!(
                "skipped `{}`: it has {found} rows for {count} particles",
                excerpt(&array.name)
            ));
        }
        is_kept
    });
    let no_position = no_position_among(&arrays);
    frame_of(None, arrays).ok_or(no_position)
}

/// The frame of an archive with a single array: the array is used as the position, whatever its name.
fn frame_of_only(mut arrays: Vec<NamedArray>, notes: &mut Vec<String>) -> Result<ParticleFrame> {
    let array = match arrays.pop() {
        Some(array) if arrays.is_empty() && array.arity >= 3 => array,
        last => {
            arrays.extend(last);
            return Err(no_position_among(&arrays));
        }
    };
    notes.push(format!("`{}` is the only array: it is used as the position", excerpt(&array.name)));
    unnamed_frame(array)
}

fn no_position(header: &ArrayHeader) -> Error {
    let names: Vec<&str> = match &header.layout {
        ElementLayout::Fields { fields, .. } => {
            fields.iter().take(12).map(|field| field.name.as_str()).collect()
        }
        _ => Vec::new(),
    };
    let what = if names.is_empty() {
        format!(
            "expected positions as an array of shape (N, 3) or with more columns, found {}",
            header.shown()
        )
    } else {
        format!(
            "expected a field `pos` with three numbers, or fields x, y and z; found: {}",
            names.join(", ")
        )
    };
    Error::invalid(FORMAT, Position::File, what)
}

fn no_position_among(arrays: &[NamedArray]) -> Error {
    let shown = |array: &NamedArray| format!("{} ({}, {})", array.name, array.particle_count(), array.arity);
    let found: Vec<String> = arrays.iter().take(12).map(shown).collect();
    let what = format!(
        "expected an array `pos` of shape (N, 3), or x, y and z of shape (N); found: {}",
        if found.is_empty() { "no numeric array".into() } else { found.join(", ") }
    );
    Error::invalid(ARCHIVE, Position::File, what)
}

/// The row of single arrays in the table of formats.
pub(crate) static ROW: FormatRow = FormatRow {
    signatures: &[b"\x93NUMPY"],
    beginnings: &[b"\x93NUMPY"],
    particles: Some(ParticleReader {
        completeness: |head, file_bytes| {
            let declared = header::bytes_declared(head, &Limits::default())?;
            let known = declared
                .map_or(Completeness::Unknown, |declared| Completeness::of_exact_size(declared, file_bytes));
            Ok(HeadCheck::Known(known))
        },
        find_steps: Some(steps_of_array),
        ..ParticleReader::new(read)
    }),
    ..FormatRow::new(FORMAT, &["npy"])
};

/// The row of archives in the table of formats.
pub(crate) static ARCHIVE_ROW: FormatRow = FormatRow {
    beginnings: &[b"PK\x03\x04"],
    particles: Some(ParticleReader::needs_reading(read_archive)),
    ..FormatRow::new(ARCHIVE, &["npz"])
};

// The members of a `.npz` file, a ZIP archive with stored or deflated members.
//
//   local header, name, bytes   ×  members
//   central directory: sizes, checksum and offset of each member
//   (ZIP64: the following record, with 64-bit values)
//   end of the central directory: the directory's offset
//
// The reader finds members by the central directory only. Members of a hostile archive can overlap, so the
// size of the archive limits the total size of all members, compressed and decompressed.

const END: &[u8; 4] = b"PK\x05\x06";
const END_BYTES: usize = 22;
const END_64_LOCATOR: &[u8; 4] = b"PK\x06\x07";
const END_64_LOCATOR_BYTES: usize = 20;
const END_64: &[u8; 4] = b"PK\x06\x06";
const ENTRY: &[u8; 4] = b"PK\x01\x02";
const ENTRY_BYTES: u64 = 46;
const LOCAL: &[u8; 4] = b"PK\x03\x04";
/// The longest comment after the end of the central directory.
const COMMENT_BYTES_MAX: usize = u16::MAX as usize;

pub(crate) const STORED: u16 = 0;
const DEFLATED: u16 = 8;

/// A file in the archive.
pub(crate) struct ArchiveMember {
    pub(crate) name: String,
    pub(crate) method: u16,
    pub(crate) checksum: u32,
    packed_bytes: u64,
    pub(crate) bytes: u64,
    pub(crate) local_offset: u64,
}

/// Total sizes of the members read so far.
#[derive(Default)]
struct ArchiveTotals {
    packed_bytes: u64,
    bytes: u64,
}

/// The members, as listed by the central directory.
fn members(bytes: &[u8], limits: &Limits) -> Result<Vec<ArchiveMember>> {
    let (count, offset) = directory(bytes, 0)?;
    limits.check_attributes(ARCHIVE, usize::try_from(count).unwrap_or(usize::MAX), "arrays")?;
    entries(&bytes[usize::try_from(offset).unwrap_or(usize::MAX).min(bytes.len())..], count)
}

/// The entries of a central directory.
pub(crate) fn entries(directory: &[u8], count: u64) -> Result<Vec<ArchiveMember>> {
    let mut cursor = Cursor::new(ARCHIVE, Endian::Little, directory, 0);
    if (cursor.remaining() as u64) < count.saturating_mul(ENTRY_BYTES) {
        return Err(cursor.invalid(format!("expected {count} entries in the central directory")));
    }
    (0..count).map(|_| member(&mut cursor)).collect::<Result<_>>().map_err(as_invalid)
}

/// The number of members, and the offset of the central directory. `bytes` are the end of the archive, from
/// the offset `base` on.
pub(crate) fn directory(bytes: &[u8], base: u64) -> Result<(u64, u64)> {
    let at = end_of_directory(bytes)?;
    let mut end = Cursor::new(ARCHIVE, Endian::Little, bytes, at + 10);
    let count = u64::from(end.u16("the number of members")?);
    end.take(4, "the size of the central directory")?;
    let offset = u64::from(end.u32("the offset of the central directory")?);
    let locator = at.checked_sub(END_64_LOCATOR_BYTES).filter(|&at| bytes[at..].starts_with(END_64_LOCATOR));
    let Some(locator) = locator else { return Ok((count, offset)) };
    let mut locator = Cursor::new(ARCHIVE, Endian::Little, bytes, locator + 8);
    let at = locator.u64("the offset of the end")?.saturating_sub(base);
    let at = usize::try_from(at).unwrap_or(usize::MAX).min(bytes.len());
    let mut end = Cursor::new(ARCHIVE, Endian::Little, bytes, at);
    if end.take(4, "the end of the central directory").map_err(as_invalid)? != END_64 {
        return Err(end.invalid("expected the end of the central directory"));
    }
    end.take(28, "the end of the central directory").map_err(as_invalid)?;
    let count = end.u64("the number of members").map_err(as_invalid)?;
    end.take(8, "the size of the central directory").map_err(as_invalid)?;
    Ok((count, end.u64("the offset of the central directory").map_err(as_invalid)?))
}

/// The offset of the end record of the central directory. Only a comment can follow that record.
fn end_of_directory(bytes: &[u8]) -> Result<usize> {
    let tail_start = bytes.len().saturating_sub(END_BYTES + COMMENT_BYTES_MAX);
    let end_of = |at: usize| {
        let comment = bytes.get(at + 20..at + END_BYTES)?;
        Some(at + END_BYTES + usize::from(u16::from_le_bytes([comment[0], comment[1]])))
    };
    // The comment may contain the signature, too. The right record is the one whose comment ends with the
    // file.
    let candidates = (tail_start..bytes.len()).rev().filter(|&at| bytes[at..].starts_with(END));
    let exact = candidates.clone().find(|&at| end_of(at) == Some(bytes.len()));
    let found =
        exact.or_else(|| candidates.clone().find(|&at| end_of(at).is_some_and(|end| end <= bytes.len())));
    found.ok_or_else(|| {
        let what = "the archive ends before its central directory does";
        Error::truncated(ARCHIVE, Position::Offset(bytes.len() as u64), what)
    })
}

/// Turns `Truncated` into `Invalid`: the archive's end is present, so nothing more will be appended.
fn as_invalid(error: Error) -> Error {
    match error {
        Error::Truncated { format, position, what } => Error::Invalid { format, position, what },
        other => other,
    }
}

fn member(cursor: &mut Cursor) -> Result<ArchiveMember> {
    if cursor.take(4, "an entry of the central directory")? != ENTRY {
        return Err(cursor.invalid("expected an entry of the central directory"));
    }
    cursor.take(4, "the versions")?;
    let flags = cursor.u16("the flags")?;
    let method = cursor.u16("the method")?;
    cursor.take(4, "the time")?;
    let checksum = cursor.u32("the checksum")?;
    let packed_bytes = cursor.u32("the compressed size")?;
    let bytes = cursor.u32("the size")?;
    let [name, extra, comment] = [
        cursor.u16("the length of the name")?,
        cursor.u16("the length of the extra field")?,
        cursor.u16("the length of the comment")?,
    ];
    cursor.take(8, "the attributes")?;
    let local_offset = cursor.u32("the offset")?;
    let name = String::from_utf8_lossy(cursor.take(name.into(), "the name")?).into_owned();
    let extra = cursor.take(extra.into(), "the extra field")?;
    cursor.take(comment.into(), "the comment")?;
    if flags & 1 != 0 {
        return Err(Error::unsupported(ARCHIVE, format!("`{}` is encrypted", excerpt(&name))));
    }
    let [bytes, packed_bytes, local_offset] = widened_sizes([bytes, packed_bytes, local_offset], extra);
    Ok(ArchiveMember { name, method, checksum, packed_bytes, bytes, local_offset })
}

/// Replaces numbers that do not fit into 32 bits: the entry has `u32::MAX` instead, and the ZIP64 field of
/// `extra` has the 64-bit values, in the order of `numbers`.
fn widened_sizes(numbers: [u32; 3], mut extra: &[u8]) -> [u64; 3] {
    let mut wide: &[u8] = &[];
    while let [a, b, c, d, rest @ ..] = extra {
        let length = usize::from(u16::from_le_bytes([*c, *d])).min(rest.len());
        let (field, next) = rest.split_at(length);
        if u16::from_le_bytes([*a, *b]) == 1 {
            wide = field;
        }
        extra = next;
    }
    numbers.map(|number| match (number, wide.split_first_chunk::<8>()) {
        (u32::MAX, Some((number, rest))) => {
            wide = rest;
            u64::from_le_bytes(*number)
        }
        _ => number.into(),
    })
}

impl ArchiveMember {
    /// The member's content, decompressed and verified. Adds its sizes to `totals`, and checks them.
    fn content<'a>(
        &self,
        archive: &'a [u8],
        limits: &Limits,
        totals: &mut ArchiveTotals,
    ) -> Result<Cow<'a, [u8]>> {
        let packed = self.packed(archive).map_err(as_invalid)?;
        totals.packed_bytes = totals.packed_bytes.saturating_add(self.packed_bytes);
        totals.bytes = totals.bytes.saturating_add(self.bytes);
        if totals.packed_bytes > archive.len() as u64 {
            return Err(Error::invalid(
                ARCHIVE,
                Position::File,
                "the members have more bytes in total than the archive",
            ));
        }
        limits.check_decompressed(ARCHIVE, totals.bytes, totals.packed_bytes)?;
        let content = match self.method {
            STORED => Cow::Borrowed(packed),
            DEFLATED => Cow::Owned(self.inflated(packed)?),
            other => {
                let what = format!(
                    "`{}` uses compression method {other}, which is not supported: save it stored or deflated",
                    excerpt(&self.name)
                );
                return Err(Error::unsupported(ARCHIVE, what));
            }
        };
        let mut checksum = flate2::Crc::new();
        checksum.update(&content);
        if content.len() as u64 != self.bytes || checksum.sum() != self.checksum {
            return Err(self.damaged());
        }
        Ok(content)
    }

    fn packed<'a>(&self, archive: &'a [u8]) -> Result<&'a [u8]> {
        let offset = usize::try_from(self.local_offset).unwrap_or(usize::MAX);
        let mut cursor = Cursor::new(ARCHIVE, Endian::Little, archive, offset);
        if cursor.take(4, "the header of a member")? != LOCAL {
            return Err(cursor.invalid(format!("expected the header of `{}`", excerpt(&self.name))));
        }
        cursor.take(22, "the header of a member")?;
        let name = cursor.u16("the length of the name")?;
        let extra = cursor.u16("the length of the extra field")?;
        cursor.take(usize::from(name) + usize::from(extra), "the name of a member")?;
        cursor.take(usize::try_from(self.packed_bytes).unwrap_or(usize::MAX), "a member")
    }

    fn inflated(&self, packed: &[u8]) -> Result<Vec<u8>> {
        let mut content = Vec::new();
        let mut decoder = flate2::bufread::DeflateDecoder::new(packed).take(self.bytes.saturating_add(1));
        decoder.read_to_end(&mut content).map_err(|_| self.damaged())?;
        Ok(content)
    }

    fn damaged(&self) -> Error {
        let what = format!("the member `{}` is damaged", excerpt(&self.name));
        Error::invalid(ARCHIVE, Position::Offset(self.local_offset), what)
    }
}
