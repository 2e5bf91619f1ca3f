//! Refinement: closed meshes that are close to strongly curved surfaces, and no change elsewhere.

use glam::{DVec3, IVec3};
use meniscus_surface::contour::{Contouring, contour, refine};
use meniscus_surface::level_set::NarrowBand;
use meniscus_surface::mesh::Mesh;
use meniscus_surface::{Options, reconstruct};

use super::bands::{band, block_band, moved, sphere, torus};
use super::{Random, UNIT};

/// The refined mesh of a band. Checks that it is sound.
fn refined(band: &NarrowBand) -> Mesh {
    let mut mesh = contour(band, &UNIT, Contouring::Dual);
    refine(&mut mesh, band, &UNIT);
    let measures = mesh.measure();
    assert!(measures.is_closed_manifold(), "{measures:?}");
    assert!(mesh.normals.iter().all(|normal| (normal.length() - 1.0).abs() < 1e-5));
    mesh
}

/// A cylinder along (1, 2, 3) with round ends.
fn thread(radius: f64) -> impl Fn([f64; 3]) -> f64 {
    let along = DVec3::new(1.0, 2.0, 3.0) / 14f64.sqrt();
    move |point| {
        let point = DVec3::from(point) - DVec3::new(0.3, 0.2, 0.1);
        point.distance(along * point.dot(along).clamp(-9.0, 9.0)) - radius
    }
}

/// The outward direction of a distance function.
fn outward(phi: &dyn Fn([f64; 3]) -> f64, point: DVec3) -> DVec3 {
    let slope = |axis: DVec3| phi((point + 1e-4 * axis).to_array()) - phi((point - 1e-4 * axis).to_array());
    DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z)).normalize()
}

/// The 95th percentile of some numbers.
fn most(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values[values.len() * 95 / 100]
}

/// The 95th percentiles of distances of vertices, and of the angles of normals and of faces, in degrees.
fn errors(mesh: &Mesh, phi: &dyn Fn([f64; 3]) -> f64) -> [f64; 3] {
    let points: Vec<DVec3> =
        mesh.positions.iter().map(|position| mesh.origin + position.as_dvec3()).collect();
    let distances = points.iter().map(|point| phi(point.to_array()).abs()).collect();
    let normals = points.iter().zip(&mesh.normals);
    let angles = normals.map(|(&point, normal)| outward(phi, point).angle_between(normal.as_dvec3()));
    let faces = mesh.triangles.iter().map(|triangle| {
        let [a, b, c] = triangle.map(|vertex| points[vertex as usize]);
        outward(phi, (a + b + c) / 3.0).angle_between((b - a).cross(c - a))
    });
    let degrees = |angles: Vec<f64>| most(angles).to_degrees();
    [most(distances), degrees(angles.collect()), degrees(faces.collect())]
}

/// A distance function.
type Phi = Box<dyn Fn([f64; 3]) -> f64>;

#[test]
fn strongly_curved_surfaces_are_fine() {
    let shapes: [(&str, Phi, [f64; 3]); 4] = [
        ("drop", Box::new(sphere([0.3, 0.2, 0.1], 2.0)), [0.03, 4.0, 12.0]),
        ("larger drop", Box::new(sphere([0.3, 0.2, 0.1], 2.8)), [0.01, 2.0, 8.0]),
        ("torus", Box::new(torus([0.3, 0.2, 0.1], 6.0, 2.0)), [0.03, 4.0, 12.0]),
        ("thread", Box::new(thread(1.6)), [0.03, 7.0, 9.0]),
    ];
    for (name, phi, limits) in shapes {
        let band = band(IVec3::splat(-20), IVec3::splat(20), &phi);
        let found = errors(&refined(&band), &phi);
        assert!((0..3).all(|measure| found[measure] < limits[measure]), "{name}: {found:.3?}");
    }
}

#[test]
fn weakly_curved_surfaces_are_unchanged() {
    let rounded_box = |point: [f64; 3]| {
        let beyond = DVec3::from(point).abs() - 6.3;
        beyond.max(DVec3::ZERO).length() + beyond.max_element().min(0.0) - 5.0
    };
    let planes = band(IVec3::splat(-20), IVec3::splat(20), rounded_box);
    let ball = band(IVec3::splat(-16), IVec3::splat(16), sphere([0.3, 0.2, 0.1], 9.0));
    for band in [planes, ball] {
        assert_eq!(refined(&band), contour(&band, &UNIT, Contouring::Dual));
    }
}

/// Only triangles that are not split are halves of quads, and each quad is one of the dual mesh.
#[test]
fn quads_are_those_that_are_not_split() {
    let thread = band(IVec3::splat(-16), IVec3::splat(16), thread(2.9));
    let quads = |mesh: &Mesh| -> Vec<[[u32; 3]; 2]> {
        let pairs = mesh.triangles.windows(2).zip(mesh.quads());
        pairs.filter(|(_, is_quad)| *is_quad).map(|(pair, _)| [pair[0], pair[1]]).collect()
    };
    let [before, after] = [quads(&contour(&thread, &UNIT, Contouring::Dual)), quads(&refined(&thread))];
    assert!(!after.is_empty() && after.len() < before.len());
    assert!(after.iter().all(|quad| before.contains(quad)));
}

#[test]
fn noise_stays_closed_on_any_number_of_threads() {
    for seed in 0..12 {
        let mut random = Random(seed);
        let values: Vec<f32> = (0..12usize.pow(3)).map(|_| random.next() * 2.0 - 1.2).collect();
        let noise = block_band(IVec3::new(-3, 5, 1), IVec3::splat(12), &values);
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            pool.install(|| refined(&noise))
        };
        assert_eq!(on(1), on(3));
        let (here, there) = (refined(&noise), refined(&moved(&noise, IVec3::splat(16))));
        assert_eq!(here.triangles.len(), there.triangles.len());
    }
}

/// One particle makes a round drop, wherever it is between the voxels.
#[test]
fn lone_drops_are_round() {
    let (mut angles, mut faces) = (Vec::new(), Vec::new());
    let mut random = Random(7);
    for _ in 0..60 {
        let center = DVec3::from_array(std::array::from_fn(|_| f64::from(random.next())));
        let options = Options { spacing: Some(1.0), ..Options::default() };
        let drop = reconstruct(&[center.to_array()], &options).expect("valid");
        let points = &drop.positions;
        angles.extend(
            points
                .iter()
                .zip(&drop.normals)
                .map(|(&point, normal)| (point - center).angle_between(normal.as_dvec3()).to_degrees()),
        );
        faces.extend(drop.triangles.iter().map(|triangle| {
            let [a, b, c] = triangle.map(|vertex| points[vertex as usize]);
            ((a + b + c) / 3.0 - center).angle_between((b - a).cross(c - a)).to_degrees()
        }));
    }
    let found = [most(angles), most(faces)];
    assert!(found[0] < 8.0 && found[1] < 8.25, "{found:?}");
}
