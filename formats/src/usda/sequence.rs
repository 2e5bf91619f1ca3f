//! Writes a sequence as one mesh whose attributes have a sample per frame.
//!
//! ```text
//!   point3f[] points.timeSamples = {
//!       1001: [(0.5, 1, 2), ..],
//!       1002: [..],
//!   }
//! ```
//!
//! The samples of an attribute are contiguous, so the writer visits all frames once per attribute. From the
//! files of the frames, which are `.glb` files of this crate, it reads only the required data. At any time,
//! only one attribute of one frame and its text are in memory.
//!
//! USD allows samples with different numbers of vertices, and holds such a sample until the next. But if two
//! consecutive samples happen to have the same number of vertices, USD blends them at times between the
//! frames, although their vertices do not correspond. So programs should evaluate the mesh only at the times
//! of frames; for motion blur they can use `velocities`.

use std::io::{self, Read, Seek, Write};

use crate::data::Provenance;
use crate::error::Result;
use crate::gltf::{FramePlacement, SequenceFrame};
use crate::usd::{Elements, POSITION, PRIM, SequenceAttribute, UsdSequence, attribute_of};

use super::head::{LAST_LINE, head, times};
use super::numbers::triple;
use super::write::about;

/// Writes a sequence of frames, whose numbers become the time codes and must increase. `open` opens the file
/// of the frame with the given index. Returns notes on attributes that are omitted because the frames differ
/// in them.
///
/// # Errors
///
/// [`Error::Io`](crate::Error::Io) if a file cannot be read or `out` fails;
/// [`Error::Invalid`](crate::Error::Invalid) if a document is damaged, numbers do not increase, or frames differ
/// in their up axis; [`Error::Unsupported`](crate::Error::Unsupported) for numbers beyond 2⁵³.
pub fn write_sequence<R: Read + Seek>(
    frames: &[SequenceFrame],
    (fps, meters_per_unit): (f64, f64),
    provenance: &Provenance,
    open: impl Fn(usize) -> io::Result<R>,
    out: &mut impl Write,
) -> Result<Vec<String>> {
    let shot = UsdSequence::of(frames)?;
    let info = shot.layer_info()?;
    let (attributes, notes) = shot.attributes()?;
    let head =
        head(provenance, (Some(&info), &[]), (shot.up, meters_per_unit), &times(shot.code_range(), fps));
    write!(out, "{head}    def Mesh \"{PRIM}\"\n    {{\n")?;

    write_lines(&shot, "float3[] extent", out, |index| {
        let [low, high] = shot.extent(index)?;
        Ok(format!("[{}, {}]", triple(low), triple(high)))
    })?;
    write_samples(&shot, "int[] faceVertexCounts", out, |index, _| {
        let triangles = vec![[0; 3]; frames[index].file.triangle_count()?];
        Ok(Elements::FaceCounts { triangles: &triangles, quads: &[] }.texts())
    })?;
    write_samples(&shot, "int[] faceVertexIndices", out, |index, _| {
        let triangles = frames[index].file.read_triangles(&mut open(index)?)?;
        Ok(Elements::FaceCorners { triangles: &triangles, quads: &[] }.texts())
    })?;
    out.write_all(b"        uniform token orientation = \"rightHanded\"\n")?;
    for attribute in &attributes {
        let SequenceAttribute { semantic, kind, name, first, arity, is_per_vertex } = attribute;
        if *is_per_vertex {
            writeln!(out, "        {kind} {name}{}", about(true, 1))?;
        }
        write_samples(&shot, &format!("{kind} {name}"), out, |index, placement| {
            let frame = &frames[index].file;
            let Some(column) = frame.column(semantic)? else { return Ok(Vec::new()) };
            let scale = if semantic == POSITION { placement.scale } else { 1.0 };
            let values = frame.read_column(&column, scale, &mut open(index)?)?;
            let (stride, first, arity) = (column.arity, *first, *arity);
            Ok(Elements::Reals { values: &values, stride, first, arity }.texts())
        })?;
    }
    out.write_all(b"        uniform token subdivisionScheme = \"none\"\n")?;
    if let Some(origins) = shot.origins() {
        write_lines(&shot, "double3 xformOp:translate", out, |index| Ok(triple(origins[index])))?;
        out.write_all(b"        uniform token[] xformOpOrder = [\"xformOp:translate\"]\n")?;
    }
    let (count, vertices, faces) = (frames.len(), info.vertices, info.faces);
    write!(out, "    }}\n}}\n\n{LAST_LINE}{count} frames, {vertices} vertices, {faces} faces\n")?;
    Ok(notes)
}

/// The end of the line before the samples of a property.
const SAMPLES: &str = ".timeSamples = {";

/// The names of the vertex attributes of a sequence of this crate, except normals.
pub fn read_attribute_names(bytes: &[u8]) -> Vec<String> {
    let name = |line: &[u8]| {
        let property = line.strip_suffix(SAMPLES.as_bytes())?;
        let (_, name) = std::str::from_utf8(property).ok()?.rsplit_once(' ')?;
        Some(attribute_of(name)?.to_owned())
    };
    bytes.split(|&byte| byte == b'\n').filter_map(name).collect()
}

/// Writes an array with a sample per frame, formatted by `texts`; the sample is empty for a frame without a
/// mesh.
fn write_samples(
    shot: &UsdSequence,
    name: &str,
    out: &mut impl Write,
    texts: impl Fn(usize, &FramePlacement) -> Result<Vec<Vec<u8>>>,
) -> Result<()> {
    writeln!(out, "        {name}{SAMPLES}")?;
    for (index, frame) in shot.frames.iter().enumerate() {
        write!(out, "            {}: [", frame.code)?;
        if let Some(placement) = &shot.placements[index] {
            for text in texts(index, placement)? {
                out.write_all(&text)?;
            }
        }
        out.write_all(b"],\n")?;
    }
    out.write_all(b"        }\n")?;
    Ok(())
}

/// Writes a line for each time code at which a frame needs one.
fn write_lines(
    shot: &UsdSequence,
    name: &str,
    out: &mut impl Write,
    line: impl Fn(usize) -> Result<String>,
) -> Result<()> {
    writeln!(out, "        {name}{SAMPLES}")?;
    for index in 0..shot.frames.len() {
        let line = line(index)?;
        for code in shot.held_codes(index) {
            writeln!(out, "            {code}: {line},")?;
        }
    }
    out.write_all(b"        }\n")?;
    Ok(())
}
