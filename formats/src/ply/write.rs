//! Writes a triangle mesh as binary little-endian PLY.

use std::borrow::Cow;
use std::io::Write;

use crate::data::{
    AttributeRole, FileAttribute, FilePositions, MeshView, ParticleFrame, Provenance, Values,
    VertexAttribute, VertexValues,
};
use crate::error::{Error, Result};
use crate::provenance::{GENERATOR, comments, escape};
use crate::vertex_attributes::{
    Purpose, UsedNames, check, clamp_note, plain_name, purposes, string_index, written,
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
pub fn write_mesh(mesh: &MeshView, provenance: &Provenance, out: &mut impl Write) -> Result<()> {
    mesh.check(FORMAT)?;
    if i32::try_from(mesh.positions.len()).is_err() {
        let what = format!("the mesh has {} vertices; the limit of PLY is 2³¹ − 1", mesh.positions.len());
        return Err(Error::too_large(FORMAT, what));
    }
    let far = mesh.origin != [0.0; 3];
    let attributes = stored_attributes(mesh.attributes);
    out.write_all(header(mesh, &attributes, far, provenance).as_bytes())?;
    let vertices = mesh.positions.iter().zip(mesh.normals).enumerate();
    write_pieces(vertices, out, |(vertex, (position, normal)), bytes| {
        if far {
            let world = (0..3).map(|axis| mesh.origin[axis] + f64::from(position[axis]));
            bytes.extend(world.flat_map(f64::to_le_bytes));
        } else {
            bytes.extend_from_slice(position.map(f32::to_le_bytes).as_flattened());
        }
        bytes.extend_from_slice(normal.map(f32::to_le_bytes).as_flattened());
        attributes.iter().for_each(|attribute| attribute.append(vertex, bytes));
    })?;
    write_pieces(mesh.triangles.iter(), out, |triangle, bytes| {
        bytes.push(3);
        bytes.extend_from_slice(triangle.map(u32::to_le_bytes).as_flattened());
    })
}

fn header(mesh: &MeshView, attributes: &[PlyAttribute], far: bool, provenance: &Provenance) -> String {
    let real = if far { "double" } else { "float" };
    let mut header = format!("ply\nformat binary_little_endian 1.0\ncomment {GENERATOR}\n");
    header += &comments(provenance, "comment ");
    attributes.iter().for_each(|attribute| header += &attribute.comments());
    header += &format!("element vertex {}\n", mesh.positions.len());
    for name in ["x", "y", "z"] {
        header += &format!("property {real} {name}\n");
    }
    for name in ["nx", "ny", "nz"] {
        header += &format!("property float {name}\n");
    }
    attributes.iter().for_each(|attribute| header += &attribute.properties());
    header += &format!("element face {}\nproperty list uchar int vertex_indices\n", mesh.triangles.len());
    header + "end_header\n"
}

/// Encodes items with `append`, and writes them in pieces of [`PIECE`] items.
fn write_pieces<T>(
    items: impl Iterator<Item = T>,
    out: &mut impl Write,
    append: impl Fn(T, &mut Vec<u8>),
) -> Result<()> {
    let mut bytes = Vec::new();
    for (index, item) in items.enumerate() {
        append(item, &mut bytes);
        if (index + 1) % PIECE == 0 {
            out.write_all(&bytes)?;
            bytes.clear();
        }
    }
    out.write_all(&bytes)?;
    Ok(())
}

// Writes particles as binary little-endian PLY.
//
//   positions    x y z                      float, or double for 64-bit positions
//   scalars      name                       the type of the attribute
//   vectors      name_x name_y name_z ..    the type of the attribute; five or more values: name_0 name_1 ..
//   "color"      red green blue [alpha]     readers join these columns to "color" again
//   integers     names as above             int, uint, or double if these are too narrow
//   strings      names as above             int: the index of a string listed in a comment; −1 for none

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
    out.write_all(particle_header(frame, &columns, provenance).as_bytes())?;
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

fn particle_header(frame: &ParticleFrame, columns: &[PlyColumn], provenance: &Provenance) -> String {
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
    if is_color {
        COLORS.iter().take(attribute.arity).map(|&name| name.to_owned()).collect()
    } else {
        component_names(stem, attribute.arity)
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

// The PLY properties that store vertex attributes.
//
//   colour     red green blue [alpha]   bytes: supported by all readers of coloured PLY
//   velocity   vx vy vz                 floats
//   others     name                     floats
//     2 to 4 values: name_x name_y [name_z [name_w]]
//     more values:   name_0 name_1 ..
//   integers   names as for others      int if all values fit, else double
//   strings    names as for others      int: the index of a string listed in a comment; −1 for none

/// Maximum size in bytes of the comments with the strings of an attribute: some readers limit the header's
/// size.
const STRINGS_BYTES_MAX: usize = 64 << 10;

/// An attribute that can be stored: one PLY property for each of its components, all of one type.
struct PlyAttribute<'a> {
    names: Vec<String>,
    values: StoredValues<'a>,
}

/// The stored type and the source of the values.
enum StoredValues<'a> {
    Floats(&'a [f32]),
    /// Numbers from 0 to 1, stored as 0 to 255.
    Bytes(&'a [f32]),
    Ints(&'a [i64]),
    Doubles(&'a [i64]),
    Strings(&'a [String], &'a [i32]),
}

/// Notes on vertex attributes that a PLY file cannot store exactly.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = Vec::new();
    assign_names(attributes, &mut notes);
    notes
}

/// The attributes that can be stored, in order.
fn stored_attributes<'a>(attributes: &[VertexAttribute<'a>]) -> Vec<PlyAttribute<'a>> {
    assign_names(attributes, &mut Vec::new())
}

fn assign_names<'a>(attributes: &[VertexAttribute<'a>], notes: &mut Vec<String>) -> Vec<PlyAttribute<'a>> {
    let mut used = UsedNames::new(&["x", "y", "z", "nx", "ny", "nz"]);
    let mut placed = Vec::new();
    for (attribute, purpose) in attributes.iter().zip(purposes(attributes)) {
        let VertexAttribute { name, arity, .. } = *attribute;
        let stem = plain_name(name);
        let (names, usual) = match purpose {
            Purpose::Color(_) => (used.take("", |stem| color_names(stem, arity)), color_names("", arity)),
            Purpose::Velocity => (used.take("v", velocity_names), velocity_names("v")),
            Purpose::Acceleration | Purpose::Other => {
                (used.take(&stem, |stem| component_names(stem, arity)), component_names(name, arity))
            }
        };
        let column = PlyAttribute { values: values_of(attribute, purpose, notes), names };
        if column.comments().len() > STRINGS_BYTES_MAX {
            notes.push(format!("{name} is missing in the .ply: its strings are too long for the header"));
            continue;
        }
        if column.names != usual {
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

fn values_of<'a>(
    attribute: &VertexAttribute<'a>,
    purpose: Purpose<'a>,
    notes: &mut Vec<String>,
) -> StoredValues<'a> {
    let name = attribute.name;
    match (attribute.values, purpose) {
        (_, Purpose::Color(values)) => {
            notes.extend(clamp_note(name, values, "the .ply"));
            StoredValues::Bytes(values)
        }
        (VertexValues::Numbers(values), _) => StoredValues::Floats(values),
        (VertexValues::Strings { table, indices }, _) => StoredValues::Strings(table, indices),
        (VertexValues::Integers(values), _) => {
            if values.iter().all(|&value| i32::try_from(value).is_ok()) {
                return StoredValues::Ints(values);
            }
            let rounded = values.iter().filter(|value| value.unsigned_abs() > EXACT_INTEGER_MAX).count();
            if rounded != 0 {
                notes.push(format!("{rounded} values of {name} are beyond ±2⁵³ and are rounded in the .ply; .vtp stores them exactly"));
            }
            StoredValues::Doubles(values)
        }
    }
}

/// The header comments that list the strings of a string attribute, each with its index.
fn string_comments(name: &str, table: &[String]) -> String {
    let line =
        |(index, text): (usize, &String)| format!("comment string {index} of {name}: {}\n", escape(text));
    table.iter().enumerate().map(line).collect()
}

impl PlyAttribute<'_> {
    /// The header lines that declare the properties.
    pub(super) fn properties(&self) -> String {
        let kind = match self.values {
            StoredValues::Floats(_) => "float",
            StoredValues::Bytes(_) => "uchar",
            StoredValues::Ints(_) | StoredValues::Strings(..) => "int",
            StoredValues::Doubles(_) => "double",
        };
        self.names.iter().map(|name| format!("property {kind} {name}\n")).collect()
    }

    /// The header comments with the strings to which the indices of a string attribute refer; empty for other
    /// attributes.
    pub(super) fn comments(&self) -> String {
        let StoredValues::Strings(table, _) = self.values else { return String::new() };
        string_comments(&self.names[0], table)
    }

    /// Appends the values of a vertex.
    fn append(&self, vertex: usize, bytes: &mut Vec<u8>) {
        let arity = self.names.len();
        let range = vertex * arity..(vertex + 1) * arity;
        match self.values {
            StoredValues::Floats(values) => {
                bytes.extend(values[range].iter().flat_map(|value| value.to_le_bytes()))
            }
            StoredValues::Bytes(values) => bytes.extend(values[range].iter().map(|&value| byte_of(value))),
            StoredValues::Ints(values) => {
                #[expect(clippy::cast_possible_truncation, reason = "all values were checked to fit")]
                bytes.extend(values[range].iter().flat_map(|&value| (value as i32).to_le_bytes()));
            }
            StoredValues::Doubles(values) => {
                bytes.extend(values[range].iter().flat_map(|&value| (value as f64).to_le_bytes()));
            }
            StoredValues::Strings(table, indices) => {
                bytes.extend(
                    indices[range].iter().flat_map(|&index| string_index(index, table).to_le_bytes()),
                );
            }
        }
    }
}

fn byte_of(value: f32) -> u8 {
    #[expect(clippy::cast_possible_truncation, reason = "clamped to the range of a byte")]
    let byte = (value.clamp(0.0, 1.0) * 255.0).round_ties_even() as u8;
    byte
}
