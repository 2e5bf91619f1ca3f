//! The particles as the method reads them: their positions, batch by batch, more than once.
//!
//! ```text
//!   batch 0            batch 1            batch 2
//!   p p p p p p p p    p p p p p p p p    p p p            each can be read alone, on any thread
//! ```
//!
//! Most particles lie deep inside: they are read, but never stored. No stage needs all particles at once, so
//! a [`ParticleSource`] may be a file that is larger than the memory.

mod attributes;
mod erased;
mod filter;
mod shapes;

use std::borrow::Cow;
use std::convert::Infallible;
use std::ops::Range;

use glam::DVec3;

pub(crate) use attributes::scale_numbers;
pub use attributes::{Attribute, AttributeValues, Role, find_attribute};
pub use erased::{AnySource, Unread, erased};
pub use filter::ParticleFilter;
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
