//! What `meniscus info` says about particles, meshes, grids and sequence files.

use std::collections::{BTreeMap, HashMap};
use std::fmt;

use glam::DVec3;
use meniscus_formats::gltf::SequenceInfo;
use meniscus_formats::vdb::{GridInfo, MetaValue};
use meniscus_formats::{AttributeRole, FileAttribute, MeshData, ParticleFrame, Values};
use serde::Serialize;

use crate::cli::wording::{shortest, significant};
use crate::pipeline::{MeasuredSpacing, SEQUENCE_POINTS, Warning, particles, shared_position};
use crate::surface::options::Preset;
use crate::surface::particles::OwnedPositions;

use super::{BoundingBox, block, f32_digits, row, vector};

/// A frame of particles.
#[derive(Debug, Serialize)]
pub(super) struct ParticlesInfo {
    count: usize,
    /// `f32` or `f64`.
    position_type: &'static str,
    not_finite: usize,
    bounds: Option<BoundingBox>,
    attributes: Vec<AttributeInfo>,
    /// Null if fewer than two particles have different positions.
    spacing: Option<f64>,
    /// From 0 to 1.
    spacing_confidence: Option<f64>,
    /// From 0 to 1; null if too few particles are surrounded by others.
    irregularity: Option<f64>,
    /// The preset for a fluid of such particles.
    suggested_preset: Option<Preset>,
    /// The voxel size of that preset.
    suggested_voxel_size: Option<f64>,
}

/// An attribute of particles, or of vertices.
#[derive(Debug, Serialize)]
struct AttributeInfo {
    name: String,
    #[serde(rename = "type")]
    value_type: &'static str,
    arity: usize,
    role: Option<&'static str>,
    /// The range of each component; null if it has no finite value. Empty for strings.
    min: Vec<Option<PrintedNumber>>,
    max: Vec<Option<PrintedNumber>>,
    /// The distinct strings.
    #[serde(skip_serializing_if = "Option::is_none")]
    strings: Option<Vec<String>>,
    /// The number of particles with each value, for scalars with few distinct integers or strings.
    #[serde(skip_serializing_if = "Option::is_none")]
    counts: Option<Vec<ValueCount>>,
}

/// The number of particles that have a value of an attribute.
#[derive(Debug, Serialize)]
struct ValueCount {
    value: String,
    count: usize,
}

/// Attributes with more distinct values are described by their range only.
const VALUE_COUNT_MAX: usize = 12;

/// A number, as an integer if it is one: `f64` cannot represent all 64-bit integers.
#[derive(Clone, Copy, Debug, Serialize)]
#[serde(untagged)]
enum PrintedNumber {
    Integer(i64),
    Real(f64),
}

impl ParticlesInfo {
    /// `measured` is the spacing that `convert` would measure on this frame alone. Also returns a warning about a
    /// position that many particles share.
    pub(super) fn of(
        frame: ParticleFrame,
        measured: Option<&MeasuredSpacing>,
    ) -> (ParticlesInfo, Option<Warning>) {
        let attributes = attributes_of(&frame.attributes);
        let particles = particles(frame.positions);
        let Ok(shared) = shared_position(&particles);
        let positions = || (0..particles.len()).map(|index| particles.position(index));
        let bounds = BoundingBox::of(positions().map(|position| position.to_array()));
        let irregularity = measured.and_then(|measured| measured.irregularity);
        let preset = Preset::for_fluid(irregularity);
        let info = ParticlesInfo {
            count: particles.len(),
            position_type: match particles {
                OwnedPositions::F32(_) => "f32",
                OwnedPositions::F64(_) => "f64",
            },
            not_finite: positions().filter(|position| !position.is_finite()).count(),
            bounds: match particles {
                OwnedPositions::F32(_) => bounds.map(BoundingBox::with_f32_digits),
                OwnedPositions::F64(_) => bounds,
            },
            attributes,
            spacing: measured.map(|measured| measured.spacing),
            spacing_confidence: measured.map(|measured| measured.confidence),
            irregularity,
            suggested_preset: irregularity.map(|_| preset),
            suggested_voxel_size: measured.map(|measured| preset.voxel_size(measured.spacing)),
        };
        (info, shared)
    }
}

/// The description of the attributes.
fn attributes_of(attributes: &[FileAttribute]) -> Vec<AttributeInfo> {
    attributes.iter().map(attribute_info).collect()
}

/// Writes a line for each attribute.
fn fmt_attributes(attributes: &[AttributeInfo], f: &mut fmt::Formatter<'_>) -> fmt::Result {
    attributes.iter().try_for_each(|attribute| row(f, "attribute", attribute))
}

fn attribute_info(attribute: &FileAttribute) -> AttributeInfo {
    let arity = attribute.arity;
    let real = |min_max: Option<(f64, f64)>| {
        min_max.map(|(min, max)| (PrintedNumber::Real(min), PrintedNumber::Real(max)))
    };
    let whole = |min_max: Option<(i64, i64)>| {
        min_max.map(|(a, b)| (PrintedNumber::Integer(a), PrintedNumber::Integer(b)))
    };
    let f32_range = |&x: &f32| real_range(f64::from(x));
    let single =
        |min_max: Option<(f64, f64)>| real(min_max.map(|(min, max)| (f32_digits(min), f32_digits(max))));
    let (value_type, ranges): (_, Vec<Option<(PrintedNumber, PrintedNumber)>>) = match &attribute.values {
        Values::F32(values) => ("f32", ranges(values, arity, f32_range, single)),
        Values::F64(values) => ("f64", ranges(values, arity, |&x| real_range(x), real)),
        Values::U8(values) => ("u8", ranges(values, arity, |&x| Some(i64::from(x)), whole)),
        Values::I32(values) => ("i32", ranges(values, arity, |&x| Some(i64::from(x)), whole)),
        Values::I64(values) => ("i64", ranges(values, arity, |&x| Some(x), whole)),
        Values::Strings { .. } => ("string", Vec::new()),
    };
    AttributeInfo {
        name: attribute.name.clone(),
        value_type,
        arity,
        role: attribute.role.map(role_name),
        min: ranges.iter().map(|range| range.map(|(min, _)| min)).collect(),
        max: ranges.iter().map(|range| range.map(|(_, max)| max)).collect(),
        strings: match &attribute.values {
            Values::Strings { table, .. } => Some(table.clone()),
            _ => None,
        },
        counts: attribute
            .value_counts(VALUE_COUNT_MAX)
            .filter(|counts| !counts.is_empty())
            .map(|counts| counts.into_iter().map(|(value, count)| ValueCount { value, count }).collect()),
    }
}

/// The value of a real number in a range; `None` if it is not finite, and thus does not count.
fn real_range(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

/// Minimum and maximum of each component. `counts` returns a value as a number, or `None` if it does not
/// count.
fn ranges<T, N: Copy + PartialOrd>(
    values: &[T],
    arity: usize,
    counts: impl Fn(&T) -> Option<N>,
    number: impl Fn(Option<(N, N)>) -> Option<(PrintedNumber, PrintedNumber)>,
) -> Vec<Option<(PrintedNumber, PrintedNumber)>> {
    let mut ranges: Vec<Option<(N, N)>> = vec![None; arity];
    for value_of_particle in values.chunks_exact(arity.max(1)) {
        for (range, value) in ranges.iter_mut().zip(value_of_particle.iter().map(&counts)) {
            if let Some(value) = value {
                let (min, max) = range.unwrap_or((value, value));
                *range = Some((if value < min { value } else { min }, if value > max { value } else { max }));
            }
        }
    }
    ranges.into_iter().map(number).collect()
}

fn role_name(role: AttributeRole) -> &'static str {
    match role {
        AttributeRole::Velocity => "velocity",
        AttributeRole::Acceleration => "acceleration",
        AttributeRole::Normal => "normal",
        AttributeRole::Color => "color",
        AttributeRole::Radius => "radius",
        AttributeRole::Density => "density",
        AttributeRole::Mass => "mass",
        AttributeRole::Id => "id",
        AttributeRole::Kind => "kind",
        AttributeRole::TextureCoordinates => "texture coordinates",
    }
}

impl fmt::Display for ParticlesInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        row(f, "particles", format_args!("{}, positions {}", self.count, self.position_type))?;
        if self.not_finite > 0 {
            row(f, "not finite", self.not_finite)?;
        }
        if let Some(bounds) = self.bounds {
            row(f, "bounds", bounds)?;
        }
        fmt_attributes(&self.attributes, f)?;
        match (self.spacing, self.spacing_confidence, self.suggested_voxel_size) {
            (Some(spacing), Some(confidence), Some(voxel_size)) => {
                let percent = (100.0 * confidence).round();
                row(f, "spacing", format_args!("{}, confidence {percent} %", significant(spacing)))?;
                if let (Some(irregularity), Some(preset)) = (self.irregularity, self.suggested_preset) {
                    let percent = (100.0 * irregularity).round();
                    let [spaced, note] = match preset {
                        Preset::Noisy => ["irregularly", " (splashes: fluid)"],
                        _ => ["evenly", ""],
                    };
                    let suits = format_args!("{percent} %: {spaced} spaced, preset {preset} suits{note}");
                    row(f, "irregularity", suits)?;
                }
                row(f, "suggested voxel size", shortest(voxel_size))
            }
            _ => row(f, "spacing", "unknown: no two particles have different positions"),
        }
    }
}

impl fmt::Display for AttributeInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {} × {}", self.name, self.value_type, self.arity)?;
        if let Some(role) = self.role {
            write!(f, ", {role}")?;
        }
        if let Some(strings) = &self.strings {
            write!(f, ", {} distinct", strings.len())?;
        }
        let [min, max] = [&self.min, &self.max].map(|corner| {
            let component = |number: &Option<PrintedNumber>| {
                number.as_ref().map_or_else(|| "none".to_owned(), ToString::to_string)
            };
            corner.iter().map(component).collect::<Vec<String>>()
        });
        match (&min[..], &max[..]) {
            ([], []) => {}
            ([min], [max]) => write!(f, ", {min} to {max}")?,
            _ => write!(f, ", {} to {}", vector(&min), vector(&max))?,
        }
        let several = self.counts.iter().filter(|counts| counts.len() > 1);
        for (index, ValueCount { value, count }) in several.flatten().enumerate() {
            write!(f, "{} {count} × {value}", if index == 0 { ":" } else { "," })?;
        }
        Ok(())
    }
}

impl fmt::Display for PrintedNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            PrintedNumber::Integer(value) => write!(f, "{value}"),
            PrintedNumber::Real(value) => f.write_str(&significant(*value)),
        }
    }
}

// Measurements of a mesh for `meniscus info`.

/// A triangle mesh; larger polygons count as the triangles they are cut into.
#[derive(Debug, Serialize)]
pub(super) struct MeshInfo {
    vertices: usize,
    triangles: usize,
    has_normals: bool,
    /// Vertices whose position is not finite; triangles with such a vertex are not measured.
    not_finite: usize,
    #[serde(skip)]
    first_not_finite: Option<[f64; 3]>,
    bounds: Option<BoundingBox>,
    area: f64,
    /// Signed: negative if triangles are clockwise seen from outside. Meaningless for a mesh with boundary
    /// edges.
    volume: f64,
    /// Vertices at the same position count as one here: many formats store a vertex once for each of its
    /// normals.
    boundary_edges: usize,
    non_manifold_edges: usize,
    /// Attributes of the vertices beyond positions and normals.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    attributes: Vec<AttributeInfo>,
}

impl MeshInfo {
    pub(super) fn of(mesh: &MeshData) -> MeshInfo {
        let bounds = BoundingBox::of(mesh.positions.iter().copied());
        // The volume is the sum of signed tetrahedra whose apex is the centre of the mesh. With the origin as
        // the apex, large volumes of opposite sign would cancel if the mesh is far from it, and precision
        // would be lost.
        let center = bounds.map_or(DVec3::ZERO, |b| 0.5 * (DVec3::from(b.min) + DVec3::from(b.max)));
        let corner = |index: u32| {
            let position = mesh.positions.get(index as usize);
            position.map_or(DVec3::NAN, |&position| DVec3::from(position) - center)
        };
        let (mut area, mut volume) = (0.0, 0.0);
        for triangle in &mesh.triangles {
            let [a, b, c] = triangle.map(corner);
            if !(a.is_finite() && b.is_finite() && c.is_finite()) {
                continue;
            }
            area += 0.5 * (b - a).cross(c - a).length();
            volume += a.dot(b.cross(c)) / 6.0;
        }
        let mut not_finite = mesh.positions.iter().filter(|position| !position.iter().all(|x| x.is_finite()));
        let (first_not_finite, others) = (not_finite.next().copied(), not_finite.count());
        let (boundary_edges, non_manifold_edges) = odd_edges(&welded(mesh));
        MeshInfo {
            vertices: mesh.positions.len(),
            triangles: mesh.triangles.len(),
            has_normals: !mesh.normals.is_empty(),
            not_finite: usize::from(first_not_finite.is_some()) + others,
            first_not_finite,
            bounds,
            area,
            volume,
            boundary_edges,
            non_manifold_edges,
            attributes: Vec::new(),
        }
    }

    /// The same mesh, with the attributes of its vertices.
    pub(super) fn with_attributes(self, attributes: &[FileAttribute]) -> MeshInfo {
        let has_more = attributes.iter().any(|attribute| attribute.role != Some(AttributeRole::Normal));
        let attributes = if has_more { attributes_of(attributes) } else { Vec::new() };
        MeshInfo { attributes, ..self }
    }
}

/// The triangles, with each vertex replaced by the first one at the same position.
fn welded(mesh: &MeshData) -> Vec<[u32; 3]> {
    let mut first_at = HashMap::new();
    let first: Vec<u32> = (0u32..)
        .zip(&mesh.positions)
        // Adding zero turns −0 into 0, so that equal positions have equal bits.
        .map(|(index, position)| *first_at.entry(position.map(|x| (x + 0.0).to_bits())).or_insert(index))
        .collect();
    let first_of = |index: u32| first.get(index as usize).copied().unwrap_or(index);
    mesh.triangles.iter().map(|triangle| triangle.map(first_of)).collect()
}

/// The number of edges with one triangle, and the number of edges with more than two.
fn odd_edges(triangles: &[[u32; 3]]) -> (usize, usize) {
    let mut edges: Vec<[u32; 2]> = triangles
        .iter()
        .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
        .map(|[a, b]| [a.min(b), a.max(b)])
        .collect();
    edges.sort_unstable();
    let counts = || edges.chunk_by(|a, b| a == b).map(<[_]>::len);
    (counts().filter(|&count| count == 1).count(), counts().filter(|&count| count > 2).count())
}

impl fmt::Display for MeshInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let normals = if self.has_normals { ", with normals" } else { "" };
        row(f, "vertices", format_args!("{}{normals}", self.vertices))?;
        row(f, "triangles", self.triangles)?;
        if let Some(position) = self.first_not_finite {
            let first = format_args!(
                "{}, the first at {}; triangles with them are not in the area and volume",
                self.not_finite,
                vector(&position.map(shortest))
            );
            row(f, "vertices not finite", first)?;
        }
        if let Some(bounds) = self.bounds {
            row(f, "bounds", bounds.with_f32_digits())?;
        }
        row(f, "area", significant(self.area))?;
        row(f, "volume", significant(self.volume))?;
        row(f, "boundary edges", self.boundary_edges)?;
        row(f, "non-manifold edges", self.non_manifold_edges)?;
        fmt_attributes(&self.attributes, f)
    }
}

// The grids of an OpenVDB file for `meniscus info`.

/// A grid.
#[derive(Debug, Serialize)]
pub(super) struct GridRecord {
    name: String,
    class: String,
    #[serde(rename = "type")]
    tree_type: String,
    half: bool,
    /// Along each index axis, in world units; null if the transform has an unsupported type.
    voxel_size: Option<[f64; 3]>,
    /// The world position of voxel (0, 0, 0).
    origin: Option<[f64; 3]>,
    /// Minimum and maximum index of the active voxels.
    active_bounds: Option<[[i32; 3]; 2]>,
    active_voxels: Option<u64>,
    metadata: BTreeMap<String, serde_json::Value>,
}

impl From<GridInfo> for GridRecord {
    fn from(grid: GridInfo) -> GridRecord {
        GridRecord {
            name: grid.name,
            class: grid.class,
            tree_type: grid.type_name,
            half: grid.half,
            voxel_size: grid.transform.map(|transform| transform.voxel_size()),
            origin: grid.transform.map(|transform| transform.translation),
            active_bounds: grid.active_bounds.map(|(min, max)| [min, max]),
            active_voxels: grid.active_voxel_count,
            metadata: grid.metadata.into_iter().map(|(name, value)| (name, json_value(value))).collect(),
        }
    }
}

fn json_value(value: MetaValue) -> serde_json::Value {
    match value {
        MetaValue::String(text) => text.into(),
        MetaValue::Bool(flag) => flag.into(),
        MetaValue::Integer(number) => number.into(),
        MetaValue::Real(number) => number.into(),
        MetaValue::Vec3i(vector) => vector.to_vec().into(),
        MetaValue::Vec3d(vector) => vector.to_vec().into(),
        MetaValue::Other(type_name, byte_count) => format!("{type_name}, {byte_count} bytes").into(),
    }
}

impl fmt::Display for GridRecord {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let class = if self.class.is_empty() { "no class" } else { &self.class };
        row(f, "grid", format_args!("{}: {class}, {}", self.name, self.tree_type))?;
        if let Some(voxel_size) = self.voxel_size {
            row(f, "voxel size", voxel_size.map(shortest).join(" × "))?;
        }
        if let Some(origin) = self.origin {
            row(f, "voxel (0, 0, 0) at", vector(&origin.map(shortest)))?;
        }
        if let Some([min, max]) = self.active_bounds {
            row(f, "active voxels from", format_args!("{min:?} to {max:?}"))?;
        }
        if let Some(count) = self.active_voxels {
            row(f, "active voxels", count)?;
        }
        let shown = |value: &serde_json::Value| match value {
            serde_json::Value::String(text) => text.clone(),
            serde_json::Value::Number(number) if number.is_f64() => {
                number.as_f64().map_or_else(|| number.to_string(), shortest)
            }
            other => other.to_string(),
        };
        let (mut made_with, mut others) = (BTreeMap::new(), BTreeMap::new());
        for (name, value) in &self.metadata {
            match name.strip_prefix("meniscus_") {
                Some(name) => made_with.insert(name.to_owned(), shown(value)),
                None => others.insert(name.clone(), shown(value)),
            };
        }
        block(f, "metadata", &others)?;
        block(f, "made with", &made_with)
    }
}

// The description of a sequence file for `meniscus info`. Areas and volumes are omitted: their sums over all
// frames would be meaningless.

/// A file with all frames of a sequence, as meniscus writes it.
#[derive(Debug, Serialize)]
pub(super) struct SequenceFileRecord {
    pub(super) frames: u64,
    /// The number of the first frame, and of the last.
    first: Option<i64>,
    last: Option<i64>,
    /// Frames per second.
    fps: Option<f64>,
    /// Total over all frames.
    vertices: u64,
    /// Total over all frames.
    triangles: u64,
    /// Points beside the meshes, total over all frames; `None` without any.
    #[serde(skip_serializing_if = "Option::is_none")]
    points: Option<u64>,
    /// The names of the vertex attributes.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    attributes: Vec<String>,
}

impl SequenceFileRecord {
    /// A sequence file with this content and these attributes; the rest comes from its recorded metadata.
    pub(super) fn new(
        info: SequenceInfo,
        attributes: Vec<String>,
        made_by: Option<&BTreeMap<String, String>>,
    ) -> SequenceFileRecord {
        let SequenceInfo { frames, vertices, triangles } = info;
        let number = |name: &str| made_by?.get(name)?.parse().ok();
        let fps = made_by.and_then(|made_by| made_by.get("fps")?.parse().ok());
        let [first, last] = ["first", "last"].map(number);
        let points = made_by.and_then(|made_by| made_by.get(SEQUENCE_POINTS)?.parse().ok());
        SequenceFileRecord { frames, first, last, fps, vertices, triangles, points, attributes }
    }
}

impl fmt::Display for SequenceFileRecord {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        row(f, "frames", self.frames)?;
        for (label, number) in [("first frame", self.first), ("last frame", self.last)] {
            number.iter().try_for_each(|number| row(f, label, number))?;
        }
        self.fps.iter().try_for_each(|fps| row(f, "frames per second", shortest(*fps)))?;
        row(f, "vertices", format_args!("{}, in all frames", self.vertices))?;
        row(f, "triangles", format_args!("{}, in all frames", self.triangles))?;
        self.points
            .iter()
            .try_for_each(|points| row(f, "points", format_args!("{points}, in all frames")))?;
        self.attributes.iter().try_for_each(|name| row(f, "attribute", name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tetrahedron_is_measured_at_any_distance_from_the_origin() {
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let triangles = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        for shift in [0.0, 1e6] {
            let positions = positions.iter().map(|p| p.map(|x| x + shift)).collect();
            let mesh = MeshData { positions, normals: Vec::new(), triangles: triangles.clone() };
            let info = MeshInfo::of(&mesh);
            assert!((info.volume - 1.0 / 6.0).abs() < 1e-9);
            assert!((info.area - (1.5 + 0.75f64.sqrt())).abs() < 1e-9);
            assert_eq!((info.boundary_edges, info.non_manifold_edges), (0, 0));
        }
        let open = MeshData {
            positions: positions.to_vec(),
            triangles: triangles[..3].to_vec(),
            ..MeshData::default()
        };
        assert_eq!(MeshInfo::of(&open).boundary_edges, 3);
        let doubled = MeshData {
            positions: positions.to_vec(),
            triangles: [triangles.clone(), triangles].concat(),
            ..MeshData::default()
        };
        assert_eq!(MeshInfo::of(&doubled).non_manifold_edges, 6);
    }
}
