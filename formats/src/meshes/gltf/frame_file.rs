//! Opens a single-frame `.glb` of this crate: parses the document and locates the data, but does not read the
//! data. A sequence can thus be assembled without holding all frames in memory.

use std::io::{ErrorKind, Read, Seek, SeekFrom};

use serde_json::{Map, Value};

use super::read::invalid;
use super::sequence::SequenceFrame;
use super::write::usual_name;
use super::{CHUNK_BIN, CHUNK_JSON, FORMAT, GLB_MAGIC, component};
use crate::core::error::{Error, Position, Result};
use crate::core::options::{UpAxis, WriteOption};

/// A frame of a sequence.
#[derive(Clone, Debug)]
pub struct GlbFrame {
    /// The document, which is small compared to the data.
    pub(crate) document: Value,
    /// Offset of the data in the file.
    pub(crate) bin_at: u64,
    /// Size of the data in bytes.
    pub(crate) bin_bytes: u64,
}

/// The names of attributes with a meaning in the files of the frames.
pub(crate) const POSITION: &str = "POSITION";
pub(crate) const NORMAL: &str = "NORMAL";
pub(crate) const VELOCITY: &str = "_VELOCITY";
pub(crate) const ACCELERATION: &str = "_ACCELERATION";
pub(crate) const COLOR: &str = "COLOR_0";
pub(crate) const TEXTURE: &str = "TEXCOORD_0";

/// Texture coordinates from the lower left corner of a picture if they are from the upper left corner, as in glTF, and
/// the reverse.
pub(crate) fn flipped([u, v]: [f32; 2]) -> [f32; 2] {
    [u, 1.0 - v]
}

/// Limit for the JSON text of a frame, in bytes.
const JSON_BYTES_MAX: u64 = 64 << 20;

/// Location and type of the numbers of an accessor: a vertex attribute, or the indices.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct VertexColumn {
    component: u32,
    pub(crate) arity: usize,
    pub(crate) count: usize,
    /// Offset from the start of the file.
    start: u64,
}

impl VertexColumn {
    /// The bytes of all numbers of a vertex; `None` for a type that is not written.
    fn element_bytes(&self) -> Option<usize> {
        match self.component {
            component::U16 => Some(2 * self.arity),
            component::U32 | component::F32 => Some(4 * self.arity),
            _ => None,
        }
    }
}

impl GlbFrame {
    /// Reads the document of a frame, and checks that the file is complete and was written by this program.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] if reading fails; [`Error::Truncated`] if the file is truncated; [`Error::Unsupported`]
    /// if another program wrote the file, or if it is already a sequence; [`Error::Invalid`] if it is
    /// damaged.
    pub fn read(file: &mut (impl Read + Seek)) -> Result<GlbFrame> {
        let file_bytes = file.seek(SeekFrom::End(0))?;
        file.seek(SeekFrom::Start(0))?;
        let mut head = [0; 20];
        let head_bytes = file_bytes.min(HEAD_BYTES) as usize;
        file.read_exact(&mut head[..head_bytes])?;
        let of_magic = head_bytes.min(GLB_MAGIC.len());
        if head[..of_magic] != GLB_MAGIC[..of_magic] {
            return Err(Error::unsupported("", NO_GLB));
        }
        if head_bytes < head.len() {
            return Err(Error::truncated(FORMAT, Position::File, "expected a GLB header"));
        }
        let word = |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        if head[16..] != CHUNK_JSON {
            return Err(Error::invalid(FORMAT, Position::Offset(0), "expected a GLB header"));
        }
        if u64::from(word(8)) != file_bytes {
            let what = format!("the file has {file_bytes} bytes, but its header declares {}", word(8));
            return Err(Error::truncated(FORMAT, Position::File, what));
        }
        let json_bytes = u64::from(word(12));
        if json_bytes > JSON_BYTES_MAX.min(file_bytes) {
            return Err(Error::unsupported(FORMAT, NOT_OURS));
        }
        let mut json = Vec::new();
        file.take(json_bytes).read_to_end(&mut json)?;
        let document: Value = serde_json::from_slice(&json).map_err(|error| invalid(error.to_string()))?;
        let (bin_at, bin_bytes) = match file_bytes - HEAD_BYTES - json_bytes.min(file_bytes - HEAD_BYTES) {
            0 => (file_bytes, 0),
            _ => {
                let mut head = [0; 8];
                file.read_exact(&mut head).map_err(|_| invalid("the header of a chunk is missing"))?;
                let [a, b, c, d, kind @ ..] = head;
                let (at, length) = (HEAD_BYTES + json_bytes + 8, u64::from(u32::from_le_bytes([a, b, c, d])));
                if kind != CHUNK_BIN || at + length != file_bytes {
                    return Err(Error::unsupported(FORMAT, NOT_OURS));
                }
                (at, length)
            }
        };
        let frame = GlbFrame { document, bin_at, bin_bytes };
        frame.check()?;
        Ok(frame)
    }

    fn check(&self) -> Result<()> {
        let generator = self.document["asset"]["generator"].as_str().unwrap_or_default();
        let count = |name: &str| self.document[name].as_array().map_or(0, Vec::len);
        if !generator.starts_with("meniscus ") || count("buffers") > 1 {
            return Err(Error::unsupported(FORMAT, NOT_OURS));
        }
        if count("animations") > 0 || count("nodes") > 1 || count("meshes") > 1 {
            return Err(Error::unsupported(FORMAT, "this file is already a sequence, not a single frame"));
        }
        if self.has_mesh() {
            self.placement()?;
            self.triangle_count()?;
            let position = self.column(POSITION)?.ok_or_else(|| invalid("the mesh has no positions"))?;
            let normal = self.column(NORMAL)?.ok_or_else(|| invalid("the mesh has no normals"))?;
            if (position.arity, normal.arity) != (3, 3) || position.count != normal.count {
                return Err(invalid("the positions and normals do not match"));
            }
            let names = self.attributes()?.keys();
            for name in names {
                if self.column(name)?.is_some_and(|column| column.count != position.count) {
                    return Err(invalid(format!("the positions and {name} do not match")));
                }
            }
        }
        Ok(())
    }

    /// The provenance of the frame.
    pub fn provenance(&self) -> Vec<(String, String)> {
        let recorded = self.document["asset"]["extras"]["meniscus"].as_object();
        let pair = |(name, value): (&String, &Value)| Some((name.clone(), value.as_str()?.to_owned()));
        recorded.into_iter().flatten().filter_map(pair).collect()
    }

    /// Whether the frame has a mesh.
    pub fn has_mesh(&self) -> bool {
        self.document["meshes"].as_array().is_some_and(|meshes| !meshes.is_empty())
    }

    /// The number of vertices.
    pub fn vertex_count(&self) -> usize {
        self.column(POSITION).ok().flatten().map_or(0, |column| column.count)
    }

    /// The number of triangles.
    ///
    /// # Errors
    ///
    /// [`Error::Invalid`] if the document is damaged.
    pub fn triangle_count(&self) -> Result<usize> {
        if !self.has_mesh() {
            return Ok(0);
        }
        Ok(self.indices()?.count / 3)
    }

    pub(crate) fn attributes(&self) -> Result<&Map<String, Value>> {
        let attributes = self.document["meshes"][0]["primitives"][0]["attributes"].as_object();
        attributes.ok_or_else(|| invalid("the mesh has no attributes"))
    }

    /// Whether the values of this attribute are indices into strings.
    pub(crate) fn has_string_indices(&self, semantic: &str) -> bool {
        !self.document["meshes"][0]["extras"]["strings"][semantic].is_null()
    }

    /// The name that an attribute had before it got its glTF name, if the two do not follow from each other.
    pub(super) fn own_name(&self, semantic: &str) -> Option<&str> {
        self.document["meshes"][0]["extras"]["names"][semantic].as_str()
    }

    /// The numbers of the named attribute, if the vertices have it.
    pub(crate) fn column(&self, semantic: &str) -> Result<Option<VertexColumn>> {
        if !self.has_mesh() {
            return Ok(None);
        }
        let Some(index) = self.attributes()?.get(semantic) else { return Ok(None) };
        self.accessor(index).map(Some)
    }

    fn indices(&self) -> Result<VertexColumn> {
        self.accessor(&self.document["meshes"][0]["primitives"][0]["indices"])
    }

    fn accessor(&self, index: &Value) -> Result<VertexColumn> {
        let missing = || invalid(NOT_OURS);
        let at = |array: &'static str, index: &Value| {
            let index = usize::try_from(index.as_u64()?).ok()?;
            self.document[array].as_array()?.get(index)
        };
        let number = |value: &Value| usize::try_from(value.as_u64()?).ok();
        let accessor = at("accessors", index).ok_or_else(missing)?;
        let view = at("bufferViews", &accessor["bufferView"]).ok_or_else(missing)?;
        let kind = accessor["type"].as_str().unwrap_or_default();
        let arity = 1 + TYPES.iter().position(|name| *name == kind).ok_or_else(missing)?;
        let component =
            accessor["componentType"].as_u64().and_then(|code| u32::try_from(code).ok()).unwrap_or_default();
        let (count, offset) = (number(&accessor["count"]), view["byteOffset"].as_u64().unwrap_or_default());
        let count = count.ok_or_else(missing)?;
        let column = VertexColumn { component, arity, count, start: self.bin_at + offset };
        let element_bytes = column.element_bytes().ok_or_else(missing)? as u64;
        let (length, needed) = (view["byteLength"].as_u64(), (count as u64).checked_mul(element_bytes));
        let (length, needed) = length.zip(needed).ok_or_else(missing)?;
        let is_inside = offset.checked_add(length).is_some_and(|end| end <= self.bin_bytes);
        if !is_inside || needed > length {
            return Err(invalid(format!("the accessor {index} exceeds the data")));
        }
        Ok(column)
    }

    /// The placement of the frame.
    pub(crate) fn placement(&self) -> Result<SequencePlacement> {
        let node = &self.document["nodes"][0];
        let vector =
            |name: &str| -> Option<Vec<f64>> { node[name].as_array()?.iter().map(Value::as_f64).collect() };
        let up = match vector("rotation").as_deref() {
            None => UpAxis::Y,
            Some([x, y, z, w]) if *y == 0.0 && *z == 0.0 && *w > 0.0 && (x + w).abs() < 1e-9 => UpAxis::Z,
            Some(_) => {
                return Err(invalid(
                    "expected the node to have no `rotation`, or one of -90 degrees about the x axis",
                ));
            }
        };
        let translation = vector("translation").unwrap_or_else(|| vec![0.0; 3]);
        let &[x, y, z] = &*translation else {
            return Err(invalid("expected the `translation` of the node to have three numbers"));
        };
        let origin = match up {
            UpAxis::Y => [x, y, z],
            UpAxis::Z => [x, 0.0 - z, y],
        };
        Ok(SequencePlacement { up, origin })
    }

    /// The smallest and largest position; zeros for a frame without a mesh.
    pub(super) fn bounds(&self) -> Result<[[f64; 3]; 2]> {
        if self.column(POSITION)?.is_none() {
            return Ok([[0.0; 3]; 2]);
        }
        let index = self.attributes()?[POSITION].as_u64().and_then(|index| usize::try_from(index).ok());
        let accessor = &self.document["accessors"][index.unwrap_or_default()];
        let corner = |name: &str| -> Option<[f64; 3]> {
            let numbers: Option<Vec<f64>> = accessor[name].as_array()?.iter().map(Value::as_f64).collect();
            <[f64; 3]>::try_from(numbers?).ok()
        };
        let corners = corner("min").zip(corner("max"));
        corners.map(|(min, max)| [min, max]).ok_or_else(|| invalid("the positions have no bounds"))
    }

    /// Reads vertex data, which replace the `values`.
    fn read_column(
        &self,
        column: &VertexColumn,
        file: &mut (impl Read + Seek),
        values: &mut Vec<f32>,
    ) -> Result<()> {
        if column.component != component::F32 {
            return Err(invalid(NOT_OURS));
        }
        values.clear();
        values.reserve_exact(column.count * column.arity);
        read_pieces(column, file, |bytes| {
            values.extend(bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)));
        })
    }

    /// Reads the triangles, which replace the given ones, and checks their indices. A frame without a mesh has
    /// none.
    pub(crate) fn read_triangles(
        &self,
        file: &mut (impl Read + Seek),
        triangles: &mut Vec<[u32; 3]>,
    ) -> Result<()> {
        triangles.clear();
        if !self.has_mesh() {
            return Ok(());
        }
        let column = self.indices()?;
        let is_narrow = match (column.component, column.arity) {
            (component::U16, 1) => true,
            (component::U32, 1) => false,
            _ => return Err(invalid("the indices have an unexpected type")),
        };
        triangles.reserve_exact(column.count / 3);
        read_pieces(&column, file, |bytes| {
            if is_narrow {
                let corners = bytes.as_chunks().0.as_chunks::<3>().0.iter();
                triangles
                    .extend(corners.map(|corners| corners.map(|bytes| u16::from_le_bytes(bytes).into())));
            } else {
                let corners = bytes.as_chunks().0.as_chunks::<3>().0.iter();
                triangles.extend(corners.map(|corners| corners.map(u32::from_le_bytes)));
            }
        })?;
        let vertex_count = self.vertex_count();
        if let Some(index) = triangles.as_flattened().iter().find(|&&index| index as usize >= vertex_count) {
            return Err(invalid(format!(
                "a triangle has vertex index {index}, but the mesh has {vertex_count} vertices"
            )));
        }
        Ok(())
    }
}

/// Reads vertex data in pieces of [`PIECE`] elements or less, and passes their bytes to `take`. So the bytes
/// and the decoded values are not all in memory at once.
fn read_pieces(
    column: &VertexColumn,
    file: &mut (impl Read + Seek),
    mut take: impl FnMut(&[u8]),
) -> Result<()> {
    let element_bytes = column.element_bytes().ok_or_else(|| invalid(NOT_OURS))?;
    file.seek(SeekFrom::Start(column.start))?;
    let mut bytes = Vec::new();
    for first in (0..column.count).step_by(PIECE) {
        let count = PIECE.min(column.count - first);
        bytes.resize(count * element_bytes, 0); // at most the size of the file
        match file.read_exact(&mut bytes) {
            Err(error) if error.kind() == ErrorKind::UnexpectedEof => {
                let what = "the file became shorter while it was being read";
                return Err(Error::truncated(FORMAT, Position::File, what));
            }
            read => read?,
        }
        take(&bytes);
    }
    Ok(())
}

/// The elements that are read at a time: whole triangles, and few enough for the cache.
const PIECE: usize = 3 << 12;

const HEAD_BYTES: u64 = 20;

const NO_GLB: &str = "this is not a .glb: use the .glb, .abc or .usdc files of the frames";

const NOT_OURS: &str =
    "this .glb was not written by meniscus, or was changed: use the .glb files of the frames";

/// The names of vectors with one to four components.
const TYPES: [&str; 4] = ["SCALAR", "VEC2", "VEC3", "VEC4"];

// The placement of the frames of a sequence, relative to one origin.

/// The placement of a frame, or of all frames of a sequence.
///
/// Frames far from the world's origin have origins of their own, which jump from one frame to the next.
/// Programs interpolate transforms, and compute motion blur from them. So a sequence has one origin, that of
/// its first frame with a mesh, and the positions of all frames are relative to it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct SequencePlacement {
    pub(crate) up: UpAxis,
    /// The point that positions are relative to, in the axes of the particles.
    pub(crate) origin: [f64; 3],
}

impl SequencePlacement {
    /// The placement of these frames. Without any mesh, points beside them have the axes that the first frame was
    /// made with.
    ///
    /// # Errors
    ///
    /// [`Error::Invalid`] if a document is damaged, or if frames differ in their up axis.
    pub(crate) fn of(
        frames: &[SequenceFrame],
        has_points: bool,
        format: &'static str,
    ) -> Result<SequencePlacement> {
        let mut first = None;
        for frame in frames.iter().filter(|frame| frame.file.has_mesh()) {
            let placement = frame.file.placement()?;
            if placement.up != first.get_or_insert(placement).up {
                let what = "some frames have Y up and others Z up: convert all frames with the same --up";
                return Err(Error::invalid(format, Position::File, what));
            }
        }
        let of_points = || {
            let recorded = frames.first().filter(|_| has_points)?.file.provenance();
            let (_, up) = recorded.iter().find(|(name, _)| name == WriteOption::Up.name())?;
            let up = if up == UpAxis::Z.name() { UpAxis::Z } else { UpAxis::Y };
            Some(SequencePlacement { up, ..SequencePlacement::default() })
        };
        Ok(first.or_else(of_points).unwrap_or_default())
    }

    /// What must be added to the positions of a frame.
    pub(crate) fn shift(&self, frame: &GlbFrame) -> Result<[f64; 3]> {
        let origin = if frame.has_mesh() { frame.placement()?.origin } else { self.origin };
        Ok(std::array::from_fn(|axis| origin[axis] - self.origin[axis]))
    }
}

#[expect(clippy::cast_possible_truncation, reason = "positions are written in 32 bits")]
fn shifted(position: [f32; 3], shift: [f64; 3]) -> [f32; 3] {
    std::array::from_fn(|axis| (f64::from(position[axis]) + shift[axis]) as f32)
}

impl GlbFrame {
    /// Reads a vertex attribute, whose numbers replace the `values`. Returns how many each vertex has; `None`
    /// if the vertices do not have the attribute. Positions are shifted, and texture coordinates are from the lower left
    /// corner.
    pub(crate) fn read_attribute(
        &self,
        semantic: &str,
        shift: [f64; 3],
        file: &mut (impl Read + Seek),
        values: &mut Vec<f32>,
    ) -> Result<Option<usize>> {
        values.clear();
        let Some(column) = self.column(semantic)? else { return Ok(None) };
        self.read_column(&column, file, values)?;
        if semantic == POSITION {
            values.as_chunks_mut().0.iter_mut().for_each(|position| *position = shifted(*position, shift));
        }
        if semantic == TEXTURE && column.arity == 2 {
            values.as_chunks_mut().0.iter_mut().for_each(|row| *row = flipped(*row));
        }
        Ok(Some(column.arity))
    }

    /// The smallest and the largest shifted position; zeros for a frame without a mesh.
    pub(crate) fn shifted_bounds(&self, shift: [f64; 3]) -> Result<[[f32; 3]; 2]> {
        #[expect(clippy::cast_possible_truncation, reason = "positions are written in 32 bits")]
        let corner = |corner: [f64; 3]| shifted(corner.map(|along| along as f32), shift);
        Ok(self.bounds()?.map(corner))
    }
}

// The vertex attributes that a sequence can have: those of all its frames.

/// A vertex attribute that all frames with a mesh have.
pub(crate) struct SharedAttribute {
    /// Its name in the frames' `.glb` files.
    pub(crate) semantic: String,
    /// Its name in the first frame with a name of its own. A format may have a property for it instead.
    pub(crate) name: String,
    /// Number of values per vertex.
    pub(crate) arity: usize,
}

/// The attributes that all frames with a mesh have, in the order of their names in the `.glb` files, and
/// notes on the others. Positions and normals are not among them: every mesh has these.
///
/// # Errors
///
/// [`Error::Invalid`](crate::Error::Invalid) if a document is damaged.
pub(crate) fn shared_attributes(frames: &[SequenceFrame]) -> Result<(Vec<SharedAttribute>, Vec<String>)> {
    let files: Vec<&GlbFrame> =
        frames.iter().map(|frame| &frame.file).filter(|file| file.has_mesh()).collect();
    let mut semantics: Vec<&String> = Vec::new();
    for file in &files {
        semantics.extend(file.attributes()?.keys());
    }
    semantics.sort();
    semantics.dedup();
    let (mut shared, mut notes) = (Vec::new(), Vec::new());
    for semantic in semantics.into_iter().filter(|semantic| ![NORMAL, POSITION].contains(&semantic.as_str()))
    {
        match arity(&files, semantic)? {
            Ok(arity) => {
                let own_name = files.iter().find_map(|file| file.own_name(semantic));
                let name = own_name.map_or_else(|| usual_name(semantic), str::to_owned);
                shared.push(SharedAttribute { semantic: semantic.clone(), name, arity });
            }
            Err(why) => notes.push(format!("{semantic} is missing in the sequence: {why}")),
        }
    }
    Ok((shared, notes))
}

/// The number of values per vertex of an attribute, or why a sequence cannot have it.
fn arity(files: &[&GlbFrame], semantic: &str) -> Result<std::result::Result<usize, &'static str>> {
    if files.iter().any(|file| file.has_string_indices(semantic)) {
        return Ok(Err("its values are strings, and each frame has its own table"));
    }
    let columns: Vec<Option<VertexColumn>> =
        files.iter().map(|file| file.column(semantic)).collect::<Result<_>>()?;
    let mut arities = columns.iter().map(|column| column.map(|column| column.arity));
    let first = arities.next().flatten().filter(|first| arities.all(|arity| arity == Some(*first)));
    Ok(first.ok_or("not all frames have it with the same number of values per vertex"))
}
