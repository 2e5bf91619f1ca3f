//! Eigenvalues and eigenvectors of eight symmetric 3×3 matrices at once, by Jacobi rotations.
//!
//! ```text
//!   ⎡xx xy xz⎤    each rotation makes one of xy, xz and yz zero and shrinks the sum of the squares of
//!   ⎢xy yy yz⎥    all three; each sweep of three rotations about doubles the number of correct digits
//!   ⎣xz yz zz⎦
//! ```
//!
//! The code has no branches and no trigonometry, and the number of rotations is fixed. So eight matrices take
//! little more time than one, all processors compute the same bits, and equal eigenvalues need no special
//! case.
//!
//! This work is based on:
//! William Press et al. Numerical Recipes, section 11.1. 2007

use crate::simd::Lanes;

/// Eigenvalues and orthonormal eigenvectors.
pub(super) struct Eigen<V> {
    /// The eigenvalues, in no particular order.
    pub(super) values: [V; 3],
    /// x, y and z of the vector of each eigenvalue.
    pub(super) vectors: [[V; 3]; 3],
}

/// Decomposes matrices with the entries xx, yy, zz, xy, xz and yz, whose magnitudes are at most about 1.
#[inline(always)]
pub(super) fn eigen<V: Lanes>(matrix: [V; 6]) -> Eigen<V> {
    let [mut xx, mut yy, mut zz, mut xy, mut xz, mut yz] = matrix;
    let (zero, one) = (V::splat(0.0), V::splat(1.0));
    let [mut x, mut y, mut z] = [[one, zero, zero], [zero, one, zero], [zero, zero, one]];
    for _ in 0..SWEEP_COUNT {
        (xx, yy) = rotate(xx, yy, &mut xy, [&mut xz, &mut yz], [&mut x, &mut y]);
        (xx, zz) = rotate(xx, zz, &mut xz, [&mut xy, &mut yz], [&mut x, &mut z]);
        (yy, zz) = rotate(yy, zz, &mut yz, [&mut xy, &mut xz], [&mut y, &mut z]);
    }
    Eigen { values: [xx, yy, zz], vectors: [x, y, z] }
}

/// Number of sweeps. After these, the entries off the diagonal are smaller than the rounding error, for any
/// matrix.
const SWEEP_COUNT: usize = 5;

/// Makes `pq` zero by a rotation of the axes p and q. `others` are the entries pr and qr, where r is the
/// third axis. Returns the new pp and qq.
#[inline(always)]
fn rotate<V: Lanes>(pp: V, qq: V, pq: &mut V, others: [&mut V; 2], axes: [&mut [V; 3]; 2]) -> (V, V) {
    let apart = qq.sub(pp);
    let twice = pq.add(*pq);
    let root = apart.mul(apart).add(twice.mul(twice)).sqrt();
    // If the sum is zero, `twice` is zero too, and there is nothing to rotate: `max` avoids 0/0.
    let sum = apart.abs().add(root).max(V::splat(f32::MIN_POSITIVE));
    let tangent = twice.div(sum).mul(V::splat(1.0).copysign(apart));
    let cosine = V::splat(1.0).div(V::splat(1.0).add(tangent.mul(tangent)).sqrt());
    let sine = tangent.mul(cosine);
    let moved = tangent.mul(*pq);
    *pq = V::splat(0.0);
    let [pr, qr] = others;
    rotate_pair(pr, qr, cosine, sine);
    let [p, q] = axes;
    for axis in 0..3 {
        rotate_pair(&mut p[axis], &mut q[axis], cosine, sine);
    }
    (pp.sub(moved), qq.add(moved))
}

#[inline(always)]
fn rotate_pair<V: Lanes>(p: &mut V, q: &mut V, cosine: V, sine: V) {
    let (before_p, before_q) = (*p, *q);
    *p = cosine.mul(before_p).sub(sine.mul(before_q));
    *q = sine.mul(before_p).add(cosine.mul(before_q));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Kernel, SimdLevel, dispatch_at};
    use glam::{DMat3, DVec3};

    struct Decompose([[f32; 8]; 6]);

    impl Kernel for Decompose {
        /// The eigenvalues, then x, y and z of each eigenvector.
        type Output = [[f32; 8]; 12];

        #[inline(always)]
        fn run<V: Lanes>(self) -> [[f32; 8]; 12] {
            let [a, b, c, d, e, f] = &self.0;
            let eigen: Eigen<V> =
                eigen([V::load(a), V::load(b), V::load(c), V::load(d), V::load(e), V::load(f)]);
            let mut rows = [[0.0; 8]; 12];
            for k in 0..3 {
                eigen.values[k].store(&mut rows[k]);
                for axis in 0..3 {
                    eigen.vectors[k][axis].store(&mut rows[3 + 3 * k + axis]);
                }
            }
            rows
        }
    }

    /// The largest error: of M·v compared to λ·v, and of the dot products of the vectors compared to those of
    /// orthonormal vectors.
    fn error(matrices: [[f32; 8]; 6], level: SimdLevel) -> f64 {
        let rows = dispatch_at(level, Decompose(matrices));
        let mut error = 0f64;
        for lane in 0..8 {
            let [xx, yy, zz, xy, xz, yz] = matrices.map(|row| f64::from(row[lane]));
            let columns = [DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz)];
            let matrix = DMat3::from_cols(columns[0], columns[1], columns[2]);
            let vectors: [DVec3; 3] = std::array::from_fn(|k| {
                DVec3::from(std::array::from_fn(|axis| f64::from(rows[3 + 3 * k + axis][lane])))
            });
            for k in 0..3 {
                let value = f64::from(rows[k][lane]);
                error = error.max((matrix * vectors[k] - value * vectors[k]).length());
                for other in 0..3 {
                    let expected = f64::from(u8::from(k == other));
                    error = error.max((vectors[k].dot(vectors[other]) - expected).abs());
                }
            }
        }
        error
    }

    #[test]
    fn eigenvectors_map_to_multiples_of_themselves() {
        let mut state = 5u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        };
        for round in 0..2000 {
            // The matrices range from full to nearly diagonal; some have equal entries.
            let off = 0.3f32.powi(round % 40);
            let mut matrices: [[f32; 8]; 6] = std::array::from_fn(|entry| {
                std::array::from_fn(|_| if entry < 3 { random() } else { off * random() })
            });
            if round % 3 == 0 {
                matrices[1] = matrices[0];
            }
            if round % 6 == 0 {
                (matrices[2], matrices[4]) = (matrices[0], matrices[3]);
            }
            for level in SimdLevel::ALL {
                let error = error(matrices, level);
                assert!(error < 2e-6, "{error} for {matrices:?}");
            }
        }
    }

    #[test]
    fn diagonal_matrices_stay_unchanged() {
        let tiny = f32::MIN_POSITIVE;
        let cases = [[0.0; 6], [1.0, 1.0, 1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.5, tiny, -tiny, 1e-20], [1.0; 6]];
        for entries in cases {
            let error = error(entries.map(|entry| [entry; 8]), SimdLevel::Baseline);
            assert!(error < 1e-6, "{error} for {entries:?}");
        }
    }
}
