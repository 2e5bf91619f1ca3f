//! Writes a triangle mesh or particles as binary little-endian PLY.
//!
//! ```text
//!   positions    x y z                      float, or double for 64-bit positions and for meshes with an origin
//!   one value    name                       the type of the attribute
//!   2 to 4       name_x name_y [name_z [name_w]]
//!   more         name_0 name_1 ..
//!   colour       red green blue [alpha]     of vertices: bytes, which all readers of coloured PLY support
//!   velocity     vx vy vz                   of vertices
//!   texture coordinates  s t                of vertices
//!   integers     names as above             int, uint (particles only), or double if these are too narrow
//!   strings      names as above             int: the index of a string listed in a comment; −1 for none
//! ```

use std::borrow::Cow;
use std::io::Write;

use crate::core::data::{
    AttributeRole, FileAttribute, FilePositions, MeshView, ParticleFrame, Provenance, Values,
    VertexAttribute, world,
};
use crate::core::error::{Error, Result};
use crate::core::provenance::{GENERATOR, comments, escape};
use crate::core::vertex_attributes::{
    Purpose, StoredNumbers, UsedNames, check, clamp_note, plain_name, purposes, written,
};

const FORMAT: &str = "PLY";

/// Number of vertices or faces encoded at a time.
const PIECE: usize = 4096;

/// Writes positions, normals, attributes and faces. Positions are floats. If the mesh has an origin, the
/// origin is added, and positions are doubles. Axes are not converted.
///
/// # Errors
///
/// [`Error::Io`] if `out` fails; [`Error::TooLarge`] if the vertex indices exceed the signed 32 bits that
/// readers expect; [`Error::Invalid`] if the mesh is inconsistent or not finite.
pub fn write_mesh(mesh: &MeshView, provenance: &Provenance, out: &mut dyn Write) -> Result<()> {
    mesh.check(FORMAT)?;
    if i32::try_from(mesh.positions.len()).is_err() {
        let what = format!("the mesh has {} vertices; the limit of PLY is 2³¹ − 1", mesh.positions.len());
        return Err(Error::too_large(FORMAT, what));
    }
    let has_origin = mesh.origin != [0.0; 3];
    let columns = columns_of_vertices(mesh.attributes, &mut Vec::new());
    let mut head =
        header(if has_origin { "double" } else { "float" }, mesh.positions.len(), &columns, provenance);
    head += "property float nx\nproperty float ny\nproperty float nz\n";
    columns.iter().for_each(|column| head += &column.properties());
    head += &format!(
        "element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        mesh.triangles.len()
    );
    out.write_all(head.as_bytes())?;
    write_pieces(mesh.positions.len(), out, |vertex, bytes| {
        let position = mesh.positions[vertex];
        if has_origin {
            bytes.extend_from_slice(world(mesh.origin, position).map(f64::to_le_bytes).as_flattened());
        } else {
            bytes.extend_from_slice(position.map(f32::to_le_bytes).as_flattened());
        }
        bytes.extend_from_slice(mesh.normals[vertex].map(f32::to_le_bytes).as_flattened());
        columns.iter().for_each(|column| column.append(vertex, bytes));
    })?;
    write_pieces(mesh.triangles.len(), out, |triangle, bytes| {
        bytes.push(3);
        bytes.extend_from_slice(mesh.triangles[triangle].map(u32::to_le_bytes).as_flattened());
    })
}

/// Notes on vertex attributes that a PLY file cannot store exactly.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = Vec::new();
    columns_of_vertices(attributes, &mut notes);
    notes
}

/// Writes positions and attributes.
///
/// # Errors
///
/// [`Error::Io`] if `out` fails; [`Error::Invalid`] if an attribute has the wrong number of values.
pub fn write_particles(frame: &ParticleFrame, provenance: &Provenance, out: &mut dyn Write) -> Result<()> {
    check(frame, FORMAT)?;
    let values: Vec<Cow<Values>> = frame.attributes.iter().map(written).collect();
    let columns = columns_of_particles(frame, &values);
    let (real, positions) = match &frame.positions {
        FilePositions::F32(positions) => ("float", StoredNumbers::F32(positions.as_flattened())),
        FilePositions::F64(positions) => ("double", StoredNumbers::F64(positions.as_flattened())),
    };
    let mut head = header(real, frame.positions.len(), &columns, provenance);
    columns.iter().for_each(|column| head += &column.properties());
    out.write_all((head + "end_header\n").as_bytes())?;
    write_pieces(frame.positions.len(), out, |particle, bytes| {
        positions.append(3 * particle..3 * (particle + 1), bytes);
        columns.iter().for_each(|column| column.append(particle, bytes));
    })
}

/// Notes on attributes that a PLY file cannot store exactly.
pub fn particle_notes(frame: &ParticleFrame) -> Vec<String> {
    let mut notes = Vec::new();
    let values: Vec<Cow<Values>> = frame.attributes.iter().map(written).collect();
    for (attribute, column) in frame.attributes.iter().zip(columns_of_particles(frame, &values)) {
        let name = &attribute.name;
        if column.names != names_of(attribute, name) {
            notes.push(format!("{name} is named {} in the .ply", column.names.join(", ")));
        }
        match column.numbers {
            StoredNumbers::Strings(..) => {
                notes.push(format!(
                    "{name} is stored as indices in the .ply; the strings are in its comments"
                ));
            }
            StoredNumbers::Rounded(values) => notes.extend(rounded_note(name, values)),
            _ => {}
        }
    }
    notes
}

/// The header up to the positions; other properties and elements follow.
fn header(real: &str, count: usize, columns: &[PlyColumns], provenance: &Provenance) -> String {
    let mut header = format!("ply\nformat binary_little_endian 1.0\ncomment {GENERATOR}\n");
    header += &comments(provenance, "comment ");
    columns.iter().for_each(|column| header += &column.comments());
    header + &format!("element vertex {count}\nproperty {real} x\nproperty {real} y\nproperty {real} z\n")
}

/// Encodes elements with `append`, and writes them in pieces of [`PIECE`] elements.
fn write_pieces(count: usize, out: &mut dyn Write, append: impl Fn(usize, &mut Vec<u8>)) -> Result<()> {
    let mut bytes = Vec::new();
    for start in (0..count).step_by(PIECE) {
        bytes.clear();
        (start..(start + PIECE).min(count)).for_each(|index| append(index, &mut bytes));
        out.write_all(&bytes)?;
    }
    Ok(())
}

/// Integers up to this magnitude are exact as 64-bit floats.
const EXACT_INTEGER_MAX: u64 = 1 << 53;

fn rounded_note(name: &str, values: &[i64]) -> Option<String> {
    let rounded = values.iter().filter(|value| value.unsigned_abs() > EXACT_INTEGER_MAX).count();
    (rounded > 0).then(|| {
        format!("values of {name} beyond ±2⁵³, which the .ply rounds: {rounded}; .vtp stores them exactly")
    })
}

/// An attribute: one PLY property for each of its components, all of one type.
struct PlyColumns<'a> {
    names: Vec<String>,
    numbers: StoredNumbers<'a>,
}

impl PlyColumns<'_> {
    /// The header lines that declare the properties.
    fn properties(&self) -> String {
        let kind = match self.numbers {
            StoredNumbers::U8(_) | StoredNumbers::Unit(_) => "uchar",
            StoredNumbers::Unsigned(_) => "uint",
            StoredNumbers::I32(_) | StoredNumbers::Narrow(_) | StoredNumbers::Strings(..) => "int",
            StoredNumbers::F32(_) => "float",
            StoredNumbers::F64(_) | StoredNumbers::Rounded(_) | StoredNumbers::I64(_) => "double",
        };
        self.names.iter().map(|name| format!("property {kind} {name}\n")).collect()
    }

    /// The header comments that list the strings of a string attribute, each with its index.
    fn comments(&self) -> String {
        let Some(table) = self.numbers.table() else { return String::new() };
        let name = &self.names[0];
        let line =
            |(index, text): (usize, &String)| format!("comment string {index} of {name}: {}\n", escape(text));
        table.iter().enumerate().map(line).collect()
    }

    /// Appends the values of a vertex or a particle.
    fn append(&self, index: usize, bytes: &mut Vec<u8>) {
        let arity = self.names.len();
        self.numbers.append(index * arity..(index + 1) * arity, bytes);
    }
}

fn columns_of_particles<'a>(frame: &ParticleFrame, values: &'a [Cow<Values>]) -> Vec<PlyColumns<'a>> {
    let mut used = UsedNames::new(&["x", "y", "z"]);
    let column = |(attribute, values): (&FileAttribute, &'a Cow<Values>)| {
        let names = used.take_all(&word(&attribute.name), |stem| names_of(attribute, stem));
        let numbers = match StoredNumbers::of_particles(values) {
            StoredNumbers::I64(values) if fits::<u32>(values) => StoredNumbers::Unsigned(values),
            StoredNumbers::I64(values) if fits::<i32>(values) => StoredNumbers::Narrow(values),
            StoredNumbers::I64(values) => StoredNumbers::Rounded(values),
            numbers => numbers,
        };
        PlyColumns { names, numbers }
    };
    frame.attributes.iter().zip(values).map(column).collect()
}

fn fits<T: TryFrom<i64>>(values: &[i64]) -> bool {
    values.iter().all(|&value| T::try_from(value).is_ok())
}

/// A name as one word, as the header requires.
fn word(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_graphic() { c } else { '_' };
    let word: String = name.trim().chars().map(plain).collect();
    if word.is_empty() { "attribute".into() } else { word }
}

fn names_of(attribute: &FileAttribute, stem: &str) -> Vec<String> {
    // Readers give the name `color` to `red green blue`.
    if attribute.role == Some(AttributeRole::Color) && stem == "color" {
        color_names("", attribute.arity)
    } else {
        component_names(stem, attribute.arity)
    }
}

/// Maximum size in bytes of the comments with the strings of an attribute: some readers limit the header's
/// size.
const STRINGS_BYTES_MAX: usize = 64 << 10;

/// The attributes of vertices that can be stored, in order.
fn columns_of_vertices<'a>(
    attributes: &[VertexAttribute<'a>],
    notes: &mut Vec<String>,
) -> Vec<PlyColumns<'a>> {
    let mut used = UsedNames::new(&["x", "y", "z", "nx", "ny", "nz"]);
    let mut placed = Vec::new();
    for (attribute, purpose) in attributes.iter().zip(purposes(attributes)) {
        let VertexAttribute { name, arity, .. } = *attribute;
        let stem = plain_name(name);
        let (names, wanted) = match purpose {
            Purpose::Color(_) => (used.take_all("", |stem| color_names(stem, arity)), color_names("", arity)),
            Purpose::Velocity => (used.take_all("v", velocity_names), velocity_names("v")),
            // The names that Blender and MeshLab know.
            Purpose::Texture => {
                let texture_names = |stem: &str| vec![format!("s{stem}"), format!("t{stem}")];
                (used.take_all("", texture_names), texture_names(""))
            }
            Purpose::Acceleration | Purpose::Other => {
                (used.take_all(&stem, |stem| component_names(stem, arity)), component_names(name, arity))
            }
        };
        let numbers = match (purpose, StoredNumbers::of_vertices(attribute.values)) {
            (Purpose::Color(values), _) => {
                notes.extend(clamp_note(name, values, "the .ply"));
                StoredNumbers::Unit(values)
            }
            (_, StoredNumbers::I64(values)) => {
                notes.extend(rounded_note(name, values));
                StoredNumbers::Rounded(values)
            }
            (_, numbers) => numbers,
        };
        let column = PlyColumns { names, numbers };
        if column.comments().len() > STRINGS_BYTES_MAX {
            notes.push(format!("{name} is missing in the .ply: its strings are too long for the header"));
            continue;
        }
        if column.names != wanted {
            notes.push(format!("{name} is named {} in the .ply", column.names.join(", ")));
        }
        placed.push(column);
    }
    placed
}

fn color_names(stem: &str, arity: usize) -> Vec<String> {
    ["red", "green", "blue", "alpha"].iter().take(arity).map(|name| format!("{name}{stem}")).collect()
}

fn velocity_names(stem: &str) -> Vec<String> {
    ["x", "y", "z"].map(|axis| format!("{stem}{axis}")).to_vec()
}

fn component_names(stem: &str, arity: usize) -> Vec<String> {
    match arity {
        1 => vec![stem.into()],
        2..=4 => ["x", "y", "z", "w"].iter().take(arity).map(|axis| format!("{stem}_{axis}")).collect(),
        _ => (0..arity).map(|index| format!("{stem}_{index}")).collect(),
    }
}
