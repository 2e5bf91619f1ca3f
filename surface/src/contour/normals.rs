//! Vertex normals from φ.
//!
//! φ grows outward, so its gradient points along the normal, and is smoother and more accurate than normals
//! computed from triangles. Midway between two sheets, the gradient vanishes and has no direction. There, the
//! normal comes from the triangles.

use glam::{DVec3, Vec3};

use crate::mesh::Mesh;

/// Gradients shorter than this are mostly rounding error. (The gradient of a distance has length one.)
const SLOPE_MIN: f32 = 1e-3;

/// The direction of a gradient, or zero if the gradient is too short.
#[inline(always)]
pub(super) fn unit_or_zero(gradient: Vec3) -> Vec3 {
    let length = gradient.length();
    let unit = gradient / length;
    // Comparison with NaN is false, so values that are not finite give zero, too.
    if (length > SLOPE_MIN) & (length < f32::INFINITY) { unit } else { Vec3::ZERO }
}

/// Replaces each zero normal by the area-weighted mean of the vertex's triangle normals, or by the z axis if
/// these cancel, as on a sheet that is folded flat.
pub fn fill_zero_normals(mesh: &mut Mesh) {
    if mesh.normals.iter().all(|&normal| normal != Vec3::ZERO) {
        return;
    }
    let mut sums = vec![DVec3::ZERO; mesh.positions.len()];
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|vertex| mesh.positions[vertex as usize].as_dvec3());
        let doubled_area = (b - a).cross(c - a);
        triangle.iter().for_each(|&vertex| sums[vertex as usize] += doubled_area);
    }
    for (normal, sum) in mesh.normals.iter_mut().zip(sums) {
        if *normal == Vec3::ZERO {
            *normal = sum.try_normalize().unwrap_or(DVec3::Z).as_vec3();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zero_normal_becomes_mean_of_triangle_normals() {
        let mut mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            normals: vec![
                unit_or_zero(Vec3::splat(1e-9)),
                unit_or_zero(Vec3::NAN),
                unit_or_zero(2.0 * Vec3::X),
            ],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        };
        fill_zero_normals(&mut mesh);
        assert_eq!(mesh.normals, [Vec3::Z, Vec3::Z, Vec3::X]);
    }

    #[test]
    fn folded_sheet_gets_unit_normals() {
        let mut mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            normals: vec![Vec3::ZERO; 3],
            triangles: vec![[0, 1, 2], [0, 2, 1]],
            ..Mesh::default()
        };
        fill_zero_normals(&mut mesh);
        assert_eq!(mesh.normals, [Vec3::Z; 3]);
    }
}
