//! Reads the triangles of a glTF file, as placed by its default scene.
//!
//! The crate gltf parses the document (scenes, nodes, meshes, accessors) and checks that references are
//! valid. This module adds the bytes of the buffers, and the transforms of nodes in 64 bits: the crate keeps
//! only 32 bits, too few for a scene far from the origin.
//!
//! Materials, skins, morphs and animations are ignored. Quantized meshes are supported.

use std::rc::Rc;

use ::gltf::json::{self, validation};
use ::gltf::mesh::Mode;
use ::gltf::{Document, Primitive, Semantic, buffer::Source};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::Deserialize;

use super::FORMAT;
use super::ReadExternal;
use super::buffer::{Buffers, invalid};
use super::chunks::{chunks, invalid_json, parse};
use super::external::{ExternalReader, is_data};
use crate::data::MeshData;
use crate::error::{Error, Result};
use crate::limits::Limits;

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
    transforms: NodeTransforms,
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
fn placed_meshes<'a>(
    document: &'a Document,
    transforms: &NodeTransforms,
) -> Result<Vec<(::gltf::Mesh<'a>, NodeTransform)>> {
    let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else {
        return Ok(document.meshes().map(|mesh| (mesh, NodeTransform::IDENTITY)).collect());
    };
    placed(&scene, transforms, |node| node.mesh())
}

/// Everything that `pick` returns for the nodes of a scene, each with the world transform of its node.
pub(super) fn placed<'a, T>(
    scene: &::gltf::Scene<'a>,
    transforms: &NodeTransforms,
    pick: impl Fn(&::gltf::Node<'a>) -> Option<T>,
) -> Result<Vec<(T, NodeTransform)>> {
    let mut placed = Vec::new();
    let mut visited = vec![false; transforms.nodes.len()];
    let mut pending: Vec<(::gltf::Node<'a>, NodeTransform)> =
        scene.nodes().map(|node| (node, NodeTransform::IDENTITY)).collect();
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
        let placement = parent.then_inner(&node_transform.placement());
        placed.extend(pick(&node).map(|found| (found, placement)));
        let first = pending.len();
        pending.extend(node.children().map(|child| (child, placement)));
        pending[first..].reverse();
    }
    Ok(placed)
}

/// An affine transform: the columns of the linear part, and the translation.
#[derive(Clone, Copy)]
pub(super) struct NodeTransform {
    pub(super) axes: [[f64; 3]; 3],
    pub(super) translation: [f64; 3],
}

impl NodeTransform {
    const IDENTITY: NodeTransform =
        NodeTransform { axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0; 3] };

    fn vector(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|row| self.axes[0][row] * x + self.axes[1][row] * y + self.axes[2][row] * z)
    }

    fn point(&self, point: [f64; 3]) -> [f64; 3] {
        let vector = self.vector(point);
        std::array::from_fn(|row| vector[row] + self.translation[row])
    }

    /// Transforms a normal by the cofactors of the linear part, so that it stays perpendicular to its
    /// surface.
    fn normal(&self, normal: [f64; 3]) -> [f64; 3] {
        let [a, b, c] = self.axes;
        let cofactors =
            NodeTransform { axes: [cross(b, c), cross(c, a), cross(a, b)], translation: [0.0; 3] };
        let [x, y, z] = cofactors.vector(normal);
        let length = (x * x + y * y + z * z).sqrt();
        if 0.0 < length { [x / length, y / length, z / length] } else { [x, y, z] }
    }

    /// The transform that applies `inner` first, then this one.
    fn then_inner(&self, inner: &NodeTransform) -> NodeTransform {
        NodeTransform {
            axes: inner.axes.map(|axis| self.vector(axis)),
            translation: self.point(inner.translation),
        }
    }
}

fn cross([ax, ay, az]: [f64; 3], [bx, by, bz]: [f64; 3]) -> [f64; 3] {
    [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]
}

impl ReadNode {
    fn placement(&self) -> NodeTransform {
        if let Some(m) = self.matrix {
            let column = |c: usize| [m[4 * c], m[4 * c + 1], m[4 * c + 2]];
            return NodeTransform { axes: [column(0), column(1), column(2)], translation: column(3) };
        }
        let [x, y, z, w] = self.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]);
        let scale = self.scale.unwrap_or([1.0; 3]);
        let rotation = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)],
            [2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)],
            [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)],
        ];
        let axes = std::array::from_fn(|axis| rotation[axis].map(|c| c * scale[axis]));
        NodeTransform { axes, translation: self.translation.unwrap_or([0.0; 3]) }
    }
}

struct Collector {
    buffers: Buffers,
    budget: u64,
    mesh: MeshData,
    has_normals: bool,
}

impl Collector {
    fn add(&mut self, primitive: &Primitive, placement: &NodeTransform) -> Result<()> {
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
        self.mesh.positions.extend(positions.iter().map(|&position| placement.point(position)));
        let triangles = triangles(&indices, primitive.mode()).into_iter();
        self.mesh.triangles.extend(triangles.map(|triangle| triangle.map(|i| first + i)));
        match normals {
            Some(normals) => {
                #[expect(clippy::cast_possible_truncation, reason = "normals are kept in 32 bits")]
                let narrow = |normal: &[f64; 3]| placement.normal(*normal).map(|c| c as f32);
                self.mesh.normals.extend(normals.iter().map(narrow));
            }
            None => self.has_normals = false,
        }
        Ok(())
    }

    /// Subtracts the memory for a primitive from the budget, before the caller allocates it.
    fn spend(&mut self, vertex_count: usize, index_count: usize) -> Result<()> {
        let cost = (vertex_count as u64).checked_mul(36).zip((index_count as u64).checked_mul(12));
        let cost = cost.and_then(|(vertices, indices)| vertices.checked_add(indices));
        let left = cost.and_then(|cost| self.budget.checked_sub(cost));
        let too_large = || Error::too_large(FORMAT, "instances of meshes take more memory than the limit");
        self.budget = left.ok_or_else(too_large)?;
        Ok(())
    }

    fn finish(mut self) -> MeshData {
        if !self.has_normals {
            self.mesh.normals.clear();
        }
        self.mesh
    }
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
