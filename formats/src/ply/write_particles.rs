//! Writes particles as binary little-endian PLY.
//!
//! ```text
//!   positions    x y z                      float, or double for 64-bit positions
//!   scalars      name                       the type of the attribute
//!   vectors      name_x name_y name_z ..    the type of the attribute; five or more values: name_0 name_1 ..
//!   "color"      red green blue [alpha]     readers join these columns to "color" again
//!   integers     names as above             int, uint, or double if these are too narrow
//!   strings      names as above             int: the index of a string listed in a comment; −1 for none
//! ```

use std::borrow::Cow;
use std::io::Write;

use super::vertex_data::{component_names, string_comments};
use crate::data::{AttributeRole, FileAttribute, FilePositions, ParticleFrame, Provenance, Values};
use crate::error::Result;
use crate::particle_columns::{check, written};
use crate::provenance::{GENERATOR, comments};
use crate::vertex_attributes::{UsedNames, string_index};

const FORMAT: &str = "PLY";

/// Number of particles encoded at a time.
const PIECE: usize = 4096;

/// Integers up to this magnitude are exact as 64-bit floats.
const EXACT_INTEGER_MAX: u64 = 1 << 53;

/// Writes positions and attributes.
///
/// # Errors
///
/// [`crate::Error::Io`] if `out` fails; [`crate::Error::Invalid`] if an attribute has the wrong number of
/// values.
pub fn write_particles(frame: &ParticleFrame, provenance: &Provenance, out: &mut impl Write) -> Result<()> {
    check(frame, FORMAT)?;
    let columns = columns_of(frame);
    out.write_all(header(frame, &columns, provenance).as_bytes())?;
    let mut bytes = Vec::new();
    let count = frame.positions.len();
    for start in (0..count).step_by(PIECE) {
        bytes.clear();
        for particle in start..(start + PIECE).min(count) {
            match &frame.positions {
                FilePositions::F32(all) => bytes.extend(all[particle].iter().flat_map(|x| x.to_le_bytes())),
                FilePositions::F64(all) => bytes.extend(all[particle].iter().flat_map(|x| x.to_le_bytes())),
            }
            columns.iter().for_each(|column| column.append(particle, &mut bytes));
        }
        out.write_all(&bytes)?;
    }
    Ok(())
}

/// Notes on attributes that a PLY file cannot store exactly.
pub fn particle_notes(frame: &ParticleFrame) -> Vec<String> {
    let mut notes = Vec::new();
    for (attribute, column) in frame.attributes.iter().zip(columns_of(frame)) {
        let name = &attribute.name;
        if column.names != names_of(attribute, name) {
            notes.push(format!("{name} is named {} in the .ply", column.names.join(", ")));
        }
        match &*column.values {
            Values::Strings { .. } => {
                notes.push(format!(
                    "{name} is stored as indices in the .ply; the strings are in its comments"
                ));
            }
            Values::I64(values) if column.kind == PlyType::Double => {
                let rounded = values.iter().filter(|value| value.unsigned_abs() > EXACT_INTEGER_MAX).count();
                if rounded > 0 {
                    notes
                        .push(format!("{rounded} values of {name} are beyond ±2⁵³ and are rounded in the .ply; .vtp stores them exactly"));
                }
            }
            _ => {}
        }
    }
    notes
}

fn header(frame: &ParticleFrame, columns: &[PlyColumn], provenance: &Provenance) -> String {
    let real = match frame.positions {
        FilePositions::F32(_) => "float",
        FilePositions::F64(_) => "double",
    };
    let mut header = format!("ply\nformat binary_little_endian 1.0\ncomment {GENERATOR}\n");
    header += &comments(provenance, "comment ");
    for column in columns {
        if let Values::Strings { table, .. } = &*column.values {
            header += &string_comments(&column.names[0], table);
        }
    }
    header += &format!("element vertex {}\n", frame.positions.len());
    for name in ["x", "y", "z"] {
        header += &format!("property {real} {name}\n");
    }
    for PlyColumn { names, kind, .. } in columns {
        names.iter().for_each(|name| header += &format!("property {} {name}\n", kind.name()));
    }
    header + "end_header\n"
}

/// An attribute as columns of one type.
struct PlyColumn<'a> {
    names: Vec<String>,
    values: Cow<'a, Values>,
    kind: PlyType,
}

/// A PLY type.
#[derive(Clone, Copy, PartialEq)]
enum PlyType {
    Uchar,
    Int,
    Uint,
    Float,
    Double,
}

impl PlyType {
    fn name(self) -> &'static str {
        match self {
            PlyType::Uchar => "uchar",
            PlyType::Int => "int",
            PlyType::Uint => "uint",
            PlyType::Float => "float",
            PlyType::Double => "double",
        }
    }

    /// The narrowest type that represents the values and that readers support.
    fn of(values: &Values) -> PlyType {
        match values {
            Values::F32(_) => PlyType::Float,
            Values::F64(_) => PlyType::Double,
            Values::U8(_) => PlyType::Uchar,
            Values::I32(_) | Values::Strings { .. } => PlyType::Int,
            Values::I64(values) if values.iter().all(|&value| u32::try_from(value).is_ok()) => PlyType::Uint,
            Values::I64(values) if values.iter().all(|&value| i32::try_from(value).is_ok()) => PlyType::Int,
            Values::I64(_) => PlyType::Double,
        }
    }
}

fn columns_of(frame: &ParticleFrame) -> Vec<PlyColumn<'_>> {
    let mut used = UsedNames::new(&["x", "y", "z"]);
    let column = |attribute| {
        let values = written(attribute);
        let stem = word(&attribute.name);
        let names = used.take(&stem, |stem| names_of(attribute, stem));
        PlyColumn { names, kind: PlyType::of(&values), values }
    };
    frame.attributes.iter().map(column).collect()
}

/// A name as one word, as the header requires.
fn word(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_graphic() { c } else { '_' };
    let word: String = name.trim().chars().map(plain).collect();
    if word.is_empty() { "attribute".into() } else { word }
}

fn names_of(attribute: &FileAttribute, stem: &str) -> Vec<String> {
    let is_color = attribute.role == Some(AttributeRole::Color) && stem == COLOR;
    match is_color {
        true => COLORS.iter().take(attribute.arity).map(|&name| name.to_owned()).collect(),
        false => component_names(stem, attribute.arity),
    }
}

/// Readers give this name to `red green blue`.
const COLOR: &str = "color";
const COLORS: [&str; 4] = ["red", "green", "blue", "alpha"];

impl PlyColumn<'_> {
    /// Appends the values of a particle.
    fn append(&self, particle: usize, bytes: &mut Vec<u8>) {
        let arity = self.names.len();
        let range = particle * arity..(particle + 1) * arity;
        match &*self.values {
            Values::F32(values) => bytes.extend(values[range].iter().flat_map(|value| value.to_le_bytes())),
            Values::F64(values) => bytes.extend(values[range].iter().flat_map(|value| value.to_le_bytes())),
            Values::U8(values) => bytes.extend_from_slice(&values[range]),
            Values::I32(values) => bytes.extend(values[range].iter().flat_map(|value| value.to_le_bytes())),
            Values::I64(values) if self.kind == PlyType::Double => {
                bytes.extend(values[range].iter().flat_map(|&value| (value as f64).to_le_bytes()));
            }
            #[expect(clippy::cast_possible_truncation, reason = "all values were checked to fit")]
            Values::I64(values) => {
                bytes.extend(values[range].iter().flat_map(|&value| (value as i32).to_le_bytes()));
            }
            Values::Strings { table, indices } => {
                let indices = indices[range].iter().map(|&index| string_index(index, table));
                bytes.extend(indices.flat_map(i32::to_le_bytes));
            }
        }
    }
}
