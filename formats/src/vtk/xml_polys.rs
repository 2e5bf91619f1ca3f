//! Reads the polygons of a `.vtp`, and the flat cells of a `.vtu`, as a mesh.

use crate::data::{FilePositions, MeshData};
use crate::error::{Error, Position, Result};
use crate::limits::Limits;

use super::XML;
use super::cells::{self, POLYGON, Points, TRIANGLE_STRIP, add_cells};
use super::pieces::checked_count;
use super::xml::{CellArrays, Decoder, malformed, open, points_of};

/// Whether the first piece of a VTK XML file has polygons, by the beginning of the file.
pub fn holds_polys(bytes: &[u8]) -> bool {
    const PIECE_BYTES: usize = 1 << 20; // the description of the first piece is in here
    let head = String::from_utf8_lossy(&bytes[..bytes.len().min(PIECE_BYTES)]);
    let count = head
        .split("NumberOfPolys=")
        .nth(1)
        .and_then(|rest| rest.get(1..)?.split(['"', '\'']).next()?.parse().ok());
    count.is_some_and(|count: u64| count > 0)
}

/// Reads the points and the polygons of all pieces, without normals. Polygons with more than three corners
/// become triangle fans. A file without polygons gives a mesh without triangles.
///
/// # Errors
///
/// Those of [`super::read_xml`]; [`Error::Invalid`] for polygons with missing points, [`Error::Unsupported`]
/// for volumetric cells.
pub fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    let (mut decoder, pieces, _) = open(bytes, limits)?;
    let mut mesh = MeshData::default();
    for piece in &pieces {
        let points = Points { first: mesh.positions.len() as u64, count: piece.point_count as u64 };
        if piece.point_count > 0 {
            match points_of(piece, &mut decoder)? {
                FilePositions::F32(positions) => {
                    mesh.positions.extend(positions.iter().map(|position| position.map(f64::from)));
                }
                FilePositions::F64(positions) => mesh.positions.extend(positions),
            }
        }
        checked_count(XML, mesh.positions.len() as u64, limits)?;
        for (cells, kind) in
            [(&piece.polys, Some(POLYGON)), (&piece.strips, Some(TRIANGLE_STRIP)), (&piece.cells, None)]
        {
            if cells.count > 0 {
                add(cells, kind, points, &mut decoder, &mut mesh.triangles)?;
            }
        }
    }
    Ok(mesh)
}

/// Adds cells. All of them have the type `kind`; if it is `None`, the array `types` has the type of each.
fn add(
    cells: &CellArrays,
    kind: Option<i64>,
    points: Points,
    decoder: &mut Decoder,
    triangles: &mut Vec<[u32; 3]>,
) -> Result<()> {
    let ends = integers_of(cells, "offsets", cells.count, decoder)?;
    let corner_count = ends.last().copied().unwrap_or_default();
    let count = usize::try_from(corner_count).map_err(|_| {
        Error::invalid(XML, Position::File, format!("the cells have {corner_count} corners, too many"))
    })?;
    let corners = integers_of(cells, "connectivity", count, decoder)?;
    let types = match kind {
        Some(_) => Vec::new(),
        None => integers_of(cells, "types", cells.count, decoder)?,
    };
    let type_of = |index: usize| kind.unwrap_or_else(|| types.get(index).copied().unwrap_or(0));
    add_cells(XML, (&ends, &corners), type_of, points, triangles)
}

/// The `count` numbers of an array that describes cells.
pub(super) fn integers_of(
    cells: &CellArrays,
    name: &str,
    count: usize,
    decoder: &mut Decoder,
) -> Result<Vec<i64>> {
    let found = cells.arrays.iter().find(|array| array.name.eq_ignore_ascii_case(name) && array.arity == 1);
    let array = found
        .ok_or_else(|| Error::invalid(XML, Position::File, format!("the cells have no `{name}` array")))?;
    let no_integers = || malformed(array.offset, &format!("the values of `{name}` are not integers"));
    let values = decoder.values(array, array.number.ok_or_else(no_integers)?, count)?;
    cells::integers(values).ok_or_else(no_integers)
}
