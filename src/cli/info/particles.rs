//! The contents of a frame of particles for `meniscus info`.

use std::fmt;

use meniscus_formats::{AttributeRole, FileAttribute, ParticleFrame, Values};
use serde::Serialize;

use crate::pipeline::{MeasuredSpacing, particles};
use crate::surface::options::Preset;
use crate::surface::particles::OwnedPositions;

use super::super::wording::{shortest, significant};
use super::{BoundingBox, row, short, vector};

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
    suggested_voxel_size: Option<f64>,
}

/// An attribute of particles, or of vertices.
#[derive(Debug, Serialize)]
pub(super) struct AttributeInfo {
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
    /// `measured` is the spacing that `convert` would measure on this frame alone.
    pub(super) fn of(frame: ParticleFrame, measured: Option<&MeasuredSpacing>) -> ParticlesInfo {
        let attributes = attributes_of(&frame.attributes);
        let particles = particles(frame.positions);
        let positions = || (0..particles.len()).map(|index| particles.position(index));
        let bounds = BoundingBox::of(positions().map(|position| position.to_array()));
        ParticlesInfo {
            count: particles.len(),
            position_type: match particles {
                OwnedPositions::F32(_) => "f32",
                OwnedPositions::F64(_) => "f64",
            },
            not_finite: positions().filter(|position| !position.is_finite()).count(),
            bounds: match particles {
                OwnedPositions::F32(_) => bounds.map(BoundingBox::short),
                OwnedPositions::F64(_) => bounds,
            },
            attributes,
            spacing: measured.map(|measured| measured.spacing),
            spacing_confidence: measured.map(|measured| measured.confidence),
            suggested_voxel_size: measured.map(|measured| Preset::default().voxel_size(measured.spacing)),
        }
    }
}

/// The description of the attributes.
pub(super) fn attributes_of(attributes: &[FileAttribute]) -> Vec<AttributeInfo> {
    attributes.iter().map(attribute_info).collect()
}

/// Writes a line for each attribute.
pub(super) fn fmt_attributes(attributes: &[AttributeInfo], f: &mut fmt::Formatter<'_>) -> fmt::Result {
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
    let short = |min_max: Option<(f64, f64)>| real(min_max.map(|(min, max)| (short(min), short(max))));
    let (value_type, ranges): (_, Vec<Option<(PrintedNumber, PrintedNumber)>>) = match &attribute.values {
        Values::F32(values) => ("f32", ranges(values, arity, f32_range, short)),
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
