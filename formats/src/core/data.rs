//! The plain data types that readers return and writers take.
//!
//! All data is in public vectors or borrowed slices. The only invariants concern lengths: one value, or
//! `arity` values, for each particle or vertex.

use std::fmt;

use crate::core::error::{Error, Position, Result};
use crate::core::number::{of_any_type, wide};

/// Particle positions, in the precision of the file.
#[derive(Clone, Debug, PartialEq)]
pub enum FilePositions {
    /// 32-bit positions, world units.
    F32(Vec<[f32; 3]>),
    /// 64-bit positions, world units.
    F64(Vec<[f64; 3]>),
}

impl FilePositions {
    /// The number of particles.
    pub fn len(&self) -> usize {
        match self {
            FilePositions::F32(positions) => positions.len(),
            FilePositions::F64(positions) => positions.len(),
        }
    }

    /// Whether there are no particles.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether a position is finite.
    pub(crate) fn has_finite(&self) -> bool {
        match self {
            FilePositions::F32(positions) => {
                positions.iter().any(|p| p.iter().all(|along| along.is_finite()))
            }
            FilePositions::F64(positions) => {
                positions.iter().any(|p| p.iter().all(|along| along.is_finite()))
            }
        }
    }

    /// The positions in 64 bits.
    pub(crate) fn into_f64(self) -> Vec<[f64; 3]> {
        match self {
            FilePositions::F32(positions) => positions.into_iter().map(|p| p.map(f64::from)).collect(),
            FilePositions::F64(positions) => positions,
        }
    }

    /// Appends positions; if one of the two has 64 bits, all get 64 bits.
    pub(crate) fn append(&mut self, more: FilePositions) {
        match (&mut *self, more) {
            (FilePositions::F32(positions), FilePositions::F32(more)) => positions.extend(more),
            (FilePositions::F64(positions), more) => positions.extend(more.into_f64()),
            (FilePositions::F32(_), FilePositions::F64(more)) => {
                let first = std::mem::take(self).into_f64();
                *self = FilePositions::F64(first.into_iter().chain(more).collect());
            }
        }
    }

    /// Keeps the particles for which `mask` is true.
    fn retain(&mut self, mask: &[bool]) {
        match self {
            FilePositions::F32(positions) => retain_rows(positions, 1, mask),
            FilePositions::F64(positions) => retain_rows(positions, 1, mask),
        }
    }
}

/// Keeps the rows of `arity` values for which `mask` is true.
fn retain_rows<T>(values: &mut Vec<T>, arity: usize, mask: &[bool]) {
    let mut index = 0;
    values.retain(|_| {
        index += 1;
        mask.get((index - 1) / arity.max(1)).is_some_and(|is_kept| *is_kept)
    });
    values.shrink_to_fit();
}

impl Default for FilePositions {
    fn default() -> FilePositions {
        FilePositions::F32(Vec::new())
    }
}

/// The meaning of an attribute for a renderer or for the reconstruction, whatever its name in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AttributeRole {
    /// World units per second, arity 3.
    Velocity,
    /// World units per second squared, arity 3.
    Acceleration,
    /// Direction, arity 3.
    Normal,
    /// Red, green, blue and optionally alpha, arity 3 or 4.
    Color,
    /// World units, arity 1. (The reader halves a diameter or width.)
    Radius,
    /// Arity 1.
    Density,
    /// Arity 1.
    Mass,
    /// Integer identity of the particle over time, arity 1.
    Id,
    /// Phase, type or group, arity 1.
    Kind,
    /// A place in a picture, with (0, 0) in its lower left corner, arity 2 or 3.
    TextureCoordinates,
}

/// The values of one attribute: `arity` values per particle, particle by particle.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// 32-bit floats.
    F32(Vec<f32>),
    /// 64-bit floats.
    F64(Vec<f64>),
    /// Unsigned bytes (colours in 0..=255, flags).
    U8(Vec<u8>),
    /// Integers of up to 32 bits.
    I32(Vec<i32>),
    /// 64-bit integers, and unsigned 32-bit integers, which can exceed `I32`.
    I64(Vec<i64>),
    /// Indices into a table of strings; an index outside the table means "no string".
    Strings {
        /// The distinct strings.
        table: Vec<String>,
        /// One index per component.
        indices: Vec<i32>,
    },
}

/// Integers up to this one are exact in `f64`: 2⁵³.
const EXACT: f64 = 9_007_199_254_740_992.0;

/// A named attribute of all particles.
#[derive(Clone, Debug, PartialEq)]
pub struct FileAttribute {
    /// The name in the file; for a vector split into columns, the columns' common stem.
    pub name: String,
    /// Number of values per particle.
    pub arity: usize,
    /// Its meaning; `None` if it is not recognised.
    pub role: Option<AttributeRole>,
    /// `arity` values per particle.
    pub values: Values,
}

impl FileAttribute {
    /// An attribute without a role.
    pub(crate) fn new(name: impl Into<String>, arity: usize, values: Values) -> FileAttribute {
        FileAttribute { name: name.into(), arity, role: None, values }
    }

    /// The number of particles that it has values for. The arity is 0 in invalid files.
    pub(crate) fn particle_count(&self) -> usize {
        self.values.len() / self.arity.max(1)
    }

    /// The distinct values of a scalar with the number of particles that have each, in ascending order;
    /// `None` for vectors, for more than `count_max` values, and for numbers that are not integers. A
    /// particle without a string counts as one with an empty string.
    pub fn value_counts(&self, count_max: usize) -> Option<Vec<(String, usize)>> {
        let mut counts: Vec<(i64, usize)> = Vec::new();
        let mut last = 0;
        let mut count = |value: i64| {
            if counts.get(last).is_none_or(|(counted, _)| *counted != value) {
                last = counts.iter().position(|(counted, _)| *counted == value).unwrap_or(counts.len());
            }
            if last == counts.len() {
                counts.push((value, 0));
            }
            counts[last].1 += 1;
            (counts.len() <= count_max).then_some(())
        };
        #[expect(clippy::cast_possible_truncation, reason = "an integer of at most 53 bits")]
        let whole = |value: f64| (value.fract() == 0.0 && value.abs() <= EXACT).then_some(value as i64);
        if self.arity != 1 {
            return None;
        }
        match &self.values {
            Values::F32(values) => values.iter().try_for_each(|&value| count(whole(value.into())?)),
            Values::F64(values) => values.iter().try_for_each(|&value| count(whole(value)?)),
            Values::U8(values) => values.iter().try_for_each(|&value| count(value.into())),
            Values::I32(values) => values.iter().try_for_each(|&value| count(value.into())),
            Values::I64(values) => values.iter().try_for_each(|&value| count(value)),
            Values::Strings { table, indices } => indices.iter().try_for_each(|&index| {
                let is_string = usize::try_from(index).is_ok_and(|index| index < table.len());
                count(if is_string { index.into() } else { -1 })
            }),
        }?;
        counts.sort_unstable();
        let Values::Strings { table, .. } = &self.values else {
            return Some(counts.into_iter().map(|(value, count)| (value.to_string(), count)).collect());
        };
        let string = |index: i64| usize::try_from(index).ok().and_then(|index| table.get(index).cloned());
        let mut counts: Vec<(String, usize)> =
            counts.into_iter().map(|(index, count)| (string(index).unwrap_or_default(), count)).collect();
        counts.sort();
        // The table may contain a string twice, or the empty one.
        counts.dedup_by(|later, first| {
            let is_same = later.0 == first.0;
            first.1 += if is_same { later.1 } else { 0 };
            is_same
        });
        Some(counts)
    }

    /// The attribute of vertices with these values; `None` for types that vertices do not have.
    pub(crate) fn view(&self) -> Option<VertexAttribute<'_>> {
        let FileAttribute { name, role, arity, values } = self;
        let values = match values {
            Values::F32(values) => VertexValues::Numbers(values),
            Values::I64(values) => VertexValues::Integers(values),
            Values::Strings { table, indices } => VertexValues::Strings { table, indices },
            Values::F64(_) | Values::U8(_) | Values::I32(_) => return None,
        };
        Some(VertexAttribute { name, role: *role, arity: *arity, values })
    }

    /// Keeps the values of the particles for which `mask` is true.
    fn retain(&mut self, mask: &[bool]) {
        of_any_type!(&mut self.values, list => retain_rows(list, self.arity, mask));
    }
}

impl Values {
    /// Multiplies all values; integers become floats.
    #[expect(clippy::cast_possible_truncation, reason = "the values have 32 bits")]
    pub(crate) fn scale(&mut self, factor: f64) {
        if factor == 1.0 {
            return;
        }
        match self {
            Values::F32(values) => {
                values.iter_mut().for_each(|value| *value = (f64::from(*value) * factor) as f32);
            }
            Values::F64(values) => values.iter_mut().for_each(|value| *value *= factor),
            Values::U8(values) => {
                *self = Values::F32(values.iter().map(|&value| (f64::from(value) * factor) as f32).collect());
            }
            Values::Strings { .. } => {}
            // The conversion is exact up to ±2⁵³, more than any radius needs.
            Values::I32(_) | Values::I64(_) => {
                *self = Values::F64(wide(self));
                self.scale(factor);
            }
        }
    }
}

/// One frame of particles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParticleFrame {
    /// Particle positions, not yet checked for being finite.
    pub positions: FilePositions,
    /// All other data of the particles.
    pub attributes: Vec<FileAttribute>,
    /// Notes for the user on a file that was read successfully: rows skipped, columns guessed.
    pub notes: Vec<String>,
}

impl ParticleFrame {
    /// Keeps the particles for which `mask`, which has an element for each of them, is true.
    pub fn retain(&mut self, mask: &[bool]) {
        self.positions.retain(mask);
        self.attributes.iter_mut().for_each(|attribute| attribute.retain(mask));
    }
}

/// How a file was made: pairs of name and value, written in this order. Must not contain times, hosts, paths
/// or random numbers, so that equal inputs give equal bytes.
pub type Provenance = [(String, String)];

/// A borrowed triangle mesh to write.
#[derive(Clone, Copy, Debug)]
pub struct MeshView<'a> {
    /// Vertex positions relative to `origin`, world units.
    pub positions: &'a [[f32; 3]],
    /// Unit vertex normals, pointing outward; one per position.
    pub normals: &'a [[f32; 3]],
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: &'a [[u32; 3]],
    /// World position of the point that `positions` are relative to.
    pub origin: [f64; 3],
    /// Vertex attributes.
    pub attributes: &'a [VertexAttribute<'a>],
}

/// The world position of a vertex of a mesh with this origin.
pub(crate) fn world(origin: [f64; 3], position: [f32; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| origin[axis] + f64::from(position[axis]))
}

/// The minimum and maximum corner of the bounding box; `None` without positions.
pub(crate) fn bounds_of(positions: &[[f32; 3]]) -> Option<[[f32; 3]; 2]> {
    let first = *positions.first()?;
    Some(positions.iter().fold([first, first], |[low, high], position| {
        [
            std::array::from_fn(|axis| low[axis].min(position[axis])),
            std::array::from_fn(|axis| high[axis].max(position[axis])),
        ]
    }))
}

impl MeshView<'_> {
    /// Fails if the mesh is invalid: unequal lengths, out-of-range indices, or numbers that are not finite.
    /// `format` is named in the error.
    pub(crate) fn check(&self, format: &'static str) -> Result<()> {
        let invalid = |what: String| Err(Error::invalid(format, Position::File, what));
        let (vertices, normals) = (self.positions.len(), self.normals.len());
        if vertices != normals {
            return invalid(format!("the mesh has {normals} normals for {vertices} vertices"));
        }
        if let Some(index) = self.triangles.as_flattened().iter().find(|index| **index as usize >= vertices) {
            return invalid(format!(
                "a triangle has vertex index {index}, but the mesh has {vertices} vertices"
            ));
        }
        if !all_finite(self.positions.as_flattened()) || !all_finite(self.normals.as_flattened()) {
            return invalid("the position or normal of a vertex is not finite".into());
        }
        if !self.origin.iter().all(|c| c.is_finite()) {
            return invalid(format!("the origin {:?} is not finite", self.origin));
        }
        self.attributes.iter().try_for_each(|attribute| attribute.check(vertices, format))
    }
}

/// A borrowed, named attribute of all vertices.
#[derive(Clone, Copy, Debug)]
pub struct VertexAttribute<'a> {
    /// Its name, as in the particle file.
    pub name: &'a str,
    /// Its meaning; `None` if it is not recognised.
    pub role: Option<AttributeRole>,
    /// Number of values per vertex, at least 1.
    pub arity: usize,
    /// `arity` values per vertex, vertex by vertex.
    pub values: VertexValues<'a>,
}

/// The values of a vertex attribute.
#[derive(Clone, Copy, Debug)]
pub enum VertexValues<'a> {
    /// Finite numbers.
    Numbers(&'a [f32]),
    /// Integers that identify something.
    Integers(&'a [i64]),
    /// Indices into a table of strings; an index outside the table means "no string".
    Strings {
        /// The distinct strings.
        table: &'a [String],
        /// One index per component.
        indices: &'a [i32],
    },
}

impl<'a> VertexAttribute<'a> {
    /// Fails if the attribute is invalid: lengths that do not match, or numbers that are not finite.
    pub(crate) fn check(&self, vertex_count: usize, format: &'static str) -> Result<()> {
        let VertexAttribute { name, arity, values, .. } = self;
        let found = match values {
            VertexValues::Numbers(values) => values.len(),
            VertexValues::Integers(values) => values.len(),
            VertexValues::Strings { indices, .. } => indices.len(),
        };
        let invalid = |what: String| Err(Error::invalid(format, Position::File, what));
        if *arity == 0 || vertex_count.checked_mul(*arity) != Some(found) {
            return invalid(format!(
                "attribute {name} has {found} values for {vertex_count} vertices with {arity} values each"
            ));
        }
        if let VertexValues::Numbers(values) = values
            && !all_finite(values)
        {
            return invalid(format!("attribute {name} has a value that is not finite"));
        }
        Ok(())
    }
}

/// Whether all numbers are finite. The loop has no branch per number, so that the compiler vectorises it.
pub(crate) fn all_finite(numbers: &[f32]) -> bool {
    numbers.iter().fold(true, |all, number| all & number.is_finite())
}

/// A mesh read from a file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MeshData {
    /// Vertex positions, world units.
    pub positions: Vec<[f64; 3]>,
    /// Vertex normals, or empty.
    pub normals: Vec<[f32; 3]>,
    /// Vertex indices; readers cut larger polygons into triangle fans.
    pub triangles: Vec<[u32; 3]>,
}

/// A narrow-band level set to write, leaf by leaf.
///
/// A leaf holds the 8 × 8 × 8 voxels that start at its origin, z fastest: voxel (x, y, z) relative to the
/// origin is value `x·64 + y·8 + z`. Values are signed distances **in voxels**, negative inside; the writer
/// multiplies them by `voxel_size`. Outside all leaves, the sign of the nearest leaf decides between inside
/// and outside.
#[derive(Clone, Copy, Debug)]
pub struct LevelSetView<'a> {
    /// Leaf origins in voxels, multiples of 8, distinct, in any order.
    pub origins: &'a [[i32; 3]],
    /// Values of each leaf. The writer clamps values beyond ± `half_width_voxels`.
    pub leaves: &'a [[f32; 512]],
    /// Half the thickness of the band, positive; times `voxel_size` it is the background value.
    pub half_width_voxels: f32,
    /// Edge length of a voxel, world units. Voxel (0, 0, 0) is centred on the world's origin unless the
    /// writer is given an offset.
    pub voxel_size: f64,
    /// Additional grids with the attributes of the band's voxels.
    pub grids: &'a [BandGrid<'a>],
}

/// Values at the voxels of a level set's band: a separate grid, active where the level set is.
#[derive(Clone, Copy, Debug)]
pub struct BandGrid<'a> {
    /// Its name, as in the particle file. The grid of a velocity is always called `velocity`.
    pub name: &'a str,
    /// Its meaning; `None` if it is not recognised.
    pub role: Option<AttributeRole>,
    /// Number of values per voxel: 1, or 3 for a vector.
    pub arity: usize,
    /// The source of the values.
    pub values: &'a dyn LeafValues,
}

/// Computes the values of a grid on demand, leaf by leaf: the values of all leaves at once would take several
/// times the memory of the level set.
pub trait LeafValues: fmt::Debug + Sync {
    /// Fills in the values of the 512 voxels of a leaf, with the grid's arity for each. `leaf` is an index
    /// into [`LevelSetView::leaves`]. Values of voxels outside the band are ignored; all others must be
    /// finite.
    fn fill(&self, leaf: usize, out: &mut [f32]);
}

// Picture types: a borrowed picture to write, and one that was read.

/// A picture to write: pixel values, row by row from the top left.
#[derive(Clone, Copy, Debug)]
pub struct PictureView<'a> {
    /// Width and height in pixels, each at least 1.
    pub size: [usize; 2],
    /// Linear colour with sRGB primaries; 1 is white.
    pub color: &'a [[f32; 3]],
    /// Additional layers. `.png` cannot store them.
    pub layers: &'a [PictureLayer<'a>],
    /// The camera. `.png` cannot store it.
    pub camera: Option<PictureCamera>,
    /// How the picture was made.
    pub provenance: &'a Provenance,
}

/// The colours of a picture read from a file, row by row from the top left.
#[derive(Clone, Debug, PartialEq)]
pub struct ColorPicture {
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// Linear colour with sRGB primaries; 1 is white.
    pub color: Vec<[f32; 3]>,
}

/// Pixel values other than colour.
#[derive(Clone, Copy, Debug)]
pub struct PictureLayer<'a> {
    /// The layer's name, unique within the picture.
    pub name: &'a str,
    /// The name of its channel. For vectors, the prefix of three: `N` gives `N.X`, `N.Y` and `N.Z`.
    pub channel: &'a str,
    /// The values.
    pub samples: PixelSamples<'a>,
}

/// Pixel values and the precision in which they are stored.
#[derive(Clone, Copy, Debug)]
pub enum PixelSamples<'a> {
    /// 32 bits each.
    Numbers(&'a [f32]),
    /// 16 bits each.
    HalfNumbers(&'a [f32]),
    /// Three components of 32 bits each.
    Vectors(&'a [[f32; 3]]),
    /// Three components of 16 bits each.
    HalfVectors(&'a [[f32; 3]]),
}

/// The camera of a picture, as two matrices M, stored row by row. They transform a row vector v to v · M.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PictureCamera {
    /// From the world to camera space: x right, y up and z into the picture.
    pub world_to_camera: [f32; 16],
    /// From the world to the picture, after division by the last coordinate: (0, 0) is the upper left corner
    /// and (1, 1) the lower right one.
    pub world_to_ndc: [f32; 16],
}

impl PictureView<'_> {
    /// Fails if the picture is invalid: empty, more than 65 535 pixels along an edge, or the wrong number of
    /// values. `format` is named in the error.
    pub(crate) fn check(&self, format: &'static str) -> Result<()> {
        let [width, height] = self.size;
        let is_possible = |edge: usize| (1..=EDGE_MAX).contains(&edge);
        if !is_possible(width) || !is_possible(height) {
            let what =
                format!("the picture has {width} × {height} pixels; each edge must have 1 to {EDGE_MAX}");
            return Err(Error::invalid(format, Position::File, what));
        }
        let counts = self.layers.iter().map(|layer| (layer.name, layer.samples.len()));
        let pixel_count = width * height;
        match std::iter::once(("color", self.color.len()))
            .chain(counts)
            .find(|(_, count)| *count != pixel_count)
        {
            Some((name, count)) => {
                let what = format!("layer {name} has {count} values for {pixel_count} pixels");
                Err(Error::invalid(format, Position::File, what))
            }
            None => Ok(()),
        }
    }
}

impl PixelSamples<'_> {
    /// The number of pixels.
    fn len(&self) -> usize {
        match self {
            PixelSamples::Numbers(values) | PixelSamples::HalfNumbers(values) => values.len(),
            PixelSamples::Vectors(values) | PixelSamples::HalfVectors(values) => values.len(),
        }
    }
}

/// Maximum number of pixels along an edge.
const EDGE_MAX: usize = 65_535;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_integers_and_strings_are_counted() {
        let counts = |values: Values, arity: usize| {
            let attribute = FileAttribute { name: "phase".into(), arity, role: None, values };
            attribute.value_counts(3)
        };
        let texts = |pairs: &[(&str, usize)]| {
            Some(pairs.iter().map(|(value, count)| ((*value).to_owned(), *count)).collect::<Vec<_>>())
        };
        let expected = texts(&[("-1", 1), ("0", 2), ("7", 1)]);
        assert_eq!(counts(Values::I32(vec![0, 7, 0, -1]), 1), expected);
        assert_eq!(counts(Values::F32(vec![0.0, 7.0, 0.0, -1.0]), 1), expected);
        assert_eq!(counts(Values::U8(vec![1; 9]), 1), texts(&[("1", 9)]));
        assert_eq!(counts(Values::I64(Vec::new()), 1), texts(&[]));
        let table = vec!["wall".to_owned(), "fluid".to_owned()];
        let strings = Values::Strings { table, indices: vec![0, 1, -1, 0, 9] };
        assert_eq!(counts(strings, 1), texts(&[("", 2), ("fluid", 1), ("wall", 2)]));
        let twice = Values::Strings { table: vec!["a".to_owned(), "a".to_owned()], indices: vec![1, 0, 1] };
        assert_eq!(counts(twice, 1), texts(&[("a", 3)]));
        for (values, arity) in [
            (Values::I32(vec![0, 1, 2, 3]), 1),
            (Values::I32(vec![0, 1]), 2),
            (Values::F64(vec![0.0, 0.5]), 1),
            (Values::F32(vec![f32::NAN]), 1),
            (Values::F64(vec![f64::INFINITY]), 1),
        ] {
            assert_eq!(counts(values, arity), None);
        }
    }

    #[test]
    fn retained_particles_keep_their_values() {
        let attribute =
            |name: &str, arity, values| FileAttribute { name: name.into(), arity, role: None, values };
        let mut frame = ParticleFrame {
            positions: FilePositions::F64(vec![[0.0; 3], [1.0; 3], [2.0; 3]]),
            attributes: vec![
                attribute("v", 2, Values::F32(vec![0.0, 0.5, 1.0, 1.5, 2.0, 2.5])),
                attribute("id", 1, Values::I64(vec![7, 8, 9])),
            ],
            notes: vec!["a note".into()],
        };
        frame.retain(&[true, false, true]);
        assert_eq!(frame.positions, FilePositions::F64(vec![[0.0; 3], [2.0; 3]]));
        assert_eq!(frame.attributes[0].values, Values::F32(vec![0.0, 0.5, 2.0, 2.5]));
        assert_eq!(frame.attributes[1].values, Values::I64(vec![7, 9]));
    }
}
