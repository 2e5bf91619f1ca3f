//! Writes a `.vtp` document: the XML head, followed by the appended arrays.
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
//! VTK's XML files store strings as the decimal codes of their bytes, with a zero after each string. Large
//! data is appended in its binary form.

use std::io::Write;

use crate::data::Provenance;
use crate::error::Result;
use crate::provenance::{GENERATOR, prefixed};
use crate::vertex_attributes::UsedNames;

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

pub(super) const UINT_8: NumberKind = NumberKind("UInt8", 1);
pub(super) const INT_32: NumberKind = NumberKind("Int32", 4);
pub(super) const INT_64: NumberKind = NumberKind("Int64", 8);
pub(super) const FLOAT_32: NumberKind = NumberKind("Float32", 4);
pub(super) const FLOAT_64: NumberKind = NumberKind("Float64", 8);

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
pub(super) enum CellKind {
    Verts,
    Polys,
}

/// The content of a file.
pub(super) struct VtpDocument<N> {
    /// The name of the array with normals, if any.
    pub(super) normals: Option<&'static str>,
    /// Arrays with values for each point.
    pub(super) of_points: Vec<Array<N>>,
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
pub(super) fn names_of<'a>(names: impl Iterator<Item = &'a str>, reserved: &[&str]) -> Vec<String> {
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
