//! Converts VTK cells to triangles.
//!
//! ```text
//!   connectivity   0 1 2   2 1 3 4   ..      the corners of all cells
//!   offsets            3         7   ..      the end of each cell
//!   types          5       9         ..      the type of each cell; Polys and Strips have one type for all
//! ```

use crate::data::Values;
use crate::error::{Error, Position, Result};

/// VTK's number for the cell type of filled polygons.
pub(super) const POLYGON: i64 = 7;

/// VTK's number for the cell type of triangle strips.
pub(super) const TRIANGLE_STRIP: i64 = 6;

/// Whether cells of this type are faces, or have faces: not points, lines or empty cells.
pub(super) fn is_face(kind: i64) -> bool {
    !matches!(kind, 0..=4 | 21)
}

/// Converts integers of any width; `None` if the values are not integers.
pub(super) fn integers(values: Values) -> Option<Vec<i64>> {
    match values {
        Values::U8(values) => Some(values.into_iter().map(i64::from).collect()),
        Values::I32(values) => Some(values.into_iter().map(i64::from).collect()),
        Values::I64(values) => Some(values),
        Values::F32(_) | Values::F64(_) | Values::Strings { .. } => None,
    }
}

/// The points that cells refer to: `count` points, the first of which is vertex `first` of the mesh.
#[derive(Clone, Copy)]
pub(super) struct Points {
    pub(super) first: u64,
    pub(super) count: u64,
}

/// Adds the triangles of cells. `ends` has the end of each cell in `corners`. Polygons with more than three
/// corners become triangle fans; points and lines are skipped.
///
/// # Errors
/// [`Error::Invalid`] for cells with missing points, [`Error::Unsupported`] for volumetric cells.
pub(super) fn add_cells(
    format: &'static str,
    (ends, corners): (&[i64], &[i64]),
    type_of: impl Fn(usize) -> i64,
    points: Points,
    triangles: &mut Vec<[u32; 3]>,
) -> Result<()> {
    let invalid = |what: String| Error::invalid(format, Position::File, what);
    let vertex = |corner: i64| {
        let corner = u64::try_from(corner).ok().filter(|&corner| corner < points.count);
        corner.and_then(|corner| u32::try_from(points.first + corner).ok())
    };
    let mut start = 0;
    for (index, &end) in ends.iter().enumerate() {
        let cell = usize::try_from(end).ok().and_then(|end| Some((corners.get(start..end)?, end)));
        let (cell, end) = cell.ok_or_else(|| {
            invalid(format!("a cell ends at corner {end}, but there are only {} corners", corners.len()))
        })?;
        start = end;
        let mut add = |triangle: [i64; 3]| {
            let [Some(a), Some(b), Some(c)] = triangle.map(vertex) else {
                return Err(invalid(format!("a cell refers to a point beyond the {} points", points.count)));
            };
            triangles.push([a, b, c]);
            Ok(())
        };
        match (type_of(index), cell) {
            (kind, _) if !is_face(kind) => {}
            (5 | POLYGON | 9, &[first, ref rest @ ..]) => {
                rest.windows(2).try_for_each(|pair| add([first, pair[0], pair[1]]))?;
            }
            (TRIANGLE_STRIP, strip) => {
                for (index, three) in strip.windows(3).enumerate() {
                    let [a, b] = if index % 2 == 0 { [three[0], three[1]] } else { [three[1], three[0]] };
                    add([a, b, three[2]])?;
                }
            }
            // The corners of a pixel (VTK's axis-aligned rectangle) are stored row by row.
            (8, &[a, b, c, d]) => [[a, b, d], [a, d, c]].into_iter().try_for_each(add)?,
            (5 | POLYGON | 8 | 9, _) => {
                return Err(invalid(format!("a cell of type {} has {} corners", type_of(index), cell.len())));
            }
            (other, _) => {
                let what = format!(
                    "the file has a cell of type {other}, which is not a flat polygon: save only the surface"
                );
                return Err(Error::unsupported(format, what));
            }
        }
    }
    Ok(())
}
