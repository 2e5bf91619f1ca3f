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

use std::borrow::Cow;
use std::io::Write;

use super::XML;
use crate::data::{
    FilePositions, MeshView, ParticleFrame, Provenance, Values, VertexAttribute, VertexValues,
};
use crate::error::Result;
use crate::number::{write_f32s, write_pieces};
use crate::provenance::{GENERATOR, prefixed};
use crate::row::MeshOptions;
use crate::vertex_attributes::{
    Face, UsedNames, check, check_quads, faces, quad_count, string_index, written,
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
        if is_wide {
            write_pieces(&numbers, u64::to_le_bytes, out)?;
        } else {
            #[expect(clippy::cast_possible_truncation, reason = "all values were checked to fit")]
            write_pieces(&numbers, |number| (number as u32).to_le_bytes(), out)?;
        }
    }
    Ok(())
}

// Writes particles as VTK's XML PolyData, `.vtp`: each point is also a cell, so that ParaView displays it.
//
//   <PointData> every attribute under its own name, with its own type
//   <Points>    floats of 32 or 64 bits, as in the particles
//   <Verts>     connectivity 0 1 2 .., offsets 1 2 3 ..
//
// See `super::appended` for the document around the data.

/// Writes positions and attributes.
///
/// # Errors
///
/// [`crate::Error::Io`] if `out` fails; [`crate::Error::Invalid`] if an attribute has the wrong number of
/// values.
pub fn write_particles(frame: &ParticleFrame, provenance: &Provenance, out: &mut impl Write) -> Result<()> {
    check(frame, XML)?;
    particle_document(frame).write(provenance, out)
}

/// Notes on attributes that a .vtp file cannot store exactly.
pub fn particle_notes(frame: &ParticleFrame) -> Vec<String> {
    let mut notes = Vec::new();
    for (attribute, name) in frame.attributes.iter().zip(particle_names_in_file(frame)) {
        if attribute.name != name {
            notes.push(format!("{} is named {name} in the .vtp", attribute.name));
        }
        if matches!(attribute.values, Values::Strings { .. }) {
            notes.push(format!("{name} is stored as indices in the .vtp; the strings are in its field data"));
        }
    }
    notes
}

fn particle_names_in_file(frame: &ParticleFrame) -> Vec<String> {
    names_of(frame.attributes.iter().map(|attribute| &*attribute.name), &[])
}

fn particle_document(frame: &ParticleFrame) -> VtpDocument<ParticleArray<'_>> {
    let point_count = frame.positions.len();
    let attributes = frame.attributes.iter().zip(particle_names_in_file(frame));
    VtpDocument {
        normals: None,
        of_points: attributes
            .map(|(attribute, name)| {
                Array::new(name, attribute.arity, ParticleArray::Values(written(attribute)))
            })
            .collect(),
        point_count,
        points: ParticleArray::Positions(&frame.positions),
        cells: CellKind::Verts,
        cell_count: point_count,
        connectivity: ParticleArray::Counted(0, point_count),
        offsets: ParticleArray::Counted(1, point_count),
    }
}

/// The data of an array.
enum ParticleArray<'a> {
    Values(Cow<'a, Values>),
    Positions(&'a FilePositions),
    /// Consecutive integers: the first, and their number.
    Counted(i64, usize),
}

impl ArrayData for ParticleArray<'_> {
    fn kind(&self) -> NumberKind {
        match self {
            ParticleArray::Positions(FilePositions::F32(_)) => FLOAT_32,
            ParticleArray::Positions(FilePositions::F64(_)) => FLOAT_64,
            ParticleArray::Counted(..) => INT_64,
            ParticleArray::Values(values) => match &**values {
                Values::F32(_) => FLOAT_32,
                Values::F64(_) => FLOAT_64,
                Values::U8(_) => UINT_8,
                Values::I32(_) | Values::Strings { .. } => INT_32,
                Values::I64(_) => INT_64,
            },
        }
    }

    fn count(&self) -> u64 {
        let count = match self {
            ParticleArray::Positions(positions) => 3 * positions.len(),
            ParticleArray::Counted(_, count) => *count,
            ParticleArray::Values(values) => crate::number::length(values),
        };
        count as u64
    }

    fn table(&self) -> Option<&[String]> {
        let ParticleArray::Values(values) = self else { return None };
        let Values::Strings { table, .. } = &**values else { return None };
        Some(table)
    }

    fn write(&self, out: &mut impl Write) -> Result<()> {
        match self {
            ParticleArray::Positions(FilePositions::F32(positions)) => {
                write_f32s(positions.as_flattened(), out)
            }
            ParticleArray::Positions(FilePositions::F64(positions)) => {
                write_pieces(positions.as_flattened(), f64::to_le_bytes, out)
            }
            ParticleArray::Counted(from, count) => {
                let mut next = *from;
                for piece in (0..*count).step_by(PIECE) {
                    let length = PIECE.min(count - piece) as i64;
                    let numbers: Vec<i64> = (next..next + length).collect();
                    write_pieces(&numbers, i64::to_le_bytes, out)?;
                    next += length;
                }
                Ok(())
            }
            ParticleArray::Values(values) => match &**values {
                Values::F32(values) => write_f32s(values, out),
                Values::F64(values) => write_pieces(values, f64::to_le_bytes, out),
                Values::U8(values) => Ok(out.write_all(values)?),
                Values::I32(values) => write_pieces(values, i32::to_le_bytes, out),
                Values::I64(values) => write_pieces(values, i64::to_le_bytes, out),
                Values::Strings { table, indices } => {
                    write_pieces(indices, |index| string_index(index, table).to_le_bytes(), out)
                }
            },
        }
    }
}

// Writes a `.vtp` document: the XML head, followed by the appended arrays.
//
//   <VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt64">
//     <PolyData>
//       <FieldData>  <Array type="String" Name="meniscus_radius" ..> 48 46 .. 0 </Array>    provenance, string tables
//       <Piece NumberOfPoints="642" ..>
//         <PointData> <DataArray Name="v" offset="0"/>      ┐
//         <Points>    <DataArray Name="Points" offset=../>  ├ appended below in this order
//         <Polys>     or <Verts>: connectivity, offsets     ┘
//     <AppendedData encoding="raw"> _ [bytes] data  [bytes] data ..
//
// VTK's XML files store strings as the decimal codes of their bytes, with a zero after each string. Large
// data is appended in its binary form.

/// The end of the file.
const END: &str = "\n  </AppendedData>\n</VTKFile>\n";

/// Whether these are the last bytes of a complete file of this crate.
pub(crate) fn ends_as_written(tail: &[u8]) -> bool {
    tail.ends_with(END.as_bytes())
}

/// The data of an array.
pub(super) trait ArrayData {
    /// The type of a number.
    fn kind(&self) -> NumberKind;

    /// The number of values.
    fn count(&self) -> u64;

    /// The strings that the values are indices into.
    fn table(&self) -> Option<&[String]>;

    fn write(&self, out: &mut impl Write) -> Result<()>;
}

/// VTK's name of a number type, and its size in bytes.
pub(super) struct NumberKind(&'static str, u64);

const UINT_8: NumberKind = NumberKind("UInt8", 1);
const INT_32: NumberKind = NumberKind("Int32", 4);
const INT_64: NumberKind = NumberKind("Int64", 8);
const FLOAT_32: NumberKind = NumberKind("Float32", 4);
const FLOAT_64: NumberKind = NumberKind("Float64", 8);

/// An appended array.
pub(super) struct Array<N> {
    name: String,
    /// Number of components per element.
    arity: usize,
    numbers: N,
}

impl<N: ArrayData> Array<N> {
    pub(super) fn new(name: impl Into<String>, arity: usize, numbers: N) -> Array<N> {
        Array { name: name.into(), arity, numbers }
    }

    fn size_bytes(&self) -> u64 {
        let NumberKind(_, number_bytes) = self.numbers.kind();
        self.numbers.count() * number_bytes
    }
}

/// The type of the cells.
enum CellKind {
    Verts,
    Polys,
}

/// The content of a file.
struct VtpDocument<N> {
    /// The name of the array with normals, if any.
    pub(super) normals: Option<&'static str>,
    /// Arrays with values for each point.
    of_points: Vec<Array<N>>,
    pub(super) point_count: usize,
    pub(super) points: N,
    pub(super) cells: CellKind,
    pub(super) cell_count: usize,
    /// The points of all cells, concatenated.
    pub(super) connectivity: N,
    /// The end of each cell in `connectivity`.
    pub(super) offsets: N,
}

/// Size of the length field before each array.
const WORD_BYTES: u64 = 8;

impl<N: ArrayData> VtpDocument<N> {
    pub(super) fn write(self, provenance: &Provenance, out: &mut impl Write) -> Result<()> {
        let parts = self.into_parts();
        out.write_all(parts.head(provenance).as_bytes())?;
        for array in &parts.arrays {
            out.write_all(&array.size_bytes().to_le_bytes())?;
            array.numbers.write(out)?;
        }
        out.write_all(END.as_bytes())?;
        Ok(())
    }

    fn into_parts(self) -> DocumentParts<N> {
        let mut arrays = self.of_points;
        let normals = self.normals.map(|name| format!(" Normals=\"{name}\"")).unwrap_or_default();
        let (cells, vert_count, poly_count) = match self.cells {
            CellKind::Verts => ("Verts", self.cell_count, 0),
            CellKind::Polys => ("Polys", 0, self.cell_count),
        };
        let sections = [
            XmlSection { name: "PointData", about: normals, array_count: arrays.len() },
            XmlSection { name: "Points", about: String::new(), array_count: 1 },
            XmlSection { name: cells, about: String::new(), array_count: 2 },
        ];
        arrays.extend([
            Array::new("Points", 3, self.points),
            Array::new("connectivity", 1, self.connectivity),
            Array::new("offsets", 1, self.offsets),
        ]);
        DocumentParts { counts: [self.point_count, vert_count, poly_count], sections, arrays }
    }
}

/// A file in its final layout.
struct DocumentParts<N> {
    /// The numbers of points, of vertex cells, and of polygons.
    counts: [usize; 3],
    /// XML sections; each contains the next `array_count` arrays.
    sections: [XmlSection; 3],
    arrays: Vec<Array<N>>,
}

struct XmlSection {
    name: &'static str,
    /// XML attributes of the section's tag, as text.
    about: String,
    array_count: usize,
}

impl<N: ArrayData> DocumentParts<N> {
    /// The text before the data.
    fn head(&self, provenance: &Provenance) -> String {
        let [points, verts, polys] = self.counts;
        let mut text = format!(
            "<?xml version=\"1.0\"?>\n<!-- {GENERATOR} -->\n<VTKFile type=\"PolyData\" version=\"1.0\" \
             byte_order=\"LittleEndian\" header_type=\"UInt64\">\n  <PolyData>\n    <FieldData>\n{}    </FieldData>\n    \
             <Piece NumberOfPoints=\"{points}\" NumberOfVerts=\"{verts}\" NumberOfLines=\"0\" NumberOfStrips=\"0\" \
             NumberOfPolys=\"{polys}\">\n",
            self.field_data(provenance)
        );
        let (mut offset, mut arrays) = (0, self.arrays.iter());
        for XmlSection { name, about, array_count } in &self.sections {
            text += &format!("      <{name}{about}>\n");
            for array in arrays.by_ref().take(*array_count) {
                let (NumberKind(kind, _), of, arity) =
                    (array.numbers.kind(), escaped(&array.name), array.arity);
                text += &format!(
                    "        <DataArray type=\"{kind}\" Name=\"{of}\" NumberOfComponents=\"{arity}\" \
                     format=\"appended\" offset=\"{offset}\"/>\n"
                );
                offset += WORD_BYTES + array.size_bytes();
            }
            text += &format!("      </{name}>\n");
        }
        text + "    </Piece>\n  </PolyData>\n  <AppendedData encoding=\"raw\">\n   _"
    }

    /// The provenance, and the strings that values are indices into.
    fn field_data(&self, provenance: &Provenance) -> String {
        let pairs = provenance.iter().map(|(key, value)| string_array(&prefixed(key), &[value]));
        let table = |array: &Array<N>| {
            let table = array.numbers.table()?;
            Some(string_array(&format!("{} strings", array.name), table))
        };
        pairs.chain(self.arrays.iter().filter_map(table)).collect()
    }
}

/// A string array in VTK's encoding.
fn string_array(name: &str, strings: &[impl AsRef<str>]) -> String {
    let mut text = format!(
        "      <Array type=\"String\" Name=\"{}\" NumberOfTuples=\"{}\" format=\"ascii\">\n       ",
        escaped(&allowed(name)),
        strings.len()
    );
    for string in strings {
        // A zero within a string would end it.
        for byte in string.as_ref().bytes().filter(|&byte| byte != 0).chain([0]) {
            text += &format!(" {byte}");
        }
    }
    text + "\n      </Array>\n"
}

/// The name of each array in the file: its own, unless it contains characters that XML does not allow, or the
/// name is reserved or already used.
fn names_of<'a>(names: impl Iterator<Item = &'a str>, reserved: &[&str]) -> Vec<String> {
    let mut used = UsedNames::new(reserved);
    names.map(|name| used.take(&allowed(name), |stem| vec![stem.to_owned()]).concat()).collect()
}

/// Replaces control characters, and characters that XML 1.0 forbids even in escaped form, by underscores.
fn allowed(name: &str) -> String {
    name.replace(|c: char| c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}'), "_")
}

/// Escapes text for the value of an XML attribute.
fn escaped(text: &str) -> String {
    quick_xml::escape::escape(text).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forbidden_characters_in_names_are_replaced() {
        let cases = [
            ("heat", "heat"),
            ("a\u{fffe}b\u{ffff}", "a_b_"),
            ("\0\t\n\u{1f}\u{7f}\u{85}", "______"),
            ("größe <\u{fffd}\u{e000}\u{10ffff}>", "größe <\u{fffd}\u{e000}\u{10ffff}>"),
        ];
        for (name, expected) in cases {
            assert_eq!(names_of([name].into_iter(), &[]), [expected]);
            assert!(string_array(name, &[""]).contains(&format!("Name=\"{}\"", escaped(expected))));
        }
        assert_eq!(names_of(["a", "b", "A", "B"].into_iter(), &["b"]), ["a", "b_2", "A_2", "B_3"]);
    }
}
