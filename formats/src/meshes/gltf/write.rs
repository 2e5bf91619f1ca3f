//! Writes a triangle mesh as glTF.
//!
//! Vertices are written unchanged. The node stores the placement: its translation is the mesh's origin in
//! 64 bits, and its rotation turns Z up into glTF's Y up.

use std::io::Write;

use base64::engine::general_purpose::STANDARD;
use base64::write::EncoderWriter;
use serde::ser::SerializeMap;
use serde::{Serialize, Serializer};

use super::frame_file::{ACCELERATION, COLOR, TEXTURE, VELOCITY, flipped};
use super::{CHUNK_BIN, CHUNK_JSON, FORMAT, GLB_MAGIC, GLB_VERSION, component};
use crate::core::data::{MeshView, Provenance, VertexAttribute, VertexValues, bounds_of};
use crate::core::error::{Error, Position, Result};
use crate::core::number::{write_f32s, write_pieces};
use crate::core::options::{MeshOptions, UpAxis};
use crate::core::provenance::GENERATOR;
use crate::core::vertex_attributes::{ACCELERATION_NAME, COLOR_NAME, TEXTURE_NAME};
use crate::core::vertex_attributes::{Purpose, UsedNames, plain_name, purposes, string_index};

/// Writes a `.glb` file. A mesh without triangles becomes an empty scene.
///
/// # Errors
///
/// [`Error::Io`] if `out` fails; [`Error::TooLarge`] if the file would reach 4 GiB;
/// [`Error::Invalid`] if the mesh is inconsistent or not finite.
pub fn write_glb(
    mesh: &MeshView,
    options: &MeshOptions,
    provenance: &Provenance,
    out: &mut dyn Write,
) -> Result<()> {
    mesh.check(FORMAT)?;
    let layout = BufferLayout::of(mesh);
    let mut json = to_json(&Document::new(mesh, &layout, options, provenance, None))?;
    json.resize(json.len().next_multiple_of(4), b' ');
    let bin_bytes = layout.byte_count().next_multiple_of(4);
    let Some(total) = glb_bytes(json.len() as u64, bin_bytes) else { return Err(too_large(mesh)) };

    out.write_all(&GLB_MAGIC)?;
    for number in [GLB_VERSION, total] {
        out.write_all(&number.to_le_bytes())?;
    }
    write_chunk_head(json.len() as u64, CHUNK_JSON, out)?;
    out.write_all(&json)?;
    if bin_bytes != 0 {
        write_chunk_head(bin_bytes, CHUNK_BIN, out)?;
        layout.write_buffer(mesh, out)?;
        for _ in layout.byte_count()..bin_bytes {
            out.write_all(&[0])?;
        }
    }
    Ok(())
}

/// Writes a `.gltf` file with its buffer as an embedded data URI.
///
/// # Errors
///
/// Those of [`write_glb`]. The limit of 4 GiB for the buffer applies here too: no reader supports longer
/// strings.
pub fn write_gltf(
    mesh: &MeshView,
    options: &MeshOptions,
    provenance: &Provenance,
    out: &mut dyn Write,
) -> Result<()> {
    const URI: &str = "data:application/octet-stream;base64,";
    mesh.check(FORMAT)?;
    let layout = BufferLayout::of(mesh);
    if u32::try_from(layout.byte_count()).is_err() {
        return Err(too_large(mesh));
    }
    let json = to_json(&Document::new(mesh, &layout, options, provenance, Some(URI)))?;
    // The URI is the last string of the document. Its data is still missing, and is inserted at `end`.
    let end = match layout.byte_count() {
        0 => json.len(),
        _ => json
            .windows(URI.len())
            .rposition(|part| part == URI.as_bytes())
            .map_or(json.len(), |at| at + URI.len()),
    };
    out.write_all(&json[..end])?;
    if end < json.len() {
        let mut encoder = EncoderWriter::new(&mut *out, &STANDARD);
        layout.write_buffer(mesh, &mut encoder)?;
        encoder.finish()?;
    }
    out.write_all(&json[end..])?;
    out.write_all(b"\n")?;
    Ok(())
}

/// The size of a `.glb` with chunks of these sizes, if it fits into 32 bits.
pub(super) fn glb_bytes(json_bytes: u64, bin_bytes: u64) -> Option<u32> {
    const HEADER_BYTES: u64 = 12;
    const CHUNK_HEAD_BYTES: u64 = 8;
    let bin = if bin_bytes == 0 { 0 } else { CHUNK_HEAD_BYTES + bin_bytes };
    u32::try_from(HEADER_BYTES + CHUNK_HEAD_BYTES + json_bytes + bin).ok()
}

fn too_large(mesh: &MeshView) -> Error {
    let (vertices, triangles) = (mesh.positions.len(), mesh.triangles.len());
    let what = format!(
        "{vertices} vertices and {triangles} triangles take 4 GiB or more, the limit of the format: \
         write .ply, or use a larger voxel size"
    );
    Error::too_large(FORMAT, what)
}

pub(super) fn write_chunk_head(byte_count: u64, kind: [u8; 4], out: &mut dyn Write) -> Result<()> {
    let length = u32::try_from(byte_count).unwrap_or(u32::MAX); // fits, because the size of the file does
    out.write_all(&length.to_le_bytes())?;
    out.write_all(&kind)?;
    Ok(())
}

fn to_json(document: &Document) -> Result<Vec<u8>> {
    serde_json::to_vec(document).map_err(|error| Error::invalid(FORMAT, Position::File, error.to_string()))
}

/// The parts of the buffer: positions, normals, attributes, indices.
struct BufferLayout<'a> {
    vertex_count: usize,
    attributes: Vec<GltfAttribute<'a>>,
    index_bytes: u64,
    index_component: u32,
}

impl<'a> BufferLayout<'a> {
    fn of(mesh: &MeshView<'a>) -> BufferLayout<'a> {
        if mesh.triangles.is_empty() {
            let (attributes, index_component) = (Vec::new(), component::U16);
            return BufferLayout { vertex_count: 0, attributes, index_bytes: 0, index_component };
        }
        // The index 65535 itself is forbidden, so 16-bit indices allow at most 65535 vertices.
        let narrow = mesh.positions.len() <= usize::from(u16::MAX);
        BufferLayout {
            vertex_count: mesh.positions.len(),
            attributes: assign_names(mesh.attributes, &mut Vec::new()),
            index_bytes: 3 * mesh.triangles.len() as u64 * if narrow { 2 } else { 4 },
            index_component: if narrow { component::U16 } else { component::U32 },
        }
    }

    /// The number of values per vertex of positions, normals and attributes, in order.
    fn arities(&self) -> impl Iterator<Item = usize> {
        [3, 3].into_iter().chain(self.attributes.iter().map(|attribute| attribute.arity))
    }

    fn column_bytes(&self, arity: usize) -> u64 {
        4 * (arity * self.vertex_count) as u64
    }

    fn byte_count(&self) -> u64 {
        self.arities().map(|arity| self.column_bytes(arity)).sum::<u64>() + self.index_bytes
    }

    fn write_buffer(&self, mesh: &MeshView, out: &mut dyn Write) -> Result<()> {
        write_f32s(mesh.positions.as_flattened(), out)?;
        write_f32s(mesh.normals.as_flattened(), out)?;
        for attribute in &self.attributes {
            attribute.write(out)?;
        }
        let indices = mesh.triangles.as_flattened();
        if self.index_component == component::U16 {
            #[expect(clippy::cast_possible_truncation, reason = "16 bits hold the number of vertices")]
            write_pieces(indices, |index| (index as u16).to_le_bytes(), out)
        } else {
            write_pieces(indices, u32::to_le_bytes, out)
        }
    }
}

/// The document, in the order of writing: `asset` first, so that the provenance is in the head of the file,
/// and `buffers` last, so that the data of a `.gltf` comes after everything else.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Document<'a> {
    asset: Asset<'a>,
    scene: usize,
    scenes: [GltfScene<'a>; 1],
    #[serde(skip_serializing_if = "Vec::is_empty")]
    nodes: Vec<WrittenNode<'a>>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    meshes: Vec<GltfMesh<'a>>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    accessors: Vec<Accessor>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    buffer_views: Vec<BufferView>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    buffers: Vec<Buffer>,
}

#[derive(Serialize)]
struct Asset<'a> {
    version: &'static str,
    generator: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    extras: Option<Extras<'a>>,
}

#[derive(Serialize)]
struct GltfScene<'a> {
    name: &'a str,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    nodes: Vec<usize>,
}

#[derive(Serialize)]
struct WrittenNode<'a> {
    name: &'a str,
    mesh: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    translation: Option<[f64; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rotation: Option<[f64; 4]>,
}

#[derive(Serialize)]
struct GltfMesh<'a> {
    name: &'a str,
    primitives: [GltfPrimitive<'a>; 1],
    #[serde(skip_serializing_if = "Option::is_none")]
    extras: Option<MeshExtras<'a>>,
}

#[derive(Serialize)]
struct GltfPrimitive<'a> {
    attributes: Entries<&'a str, usize>,
    indices: usize,
    mode: u32,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: usize,
    component_type: u32,
    count: usize,
    r#type: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    min: Option<[f32; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    max: Option<[f32; 3]>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct BufferView {
    buffer: usize,
    byte_offset: u64,
    byte_length: u64,
    target: u32,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Buffer {
    byte_length: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    uri: Option<&'static str>,
}

/// The entries of this program. Their name separates them from entries that other programs may add.
#[derive(Serialize)]
struct Extras<'a> {
    meniscus: Entries<&'a str, &'a str>,
}

#[derive(Serialize)]
struct MeshExtras<'a> {
    #[serde(skip_serializing_if = "Entries::is_empty")]
    meniscus: Entries<&'a str, &'a str>,
    /// The strings that attribute values are indices into.
    #[serde(skip_serializing_if = "Entries::is_empty")]
    strings: Entries<&'a str, &'a [String]>,
    /// The names of attributes that do not follow from those in glTF.
    #[serde(skip_serializing_if = "Entries::is_empty")]
    names: Entries<&'a str, &'a str>,
}

/// Names and values, serialized in this order.
struct Entries<K, V>(Vec<(K, V)>);

impl<K, V> Entries<K, V> {
    fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl<K: Serialize, V: Serialize> Serialize for Entries<K, V> {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        for (key, value) in &self.0 {
            map.serialize_entry(key, value)?;
        }
        map.end()
    }
}

fn provenance_entries(provenance: &Provenance) -> Entries<&str, &str> {
    Entries(provenance.iter().map(|(key, value)| (key.as_str(), value.as_str())).collect())
}

impl<'a> Document<'a> {
    fn new(
        mesh: &MeshView,
        layout: &'a BufferLayout,
        options: &'a MeshOptions,
        provenance: &'a Provenance,
        uri: Option<&'static str>,
    ) -> Document<'a> {
        let name = options.name.as_str();
        let extras = (!provenance.is_empty()).then(|| Extras { meniscus: provenance_entries(provenance) });
        let mut document = Document {
            asset: Asset { version: "2.0", generator: GENERATOR, extras },
            scene: 0,
            scenes: [GltfScene { name, nodes: Vec::new() }],
            nodes: Vec::new(),
            meshes: Vec::new(),
            accessors: Vec::new(),
            buffer_views: Vec::new(),
            buffers: Vec::new(),
        };
        if mesh.triangles.is_empty() {
            return document; // glTF does not allow empty accessors and buffers, and an empty node is useless
        }
        let semantics = layout.attributes.iter().map(|attribute| attribute.semantic.as_str());
        let attributes: Vec<(&str, usize)> =
            ["POSITION", "NORMAL"].into_iter().chain(semantics).zip(0..).collect();
        let indices = attributes.len();
        let primitive = GltfPrimitive { attributes: Entries(attributes), indices, mode: MODE_TRIANGLES };
        let strings = |attribute: &'a GltfAttribute| Some((attribute.semantic.as_str(), attribute.table()?));
        let strings = Entries(layout.attributes.iter().filter_map(strings).collect());
        let name_of = |attribute: &'a GltfAttribute| {
            Some((attribute.semantic.as_str(), attribute.own_name.as_deref()?))
        };
        let names = Entries(layout.attributes.iter().filter_map(name_of).collect());
        let extras = MeshExtras { meniscus: provenance_entries(provenance), strings, names };
        let has_extras =
            !extras.meniscus.is_empty() || !extras.strings.is_empty() || !extras.names.is_empty();
        let extras = has_extras.then_some(extras);
        document.scenes[0].nodes.push(0);
        document.nodes.push(node(name, mesh.origin, options.up));
        document.meshes.push(GltfMesh { name, primitives: [primitive], extras });
        document.accessors = accessors(mesh, layout);
        document.buffer_views = layout.views();
        document.buffers.push(Buffer { byte_length: layout.byte_count(), uri });
        document
    }
}

/// The node that places the mesh: it adds the mesh's origin, and turns Z up into Y up. glTF rotates before it
/// translates, so the translation is the rotated origin.
fn node(name: &str, origin: [f64; 3], up: UpAxis) -> WrittenNode<'_> {
    const HALF_SQRT: f64 = std::f64::consts::FRAC_1_SQRT_2;
    // -0.0 becomes 0.0.
    let [x, y, z] = origin.map(|coordinate| coordinate + 0.0);
    let (translation, rotation) = match up {
        UpAxis::Y => ([x, y, z], None),
        UpAxis::Z => ([x, z, 0.0 - y], Some([-HALF_SQRT, 0.0, 0.0, HALF_SQRT])),
    };
    let translation = (origin != [0.0; 3]).then_some(translation);
    WrittenNode { name, mesh: 0, translation, rotation }
}

fn accessors(mesh: &MeshView, layout: &BufferLayout) -> Vec<Accessor> {
    let [min, max] = bounds_of(mesh.positions).unwrap_or_default();
    let vertices = |(buffer_view, arity): (usize, usize)| Accessor {
        buffer_view,
        component_type: component::F32,
        count: mesh.positions.len(),
        r#type: TYPE_OF_ARITY[arity - 1],
        min: None,
        max: None,
    };
    let mut accessors: Vec<Accessor> = layout.arities().enumerate().map(vertices).collect();
    (accessors[0].min, accessors[0].max) = (Some(min), Some(max));
    accessors.push(Accessor {
        buffer_view: accessors.len(),
        component_type: layout.index_component,
        count: 3 * mesh.triangles.len(),
        r#type: TYPE_OF_ARITY[0],
        min: None,
        max: None,
    });
    accessors
}

impl BufferLayout<'_> {
    fn views(&self) -> Vec<BufferView> {
        let mut end = 0;
        let mut view = |byte_length, target| {
            let byte_offset = end;
            end += byte_length;
            BufferView { buffer: 0, byte_offset, byte_length, target }
        };
        let mut views: Vec<BufferView> =
            self.arities().map(|arity| view(self.column_bytes(arity), TARGET_VERTICES)).collect();
        views.push(view(self.index_bytes, TARGET_INDICES));
        views
    }
}

/// The names of vectors with one to four components.
const TYPE_OF_ARITY: [&str; 4] = ["SCALAR", "VEC2", "VEC3", "VEC4"];

const MODE_TRIANGLES: u32 = 4;
const TARGET_VERTICES: u32 = 34962;
const TARGET_INDICES: u32 = 34963;

// How glTF stores vertex attributes.
//
//   colour     COLOR_0      three or four floats, linear according to the specification
//   velocity   _VELOCITY    three floats, in the axes of the positions
//   acceleration  _ACCELERATION, likewise
//   texture coordinates  TEXCOORD_0  two floats: v is 1 − v, because the origin of a picture is its upper left
//              corner
//   others     _NAME        one to four floats; integers of up to 24 bits are exact
//   strings    _NAME        an index into the list `extras.strings._NAME` of the mesh; −1 for none
//
// Where the plain name of an attribute differs from the [usual one](usual_name), it is in `extras.names` of
// the mesh, so that sequences have the names that the files of single frames have.
//
// All values are 32-bit floats, because the format requires elements of a multiple of four bytes and has no
// 32-bit integers for vertices. Floats are stored exactly. An attribute with integers that would be rounded
// is omitted with a note: a wrong identity is worse than a missing one.

/// Integers up to this magnitude are exact as 32-bit floats.
const EXACT_INTEGER_MAX: u64 = 1 << 24;
/// Number of components of the widest vector.
const ARITY_MAX: usize = 4;

/// An attribute that can be stored.
struct GltfAttribute<'a> {
    /// Its glTF name.
    pub(super) semantic: String,
    /// Its [plain name](plain_name), if it differs from the [usual one](usual_name). Velocities have none:
    /// formats have a property for them.
    pub(super) own_name: Option<String>,
    /// Number of values per vertex, one to four.
    pub(super) arity: usize,
    values: VertexValues<'a>,
}

/// Notes on vertex attributes that a glTF file cannot store exactly.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = Vec::new();
    let placed = assign_names(attributes, &mut notes);
    let mut arities =
        placed.iter().filter(|placed| placed.semantic.starts_with('_')).map(|placed| placed.arity);
    let first = arities.next();
    if arities.any(|arity| Some(arity) != first) {
        notes.push(
            "the glTF file has both vector and scalar attributes, on which Blender's importer fails before 5.1: select \
             only vector or only scalar attributes, or use .ply"
                .into(),
        );
    }
    notes
}

/// Notes on attributes that a file does not have, or under other names.
pub(crate) fn naming_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = Vec::new();
    assign_names(attributes, &mut notes);
    notes
}

fn assign_names<'a>(attributes: &[VertexAttribute<'a>], notes: &mut Vec<String>) -> Vec<GltfAttribute<'a>> {
    let mut used = UsedNames::new(&[]);
    let mut placed = Vec::new();
    for (attribute, purpose) in attributes.iter().zip(purposes(attributes)) {
        let VertexAttribute { name, arity, values, .. } = *attribute;
        if let Some(why) = obstacle(attribute) {
            notes.push(format!("{name} is missing in the glTF file: {why}"));
            continue;
        }
        let (stem, usual) = match purpose {
            Purpose::Color(_) => (COLOR.into(), COLOR.into()),
            Purpose::Velocity => (VELOCITY.into(), VELOCITY.into()),
            Purpose::Acceleration => (ACCELERATION.into(), ACCELERATION.into()),
            Purpose::Texture => (TEXTURE.into(), TEXTURE.into()),
            Purpose::Other => (format!("_{}", plain_name(name)), format!("_{name}")),
        };
        let semantic = used.take(&stem.to_ascii_uppercase());
        if semantic != usual.to_ascii_uppercase() {
            notes.push(format!("{name} is named {semantic} in the glTF file"));
        }
        let own_name = Some(plain_name(name));
        let own_name = own_name.filter(|own| purpose != Purpose::Velocity && *own != usual_name(&semantic));
        placed.push(GltfAttribute { semantic, own_name, arity, values });
    }
    placed
}

/// The name of most attributes with this glTF name: glTF names start with an underscore and are in upper
/// case.
pub(super) fn usual_name(semantic: &str) -> String {
    match semantic {
        COLOR => COLOR_NAME.to_owned(),
        ACCELERATION => ACCELERATION_NAME.to_owned(),
        TEXTURE => TEXTURE_NAME.to_owned(),
        _ => semantic.strip_prefix('_').unwrap_or(semantic).to_ascii_lowercase(),
    }
}

/// Why an attribute cannot be stored; `None` if it can.
fn obstacle(attribute: &VertexAttribute) -> Option<String> {
    if attribute.arity > ARITY_MAX {
        return Some(format!("it has {} values per vertex; the limit is {ARITY_MAX}", attribute.arity));
    }
    let VertexValues::Integers(values) = attribute.values else { return None };
    let beyond = values.iter().filter(|value| value.unsigned_abs() > EXACT_INTEGER_MAX).count();
    (beyond != 0).then(|| {
        format!("values beyond ±{EXACT_INTEGER_MAX}, where 32-bit floats are not exact: {beyond}; use .ply")
    })
}

impl<'a> GltfAttribute<'a> {
    /// The strings that its values are indices into.
    pub(super) fn table(&self) -> Option<&'a [String]> {
        match self.values {
            VertexValues::Strings { table, .. } => Some(table),
            VertexValues::Numbers(_) | VertexValues::Integers(_) => None,
        }
    }

    pub(super) fn write(&self, out: &mut dyn Write) -> Result<()> {
        match self.values {
            VertexValues::Numbers(values) if self.semantic == TEXTURE => {
                let bytes_of = |row: [f32; 2]| {
                    let [[a, b, c, d], [e, f, g, h]] = flipped(row).map(f32::to_le_bytes);
                    [a, b, c, d, e, f, g, h]
                };
                write_pieces(values.as_chunks().0, bytes_of, out)
            }
            VertexValues::Numbers(values) => write_f32s(values, out),
            VertexValues::Integers(values) => write_pieces(values, |value| (value as f32).to_le_bytes(), out),
            VertexValues::Strings { table, indices } => {
                let to_bytes = |index| (string_index(index, table) as f32).to_le_bytes();
                write_pieces(indices, to_bytes, out)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn glb_of_four_gibibytes_is_too_large() {
        assert_eq!(glb_bytes(1000, 0), Some(1020));
        assert_eq!(glb_bytes(1000, u64::from(u32::MAX) - 1031), Some(u32::MAX - 3));
        assert_eq!(glb_bytes(1000, u64::from(u32::MAX) - 1027), None);
    }
}
