//! Binary USD, `.usdc`, the crate format of the AOUSD Core Specification 1.0, §16.3: writes the mesh of a frame, and
//! reads the layers of any program.
//!
//! ```text
//!   0    bootstrap     PXR-USDC, version 0.8.0, offset of the table of contents
//!   88   comment       the provenance, in the same form as in .ply
//!        arrays        points, normals, indices .., each at an offset that is a multiple of 8
//!        values        lists of names, dictionaries, time samples: refer to arrays by their offsets
//!        TOKENS STRINGS FIELDS FIELDSETS PATHS SPECS     what the layer contains: refer to values
//!        table of contents
//! ```
//!
//! No part of the format refers to the comment. The provenance is also in `customLayerData`, but this is in
//! compressed tables at the end of the file, which may have gigabytes, and `--skip-done` reads only the head
//! of a file.
//!
//! The tables are at the end, because OpenUSD overwrites everything from the first table on when it saves a
//! file that it opened.
//!
//! Integers are compressed in the same way as by OpenUSD. Vectors are not compressed, so that programs can
//! map them into memory.
//!
//! The file of a frame has each value twice, as the default and as a time sample, which refer to one array.
//! [Stages](crate::usd::usda::UsdStage) see only time samples; programs that know no times find the default.

mod array;
mod own;
mod read;
mod tables;

use std::io::Write;

use rayon::prelude::*;

pub use crate::usd::{LayerInfo, SampledProperty};
pub use own::{UsdcFrame, UsdcLayer, read_sampled_properties};
pub(crate) use read::{CrateFile, read_layer};

use crate::core::data::{
    AttributeRole, FileAttribute, MeshView, ParticleFrame, Provenance, Values, VertexAttribute, VertexValues,
};
use crate::core::error::Result;
use crate::core::limits::Limits;
use crate::core::narrow_points::NarrowPoints;
use crate::core::options::{MeshOptions, UpAxis, WriteOption};
use crate::core::placed_mesh::{PlacedMesh, StoredMesh};
use crate::core::provenance::{comments, from_comments};
use crate::core::row::{Content, FormatRow, Integrity, MeshEncoder, MeshWriter, OutputRow};
use crate::core::vertex_attributes::{ACCELERATION_NAME, COLOR_NAME};
use crate::core::vertex_attributes::{check_quads, plain_name, quad_count};
use crate::usd::mesh::read_alone;
use crate::usd::points::READER;
use crate::usd::usda::notes_of_points;
use crate::usd::{
    FORMAT, MeshProperty, POINTS_KIND, POINTS_PRIM, PropertyValue, ROOT, SAMPLE_CODE, point_properties,
    properties, renamed,
};
use array::{ALIGNMENT, CrateArray};
use tables::{
    BOOTSTRAP_BYTES, MAGIC, SpecType, Tables, ValueRep, ValueType, append_count, bootstrap, check_magic,
    claimed_bytes,
};

/// Notes on vertex attributes that a file does not hold exactly.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = renamed(attributes, "usdc");
    for attribute in attributes {
        if let VertexValues::Strings { table, .. } = attribute.values
            && table.iter().any(|text| text.contains('\0'))
        {
            notes.push(format!("{}: the .usdc stores null characters as \\x00", attribute.name));
        }
    }
    notes
}

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        signatures: &[MAGIC],
        beginnings: &[MAGIC],
        particles: Some(READER),
        read_mesh: Some(read_alone),
        ..FormatRow::new("binary USD", &["usdc"])
    },
    help: "Binary USD",
    content: Content::Mesh(MeshWriter { attribute_notes, ..MeshWriter::new(MeshEncoder::Stream(write)) }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Quads, WriteOption::Up, WriteOption::MetersPerUnit],
    read_provenance,
    integrity: Integrity::Length(claimed_bytes),
};

// Writes the mesh of one frame.
//
// The file starts with the offset of its last part, the table of contents. So the sizes of all arrays must
// be known, and all integers compressed, before the first byte is written. The compressed integers take
// little memory compared with the vectors, which are written directly from the mesh.

/// Writes a mesh.
///
/// # Errors
///
/// [`crate::Error::Io`] if `out` fails; [`crate::Error::Invalid`] if the mesh is inconsistent or not finite,
/// or if two triangles marked as a quad do not form one; [`crate::Error::TooLarge`] beyond 2³¹ vertices.
fn write(mesh: &MeshView, options: &MeshOptions, provenance: &Provenance, out: &mut dyn Write) -> Result<()> {
    mesh.check(FORMAT)?;
    check_quads(FORMAT, mesh.triangles, &options.quads)?;
    let layer = LayerHead {
        provenance,
        info: Some(LayerInfo {
            vertices: mesh.positions.len() as u64,
            faces: (mesh.triangles.len() - quad_count(&options.quads)) as u64,
        }),
        up: options.up,
        meters_per_unit: options.meters_per_unit,
    };
    let prim = (MESH_KIND, &*plain_name(&options.name));
    write_layer(prim, &properties(mesh, &options.quads, true), &layer, out)
}

/// The type of the prim of a mesh.
const MESH_KIND: &str = "Mesh";

/// Writes particles as a prim of the type `Points`.
///
/// # Errors
///
/// [`crate::Error::Io`] if `out` fails; [`crate::Error::Invalid`] if an attribute has the wrong number of values, or a
/// position is not finite; [`crate::Error::TooLarge`] beyond the limits of the format.
pub fn write_particles(
    frame: &ParticleFrame,
    options: &MeshOptions,
    provenance: &Provenance,
    out: &mut dyn Write,
) -> Result<()> {
    let points = NarrowPoints::of(frame, FORMAT)?;
    let layer =
        LayerHead { provenance, info: None, up: options.up, meters_per_unit: options.meters_per_unit };
    let prim = (POINTS_KIND, POINTS_PRIM);
    write_layer(prim, &point_properties(&points, &points.others(), true), &layer, out)
}

/// Notes on attributes that a file does not hold exactly.
pub fn particle_notes(frame: &ParticleFrame) -> Vec<String> {
    notes_of_points(frame, "usdc")
}

/// Writes a layer with one prim of this type and name, which has these properties.
fn write_layer(
    (kind, name): (&'static str, &str),
    found: &[MeshProperty],
    layer: &LayerHead,
    out: &mut dyn Write,
) -> Result<()> {
    let arrays: Vec<Option<CrateArray>> = found.par_iter().map(array_of).collect::<Result<_>>()?;

    let mut at = head(layer.provenance, 0).len() as u64;
    let mut spans = Vec::new();
    for array in &arrays {
        let padding = padding(at);
        at += padding.len() as u64;
        spans.push((padding, at));
        at += array.as_ref().map_or(0, CrateArray::byte_count);
    }
    let mut end = LayerEnd::at(at);
    let mut specs = Vec::new();
    for ((property, array), (_, offset)) in found.iter().zip(&arrays).zip(&spans) {
        let value = match array {
            Some(array) => array.rep(*offset),
            None => value_of(property, &mut end)?,
        };
        specs.push(spec(property, value));
    }
    let (end, contents_at) = end.finish(layer, &PrimSpec { kind, name, properties: specs })?;
    out.write_all(&head(layer.provenance, contents_at))?;
    for (array, (padding, _)) in arrays.iter().zip(spans) {
        out.write_all(padding)?;
        array.iter().try_for_each(|array| array.write(out))?;
    }
    Ok(out.write_all(&end)?)
}

/// The array of a property, if it has one that is written before the tables.
fn array_of<'a>(property: &MeshProperty<'a>) -> Result<Option<CrateArray<'a>>> {
    match property.value {
        PropertyValue::Array(elements) => CrateArray::of(elements).map(Some),
        _ => Ok(None),
    }
}

/// The value of a property that refers to tokens, or has only a few numbers.
fn value_of(property: &MeshProperty, end: &mut LayerEnd) -> Result<ValueRep> {
    match &property.value {
        PropertyValue::Array(elements) => end.array(&CrateArray::of(*elements)?),
        PropertyValue::Extent(corners) => end.array(&CrateArray::of_vectors(corners.as_flattened())),
        PropertyValue::Double3(values) => Ok(end.double3(*values)),
        PropertyValue::Token(word) => Ok(end.tables.token_value(word)),
        PropertyValue::TokenList(word) => {
            let words = [end.tables.token(word)];
            end.array(&CrateArray::of_indices(ValueType::Token, &words))
        }
        PropertyValue::StringTable(table) => string_table(table, end),
    }
}

/// The value of the table of an indexed primvar.
fn string_table(table: &[String], end: &mut LayerEnd) -> Result<ValueRep> {
    let texts = table.iter().map(String::as_str).chain([""]);
    let indices: Vec<u32> = texts.map(|text| end.tables.string(text)).collect();
    end.array(&CrateArray::of_indices(ValueType::String, &indices))
}

fn spec(property: &MeshProperty, value: ValueRep) -> PropertySpec {
    PropertySpec {
        kind: property.kind.clone(),
        name: property.name.clone(),
        value: if property.is_uniform() { SpecValue::Always(value) } else { SpecValue::Frame(value) },
        is_uniform: property.is_uniform(),
        interpolation: property.interpolation,
        element_size: property.element_size,
    }
}

// Reads the mesh of a file with one frame.

/// Whether a file that starts with these bytes is binary USD.
pub fn is_layer(head: &[u8]) -> bool {
    head.starts_with(MAGIC)
}

/// Reads the mesh of a file of this crate with one frame, as it was before it was written.
///
/// # Errors
///
/// Those of [`UsdcLayer::read`] and [`UsdcLayer::frame`].
pub(crate) fn read_stored(bytes: &[u8], limits: &Limits) -> Result<StoredMesh> {
    let provenance = read_provenance(bytes)?;
    let (mesh, up) = UsdcLayer::read(bytes, limits)?.placed_frame()?;
    let attributes = as_before(mesh.attributes);
    Ok(StoredMesh { mesh: PlacedMesh { attributes, ..mesh }, up, provenance })
}

/// The attributes under the names and with the types that they had before they were written. The names of
/// colours and accelerations are not in the file, so they get the usual ones.
pub(crate) fn as_before(mut attributes: Vec<FileAttribute>) -> Vec<FileAttribute> {
    merge_opacity(&mut attributes);
    for FileAttribute { name, role, values, .. } in &mut attributes {
        match values {
            Values::I32(integers) => *values = Values::I64(integers.iter().map(|&i| i.into()).collect()),
            // The last string marks missing values. Without it, their index is outside the table.
            Values::Strings { table, .. } => drop(table.pop()),
            Values::F32(_) | Values::F64(_) | Values::U8(_) | Values::I64(_) => {}
        }
        match role {
            Some(AttributeRole::Color) => *name = COLOR_NAME.to_owned(),
            Some(AttributeRole::Acceleration) => *name = ACCELERATION_NAME.to_owned(),
            // USD writes an underscore before the digit of a name such as `2nd`.
            _ if name.starts_with('_') && name[1..].starts_with(|c: char| c.is_ascii_digit()) => {
                name.remove(0);
            }
            _ => {}
        }
    }
    attributes
}

/// Makes the opacity the fourth value of the colour, as it was before it was written.
fn merge_opacity(attributes: &mut Vec<FileAttribute>) {
    let position = |name: &str, arity: usize| {
        attributes.iter().position(|attribute| attribute.name == name && attribute.arity == arity)
    };
    let Some((color, opacity)) = position("displayColor", 3).zip(position("displayOpacity", 1)) else {
        return;
    };
    let (Values::F32(colors), Values::F32(opacities)) =
        (&attributes[color].values, &attributes[opacity].values)
    else {
        return;
    };
    let pairs = colors.as_chunks::<3>().0.iter().zip(opacities);
    let values = pairs.flat_map(|(&[red, green, blue], &opacity)| [red, green, blue, opacity]).collect();
    attributes[color].arity = 4;
    attributes[color].values = Values::F32(values);
    attributes.remove(opacity);
}

// The beginning of a file, and the prim that refers to its arrays.

/// The offset of the comment with the provenance.
const COMMENT_AT: usize = BOOTSTRAP_BYTES;

/// The start of each of its lines.
const COMMENT: &str = "# ";

/// The bytes before the first array.
fn head(provenance: &Provenance, contents_at: u64) -> Vec<u8> {
    let mut bytes = bootstrap(contents_at).to_vec();
    bytes.extend_from_slice(comments(provenance, COMMENT).as_bytes());
    bytes.extend_from_slice(b"end_header\n");
    bytes
}

/// The provenance in the first bytes of a file.
pub(crate) fn read_provenance(head: &[u8]) -> Result<Vec<(String, String)>> {
    check_magic(head)?;
    Ok(from_comments(head.get(COMMENT_AT..).unwrap_or_default(), COMMENT))
}

/// The zeros that are inserted before an array.
#[expect(clippy::cast_possible_truncation, reason = "fewer than the alignment")]
fn padding(at: u64) -> &'static [u8] {
    &[0; ALIGNMENT as usize][..(at.next_multiple_of(ALIGNMENT) - at) as usize]
}

/// The metadata of the layer.
struct LayerHead<'a> {
    provenance: &'a Provenance,
    /// `None` for points.
    info: Option<LayerInfo>,
    up: UpAxis,
    meters_per_unit: f64,
}

/// The prim of a mesh or of points.
struct PrimSpec<'a> {
    /// Its type.
    kind: &'static str,
    name: &'a str,
    properties: Vec<PropertySpec>,
}

/// A property of a prim.
struct PropertySpec {
    kind: String,
    name: String,
    value: SpecValue,
    is_uniform: bool,
    interpolation: Option<&'static str>,
    element_size: usize,
}

/// Where the value of a property is.
enum SpecValue {
    Always(ValueRep),
    /// The value of a frame: the default, and a sample for stages, which see nothing but samples. Both refer
    /// to the same array.
    Frame(ValueRep),
}

/// The end of a file under construction: values, and the tables that refer to them.
struct LayerEnd {
    base: u64,
    values: Vec<u8>,
    tables: Tables,
}

impl LayerEnd {
    /// Starts at this offset of the file.
    fn at(base: u64) -> LayerEnd {
        let mut tables = Tables::default();
        tables.token(ROOT); // no property may be named by token 0: see `Tables::append_paths`
        LayerEnd { base, values: Vec::new(), tables }
    }

    fn offset(&self) -> u64 {
        self.base + self.values.len() as u64
    }

    /// The representation of a number, which is inlined if a 32-bit float holds it exactly.
    #[expect(clippy::cast_possible_truncation, reason = "compared with the value afterwards")]
    fn double(&mut self, value: f64) -> ValueRep {
        if f64::from(value as f32) == value {
            return ValueRep::inlined(ValueType::Double, (value as f32).to_bits());
        }
        let rep = ValueRep::at(ValueType::Double, self.offset());
        self.values.extend_from_slice(&value.to_le_bytes());
        rep
    }

    fn int64(&mut self, value: u64) -> ValueRep {
        if let Ok(value) = i32::try_from(value) {
            return ValueRep::inlined(ValueType::Int64, value.cast_unsigned());
        }
        let rep = ValueRep::at(ValueType::Int64, self.offset());
        self.values.extend_from_slice(&value.to_le_bytes());
        rep
    }

    fn double3(&mut self, value: [f64; 3]) -> ValueRep {
        let rep = ValueRep::at(ValueType::Vec3d, self.offset());
        value.iter().for_each(|part| self.values.extend_from_slice(&part.to_le_bytes()));
        rep
    }

    /// An array, written among the values.
    fn array(&mut self, array: &CrateArray) -> Result<ValueRep> {
        self.values.extend_from_slice(padding(self.offset()));
        let rep = array.rep(self.offset());
        array.write(&mut self.values)?;
        Ok(rep)
    }

    /// A list of the names of children.
    fn names<'a>(&mut self, names: impl ExactSizeIterator<Item = &'a str>) -> ValueRep {
        let rep = ValueRep::at(ValueType::TokenVector, self.offset());
        append_count(names.len(), &mut self.values);
        for name in names {
            let token = self.tables.token(name);
            self.values.extend_from_slice(&token.to_le_bytes());
        }
        rep
    }

    fn dictionary(&mut self, entries: &[(&str, ValueRep)]) -> ValueRep {
        let rep = ValueRep::at(ValueType::Dictionary, self.offset());
        append_count(entries.len(), &mut self.values);
        for (key, value) in entries {
            let key = self.tables.string(key);
            self.values.extend_from_slice(&key.to_le_bytes());
            self.append_here(*value);
        }
        rep
    }

    /// Appends an offset and the value that it leads to. The offset is relative to its own position: it is 8,
    /// because nothing is in between. OpenUSD stores nested values in between.
    fn append_here(&mut self, value: ValueRep) {
        self.values.extend_from_slice(&8_i64.to_le_bytes());
        self.values.extend_from_slice(&value.0.to_le_bytes());
    }

    /// The time samples of a value: one, at [`SAMPLE_CODE`].
    fn sample(&mut self, value: ValueRep) -> ValueRep {
        let times = ValueRep::at(ValueType::DoubleVector, self.offset());
        append_count(1, &mut self.values);
        self.values.extend_from_slice(&(SAMPLE_CODE as f64).to_le_bytes());
        let rep = ValueRep::at(ValueType::TimeSamples, self.offset());
        self.append_here(times);
        self.values.extend_from_slice(&8_i64.to_le_bytes());
        append_count(1, &mut self.values);
        self.values.extend_from_slice(&value.0.to_le_bytes());
        rep
    }

    fn custom_data(&mut self, head: &LayerHead) -> ValueRep {
        let mut provenance = Vec::new();
        for (key, value) in head.provenance {
            let value = ValueRep::inlined(ValueType::String, self.tables.string(value));
            provenance.push((key.as_str(), value));
        }
        let provenance = self.dictionary(&provenance);
        let Some(LayerInfo { vertices, faces }) = head.info else {
            return self.dictionary(&[("meniscus", provenance)]);
        };
        let counts = [("faces", self.int64(faces)), ("vertices", self.int64(vertices))];
        let counts = self.dictionary(&counts);
        self.dictionary(&[("meniscus", provenance), ("meniscus_mesh", counts)])
    }

    /// Adds the prim and its properties; returns the bytes, and the offset of the table of contents.
    ///
    /// # Errors
    ///
    /// [`crate::Error::TooLarge`] if the tables exceed the format's limits.
    fn finish(mut self, head: &LayerHead, prim: &PrimSpec) -> Result<(Vec<u8>, u64)> {
        let up = match head.up {
            UpAxis::Y => "Y",
            UpAxis::Z => "Z",
        };
        let fields = [
            ("customLayerData", self.custom_data(head)),
            ("defaultPrim", self.tables.token_value(ROOT)),
            ("metersPerUnit", self.double(head.meters_per_unit)),
            ("primChildren", self.names([ROOT].into_iter())),
            ("upAxis", self.tables.token_value(up)),
        ];
        self.tables.add_spec("", SpecType::PseudoRoot, &fields);
        let specifier = ValueRep::inlined(ValueType::Specifier, 0); // def
        let kind = self.tables.token_value("Xform");
        let children = self.names([prim.name].into_iter());
        let fields = [("specifier", specifier), ("typeName", kind), ("primChildren", children)];
        self.tables.add_spec(ROOT, SpecType::Prim, &fields);
        let PrimSpec { kind, name, properties } = prim;
        let kind = self.tables.token_value(kind);
        let names = self.names(properties.iter().map(|property| property.name.as_str()));
        let fields = [("specifier", specifier), ("typeName", kind), ("properties", names)];
        self.tables.add_spec(name, SpecType::Prim, &fields);
        for property in properties {
            self.add_property(property)?;
        }
        let LayerEnd { base, mut values, tables } = self;
        let contents_at = tables.append(base, &mut values)?;
        Ok((values, contents_at))
    }

    fn add_property(&mut self, property: &PropertySpec) -> Result<()> {
        let PropertySpec { kind, name, value, is_uniform, interpolation, element_size } = property;
        let mut fields = vec![
            ("typeName", self.tables.token_value(kind)),
            ("custom", ValueRep::inlined(ValueType::Bool, 0)),
            ("variability", ValueRep::inlined(ValueType::Variability, u32::from(*is_uniform))),
        ];
        match value {
            SpecValue::Always(value) => fields.push(("default", *value)),
            SpecValue::Frame(value) => {
                let sample = self.sample(*value);
                fields.extend([("default", *value), ("timeSamples", sample)]);
            }
        }
        if let Some(interpolation) = interpolation {
            fields.push(("interpolation", self.tables.token_value(interpolation)));
        }
        if *element_size != 1 {
            let size = array::index(*element_size)?.cast_unsigned();
            fields.push(("elementSize", ValueRep::inlined(ValueType::Int, size)));
        }
        self.tables.add_spec(name, SpecType::Attribute, &fields);
        Ok(())
    }
}
