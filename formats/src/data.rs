//! The plain data that readers return and writers take.
//!
//! Everything is a public vector or a borrowed slice; there are no invariants beyond equal lengths.

use std::fmt;

use crate::error::{Error, Place, Result};

/// Particle positions, in the precision of the file.
#[derive(Clone, Debug, PartialEq)]
pub enum Positions {
    /// 32-bit positions, world units.
    F32(Vec<[f32; 3]>),
    /// 64-bit positions, world units.
    F64(Vec<[f64; 3]>),
}

impl Positions {
    /// The number of particles.
    pub fn len(&self) -> usize {
        match self {
            Positions::F32(positions) => positions.len(),
            Positions::F64(positions) => positions.len(),
        }
    }

    /// Whether there is no particle.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl Default for Positions {
    fn default() -> Positions {
        Positions::F32(Vec::new())
    }
}

/// What an attribute means to a renderer or to the method, whatever the file calls it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// World units per second, arity 3.
    Velocity,
    /// Direction, arity 3.
    Normal,
    /// Red, green, blue and perhaps alpha, arity 3 or 4.
    Color,
    /// World units, arity 1. (A file's diameter or width is halved by the reader.)
    Radius,
    /// Arity 1.
    Density,
    /// Arity 1.
    Mass,
    /// Integer identity of the particle over time, arity 1.
    Id,
    /// Phase, type or group, arity 1.
    Kind,
}

/// The values of one attribute, `arity` of them per particle, particle by particle.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// 32-bit reals.
    F32(Vec<f32>),
    /// 64-bit reals.
    F64(Vec<f64>),
    /// Unsigned bytes (colours in 0..=255, flags).
    U8(Vec<u8>),
    /// Integers of up to 32 bits.
    I32(Vec<i32>),
    /// Wider integers, and unsigned 32-bit ones.
    I64(Vec<i64>),
    /// Indices into a table of strings; an index outside the table means none.
    Strings {
        /// The distinct strings.
        table: Vec<String>,
        /// One index per component.
        indices: Vec<i32>,
    },
}

/// One named attribute of all particles.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    /// The name in the file; for a vector that the file splits into columns, the common stem.
    pub name: String,
    /// Values per particle.
    pub arity: usize,
    /// What it was recognised as.
    pub role: Option<Role>,
    /// `arity` values per particle.
    pub values: Values,
}

impl Attribute {
    /// Multiplies an attribute; integers become reals.
    pub(crate) fn scale(&mut self, factor: f64) {
        if factor == 1.0 {
            return;
        }
        #[expect(clippy::cast_possible_truncation, reason = "the factor is a half, exact in both")]
        let factor_f32 = factor as f32;
        match &mut self.values {
            Values::F32(values) => values.iter_mut().for_each(|value| *value *= factor_f32),
            Values::F64(values) => values.iter_mut().for_each(|value| *value *= factor),
            Values::U8(values) => {
                self.values =
                    Values::F32(values.iter().map(|&value| f32::from(value) * factor_f32).collect());
            }
            Values::I32(values) => {
                self.values = Values::F64(values.iter().map(|&value| f64::from(value) * factor).collect());
            }
            // At most 32 bits of a 64-bit integer are in use here: the conversion is exact.
            Values::I64(values) => {
                self.values = Values::F64(values.iter().map(|&value| value as f64 * factor).collect());
            }
            Values::Strings { .. } => {}
        }
    }
}

/// One frame of particles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParticleFrame {
    /// Where the particles are. Not yet checked for being finite.
    pub positions: Positions,
    /// Everything else the file says of each particle.
    pub attributes: Vec<Attribute>,
    /// What a user should know though the file was read: rows skipped, columns guessed.
    pub notes: Vec<String>,
}

/// What made a file: name and value pairs, written in this order.
/// No clock, host, path or random number belongs here: equal inputs make equal bytes.
pub type Provenance = [(String, String)];

/// A triangle mesh to write: borrowed from whoever made it.
#[derive(Clone, Copy, Debug)]
pub struct MeshView<'a> {
    /// Vertex positions relative to `origin`, world units.
    pub positions: &'a [[f32; 3]],
    /// Unit vertex normals, pointing outward; as many as positions.
    pub normals: &'a [[f32; 3]],
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: &'a [[u32; 3]],
    /// World position of the point that `positions` are relative to.
    pub origin: [f64; 3],
    /// What else is known of the vertices.
    pub attributes: &'a [VertexAttribute<'a>],
}

impl MeshView<'_> {
    /// Refuses a mesh that no file can hold: unequal lengths, indices of no vertex, numbers that
    /// are not finite. `format` is named in the error.
    pub(crate) fn check(&self, format: &'static str) -> Result<()> {
        let invalid = |what: String| Err(Error::invalid(format, Place::File, what));
        let (vertices, normals) = (self.positions.len(), self.normals.len());
        if vertices != normals {
            return invalid(format!("{normals} normals for {vertices} vertices"));
        }
        if let Some(index) = self.triangles.as_flattened().iter().find(|index| **index as usize >= vertices) {
            return invalid(format!("a triangle with vertex {index} of {vertices}"));
        }
        if !all_finite(self.positions.as_flattened()) || !all_finite(self.normals.as_flattened()) {
            return invalid("a vertex whose position or normal is not finite".into());
        }
        if !self.origin.iter().all(|c| c.is_finite()) {
            return invalid(format!("an origin at {:?}", self.origin));
        }
        self.attributes.iter().try_for_each(|attribute| attribute.check(vertices, format))
    }
}

/// One named attribute of all vertices: borrowed from whoever made it.
#[derive(Clone, Copy, Debug)]
pub struct VertexAttribute<'a> {
    /// Its name among the particles.
    pub name: &'a str,
    /// What it was recognised as.
    pub role: Option<Role>,
    /// Values per vertex, at least 1.
    pub arity: usize,
    /// `arity` values per vertex, vertex by vertex.
    pub values: VertexValues<'a>,
}

/// The values of one attribute.
#[derive(Clone, Copy, Debug)]
pub enum VertexValues<'a> {
    /// Finite numbers.
    Numbers(&'a [f32]),
    /// Numbers that name something.
    Integers(&'a [i64]),
    /// Indices into a table of strings; an index outside the table means none.
    Strings {
        /// The distinct strings.
        table: &'a [String],
        /// One index per component.
        indices: &'a [i32],
    },
}

impl<'a> VertexAttribute<'a> {
    /// Refuses what no file can hold: lengths that do not fit, numbers that are not finite.
    pub(crate) fn check(&self, vertex_count: usize, format: &'static str) -> Result<()> {
        let VertexAttribute { name, arity, values, .. } = self;
        let found = match values {
            VertexValues::Numbers(values) => values.len(),
            VertexValues::Integers(values) => values.len(),
            VertexValues::Strings { indices, .. } => indices.len(),
        };
        let invalid = |what: String| Err(Error::invalid(format, Place::File, what));
        if *arity == 0 || vertex_count.checked_mul(*arity) != Some(found) {
            return invalid(format!("{found} values of {name} for {vertex_count} vertices of {arity} each"));
        }
        if let VertexValues::Numbers(values) = values
            && !all_finite(values)
        {
            return invalid(format!("a value of {name} that is not finite"));
        }
        Ok(())
    }
}

/// Whether all numbers are finite. No branch depends on a single one.
pub(crate) fn all_finite(numbers: &[f32]) -> bool {
    numbers.iter().fold(true, |all, number| all & number.is_finite())
}

/// A mesh read from a file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MeshData {
    /// Vertex positions, world units.
    pub positions: Vec<[f64; 3]>,
    /// Vertex normals, or none.
    pub normals: Vec<[f32; 3]>,
    /// Vertex indices; larger polygons are cut into triangle fans.
    pub triangles: Vec<[u32; 3]>,
}

/// A narrow-band level set to write, leaf by leaf.
///
/// A leaf holds the 8 × 8 × 8 voxels from its origin on, z fastest: voxel (x, y, z) relative to the
/// origin is value `x·64 + y·8 + z`. Values are signed distances **in voxels**, negative inside;
/// the writer multiplies by `voxel_size`. Where there is no leaf, the sign of the nearest leaf
/// decides between inside and outside.
#[derive(Clone, Copy, Debug)]
pub struct LevelSetView<'a> {
    /// Leaf origins in voxels, multiples of 8, distinct, in any order.
    pub origins: &'a [[i32; 3]],
    /// Values of each leaf. Values beyond ± `half_width_voxels` are allowed, and written as that.
    pub leaves: &'a [[f32; 512]],
    /// Half the thickness of the band, positive; times `voxel_size` it is the background value.
    pub half_width_voxels: f32,
    /// Edge length of a voxel, world units. Voxel (0, 0, 0) is centred on the world's origin,
    /// unless the writer is told otherwise.
    pub voxel_size: f64,
    /// What else is known of the voxels of the band.
    pub grids: &'a [BandGrid<'a>],
}

/// Values at the voxels of a level set's band: a grid of its own beside it, active where the level set is.
#[derive(Clone, Copy, Debug)]
pub struct BandGrid<'a> {
    /// Its name among the particles. A velocity's grid is called `velocity`, whatever its name.
    pub name: &'a str,
    /// What it was recognised as.
    pub role: Option<Role>,
    /// Values per voxel: 1, or 3 for a vector.
    pub arity: usize,
    /// Where they come from.
    pub values: &'a dyn LeafValues,
}

/// The values of a grid, leaf by leaf as they are asked for: all of them at once would take several times the
/// memory of the level set.
pub trait LeafValues: fmt::Debug + Sync {
    /// Fills in the values of the 512 voxels of a leaf, which is counted as in [`LevelSetView::leaves`]; as many for
    /// each as the grid's arity. What voxels beyond the band get is not looked at; others must be finite.
    fn fill(&self, leaf: usize, out: &mut [f32]);
}
