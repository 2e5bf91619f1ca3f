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
//! USD allows samples with different numbers of vertices, and holds such a sample until the next. If the next
//! frame has the same number of vertices, the sample is repeated just before it, so that USD does not blend
//! them.

use std::io::{self, Read, Seek, Write};

use crate::data::Provenance;
use crate::error::Result;
use crate::gltf::SequenceFrame;
use crate::usd::{Elements, PRIM, SequenceAttribute, TRANSLATE, UsdSequence, attribute_of};

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
/// [`Error::Invalid`](crate::Error::Invalid) if a document is damaged, numbers do not increase, or frames
/// differ in their up axis; [`Error::Unsupported`](crate::Error::Unsupported) for numbers beyond 2⁵³.
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
    let head = head(
        provenance,
        (Some(&info), &[]),
        (shot.placement.up, meters_per_unit),
        &times(shot.code_range(), fps),
    );
    write!(out, "{head}    def Mesh \"{PRIM}\"\n    {{\n")?;

    write_lines(&shot, "float3[] extent", out, |index| {
        let [low, high] = shot.extent(index)?;
        Ok(format!("[{}, {}]", triple(low), triple(high)))
    })?;
    write_samples(&shot, "int[] faceVertexCounts", out, |index| {
        let triangles = vec![[0; 3]; frames[index].file.triangle_count()?];
        Ok(Elements::FaceCounts { triangles: &triangles, quads: &[] }.texts())
    })?;
    let mut triangles = Vec::new();
    write_samples(&shot, "int[] faceVertexIndices", out, |index| {
        frames[index].file.read_triangles(&mut open(index)?, &mut triangles)?;
        Ok(Elements::FaceCorners { triangles: &triangles, quads: &[] }.texts())
    })?;
    out.write_all(b"        uniform token orientation = \"rightHanded\"\n")?;
    let mut values = Vec::new();
    for attribute in &attributes {
        let SequenceAttribute { semantic, kind, name, first, arity, is_per_vertex } = attribute;
        if *is_per_vertex {
            writeln!(out, "        {kind} {name}{}", about(true, 1))?;
        }
        write_samples(&shot, &format!("{kind} {name}"), out, |index| {
            let (frame, transform) = (&frames[index].file, shot.transform(index)?);
            let found = frame.read_attribute(semantic, &transform, &mut open(index)?, &mut values)?;
            let Some(stride) = found else { return Ok(Vec::new()) };
            Ok(Elements::Reals { values: &values, stride, first: *first, arity: *arity }.texts())
        })?;
    }
    out.write_all(b"        uniform token subdivisionScheme = \"none\"\n")?;
    if let Some(origin) = shot.origin() {
        writeln!(out, "        double3 {TRANSLATE} = {}", triple(origin))?;
        writeln!(out, "        uniform token[] xformOpOrder = [\"{TRANSLATE}\"]")?;
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

/// Writes an array with samples of each frame, formatted by `texts`; they are empty for a frame without a
/// mesh.
fn write_samples(
    shot: &UsdSequence,
    name: &str,
    out: &mut impl Write,
    mut texts: impl FnMut(usize) -> Result<Vec<Vec<u8>>>,
) -> Result<()> {
    writeln!(out, "        {name}{SAMPLES}")?;
    for (index, frame) in shot.frames.iter().enumerate() {
        let texts = if frame.file.has_mesh() { texts(index)? } else { Vec::new() };
        for code in shot.vertex_codes(index) {
            write!(out, "            {code}: [")?;
            texts.iter().try_for_each(|text| out.write_all(text))?;
            out.write_all(b"],\n")?;
        }
    }
    out.write_all(b"        }\n")?;
    Ok(())
}

/// Writes a property that has the same size in all frames, with a line for each sample.
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
