//! glTF 2.0: writes meshes as `.glb`, or as `.gltf` with an embedded buffer; reads meshes and points.
//!
//! ```text
//!   .glb    header │ JSON chunk, padded with spaces │ BIN chunk: positions, normals, attributes, indices
//!   .gltf   JSON with the same buffer as a base64 data URI
//! ```
//!
//! A `.gltf` with a separate `.bin` would be two files, and two files cannot be replaced atomically. The
//! buffer is therefore in a data URI, which is a third larger than the bytes. A few structs define the
//! written document, and serde_json serialises them, so that the code shows exactly what is written. Node
//! translations keep 64 bits, so that scenes far from the origin stay exact.
//!
//! This work is based on:
//! The Khronos 3D Formats Working Group. glTF 2.0 Specification. 2021

mod frame_file;
mod points;
mod read;
mod sequence;
mod write;

use std::collections::BTreeSet;
use std::fmt;

use ::gltf::Semantic;
use ::gltf::camera::Projection;
use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, MapAccess, Visitor};
use serde_json::Value;

pub use crate::core::options::UpAxis;
pub use crate::core::row::ReadExternal;
pub use frame_file::GlbFrame;
pub(crate) use frame_file::{
    ACCELERATION, COLOR, NORMAL, POSITION, SequencePlacement, SharedAttribute, TEXTURE, VELOCITY, flipped,
    shared_attributes,
};
pub(crate) use points::{POINTS, declares_points};
pub use read::{ExternalFile, external_files, read_mesh, read_mesh_with_external};
pub use sequence::{SEQUENCE_FRAMES, SequenceFrame, SequenceInfo, read_sequence_info, write_sequence};
pub(crate) use write::naming_notes;
pub use write::{attribute_notes, write_glb, write_gltf};

use crate::core::data::{AttributeRole, FileAttribute, MeshData, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::options::WriteOption;
use crate::core::row::{Content, FormatRow, Integrity, MeshEncoder, MeshWriter, OutputRow};
use read::{Buffers, OpenDocument, chunks, document, open, parse, placed};

/// The format's name in errors.
const FORMAT: &str = "glTF";

const GLB_MAGIC: [u8; 4] = *b"glTF";
const GLB_VERSION: u32 = 2;
const CHUNK_JSON: [u8; 4] = *b"JSON";
const CHUNK_BIN: [u8; 4] = *b"BIN\0";

/// The codes of the component types that the writer uses.
mod component {
    pub(super) const U16: u32 = 5123;
    pub(super) const U32: u32 = 5125;
    pub(super) const F32: u32 = 5126;
}

/// The row of the binary form in the table of formats.
pub(crate) static GLB: OutputRow = OutputRow {
    format: FormatRow {
        signatures: &[b"glTF"],
        read_mesh: Some(read_one_mesh),
        ..FormatRow::new("binary glTF", &["glb"])
    },
    help: "Binary glTF: positions, normals",
    content: Content::Mesh(MeshWriter { attribute_notes, ..MeshWriter::new(MeshEncoder::Stream(write_glb)) }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Up],
    read_provenance: |head| read_provenance(json_of_glb_head(head)?),
    integrity: Integrity::Length(|head, _| glb_bytes_declared(head)),
};

/// The row of the text form in the table of formats.
pub(crate) static GLTF: OutputRow = OutputRow {
    format: FormatRow { read_mesh: Some(read_mesh_with_external), ..FormatRow::new(FORMAT, &["gltf"]) },
    help: "Text glTF",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Stream(write_gltf))
    }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Up],
    read_provenance,
    integrity: Integrity::Json,
};

/// Reads the mesh of a `.glb`. Rejects a sequence: it has a mesh per frame, and nothing says which one to
/// use.
fn read_one_mesh(bytes: &[u8], limits: &Limits, read_external: &ReadExternal) -> Result<MeshData> {
    if let Some(shot) = read_sequence_info(bytes)? {
        let what = format!(
            "this file is a sequence of {} frames, and a single mesh is needed: use the .glb of one frame, or of each frame, as in body.####.glb",
            shot.frames
        );
        return Err(Error::unsupported(GLB.format.name, what));
    }
    read_mesh_with_external(bytes, limits, read_external)
}

// Reads the provenance in the head of a glTF document, without reading the rest.

/// The JSON chunk of a `.glb`, or the part of it that the head contains.
pub(crate) fn json_of_glb_head(head: &[u8]) -> Result<&[u8]> {
    const HEADER_BYTES: usize = 12;
    if !head.starts_with(&GLB_MAGIC) {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected a GLB header"));
    }
    match head.get(HEADER_BYTES..).and_then(|chunk| chunk.split_first_chunk::<8>()) {
        Some(([a, b, c, d, kind @ ..], json)) if *kind == CHUNK_JSON => {
            let length = u32::from_le_bytes([*a, *b, *c, *d]) as usize;
            Ok(&json[..length.min(json.len())])
        }
        _ => {
            Err(Error::invalid(FORMAT, Position::Offset(HEADER_BYTES as u64), "the first chunk is not JSON"))
        }
    }
}

/// The file size that the header of a `.glb` declares; `None` if the header is truncated.
pub(crate) fn glb_bytes_declared(head: &[u8]) -> Result<Option<u64>> {
    const LENGTH_AT: usize = 8;
    if !head.starts_with(&GLB_MAGIC) {
        return Err(Error::invalid(FORMAT, Position::Offset(0), "expected a GLB header"));
    }
    let length = head.get(LENGTH_AT..).and_then(|rest| rest.first_chunk::<4>());
    Ok(length.map(|&length| u64::from(u32::from_le_bytes(length))))
}

/// The provenance that this crate stores in `asset.extras`. `json` can be truncated anywhere after it.
pub(crate) fn read_provenance(json: &[u8]) -> Result<Vec<(String, String)>> {
    let mut asset = None;
    let mut deserializer = serde_json::Deserializer::from_slice(json);
    let outcome = AssetOf(&mut asset).deserialize(&mut deserializer);
    match (asset, outcome) {
        // Parsing stops after `asset`, which the deserializer reports as an error.
        (Some(ReadAsset { extras: Some(ReadExtras::Ours { meniscus }) }), _) => Ok(meniscus.0),
        (Some(_), _) => Ok(Vec::new()),
        (None, Err(error)) if !error.is_eof() => {
            Err(Error::invalid(FORMAT, Position::Line(error.line() as u64), error.to_string()))
        }
        (None, _) => Ok(Vec::new()),
    }
}

#[derive(Deserialize)]
struct ReadAsset {
    #[serde(default)]
    extras: Option<ReadExtras>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum ReadExtras {
    Ours { meniscus: ReadEntries },
    Others(IgnoredAny),
}

/// Names and values in file order.
struct ReadEntries(Vec<(String, String)>);

impl<'de> Deserialize<'de> for ReadEntries {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<ReadEntries, D::Error> {
        struct Pairs;
        impl<'de> Visitor<'de> for Pairs {
            type Value = ReadEntries;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("names and values")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<ReadEntries, A::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(ReadEntries(entries))
            }
        }
        deserializer.deserialize_map(Pairs)
    }
}

/// Deserializes a document up to its `asset`, and stores the asset in the option.
struct AssetOf<'a>(&'a mut Option<ReadAsset>);

impl<'de> DeserializeSeed<'de> for AssetOf<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> std::result::Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for AssetOf<'_> {
    type Value = ();
    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a glTF document")
    }
    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<(), A::Error> {
        while let Some(key) = map.next_key::<String>()? {
            if key == "asset" {
                *self.0 = Some(map.next_value()?);
                return Ok(());
            }
            map.next_value::<IgnoredAny>()?;
        }
        Ok(())
    }
}

// Reads the vertex attributes of a glTF file, except positions and normals.

/// Reads the attributes of all meshes, with their names in the file, except positions and normals. Joins the
/// values of several primitives if their attributes have the same name and type. Does not normalize integers. Texture
/// coordinates are from the lower left corner of a picture, and in the file from the upper left one.
///
/// # Errors
///
/// Those of [`read_mesh`].
pub fn read_attributes(bytes: &[u8], limits: &Limits) -> Result<Vec<FileAttribute>> {
    let OpenDocument { document, buffers, mut budget, .. } = open(bytes, limits, None)?;
    let mut found: Vec<FileAttribute> = Vec::new();
    for (semantic, accessor) in document.meshes().flat_map(|mesh| {
        mesh.primitives().flat_map(|primitive| primitive.attributes().collect::<Vec<_>>()).collect::<Vec<_>>()
    }) {
        let arity = accessor.dimensions().multiplicity();
        if matches!(semantic, Semantic::Positions | Semantic::Normals) || arity > ARITY_MAX {
            continue;
        }
        let bytes = (accessor.count() as u64).checked_mul(VALUE_BYTES * arity as u64);
        let left = bytes.and_then(|bytes| budget.checked_sub(bytes));
        budget =
            left.ok_or_else(|| Error::too_large(FORMAT, "the attributes take more memory than the limit"))?;
        let mut values = values_of(&buffers, &accessor)?;
        if let (Semantic::TexCoords(_), 2, Values::F32(values)) = (&semantic, arity, &mut values) {
            values.as_chunks_mut().0.iter_mut().for_each(|row| *row = flipped(*row));
        }
        let name = semantic.to_string();
        let is_it = |other: &&mut FileAttribute| other.name == name && other.arity == arity;
        match found.iter_mut().find(is_it).map(|other| (&mut other.values, &values)) {
            Some((Values::F32(all), Values::F32(more))) => all.extend_from_slice(more),
            Some((Values::I64(all), Values::I64(more))) => all.extend_from_slice(more),
            _ => found.push(FileAttribute { role: role_of(&name, arity), name, arity, values }),
        }
    }
    Ok(found)
}

/// The names of the attributes of all meshes in alphabetical order, except positions and normals. Does not
/// read their values.
///
/// # Errors
///
/// [`Error::Invalid`] if the document is damaged.
pub fn read_attribute_names(bytes: &[u8]) -> Result<Vec<String>> {
    let (json, _) = chunks(bytes)?;
    let document: Value = parse(json)?;
    let mut names = BTreeSet::new();
    for mesh in document["meshes"].as_array().into_iter().flatten() {
        for primitive in mesh["primitives"].as_array().into_iter().flatten() {
            names.extend(primitive["attributes"].as_object().into_iter().flat_map(|all| all.keys()));
        }
    }
    Ok(names.into_iter().filter(|name| *name != "POSITION" && *name != "NORMAL").cloned().collect())
}

/// The largest arity that is read: that of a vector. Wider elements are matrices, which are skipped.
const ARITY_MAX: usize = 4;

/// Maximum memory per value, in bytes.
const VALUE_BYTES: u64 = 8;

fn role_of(name: &str, arity: usize) -> Option<AttributeRole> {
    match (name, arity) {
        (COLOR, 3 | 4) => Some(AttributeRole::Color),
        (VELOCITY, 3) => Some(AttributeRole::Velocity),
        (ACCELERATION, 3) => Some(AttributeRole::Acceleration),
        (TEXTURE, 2) => Some(AttributeRole::TextureCoordinates),
        _ => None,
    }
}

fn values_of(buffers: &Buffers, accessor: &::gltf::Accessor) -> Result<Values> {
    use ::gltf::accessor::DataType;
    Ok(match accessor.data_type() {
        DataType::F32 => Values::F32(buffers.components::<f32>(accessor)?),
        DataType::I8 => integers(buffers.components::<i8>(accessor)?),
        DataType::U8 => integers(buffers.components::<u8>(accessor)?),
        DataType::I16 => integers(buffers.components::<i16>(accessor)?),
        DataType::U16 => integers(buffers.components::<u16>(accessor)?),
        DataType::U32 => integers(buffers.components::<u32>(accessor)?),
    })
}

fn integers<T: Into<i64>>(components: Vec<T>) -> Values {
    Values::I64(components.into_iter().map(Into::into).collect())
}

// Reads the camera of a glTF file, as placed by its default scene.

/// A perspective camera. The directions are not normalized.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraData {
    /// Position, world units.
    pub eye: [f64; 3],
    /// Viewing direction.
    pub forward: [f64; 3],
    /// Up direction of the picture.
    pub up: [f64; 3],
    /// Vertical field of view, in radians.
    pub view_radians: f64,
}

/// Reads the first camera of the default scene, or of the first scene.
///
/// # Errors
///
/// [`Error::Invalid`] for a damaged file; [`Error::Unsupported`] if there is no camera, or only an
/// orthographic one.
pub fn read_camera(bytes: &[u8]) -> Result<CameraData> {
    let (json, _) = chunks(bytes)?;
    let document = document(json)?;
    let transforms = parse(json)?;
    let Cameras { cameras: cameras_of } = parse(json)?;
    let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else {
        return Err(Error::unsupported(
            FORMAT,
            "the file has no scene and no camera: export the scene with its camera",
        ));
    };
    let cameras = placed(&scene, &transforms, |node| node.camera())?;
    let Some((camera, placement)) = cameras.first() else {
        return Err(Error::unsupported(FORMAT, "the file has no camera: export it with the scene"));
    };
    if !cameras_of.iter().all(CameraEntry::has_its_kind) {
        return Err(Error::invalid(FORMAT, Position::File, "a camera lacks the parameters of its type"));
    }
    let Projection::Perspective(perspective) = camera.projection() else {
        return Err(Error::unsupported(FORMAT, "the camera is orthographic: use a perspective camera"));
    };
    let [_, up, backward, eye] = placement.map(|[x, y, z, _]| [x, y, z]);
    Ok(CameraData {
        eye,
        forward: backward.map(|along| -along),
        up,
        view_radians: f64::from(perspective.yfov()),
    })
}

/// The fields of cameras that the crate gltf does not validate.
#[derive(Deserialize)]
struct Cameras {
    #[serde(default)]
    cameras: Vec<CameraEntry>,
}

#[derive(Deserialize)]
struct CameraEntry {
    #[serde(rename = "type")]
    kind: String,
    perspective: Option<IgnoredAny>,
    orthographic: Option<IgnoredAny>,
}

impl CameraEntry {
    fn has_its_kind(&self) -> bool {
        match &*self.kind {
            "perspective" => self.perspective.is_some(),
            _ => self.orthographic.is_some(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(camera: &str) -> String {
        format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
                "nodes":[{{"translation":[1,2,3],"children":[1]}},
                         {{"rotation":[0,0.7071067811865476,0,0.7071067811865476],"camera":0}}],
                "cameras":[{camera}]}}"#
        )
    }

    #[test]
    fn camera_is_placed_by_its_nodes() {
        let text = scene(r#"{"type":"perspective","perspective":{"yfov":0.5,"znear":0.1}}"#);
        let camera = read_camera(text.as_bytes()).expect("a camera");
        assert_eq!((camera.eye, camera.view_radians), ([1.0, 2.0, 3.0], 0.5));
        let is_near = |a: [f64; 3], b: [f64; 3]| (0..3).all(|axis| (a[axis] - b[axis]).abs() < 1e-9);
        // A quarter turn to the left: from −z to −x.
        assert!(
            is_near(camera.forward, [-1.0, 0.0, 0.0]) && is_near(camera.up, [0.0, 1.0, 0.0]),
            "{camera:?}"
        );
    }

    #[test]
    fn missing_and_invalid_cameras_are_errors() {
        let orthographic =
            scene(r#"{"type":"orthographic","orthographic":{"xmag":1,"ymag":1,"znear":0.1,"zfar":9}}"#);
        let none = r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{}]}"#;
        // Cameras with the parameters of the other type, or without any.
        let crossed = [
            scene(r#"{"type":"perspective","orthographic":{"xmag":1,"ymag":1,"znear":0.1,"zfar":9}}"#),
            scene(r#"{"type":"orthographic","perspective":{"yfov":0.5,"znear":0.1}}"#),
            scene(r#"{"type":"perspective"}"#),
        ];
        for text in crossed {
            let error = read_camera(text.as_bytes()).expect_err(&text).to_string();
            assert!(error.contains("lacks the parameters of its type"), "{error}");
        }
        for (text, words) in [(&*orthographic, "orthographic"), (none, "no camera"), ("{}", "")] {
            let error = read_camera(text.as_bytes()).expect_err(text).to_string();
            assert!(error.contains(words), "{error}");
        }
    }
}
