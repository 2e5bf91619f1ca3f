//! What a user should know of obstacles: what is odd about their files, and which of them are nowhere near.
//!
//! An obstacle in other units, or with another axis up, is no error: the surface simply does not meet it. Boxes tell:
//!
//! ```text
//!   ┌────────────┐               ┌───┐
//!   │ particles  │◀── reach ──▶  │   │     farther than anything of the frame can come: it touches nothing
//!   └────────────┘               └───┘
//! ```

use std::path::Path;

use glam::DVec3;
use rayon::prelude::*;

use crate::surface::obstacle::Shape;
use crate::surface::options::{Anisotropy, RADIUS_MAX_VOXELS, Settings};
use crate::surface::particles::{ParticleSource, Positions};

use super::frame::Cause;
use super::frame_input::FrameInput;
use super::obstacles::FrameObstacles;

/// A level set with a band that is narrower than this, in units of h, tells little of where it is.
const KNOWN_MIN: f64 = 1.0;

/// What a user should know of an obstacle.
pub(super) fn notes_of(shape: &Shape, path: &Path, settings: &Settings) -> Vec<String> {
    let name = path.display();
    let mut notes = Vec::new();
    let mut tell = |count: usize, what: &str| {
        if count > 0 {
            notes.push(format!("obstacle {name}: {count} {what}"));
        }
    };
    match shape {
        Shape::Solid(solid) => {
            let findings = solid.findings();
            tell(
                findings.open_edge_count,
                match findings.encloses_nothing {
                    true => {
                        "open edges, and it encloses nothing: an obstacle is what a mesh encloses, so give it a thickness"
                    }
                    false => "open edges: holes are closed where its winding number is 1/2",
                },
            );
            tell(findings.turned_count, "triangles faced the other way, and were turned");
            tell(
                findings.unasked_part_count,
                "parts seem to face inwards, and were left so: it has too many parts to tell cavities",
            );
            tell(findings.broken_count, "triangles left out: a corner is not finite, or does not exist");
            if findings.triangle_count == 0 {
                notes.push(format!(
                    "obstacle {name}: no triangle has an area, so there is nothing in the way"
                ));
            }
        }
        Shape::Sampled(sampled) => {
            if let Some(reason) = sampled.rebuilt_because() {
                notes.push(format!("obstacle {name}: {reason}"));
            }
            let known = (sampled.band_width() - sampled.voxel_size()) / settings.voxel_size;
            if known < KNOWN_MIN {
                notes.push(format!(
                    "obstacle {name}: its distances are known to {known:.2} h only, and its surface may be off by as much: \
                     make it with a wider band"
                ));
            }
        }
    }
    notes
}

/// A sentence for each obstacle that nothing of a frame can touch.
///
/// # Errors
/// Those of reading the particles.
pub(super) fn out_of_reach(
    obstacles: &FrameObstacles,
    particles: &FrameInput,
    settings: &Settings,
) -> Result<Vec<String>, Cause> {
    if obstacles.paths.is_empty() {
        return Ok(Vec::new());
    }
    let Some(of_particles) = box_of(particles)? else { return Ok(Vec::new()) };
    let reach = reach(settings);
    let members = obstacles.paths.iter().zip(&obstacles.obstacles.members);
    let notes = members.filter_map(|(path, obstacle)| {
        let of_obstacle = obstacle.shape().bounds()?;
        let is_near = (0..3).all(|axis| {
            of_obstacle[0][axis] - reach <= of_particles[1][axis]
                && of_particles[0][axis] <= of_obstacle[1][axis] + reach
        });
        let [obstacle, particles] = [of_obstacle, of_particles].map(told);
        (!is_near).then(|| {
            format!(
                "obstacle {}: touches nothing of the frame: it spans {obstacle}, and the particles {particles}",
                path.display()
            )
        })
    });
    Ok(notes.collect())
}

/// How far from a particle anything is done, at most, in world units.
fn reach(settings: &Settings) -> f64 {
    let h = settings.voxel_size;
    let radius = match settings.own_radii {
        Some(_) => settings.radius_max.max(RADIUS_MAX_VOXELS * h),
        None => settings.radius_max,
    };
    let stretch = match settings.anisotropy {
        Anisotropy::None => 1.0,
        Anisotropy::Neighbors { max_stretch, .. } | Anisotropy::Velocity { max_stretch, .. } => max_stretch,
    };
    let moved = settings.position_smoothing * settings.neighbor_radius + settings.offset.max(0.0);
    radius * stretch + moved + (settings.void_threshold + BAND_VOXELS) * h
}

/// Half the thickness of what is written of a level set, in voxels.
const BAND_VOXELS: f64 = 3.0;

/// The least and the greatest corner of the box around the particles that are somewhere.
fn box_of(particles: &FrameInput) -> Result<Option<[DVec3; 2]>, Cause> {
    fn around(points: impl Iterator<Item = DVec3>) -> Option<[DVec3; 2]> {
        points.filter(|point| point.is_finite()).map(|point| [point; 2]).reduce(both)
    }
    let of_batch = |batch: usize| {
        Ok(match particles.batch(batch)? {
            Positions::Single(points) => {
                around(points.iter().map(|&point| glam::Vec3::from(point).as_dvec3()))
            }
            Positions::Double(points) => around(points.iter().map(|&point| DVec3::from(point))),
        })
    };
    let of_batches = (0..particles.batch_count()).into_par_iter().map(of_batch);
    of_batches.try_reduce(|| None, |one, other| Ok(one.into_iter().chain(other).reduce(both)))
}

/// The box around two boxes.
fn both(one: [DVec3; 2], other: [DVec3; 2]) -> [DVec3; 2] {
    [one[0].min(other[0]), one[1].max(other[1])]
}

/// A box in four digits.
fn told(corners: [DVec3; 2]) -> String {
    let short = |value: f64| format!("{value:.3e}").parse::<f64>().unwrap_or(value).to_string();
    let [min, max] = corners.map(|corner| corner.to_array().map(short).join(", "));
    format!("({min}) to ({max})")
}
