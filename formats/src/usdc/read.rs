//! Reads the meshes of a file that this crate wrote.

use std::cell::Cell;
use std::io::{Read, Seek, SeekFrom};

use super::array::{AS_INTEGERS, AS_TABLE, COMPRESSED_MIN, Integer, decode, decompress, encoded_bytes_max};
use super::tables::{
    BOOTSTRAP_BYTES, LayerTables, NOT_OURS, Spec, SpecType, TABLE_BYTES, ValueRep, ValueType,
    check_contents_at, contents_at, no_gap, read_contents, value_here,
};
use crate::bytes::{Cursor, Endian, piece};
use crate::data::{AttributeRole, FileAttribute, MeshData, Values, world};
use crate::error::{Error, Position, Result};
use crate::gltf::PlacedMesh;
use crate::limits::Limits;
use crate::options::UpAxis;
use crate::usd::{
    ACCELERATIONS, FORMAT, INDICES, LayerInfo, SampledProperty, TRANSLATE, VELOCITIES, attribute_of,
};

/// A file with the mesh of one frame, or with a sample for each frame of a sequence.
pub struct UsdcLayer<'a> {
    source: Source<'a>,
    tables: LayerTables,
    info: LayerInfo,
    codes: Option<Vec<f64>>,
    properties: Vec<(usize, PropertyValues)>,
}

/// A frame of a file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct UsdcFrame {
    /// The mesh, in world units.
    pub mesh: MeshData,
    /// The velocities and accelerations, and the primvars under their own names.
    pub attributes: Vec<FileAttribute>,
}

/// The values of a property.
enum PropertyValues {
    Always(ValueRep),
    /// In the order of time codes.
    Samples(Vec<(f64, ValueRep)>),
}

/// Reads the mesh of a file with one frame.
pub(super) fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    let layer = UsdcLayer::read(bytes, limits)?;
    layer.check_single_frame()?;
    Ok(layer.frame(0)?.mesh)
}

impl<'a> UsdcLayer<'a> {
    /// Reads the tables of a file; [`UsdcLayer::frame`] reads the meshes.
    ///
    /// # Errors
    ///
    /// [`Error::Truncated`] if the file is truncated; [`Error::Unsupported`] if another program wrote or
    /// changed it; [`Error::Invalid`] if it is damaged; [`Error::TooLarge`] if it exceeds the limits.
    pub fn read(bytes: &'a [u8], limits: &Limits) -> Result<UsdcLayer<'a>> {
        let source = Source::new(bytes, limits);
        let tables = LayerTables::read(&source)?;
        UsdcLayer::of_parts(source, tables)
    }

    /// The layer with these tables. The source needs no arrays, except to read frames.
    fn of_parts(source: Source<'a>, tables: LayerTables) -> Result<UsdcLayer<'a>> {
        let info = layer_info(&source, &tables)?;
        if tables.word(tables.specs[2].field("typeName"), "the prim's type")? != "Mesh" {
            return Err(Error::unsupported(
                FORMAT,
                format!("this file has prims other than one mesh: {NOT_OURS}"),
            ));
        }
        let mut properties = Vec::new();
        for (index, spec) in tables.specs.iter().enumerate().skip(3) {
            if spec.kind != SpecType::Attribute as i32 {
                return Err(Error::unsupported(FORMAT, format!("this file has relationships: {NOT_OURS}")));
            }
            properties.push((index, values_of(&source, spec)?));
        }
        let mut layer = UsdcLayer { source, tables, info, codes: None, properties };
        layer.codes = match layer.values("points") {
            Some((_, PropertyValues::Samples(samples))) => {
                // Other samples repeat a frame just before the next.
                Some(samples.iter().map(|(code, _)| *code).filter(|code| code.fract() == 0.0).collect())
            }
            Some((_, PropertyValues::Always(_))) => None,
            None => return Err(unexpected("points")),
        };
        Ok(layer)
    }

    /// The summary of the file.
    pub fn info(&self) -> LayerInfo {
        self.info
    }

    /// Fails if the file is a sequence.
    pub(super) fn check_single_frame(&self) -> Result<()> {
        match self.codes {
            Some(_) => Err(Error::unsupported(FORMAT, "this file is a sequence: use the file of one frame")),
            None => Ok(()),
        }
    }

    /// The axis of the points that points up.
    pub(super) fn up(&self) -> Result<UpAxis> {
        match self.tables.word(self.tables.specs[0].field("upAxis"), "upAxis")? {
            "Y" => Ok(UpAxis::Y),
            "Z" => Ok(UpAxis::Z),
            axis => {
                Err(Error::unsupported(FORMAT, format!("upAxis is {}: {NOT_OURS}", crate::escaped(axis))))
            }
        }
    }

    /// The time codes of the frames; `None` for a file without time samples.
    pub fn codes(&self) -> Option<&[f64]> {
        self.codes.as_deref()
    }

    /// The names of the vertex attributes, except normals.
    pub fn attribute_names(&self) -> impl Iterator<Item = &str> {
        self.properties.iter().filter_map(|(spec, _)| attribute_of(&self.tables.specs[*spec].name))
    }

    /// Reads a frame by its index; a file without time samples has one, with index 0.
    ///
    /// # Errors
    ///
    /// [`Error::Invalid`] if there is no such frame, or if it is damaged; [`Error::TooLarge`] if it exceeds
    /// the limits.
    pub fn frame(&self, index: usize) -> Result<UsdcFrame> {
        let PlacedMesh { positions, normals, triangles, origin, attributes } = self.placed_frame(index)?;
        let positions = positions.as_chunks::<3>().0;
        self.source.claim(positions.len(), size_of::<[f64; 3]>())?;
        let positions = positions.iter().map(|position| world(origin, *position)).collect();
        let normals = normals.as_chunks::<3>().0.to_vec();
        Ok(UsdcFrame { mesh: MeshData { positions, normals, triangles }, attributes })
    }

    /// Reads a frame as it is stored.
    pub(super) fn placed_frame(&self, index: usize) -> Result<PlacedMesh> {
        self.source.start_anew();
        let floats = |name: &str| self.source.read_floats(self.value(name, index)?, 3, name);
        let (positions, normals) = (floats("points")?, floats("normals")?);
        let (point_count, normal_count) = (positions.len() / 3, normals.len() / 3);
        if normal_count != point_count {
            return Err(invalid(format!("{normal_count} normals for {point_count} points")));
        }
        let integers = |name: &str| -> Result<Vec<i32>> {
            self.source.read_integers(self.value(name, index)?, (ValueType::Int, 1), name)
        };
        let (counts, corners) = (integers("faceVertexCounts")?, integers("faceVertexIndices")?);
        self.source.claim(corners.len(), size_of::<[u32; 3]>())?;
        let triangles = fans(&counts, &corners, point_count)?;
        let origin = self.origin(index)?;
        let mut attributes = Vec::new();
        for (spec, _) in &self.properties {
            attributes.extend(self.attribute(&self.tables.specs[*spec], index, point_count)?);
        }
        Ok(PlacedMesh { positions, normals, triangles, origin, attributes })
    }

    fn values(&self, name: &str) -> Option<(&Spec, &PropertyValues)> {
        let found = self.properties.iter().find(|(spec, _)| self.tables.specs[*spec].name == name);
        found.map(|(spec, values)| (&self.tables.specs[*spec], values))
    }

    /// The value of a property in a frame. In a sequence, the property must have a sample for each frame.
    fn value(&self, name: &str, index: usize) -> Result<ValueRep> {
        match (self.values(name), &self.codes) {
            (Some((_, PropertyValues::Always(value))), None) if index == 0 => Ok(*value),
            (Some((_, PropertyValues::Samples(samples))), Some(codes)) => {
                let sample = codes.get(index).and_then(|code| sample(samples, *code));
                sample.ok_or_else(|| invalid(format!("{name} has no sample for frame {index}")))
            }
            _ => Err(unexpected(name)),
        }
    }

    /// The point that positions are relative to.
    fn origin(&self, index: usize) -> Result<[f64; 3]> {
        let name = TRANSLATE;
        let value = match self.values(name) {
            None => return Ok([0.0; 3]),
            Some((_, PropertyValues::Always(value))) => *value,
            Some(_) => self.value(name, index)?,
        };
        let offset = value.offset(ValueType::Vec3d).ok_or_else(|| unexpected(name))?;
        let mut cursor = self.source.at(offset)?;
        let mut origin = [0.0; 3];
        for part in &mut origin {
            *part = cursor.f64(name)?;
        }
        Ok(origin)
    }

    /// The vertex attribute that is stored in a property; `None` for other properties.
    fn attribute(&self, spec: &Spec, index: usize, vertex_count: usize) -> Result<Option<FileAttribute>> {
        let name = &*spec.name;
        let Some(plain) = attribute_of(name) else { return Ok(None) };
        let role = match name {
            VELOCITIES => Some(AttributeRole::Velocity),
            ACCELERATIONS => Some(AttributeRole::Acceleration),
            "primvars:displayColor" => Some(AttributeRole::Color),
            _ => None,
        };
        let size = match spec.field("elementSize") {
            None => 1,
            Some(size) => size.value(ValueType::Int).ok_or_else(|| unexpected(name))? as usize,
        };
        let kind = self.tables.word(spec.field("typeName"), name)?;
        let value = self.value(name, index)?;
        let (width, values) = self.attribute_values(name, kind, value, index)?;
        let found = values.len();
        let arity = width.saturating_mul(size);
        if arity == 0 || vertex_count.checked_mul(arity) != Some(found) {
            return Err(invalid(format!(
                "{name} has {found} values, but the mesh has {vertex_count} points with {arity} values each"
            )));
        }
        Ok(Some(FileAttribute { name: plain.to_owned(), arity, role, values }))
    }

    /// The number of values per element of the array, and all values.
    fn attribute_values(
        &self,
        name: &str,
        kind: &str,
        value: ValueRep,
        index: usize,
    ) -> Result<(usize, Values)> {
        let floats = |arity| Ok((arity, Values::F32(self.source.read_floats(value, arity, name)?)));
        let integers =
            |kind, arity| Ok((arity, Values::I32(self.source.read_integers(value, (kind, arity), name)?)));
        match kind {
            "float[]" => floats(1),
            "float2[]" => floats(2),
            "float3[]" | "vector3f[]" | "color3f[]" => floats(3),
            "float4[]" => floats(4),
            "int[]" => integers(ValueType::Int, 1),
            "int2[]" => integers(ValueType::Vec2i, 2),
            "int3[]" => integers(ValueType::Vec3i, 3),
            "int4[]" => integers(ValueType::Vec4i, 4),
            "int64[]" => Ok((1, Values::I64(self.source.read_integers(value, (ValueType::Int64, 1), name)?))),
            "string[]" => {
                let strings = self.source.read_indices(value, ValueType::String, name)?;
                let mut table = Vec::new();
                for string in strings {
                    let text = self.tables.string(string).ok_or_else(|| unexpected(name))?;
                    self.source.claim(text.len() + size_of::<String>(), 1)?;
                    table.push(text.to_owned());
                }
                let indices = self.value(&format!("{name}{INDICES}"), index)?;
                let indices = self.source.read_integers(indices, (ValueType::Int, 1), name)?;
                Ok((1, Values::Strings { table, indices }))
            }
            _ => Err(Error::unsupported(FORMAT, format!("{name} is {}: {NOT_OURS}", crate::escaped(kind)))),
        }
    }
}

fn layer_info(source: &Source, tables: &LayerTables) -> Result<LayerInfo> {
    let foreign = || Error::unsupported(FORMAT, format!("another program wrote this file: {NOT_OURS}"));
    let data = tables.specs[0].field("customLayerData").ok_or_else(foreign)?;
    let data = tables.dictionary(source, data)?;
    let (_, counts) = data.iter().find(|(key, _)| *key == "meniscus_mesh").ok_or_else(foreign)?;
    let counts = tables.dictionary(source, *counts)?;
    let number = |name: &str| {
        let value = counts.iter().find(|(key, _)| *key == name).map(|(_, value)| *value);
        value.map(|value| int64(source, value)).transpose()
    };
    let vertices_and_faces = number("vertices")?.zip(number("faces")?);
    let (vertices, faces) = vertices_and_faces.ok_or_else(|| unexpected("meniscus_mesh"))?;
    Ok(LayerInfo { vertices, faces, frames: number("frames")? })
}

fn int64(source: &Source, value: ValueRep) -> Result<u64> {
    let what = "a number in meniscus_mesh";
    if let Some(value) = value.value(ValueType::Int64) {
        return Ok(value.into());
    }
    let offset = value.offset(ValueType::Int64).ok_or_else(|| unexpected(what))?;
    source.at(offset)?.u64(what)
}

fn values_of(source: &Source, spec: &Spec) -> Result<PropertyValues> {
    let name = &*spec.name;
    // The file of a frame has the same value as a sample, for stages.
    if let Some(value) = spec.field("default") {
        return Ok(PropertyValues::Always(value));
    }
    let samples = spec.field("timeSamples").ok_or_else(|| unexpected(name))?;
    let offset = samples.offset(ValueType::TimeSamples).ok_or_else(|| unexpected(name))?;
    let mut cursor = source.at(offset)?;
    let times = value_here(&mut cursor, "times")?;
    no_gap(&mut cursor, "samples")?;
    let at = cursor.clone();
    let sample_count = count(&mut cursor, "samples")?;
    let values = cursor.take(sample_count.saturating_mul(8), "samples")?.as_chunks().0;
    let times = times.offset(ValueType::DoubleVector).ok_or_else(|| unexpected(name))?;
    let mut cursor = source.at(times)?;
    if count(&mut cursor, "times")? != sample_count {
        let what = format!("{name} has {sample_count} time samples, but a different number of time codes");
        return Err(at.invalid(what));
    }
    let times = cursor.take(sample_count.saturating_mul(8), "times")?.as_chunks().0;
    source.claim(sample_count, size_of::<(f64, ValueRep)>())?;
    let value = |(time, value): (&[u8; 8], &[u8; 8])| {
        (f64::from_le_bytes(*time), ValueRep(u64::from_le_bytes(*value)))
    };
    let samples: Vec<(f64, ValueRep)> = times.iter().zip(values).map(value).collect();
    if samples.is_sorted_by(|(a, _), (b, _)| a < b) {
        Ok(PropertyValues::Samples(samples))
    } else {
        Err(at.invalid(format!("the times of {name} do not increase")))
    }
}

/// The sample at exactly this time code.
fn sample(samples: &[(f64, ValueRep)], code: f64) -> Option<ValueRep> {
    let index = samples.binary_search_by(|(time, _)| time.total_cmp(&code)).ok()?;
    Some(samples[index].1)
}

/// Splits faces into triangle fans.
fn fans(counts: &[i32], corners: &[i32], vertex_count: usize) -> Result<Vec<[u32; 3]>> {
    let mut triangles = Vec::new();
    let mut rest = corners;
    for &count in counts {
        let face = usize::try_from(count).ok().filter(|&count| count >= 3);
        let Some((face, others)) = face.and_then(|count| rest.split_at_checked(count)) else {
            return Err(invalid(format!("a face has {count} corners, but only {} are left", rest.len())));
        };
        rest = others;
        let is_vertex = |index: i32| usize::try_from(index).is_ok_and(|index| index < vertex_count);
        if let Some(index) = face.iter().find(|&&index| !is_vertex(index)) {
            return Err(invalid(format!(
                "a face has vertex {index}, but the mesh has {vertex_count} vertices"
            )));
        }
        triangles
            .extend(face[1..].windows(2).map(|pair| [face[0], pair[0], pair[1]].map(i32::cast_unsigned)));
    }
    match rest.len() {
        0 => Ok(triangles),
        count => Err(invalid(format!("{count} corners belong to no face"))),
    }
}

fn invalid(what: String) -> Error {
    Error::invalid(FORMAT, Position::File, what)
}

// Reads the ends of a file without its arrays: which properties have time samples, which a stage declares,
// and the summary of a sequence.

/// The maximum size of the tables. They are a few kilobytes, and more only if an attribute has very many
/// different strings.
const TABLES_BYTES_MAX: u64 = 64 << 20;

/// Reads the properties with time samples from a file of this crate. Reads only its two ends: the bootstrap,
/// and the tables.
///
/// # Errors
///
/// [`Error::Io`] if the file cannot be read; [`Error::Truncated`] if it is truncated; [`Error::Unsupported`]
/// if another program wrote or changed it; [`Error::Invalid`] if it is damaged; [`Error::TooLarge`] if it
/// exceeds the limits.
pub fn read_sampled_properties(
    file: &mut (impl Read + Seek),
    limits: &Limits,
) -> Result<Vec<SampledProperty>> {
    let (_, tables) = read_tables(file, limits)?;
    let mut found = Vec::new();
    for spec in &tables.specs {
        if spec.kind == SpecType::Attribute as i32 && spec.field("timeSamples").is_some() {
            let kind = tables.word(spec.field("typeName"), &spec.name)?;
            found.extend(SampledProperty::checked(kind, &spec.name));
        }
    }
    Ok(found)
}

/// The offset of the tables of a file, and the tables.
fn read_tables(file: &mut (impl Read + Seek), limits: &Limits) -> Result<(u64, LayerTables)> {
    let head = piece(file, 0, BOOTSTRAP_BYTES as u64)?;
    let at = contents_at(&head)?;
    let file_bytes = file.seek(SeekFrom::End(0))?;
    check_contents_at(at, file_bytes)?;
    let sections = read_contents(&piece(file, at, TABLE_BYTES as u64)?, at)?;
    let start = sections.iter().map(|(start, _)| *start).min().unwrap_or(at);
    // The sections lie before the table of contents.
    let tables_bytes = at.saturating_sub(start);
    if tables_bytes > TABLES_BYTES_MAX {
        let what = format!("its tables have {tables_bytes} bytes, more than the limit of {TABLES_BYTES_MAX}");
        return Err(Error::too_large(FORMAT, what));
    }
    let bytes = piece(file, start, tables_bytes)?;
    let source = Source::of_end(&bytes, start, limits);
    Ok((start, LayerTables::in_sections(&source, &sections)?))
}

/// Reads the summary of a file of this crate, and the names of its vertex attributes, except normals. Reads
/// only its two ends.
///
/// # Errors
///
/// As [`read_sampled_properties`].
pub fn read_layer_info(file: &mut (impl Read + Seek), limits: &Limits) -> Result<(LayerInfo, Vec<String>)> {
    let (end, tables) = read_tables(file, limits)?;
    let data = tables.specs[0].field("customLayerData");
    // The values of the properties follow this one, except arrays. What it refers to is just before it.
    let start = data.and_then(|data| data.offset(ValueType::Dictionary)).unwrap_or(end).min(end);
    let start = start.saturating_sub(NESTED_BYTES_MAX);
    if end - start > TABLES_BYTES_MAX {
        let what =
            format!("its values have {} bytes, more than the limit of {TABLES_BYTES_MAX}", end - start);
        return Err(Error::too_large(FORMAT, what));
    }
    let bytes = piece(file, start, end - start)?;
    let layer = UsdcLayer::of_parts(Source::of_end(&bytes, start, limits), tables)?;
    let names = layer.attribute_names().map(str::to_owned).collect();
    Ok((layer.info(), names))
}

/// The maximum size of provenance.
const NESTED_BYTES_MAX: u64 = 64 << 10;

// Reads arrays, and limits the memory that they need.

/// The bytes of a file or of its end, and the number of bytes that were read since
/// [`Source::start_anew`]. Several values can refer to the same bytes, so all that is read counts towards the
/// limit of decompressed bytes.
pub(super) struct Source<'a> {
    pub(super) bytes: &'a [u8],
    /// The offset of the bytes in the file.
    base: u64,
    limits: Limits,
    unpacked: Cell<u64>,
}

impl<'a> Source<'a> {
    pub(super) fn new(bytes: &'a [u8], limits: &Limits) -> Source<'a> {
        Source::of_end(bytes, 0, limits)
    }

    /// The bytes of a file from the offset `base` on.
    fn of_end(bytes: &'a [u8], base: u64, limits: &Limits) -> Source<'a> {
        Source { bytes, base, limits: *limits, unpacked: Cell::new(0) }
    }

    /// Sets the count of decompressed bytes to 0.
    fn start_anew(&self) {
        self.unpacked.set(0);
    }

    /// A cursor at an offset of the file.
    pub(super) fn at(&self, offset: u64) -> Result<Cursor<'a>> {
        let start = offset.checked_sub(self.base).and_then(|start| usize::try_from(start).ok());
        let start = start.filter(|&start| start <= self.bytes.len()).ok_or_else(|| {
            let end = self.base + self.bytes.len() as u64;
            let what = format!(
                "a value would be at {offset}, but it can only be from {} to the end at {end}",
                self.base
            );
            Error::invalid(FORMAT, Position::Offset(offset), what)
        })?;
        Ok(Cursor::new(FORMAT, Endian::Little, self.bytes, start))
    }

    /// Counts bytes that are about to be allocated; fails if the sum exceeds the limit.
    pub(super) fn claim(&self, count: usize, bytes_each: usize) -> Result<()> {
        let bytes = (count as u64).saturating_mul(bytes_each as u64);
        self.unpacked.set(self.unpacked.get().saturating_add(bytes));
        self.limits.check_decompressed(FORMAT, self.unpacked.get(), self.bytes.len() as u64)
    }

    /// Reads a size and as many compressed bytes, and decompresses them to at most `bytes_max` bytes.
    pub(super) fn lz4(&self, cursor: &mut Cursor, bytes_max: usize, what: &str) -> Result<Vec<u8>> {
        let size = count(cursor, what)?;
        let at = cursor.clone();
        let packed = cursor.take(size, what)?;
        self.claim(bytes_max, 1)?;
        let mut out = vec![0; bytes_max];
        let length = decompress(packed, &mut out)
            .ok_or_else(|| at.invalid(format!("the compressed {what} are damaged")))?;
        out.truncate(length);
        Ok(out)
    }

    /// Reads a size and `count` compressed integers.
    pub(super) fn integers<T: Integer>(
        &self,
        cursor: &mut Cursor,
        count: usize,
        what: &str,
    ) -> Result<Vec<T>> {
        let at = cursor.clone();
        let bytes_max = encoded_bytes_max::<T>(count)
            .ok_or_else(|| at.invalid(format!("{count} {what} are more than a file can hold")))?;
        self.claim(count, T::CODE_BYTES[2])?;
        let encoded = self.lz4(cursor, bytes_max, what)?;
        decode(&encoded, count).ok_or_else(|| at.invalid(format!("expected {count} compressed {what}")))
    }

    /// The start of an array of this type, and whether it is compressed; `None` if it is empty.
    fn array(&self, rep: ValueRep, kind: ValueType, what: &str) -> Result<Option<(Cursor<'a>, bool)>> {
        match rep.array_offset(kind) {
            Some((0, _)) => Ok(None),
            Some((offset, is_compressed)) => Ok(Some((self.at(offset)?, is_compressed))),
            None => Err(unexpected(what)),
        }
    }

    /// The numbers of an array of integers, or of vectors of `arity` integers.
    fn read_integers<T: Integer>(
        &self,
        rep: ValueRep,
        (kind, arity): (ValueType, usize),
        what: &str,
    ) -> Result<Vec<T>> {
        let Some((mut cursor, is_compressed)) = self.array(rep, kind, what)? else { return Ok(Vec::new()) };
        let count = count(&mut cursor, what)?;
        if is_compressed && arity == 1 && count >= COMPRESSED_MIN {
            return self.integers(&mut cursor, count, what);
        }
        let width = T::CODE_BYTES[2];
        let bytes = self.elements(&mut cursor, count, arity * width, what)?;
        let widened = |bytes: &[u8]| {
            let mut all = [0; 8];
            all[..width].copy_from_slice(bytes);
            T::lowest(i64::from_le_bytes(all))
        };
        Ok(bytes.chunks_exact(width).map(widened).collect())
    }

    /// The numbers of an array of vectors of `arity` floats.
    fn read_floats(&self, rep: ValueRep, arity: usize, what: &str) -> Result<Vec<f32>> {
        let kind = match arity {
            1 => ValueType::Float,
            2 => ValueType::Vec2f,
            3 => ValueType::Vec3f,
            _ => ValueType::Vec4f,
        };
        let Some((mut cursor, is_compressed)) = self.array(rep, kind, what)? else { return Ok(Vec::new()) };
        let count = count(&mut cursor, what)?;
        if !is_compressed || arity != 1 || count < COMPRESSED_MIN {
            return Ok(floats(self.elements(&mut cursor, count, 4 * arity, what)?));
        }
        let at = cursor.clone();
        match cursor.u8(what)? {
            AS_INTEGERS => {
                let integers: Vec<i32> = self.integers(&mut cursor, count, what)?;
                Ok(integers.into_iter().map(|value| value as f32).collect())
            }
            AS_TABLE => {
                let length = cursor.u32(what)? as usize;
                let table = floats(self.elements(&mut cursor, length, 4, what)?);
                let indices: Vec<i32> = self.integers(&mut cursor, count, what)?;
                let value = |index: i32| table.get(usize::try_from(index).ok()?).copied();
                let values: Option<Vec<f32>> = indices.into_iter().map(value).collect();
                values.ok_or_else(|| at.invalid(format!("an index of {what} is beyond the end of its table")))
            }
            code => Err(at.invalid(format!("unknown compression {code} of {what}"))),
        }
    }

    /// The bytes of `count` elements.
    fn elements(
        &self,
        cursor: &mut Cursor<'a>,
        count: usize,
        bytes_each: usize,
        what: &str,
    ) -> Result<&'a [u8]> {
        let bytes = cursor.take(count.saturating_mul(bytes_each), what)?;
        self.claim(bytes.len(), 1)?;
        Ok(bytes)
    }

    /// The indices of an array of tokens or strings.
    fn read_indices(&self, rep: ValueRep, kind: ValueType, what: &str) -> Result<Vec<u32>> {
        let indices: Vec<i32> = self.read_integers(rep, (kind, 1), what)?;
        Ok(indices.into_iter().map(i32::cast_unsigned).collect())
    }
}

/// Reads a 64-bit count.
pub(super) fn count(cursor: &mut Cursor, what: &str) -> Result<usize> {
    let at = cursor.clone();
    let count = cursor.u64(what)?;
    usize::try_from(count).map_err(|_| at.invalid(format!("{count} {what} are more than a file can hold")))
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

/// The error for a value that is missing or has another type.
pub(super) fn unexpected(what: &str) -> Error {
    Error::invalid(FORMAT, Position::File, format!("the value of {what} is missing, or has another type"))
}
