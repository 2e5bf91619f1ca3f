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

use std::sync::Arc;

use crate::core::columns::position_rank;
use crate::core::data::{FileAttribute, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::first_column::{self, FirstColumn};
use crate::core::limits::Limits;
use crate::core::named_arrays::{ArrayShape, frame_of, position_count, unnamed_position_count};
use crate::core::number::{self, NumberType, components, interleaved};
use crate::core::row::{Completeness, FormatRow, HeadCheck, ParticleReader};
use crate::core::steps::{FoundStep, StepSource};
use crate::core::text::{excerpt, excerpts, surplus_note};
use crate::core::zip::{ARCHIVE, ArchiveMember, ArchiveTotals, directory, entries};
use header::{ArrayHeader, COLUMNS_MAX, ElementLayout, StructField};

/// The format's name in errors.
const FORMAT: &str = "NumPy array";

/// Reads the particles of a `.npy` file.
///
/// # Errors
///
/// [`Error::Invalid`] for a malformed header or an array that is not a list of positions,
/// [`Error::Truncated`] if data is missing, [`Error::Unsupported`] for non-numeric types and for several
/// frames, which [`crate::table::steps::find_steps`] locates; [`Error::TooLarge`] beyond `limits`.
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
        let is_list = |array: &FileAttribute| array.arity >= 3 && header.shape.len() >= 2;
        let array = arrays.into_iter().find(is_list);
        unnamed_frame(array.ok_or_else(|| no_position(&header))?)?
    };
    frame.notes.append(&mut notes);
    frame.notes.extend(surplus_note(bytes.len() as u64, (header.data_offset + data.len()) as u64));
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
    let (mut pickled, mut last_unfit, mut several) = (Vec::new(), None, None);
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
        let unfit = check_shape(&header).map_err(within).err();
        let may_be_position =
            position_rank(name).is_some() || matches!(header.layout, ElementLayout::Fields { .. });
        let skipped = || format!("skipped `{}`: it has {}", excerpt(name), header.shown());
        if header.frame_count().is_some() {
            let what = format!(
                "the array `{}` has several frames, with {}: save it alone, as .npy, or each frame as a file of its own",
                excerpt(name),
                header.shown()
            );
            let error = Error::unsupported(ARCHIVE, what);
            if may_be_position {
                return Err(error);
            }
            several.get_or_insert(error);
            notes.push(skipped());
            continue;
        }
        // Arrays that are not the position may have any shape. The position may be a field of records.
        if may_be_position && let Some(error) = unfit {
            return Err(error);
        }
        let data = header.data(&content).map_err(within)?;
        let (parts, more) = match (arrays_of(&header, data, limits).map_err(within), &unfit) {
            (Err(_), Some(_)) => (Vec::new(), vec![skipped()]),
            (read, _) => read?,
        };
        // A skipped array does not change why the only other one can be unfit.
        if arrays.is_empty() || !parts.is_empty() {
            last_unfit = unfit;
        }
        notes.extend(more);
        arrays.extend(parts.into_iter().map(|array| {
            if array.name.is_empty() { FileAttribute { name: name.into(), ..array } } else { array }
        }));
    }
    if let ([] | [_], Some(error)) = (&arrays[..], last_unfit) {
        return Err(error);
    }
    let mut frame = frame_of_archive(arrays, &mut notes).map_err(|error| match several {
        Some(several) => several,
        None if pickled.is_empty() => error,
        None => of_pickled(&pickled),
    })?;
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
fn arrays_of(
    header: &ArrayHeader,
    data: &[u8],
    limits: &Limits,
) -> Result<(Vec<FileAttribute>, Vec<String>)> {
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
            Ok((vec![FileAttribute::new(String::new(), columns, values)], notes))
        }
        ElementLayout::Fields { fields, stride } => {
            limits.check_particles(FORMAT, header.element_count()?)?;
            let mut arrays = Vec::new();
            for StructField { name, offset, arity, number } in fields {
                match number {
                    Some((number, endian)) => {
                        let values = number.decode_strided(data, *endian, *stride, *offset, *arity);
                        arrays.push(FileAttribute::new(name, *arity, values));
                    }
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
pub(crate) fn unnamed_frame(array: FileAttribute) -> Result<ParticleFrame> {
    let FileAttribute { arity, values, .. } = array;
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
    let column = |index| {
        let name = if index == 0 { "id".to_owned() } else { format!("column_{}", index + 1) };
        FileAttribute::new(name, 1, components(&values, arity, index..index + 1))
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
fn frame_of_archive(mut arrays: Vec<FileAttribute>, notes: &mut Vec<String>) -> Result<ParticleFrame> {
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
fn frame_of_only(mut arrays: Vec<FileAttribute>, notes: &mut Vec<String>) -> Result<ParticleFrame> {
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

fn no_position_among(arrays: &[FileAttribute]) -> Error {
    let shown =
        |array: &FileAttribute| format!("{} ({}, {})", array.name, array.particle_count(), array.arity);
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

/// The members, as listed by the central directory.
fn members(bytes: &[u8], limits: &Limits) -> Result<Vec<ArchiveMember>> {
    let (count, offset) = directory(bytes, 0)?;
    limits.check_attributes(ARCHIVE, usize::try_from(count).unwrap_or(usize::MAX), "arrays")?;
    entries(&bytes[usize::try_from(offset).unwrap_or(usize::MAX).min(bytes.len())..], count)
}
