//! Writes a sequence as one mesh whose attributes have a sample per frame.
//!
//! The writer visits the frames once, in order. It writes their arrays one after the other, and at the end
//! the time samples, which refer to the arrays. At any time, only one attribute of one frame is in memory.
//! Equal arrays, such as those of a fluid at rest, are written once, as OpenUSD does.
//! The attributes of a frame have the same time codes, so its `velocities` are valid for its `points`.
//!
//! USD allows samples with different numbers of vertices, and holds each of them until the next sample.

use std::collections::HashMap;
use std::io::{self, Read, Seek, SeekFrom, Write};

use crate::data::Provenance;
use crate::digest::{Hasher, SampleKey};
use crate::error::Result;
use crate::gltf::SequenceFrame;
use crate::usd::{Elements, POSITION, PRIM, SequenceAttribute, UsdSequence};

use super::array::CrateArray;
use super::contents::CONTENTS_AT;
use super::layer::{LayerEnd, LayerHead, PropertySpec, SpecValue, head, padding};
use super::value::{ValueRep, ValueType};

/// Writes a sequence of frames, whose numbers become the time codes and must increase. `open` opens the file
/// of a frame, by its index; position 0 of `out` is the start of the file. Returns notes on attributes that
/// are renamed, or omitted because the frames differ in them.
///
/// # Errors
///
/// [`crate::Error::Io`] if a file cannot be read or `out` fails; [`crate::Error::Invalid`] if a document is
/// damaged, numbers do not increase, or frames differ in their up axis; [`crate::Error::Unsupported`] for
/// numbers beyond 2⁵³; [`crate::Error::TooLarge`] beyond 2³¹ vertices in a frame.
pub fn write_sequence<R: Read + Seek>(
    frames: &[SequenceFrame],
    (fps, meters_per_unit): (f64, f64),
    provenance: &Provenance,
    open: impl Fn(usize) -> io::Result<R>,
    out: &mut (impl Write + Seek),
) -> Result<Vec<String>> {
    let shot = UsdSequence::of(frames)?;
    let (attributes, notes) = shot.attributes()?;
    let start = head(provenance, 0);
    out.write_all(&start)?;
    let mut arrays = ArrayWriter { at: start.len() as u64, written: HashMap::new(), out };
    let (mut counts, mut corners) = (Vec::new(), Vec::new());
    let mut samples: Vec<Vec<(f64, ValueRep)>> = attributes.iter().map(|_| Vec::new()).collect();
    for (index, frame) in frames.iter().enumerate() {
        let code = frame.code as f64; // exact, because codes are at most 2⁵³
        let file = &mut open(index)?;
        let faces = write_faces(frame, file, &mut arrays)?;
        counts.push((code, faces[0]));
        corners.push((code, faces[1]));
        for (attribute, samples) in attributes.iter().zip(&mut samples) {
            let values = read_attribute(&shot, index, attribute, file)?;
            let (stride, values) = (values.0, &*values.1);
            let SequenceAttribute { first, arity, .. } = *attribute;
            samples.push((code, arrays.write(Elements::Reals { values, stride, first, arity })?));
        }
    }

    let mut end = LayerEnd::at(arrays.at);
    let mut specs = vec![extents(&shot, &mut end)?];
    specs.push(sampled("int[]", "faceVertexCounts", counts));
    specs.push(sampled("int[]", "faceVertexIndices", corners));
    specs.push(word("orientation", "rightHanded", &mut end));
    for (SequenceAttribute { kind, name, is_per_vertex, .. }, samples) in attributes.iter().zip(samples) {
        specs.push(PropertySpec { is_per_vertex: *is_per_vertex, ..sampled(kind, name, samples) });
    }
    specs.push(word("subdivisionScheme", "none", &mut end));
    specs.extend(origins(&shot, &mut end)?);
    let layer = LayerHead {
        provenance,
        info: shot.layer_info()?,
        up: shot.up,
        meters_per_unit,
        times: Some((shot.code_range(), fps)),
        prim: PRIM,
    };
    let (end, contents_at) = end.finish(&layer, &specs)?;
    out.write_all(&end)?;
    out.seek(SeekFrom::Start(CONTENTS_AT as u64))?;
    out.write_all(&contents_at.to_le_bytes())?;
    out.seek(SeekFrom::End(0))?;
    Ok(notes)
}

/// Writes the number of corners of each face, and the vertex indices of the corners.
fn write_faces(
    frame: &SequenceFrame,
    file: &mut (impl Read + Seek),
    arrays: &mut ArrayWriter<impl Write>,
) -> Result<[ValueRep; 2]> {
    let triangles = if frame.file.has_mesh() { frame.file.read_triangles(file)? } else { Vec::new() };
    let (triangles, quads) = (&*triangles, &[][..]);
    let counts = arrays.write(Elements::FaceCounts { triangles, quads })?;
    Ok([counts, arrays.write(Elements::FaceCorners { triangles, quads })?])
}

/// Writes arrays, and keeps track of their offsets.
struct ArrayWriter<'a, W> {
    at: u64,
    /// The arrays so far, by their types and 128-bit digests.
    written: HashMap<(ValueRep, SampleKey), ValueRep>,
    out: &'a mut W,
}

impl<W: Write> ArrayWriter<'_, W> {
    /// Writes an array, unless an equal one was written before.
    fn write(&mut self, elements: Elements) -> Result<ValueRep> {
        let array = CrateArray::of(elements)?;
        let mut hasher = Hasher::default();
        array.write(&mut hasher)?;
        let key = (array.rep(0), hasher.finish());
        if let Some(equal) = self.written.get(&key) {
            return Ok(*equal);
        }
        let padding = padding(self.at);
        self.out.write_all(padding)?;
        array.write(self.out)?;
        let offset = self.at + padding.len() as u64;
        self.at = offset + array.byte_count();
        self.written.insert(key, array.rep(offset));
        Ok(array.rep(offset))
    }
}

/// The number of values per vertex of an attribute in a frame, and the values.
fn read_attribute(
    shot: &UsdSequence,
    index: usize,
    attribute: &SequenceAttribute,
    file: &mut (impl Read + Seek),
) -> Result<(usize, Vec<f32>)> {
    let frame = &shot.frames[index].file;
    let none = (attribute.arity, Vec::new());
    let Some(placement) = &shot.placements[index] else { return Ok(none) };
    let Some(column) = frame.column(&attribute.semantic)? else { return Ok(none) };
    let scale = if attribute.semantic == POSITION { placement.scale } else { 1.0 };
    Ok((column.arity, frame.read_column(&column, scale, file)?))
}

fn sampled(kind: &str, name: &str, samples: Vec<(f64, ValueRep)>) -> PropertySpec {
    PropertySpec {
        kind: kind.to_owned(),
        name: name.to_owned(),
        value: SpecValue::Samples(samples),
        is_uniform: false,
        is_per_vertex: false,
        element_size: 1,
    }
}

/// A property that has the same token in all frames.
fn word(name: &str, word: &str, end: &mut LayerEnd) -> PropertySpec {
    let value = SpecValue::Always(end.tables.token_value(word));
    PropertySpec { is_uniform: true, value, ..sampled("token", name, Vec::new()) }
}

fn extents(shot: &UsdSequence, end: &mut LayerEnd) -> Result<PropertySpec> {
    let mut samples = Vec::new();
    for index in 0..shot.frames.len() {
        let corners = shot.extent(index)?;
        let value = end.array(&CrateArray::of_vectors(corners.as_flattened()))?;
        samples.extend(shot.held_codes(index).map(|code| (code as f64, value)));
    }
    Ok(sampled("float3[]", "extent", samples))
}

/// The origins of the frames, unless all are zero.
fn origins(shot: &UsdSequence, end: &mut LayerEnd) -> Result<Vec<PropertySpec>> {
    let Some(origins) = shot.origins() else { return Ok(Vec::new()) };
    let mut samples = Vec::new();
    for (index, origin) in origins.into_iter().enumerate() {
        let value = end.double3(origin);
        samples.extend(shot.held_codes(index).map(|code| (code as f64, value)));
    }
    let name = "xformOp:translate";
    let words = [end.tables.token(name)];
    let order = end.array(&CrateArray::of_indices(ValueType::Token, &words))?;
    let order = PropertySpec {
        is_uniform: true,
        value: SpecValue::Always(order),
        ..sampled("token[]", "xformOpOrder", Vec::new())
    };
    Ok(vec![sampled("double3", name, samples), order])
}
