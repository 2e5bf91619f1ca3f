//! Joins the pieces of a data set into one frame.

use crate::data::{FilePositions, ParticleFrame, Values};
use crate::error::{Error, Position, Result};
use crate::excerpt::excerpt;
use crate::limits::Limits;
use crate::named_arrays::{NamedArray, frame_of};
use crate::number::{self, append};

/// The note for files that also contain a mesh.
pub const POLYGONS_NOTE: &str = "the file also has polygons, which are ignored: only its points are read";

/// The points of a piece, and the arrays that have a value for each.
#[derive(Debug, Default)]
pub(super) struct VtkPiece {
    pub(super) positions: FilePositions,
    pub(super) arrays: Vec<NamedArray>,
}

/// Converts the number of points to a length, within the limits.
pub(super) fn checked_count(format: &'static str, count: u64, limits: &Limits) -> Result<usize> {
    if count > limits.particle_count {
        let what = format!("the file has {count} points, more than the limit of {}", limits.particle_count);
        return Err(Error::too_large(format, what));
    }
    usize::try_from(count)
        .map_err(|_| Error::too_large(format, format!("the file has {count} points, too many")))
}

/// Converts values to positions.
pub(super) fn positions_of(format: &'static str, values: Values) -> Result<FilePositions> {
    let no_numbers =
        || Error::invalid(format, Position::File, "the coordinates of the points are not numbers");
    number::positions(values).ok_or_else(no_numbers)
}

/// Joins all points. Skips arrays that are missing in a piece or differ in type, with a note.
pub(super) fn joined(pieces: Vec<VtkPiece>, mut notes: Vec<String>) -> ParticleFrame {
    let mut pieces = pieces.into_iter().filter(|piece| !piece.positions.is_empty());
    let mut all = pieces.next().unwrap_or_default();
    for piece in pieces {
        append_positions(&mut all.positions, piece.positions);
        let mut more = piece.arrays;
        all.arrays.retain_mut(|array| {
            let same = |other: &NamedArray| other.name == array.name && other.arity == array.arity;
            let found = more.iter().position(same).map(|index| more.swap_remove(index));
            let is_kept = found.is_some_and(|found| append(&mut array.values, found.values));
            if !is_kept {
                notes.push(format!(
                    "skipped the array `{}`: it is not the same in all pieces",
                    excerpt(&array.name)
                ));
            }
            is_kept
        });
    }
    // `frame_of` always returns a frame if it gets positions.
    let mut frame = frame_of(Some(all.positions), all.arrays).unwrap_or_default();
    frame.notes.append(&mut notes);
    frame
}

fn append_positions(positions: &mut FilePositions, more: FilePositions) {
    match (&mut *positions, more) {
        (FilePositions::F32(positions), FilePositions::F32(more)) => positions.extend(more),
        (FilePositions::F64(positions), FilePositions::F64(more)) => positions.extend(more),
        (FilePositions::F64(positions), FilePositions::F32(more)) => {
            positions.extend(more.into_iter().map(wide))
        }
        (FilePositions::F32(narrow), FilePositions::F64(more)) => {
            let first = std::mem::take(narrow).into_iter().map(wide);
            *positions = FilePositions::F64(first.chain(more).collect());
        }
    }
}

fn wide(position: [f32; 3]) -> [f64; 3] {
    position.map(f64::from)
}
