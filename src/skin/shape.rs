//! What each particle is, before it is rasterized: of a size of its own, stretched, or a ball like the others.

use std::borrow::Cow;
use std::time::Instant;

use crate::anisotropy::{
    NeighborConfig, RadiusScales, Shaped, VelocityConfig, from_neighbors, from_velocities, radius_scales,
};
use crate::particles::{Cloud, Shapes};
use crate::report::Shaping;
use crate::settings::{Anisotropy, OwnRadii, RADIUS_MAX_VOXELS, Settings};

/// Gives the particles the shapes that the settings ask for. What is asked for by attributes must be there, a number or a
/// vector for each particle: where it is not, particles are balls.
pub fn shape(cloud: Cloud, settings: &Settings) -> (Cloud, Shaping) {
    if !settings.has_shapes() {
        return (cloud, Shaping::default());
    }
    let started = Instant::now();
    let mut shaping = Shaping::default();
    let scales = settings.own_radii.as_ref().and_then(|own| scales(&cloud, own, settings, &mut shaping));
    let floor = shortest(settings);
    let shaped = match settings.anisotropy {
        Anisotropy::None => None,
        Anisotropy::Neighbors { radius, max_stretch, position_smoothing } => {
            let config = NeighborConfig {
                radius_world: radius,
                max_stretch: max_stretch as f32,
                position_smoothing: position_smoothing as f32,
                floor,
            };
            Some(from_neighbors(&cloud.positions, scales.as_deref(), &config))
        }
        Anisotropy::Velocity { gain, max_stretch } => {
            let gain_per_speed = (gain / settings.radius_min) as f32;
            let config = VelocityConfig { gain_per_speed, max_stretch: max_stretch as f32, floor };
            numbers(&cloud, "velocity", 3)
                .map(|velocities| from_velocities(&velocities, scales.as_deref(), &config))
        }
    };
    let Cloud { mut positions, attributes, .. } = cloud;
    let shapes = match (shaped, scales) {
        (Some(Shaped { positions: moved, shapes, raised_count, ball_count }), _) => {
            positions = moved.unwrap_or(positions);
            shaping.raised_count = raised_count;
            shaping.ball_count = ball_count;
            Shapes::Ellipsoids(shapes)
        }
        (None, Some(scales)) => Shapes::Scaled(scales),
        (None, None) => Shapes::Balls,
    };
    shaping.longest = (0..positions.len()).map(|index| shapes.longest(index)).fold(0.0, f32::max);
    shaping.seconds = started.elapsed().as_secs_f64();
    (Cloud { positions, shapes, attributes }, shaping)
}

/// The scale of each particle, in units of the settings' radii.
fn scales(cloud: &Cloud, own: &OwnRadii, settings: &Settings, shaping: &mut Shaping) -> Option<Vec<f32>> {
    let radii = numbers(cloud, &own.attribute, 1)?;
    let RadiusScales { mut scales, raised_count, invalid_count } =
        radius_scales(&radii, own.scale, settings.radius_min, shortest(settings));
    shaping.small_radius_count = raised_count;
    shaping.invalid_radius_count = invalid_count;
    let most =
        ((RADIUS_MAX_VOXELS * settings.voxel_size / settings.radius_max) as f32).max(shortest(settings));
    shaping.large_radius_count = scales.iter().filter(|&&scale| scale > most).count();
    scales.iter_mut().for_each(|scale| *scale = scale.min(most));
    Some(scales)
}

/// The numbers of an attribute of which each particle has so many.
fn numbers<'a>(cloud: &'a Cloud, name: &str, arity: usize) -> Option<Cow<'a, [f32]>> {
    let numbers = cloud.attribute_of(name, arity)?.values.numbers()?;
    (numbers.len() == arity * cloud.positions.len()).then_some(numbers)
}

/// The least half axis, in units of the settings' radii, of particles with shapes: the grid holds no less than √3
/// voxels (Eq. 13).
pub(super) fn shortest(settings: &Settings) -> f32 {
    (3f64.sqrt() * settings.voxel_size / settings.radius_min) as f32
}

/// The half axes that the band has room for, in units of the settings' radii. It is the same for all frames of a
/// sequence, whatever particles they have. Stretched particles are short where there is a surface to move: at the sides
/// of sheets and threads.
pub(super) fn roomy(settings: &Settings) -> f32 {
    if settings.own_radii.is_some() { SCALE_ROOM } else { 1.0 }
}

/// Particles of three times the least radius have gaps of three voxels between their bounds: more than smoothing moves a
/// surface by.
const SCALE_ROOM: f32 = 3.0;
