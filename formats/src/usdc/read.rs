//! Reads the meshes of a file that this crate wrote.

use crate::data::{AttributeRole, FileAttribute, MeshData, Values};
use crate::error::{Error, Position, Result};
use crate::limits::Limits;
use crate::mesh_options::UpAxis;
use crate::usd::{ACCELERATIONS, FORMAT, INDICES, LayerInfo, TRANSLATE, VELOCITIES, attribute_of};

use super::contents::NOT_OURS;
use super::read_array::{Source, count, unexpected};
use super::read_tables::{LayerTables, Spec, no_gap, value_here};
use super::tables::SpecType;
use super::value::{ValueRep, ValueType};

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

/// A frame whose points are relative to its origin.
pub(super) struct PlacedFrame {
    /// Three coordinates for each point.
    pub(super) points: Vec<f32>,
    /// Three for each point.
    pub(super) normals: Vec<f32>,
    pub(super) triangles: Vec<[u32; 3]>,
    pub(super) origin: [f64; 3],
    pub(super) attributes: Vec<FileAttribute>,
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
    pub(super) fn of_parts(source: Source<'a>, tables: LayerTables) -> Result<UsdcLayer<'a>> {
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
        let PlacedFrame { points, normals, triangles, origin, attributes } = self.placed_frame(index)?;
        let points = points.as_chunks::<3>().0;
        self.source.claim(points.len(), size_of::<[f64; 3]>())?;
        let world = |point: &[f32; 3]| std::array::from_fn(|axis| origin[axis] + f64::from(point[axis]));
        let positions: Vec<[f64; 3]> = points.iter().map(world).collect();
        let normals = normals.as_chunks::<3>().0.to_vec();
        Ok(UsdcFrame { mesh: MeshData { positions, normals, triangles }, attributes })
    }

    /// Reads a frame as it is stored.
    pub(super) fn placed_frame(&self, index: usize) -> Result<PlacedFrame> {
        self.source.start_anew();
        let floats = |name: &str| self.source.read_floats(self.value(name, index)?, 3, name);
        let (points, normals) = (floats("points")?, floats("normals")?);
        let (point_count, normal_count) = (points.len() / 3, normals.len() / 3);
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
        Ok(PlacedFrame { points, normals, triangles, origin, attributes })
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
            *part = f64::from_le_bytes(cursor.array(name)?);
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
        let found = match &values {
            Values::F32(values) => values.len(),
            Values::I32(values) => values.len(),
            Values::I64(values) => values.len(),
            Values::Strings { indices, .. } => indices.len(),
            Values::F64(_) | Values::U8(_) => 0,
        };
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
    Ok(u64::from_le_bytes(source.at(offset)?.array(what)?))
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
    match samples.is_sorted_by(|(a, _), (b, _)| a < b) {
        true => Ok(PropertyValues::Samples(samples)),
        false => Err(at.invalid(format!("the times of {name} do not increase"))),
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
