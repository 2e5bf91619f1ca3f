//! Writes a mesh as VTK's XML PolyData, `.vtp`, for ParaView.
//!
//! ```text
//!   <PointData> Normals, and all vertex attributes under their own names
//!   <Points>
//!   <Polys>     connectivity and offsets: triangles, and quads if the mesh has them
//! ```
//!
//! Floats have 32 bits; integers have 32 bits if all fit, else 64. Positions are 64-bit floats if the mesh
//! has an origin other than zero. Axes are not converted, because VTK has no notion of up. See
//! [`super::appended`] for the document around the data.

use std::io::Write;

use crate::data::{MeshView, Provenance, VertexAttribute, VertexValues};
use crate::error::Result;
use crate::le_bytes::{write_f32s, write_pieces};
use crate::mesh_options::MeshOptions;
use crate::quads::{Face, check_quads, faces, quad_count};
use crate::vertex_attributes::string_index;

use super::XML;
use super::appended::{
    Array, ArrayData, CellKind, FLOAT_32, FLOAT_64, INT_32, INT_64, NumberKind, VtpDocument, names_of,
};

/// Writes positions, normals, attributes and faces.
///
/// # Errors
///
/// [`crate::Error::Io`] if `out` fails; [`crate::Error::Invalid`] if the mesh is inconsistent or not finite,
/// or if two triangles marked as a quad do not form one.
pub fn write_mesh(
    mesh: &MeshView,
    options: &MeshOptions,
    provenance: &Provenance,
    out: &mut impl Write,
) -> Result<()> {
    mesh.check(XML)?;
    check_quads(XML, mesh.triangles, &options.quads)?;
    document(mesh, &options.quads).write(provenance, out)
}

/// Notes on vertex attributes that are renamed in a .vtp file.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let renamed =
        attributes.iter().zip(names_in_file(attributes)).filter(|(attribute, name)| attribute.name != *name);
    renamed.map(|(attribute, name)| format!("{} is named {name} in the .vtp", attribute.name)).collect()
}

fn names_in_file(attributes: &[VertexAttribute]) -> Vec<String> {
    names_of(attributes.iter().map(|attribute| attribute.name), &[NORMALS])
}

const NORMALS: &str = "Normals";

fn document<'a>(mesh: &MeshView<'a>, quads: &'a [bool]) -> VtpDocument<MeshArray<'a>> {
    let MeshView { positions, normals, triangles, origin, attributes } = *mesh;
    let mut of_points = vec![Array::new(NORMALS, 3, MeshArray::Floats(normals.as_flattened()))];
    for (attribute, name) in attributes.iter().zip(names_in_file(attributes)) {
        of_points.push(Array::new(name, attribute.arity, values_of(attribute)));
    }
    // A quad has six corners as two triangles, and four as one face.
    let quad_count = quad_count(quads);
    let (face_count, corner_count) = (triangles.len() - quad_count, 3 * triangles.len() - 2 * quad_count);
    // Both index arrays have either 32 or 64 bits, because VTK does not support a mixture.
    let is_wide = i32::try_from(corner_count.max(positions.len())).is_err();
    let of_faces = |what, count| MeshArray::Faces { what, count, triangles, quads, is_wide };
    VtpDocument {
        normals: Some(NORMALS),
        of_points,
        point_count: positions.len(),
        points: match origin {
            [0.0, 0.0, 0.0] => MeshArray::Floats(positions.as_flattened()),
            origin => MeshArray::FarPositions { positions, origin },
        },
        cells: CellKind::Polys,
        cell_count: face_count,
        connectivity: of_faces(OfFaces::Corners, corner_count),
        offsets: of_faces(OfFaces::Ends, face_count),
    }
}

/// The source of an array's values. The variant determines the stored type.
enum MeshArray<'a> {
    FarPositions {
        positions: &'a [[f32; 3]],
        origin: [f64; 3],
    },
    Floats(&'a [f32]),
    Ints(&'a [i64]),
    Longs(&'a [i64]),
    Strings(&'a [String], &'a [i32]),
    Faces {
        what: OfFaces,
        /// Number of values.
        count: usize,
        triangles: &'a [[u32; 3]],
        quads: &'a [bool],
        is_wide: bool,
    },
}

/// The arrays that describe faces.
#[derive(Clone, Copy)]
enum OfFaces {
    Corners,
    /// The end of each face in the list of corners.
    Ends,
}

fn values_of<'a>(attribute: &VertexAttribute<'a>) -> MeshArray<'a> {
    match attribute.values {
        VertexValues::Numbers(values) => MeshArray::Floats(values),
        VertexValues::Integers(values) if values.iter().all(|&value| i32::try_from(value).is_ok()) => {
            MeshArray::Ints(values)
        }
        VertexValues::Integers(values) => MeshArray::Longs(values),
        VertexValues::Strings { table, indices } => MeshArray::Strings(table, indices),
    }
}

impl ArrayData for MeshArray<'_> {
    fn kind(&self) -> NumberKind {
        match self {
            MeshArray::Floats(_) => FLOAT_32,
            MeshArray::FarPositions { .. } => FLOAT_64,
            MeshArray::Ints(_) | MeshArray::Strings(..) | MeshArray::Faces { is_wide: false, .. } => INT_32,
            MeshArray::Longs(_) | MeshArray::Faces { is_wide: true, .. } => INT_64,
        }
    }

    fn count(&self) -> u64 {
        let count = match self {
            MeshArray::FarPositions { positions, .. } => positions.as_flattened().len(),
            MeshArray::Floats(values) => values.len(),
            MeshArray::Ints(values) | MeshArray::Longs(values) => values.len(),
            MeshArray::Strings(_, indices) => indices.len(),
            MeshArray::Faces { count, .. } => *count,
        };
        count as u64
    }

    fn table(&self) -> Option<&[String]> {
        match self {
            MeshArray::Strings(table, _) => Some(table),
            _ => None,
        }
    }

    fn write(&self, out: &mut impl Write) -> Result<()> {
        match *self {
            MeshArray::FarPositions { positions, origin } => positions.chunks(PIECE).try_for_each(|piece| {
                let world = |p: &[f32; 3]| -> [f64; 3] {
                    std::array::from_fn(|axis| origin[axis] + f64::from(p[axis]))
                };
                let piece: Vec<[f64; 3]> = piece.iter().map(world).collect();
                write_pieces(piece.as_flattened(), f64::to_le_bytes, out)
            }),
            MeshArray::Floats(values) => write_f32s(values, out),
            #[expect(clippy::cast_possible_truncation, reason = "all values were checked to fit")]
            MeshArray::Ints(values) => write_pieces(values, |value| (value as i32).to_le_bytes(), out),
            MeshArray::Longs(values) => write_pieces(values, i64::to_le_bytes, out),
            MeshArray::Strings(table, indices) => {
                write_pieces(indices, |index| string_index(index, table).to_le_bytes(), out)
            }
            MeshArray::Faces { what, triangles, quads, is_wide, .. } => {
                let mut end = 0;
                let append = |face: Face, numbers: &mut Vec<u64>| match what {
                    OfFaces::Corners => {
                        numbers.extend(face.corners().iter().map(|&corner| u64::from(corner)))
                    }
                    OfFaces::Ends => {
                        end += face.corners().len() as u64;
                        numbers.push(end);
                    }
                };
                write_faces(triangles, quads, is_wide, out, append)
            }
        }
    }
}

/// Number of elements encoded at a time.
const PIECE: usize = 4096;

/// Writes the numbers that `append` adds for each face.
fn write_faces(
    triangles: &[[u32; 3]],
    quads: &[bool],
    is_wide: bool,
    out: &mut impl Write,
    mut append: impl FnMut(Face, &mut Vec<u64>),
) -> Result<()> {
    let mut numbers = Vec::new();
    for start in (0..triangles.len()).step_by(PIECE) {
        let range = start..(start + PIECE).min(triangles.len());
        numbers.clear();
        faces(triangles, quads, range).for_each(|face| append(face, &mut numbers));
        match is_wide {
            true => write_pieces(&numbers, u64::to_le_bytes, out)?,
            #[expect(clippy::cast_possible_truncation, reason = "all values were checked to fit")]
            false => write_pieces(&numbers, |number| (number as u32).to_le_bytes(), out)?,
        }
    }
    Ok(())
}
