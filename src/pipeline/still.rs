//! One frame through the method by itself: for whoever wants its surface, and no files.

use std::path::Path;

use twox_hash::XxHash3_128;

use crate::particles::Particles;
use crate::settings::Settings;
use crate::skin::Surface;

use super::attributes::Wanted;
use super::frame::{Cause, FrameError, Stage};
use super::frame_particles::FrameParticles;
use super::method::{LevelSetSkinning, Method};
use super::obstacles::ObstacleFiles;
use super::outputs::OutputOptions;
use super::reading::{ReadFrame, parse_particles, read_file};
use super::writing::surface_notes;

/// A frame that was skinned.
#[derive(Debug)]
pub struct Still {
    /// Its surface.
    pub surface: Surface,
    /// Its particles, as they were read.
    pub particles: Particles,
    /// A hash of its file.
    pub hash: u128,
    /// What stood in the way: names and hashes of files. Empty if nothing did.
    pub obstacles: String,
    /// What a user should know though it was skinned.
    pub notes: Vec<String>,
}

/// Skins the frame in a file, on the threads of the pool that this is called in, and in so much memory if that can be.
/// What does not fit is put into the folder of the outputs for a while.
///
/// # Errors
/// Those of every stage.
pub fn skin_file(
    (path, number): (&Path, Option<u64>),
    settings: &Settings,
    obstacles: &ObstacleFiles,
    outputs: &OutputOptions,
    memory_bytes: u64,
) -> Result<Still, FrameError> {
    let read = stage(path, Stage::Read, || {
        let bytes = read_file(path).map_err(|error| error.cause)?;
        let hash = XxHash3_128::oneshot(&bytes);
        let read = parse_particles(path, &bytes, &Wanted::by(settings)).map_err(|error| error.cause)?;
        let of_obstacle = |error| Cause::Obstacle(Box::new(error));
        let found = obstacles.find(number).map_err(of_obstacle)?;
        let loaded = obstacles.load(found, settings, memory_bytes / OBSTACLE_SHARE).map_err(of_obstacle)?;
        Ok((hash, read, loaded))
    });
    let (hash, ReadFrame { cloud, mut notes }, mut loaded) = read?;
    notes.append(&mut loaded.notes);
    let (particles, obstacles) = (cloud.positions.clone(), loaded.recorded.clone());
    let given = FrameParticles::InMemory(cloud);
    let method = LevelSetSkinning;
    let plan = stage(path, Stage::Read, || method.plan(&given, &loaded, settings, memory_bytes))?;
    let rasterized =
        stage(path, Stage::Rasterize, || method.rasterize(given, loaded, settings, &plan, &outputs.folder))?;
    let smoothed = stage(path, Stage::Smooth, || method.smooth(rasterized, settings))?;
    let surface = stage(path, Stage::Contour, || method.contour(smoothed, settings, outputs))?;
    notes.extend(surface_notes(&surface, &outputs.formats));
    Ok(Still { surface, particles, hash, obstacles, notes })
}

/// A stage of the frame at `path`; a panic becomes an error of this frame.
fn stage<T>(path: &Path, during: Stage, work: impl FnOnce() -> Result<T, Cause>) -> Result<T, FrameError> {
    let failed = |cause| FrameError { path: path.to_owned(), during, cause };
    FrameError::catch(path, during, work)?.map_err(failed)
}

/// What leaves of obstacles are kept may take one part in so many of the memory.
const OBSTACLE_SHARE: u64 = 16;
