//! The surface of 50 000 random particles in a ball is nearly spherical (paper, Fig. 12).

#![expect(clippy::print_stdout, reason = "tests print measurements, visible with --nocapture")]

use std::f64::consts::PI;

use meniscus_surface::options::{MethodOptions, Settings};
use meniscus_surface::particles::OwnedPositions;
use meniscus_surface::reconstruction::reconstruct_frame;

use crate::shapes::{Random, crossings};

/// Radius of the ball, in voxels: the mean spacing of the particles is then two voxels.
const RADIUS: f64 = 45.0;
const PARTICLE_COUNT: usize = 50_000;

#[test]
fn random_particles_in_a_ball_come_out_as_one_ball() {
    let mut random = Random::new(12);
    let positions = (0..PARTICLE_COUNT).map(|_| random.in_ball(RADIUS).to_array()).collect();
    let settings = Settings::paper(1.0, &MethodOptions::default()).unwrap();
    let surface = reconstruct_frame(&OwnedPositions::F64(positions), &settings);
    let of_field: Vec<f64> = crossings(&surface.band).iter().map(|p| p.as_dvec3().length()).collect();
    let of_mesh: Vec<f64> = surface.mesh.positions.iter().map(|p| p.as_dvec3().length()).collect();
    for (what, radii) in [("zero set", of_field), ("mesh", of_mesh)] {
        let mean = radii.iter().sum::<f64>() / radii.len() as f64;
        let variance = radii.iter().map(|radius| (radius - mean).powi(2)).sum::<f64>() / radii.len() as f64;
        println!("{what}: radius {mean:.2} ± {:.3} voxels", variance.sqrt());
        assert!(variance.sqrt() <= 0.2, "{what}: {}", variance.sqrt());
    }
    let report = &surface.report;
    println!("∫H² is {:.3} of a sphere's", report.mesh.bending_energy / (4.0 * PI));
    assert!(report.certificate.holds(), "{:?}", report.certificate);
    assert_eq!((report.mesh.component_count, report.mesh.euler_characteristic), (1, 2));
}
