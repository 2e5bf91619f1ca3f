//! The particles as the method reads them: their positions, batch by batch, more than once.
//!
//! ```text
//!   batch 0            batch 1            batch 2
//!   p p p p p p p p    p p p p p p p p    p p p            each can be read alone, on any thread
//! ```
//!
//! Most particles lie deep inside: they are read, but never stored. No stage needs all particles at once, so
//! a [`ParticleSource`] may be a file that is larger than the memory.

mod filter;
mod kernels;
mod shapes;

use std::borrow::Cow;
use std::convert::Infallible;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use glam::DVec3;
use rustc_hash::FxHashMap;

pub use filter::{ParticleFilter, coordinate, coordinates};
pub(crate) use filter::{rows, rows_of};
pub use kernels::{BODY_SCALE, LEVEL, LEVEL_AT, LONE_RADIUS, LONE_SCALE, inverse_kernel, kernel};
pub(crate) use shapes::cube_root;
pub use shapes::{Ellipsoid, Shapes};

/// Particle positions in world units, in the precision of the input.
#[derive(Clone, Debug, PartialEq)]
pub enum OwnedPositions {
    /// 32-bit positions.
    F32(Vec<[f32; 3]>),
    /// 64-bit positions.
    F64(Vec<[f64; 3]>),
}

/// A frame of particles: positions, shapes and attributes.
#[derive(Clone, Debug, PartialEq)]
pub struct ParticleCloud {
    /// Positions.
    pub positions: OwnedPositions,
    /// Shapes.
    pub shapes: Shapes,
    /// Attributes, each with values for every particle.
    pub attributes: Vec<Attribute>,
}

impl ParticleCloud {
    /// Finds the attribute that `name` refers to, with `arity` numbers per particle. An attribute with this
    /// name takes precedence over one with this semantic.
    pub fn find_attribute(&self, name: &str, arity: usize) -> Option<&Attribute> {
        find_attribute(&self.attributes, name, arity)
    }

    /// The memory of positions, shapes and attributes, in bytes.
    pub fn size_bytes(&self) -> usize {
        let shapes = match &self.shapes {
            Shapes::Uniform => 0,
            Shapes::Scaled(scales) => size_of_val(&**scales),
            Shapes::Ellipsoids(ellipsoids) => size_of_val(&**ellipsoids),
        };
        let attributes: usize = self.attributes.iter().map(|attribute| attribute.values.size_bytes()).sum();
        self.positions.size_bytes() + shapes + attributes
    }
}

impl From<OwnedPositions> for ParticleCloud {
    fn from(positions: OwnedPositions) -> ParticleCloud {
        ParticleCloud { positions, shapes: Shapes::Uniform, attributes: Vec::new() }
    }
}

/// Particles that can be read more than once, in batches.
pub trait ParticleSource: Sync {
    /// Why a batch cannot be read. [`Infallible`] for particles in memory.
    type Error: Send;

    /// The number of batches.
    fn batch_count(&self) -> usize;

    /// The positions of a batch. Every call returns the same positions. Some ten thousand particles are a
    /// good size: they fit into the cache of a core, and are enough to be worth sorting.
    ///
    /// # Errors
    /// If the source cannot read the batch.
    fn batch(&self, batch: usize) -> Result<Positions<'_>, Self::Error>;

    /// The number of particles in a batch.
    fn batch_len(&self, batch: usize) -> usize;

    /// Whether particles differ in size or shape.
    fn has_shapes(&self) -> bool {
        false
    }

    /// The shapes of the particles of a batch, in their order. All batches have the same variant:
    /// [`Shapes::Uniform`] unless the particles [have shapes](Self::has_shapes).
    fn batch_shapes(&self, _batch: usize) -> Shapes {
        Shapes::Uniform
    }

    /// Whether position smoothing moved particles.
    fn is_smoothed(&self) -> bool {
        false
    }

    /// The moved particles of a batch: their input position and their current position, world units.
    ///
    /// # Errors
    /// As for [`batch`](Self::batch).
    fn moved_pairs(&self, _batch: usize) -> Result<Vec<[DVec3; 2]>, Self::Error> {
        Ok(Vec::new())
    }
}

/// A reference to a source is a source of the same particles.
impl<S: ParticleSource> ParticleSource for &S {
    type Error = S::Error;

    fn batch_count(&self) -> usize {
        (**self).batch_count()
    }

    fn batch(&self, batch: usize) -> Result<Positions<'_>, S::Error> {
        (**self).batch(batch)
    }

    fn batch_len(&self, batch: usize) -> usize {
        (**self).batch_len(batch)
    }

    fn has_shapes(&self) -> bool {
        (**self).has_shapes()
    }

    fn batch_shapes(&self, batch: usize) -> Shapes {
        (**self).batch_shapes(batch)
    }

    fn is_smoothed(&self) -> bool {
        (**self).is_smoothed()
    }

    fn moved_pairs(&self, batch: usize) -> Result<Vec<[DVec3; 2]>, S::Error> {
        (**self).moved_pairs(batch)
    }
}

/// Particle positions in world units, in the precision of the input, borrowed from the caller or owned.
///
/// Functions that take `impl Into<Positions>` accept `&[[f32; 3]]` and `&[[f64; 3]]`, `&Vec` and `&[_; N]` of
/// such positions (nothing is copied), and owned vectors.
#[derive(Clone, Debug, PartialEq)]
pub enum Positions<'a> {
    /// 32-bit positions.
    F32(Cow<'a, [[f32; 3]]>),
    /// 64-bit positions.
    F64(Cow<'a, [[f64; 3]]>),
}

/// Conversions into [`Positions`] from slices, vectors and arrays of positions of one precision.
macro_rules! positions_from {
    ($number:ty, $variant:ident) => {
        impl<'a> From<&'a [[$number; 3]]> for Positions<'a> {
            fn from(positions: &'a [[$number; 3]]) -> Positions<'a> {
                Positions::$variant(Cow::Borrowed(positions))
            }
        }

        impl<'a> From<&'a Vec<[$number; 3]>> for Positions<'a> {
            fn from(positions: &'a Vec<[$number; 3]>) -> Positions<'a> {
                Positions::$variant(Cow::Borrowed(positions))
            }
        }

        impl<'a, const N: usize> From<&'a [[$number; 3]; N]> for Positions<'a> {
            fn from(positions: &'a [[$number; 3]; N]) -> Positions<'a> {
                Positions::$variant(Cow::Borrowed(positions))
            }
        }

        impl From<Vec<[$number; 3]>> for Positions<'_> {
            fn from(positions: Vec<[$number; 3]>) -> Self {
                Positions::$variant(Cow::Owned(positions))
            }
        }
    };
}

positions_from!(f32, F32);
positions_from!(f64, F64);

impl<'a> From<&'a OwnedPositions> for Positions<'a> {
    fn from(particles: &'a OwnedPositions) -> Positions<'a> {
        match particles {
            OwnedPositions::F32(positions) => positions.into(),
            OwnedPositions::F64(positions) => positions.into(),
        }
    }
}

impl From<OwnedPositions> for Positions<'_> {
    fn from(particles: OwnedPositions) -> Self {
        match particles {
            OwnedPositions::F32(positions) => positions.into(),
            OwnedPositions::F64(positions) => positions.into(),
        }
    }
}

impl From<Positions<'_>> for OwnedPositions {
    fn from(positions: Positions<'_>) -> OwnedPositions {
        match positions {
            Positions::F32(positions) => OwnedPositions::F32(positions.into_owned()),
            Positions::F64(positions) => OwnedPositions::F64(positions.into_owned()),
        }
    }
}

/// In-memory particles are split into this many batches, so that small frames use all threads, too. The size
/// of a batch is limited to [`BATCH_SIZES`].
const BATCH_COUNT: usize = 16;

/// The smallest and the largest number of particles in a batch of in-memory particles.
const BATCH_SIZES: [usize; 2] = [1 << 10, 1 << 14];

impl Positions<'_> {
    /// The number of particles.
    pub fn len(&self) -> usize {
        match self {
            Positions::F32(positions) => positions.len(),
            Positions::F64(positions) => positions.len(),
        }
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The position of particle `index`.
    ///
    /// Panics if `index` is out of range.
    pub fn position(&self, index: usize) -> DVec3 {
        match self {
            Positions::F32(positions) => glam::Vec3::from(positions[index]).as_dvec3(),
            Positions::F64(positions) => DVec3::from(positions[index]),
        }
    }

    /// The same positions, borrowed.
    pub(crate) fn borrowed(&self) -> Positions<'_> {
        self.part(0..self.len())
    }

    /// The positions in this range.
    fn part(&self, range: Range<usize>) -> Positions<'_> {
        match self {
            Positions::F32(positions) => Positions::F32(Cow::Borrowed(&positions[range])),
            Positions::F64(positions) => Positions::F64(Cow::Borrowed(&positions[range])),
        }
    }

    /// The number of particles per batch.
    fn batch_size(&self) -> usize {
        self.len().div_ceil(BATCH_COUNT).clamp(BATCH_SIZES[0], BATCH_SIZES[1])
    }

    /// The indices of the particles of a batch.
    pub(crate) fn range_of(&self, batch: usize) -> Range<usize> {
        let size = self.batch_size();
        batch * size..self.len().min((batch + 1) * size)
    }
}

impl OwnedPositions {
    /// The number of particles.
    pub fn len(&self) -> usize {
        Positions::from(self).len()
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The memory of the positions, in bytes.
    pub fn size_bytes(&self) -> usize {
        match self {
            OwnedPositions::F32(positions) => size_of_val(&**positions),
            OwnedPositions::F64(positions) => size_of_val(&**positions),
        }
    }

    /// The position of particle `index`.
    #[inline]
    pub fn position(&self, index: usize) -> DVec3 {
        match self {
            OwnedPositions::F32(positions) => glam::Vec3::from(positions[index]).as_dvec3(),
            OwnedPositions::F64(positions) => DVec3::from(positions[index]),
        }
    }

    /// The indices of the particles of a batch.
    fn range_of(&self, batch: usize) -> Range<usize> {
        Positions::from(self).range_of(batch)
    }
}

impl ParticleSource for Positions<'_> {
    type Error = Infallible;

    fn batch_count(&self) -> usize {
        self.len().div_ceil(self.batch_size())
    }

    fn batch(&self, batch: usize) -> Result<Positions<'_>, Infallible> {
        Ok(self.part(self.range_of(batch)))
    }

    fn batch_len(&self, batch: usize) -> usize {
        self.range_of(batch).len()
    }
}

impl ParticleSource for OwnedPositions {
    type Error = Infallible;

    fn batch_count(&self) -> usize {
        Positions::from(self).batch_count()
    }

    fn batch(&self, batch: usize) -> Result<Positions<'_>, Infallible> {
        let range = self.range_of(batch);
        Ok(match self {
            OwnedPositions::F32(positions) => Positions::from(&positions[range]),
            OwnedPositions::F64(positions) => Positions::from(&positions[range]),
        })
    }

    fn batch_len(&self, batch: usize) -> usize {
        self.range_of(batch).len()
    }
}

impl ParticleSource for ParticleCloud {
    type Error = Infallible;

    fn batch_count(&self) -> usize {
        self.positions.batch_count()
    }

    fn batch(&self, batch: usize) -> Result<Positions<'_>, Infallible> {
        self.positions.batch(batch)
    }

    fn batch_len(&self, batch: usize) -> usize {
        self.positions.batch_len(batch)
    }

    fn has_shapes(&self) -> bool {
        !self.shapes.is_uniform()
    }

    fn batch_shapes(&self, batch: usize) -> Shapes {
        self.shapes.slice(self.positions.range_of(batch))
    }
}

// Sources without their type: what reads them is compiled once, and not once for each type of source.

/// A source of any type, inside [`erased`].
pub type AnySource<'a> = dyn ParticleSource<Error = Unread> + 'a;

/// The source could not be read. [`erased`] returns the error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unread;

/// Calls `read` with the source, without its type.
///
/// # Errors
/// The first error of the source, if `read` returns [`Unread`].
pub fn erased<S: ParticleSource, T>(
    source: &S,
    read: impl FnOnce(&AnySource<'_>) -> Result<T, Unread>,
) -> Result<T, S::Error> {
    let erased = Erased { source, error: Mutex::new(None) };
    read(&erased).map_err(|Unread| {
        let error = erased.error.into_inner().unwrap_or_else(PoisonError::into_inner);
        error.expect("`Unread` comes from a read that failed")
    })
}

/// A source, and its first error.
struct Erased<'a, S: ParticleSource> {
    source: &'a S,
    error: Mutex<Option<S::Error>>,
}

impl<S: ParticleSource> Erased<'_, S> {
    fn unread(&self, error: S::Error) -> Unread {
        self.error.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        Unread
    }
}

impl<S: ParticleSource> ParticleSource for Erased<'_, S> {
    type Error = Unread;

    fn batch_count(&self) -> usize {
        self.source.batch_count()
    }

    fn batch(&self, batch: usize) -> Result<Positions<'_>, Unread> {
        self.source.batch(batch).map_err(|error| self.unread(error))
    }

    fn batch_len(&self, batch: usize) -> usize {
        self.source.batch_len(batch)
    }

    fn has_shapes(&self) -> bool {
        self.source.has_shapes()
    }

    fn batch_shapes(&self, batch: usize) -> Shapes {
        self.source.batch_shapes(batch)
    }

    fn is_smoothed(&self) -> bool {
        self.source.is_smoothed()
    }

    fn moved_pairs(&self, batch: usize) -> Result<Vec<[DVec3; 2]>, Unread> {
        self.source.moved_pairs(batch).map_err(|error| self.unread(error))
    }
}

// Attributes: data of each particle or vertex besides its position.

/// A named attribute of all particles, or of all vertices of a surface: velocities, colours, ids, anything.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    /// Its name.
    pub name: String,
    /// Its semantic.
    pub role: Role,
    /// Values per particle, at least 1.
    pub arity: usize,
    /// `arity` values per particle, particle by particle.
    pub values: AttributeValues,
}

/// The semantic of an attribute. Options find velocities and radii by semantic, whatever the attribute's
/// name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// World units per second, arity 3.
    Velocity,
    /// World units per second squared, arity 3.
    Acceleration,
    /// Red, green and blue from 0 to 1, optionally alpha, in the file's colour space: arity 3 or 4.
    Color,
    /// A radius in world units, arity 1.
    Radius,
    /// The id of a particle, constant over time, arity 1.
    Id,
    /// A position in another frame, in world units, arity 3.
    Rest,
    /// A place in a picture, arity 2 or 3, of which the third is not used.
    TextureCoordinates,
    /// Anything else.
    Other,
}

/// The values of an attribute, particle by particle. At a vertex, numbers are averaged over particles;
/// integers and strings are those of the nearest particle.
#[derive(Clone, Debug, PartialEq)]
pub enum AttributeValues {
    /// Numbers that can be averaged.
    Numbers(Vec<f32>),
    /// Integers, which cannot be averaged: ids, types, counts.
    Integers(Vec<i64>),
    /// Strings, as indices into a table; an index outside the table means no string.
    Strings {
        /// The distinct strings.
        table: Arc<[String]>,
        /// One index per value.
        indices: Vec<i32>,
    },
}

impl Attribute {
    /// Whether the attribute has `arity` numbers per particle.
    pub fn has_numbers(&self, arity: usize) -> bool {
        self.arity == arity && !matches!(self.values, AttributeValues::Strings { .. })
    }

    /// Whether `name` refers to this attribute: its own name, ignoring case, or a name of its semantic.
    pub fn matches(&self, name: &str) -> bool {
        name.eq_ignore_ascii_case(&self.name) || self.role.has_name(name)
    }
}

/// Finds the attribute that `name` refers to, with `arity` numbers per particle. An attribute with this name
/// takes precedence over one with this semantic.
pub fn find_attribute<'a>(all: &'a [Attribute], name: &str, arity: usize) -> Option<&'a Attribute> {
    let fitting = || all.iter().filter(|attribute| attribute.has_numbers(arity));
    let own = fitting().find(|attribute| attribute.name == name);
    own.or_else(|| fitting().find(|attribute| attribute.matches(name)))
}

/// The particle of each id that only one particle has.
pub fn unique_ids(ids: &[i64]) -> FxHashMap<i64, u32> {
    const SHARED: u32 = u32::MAX;
    let mut index_of_id = FxHashMap::default();
    for (&id, index) in ids.iter().zip(0u32..SHARED) {
        index_of_id.entry(id).and_modify(|known| *known = SHARED).or_insert(index);
    }
    index_of_id.retain(|_, index| *index != SHARED);
    index_of_id
}

/// The ids among the attributes: those of the attribute `id`, or else of the first whose role this is.
pub fn ids_of(attributes: &[Attribute]) -> Option<&[i64]> {
    let is_named = |attribute: &&Attribute| attribute.name == "id";
    let ids = |attribute: &'_ Attribute| match &attribute.values {
        AttributeValues::Integers(_) => attribute.role == Role::Id && attribute.arity == 1,
        _ => false,
    };
    let named = attributes.iter().filter(is_named).find(|attribute| ids(attribute));
    let found = named.or_else(|| attributes.iter().find(|attribute| ids(attribute)))?;
    match &found.values {
        AttributeValues::Integers(ids) => Some(ids),
        _ => None,
    }
}

/// Multiplies finite numbers by a factor. Products beyond the range of 32-bit numbers become its limit,
/// because files must contain finite numbers.
pub(crate) fn scale_numbers(values: &mut [f32], factor: f64) {
    for value in values {
        *value = (f64::from(*value) * factor).clamp(f32::MIN.into(), f32::MAX.into()) as f32;
    }
}

impl Role {
    /// The factor for values of this role if those of velocities are multiplied by `velocity_scale`: the unit
    /// of time changes, and not that of lengths.
    pub(crate) fn scale(self, velocity_scale: f64) -> f64 {
        match self {
            Role::Velocity => velocity_scale,
            Role::Acceleration => velocity_scale * velocity_scale,
            Role::Color | Role::Radius | Role::Id | Role::Rest | Role::TextureCoordinates | Role::Other => {
                1.0
            }
        }
    }

    /// Whether users refer to the semantic by this name, in any case.
    pub fn has_name(self, name: &str) -> bool {
        self.names().iter().any(|known| name.eq_ignore_ascii_case(known))
    }

    /// The names by which users refer to the semantic.
    fn names(self) -> &'static [&'static str] {
        match self {
            Role::Velocity => {
                &["velocity", "velocities", "vel", "v", "particle_vel", "particle_qd", "f_v", "qd"]
            }
            Role::Acceleration => &["acceleration", "accelerations", "accel"],
            Role::Color => &["color", "colour", "colors", "colours", "cd", "rgb", "rgba", "displaycolor"],
            Role::Radius => &["radius", "pscale"],
            Role::Id => &["id"],
            Role::TextureCoordinates => &["uv", "st"],
            Role::Rest | Role::Other => &[],
        }
    }
}

impl AttributeValues {
    /// The number of values.
    pub fn len(&self) -> usize {
        match self {
            AttributeValues::Numbers(values) => values.len(),
            AttributeValues::Integers(values) => values.len(),
            AttributeValues::Strings { indices, .. } => indices.len(),
        }
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The values as 32-bit numbers, with integers converted; `None` for strings.
    pub fn numbers(&self) -> Option<Cow<'_, [f32]>> {
        match self {
            AttributeValues::Numbers(values) => Some(Cow::Borrowed(values)),
            AttributeValues::Integers(values) => Some(values.iter().map(|&value| value as f32).collect()),
            AttributeValues::Strings { .. } => None,
        }
    }

    /// Multiplies the values by a factor. Integers become 32-bit numbers; strings are unchanged.
    pub(crate) fn scale(&mut self, factor: f64) {
        if let AttributeValues::Integers(values) = self {
            *self = AttributeValues::Numbers(values.iter().map(|&value| value as f32).collect());
        }
        if let AttributeValues::Numbers(values) = self {
            scale_numbers(values, factor);
        }
    }

    /// The memory of the values, in bytes.
    pub fn size_bytes(&self) -> usize {
        match self {
            AttributeValues::Numbers(values) => size_of_val(&**values),
            AttributeValues::Integers(values) => size_of_val(&**values),
            AttributeValues::Strings { indices, .. } => size_of_val(&**indices),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scaled_values_are_finite_numbers() {
        let mut integers = AttributeValues::Integers(vec![3, -2]);
        integers.scale(0.5);
        assert_eq!(integers, AttributeValues::Numbers(vec![1.5, -1.0]));
        let mut large = AttributeValues::Numbers(vec![1e30, -1e30, 0.0]);
        large.scale(1e18);
        assert_eq!(large, AttributeValues::Numbers(vec![f32::MAX, f32::MIN, 0.0]));
    }
}
