//! Checks which triangles of a mesh are halves of quads.

use glam::IVec3;
use meniscus_surface::contour::Contouring;

use super::bands::{band, block_band, sphere};
use super::{Random, UNIT, checked_contour};

#[test]
fn triangles_of_a_ball_are_halves_of_quads() {
    let ball = band(IVec3::splat(-16), IVec3::splat(16), sphere([0.3, -0.2, 0.41], 11.3));
    let (mesh, _) = checked_contour(&ball, &UNIT, Contouring::Dual);
    let quads = mesh.quads();
    assert!(quads.iter().enumerate().all(|(index, &is_quad)| is_quad == (index % 2 == 0)));
    // One quad around each grid edge that the surface crosses: four vertices, each in a different cell.
    for halves in mesh.triangles.chunks(2) {
        let mut corners = halves.concat();
        corners.sort_unstable();
        corners.dedup();
        assert_eq!(corners.len(), 4);
    }
}

/// Noise also makes fans; every other triangle belongs to a quad.
#[test]
fn triangles_without_a_quad_are_in_a_fan() {
    let mut random = Random(3);
    let values: Vec<f32> = (0..24 * 24 * 24).map(|_| random.next() - 0.5).collect();
    let noise = block_band(IVec3::splat(-13), IVec3::splat(24), &values);
    let (mesh, _) = checked_contour(&noise, &UNIT, Contouring::Dual);
    let quads = mesh.quads();
    let is_half = |index: usize| quads[index] || index > 0 && quads[index - 1];
    let mut index = 0;
    let mut fan_count = 0;
    while index < mesh.triangles.len() {
        if is_half(index) {
            assert!(quads[index] && !quads[index + 1]);
            index += 2;
            continue;
        }
        let center = mesh.triangles[index][0];
        let length = mesh.triangles[index..].iter().take_while(|triangle| triangle[0] == center).count();
        assert!((5..=8).contains(&length), "{length}");
        assert!((index..index + length).all(|index| !is_half(index)));
        index += length;
        fan_count += 1;
    }
    let quad_count = quads.iter().filter(|&&is_quad| is_quad).count();
    assert!(fan_count > 100 && quad_count > 1000, "{fan_count} {quad_count}");
}
