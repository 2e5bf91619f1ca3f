//! Particles in the types of formats that have only 32-bit floats: positions relative to an origin, and attributes like
//! those of vertices.

use std::borrow::Cow;

use crate::core::data::{
    AttributeRole, FileAttribute, FilePositions, ParticleFrame, Values, VertexAttribute, VertexValues,
};
use crate::core::error::{Error, Position, Result};
use crate::core::vertex_attributes::check;

/// The particles of a frame.
pub(crate) struct NarrowPoints<'a> {
    /// What positions are relative to, world units: zero, unless they have 64 bits.
    pub(crate) origin: [f64; 3],
    pub(crate) positions: Cow<'a, [[f32; 3]]>,
    pub(crate) ids: Option<Cow<'a, [i64]>>,
    /// Diameters.
    pub(crate) widths: Option<Vec<f32>>,
    /// The other attributes.
    others: Vec<NarrowAttribute<'a>>,
}

struct NarrowAttribute<'a> {
    name: &'a str,
    role: Option<AttributeRole>,
    arity: usize,
    values: NarrowValues<'a>,
}

enum NarrowValues<'a> {
    Numbers(Cow<'a, [f32]>),
    Integers(Cow<'a, [i64]>),
    Strings { table: &'a [String], indices: &'a [i32] },
}

impl<'a> NarrowPoints<'a> {
    /// Converts a frame. Numbers that are not finite become 0.
    ///
    /// # Errors
    /// [`Error::Invalid`] if an attribute has the wrong number of values, or a position is not finite.
    pub(crate) fn of(frame: &'a ParticleFrame, format: &'static str) -> Result<NarrowPoints<'a>> {
        let origin = match &frame.positions {
            FilePositions::F32(_) => [0.0; 3],
            FilePositions::F64(positions) => middle(positions),
        };
        NarrowPoints::around(frame, origin, format)
    }

    /// Converts a frame; positions become relative to this origin.
    ///
    /// # Errors
    /// Those of [`NarrowPoints::of`].
    pub(crate) fn around(
        frame: &'a ParticleFrame,
        origin: [f64; 3],
        format: &'static str,
    ) -> Result<NarrowPoints<'a>> {
        check(frame, format)?;
        let positions: Cow<[[f32; 3]]> = match &frame.positions {
            FilePositions::F32(positions) if origin == [0.0; 3] => Cow::Borrowed(&**positions),
            FilePositions::F32(positions) => {
                positions.iter().map(|position| relative(position.map(f64::from), origin)).collect()
            }
            FilePositions::F64(positions) => {
                positions.iter().map(|position| relative(*position, origin)).collect()
            }
        };
        if !positions.as_flattened().iter().all(|along| along.is_finite()) {
            return Err(Error::invalid(format, Position::File, "the position of a point is not finite"));
        }
        let (mut ids, mut widths, mut others) = (None, None, Vec::new());
        for FileAttribute { name, arity, role, values } in &frame.attributes {
            let values = narrowed(values);
            match (role, arity, &values) {
                (Some(AttributeRole::Id), 1, NarrowValues::Integers(values)) if ids.is_none() => {
                    ids = Some(values.clone());
                }
                (Some(AttributeRole::Radius), 1, NarrowValues::Numbers(radii)) if widths.is_none() => {
                    widths = Some(radii.iter().map(|radius| 2.0 * radius).collect());
                }
                _ => others.push(NarrowAttribute { name, role: *role, arity: *arity, values }),
            }
        }
        Ok(NarrowPoints { origin, positions, ids, widths, others })
    }

    /// The largest radius; 0 without widths.
    pub(crate) fn radius(&self) -> f32 {
        self.widths.iter().flatten().fold(0.0, |most: f32, width| most.max(0.5 * width))
    }

    /// The attributes other than ids and widths.
    pub(crate) fn others(&self) -> Vec<VertexAttribute<'_>> {
        self.others.iter().map(NarrowAttribute::view).collect()
    }
}

impl NarrowAttribute<'_> {
    fn view(&self) -> VertexAttribute<'_> {
        let values = match &self.values {
            NarrowValues::Numbers(values) => VertexValues::Numbers(values),
            NarrowValues::Integers(values) => VertexValues::Integers(values),
            NarrowValues::Strings { table, indices } => VertexValues::Strings { table, indices },
        };
        // Points have no texture.
        let role = self.role.filter(|role| *role != AttributeRole::TextureCoordinates);
        VertexAttribute { name: self.name, role, arity: self.arity, values }
    }
}

/// Notes on attributes with numbers that are not finite, which become 0 in a file with this extension.
pub(crate) fn not_finite_notes(frame: &ParticleFrame, extension: &str) -> Vec<String> {
    let note = |attribute: &FileAttribute| {
        let count = match &attribute.values {
            Values::F32(values) => values.iter().filter(|value| !value.is_finite()).count(),
            Values::F64(values) => values.iter().filter(|&&value| !narrow(value).is_finite()).count(),
            _ => 0,
        };
        (count > 0)
            .then(|| format!("{count} values of {} are not finite: the .{extension} has 0", attribute.name))
    };
    frame.attributes.iter().filter_map(note).collect()
}

/// The median of the finite positions along each axis; zero without any. Unlike the middle of their bounding box, it is
/// near most of them however far away some are.
fn middle(positions: &[[f64; 3]]) -> [f64; 3] {
    let along = |axis: usize| {
        let finite = positions.iter().map(|position| position[axis]).filter(|along| along.is_finite());
        let mut finite: Vec<f64> = finite.collect();
        let half = finite.len() / 2;
        if finite.is_empty() { 0.0 } else { *finite.select_nth_unstable_by(half, f64::total_cmp).1 }
    };
    [0, 1, 2].map(along)
}

fn relative(position: [f64; 3], origin: [f64; 3]) -> [f32; 3] {
    std::array::from_fn(|axis| narrow(position[axis] - origin[axis]))
}

#[expect(clippy::cast_possible_truncation, reason = "the formats have 32-bit floats")]
fn narrow(value: f64) -> f32 {
    value as f32
}

fn narrowed(values: &Values) -> NarrowValues<'_> {
    let finite = |value: f32| if value.is_finite() { value } else { 0.0 };
    match values {
        Values::F32(values) if values.iter().all(|value| value.is_finite()) => {
            NarrowValues::Numbers(Cow::Borrowed(values))
        }
        Values::F32(values) => NarrowValues::Numbers(values.iter().map(|&value| finite(value)).collect()),
        Values::F64(values) => {
            NarrowValues::Numbers(values.iter().map(|&value| finite(narrow(value))).collect())
        }
        Values::U8(values) => NarrowValues::Integers(values.iter().map(|&value| value.into()).collect()),
        Values::I32(values) => NarrowValues::Integers(values.iter().map(|&value| value.into()).collect()),
        Values::I64(values) => NarrowValues::Integers(Cow::Borrowed(values)),
        Values::Strings { table, indices } => NarrowValues::Strings { table, indices },
    }
}
