//! Reads the triangles of a glTF file, as placed by its default scene.
//!
//! The crate gltf parses the document (scenes, nodes, meshes, accessors) and checks that references are
//! valid. This module adds the bytes of the buffers, and the transforms of nodes in 64 bits: the crate keeps
//! only 32 bits, too few for a scene far from the origin.
//!
//! Materials, skins, morphs and animations are ignored. Quantized meshes are supported.

use std::collections::BTreeMap;
use std::rc::Rc;

use ::gltf::accessor::{DataType, Dimensions, Item, Iter, sparse};
use ::gltf::buffer::{Buffer, Source, View};
use ::gltf::json::{self, validation};
use ::gltf::mesh::Mode;
use ::gltf::{Accessor, Document, Primitive, Semantic};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::Deserialize;

use super::{CHUNK_BIN, CHUNK_JSON, FORMAT, GLB_MAGIC, GLB_VERSION};
use crate::core::container::further_path;
use crate::core::data::MeshData;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::matrix::{
    IDENTITY, Matrix, determinant, normal_transform, product, quaternion_rotation, transformed,
};
use crate::core::row::ReadExternal;

/// Reads all triangles of the default scene (or of the first scene, or of all meshes if there is no scene) as
/// one mesh in world space. Keeps normals if every primitive has them.
///
/// # Errors
///
/// [`Error::Invalid`] for a damaged file; [`Error::Unsupported`] for buffers outside the file and for
/// required extensions such as compression; [`Error::TooLarge`] if instances multiply meshes beyond `limits`.
pub fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    read(bytes, limits, None)
}

/// Like [`read_mesh`], but also reads external buffers.
///
/// # Errors
///
/// Those of [`read_mesh`]; [`Error::Io`] if a buffer cannot be read.
pub fn read_mesh_with_external(
    bytes: &[u8],
    limits: &Limits,
    read_external: &ReadExternal,
) -> Result<MeshData> {
    read(bytes, limits, Some(read_external))
}

fn read(bytes: &[u8], limits: &Limits, read_external: Option<&ReadExternal>) -> Result<MeshData> {
    let OpenDocument { document, transforms, buffers, budget } = open(bytes, limits, read_external)?;
    let mut collector = Collector { buffers, budget, mesh: MeshData::default(), has_normals: true };
    for (mesh, placement) in placed_meshes(&document, &transforms)? {
        for primitive in mesh.primitives() {
            collector.add(&primitive, &placement)?;
        }
    }
    Ok(collector.finish())
}

/// A document and its buffers.
pub(super) struct OpenDocument {
    pub(super) document: Document,
    pub(super) transforms: NodeTransforms,
    pub(super) buffers: Buffers,
    /// Remaining memory for the content, in bytes.
    pub(super) budget: u64,
}

pub(super) fn open(
    bytes: &[u8],
    limits: &Limits,
    read_external: Option<&ReadExternal>,
) -> Result<OpenDocument> {
    let (json, bin) = chunks(bytes)?;
    let document = document(json)?;
    let transforms: NodeTransforms = parse(json)?;
    let mut files = ExternalReader::new(read_external);
    let buffers = document.buffers().map(|buffer| match buffer.source() {
        Source::Bin => bin
            .filter(|_| buffer.index() == 0)
            .map(|bin| Rc::new(bin.to_vec()))
            .ok_or_else(|| invalid("a buffer has no data")),
        Source::Uri(uri) if is_data(uri) => embedded(uri).map(Rc::new),
        Source::Uri(uri) => files.bytes(uri),
    });
    let buffers = Buffers { bytes: buffers.collect::<Result<_>>()? };
    let budget = limits.decompressed_bytes_of((bytes.len() as u64).saturating_add(files.size_bytes));
    Ok(OpenDocument { document, transforms, buffers, budget })
}

/// Parses the document and checks that all references are valid.
pub(super) fn document(json: &[u8]) -> Result<Document> {
    // The crate's own function is compiled there; the generic one of serde_json would be compiled here.
    let root = json::Root::from_slice(json)
        .or_else(|error| with_nodes_in_scenes(json).ok_or_else(|| invalid_json(&error)))?;
    if let Some(extension) = root.extensions_required.iter().find(|name| *name != "KHR_mesh_quantization") {
        return Err(Error::unsupported(
            FORMAT,
            format!("the file requires the extension {extension}: export without it"),
        ));
    }
    // Checks that the accessors of attributes exist. The crate's validation, which comes after this, indexes
    // the accessors without a check, and would panic if one is missing.
    let attributes = root.meshes.iter().flat_map(|mesh| &mesh.primitives).flat_map(|part| &part.attributes);
    if let Some((_, index)) = attributes.into_iter().find(|(_, index)| root.get(**index).is_none()) {
        return Err(invalid(format!("there is no accessor {}", index.value())));
    }
    let mut wrong = None;
    validation::Validate::validate(&root, &root, json::Path::new, &mut |path, error| {
        // Ignores missing items, such as the bounds of positions, because this reader needs none of them.
        // Ignores required extensions that the crate does not support, because they were checked above.
        if !matches!(error, validation::Error::Missing | validation::Error::Unsupported) && wrong.is_none() {
            wrong = Some(format!("{}: {error}", path()));
        }
    });
    match wrong {
        Some(wrong) => Err(invalid(wrong)),
        None => Ok(Document::from_json_without_validation(root)),
    }
}

/// Adds an empty node list to scenes without one, which are valid but which the crate rejects.
fn with_nodes_in_scenes(json: &[u8]) -> Option<json::Root> {
    let mut document: serde_json::Value = serde_json::from_slice(json).ok()?;
    for scene in document.get_mut("scenes")?.as_array_mut()? {
        scene.as_object_mut()?.entry("nodes").or_insert_with(|| serde_json::Value::Array(Vec::new()));
    }
    json::Root::from_slice(&serde_json::to_vec(&document).ok()?).ok()
}

/// The bytes in a data URI.
fn embedded(uri: &str) -> Result<Vec<u8>> {
    let (_, base64) = uri.split_once(";base64,").ok_or_else(|| invalid("a data URI is not base64"))?;
    STANDARD.decode(base64).map_err(|error| invalid(format!("a data URI is invalid: {error}")))
}

/// The transforms of the nodes.
#[derive(Deserialize)]
pub(super) struct NodeTransforms {
    #[serde(default)]
    nodes: Vec<ReadNode>,
}

#[derive(Deserialize)]
struct ReadNode {
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

/// Every use of a mesh in the scene, with its world transform.
pub(super) fn placed_meshes<'a>(
    document: &'a Document,
    transforms: &NodeTransforms,
) -> Result<Vec<(::gltf::Mesh<'a>, Matrix)>> {
    let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else {
        return Ok(document.meshes().map(|mesh| (mesh, IDENTITY)).collect());
    };
    placed(&scene, transforms, |node| node.mesh())
}

/// Everything that `pick` returns for the nodes of a scene, each with the world transform of its node.
pub(super) fn placed<'a, T>(
    scene: &::gltf::Scene<'a>,
    transforms: &NodeTransforms,
    pick: impl Fn(&::gltf::Node<'a>) -> Option<T>,
) -> Result<Vec<(T, Matrix)>> {
    let mut placed = Vec::new();
    let mut visited = vec![false; transforms.nodes.len()];
    let mut pending: Vec<(::gltf::Node<'a>, Matrix)> = scene.nodes().map(|node| (node, IDENTITY)).collect();
    pending.reverse();
    while let Some((node, parent)) = pending.pop() {
        let index = node.index();
        let (Some(node_transform), Some(visited)) = (transforms.nodes.get(index), visited.get_mut(index))
        else {
            return Err(invalid(format!("there is no node {index}")));
        };
        if std::mem::replace(visited, true) {
            return Err(invalid(format!("node {index} has two parents")));
        }
        let placement = product(&node_transform.placement(), &parent);
        placed.extend(pick(&node).map(|found| (found, placement)));
        let first = pending.len();
        pending.extend(node.children().map(|child| (child, placement)));
        pending[first..].reverse();
    }
    Ok(placed)
}

impl ReadNode {
    fn placement(&self) -> Matrix {
        if let Some(m) = self.matrix {
            return [0, 1, 2, 3].map(|c| [m[4 * c], m[4 * c + 1], m[4 * c + 2], IDENTITY[c][3]]);
        }
        let [x, y, z, w] = self.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]);
        let scale = self.scale.unwrap_or([1.0; 3]);
        let mut placement = quaternion_rotation([w, x, y, z]);
        for (row, scale) in placement.iter_mut().zip(scale) {
            *row = row.map(|along| along * scale);
        }
        placement[3][..3].copy_from_slice(&self.translation.unwrap_or([0.0; 3]));
        placement
    }
}

struct Collector {
    buffers: Buffers,
    budget: u64,
    mesh: MeshData,
    has_normals: bool,
}

impl Collector {
    fn add(&mut self, primitive: &Primitive, placement: &Matrix) -> Result<()> {
        let Some(positions) = primitive.get(&Semantic::Positions) else { return Ok(()) };
        if matches!(primitive.mode(), Mode::Points | Mode::Lines | Mode::LineLoop | Mode::LineStrip) {
            return Ok(());
        }
        let index_count = primitive.indices().map_or(positions.count(), |indices| indices.count());
        self.spend(positions.count(), index_count)?;
        let vertex_count =
            u32::try_from(positions.count()).map_err(|_| invalid("a mesh has 2³² or more vertices"))?;
        let positions = self.buffers.vectors(&positions, &Semantic::Positions)?;
        let normals = primitive.get(&Semantic::Normals);
        let normals = normals.filter(|normals| normals.count() == positions.len());
        let normals =
            normals.map(|normals| self.buffers.vectors(&normals, &Semantic::Normals)).transpose()?;
        let indices = match primitive.indices() {
            None => (0..vertex_count).collect(),
            Some(accessor) => self.buffers.indices(&accessor)?,
        };
        if let Some(index) = indices.iter().find(|index| **index >= vertex_count) {
            return Err(invalid(format!(
                "a triangle has vertex index {index}, but the mesh has {vertex_count} vertices"
            )));
        }
        let first = u32::try_from(self.mesh.positions.len()).ok();
        let Some(first) = first.filter(|first| first.checked_add(vertex_count).is_some()) else {
            return Err(Error::too_large(FORMAT, "the meshes have more than 2³² vertices in total"));
        };
        self.mesh.positions.extend(positions.iter().map(|&position| transformed(placement, position, 1.0)));
        let triangles = triangles(&indices, primitive.mode()).into_iter();
        let is_mirrored = determinant(placement) < 0.0;
        self.mesh.triangles.extend(triangles.map(|triangle| {
            let [a, b, c] = triangle.map(|i| first + i);
            if is_mirrored { [a, c, b] } else { [a, b, c] }
        }));
        match normals {
            Some(normals) => {
                let turn = normal_transform(placement);
                #[expect(clippy::cast_possible_truncation, reason = "normals are kept in 32 bits")]
                let narrow = |normal: &[f64; 3]| turn(*normal).map(|c| c as f32);
                self.mesh.normals.extend(normals.iter().map(narrow));
            }
            None => self.has_normals = false,
        }
        Ok(())
    }

    /// Subtracts the memory for a primitive from the budget, before the caller allocates it.
    fn spend(&mut self, vertex_count: usize, index_count: usize) -> Result<()> {
        let cost = (vertex_count as u64).checked_mul(36).zip((index_count as u64).checked_mul(12));
        spend(&mut self.budget, cost.and_then(|(vertices, indices)| vertices.checked_add(indices)))
    }

    fn finish(mut self) -> MeshData {
        if !self.has_normals {
            self.mesh.normals.clear();
        }
        self.mesh
    }
}

/// Subtracts bytes from a budget; `None` is more than all.
pub(super) fn spend(budget: &mut u64, bytes: Option<u64>) -> Result<()> {
    let left = bytes.and_then(|bytes| budget.checked_sub(bytes));
    let too_large = || Error::too_large(FORMAT, "instances of meshes take more memory than the limit");
    *budget = left.ok_or_else(too_large)?;
    Ok(())
}

fn triangles(indices: &[u32], mode: Mode) -> Vec<[u32; 3]> {
    match mode {
        Mode::TriangleStrip => indices
            .windows(3)
            .enumerate()
            .map(|(index, strip)| {
                let (a, b, c) = (strip[0], strip[1], strip[2]);
                if index % 2 == 0 { [a, b, c] } else { [a, c, b] }
            })
            .collect(),
        Mode::TriangleFan => indices.windows(2).skip(1).map(|pair| [indices[0], pair[0], pair[1]]).collect(),
        _ => indices.as_chunks::<3>().0.to_vec(),
    }
}

// Reads typed numbers from the buffers of a glTF document, with all bounds checked.
//
// The crate gltf iterates over the elements, including sparse ones, but trusts what the document declares.
// This module therefore first compares every declaration with the available bytes.

/// The bytes of the document's buffers. Several buffers can share a file.
pub(super) struct Buffers {
    pub(super) bytes: Vec<Rc<Vec<u8>>>,
}

impl Buffers {
    /// The elements of an accessor of vectors; converts normalized integers to −1 ..= 1.
    pub(super) fn vectors(&self, accessor: &Accessor, semantic: &Semantic) -> Result<Vec<[f64; 3]>> {
        if accessor.dimensions() != Dimensions::Vec3 {
            return Err(invalid(format!(
                "{semantic:?} has the type {:?}; expected Vec3",
                accessor.dimensions()
            )));
        }
        let scale = scale_of(accessor);
        match accessor.data_type() {
            DataType::I8 => self.reals::<i8>(accessor, scale),
            DataType::U8 => self.reals::<u8>(accessor, scale),
            DataType::I16 => self.reals::<i16>(accessor, scale),
            DataType::U16 => self.reals::<u16>(accessor, scale),
            DataType::U32 => self.reals::<u32>(accessor, scale),
            DataType::F32 => self.reals::<f32>(accessor, scale),
        }
    }

    /// The elements of an accessor of indices.
    pub(super) fn indices(&self, accessor: &Accessor) -> Result<Vec<u32>> {
        match (accessor.dimensions(), accessor.data_type()) {
            (Dimensions::Scalar, DataType::U8) => {
                Ok(self.elements::<u8>(accessor)?.into_iter().map(u32::from).collect())
            }
            (Dimensions::Scalar, DataType::U16) => {
                Ok(self.elements::<u16>(accessor)?.into_iter().map(u32::from).collect())
            }
            (Dimensions::Scalar, DataType::U32) => self.elements::<u32>(accessor),
            (dimensions, data) => {
                Err(invalid(format!("the indices have the invalid type {dimensions:?} of {data:?}")))
            }
        }
    }

    /// The stored numbers of an accessor, element by element. Matrices are not supported.
    pub(super) fn components<T: Item + Copy>(&self, accessor: &Accessor) -> Result<Vec<T>> {
        Ok(match accessor.dimensions() {
            Dimensions::Scalar => self.elements::<T>(accessor)?,
            Dimensions::Vec2 => self.elements::<[T; 2]>(accessor)?.into_flattened(),
            Dimensions::Vec3 => self.elements::<[T; 3]>(accessor)?.into_flattened(),
            Dimensions::Vec4 => self.elements::<[T; 4]>(accessor)?.into_flattened(),
            dimensions => {
                return Err(invalid(format!("a vertex attribute has the unsupported type {dimensions:?}")));
            }
        })
    }

    fn reals<T: Item + Copy + Into<f64>>(
        &self,
        accessor: &Accessor,
        scale: Option<f64>,
    ) -> Result<Vec<[f64; 3]>> {
        let real = |component: T| match scale {
            Some(greatest) => (component.into() / greatest).max(-1.0),
            None => component.into(),
        };
        Ok(self.elements::<[T; 3]>(accessor)?.into_iter().map(|element| element.map(real)).collect())
    }

    /// The stored elements.
    fn elements<T: Item>(&self, accessor: &Accessor) -> Result<Vec<T>> {
        if accessor.count() == 0 {
            return Ok(Vec::new());
        }
        self.check(accessor)?;
        let bytes = |buffer: Buffer| self.bytes.get(buffer.index()).map(|bytes| bytes.as_slice());
        let elements = Iter::new(accessor.clone(), bytes).ok_or_else(|| beyond(accessor.count()))?;
        Ok(elements.take(accessor.count()).collect())
    }

    /// Checks that the buffers contain all data of an accessor.
    fn check(&self, accessor: &Accessor) -> Result<()> {
        let (count, size) = (accessor.count(), accessor.size());
        if let Some(view) = accessor.view() {
            self.part(&view, accessor.offset(), count, size)?;
        }
        match accessor.sparse() {
            Some(sparse) => self.check_sparse(&sparse, count, size),
            None if accessor.view().is_none() => {
                Err(Error::unsupported(FORMAT, "an accessor without a buffer view is not supported"))
            }
            None => Ok(()),
        }
    }

    /// Checks that the data of sparse elements exists, and that their indices are in bounds and ascend
    /// without repetition, as the iterator of the crate requires.
    fn check_sparse(&self, sparse: &sparse::Sparse, count: usize, size: usize) -> Result<()> {
        let sparse_count = sparse.count();
        if sparse_count == 0 || sparse_count > count {
            return Err(invalid(format!(
                "an accessor has {sparse_count} sparse elements, but only {count} elements"
            )));
        }
        let (indices, values) = (sparse.indices(), sparse.values());
        self.part(&values.view(), values.offset(), sparse_count, size)?;
        let width = indices.index_type().size();
        let (bytes, stride) = self.part(&indices.view(), indices.offset(), sparse_count, width)?;
        let mut last = None;
        for start in (0..sparse_count).map(|index| index * stride) {
            let index =
                bytes[start..start + width].iter().rfold(0, |index, byte| index << 8 | usize::from(*byte));
            if index >= count || last.is_some_and(|last| index <= last) {
                return Err(invalid(format!("the sparse element {index} of {count} is out of order")));
            }
            last = Some(index);
        }
        Ok(())
    }

    /// The bytes from the first element on, and the stride, after checking that all elements exist.
    fn part(&self, view: &View, offset: usize, count: usize, size: usize) -> Result<(&[u8], usize)> {
        let buffer = self.bytes.get(view.buffer().index());
        let end = view.offset().checked_add(view.length());
        let bytes = buffer.zip(end).and_then(|(buffer, end)| buffer.get(view.offset()..end));
        let bytes = bytes.and_then(|bytes| bytes.get(offset..));
        let stride = view.stride().unwrap_or(size);
        let needed = (count - 1)
            .checked_mul(stride)
            .and_then(|before| before.checked_add(size))
            .filter(|_| size <= stride);
        match (bytes, needed) {
            (Some(bytes), Some(needed)) if needed <= bytes.len() => Ok((bytes, stride)),
            _ => Err(beyond(count)),
        }
    }
}

/// The greatest number of an accessor of normalized integers; `None` for others.
pub(super) fn scale_of(accessor: &Accessor) -> Option<f64> {
    match accessor.data_type() {
        // `normalized` has no meaning for floats, but some exporters set it.
        DataType::F32 => None,
        _ if !accessor.normalized() => None,
        DataType::I8 => Some(f64::from(i8::MAX)),
        DataType::U8 => Some(f64::from(u8::MAX)),
        DataType::I16 => Some(f64::from(i16::MAX)),
        DataType::U16 => Some(f64::from(u16::MAX)),
        DataType::U32 => Some(f64::from(u32::MAX)),
    }
}

fn beyond(count: usize) -> Error {
    invalid(format!("an accessor of {count} elements exceeds its buffer"))
}

pub(super) fn invalid(what: impl Into<String>) -> Error {
    Error::invalid(FORMAT, Position::File, what)
}

// Buffers in external files next to the document.
//
//   scene.gltf    "uri":"parts/a%20b.bin", "byteLength":96   ──▶   parts/a b.bin, its first 96 bytes
//   parts/
//     a b.bin
//
// Paths in a document are not trusted: see `further_path`.

/// An external file with buffers of a document.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExternalFile {
    /// Its path relative to the document's folder: names separated by `/`, without `..`.
    pub path: String,
    /// Number of bytes to read from its start.
    pub byte_count: u64,
}

/// The external files of a document, each once, in the order of their first use.
///
/// # Errors
/// [`Error::Invalid`] if the file is not glTF; [`Error::Unsupported`] for a buffer outside the document's
/// folder.
pub fn external_files(bytes: &[u8]) -> Result<Vec<ExternalFile>> {
    #[derive(Deserialize)]
    struct Document {
        #[serde(default)]
        buffers: Vec<Buffer>,
    }
    #[derive(Deserialize)]
    struct Buffer {
        uri: Option<String>,
        #[serde(rename = "byteLength")]
        byte_count: u64,
    }
    let document: Document = parse(chunks(bytes)?.0)?;
    let mut files: Vec<ExternalFile> = Vec::new();
    let mut index_of: BTreeMap<String, usize> = BTreeMap::new();
    for Buffer { uri, byte_count } in document.buffers {
        let Some(uri) = uri.filter(|uri| !is_data(uri)) else { continue };
        let path = path_of(&uri)?;
        let index = *index_of.entry(path.clone()).or_insert(files.len());
        match files.get_mut(index) {
            Some(file) => file.byte_count = file.byte_count.max(byte_count),
            None => files.push(ExternalFile { path, byte_count }),
        }
    }
    Ok(files)
}

/// Whether a URI contains the data itself.
fn is_data(uri: &str) -> bool {
    uri.starts_with("data:")
}

/// Reads external files, each only once even if it has several buffers.
struct ExternalReader<'a> {
    read_external: Option<&'a ReadExternal<'a>>,
    read: BTreeMap<String, Rc<Vec<u8>>>,
    /// Total size in bytes of the files read so far.
    size_bytes: u64,
}

impl<'a> ExternalReader<'a> {
    pub(super) fn new(read_external: Option<&'a ReadExternal<'a>>) -> ExternalReader<'a> {
        ExternalReader { read_external, read: BTreeMap::new(), size_bytes: 0 }
    }

    /// The content of the file at a URI.
    pub(super) fn bytes(&mut self, uri: &str) -> Result<Rc<Vec<u8>>> {
        let Some(read_external) = self.read_external else {
            let what = "a buffer is in a separate file: export as .glb, or embed the buffer";
            return Err(Error::unsupported(FORMAT, what));
        };
        let path = path_of(uri)?;
        if let Some(bytes) = self.read.get(&path) {
            return Ok(Rc::clone(bytes));
        }
        let read = read_external(&path);
        let bytes = read.map_err(|error| {
            std::io::Error::new(error.kind(), format!("cannot read the buffer {path}: {error}"))
        })?;
        let bytes = Rc::new(bytes);
        self.size_bytes = self.size_bytes.saturating_add(bytes.len() as u64);
        self.read.insert(path, Rc::clone(&bytes));
        Ok(bytes)
    }
}

/// Converts a URI to a relative path.
fn path_of(uri: &str) -> Result<String> {
    let path = percent_decoded(uri).ok_or_else(|| invalid(format!("the URI {uri} is invalid")))?;
    further_path(FORMAT, "", &path)
}

/// Decodes the percent escapes of a URI.
fn percent_decoded(uri: &str) -> Option<String> {
    let mut parts = uri.split('%');
    let mut bytes = parts.next()?.as_bytes().to_vec();
    for part in parts {
        let (code, rest) = part.split_at_checked(2)?;
        bytes.push(u8::from_str_radix(code, 16).ok()?);
        bytes.extend_from_slice(rest.as_bytes());
    }
    String::from_utf8(bytes).ok()
}

// Splits a GLB file into its chunks, and parses JSON into types.

/// Parses JSON.
pub(super) fn parse<'a, T: Deserialize<'a>>(json: &'a [u8]) -> Result<T> {
    serde_json::from_slice(json).map_err(|error| invalid_json(&error))
}

fn invalid_json(error: &serde_json::Error) -> Error {
    Error::invalid(FORMAT, Position::Line(error.line() as u64), error.to_string())
}

/// The JSON chunk and, if present, the binary chunk. A file without the GLB signature is JSON as a whole.
pub(super) fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>)> {
    let error = |offset: u64, what: &str| Err(Error::invalid(FORMAT, Position::Offset(offset), what));
    if !bytes.starts_with(&GLB_MAGIC) {
        return Ok((bytes, None));
    }
    let Some((header, _)) = bytes.split_first_chunk::<12>() else {
        return error(0, "the GLB header is truncated");
    };
    let number = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    if number(4) != GLB_VERSION {
        return Err(Error::unsupported(
            FORMAT,
            format!("the GLB version is {}; only 2 is supported", number(4)),
        ));
    }
    let Some(bytes) = bytes.get(..number(8) as usize) else {
        return error(8, "the file is shorter than its GLB header declares");
    };
    let (mut json, mut bin, mut at) = (None, None, 12);
    while let Some(([a, b, c, d, kind @ ..], rest)) = bytes.get(at..).and_then(|b| b.split_first_chunk::<8>())
    {
        let length = u32::from_le_bytes([*a, *b, *c, *d]) as usize;
        let Some(chunk) = rest.get(..length) else {
            return error(at as u64, "a GLB chunk extends beyond the end of the file");
        };
        match *kind {
            CHUNK_JSON if json.is_none() => json = Some(chunk),
            CHUNK_BIN if bin.is_none() => bin = Some(chunk),
            _ => {} // readers must skip unknown chunks
        }
        at += 8 + length;
    }
    match json {
        Some(json) => Ok((json, bin)),
        None => error(12, "the GLB file has no JSON chunk"),
    }
}
