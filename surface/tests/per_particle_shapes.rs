//! Per-particle radii and shapes, from attributes to the surface (paper, Fig. 11 and 13).

#![expect(clippy::print_stdout, reason = "tests print measurements, visible with --nocapture")]

use glam::{DVec3, Vec3};
use meniscus_surface::obstacle::Obstacles;
use meniscus_surface::options::{AnisotropyKind, MethodOptions, Preset, Settings};
use meniscus_surface::particles::{Attribute, AttributeValues, OwnedPositions, ParticleCloud, Role};
use meniscus_surface::reconstruction::{FrameSurface, reconstruct_cloud};
use meniscus_surface::smooth::Integrator;

use crate::shapes::{Random, same_bits};

fn cloud(positions: &[DVec3]) -> ParticleCloud {
    OwnedPositions::F64(positions.iter().map(|position| position.to_array()).collect()).into()
}

fn with(mut cloud: ParticleCloud, name: &str, role: Role, arity: usize, numbers: Vec<f32>) -> ParticleCloud {
    let values = AttributeValues::Numbers(numbers);
    cloud.attributes.push(Attribute { name: name.to_owned(), role, arity, values });
    cloud
}

fn with_radii(cloud: ParticleCloud, radii: Vec<f32>) -> ParticleCloud {
    with(cloud, "pscale", Role::Radius, 1, radii)
}

fn with_velocities(cloud: ParticleCloud, velocities: &[Vec3]) -> ParticleCloud {
    let numbers = velocities.iter().flat_map(|velocity| velocity.to_array()).collect();
    with(cloud, "v", Role::Velocity, 3, numbers)
}

/// Reconstructs the surface with a voxel size of 1.
fn skinned(cloud: ParticleCloud, choices: &MethodOptions) -> FrameSurface {
    let settings = Settings::paper(1.0, choices).expect("sound");
    let surface = reconstruct_cloud(cloud, &settings, &Obstacles::default());
    let certificate = &surface.report.certificate;
    assert!(certificate.holds(), "{certificate:?}");
    surface
}

fn by_radii() -> MethodOptions {
    MethodOptions { radius_attribute: Some("pscale".to_owned()), ..MethodOptions::default() }
}

fn by_neighbors() -> MethodOptions {
    MethodOptions { anisotropy: Some(AnisotropyKind::Neighbors), ..MethodOptions::default() }
}

/// The vertices in world space.
fn vertices(surface: &FrameSurface) -> impl Iterator<Item = DVec3> {
    surface.mesh.positions.iter().map(|position| surface.mesh.origin + position.as_dvec3())
}

/// Fig. 13: lone spheres keep their own radii, except that 15 Laplacian steps of 0.1 h² shrink any sphere a
/// little. The biharmonic steps do not change them.
#[test]
fn lone_spheres_have_the_radii_of_their_particles() {
    let radii: Vec<f32> = (0..12).map(|index| 1.2 + 1.1 * index as f32).collect();
    // Radii at which implicit steps could round off the level set at the centre.
    let more = [1.0, 1.5, 1.74, 2.0, 2.2, 2.4, 2.5, 2.6, 2.8, 3.0, 3.2, 3.4, 3.7, 3.9, 4.2, 5.0, 17.0];
    let rows = [
        (Integrator::Explicit, radii.clone()),
        (Integrator::Fast, [&*radii, &more].concat()),
        (Integrator::Implicit, [&*radii, &more].concat()),
    ];
    for (integrator, radii) in rows {
        let errors = sphere_errors(&radii, &MethodOptions { integrator: Some(integrator), ..by_radii() });
        assert!(errors.iter().all(|error| *error < 0.15), "{integrator:?}: {errors:?}");
    }
}

/// The result does not depend on the source of a radius.
#[test]
fn lone_spheres_keep_a_radius_that_was_chosen() {
    for (radius_min, ratio) in [(1.74, 2.0), (1.74, 3.0), (2.5, 2.0), (3.0, 2.0), (3.4, 1.5), (5.0, 2.0)] {
        for center in [DVec3::ZERO, DVec3::new(0.4, -0.2, 0.3), DVec3::splat(0.5)] {
            let choices = MethodOptions {
                radius_min: Some(radius_min.into()),
                radius_ratio: Some(ratio),
                ..MethodOptions::default()
            };
            let surface = skinned(cloud(&[center]), &choices);
            let radius_init = radius_min * (1.0 + ratio) / 2.0;
            let expected = radius_min.max((radius_init * radius_init - 6.0).max(0.0).sqrt());
            let (sum, count) = vertices(&surface)
                .fold((0.0, 0.0), |(sum, count), vertex| (sum + vertex.distance(center), count + 1.0));
            let radius = sum / count;
            println!("r_min {radius_min}, ratio {ratio}: {radius:.3} for {expected:.3}");
            assert!((radius - expected).abs() < 0.15, "{radius_min} {ratio}: {radius} for {expected}");
        }
    }
}

/// The differences between the surfaces of lone spheres with these radii and the expected spheres.
fn sphere_errors(radii: &[f32], choices: &MethodOptions) -> Vec<f64> {
    let centers: Vec<DVec3> =
        (0..radii.len()).map(|index| DVec3::new(90.3 * index as f64, 0.4, -0.2)).collect();
    let surface = skinned(with_radii(cloud(&centers), radii.to_vec()), choices);
    let small_count = radii.iter().filter(|radius| **radius < 3f32.sqrt()).count();
    assert_eq!(surface.report.shapes.small_radius_count, small_count);
    assert_eq!(surface.report.mesh.component_count, radii.len());
    let error = |(center, &radius): (&DVec3, &f32)| {
        let radius_min = f64::from(radius).max(3f64.sqrt());
        let radius_init = 1.5 * radius_min;
        let expected = radius_min.max((radius_init * radius_init - 6.0).max(0.0).sqrt());
        let distances = vertices(&surface).map(|vertex| vertex.distance(*center));
        let near: Vec<f64> = distances.filter(|distance| *distance < 45.0).collect();
        let mean = near.iter().sum::<f64>() / near.len() as f64;
        println!("r_min {radius_min:.2}: {mean:.3} for {expected:.3}");
        (mean - expected).abs()
    };
    centers.iter().zip(radii).map(error).collect()
}

/// A distant particle of any size does not change a bit of the surface here.
#[test]
fn far_particles_of_any_size_change_nothing() {
    let mut random = Random::new(5);
    let positions: Vec<DVec3> =
        (0..300).map(|_| DVec3::new(random.unit(), random.unit(), random.unit()) * 14.0).collect();
    let radii: Vec<f32> = (0..300).map(|_| 1.8 + 2.0 * random.unit() as f32).collect();
    let velocities: Vec<Vec3> = (0..300).map(|_| Vec3::X * 40.0 * random.unit() as f32).collect();
    let kinds = [AnisotropyKind::None, AnisotropyKind::Neighbors, AnisotropyKind::Velocity];
    for (kind, part) in kinds.into_iter().flat_map(|kind| [(kind, 0.0), (kind, 0.9)]) {
        let choices = MethodOptions { anisotropy: Some(kind), position_smoothing: Some(part), ..by_radii() };
        let alone = with_velocities(with_radii(cloud(&positions), radii.clone()), &velocities);
        let alone = skinned(alone, &choices);
        let far = DVec3::splat(f64::from(alone.report.smoothing.reach_voxels.expect("fast")) * 1.8);
        let more: Vec<DVec3> = positions.iter().copied().chain([far]).collect();
        let more_radii: Vec<f32> = radii.iter().copied().chain([15.0]).collect();
        let more_velocities: Vec<Vec3> = velocities.iter().copied().chain([Vec3::Y * 90.0]).collect();
        let both = with_velocities(with_radii(cloud(&more), more_radii), &more_velocities);
        let both = skinned(both, &choices);
        let mut compared = 0;
        for (leaf, &origin) in alone.band.topology.origins().iter().enumerate() {
            let other = both.band.topology.find(origin).expect("the same leaves here");
            let bits =
                |surface: &FrameSurface, leaf: usize| surface.band.phi.leaves[leaf].values.map(f32::to_bits);
            assert_eq!(bits(&alone, leaf), bits(&both, other), "{kind:?}");
            compared += 1;
        }
        assert!(both.band.topology.len() > compared, "{kind:?}: the far particle has a separate surface");
    }
}

#[test]
fn the_number_of_threads_does_not_matter() {
    let mut random = Random::new(6);
    let positions: Vec<DVec3> =
        (0..900).map(|_| DVec3::new(random.unit(), random.unit(), random.unit() * 0.2) * 22.0).collect();
    let radii: Vec<f32> = (0..900).map(|_| 1.8 + 2.0 * random.unit() as f32).collect();
    let choices = MethodOptions {
        position_smoothing: Some(0.5),
        radius_attribute: by_radii().radius_attribute,
        ..by_neighbors()
    };
    let on_threads = |count| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build().expect("threads");
        pool.install(|| skinned(with_radii(cloud(&positions), radii.clone()), &choices))
    };
    let one = on_threads(1);
    for count in [2, 4] {
        let other = on_threads(count);
        assert!(same_bits(&one.band, &other.band), "{count} threads");
        assert!(one.mesh == other.mesh, "{count} threads");
    }
}

/// The root mean square deviation of a sheet's upper side from its mean height, away from the rim.
fn roughness(surface: &FrameSurface, half_edge: f64) -> f64 {
    let heights: Vec<f64> = vertices(surface)
        .filter(|vertex| vertex.z > 0.0 && vertex.x.abs().max(vertex.y.abs()) < half_edge)
        .map(|vertex| vertex.z)
        .collect();
    assert!(heights.len() > 500, "{}", heights.len());
    let mean = heights.iter().sum::<f64>() / heights.len() as f64;
    (heights.iter().map(|height| (height - mean).powi(2)).sum::<f64>() / heights.len() as f64).sqrt()
}

/// Fig. 11, in the middle: flat particles make a flat sheet. In the plane, the particles are as irregular as
/// possible without holes between balls.
#[test]
fn particles_stretched_by_their_neighbors_make_a_flat_sheet() {
    let mut random = Random::new(7);
    let mut jitter = || (random.unit() - 0.5) * 1.6;
    let positions: Vec<DVec3> = (0..41 * 41)
        .map(|index| {
            let (x, y) = (f64::from(index / 41 - 20), f64::from(index % 41 - 20));
            DVec3::new(2.4 * x + jitter(), 2.4 * y + jitter(), 0.0)
        })
        .collect();
    let of = |choices: &MethodOptions| roughness(&skinned(cloud(&positions), choices), 34.0);
    let balls = of(&MethodOptions::default());
    let stretched = of(&by_neighbors());
    let more = of(&MethodOptions { max_stretch: Some(6.0), ..by_neighbors() });
    let moved = of(&MethodOptions { position_smoothing: Some(0.9), ..by_neighbors() });
    println!("roughness of a sheet in h: balls {balls:.4}, stretched {stretched:.4}, by up to 6 {more:.4}");
    println!("stretched, and moved to their neighbours' mean: {moved:.4}");
    assert!(stretched < balls / 2.5, "{stretched} of {balls}");
    assert!(more < balls / 3.0, "{more} of {balls}");
    assert!(moved < balls / 1.5, "{moved} of {balls}");
}

/// Positions are also smoothed without stretch: the corners and edges of a block recede. Two particles alone
/// are not moved, because drops that come close must not attract each other.
#[test]
fn position_smoothing_shrinks_a_block_and_leaves_a_pair() {
    let reach = |positions: &[DVec3], position_smoothing| {
        let choices = MethodOptions { position_smoothing, ..MethodOptions::default() };
        let mesh = skinned(cloud(positions), &choices).mesh;
        mesh.positions.iter().map(|at| mesh.origin.x + f64::from(at.x)).fold(0.0, f64::max)
    };
    let pair = [DVec3::new(-1.0, 0.2, 0.3), DVec3::new(1.0, 0.2, 0.3)];
    assert_eq!(reach(&pair, Some(0.9)), reach(&pair, None));
    let at = |index: i32| DVec3::new((index % 7).into(), (index / 7 % 7).into(), (index / 49).into());
    let block: Vec<DVec3> = (0..343).map(|index| 2.0 * (at(index) - 3.0)).collect();
    let (given, smoothed) = (reach(&block, None), reach(&block, Some(0.9)));
    assert!((0.5..1.5).contains(&(given - smoothed)), "{given} {smoothed}");
}

/// Fig. 11, on the right, and Eq. 16: semi-axes (1 + s)² along the velocity and 1/(1 + s) across.
#[test]
fn moving_drops_are_stretched_as_in_the_paper() {
    // Velocities are per frame, at 25 frames per second.
    let choices = |kind| MethodOptions {
        radius_min: Some(8.0.into()),
        anisotropy: Some(kind),
        velocity_gain: Some(0.01),
        velocity_scale: Some(25.0),
        ..MethodOptions::default()
    };
    // s is 0.01 seconds of movement in units of r_min.
    let speeds = [0.0, 80.0, 160.0, 280.0];
    let along = DVec3::new(2.0, -1.0, 2.0) / 3.0;
    let centers: Vec<DVec3> = (0..4).map(|index| DVec3::new(120.3 * f64::from(index), 0.4, 0.2)).collect();
    let velocities = speeds.map(|speed| along.as_vec3() * (speed / 25.0) as f32);
    let surface_of = |kind| skinned(with_velocities(cloud(&centers), &velocities), &choices(kind));
    let (balls, drops) = (surface_of(AnisotropyKind::None), surface_of(AnisotropyKind::Velocity));
    let length = |surface: &FrameSurface, center: DVec3, direction: DVec3| {
        let near = vertices(surface).filter(|vertex| vertex.distance(center) < 60.0);
        near.map(|vertex| (vertex - center).dot(direction).abs()).fold(0.0, f64::max)
    };
    let across = along.any_orthonormal_vector();
    for (center, speed) in centers.into_iter().zip(speeds) {
        let s: f64 = 0.01 * speed / 8.0;
        for (direction, factor) in [(along, (1.0 + s).powi(2)), (across, 1.0 / (1.0 + s))] {
            let found = length(&drops, center, direction) / length(&balls, center, direction);
            println!("s = {s}: {found:.3} for {factor:.3}");
            assert!((found / factor - 1.0).abs() < 0.1, "{found} for {factor}");
        }
    }
}

/// Stretched kernels have the size that their weights are computed for: a body has no voids inside.
#[test]
fn moving_fluid_has_the_volume_of_fluid_at_rest() {
    let at = |index: i32| DVec3::new((index % 10).into(), (index / 10 % 10).into(), (index / 100).into());
    let block: Vec<DVec3> = (0..1000).map(|index| 2.0 * at(index)).collect();
    let of_own = by_radii().radius_attribute;
    for (gain, radius, slack) in [
        (0.003, None, 0.02),
        (0.01, None, 0.06),
        (0.003, Some(0.8), 0.02),
        (0.003, Some(1.0), 0.02),
        (0.003, Some(1.6), 0.02),
    ] {
        let volume = |kind| {
            let choices = MethodOptions {
                preset: Some(Preset::Fluid),
                spacing: Some(2.0),
                anisotropy: Some(kind),
                velocity_gain: (kind == AnisotropyKind::Velocity).then_some(gain),
                radius_attribute: of_own.clone().filter(|_| radius.is_some()),
                ..MethodOptions::default()
            };
            let velocities: Vec<Vec3> = block.iter().map(|center| (DVec3::ONE + *center).as_vec3()).collect();
            let particles = with_velocities(cloud(&block), &velocities);
            let particles = match radius {
                Some(radius) => with_radii(particles, vec![radius; block.len()]),
                None => particles,
            };
            let surface = skinned(particles, &choices);
            assert_eq!(surface.report.mesh.component_count, 1, "{gain}, {radius:?}");
            surface.report.mesh.volume
        };
        let [still, moving] = [AnisotropyKind::None, AnisotropyKind::Velocity].map(volume);
        assert!((moving / still - 1.0).abs() < slack, "{gain}, {radius:?}: {moving} instead of {still}");
    }
}
