//! Writes a mesh or particles as VTK's XML PolyData, `.vtp`, for ParaView: the XML head, followed by the
//! appended arrays.
//!
//! ```text
//!   <VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt64">
//!     <PolyData>
//!       <FieldData>  <Array type="String" Name="meniscus_radius" ..> 48 46 .. 0 </Array>    provenance, string tables
//!       <Piece NumberOfPoints="642" ..>
//!         <PointData> <DataArray Name="v" offset="0"/>      ┐
//!         <Points>    <DataArray Name="Points" offset=../>  ├ appended below in this order
//!         <Polys>     or <Verts>: connectivity, offsets     ┘
//!     <AppendedData encoding="raw"> _ [bytes] data  [bytes] data ..
//! ```
//!
//! Attributes have their own names. Those of particles have their own types; integers of a mesh have 32 bits
//! if all fit, else 64. Positions of a mesh are 64-bit floats if it has an origin other than zero. Each
//! particle is also a cell, so that ParaView displays it. Axes are not converted, because VTK has no notion of
//! up. VTK's XML files store strings as the decimal codes of their bytes, with a zero after each string.

use std::borrow::Cow;
use std::io::Write;

use super::XML;
use crate::core::data::{FilePositions, MeshView, ParticleFrame, Provenance, Values, VertexAttribute, world};
use crate::core::error::Result;
use crate::core::options::MeshOptions;
use crate::core::provenance::{GENERATOR, prefixed};
use crate::core::vertex_attributes::{
    Purpose, StoredNumbers, UsedNames, check, check_quads, faces, purposes, quad_count, written,
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
    out: &mut dyn Write,
) -> Result<()> {
    mesh.check(XML)?;
    check_quads(XML, mesh.triangles, &options.quads)?;
    let quads = &*options.quads;
    let MeshView { positions, normals, triangles, origin, attributes } = *mesh;
    let mut of_points = vec![Array::stored(NORMALS, 3, StoredNumbers::F32(normals.as_flattened()))];
    for (attribute, name) in attributes.iter().zip(names_in_file(attributes)) {
        of_points.push(Array::stored(name, attribute.arity, StoredNumbers::of_vertices(attribute.values)));
    }
    let texture = purposes(attributes).iter().position(|purpose| *purpose == Purpose::Texture);
    // The array of normals is before those of the attributes.
    let texture =
        texture.map_or_else(String::new, |at| format!(" TCoords=\"{}\"", escaped(&of_points[at + 1].name)));
    // Every quad joins two triangles with six corners into one face with four.
    let quad_count = quad_count(quads);
    let (face_count, corner_count) = (triangles.len() - quad_count, 3 * triangles.len() - 2 * quad_count);
    // 32 bits must also hold the largest offset, which is the number of corners.
    let is_wide = i32::try_from(corner_count.max(positions.len())).is_err();
    let of_faces = |what, count| ArrayNumbers::Faces { what, count, triangles, quads, is_wide };
    VtpDocument {
        about_points: format!(" Normals=\"Normals\"{texture}"),
        of_points,
        point_count: positions.len(),
        points: match origin {
            [0.0, 0.0, 0.0] => ArrayNumbers::Stored(StoredNumbers::F32(positions.as_flattened())),
            origin => ArrayNumbers::FarPositions { positions, origin },
        },
        cells: "Polys",
        cell_count: face_count,
        connectivity: of_faces(OfFaces::Corners, corner_count),
        offsets: of_faces(OfFaces::Ends, face_count),
    }
    .write(provenance, out)
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

/// Writes positions and attributes.
///
/// # Errors
///
/// [`crate::Error::Io`] if `out` fails; [`crate::Error::Invalid`] if an attribute has the wrong number of
/// values.
pub fn write_particles(frame: &ParticleFrame, provenance: &Provenance, out: &mut dyn Write) -> Result<()> {
    check(frame, XML)?;
    let point_count = frame.positions.len();
    let values: Vec<Cow<Values>> = frame.attributes.iter().map(written).collect();
    let mut of_points = Vec::new();
    for ((attribute, name), values) in frame.attributes.iter().zip(particle_names_in_file(frame)).zip(&values)
    {
        of_points.push(Array::stored(name, attribute.arity, StoredNumbers::of_particles(values)));
    }
    VtpDocument {
        about_points: String::new(),
        of_points,
        point_count,
        points: ArrayNumbers::Stored(match &frame.positions {
            FilePositions::F32(positions) => StoredNumbers::F32(positions.as_flattened()),
            FilePositions::F64(positions) => StoredNumbers::F64(positions.as_flattened()),
        }),
        cells: "Verts",
        cell_count: point_count,
        connectivity: ArrayNumbers::Counted { first: 0, count: point_count },
        offsets: ArrayNumbers::Counted { first: 1, count: point_count },
    }
    .write(provenance, out)
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

/// The end of the file.
const END: &str = "\n  </AppendedData>\n</VTKFile>\n";

/// Whether these are the last bytes of a complete file of this crate.
pub(crate) fn ends_as_written(tail: &[u8]) -> bool {
    tail.ends_with(END.as_bytes())
}

/// The content of a file.
struct VtpDocument<'a> {
    /// The XML attributes that name the arrays with normals and texture coordinates.
    about_points: String,
    /// Arrays with values for each point.
    of_points: Vec<Array<'a>>,
    point_count: usize,
    points: ArrayNumbers<'a>,
    /// The section with the cells, `Verts` or `Polys`.
    cells: &'static str,
    cell_count: usize,
    /// The points of all cells, concatenated.
    connectivity: ArrayNumbers<'a>,
    /// The end of each cell in `connectivity`.
    offsets: ArrayNumbers<'a>,
}

/// Size of the length field before each array.
const WORD_BYTES: u64 = 8;

impl VtpDocument<'_> {
    fn write(self, provenance: &Provenance, out: &mut dyn Write) -> Result<()> {
        let of_points = self.of_points.len();
        let mut arrays = self.of_points;
        arrays.push(Array { name: "Points".into(), arity: 3, numbers: self.points });
        arrays.push(Array { name: "connectivity".into(), arity: 1, numbers: self.connectivity });
        arrays.push(Array { name: "offsets".into(), arity: 1, numbers: self.offsets });
        let table =
            |array: &Array| Some(string_array(&format!("{} strings", array.name), array.numbers.table()?));
        let field_data = provenance.iter().map(|(key, value)| string_array(&prefixed(key), &[value]));
        let field_data: String = field_data.chain(arrays.iter().filter_map(table)).collect();
        let count_of = |section| if self.cells == section { self.cell_count } else { 0 };
        let mut text = format!(
            "<?xml version=\"1.0\"?>\n<!-- {GENERATOR} -->\n<VTKFile type=\"PolyData\" version=\"1.0\" \
             byte_order=\"LittleEndian\" header_type=\"UInt64\">\n  <PolyData>\n    <FieldData>\n{field_data}    \
             </FieldData>\n    <Piece NumberOfPoints=\"{}\" NumberOfVerts=\"{}\" NumberOfLines=\"0\" \
             NumberOfStrips=\"0\" NumberOfPolys=\"{}\">\n",
            self.point_count,
            count_of("Verts"),
            count_of("Polys")
        );
        let (mut offset, mut rest) = (0, &arrays[..]);
        for (section, about, count) in
            [("PointData", &*self.about_points, of_points), ("Points", "", 1), (self.cells, "", 2)]
        {
            let (of_section, others) = rest.split_at(count);
            rest = others;
            text += &format!("      <{section}{about}>\n");
            for array in of_section {
                let (kind, name, arity) = (array.numbers.kind().0, escaped(&array.name), array.arity);
                text += &format!(
                    "        <DataArray type=\"{kind}\" Name=\"{name}\" NumberOfComponents=\"{arity}\" \
                     format=\"appended\" offset=\"{offset}\"/>\n"
                );
                offset += WORD_BYTES + array.numbers.size_bytes();
            }
            text += &format!("      </{section}>\n");
        }
        text += "    </Piece>\n  </PolyData>\n  <AppendedData encoding=\"raw\">\n   _";
        out.write_all(text.as_bytes())?;
        for array in &arrays {
            out.write_all(&array.numbers.size_bytes().to_le_bytes())?;
            array.numbers.write(out)?;
        }
        Ok(out.write_all(END.as_bytes())?)
    }
}

/// An appended array.
struct Array<'a> {
    name: String,
    /// Number of components per element.
    arity: usize,
    numbers: ArrayNumbers<'a>,
}

impl<'a> Array<'a> {
    fn stored(name: impl Into<String>, arity: usize, numbers: StoredNumbers<'a>) -> Array<'a> {
        Array { name: name.into(), arity, numbers: ArrayNumbers::Stored(numbers) }
    }
}

/// The source of an array's values. The variant determines the stored type.
#[derive(Clone, Copy)]
enum ArrayNumbers<'a> {
    Stored(StoredNumbers<'a>),
    FarPositions {
        positions: &'a [[f32; 3]],
        origin: [f64; 3],
    },
    /// Consecutive integers.
    Counted {
        first: i64,
        count: usize,
    },
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

/// Number of elements encoded at a time.
const PIECE: usize = 4096;

impl ArrayNumbers<'_> {
    /// VTK's name of the number type, and its size in bytes.
    fn kind(&self) -> (&'static str, usize) {
        match self {
            ArrayNumbers::Stored(StoredNumbers::U8(_) | StoredNumbers::Unit(_)) => ("UInt8", 1),
            ArrayNumbers::Stored(
                StoredNumbers::I32(_) | StoredNumbers::Narrow(_) | StoredNumbers::Strings(..),
            )
            | ArrayNumbers::Faces { is_wide: false, .. } => ("Int32", 4),
            ArrayNumbers::Stored(StoredNumbers::I64(_) | StoredNumbers::Unsigned(_))
            | ArrayNumbers::Counted { .. }
            | ArrayNumbers::Faces { is_wide: true, .. } => ("Int64", 8),
            ArrayNumbers::Stored(StoredNumbers::F32(_)) => ("Float32", 4),
            ArrayNumbers::Stored(StoredNumbers::F64(_) | StoredNumbers::Rounded(_))
            | ArrayNumbers::FarPositions { .. } => ("Float64", 8),
        }
    }

    fn size_bytes(&self) -> u64 {
        let count = match self {
            ArrayNumbers::Stored(numbers) => numbers.len(),
            ArrayNumbers::FarPositions { positions, .. } => positions.as_flattened().len(),
            ArrayNumbers::Counted { count, .. } | ArrayNumbers::Faces { count, .. } => *count,
        };
        (count * self.kind().1) as u64
    }

    /// The strings that the values are indices into.
    fn table(&self) -> Option<&[String]> {
        match self {
            ArrayNumbers::Stored(numbers) => numbers.table(),
            _ => None,
        }
    }

    fn write(&self, out: &mut dyn Write) -> Result<()> {
        let element_count = match self {
            ArrayNumbers::Stored(numbers) => numbers.len(),
            ArrayNumbers::FarPositions { positions, .. } => positions.len(),
            ArrayNumbers::Counted { count, .. } => *count,
            ArrayNumbers::Faces { triangles, .. } => triangles.len(),
        };
        let (mut bytes, mut end) = (Vec::new(), 0);
        for start in (0..element_count).step_by(PIECE) {
            let range = start..(start + PIECE).min(element_count);
            bytes.clear();
            match *self {
                ArrayNumbers::Stored(numbers) => numbers.append(range, &mut bytes),
                ArrayNumbers::FarPositions { positions, origin } => {
                    let numbers = positions[range].iter().flat_map(|position| world(origin, *position));
                    bytes.extend(numbers.flat_map(f64::to_le_bytes));
                }
                ArrayNumbers::Counted { first, .. } => {
                    bytes.extend(range.flat_map(|index| (first + index as i64).to_le_bytes()));
                }
                ArrayNumbers::Faces { what, triangles, quads, .. } => {
                    let width = self.kind().1;
                    let mut append = |number: u64| bytes.extend_from_slice(&number.to_le_bytes()[..width]);
                    for face in faces(triangles, quads, range) {
                        match what {
                            OfFaces::Corners => face.corners().iter().for_each(|&c| append(c.into())),
                            OfFaces::Ends => {
                                end += face.corners().len() as u64;
                                append(end);
                            }
                        }
                    }
                }
            }
            out.write_all(&bytes)?;
        }
        Ok(())
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
    names.map(|name| used.take(&allowed(name))).collect()
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
