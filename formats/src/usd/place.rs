//! Values at a time, and where prims are: their transforms and whether they are visible.

use super::FORMAT;
use super::composed::{ComposedStage, StagePrim, StrongestValue};
use super::layer::{Value, wide};
use crate::data::Values;
use crate::error::{Error, Result};
use crate::named_arrays::NamedArray;
use crate::text::excerpt;

/// A transform of row vectors: the last row is the translation.
pub(crate) type PrimMatrix = [[f64; 4]; 4];

pub(crate) const IDENTITY: PrimMatrix =
    [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];

/// The transform that applies `a` first.
pub(crate) fn product(a: &PrimMatrix, b: &PrimMatrix) -> PrimMatrix {
    std::array::from_fn(|row| std::array::from_fn(|column| (0..4).map(|k| a[row][k] * b[k][column]).sum()))
}

/// The transformed point, or the transformed direction for `weight` 0.
pub(crate) fn transformed(matrix: &PrimMatrix, [x, y, z]: [f64; 3], weight: f64) -> [f64; 3] {
    std::array::from_fn(|axis| {
        x * matrix[0][axis] + y * matrix[1][axis] + z * matrix[2][axis] + weight * matrix[3][axis]
    })
}

/// How a transform changes volumes; negative if it mirrors.
pub(crate) fn determinant(m: &PrimMatrix) -> f64 {
    let cross: [f64; 3] = cofactors(m)[0];
    (0..3).map(|axis| m[0][axis] * cross[axis]).sum()
}

/// The matrix that turns normals, up to their length.
pub(crate) fn cofactors(m: &PrimMatrix) -> [[f64; 3]; 3] {
    std::array::from_fn(|row| {
        let [a, b] = [&m[(row + 1) % 3], &m[(row + 2) % 3]];
        std::array::from_fn(|axis| {
            let [y, z] = [(axis + 1) % 3, (axis + 2) % 3];
            a[y] * b[z] - a[z] * b[y]
        })
    })
}

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

/// The samples around a time.
enum Moment {
    Value(Value),
    /// Two samples, and how far the time is from the first to the second.
    Between(Value, Value, f64),
}

/// The value at a time code; `None` is the default, or the first sample.
fn moment(value: &StrongestValue, time: Option<f64>) -> Result<Option<Moment>> {
    let Some((samples, codes)) = &value.samples else {
        return Ok(value.default.clone().map(Moment::Value));
    };
    let sample = |index: usize| value.layer().sample(samples, index);
    let Some(time) = time else {
        return Ok(Some(Moment::Value(match &value.default {
            Some(default) => default.clone(),
            None => sample(0)?,
        })));
    };
    let after = codes.partition_point(|code| *code <= time);
    Ok(Some(match after {
        0 => Moment::Value(sample(0)?),
        _ if codes[after - 1] == time || after == codes.len() => Moment::Value(sample(after - 1)?),
        _ => {
            let [first, second] = [codes[after - 1], codes[after]];
            Moment::Between(sample(after - 1)?, sample(after)?, (time - first) / (second - first))
        }
    }))
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
    ) -> Result<Option<(NamedArray, bool)>> {
        let Some(value) = self.attribute(prim, name)? else { return Ok(None) };
        let read = |stored: &Value| match stored {
            Value::Array(place) => value.layer().array(place, name).map(Some),
            Value::Unread(what) => Err(unread(prim, name, what)),
            _ => Ok(None),
        };
        Ok(match moment(&value, time)? {
            Some(Moment::Value(stored)) => read(&stored)?.map(|array| (array, false)),
            Some(Moment::Between(first, second, t)) => match (read(&first)?, read(&second)?) {
                (Some(mut array), Some(second)) => {
                    let is_blended = blend(&mut array.values, &second.values, t);
                    Some((array, is_blended))
                }
                (first, _) => first.map(|array| (array, false)),
            },
            None => None,
        })
    }

    /// The number, vector, matrix or quaternion of an attribute.
    fn numbers_at(&self, prim: &StagePrim, name: &str, time: Option<f64>) -> Result<Option<Vec<f64>>> {
        let Some(value) = self.attribute(prim, name)? else { return Ok(None) };
        Ok(match moment(&value, time)? {
            Some(Moment::Value(Value::Numbers(numbers))) => Some(numbers),
            Some(Moment::Between(Value::Numbers(first), Value::Numbers(second), t)) => {
                let is_rotation = name.starts_with("xformOp:orient");
                Some(if is_rotation { turned(&first, &second, t) } else { between(&first, &second, t) })
            }
            Some(Moment::Between(Value::Numbers(first), ..)) => Some(first),
            Some(Moment::Value(Value::Unread(what))) => return Err(unread(prim, name, what)),
            _ => None,
        })
    }

    /// The token of an attribute.
    pub(crate) fn word_at(&self, prim: &StagePrim, name: &str, time: Option<f64>) -> Result<Option<String>> {
        let Some(value) = self.attribute(prim, name)? else { return Ok(None) };
        Ok(match moment(&value, time)? {
            Some(Moment::Value(Value::Word(word)) | Moment::Between(Value::Word(word), ..)) => Some(word),
            _ => None,
        })
    }

    /// The steps of the transform of a prim, the outermost first.
    fn steps(&self, prim: &StagePrim) -> Result<Vec<String>> {
        if ["", "Scope"].contains(&self.type_name(prim)?.as_str()) {
            return Ok(Vec::new()); // these have no transform
        }
        match self.attribute(prim, "xformOpOrder")? {
            Some(value) => value.default.as_ref().map_or(Ok(Vec::new()), |words| value.layer().words(words)),
            None => Ok(Vec::new()),
        }
    }

    /// The transform of a prim to the stage.
    ///
    /// # Errors
    /// [`Error::Unsupported`] for an unknown step or one without an inverse.
    pub(crate) fn world(&self, prim: &StagePrim, time: Option<f64>) -> Result<PrimMatrix> {
        let mut matrix = IDENTITY;
        for prim in ancestors(prim) {
            let steps = self.steps(prim)?;
            for step in steps.iter().rev().filter(|step| *step != RESET) {
                matrix = product(&matrix, &self.step(prim, step, time)?);
            }
            if steps.iter().any(|step| step == RESET) {
                break;
            }
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
        for prim in ancestors(prim) {
            let steps = self.steps(prim)?;
            for step in &steps {
                codes.extend(self.sample_codes(prim, step.strip_prefix(INVERT).unwrap_or(step))?);
            }
            if steps.iter().any(|step| step == RESET) {
                break;
            }
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
            let [w, x, y, z] =
                if norm > 0.0 { [w, x, y, z].map(|part| part / norm) } else { [1.0, 0.0, 0.0, 0.0] };
            let two = 2.0;
            matrix[0][..3].copy_from_slice(&[
                1.0 - two * (y * y + z * z),
                two * (x * y + w * z),
                two * (x * z - w * y),
            ]);
            matrix[1][..3].copy_from_slice(&[
                two * (x * y - w * z),
                1.0 - two * (x * x + z * z),
                two * (y * z + w * x),
            ]);
            matrix[2][..3].copy_from_slice(&[
                two * (x * z + w * y),
                two * (y * z - w * x),
                1.0 - two * (x * x + y * y),
            ]);
        }
        ("transform", values) if values.len() == 16 => {
            let (rows, _) = values.as_chunks::<4>();
            (0..4).for_each(|row| matrix[row] = rows[row]);
        }
        _ => {
            let (stem, axes) = ["translate", "scale", "rotate"]
                .iter()
                .find_map(|stem| Some((*stem, kind.strip_prefix(stem)?)))?;
            let axis_of = |letter: char| "XYZ".find(letter);
            let mut letters = axes.chars();
            match (stem, letters.next().and_then(axis_of), axes.len(), numbers) {
                ("translate", Some(axis), 1, &[x]) => matrix[3][axis] = x,
                ("scale", Some(axis), 1, &[x]) => matrix[axis][axis] = x,
                ("rotate", Some(axis), 1, &[angle]) => matrix = rotation(axis, angle),
                ("rotate", Some(_), 3, angles @ [_, _, _]) => {
                    for letter in axes.chars() {
                        let axis = axis_of(letter)?;
                        matrix = product(&matrix, &rotation(axis, angles[axis]));
                    }
                }
                _ => return None,
            }
        }
    }
    Some(matrix)
}

fn rotation(axis: usize, degrees: f64) -> PrimMatrix {
    let (sin, cos) = degrees.to_radians().sin_cos();
    let [a, b] = [(axis + 1) % 3, (axis + 2) % 3];
    let mut matrix = IDENTITY;
    (matrix[a][a], matrix[a][b], matrix[b][a], matrix[b][b]) = (cos, sin, -sin, cos);
    matrix
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

/// Transforms vectors of three numbers; the results have 64 bits.
pub(crate) fn all_transformed(values: &Values, matrix: &PrimMatrix, weight: f64) -> Vec<f64> {
    let wide = wide(values);
    wide.as_chunks::<3>().0.iter().flat_map(|vector| transformed(matrix, *vector, weight)).collect()
}
