//! Writes a sequence as one mesh, and the points beside it, whose attributes have a sample per frame.
//!
//! The writer visits the frames once, in order, and once more for their points. It writes their arrays one
//! after the other, and at the end the time samples, which refer to the arrays. While it writes the arrays of a
//! frame, the other threads of the caller's pool read and encode those of the next one; no other arrays are in
//! memory, except the strings, and the frame after reuses their memory. Equal arrays, such as those of a fluid
//! at rest, are written once, as OpenUSD does. The attributes of a frame have the same time codes, so its
//! `velocities` are valid for its `points`.
//!
//! USD allows samples with different numbers of vertices, and holds such a sample until the next. If the next
//! frame has the same number of vertices, a second sample just before it refers to the same arrays, so that
//! USD does not blend the two frames.

use std::borrow::Cow;
use std::collections::HashMap;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::mem;
use std::ops::Range;
use std::rc::Rc;

use rayon::prelude::*;

use super::array::{CrateArray, IntegerBuffers};
use super::tables::{CONTENTS_AT, ValueRep, ValueType};
use super::{
    LayerEnd, LayerHead, MESH_KIND, PrimSpec, PropertySpec, SpecValue, array_of, head, padding, string_table,
};
use crate::data::Provenance;
use crate::digest::{Hasher, SampleKey};
use crate::error::Result;
use crate::gltf::{GlbFrame, SequenceFrame};
use crate::sequence_points::SequencePoints;
use crate::usd::{
    POINTS_KIND, PRIM, PropertyValue, SEQUENCE_POINTS_PRIM, SequenceAttribute, TRANSLATE, UsdSequence,
    UsdSequencePoints,
};

/// Writes a sequence of frames, whose numbers become the time codes and must increase, and the points beside
/// their meshes. `open` opens the file of a frame, by its index; position 0 of `out` is the start of the file.
/// Returns notes on attributes that are renamed, or omitted because the frames differ in them.
///
/// # Errors
///
/// [`crate::Error::Io`] if a file cannot be read or `out` fails; [`crate::Error::Invalid`] if a document is
/// damaged, numbers do not increase, or frames differ in their up axis; [`crate::Error::Unsupported`] for
/// numbers beyond 2⁵³; [`crate::Error::TooLarge`] beyond 2³¹ vertices in a frame; those of reading the points.
pub fn write_sequence<R: Read + Seek + Send>(
    frames: &[SequenceFrame],
    points: Option<&SequencePoints>,
    (fps, meters_per_unit): (f64, f64),
    provenance: &Provenance,
    open: impl Fn(usize) -> io::Result<R>,
    out: &mut (impl Write + Seek + Send),
) -> Result<Vec<String>> {
    let shot = UsdSequence::of(frames, points.is_some())?;
    let (attributes, mut notes) = shot.attributes()?;
    let points = points.map(|points| UsdSequencePoints::of(&shot, points));
    let start = head(provenance, 0);
    out.write_all(&start)?;
    let mut arrays = ArrayWriter { at: start.len() as u64, written: HashMap::new(), out };
    let samples = write_arrays(&shot, &attributes, open, &mut arrays)?;
    let of_points = points.as_ref().map(|points| write_point_arrays(points, &mut arrays)).transpose()?;

    let mut end = LayerEnd::at(arrays.at);
    let extent = |index| Ok((shot.extent(index)?, shot.held_codes(index)));
    let mut specs = vec![extents(0..frames.len(), extent, &mut end)?];
    let mut samples = samples.into_iter();
    let mut integers = |name| sampled("int[]", name, samples.next().unwrap_or_default());
    let (corners, sizes) = (integers("faceVertexIndices"), integers("faceVertexCounts"));
    specs.extend([sizes, corners]);
    specs.push(word("orientation", "rightHanded", &mut end));
    for (SequenceAttribute { kind, name, interpolation, .. }, samples) in attributes.iter().zip(samples) {
        specs.push(PropertySpec { interpolation: *interpolation, ..sampled(kind, name, samples) });
    }
    specs.push(word("subdivisionScheme", "none", &mut end));
    if let Some(origin) = shot.origin() {
        specs.extend(translation(origin, &mut end)?);
    }
    let layer = LayerHead {
        provenance,
        info: Some(shot.layer_info()?),
        up: shot.placement.up,
        meters_per_unit,
        times: Some((shot.code_range(), fps)),
    };
    let mut prims = vec![PrimSpec { kind: MESH_KIND, name: PRIM, properties: specs }];
    if let Some((points, samples)) = points.as_ref().zip(of_points) {
        let properties = point_specs(points, samples, &mut end)?;
        prims.push(PrimSpec { kind: POINTS_KIND, name: SEQUENCE_POINTS_PRIM, properties });
        notes.extend_from_slice(points.notes());
    }
    let (end, contents_at) = end.finish(&layer, &prims)?;
    out.write_all(&end)?;
    out.seek(SeekFrom::Start(CONTENTS_AT as u64))?;
    out.write_all(&contents_at.to_le_bytes())?;
    out.seek(SeekFrom::End(0))?;
    Ok(notes)
}

/// Writes the arrays of all frames. Returns the time samples of each property: the corners, the numbers of
/// corners, and the attributes. The corners come first because they take longest to encode.
fn write_arrays<R: Read + Seek + Send>(
    shot: &UsdSequence,
    attributes: &[SequenceAttribute],
    open: impl Fn(usize) -> io::Result<R>,
    out: &mut ArrayWriter<impl Write + Send>,
) -> Result<Vec<Vec<(f64, ValueRep)>>> {
    let mut encoders: Vec<ArrayEncoder> = [SourceArray::TriangleCorners, SourceArray::TriangleSizes]
        .into_iter()
        .chain(attributes.iter().map(SourceArray::Attribute))
        .map(ArrayEncoder::new)
        .collect();
    let mut samples: Vec<Vec<(f64, ValueRep)>> = vec![Vec::new(); encoders.len()];
    let mut write = |index: usize, arrays: &[KeyedArray]| -> Result<()> {
        for (array, samples) in arrays.iter().zip(&mut samples) {
            let value = out.write(array)?;
            samples.extend(shot.vertex_codes(index).map(|code| (code, value)));
        }
        Ok(())
    };
    // The arrays of the frame before, which are written while those of a frame are encoded.
    let mut waiting: Vec<KeyedArray> = Vec::new();
    for (index, frame) in shot.frames.iter().enumerate() {
        let shift = shot.shift(index)?;
        let encode =
            |(encoder, mut file): (&mut ArrayEncoder, R)| encoder.encode(&frame.file, shift, &mut file);
        let mut arrays = Vec::with_capacity(encoders.len());
        let mut unwritten = &waiting[..];
        for encoders in encoders.chunks_mut(OPEN_FILES_MAX) {
            // Each array is read from a file of its own, so that threads can read at once.
            let files = encoders.iter().map(|_| open(index)).collect::<io::Result<Vec<R>>>()?;
            let (written, encoded) = rayon::join(
                || write(index.saturating_sub(1), mem::take(&mut unwritten)),
                || encoders.par_iter_mut().zip(files).map(encode).collect::<Vec<Result<KeyedArray>>>(),
            );
            written?;
            for array in encoded {
                arrays.push(array?);
            }
        }
        let written = mem::replace(&mut waiting, arrays);
        encoders.iter_mut().zip(written).for_each(|(encoder, array)| encoder.recycle(array));
    }
    write(shot.frames.len().saturating_sub(1), &waiting)?;
    Ok(samples)
}

/// The samples of a property of points.
#[derive(Default)]
struct PropertySamples {
    arrays: Vec<(f64, ValueRep)>,
    /// The tables of an indexed primvar, which are written at the end. Equal ones in a row are in memory once.
    tables: Vec<(f64, Rc<Vec<String>>)>,
}

/// Writes the arrays of the points of all frames. Returns the samples of each property.
fn write_point_arrays(
    points: &UsdSequencePoints,
    out: &mut ArrayWriter<impl Write>,
) -> Result<Vec<PropertySamples>> {
    let mut samples: Vec<PropertySamples> = Vec::new();
    for index in points.frames() {
        points.with_properties(index, |properties| {
            samples.resize_with(properties.len(), PropertySamples::default);
            for (property, PropertySamples { arrays, tables }) in properties.iter().zip(&mut samples) {
                let codes = points.point_codes(index);
                if let Some(array) = array_of(property)? {
                    let value = out.write(&KeyedArray::of(array)?)?;
                    arrays.extend(codes.map(|code| (code, value)));
                } else if let PropertyValue::StringTable(table) = property.value {
                    let last = tables.last().map(|(_, last)| last).filter(|last| ***last == table);
                    let table = last.map_or_else(|| Rc::new(table.to_vec()), Rc::clone);
                    tables.extend(codes.map(|code| (code, Rc::clone(&table))));
                }
            }
            Ok(())
        })?;
    }
    Ok(samples)
}

/// The properties of the points, with these samples.
fn point_specs(
    points: &UsdSequencePoints,
    samples: Vec<PropertySamples>,
    end: &mut LayerEnd,
) -> Result<Vec<PropertySpec>> {
    let extent = |index| Ok((points.extent(index), points.held_codes(index)));
    let mut specs = vec![extents(points.frames(), extent, end)?];
    points.with_template(|properties| {
        for (property, PropertySamples { mut arrays, tables }) in properties.iter().zip(samples) {
            let mut last: Option<(Rc<Vec<String>>, ValueRep)> = None;
            for (code, table) in tables {
                let value = match &last {
                    Some((known, value)) if Rc::ptr_eq(known, &table) => *value,
                    _ => string_table(&table, end)?,
                };
                arrays.push((code, value));
                last = Some((table, value));
            }
            specs.push(PropertySpec {
                interpolation: property.interpolation,
                element_size: property.element_size,
                ..sampled(&property.kind, &property.name, arrays)
            });
        }
        Ok(())
    })?;
    if let Some(origin) = points.origin() {
        specs.extend(translation(origin, end)?);
    }
    Ok(specs)
}

/// The most files of a frame that are open at once: systems limit them to 256 or more.
const OPEN_FILES_MAX: usize = 32;

/// What an array contains.
enum SourceArray<'a> {
    TriangleSizes,
    TriangleCorners,
    Attribute(&'a SequenceAttribute),
}

/// Encodes an array of each frame, in memory that it reuses. Otherwise the system would have to clear memory
/// for every frame, which takes a sixth of the time.
struct ArrayEncoder<'a> {
    source: SourceArray<'a>,
    triangles: Vec<[u32; 3]>,
    values: Vec<f32>,
    buffers: IntegerBuffers,
}

impl<'a> ArrayEncoder<'a> {
    fn new(source: SourceArray<'a>) -> ArrayEncoder<'a> {
        ArrayEncoder { source, triangles: Vec::new(), values: Vec::new(), buffers: IntegerBuffers::default() }
    }

    /// Reads and encodes the array; it is empty if the frame does not have it.
    fn encode(
        &mut self,
        frame: &GlbFrame,
        shift: [f64; 3],
        file: &mut (impl Read + Seek),
    ) -> Result<KeyedArray<'static>> {
        let ArrayEncoder { source, triangles, values, buffers } = self;
        KeyedArray::of(match source {
            SourceArray::TriangleSizes => CrateArray::triangle_sizes(frame.triangle_count()?, buffers)?,
            SourceArray::TriangleCorners => {
                frame.read_triangles(file, triangles)?;
                CrateArray::triangle_corners(triangles, buffers)?
            }
            SourceArray::Attribute(SequenceAttribute { semantic, first, arity, .. }) => {
                let mut values = mem::take(values);
                let stride = frame.read_attribute(semantic, shift, file, &mut values)?.unwrap_or(*arity);
                CrateArray::reals(Cow::Owned(values), stride, *first, *arity)?
            }
        })
    }

    /// Takes the memory of an array that has been written.
    fn recycle(&mut self, KeyedArray { array, .. }: KeyedArray<'static>) {
        array.recycle(&mut self.buffers, &mut self.values);
    }
}

/// An encoded array with its type and its 128-bit digest, by which equal arrays are recognised.
struct KeyedArray<'a> {
    array: CrateArray<'a>,
    key: (ValueRep, SampleKey),
}

impl<'a> KeyedArray<'a> {
    fn of(array: CrateArray<'a>) -> Result<KeyedArray<'a>> {
        let mut hasher = Hasher::default();
        array.write(&mut hasher)?;
        let key = (array.rep(0), hasher.finish());
        Ok(KeyedArray { array, key })
    }
}

/// Writes arrays, and keeps track of their offsets.
struct ArrayWriter<'a, W> {
    at: u64,
    /// The arrays so far.
    written: HashMap<(ValueRep, SampleKey), ValueRep>,
    out: &'a mut W,
}

impl<W: Write> ArrayWriter<'_, W> {
    /// Writes an array, unless an equal one was written before.
    fn write(&mut self, KeyedArray { array, key }: &KeyedArray) -> Result<ValueRep> {
        if let Some(equal) = self.written.get(key) {
            return Ok(*equal);
        }
        let padding = padding(self.at);
        self.out.write_all(padding)?;
        array.write(self.out)?;
        let offset = self.at + padding.len() as u64;
        self.at = offset + array.byte_count();
        self.written.insert(*key, array.rep(offset));
        Ok(array.rep(offset))
    }
}

fn sampled(kind: &str, name: &str, samples: Vec<(f64, ValueRep)>) -> PropertySpec {
    PropertySpec {
        kind: kind.to_owned(),
        name: name.to_owned(),
        value: SpecValue::Samples(samples),
        is_uniform: false,
        interpolation: None,
        element_size: 1,
    }
}

/// A property that has the same token in all frames.
fn word(name: &str, word: &str, end: &mut LayerEnd) -> PropertySpec {
    let value = SpecValue::Always(end.tables.token_value(word));
    PropertySpec { is_uniform: true, value, ..sampled("token", name, Vec::new()) }
}

/// The extents of frames: the corners of each, and their time codes.
fn extents<C: Iterator<Item = f64>>(
    frames: Range<usize>,
    extent: impl Fn(usize) -> Result<([[f32; 3]; 2], C)>,
    end: &mut LayerEnd,
) -> Result<PropertySpec> {
    let mut samples = Vec::new();
    for index in frames {
        let (corners, codes) = extent(index)?;
        let value = end.array(&CrateArray::of_vectors(corners.as_flattened()))?;
        samples.extend(codes.map(|code| (code, value)));
    }
    Ok(sampled("float3[]", "extent", samples))
}

/// The transform of the mesh or the points, which is the same in all frames.
fn translation(origin: [f64; 3], end: &mut LayerEnd) -> Result<[PropertySpec; 2]> {
    let words = [end.tables.token(TRANSLATE)];
    let order = end.array(&CrateArray::of_indices(ValueType::Token, &words))?;
    let order = PropertySpec {
        is_uniform: true,
        value: SpecValue::Always(order),
        ..sampled("token[]", "xformOpOrder", Vec::new())
    };
    let value = SpecValue::Always(end.double3(origin));
    Ok([PropertySpec { value, ..sampled("double3", TRANSLATE, Vec::new()) }, order])
}
