//! Drops, clusters, threads and sheets have the volume of their particles with the default settings, and
//! change it continuously.

#![expect(clippy::print_stdout, reason = "tests print measurements, visible with --nocapture")]

use glam::DVec3;
use meniscus_surface::obstacle::Obstacles;
use meniscus_surface::options::{MethodOptions, SequenceSpacing, Settings};
use meniscus_surface::particles::{Attribute, AttributeValues, OwnedPositions, ParticleCloud, Role};
use meniscus_surface::reconstruction::{FrameSurface, reconstruct_cloud};

/// The surface of particles with a spacing of 1 by the default settings, somewhere between the voxels.
fn surface_of(positions: &[DVec3]) -> FrameSurface {
    let settings =
        Settings::resolve(&MethodOptions::default(), Some(SequenceSpacing::from(1.0))).expect("sound");
    let moved = positions.iter().map(|position| (*position + DVec3::new(0.31, 0.17, -0.23)).to_array());
    let cloud = OwnedPositions::F64(moved.collect()).into();
    let surface = reconstruct_cloud(cloud, &settings, &Obstacles::default());
    let certificate = &surface.report.certificate;
    assert!(certificate.holds(), "{certificate:?}");
    surface
}

/// The volume of the surface over that of its particles.
fn relative_volume(positions: &[DVec3]) -> f64 {
    surface_of(positions).mesh.measure().volume / positions.len() as f64
}

/// The points of a face-centred cubic lattice with one point per unit of volume, by their distance from a
/// point between them.
fn lattice_points() -> Vec<DVec3> {
    let edge = 4f64.cbrt();
    let mut points = Vec::new();
    for index in 0..9 * 9 * 9 {
        let corner = DVec3::new((index % 9).into(), (index / 9 % 9).into(), (index / 81).into()) - 4.0;
        let faces = [[0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.5, 0.0, 0.5], [0.0, 0.5, 0.5]].map(DVec3::from);
        points.extend(faces.map(|face| edge * (corner + face) - DVec3::new(0.21, 0.13, 0.34)));
    }
    points.sort_by(|one, other| one.length().total_cmp(&other.length()));
    points
}

#[test]
fn drops_and_clusters_have_the_volume_of_their_particles() {
    let points = lattice_points();
    for count in [1, 2, 4, 6, 8, 13, 33, 251] {
        let volume = relative_volume(&points[..count]);
        println!("{count} particles: {volume:.3}");
        assert!((0.8..1.25).contains(&volume), "{count}: {volume}");
    }
}

#[test]
fn threads_and_sheets_have_the_volume_of_their_particles() {
    let direction = DVec3::new(0.6, 0.64, 0.48);
    let thread: Vec<DVec3> = (0..60).map(|index| direction * f64::from(index)).collect();
    let (one, other) = (direction.any_orthonormal_vector(), direction);
    let sheet: Vec<DVec3> =
        (0..900).map(|index| one * f64::from(index % 30) + other * f64::from(index / 30)).collect();
    for (name, particles) in [("thread", thread), ("sheet", sheet)] {
        let volume = relative_volume(&particles);
        println!("{name}: {volume:.3}");
        assert!((0.85..1.2).contains(&volume), "{name}: {volume}");
    }
}

/// Large particles in a body have few neighbours within the radius of the small ones, and are no spray.
#[test]
fn bodies_of_small_and_of_large_particles_are_smooth() {
    let block = |edge: f64, at: f64| {
        (0..512).map(move |index| {
            let place = DVec3::new((index % 8).into(), (index / 8 % 8).into(), (index / 64).into());
            (place * edge + DVec3::X * at).to_array()
        })
    };
    let positions = block(1.0, 0.0).chain(block(2.0, 20.0)).collect();
    let radii = [0.5; 512].into_iter().chain([1.0; 512]).collect();
    let options = MethodOptions {
        radius_attribute: Some("pscale".to_owned()),
        radius_scale: Some(1.28),
        ..MethodOptions::default()
    };
    let settings = Settings::resolve(&options, Some(SequenceSpacing::from(1.0))).expect("sound");
    let values = AttributeValues::Numbers(radii);
    let mut cloud: ParticleCloud = OwnedPositions::F64(positions).into();
    cloud.attributes.push(Attribute { name: "pscale".to_owned(), role: Role::Radius, arity: 1, values });
    let surface = reconstruct_cloud(cloud, &settings, &Obstacles::default());
    let measure = surface.mesh.measure();
    println!("two blocks: volume {:.3}, ∫H² {:.0}", measure.volume / (512.0 * 9.0), measure.bending_energy);
    // If each particle of the large block is a bump, it is 850.
    assert!(measure.bending_energy < 100.0, "{}", measure.bending_energy);
}

/// Two drops that approach each other do not attract each other, join late, and change their volume gently.
#[test]
fn drops_join_late_and_without_jumps() {
    let mut before: Option<f64> = None;
    for step in (10..60).rev() {
        let apart = 0.05 * f64::from(step);
        let surface = surface_of(&[DVec3::ZERO, DVec3::new(0.36, 0.48, 0.8) * apart]);
        let measure = surface.mesh.measure();
        let change = before.map_or(0.0, |before| (measure.volume - before).abs());
        assert!(change < 0.15, "{change} at {apart}");
        assert!(apart < 2.1 || measure.component_count == 2, "joined at {apart}");
        before = Some(measure.volume);
    }
}
