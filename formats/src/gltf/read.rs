//! Reads the triangles of a glTF file, as placed by its default scene.
//!
//! Buffers must be inside the file: the second chunk of a `.glb`, or data URIs. Materials, skins,
//! morphs and animations are not looked at. Quantized meshes are read.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::Deserialize;

use super::buffer::{Accessor, BufferView, invalid};
use super::{CHUNK_BIN, CHUNK_JSON, FORMAT, GLB_MAGIC, GLB_VERSION};
use crate::data::MeshData;
use crate::error::{Error, Place, Result};
use crate::limits::Limits;

/// Reads all triangles of the default scene (or of the first, or of all meshes if there is no scene)
/// as one mesh in world space. Normals are kept if every part has them.
///
/// # Errors
///
/// [`Error::Invalid`] for a damaged file; [`Error::Unsupported`] for buffers outside the file,
/// sparse accessors and extensions that the file requires, such as compression; [`Error::TooLarge`]
/// if instances of meshes multiply beyond `limits`.
pub fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    let (json, bin) = chunks(bytes)?;
    let document: Document = serde_json::from_slice(json)
        .map_err(|error| Error::invalid(FORMAT, Place::Line(error.line() as u64), error.to_string()))?;
    if let Some(extension) = document.extensions_required.iter().find(|name| *name != "KHR_mesh_quantization")
    {
        return Err(Error::unsupported(FORMAT, format!("the extension {extension}; export without it")));
    }
    let buffers = document.buffers.iter().enumerate();
    let buffers: Vec<Vec<u8>> =
        buffers.map(|(index, buffer)| buffer.load(bin.filter(|_| index == 0))).collect::<Result<_>>()?;
    let mut collector = Collector {
        document: &document,
        buffers: &buffers,
        budget: limits.decompressed_bytes_of(bytes.len() as u64),
        mesh: MeshData::default(),
        has_normals: true,
    };
    for (mesh, placement) in document.placed_meshes()? {
        let mesh = document.meshes.get(mesh).ok_or_else(|| invalid(format!("no mesh {mesh}")))?;
        for primitive in &mesh.primitives {
            collector.add(primitive, &placement)?;
        }
    }
    Ok(collector.finish())
}

/// The JSON and, if there is one, the binary chunk.
fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>)> {
    let error = |offset: u64, what: &str| Err(Error::invalid(FORMAT, Place::Offset(offset), what));
    if !bytes.starts_with(&GLB_MAGIC) {
        return Ok((bytes, None));
    }
    let Some((header, _)) = bytes.split_first_chunk::<12>() else {
        return error(0, "a GLB header that ends too soon");
    };
    let number = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    if number(4) != GLB_VERSION {
        return Err(Error::unsupported(FORMAT, format!("GLB version {}; 2 is read", number(4))));
    }
    let Some(bytes) = bytes.get(..number(8) as usize) else {
        return error(8, "a file shorter than its GLB header says");
    };
    let (mut json, mut bin, mut at) = (None, None, 12);
    while let Some(([a, b, c, d, kind @ ..], rest)) = bytes.get(at..).and_then(|b| b.split_first_chunk::<8>())
    {
        let length = u32::from_le_bytes([*a, *b, *c, *d]) as usize;
        let Some(chunk) = rest.get(..length) else {
            return error(at as u64, "a GLB chunk that ends after the file");
        };
        match *kind {
            CHUNK_JSON if json.is_none() => json = Some(chunk),
            CHUNK_BIN if bin.is_none() => bin = Some(chunk),
            _ => {} // readers must skip chunks that they do not know
        }
        at += 8 + length;
    }
    match json {
        Some(json) => Ok((json, bin)),
        None => error(12, "a GLB file without a JSON chunk"),
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase", default)]
#[derive(Default)]
struct Document {
    scene: Option<usize>,
    scenes: Vec<Scene>,
    nodes: Vec<Node>,
    meshes: Vec<Mesh>,
    accessors: Vec<Accessor>,
    buffer_views: Vec<BufferView>,
    buffers: Vec<Buffer>,
    extensions_required: Vec<String>,
}

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct Node {
    mesh: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    attributes: Attributes,
    indices: Option<usize>,
    #[serde(default = "mode_triangles")]
    mode: u32,
}

#[derive(Deserialize)]
#[serde(rename_all = "UPPERCASE")]
struct Attributes {
    position: Option<usize>,
    normal: Option<usize>,
}

#[derive(Deserialize)]
struct Buffer {
    uri: Option<String>,
}

impl Buffer {
    fn load(&self, bin: Option<&[u8]>) -> Result<Vec<u8>> {
        let Some(uri) = &self.uri else {
            return bin.map(<[u8]>::to_vec).ok_or_else(|| invalid("a buffer without data"));
        };
        let Some((_, base64)) = uri.strip_prefix("data:").and_then(|uri| uri.split_once(";base64,")) else {
            return Err(Error::unsupported(
                FORMAT,
                "a buffer in a file of its own; export as .glb, or embed it",
            ));
        };
        STANDARD.decode(base64).map_err(|error| invalid(format!("a data URI: {error}")))
    }
}

impl Document {
    /// Every use of a mesh by the scene, with its place in the world.
    fn placed_meshes(&self) -> Result<Vec<(usize, Placement)>> {
        let roots = match self.scenes.get(self.scene.unwrap_or(0)) {
            Some(scene) => &scene.nodes,
            None if self.scene.is_none() => {
                return Ok((0..self.meshes.len()).map(|mesh| (mesh, Placement::IDENTITY)).collect());
            }
            None => return Err(invalid("a default scene that does not exist")),
        };
        let mut placed = Vec::new();
        let mut visited = vec![false; self.nodes.len()];
        let mut pending: Vec<(usize, Placement)> =
            roots.iter().rev().map(|&node| (node, Placement::IDENTITY)).collect();
        while let Some((index, parent)) = pending.pop() {
            let (Some(node), Some(visited)) = (self.nodes.get(index), visited.get_mut(index)) else {
                return Err(invalid(format!("no node {index}")));
            };
            if std::mem::replace(visited, true) {
                return Err(invalid(format!("node {index} has two parents")));
            }
            let placement = parent.then_inner(&node.placement());
            placed.extend(node.mesh.map(|mesh| (mesh, placement)));
            pending.extend(node.children.iter().rev().map(|&child| (child, placement)));
        }
        Ok(placed)
    }
}

/// An affine map: columns of the linear part, and the translation.
#[derive(Clone, Copy)]
struct Placement {
    axes: [[f64; 3]; 3],
    translation: [f64; 3],
}

impl Placement {
    const IDENTITY: Placement =
        Placement { axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0; 3] };

    fn vector(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|row| self.axes[0][row] * x + self.axes[1][row] * y + self.axes[2][row] * z)
    }

    fn point(&self, point: [f64; 3]) -> [f64; 3] {
        let vector = self.vector(point);
        std::array::from_fn(|row| vector[row] + self.translation[row])
    }

    /// A normal keeps at right angles to its surface: the cofactors of the linear part move it.
    fn normal(&self, normal: [f64; 3]) -> [f64; 3] {
        let [a, b, c] = self.axes;
        let cofactors = Placement { axes: [cross(b, c), cross(c, a), cross(a, b)], translation: [0.0; 3] };
        let [x, y, z] = cofactors.vector(normal);
        let length = (x * x + y * y + z * z).sqrt();
        if 0.0 < length { [x / length, y / length, z / length] } else { [x, y, z] }
    }

    /// First `inner`, then this.
    fn then_inner(&self, inner: &Placement) -> Placement {
        Placement {
            axes: inner.axes.map(|axis| self.vector(axis)),
            translation: self.point(inner.translation),
        }
    }
}

fn cross([ax, ay, az]: [f64; 3], [bx, by, bz]: [f64; 3]) -> [f64; 3] {
    [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]
}

impl Node {
    fn placement(&self) -> Placement {
        if let Some(m) = self.matrix {
            let column = |c: usize| [m[4 * c], m[4 * c + 1], m[4 * c + 2]];
            return Placement { axes: [column(0), column(1), column(2)], translation: column(3) };
        }
        let [x, y, z, w] = self.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]);
        let scale = self.scale.unwrap_or([1.0; 3]);
        let rotation = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)],
            [2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)],
            [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)],
        ];
        let axes = std::array::from_fn(|axis| rotation[axis].map(|c| c * scale[axis]));
        Placement { axes, translation: self.translation.unwrap_or([0.0; 3]) }
    }
}

struct Collector<'a> {
    document: &'a Document,
    buffers: &'a [Vec<u8>],
    budget: u64,
    mesh: MeshData,
    has_normals: bool,
}

impl Collector<'_> {
    fn add(&mut self, primitive: &Primitive, placement: &Placement) -> Result<()> {
        let Some(position) = primitive.attributes.position else { return Ok(()) };
        if primitive.mode < mode_triangles() {
            return Ok(()); // points and lines
        }
        let Document { accessors, buffer_views, .. } = self.document;
        let elements = |index: usize, arity: usize| {
            let accessor = accessors.get(index).ok_or_else(|| invalid(format!("no accessor {index}")))?;
            accessor.elements(arity, buffer_views, self.buffers)
        };
        let positions = elements(position, 3)?;
        let normals = primitive.attributes.normal.map(|normal| elements(normal, 3)).transpose()?;
        let vertex_count = u32::try_from(positions.len()).map_err(|_| invalid("2³² vertices or more"))?;
        let indices = match primitive.indices {
            None => (0..vertex_count).collect(),
            Some(accessor) => elements(accessor, 1)?
                .indices()
                .ok_or_else(|| invalid("indices that are no unsigned integers"))?,
        };
        if let Some(index) = indices.iter().find(|index| **index >= vertex_count) {
            return Err(invalid(format!("index {index} of {vertex_count} vertices")));
        }
        let cost = 36 * u64::from(vertex_count) + 12 * indices.len() as u64;
        let too_large = || Error::too_large(FORMAT, "instances of meshes take more memory than the limit");
        self.budget = self.budget.checked_sub(cost).ok_or_else(too_large)?;
        let first = u32::try_from(self.mesh.positions.len()).ok();
        let Some(first) = first.filter(|first| first.checked_add(vertex_count).is_some()) else {
            return Err(Error::too_large(FORMAT, "more than 2³² vertices in all"));
        };
        self.mesh.positions.extend(positions.vectors().map(|position| placement.point(position)));
        self.mesh.triangles.extend(
            triangles(&indices, primitive.mode)?.into_iter().map(|triangle| triangle.map(|i| first + i)),
        );
        match normals {
            Some(normals) if normals.len() == positions.len() => {
                #[expect(clippy::cast_possible_truncation, reason = "normals are kept in 32 bits")]
                let narrow = |normal| placement.normal(normal).map(|c| c as f32);
                self.mesh.normals.extend(normals.vectors().map(narrow));
            }
            _ => self.has_normals = false,
        }
        Ok(())
    }

    fn finish(mut self) -> MeshData {
        if !self.has_normals {
            self.mesh.normals.clear();
        }
        self.mesh
    }
}

fn triangles(indices: &[u32], mode: u32) -> Result<Vec<[u32; 3]>> {
    match mode {
        4 => Ok(indices.as_chunks::<3>().0.to_vec()),
        5 => Ok(indices
            .windows(3)
            .enumerate()
            .map(|(index, strip)| {
                let (a, b, c) = (strip[0], strip[1], strip[2]);
                if index % 2 == 0 { [a, b, c] } else { [a, c, b] }
            })
            .collect()),
        6 => Ok(indices.windows(2).skip(1).map(|pair| [indices[0], pair[0], pair[1]]).collect()),
        mode => Err(invalid(format!("primitive mode {mode}; 0 to 6 are known"))),
    }
}

/// Points and lines have smaller codes.
fn mode_triangles() -> u32 {
    4
}
