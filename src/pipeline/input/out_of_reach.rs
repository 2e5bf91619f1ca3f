//! Finds obstacles that are too far away to affect a frame.
//!
//! An obstacle in wrong units, or with a wrong up axis, causes no error: the surface simply does not touch
//! it. Bounding boxes reveal such an obstacle:
//!
//! ```text
//!   ┌────────────┐               ┌──────────┐
//!   │ particles  │◀── reach ──▶  │ obstacle │     farther than the reach: it has no effect
//!   └────────────┘               └──────────┘
//! ```

use std::path::Path;

use glam::DVec3;

use crate::surface::obstacle::Obstacle;
use crate::surface::options::{Anisotropy, RADIUS_MAX_VOXELS, Settings};
use crate::surface::particles::ParticleSource;

use super::position_doubts::box_of_all_particles;
use crate::pipeline::target::outputs::VDB_HALF_WIDTH_VOXELS;
use crate::pipeline::warning::Warning;

/// A warning for each obstacle that is out of reach of all particles of a frame.
///
/// # Errors
/// Those of reading the particles.
pub(crate) fn out_of_reach<'a, S: ParticleSource>(
    obstacles: impl IntoIterator<Item = (&'a Path, &'a Obstacle)>,
    particles: &S,
    settings: &Settings,
) -> Result<Vec<Warning>, S::Error> {
    let mut obstacles = obstacles.into_iter().peekable();
    // Without obstacles no particles are read.
    if obstacles.peek().is_none() {
        return Ok(Vec::new());
    }
    let Some(particle_box) = box_of_all_particles(particles)? else { return Ok(Vec::new()) };
    let reach = reach(settings);
    let warnings = obstacles.filter_map(|(path, obstacle)| {
        let obstacle_box = obstacle.sdf().bounds()?;
        let is_near = (0..3).all(|axis| {
            obstacle_box[0][axis] - reach <= particle_box[1][axis]
                && particle_box[0][axis] <= obstacle_box[1][axis] + reach
        });
        (!is_near).then(|| {
            let finding = format!(
                "too far from the particles to have an effect: it spans {}, and the particles span {}; check its position, \
                 unit of length and up axis",
                box_text(obstacle_box),
                box_text(particle_box)
            );
            Warning::of_obstacle(path, &finding)
        })
    });
    Ok(warnings.collect())
}

/// A box with four digits for each coordinate.
fn box_text(corners: [DVec3; 2]) -> String {
    let short = |value: f64| format!("{value:.3e}").parse::<f64>().unwrap_or(value).to_string();
    let [min, max] = corners.map(|corner| corner.to_array().map(short).join(", "));
    format!("({min}) to ({max})")
}

/// The largest distance from a particle at which values of the level set are computed, in world units.
fn reach(settings: &Settings) -> f64 {
    let h = settings.voxel_size;
    let radius = match settings.per_particle_radius {
        // A particle's own radius may be larger, up to this limit.
        Some(_) => settings.radius_max.max(RADIUS_MAX_VOXELS * h),
        None => settings.radius_max,
    };
    let stretch = match settings.anisotropy {
        Anisotropy::None => 1.0,
        Anisotropy::Neighbors { max_stretch, .. } | Anisotropy::Velocity { max_stretch, .. } => max_stretch,
    };
    let moved = settings.position_smoothing * settings.neighbor_radius + settings.offset.max(0.0);
    radius * stretch + moved + (settings.void_threshold + f64::from(VDB_HALF_WIDTH_VOXELS)) * h
}
