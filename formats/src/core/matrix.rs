//! Transforms of row vectors: the last row of a matrix is the translation.

use crate::core::data::Values;
use crate::core::number::wide;

/// A transform. Its rows are the images of the axes, and of the origin.
pub(crate) type Matrix = [[f64; 4]; 4];

pub(crate) const IDENTITY: Matrix =
    [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];

/// The transform `first`, then `second`.
pub(crate) fn product(first: &Matrix, second: &Matrix) -> Matrix {
    if *first == IDENTITY {
        return *second;
    }
    first.map(|row| std::array::from_fn(|column| (0..4).map(|n| row[n] * second[n][column]).sum()))
}

/// The transformed vector. `fourth` is 1 for a point and 0 for a direction.
pub(crate) fn transformed(matrix: &Matrix, vector: [f64; 3], fourth: f64) -> [f64; 3] {
    if *matrix == IDENTITY {
        return vector;
    }
    let [x, y, z] = vector;
    std::array::from_fn(|axis| {
        x * matrix[0][axis] + y * matrix[1][axis] + z * matrix[2][axis] + fourth * matrix[3][axis]
    })
}

/// The factor by which a transform changes volumes; negative if it mirrors.
pub(crate) fn determinant(matrix: &Matrix) -> f64 {
    let cofactors = cofactors(matrix);
    (0..3).map(|axis| matrix[0][axis] * cofactors[0][axis]).sum()
}

/// The inverse, transposed, times the determinant, of the part without translation.
pub(crate) fn cofactors(matrix: &Matrix) -> [[f64; 3]; 3] {
    std::array::from_fn(|row| {
        let [a, b] = [&matrix[(row + 1) % 3], &matrix[(row + 2) % 3]];
        std::array::from_fn(|axis| {
            let [y, z] = [(axis + 1) % 3, (axis + 2) % 3];
            a[y] * b[z] - a[z] * b[y]
        })
    })
}

/// Transforms a normal: it stays perpendicular to its surface, and outward. The result has length 1, except that
/// a rotation, which keeps the length, does not round it.
pub(crate) fn normal_transform(matrix: &Matrix) -> impl Fn([f64; 3]) -> [f64; 3] {
    let sign = determinant(matrix).signum();
    let mut turn = IDENTITY;
    for (row, cofactors) in turn.iter_mut().zip(cofactors(matrix)) {
        row[..3].copy_from_slice(&cofactors.map(|cofactor| sign * cofactor));
    }
    move |normal| {
        let turned = transformed(&turn, normal, 0.0);
        let squared: f64 = turned.iter().map(|along| along * along).sum();
        let length = if (squared - 1.0).abs() < 1e-6 || squared == 0.0 { 1.0 } else { squared.sqrt() };
        turned.map(|along| along / length)
    }
}

/// The rotation about an axis of length 1, counterclockwise as seen from its tip.
pub(crate) fn rotation(axis: [f64; 3], degrees: f64) -> Matrix {
    let (sin, cos) = degrees.to_radians().sin_cos();
    turned(axis, [cos, sin, 1.0 - cos])
}

/// The rotation by a quaternion of length 1, real part first.
pub(crate) fn quaternion_rotation([w, x, y, z]: [f64; 4]) -> Matrix {
    turned([x, y, z], [1.0 - 2.0 * (x * x + y * y + z * z), 2.0 * w, 2.0])
}

/// The sum of the identity, the cross product with the axis and the projection on it, with these factors.
fn turned([x, y, z]: [f64; 3], [one, cross, along]: [f64; 3]) -> Matrix {
    [
        [one + along * x * x, along * x * y + cross * z, along * x * z - cross * y, 0.0],
        [along * x * y - cross * z, one + along * y * y, along * y * z + cross * x, 0.0],
        [along * x * z + cross * y, along * y * z - cross * x, one + along * z * z, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]
}

/// Changes vectors of three numbers. Floats keep their precision; integers become 64-bit floats.
#[expect(clippy::cast_possible_truncation, reason = "the precision of the file")]
pub(crate) fn change_vectors(values: &mut Values, change: impl Fn([f64; 3]) -> [f64; 3]) {
    if let Values::U8(_) | Values::I32(_) | Values::I64(_) = values {
        *values = Values::F64(wide(values));
    }
    match values {
        Values::F32(values) => {
            for vector in values.as_chunks_mut::<3>().0 {
                *vector = change(vector.map(f64::from)).map(|along| along as f32);
            }
        }
        Values::F64(values) => {
            values.as_chunks_mut::<3>().0.iter_mut().for_each(|vector| *vector = change(*vector));
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_stay_outward() {
        // A plane in which x + y = 0, under transforms that scale and mirror.
        for [x, y] in [[1.0, 1.0], [2.0, 1.0], [-2.0, 1.0], [-1.0, -1.0]] {
            let mut matrix = IDENTITY;
            (matrix[0][0], matrix[1][1], matrix[3]) = (x, y, [5.0, 6.0, 7.0, 1.0]);
            let normal = normal_transform(&matrix)([0.8, 0.8, 0.0].map(|along| along * 1.25));
            let along: f64 =
                (0..3).map(|axis| normal[axis] * transformed(&matrix, [1.0, -1.0, 3.0], 0.0)[axis]).sum();
            let outward: f64 =
                (0..3).map(|axis| normal[axis] * transformed(&matrix, [1.0, 1.0, 0.0], 0.0)[axis]).sum();
            assert!(along.abs() < 1e-12 && outward > 0.0, "{x} {y}: {normal:?}");
        }
    }

    #[test]
    fn quaternions_and_angles_give_the_same_rotations() {
        let (sin, cos) = 35_f64.to_radians().sin_cos();
        let axis = [2.0 / 7.0, 3.0 / 7.0, -6.0 / 7.0];
        let [x, y, z] = axis.map(|along| along * sin);
        let difference = rotation(axis, 70.0)
            .as_flattened()
            .iter()
            .zip(quaternion_rotation([cos, x, y, z]).as_flattened())
            .map(|(one, other)| (one - other).abs())
            .fold(0.0, f64::max);
        assert!(difference < 1e-15, "{difference}");
    }
}
