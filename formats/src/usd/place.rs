//! Values at a time, and where prims are: their transforms and whether they are visible.

use super::FORMAT;
use super::composed::{ComposedStage, StagePrim, StrongestValue};
use super::layer::Value;
use crate::core::data::{FileAttribute, Values};
use crate::core::error::{Error, Result};
use crate::core::matrix::{IDENTITY, product, quaternion_rotation, rotation};
pub(crate) use crate::core::matrix::{Matrix as PrimMatrix, cofactors, determinant, transformed};
use crate::core::text::excerpt;

fn inverse(m: &PrimMatrix) -> Option<PrimMatrix> {
    let (cofactors, determinant) = (cofactors(m), determinant(m));
    if determinant == 0.0 || !determinant.is_finite() {
        return None;
    }
    let mut inverse = IDENTITY;
    for row in 0..3 {
        for column in 0..3 {
            inverse[row][column] = cofactors[column][row] / determinant;
        }
    }
    let moved = transformed(&inverse, [m[3][0], m[3][1], m[3][2]], 0.0);
    inverse[3][..3].copy_from_slice(&moved.map(|x| -x));
    Some(inverse)
}

/// The value at a time code or, if it lies between two samples, both, and how far it is from the first to the
/// second. Without a time, the default or the first sample.
type Moment = (Value, Option<(Value, f64)>);

fn moment(value: &StrongestValue, time: Option<f64>) -> Result<Option<Moment>> {
    let (Some((samples, codes)), Some(time)) = (&value.samples, time) else {
        let first = value.samples.as_ref().filter(|_| value.default.is_none());
        let first = first.map(|(samples, _)| value.layer().sample(samples, 0)).transpose()?;
        return Ok(first.or_else(|| value.default.clone()).map(|value| (value, None)));
    };
    let after = codes.partition_point(|code| *code <= time);
    let first = after.saturating_sub(1);
    let later = match (after, codes.get(after)) {
        (1.., Some(later)) if codes[first] < time => {
            Some((value.layer().sample(samples, after)?, (time - codes[first]) / (later - codes[first])))
        }
        _ => None,
    };
    Ok(Some((value.layer().sample(samples, first)?, later)))
}

impl ComposedStage<'_> {
    /// The array of an attribute at a time code, and whether it lies between two samples. Floats are
    /// interpolated if both samples have as many; other values are those of the sample before.
    ///
    /// # Errors
    /// [`Error::Unsupported`] for edits of arrays.
    pub(crate) fn array_at(
        &self,
        prim: &StagePrim,
        name: &str,
        time: Option<f64>,
    ) -> Result<Option<(FileAttribute, bool)>> {
        let Some(value) = self.attribute(prim, name)? else { return Ok(None) };
        let read = |stored: &Value| match stored {
            Value::Array(place) => value.layer().array(place, name).map(Some),
            Value::Unread(what) => Err(unread(prim, name, what)),
            _ => Ok(None),
        };
        let Some((first, later)) = moment(&value, time)? else { return Ok(None) };
        let Some(mut array) = read(&first)? else { return Ok(None) };
        let is_between = match later {
            Some((later, t)) => read(&later)?.is_some_and(|later| blend(&mut array.values, &later.values, t)),
            None => false,
        };
        Ok(Some((array, is_between)))
    }

    /// The number, vector, matrix or quaternion of an attribute.
    fn numbers_at(&self, prim: &StagePrim, name: &str, time: Option<f64>) -> Result<Option<Vec<f64>>> {
        let Some(value) = self.attribute(prim, name)? else { return Ok(None) };
        Ok(match moment(&value, time)? {
            Some((Value::Numbers(first), Some((Value::Numbers(second), t)))) => {
                let is_rotation = name.starts_with("xformOp:orient");
                Some(if is_rotation { turned(&first, &second, t) } else { between(&first, &second, t) })
            }
            Some((Value::Numbers(numbers), _)) => Some(numbers),
            Some((Value::Unread(what), _)) => return Err(unread(prim, name, what)),
            _ => None,
        })
    }

    /// The token of an attribute.
    pub(crate) fn word_at(&self, prim: &StagePrim, name: &str, time: Option<f64>) -> Result<Option<String>> {
        let Some(value) = self.attribute(prim, name)? else { return Ok(None) };
        Ok(match moment(&value, time)? {
            Some((Value::Word(word), _)) => Some(word),
            _ => None,
        })
    }

    /// The steps of the transform of a prim to the stage, each with the prim that has it, in the order in which
    /// they are applied.
    fn steps<'p>(&self, prim: &'p StagePrim) -> Result<Vec<(&'p StagePrim, String)>> {
        let mut all = Vec::new();
        for prim in ancestors(prim) {
            if ["", "Scope"].contains(&self.type_name(prim)?.as_str()) {
                continue; // these have no transform
            }
            let Some(order) = self.attribute(prim, "xformOpOrder")? else { continue };
            let steps = order.default.as_ref().map_or(Ok(Vec::new()), |words| order.layer().words(words))?;
            let is_reset = steps.iter().any(|step| step == RESET);
            all.extend(steps.into_iter().rev().filter(|step| step != RESET).map(|step| (prim, step)));
            if is_reset {
                break;
            }
        }
        Ok(all)
    }

    /// The transform of a prim to the stage.
    ///
    /// # Errors
    /// [`Error::Unsupported`] for an unknown step or one without an inverse.
    pub(crate) fn world(&self, prim: &StagePrim, time: Option<f64>) -> Result<PrimMatrix> {
        let mut matrix = IDENTITY;
        for (prim, step) in self.steps(prim)? {
            matrix = product(&matrix, &self.step(prim, &step, time)?);
        }
        Ok(matrix)
    }

    fn step(&self, prim: &StagePrim, step: &str, time: Option<f64>) -> Result<PrimMatrix> {
        let refused = |what: &str| {
            let what = format!("{}: the transform {} {what}", excerpt(&prim.path), excerpt(step));
            Error::unsupported(FORMAT, what)
        };
        let name = step.strip_prefix(INVERT).unwrap_or(step);
        let Some(numbers) = self.numbers_at(prim, name, time)? else { return Ok(IDENTITY) };
        let kind = name.strip_prefix("xformOp:").and_then(|rest| rest.split(':').next()).unwrap_or_default();
        let matrix = matrix_of(kind, &numbers).ok_or_else(|| refused("is of an unknown type"))?;
        if name.len() == step.len() {
            return Ok(matrix);
        }
        inverse(&matrix).ok_or_else(|| refused("has no inverse"))
    }

    /// The time codes at which the transform of a prim has samples.
    pub(crate) fn transform_codes(&self, prim: &StagePrim) -> Result<Vec<f64>> {
        let mut codes = Vec::new();
        for (prim, step) in self.steps(prim)? {
            codes.extend(self.sample_codes(prim, step.strip_prefix(INVERT).unwrap_or(&step))?);
        }
        Ok(codes)
    }

    /// Whether neither the prim nor one above it is invisible.
    pub(crate) fn is_visible(&self, prim: &StagePrim, time: Option<f64>) -> Result<bool> {
        for prim in ancestors(prim) {
            if self.word_at(prim, "visibility", time)?.as_deref() == Some("invisible") {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Whether a prim is for final pictures: not a proxy or a guide.
    pub(crate) fn is_rendered(&self, prim: &StagePrim) -> Result<bool> {
        for prim in ancestors(prim) {
            if let Some(purpose) = self.word_at(prim, "purpose", None)? {
                return Ok(purpose != "proxy" && purpose != "guide");
            }
        }
        Ok(true)
    }
}

fn unread(prim: &StagePrim, name: &str, what: &str) -> Error {
    let what = format!("{}.{name} is {what}, which is not supported", excerpt(&prim.path));
    Error::unsupported(FORMAT, what)
}

const RESET: &str = "!resetXformStack!";
const INVERT: &str = "!invert!";

/// The prim, and those above it.
pub(crate) fn ancestors(prim: &StagePrim) -> impl Iterator<Item = &StagePrim> {
    std::iter::successors(Some(prim), |prim| prim.parent.as_deref().map(|parent: &StagePrim| parent))
}

/// The matrix of a step of a transform. Angles are in degrees.
fn matrix_of(kind: &str, numbers: &[f64]) -> Option<PrimMatrix> {
    let mut matrix = IDENTITY;
    match (kind, numbers) {
        ("translate", &[x, y, z]) => matrix[3] = [x, y, z, 1.0],
        ("scale", scale @ [_, _, _]) => (0..3).for_each(|axis| matrix[axis][axis] = scale[axis]),
        ("orient", &[w, x, y, z]) => {
            let norm = (w * w + x * x + y * y + z * z).sqrt();
            if norm > 0.0 {
                matrix = quaternion_rotation([w, x, y, z].map(|part| part / norm));
            }
        }
        ("transform", values) if values.len() == 16 => {
            matrix.as_flattened_mut().copy_from_slice(values);
        }
        _ => {
            let (stem, axes) = ["translate", "scale", "rotate"]
                .iter()
                .find_map(|stem| Some((*stem, kind.strip_prefix(stem)?)))?;
            let axis_of = |letter: char| "XYZ".find(letter);
            let unit = |axis: usize| [0, 1, 2].map(|other| f64::from(u8::from(other == axis)));
            let mut letters = axes.chars();
            match (stem, letters.next().and_then(axis_of), axes.len(), numbers) {
                ("translate", Some(axis), 1, &[x]) => matrix[3][axis] = x,
                ("scale", Some(axis), 1, &[x]) => matrix[axis][axis] = x,
                ("rotate", Some(axis), 1, &[angle]) => matrix = rotation(unit(axis), angle),
                ("rotate", Some(_), 3, angles @ [_, _, _]) => {
                    for letter in axes.chars() {
                        let axis = axis_of(letter)?;
                        matrix = product(&matrix, &rotation(unit(axis), angles[axis]));
                    }
                }
                _ => return None,
            }
        }
    }
    Some(matrix)
}

fn between(first: &[f64], second: &[f64], t: f64) -> Vec<f64> {
    first.iter().zip(second).map(|(a, b)| a + (b - a) * t).collect()
}

/// The rotation between two quaternions, along the shorter arc.
/// Shoemake. Animating rotation with quaternion curves. 1985
fn turned(first: &[f64], second: &[f64], t: f64) -> Vec<f64> {
    let dot: f64 = first.iter().zip(second).map(|(a, b)| a * b).sum();
    let sign = if dot < 0.0 { -1.0 } else { 1.0 };
    let angle = dot.abs().min(1.0).acos();
    let [a, b] = if angle < 1e-6 {
        [1.0 - t, t]
    } else {
        [((1.0 - t) * angle).sin() / angle.sin(), (t * angle).sin() / angle.sin()]
    };
    first.iter().zip(second).map(|(first, second)| a * first + sign * b * second).collect()
}

/// Moves floats towards those of a later sample; returns whether that was possible.
#[expect(clippy::cast_possible_truncation, reason = "the values have 32 bits")]
fn blend(values: &mut Values, later: &Values, t: f64) -> bool {
    match (values, later) {
        (Values::F32(values), Values::F32(later)) if values.len() == later.len() => {
            let part = t as f32;
            values.iter_mut().zip(later).for_each(|(a, b)| *a += (b - *a) * part);
            true
        }
        (Values::F64(values), Values::F64(later)) if values.len() == later.len() => {
            values.iter_mut().zip(later).for_each(|(a, b)| *a += (b - *a) * t);
            true
        }
        _ => false,
    }
}
