//! The polygons of a `.vtp`: a mesh.
//!
//! ```text
//!   connectivity   0 1 2   2 1 3 4   ..      the corners of all polygons
//!   offsets            3         7   ..      where each ends
//! ```

use crate::data::{MeshData, Positions, Values};
use crate::error::{Error, Place, Result};
use crate::limits::Limits;

use super::XML;
use super::pieces::checked_count;
use super::xml::{Decoder, Described, malformed, open, points_of};

/// Reads the points and the polygons of all pieces, without normals; a polygon of more than three corners becomes a
/// fan. A file without polygons is a mesh without triangles.
///
/// # Errors
///
/// As [`super::read_xml`]; [`Error::Invalid`] for polygons of points that are not there.
pub fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    let (mut decoder, pieces, _) = open(bytes, limits)?;
    let mut mesh = MeshData::default();
    for piece in &pieces {
        let first = mesh.positions.len() as u64;
        if piece.point_count > 0 {
            match points_of(piece, &mut decoder)? {
                Positions::F32(positions) => {
                    mesh.positions.extend(positions.iter().map(|position| position.map(f64::from)));
                }
                Positions::F64(positions) => mesh.positions.extend(positions),
            }
        }
        checked_count(XML, mesh.positions.len() as u64, limits)?;
        if piece.poly_count > 0 {
            add_polys(piece, first, &mut decoder, &mut mesh)?;
        }
    }
    Ok(mesh)
}

fn add_polys(piece: &Described, first: u64, decoder: &mut Decoder, mesh: &mut MeshData) -> Result<()> {
    let ends = integers(piece, "offsets", piece.poly_count, decoder)?;
    let corner_count = ends.last().copied().unwrap_or_default();
    let invalid = |what: String| Error::invalid(XML, Place::File, what);
    let count =
        usize::try_from(corner_count).map_err(|_| invalid(format!("{corner_count} corners of polygons")))?;
    let corners = integers(piece, "connectivity", count, decoder)?;
    let vertex = |corner: i64| {
        let corner = u64::try_from(corner).ok().filter(|&corner| corner < piece.point_count as u64);
        corner.and_then(|corner| u32::try_from(first + corner).ok())
    };
    let mut start = 0;
    for end in ends {
        let polygon = usize::try_from(end).ok().and_then(|end| Some((corners.get(start..end)?, end)));
        let (polygon, end) =
            polygon.ok_or_else(|| invalid(format!("a polygon that ends at corner {end} of {count}")))?;
        for pair in polygon.windows(2).skip(1) {
            let [Some(a), Some(b), Some(c)] = [polygon[0], pair[0], pair[1]].map(vertex) else {
                return Err(invalid(format!(
                    "a polygon of points that are not among the {}",
                    piece.point_count
                )));
            };
            mesh.triangles.push([a, b, c]);
        }
        start = end;
    }
    Ok(())
}

/// The `count` numbers of an array of the polygons.
fn integers(piece: &Described, name: &str, count: usize, decoder: &mut Decoder) -> Result<Vec<i64>> {
    let found = piece.polys.iter().find(|array| array.name.eq_ignore_ascii_case(name) && array.arity == 1);
    let array =
        found.ok_or_else(|| Error::invalid(XML, Place::File, format!("polygons without their `{name}`")))?;
    let no_integers = || malformed(array.offset, &format!("`{name}` are no integers"));
    match decoder.values(array, array.number.ok_or_else(no_integers)?, count)? {
        Values::I32(values) => Ok(values.into_iter().map(i64::from).collect()),
        Values::I64(values) => Ok(values),
        _ => Err(no_integers()),
    }
}
