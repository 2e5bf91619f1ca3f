//! Writes a sequence as a single `.glb`: a node per frame, and an animation that shows one node after the
//! other.
//!
//! ```text
//!   node      scale          0   1.5  2.5  3.5         in frames; STEP: each value holds until the next key
//!   frame 1   1 → 0          1    0
//!   frame 2   0 → 1 → 0      0    1    0
//!   frame 3   0 → 1          0         1    1
//! ```
//!
//! A program that plays frame by frame, such as Blender, counts frames from 1 and evaluates the animation of
//! its frame n at n / fps seconds. Frame n of the sequence is therefore visible from n − ½ to n + ½ frames,
//! so that rounding cannot select a neighbour. The first frame is also visible before, from time 0.
//!
//! A node scaled to zero is invisible. There are extensions for visibility, but Blender and three.js do not
//! read them yet, while every program that plays glTF supports scaling. A program that ignores the animation
//! shows only the first frame.
//!
//! The data of each frame is copied from its own file, byte for byte; only the JSON documents are combined,
//! with new indices and offsets. The data is therefore neither decoded nor rounded, and memory holds only one
//! copy buffer of it.
//!
//! The provenance of a sequence includes its [number of frames](SEQUENCE_FRAMES), which distinguishes it from
//! a single mesh.

use std::io::{self, Read, Seek, SeekFrom, Write};

use serde_json::{Map, Value, json};

use super::frame_file::GlbFrame;
use super::read::{chunks, invalid, parse};
use super::write::{glb_bytes, write_chunk_head};
use super::{CHUNK_BIN, CHUNK_JSON, FORMAT, GLB_MAGIC, GLB_VERSION, component, read_provenance};
use crate::core::data::Provenance;
use crate::core::error::{Error, Result};
use crate::core::provenance::GENERATOR;
pub use crate::core::sequence::{SEQUENCE_FRAMES, SequenceInfo};

/// The content of a `.glb` sequence of this crate, from the whole file; `None` for any other file.
///
/// # Errors
///
/// [`Error::Invalid`] if the sequence is damaged.
pub fn read_sequence_info(bytes: &[u8]) -> Result<Option<SequenceInfo>> {
    if !bytes.starts_with(&GLB_MAGIC) {
        return Ok(None);
    }
    let (json, _) = chunks(bytes)?;
    let provenance = read_provenance(json)?;
    let Some((_, frames)) = provenance.iter().find(|(name, _)| name == SEQUENCE_FRAMES) else {
        return Ok(None);
    };
    let frames = frames
        .parse()
        .map_err(|_| invalid(format!("the sequence has an invalid number of frames `{frames}`")))?;
    let document: Value = parse(json)?;
    let count = |accessor: &Value| {
        let index = usize::try_from(accessor.as_u64()?).ok()?;
        document["accessors"].get(index)?["count"].as_u64()
    };
    let mut info = SequenceInfo { frames, ..SequenceInfo::default() };
    for mesh in document["meshes"].as_array().into_iter().flatten() {
        let primitive = &mesh["primitives"][0];
        let counts = count(&primitive["attributes"]["POSITION"]).zip(count(&primitive["indices"]));
        let (vertices, corners) =
            counts.ok_or_else(|| invalid("a mesh lacks its number of vertices or of indices"))?;
        info.vertices = info.vertices.saturating_add(vertices);
        info.triangles = info.triangles.saturating_add(corners / 3);
    }
    Ok(Some(info))
}

/// A frame and its time.
#[derive(Clone, Debug)]
pub struct SequenceFrame {
    /// Its name.
    pub name: String,
    /// The frame number. Numbers can be missing: a frame is shown until the next one that exists. Frames
    /// before frame 0 have negative numbers.
    pub code: i64,
    /// Its file.
    pub file: GlbFrame,
}

/// Writes a sequence of frames, whose numbers must increase. `open` opens the file of a frame, by its index.
///
/// # Errors
///
/// [`Error::Io`] if a file cannot be read or `out` fails; [`Error::TooLarge`], before anything is written, if
/// the file would reach 4 GiB; [`Error::Invalid`] if a document is damaged or the numbers do not increase.
pub fn write_sequence<R: Read + Seek>(
    frames: &[SequenceFrame],
    fps: f64,
    provenance: &Provenance,
    open: impl Fn(usize) -> io::Result<R>,
    out: &mut impl Write,
) -> Result<()> {
    let mut shot = SequenceDocument::default();
    let keys = keys(frames, fps)?;
    // The keys come first; then the data of each frame, which is a multiple of four bytes.
    let key_bytes = keys.iter().map(|keys| keys.len() as u64 * KEY_BYTES).sum();
    shot.add_animation(frames, &keys, key_bytes)?;
    let mut bin_bytes: u64 = key_bytes;
    for (index, frame) in frames.iter().enumerate() {
        shot.add_frame(frame, &keys[index], bin_bytes)?;
        bin_bytes += frame.file.bin_bytes.next_multiple_of(4);
    }
    let mut json = serde_json::to_vec(&shot.document(provenance, bin_bytes))
        .map_err(|error| invalid(error.to_string()))?;
    json.resize(json.len().next_multiple_of(4), b' ');
    let total = glb_bytes(json.len() as u64, bin_bytes).ok_or_else(|| too_large(frames.len(), bin_bytes))?;

    out.write_all(&GLB_MAGIC)?;
    for number in [GLB_VERSION, total] {
        out.write_all(&number.to_le_bytes())?;
    }
    write_chunk_head(json.len() as u64, CHUNK_JSON, out)?;
    out.write_all(&json)?;
    if bin_bytes == 0 {
        return Ok(());
    }
    write_chunk_head(bin_bytes, CHUNK_BIN, out)?;
    write_keys(&keys, out)?;
    for (index, frame) in frames.iter().enumerate().filter(|(_, frame)| frame.file.bin_bytes > 0) {
        let mut file = open(index)?;
        file.seek(SeekFrom::Start(frame.file.bin_at))?;
        let copied = io::copy(&mut file.take(frame.file.bin_bytes), out)?;
        if copied != frame.file.bin_bytes {
            return Err(invalid(format!("{} became shorter while it was being read", frame.name)));
        }
        io::copy(&mut io::repeat(0).take(copied.next_multiple_of(4) - copied), out)?;
    }
    Ok(())
}

fn too_large(frame_count: usize, bin_bytes: u64) -> Error {
    let gibibytes = bin_bytes as f64 / f64::from(1 << 30);
    let what = format!(
        "{frame_count} frames take {gibibytes:.1} GiB, and the format's limit is 4 GiB: use fewer frames, write them \
         with --decimate or a larger voxel size, or write a .usda"
    );
    Error::too_large(FORMAT, what)
}

/// A key of a node's scale: time in seconds, and the factor, 0 or 1.
type ScaleKey = (f32, f32);

/// Size of a key in the file: a time, and a scale along three axes.
const KEY_BYTES: u64 = 16;

/// The keys of each frame; empty for a frame without a mesh.
fn keys(frames: &[SequenceFrame], fps: f64) -> Result<Vec<Vec<ScaleKey>>> {
    let first = frames.first().map_or(0, |frame| frame.code);
    // A frame starts half a frame before its own time. The first frame counts as number 1.
    #[expect(clippy::cast_possible_truncation, reason = "times have 32 bits")]
    let seconds = |code: i64| ((code.saturating_sub(first) as f64 + 0.5) / fps) as f32;
    let mut all = Vec::with_capacity(frames.len());
    for (index, frame) in frames.iter().enumerate() {
        let next = frames.get(index + 1).map(|next| seconds(next.code));
        let end = next.unwrap_or_else(|| seconds(frame.code.saturating_add(1)));
        let start = if index == 0 { 0.0 } else { seconds(frame.code) };
        if end <= seconds(frame.code) {
            return Err(invalid(format!(
                "the frame number of {} is too large, or equal to the next: 32-bit times cannot separate the two; \
                 renumber the frames, or write .abc",
                frame.name
            )));
        }
        if !frame.file.has_mesh() {
            all.push(Vec::new());
            continue;
        }
        let hidden = (index > 0).then_some((0.0, 0.0));
        // The last frame is shown for the length of one frame.
        let last = if next.is_some() { (end, 0.0) } else { (end, 1.0) };
        all.push(hidden.into_iter().chain([(start, 1.0), last]).collect());
    }
    Ok(all)
}

/// Writes the times of all keys, then the scales of all keys.
fn write_keys(keys: &[Vec<ScaleKey>], out: &mut impl Write) -> Result<()> {
    for (time, _) in keys.iter().flatten() {
        out.write_all(&time.to_le_bytes())?;
    }
    for (_, scale) in keys.iter().flatten() {
        out.write_all([scale.to_le_bytes(); 3].as_flattened())?;
    }
    Ok(())
}

/// The document under construction.
#[derive(Default)]
struct SequenceDocument {
    nodes: Vec<Value>,
    meshes: Vec<Value>,
    accessors: Vec<Value>,
    buffer_views: Vec<Value>,
    samplers: Vec<Value>,
    channels: Vec<Value>,
}

impl SequenceDocument {
    /// Adds the keys of all frames: two buffer views, and two accessors for each frame.
    fn add_animation(
        &mut self,
        frames: &[SequenceFrame],
        keys: &[Vec<ScaleKey>],
        key_bytes: u64,
    ) -> Result<()> {
        if key_bytes == 0 {
            return Ok(());
        }
        let time_bytes = key_bytes / 4;
        self.buffer_views.push(json!({"buffer": 0, "byteOffset": 0, "byteLength": time_bytes}));
        let scale_bytes = key_bytes - time_bytes;
        self.buffer_views.push(json!({"buffer": 0, "byteOffset": time_bytes, "byteLength": scale_bytes}));
        let mut start = 0;
        for (_, keys) in frames.iter().zip(keys).filter(|(_, keys)| !keys.is_empty()) {
            let times = |key: Option<&ScaleKey>| key.map(|(time, _)| [*time]);
            let (input, count) = (self.accessors.len(), keys.len());
            self.accessors.push(json!({
                "bufferView": 0, "byteOffset": 4 * start, "componentType": component::F32, "count": count,
                "type": "SCALAR", "min": times(keys.first()), "max": times(keys.last()),
            }));
            self.accessors.push(json!({
                "bufferView": 1, "byteOffset": 12 * start, "componentType": component::F32, "count": count,
                "type": "VEC3",
            }));
            let node = self.channels.len();
            self.channels.push(json!({"sampler": node, "target": {"node": node, "path": "scale"}}));
            self.samplers.push(json!({"input": input, "interpolation": "STEP", "output": input + 1}));
            start += count;
        }
        Ok(())
    }

    /// Adds a frame whose data starts at offset `data_at` of the buffer.
    fn add_frame(&mut self, frame: &SequenceFrame, keys: &[ScaleKey], data_at: u64) -> Result<()> {
        let document = &frame.file.document;
        let list = |name: &str| document[name].as_array().cloned().unwrap_or_default();
        let Some(&(_, rest)) = keys.first() else { return Ok(()) };
        let (first_view, first_accessor) = (self.buffer_views.len(), self.accessors.len());
        for mut view in list("bufferViews") {
            let at = view["byteOffset"].as_u64().unwrap_or_default();
            object(&mut view)?.insert("byteOffset".into(), (at + data_at).into());
            self.buffer_views.push(view);
        }
        for mut accessor in list("accessors") {
            shift(accessor.get_mut("bufferView"), first_view, "`bufferView` of an accessor")?;
            self.accessors.push(accessor);
        }
        let mut mesh =
            list("meshes").into_iter().next().ok_or_else(|| invalid("the document has no mesh"))?;
        let primitive =
            mesh.pointer_mut("/primitives/0").ok_or_else(|| invalid("the mesh has no primitive"))?;
        shift(primitive.get_mut("indices"), first_accessor, "`indices` of a mesh")?;
        for index in
            primitive.get_mut("attributes").map(object).transpose()?.into_iter().flat_map(Map::values_mut)
        {
            shift(Some(index), first_accessor, "an attribute of a mesh")?;
        }
        object(&mut mesh)?.insert("name".into(), frame.name.as_str().into());
        let mut node = list("nodes").into_iter().next().ok_or_else(|| invalid("the document has no node"))?;
        let entries = object(&mut node)?;
        entries.insert("name".into(), frame.name.as_str().into());
        entries.insert("mesh".into(), self.meshes.len().into());
        entries.insert("scale".into(), json!([rest, rest, rest]));
        self.meshes.push(mesh);
        self.nodes.push(node);
        Ok(())
    }

    fn document(self, provenance: &Provenance, bin_bytes: u64) -> Value {
        let ours: Map<String, Value> =
            provenance.iter().map(|(key, value)| (key.clone(), value.as_str().into())).collect();
        let asset = json!({"version": "2.0", "generator": GENERATOR, "extras": {"meniscus": ours}});
        let mut document = Map::from_iter([("asset".to_owned(), asset), ("scene".to_owned(), 0.into())]);
        let mut scene = Map::from_iter([("name".to_owned(), Value::from("shot"))]);
        if !self.nodes.is_empty() {
            scene.insert("nodes".into(), (0..self.nodes.len()).collect());
            let animation = json!({"name": "shot", "channels": self.channels, "samplers": self.samplers});
            document.insert("animations".into(), json!([animation]));
            document.insert("buffers".into(), json!([{"byteLength": bin_bytes}]));
        }
        document.insert("scenes".into(), json!([scene]));
        let lists = [
            ("nodes", self.nodes),
            ("meshes", self.meshes),
            ("accessors", self.accessors),
            ("bufferViews", self.buffer_views),
        ];
        // glTF does not allow empty lists.
        for (name, list) in lists.into_iter().filter(|(_, list)| !list.is_empty()) {
            document.insert(name.to_owned(), list.into());
        }
        Value::Object(document)
    }
}

fn object(value: &mut Value) -> Result<&mut Map<String, Value>> {
    value.as_object_mut().ok_or_else(|| invalid("a part of the document is not an object"))
}

/// Increases an index by the number of items that precede it in the combined document. `property` names it in
/// errors.
fn shift(index: Option<&mut Value>, by: usize, property: &str) -> Result<()> {
    let index = index.ok_or_else(|| invalid(format!("{property} is missing")))?;
    let number = index.as_u64().ok_or_else(|| invalid(format!("{property} is not an index")))?;
    *index = (number + by as u64).into();
    Ok(())
}
