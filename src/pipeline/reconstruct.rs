//! One frame through the method by itself: for whoever wants its surface, and no files.

use std::path::{Path, PathBuf};

use twox_hash::XxHash3_128;

use crate::surface::options::Settings;
use crate::surface::particles::{Cloud, Particles};
use crate::surface::skin::FrameSurface;

use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::input::attributes::Wanted;
use crate::pipeline::input::frame_input::FrameInput;
use crate::pipeline::input::obstacles::ObstacleFiles;
use crate::pipeline::input::reading::{ReadFrame, parse_particles, read_file};
use crate::pipeline::method::{LevelSetSkinning, Method};
use crate::pipeline::output::writing::surface_warnings;
use crate::pipeline::records::frame_warnings::left_out;
use crate::pipeline::target::outputs::OutputOptions;
use crate::pipeline::warning::Warning;

/// A frame that was read, to be skinned any number of times.
#[derive(Debug)]
pub struct LoadedFrame {
    path: PathBuf,
    number: Option<u64>,
    cloud: Cloud,
    hash: u128,
    warnings: Vec<Warning>,
}

/// A frame that was skinned.
#[derive(Debug)]
pub struct Reconstruction {
    /// Its surface.
    pub surface: FrameSurface,
    /// What stood in the way: names and hashes of files. Empty if nothing did.
    pub obstacles: String,
    /// What a user should know though it was skinned.
    pub warnings: Vec<Warning>,
}

impl LoadedFrame {
    /// Reads the frame in a file, with those attributes that the settings ask for.
    ///
    /// # Errors
    /// When the system refuses, or there are no particles that are read.
    pub fn read(
        (path, number): (&Path, Option<u64>),
        settings: &Settings,
    ) -> Result<LoadedFrame, FrameError> {
        stage(path, Stage::Read, || {
            let bytes = read_file(path).map_err(|error| error.cause)?;
            let hash = XxHash3_128::oneshot(&bytes);
            let read = parse_particles(path, &bytes, &Wanted::by(settings)).map_err(|error| error.cause)?;
            let ReadFrame { cloud, warnings, .. } = read;
            Ok(LoadedFrame { path: path.to_owned(), number, cloud, hash, warnings })
        })
    }

    /// Its file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its particles, as they were read.
    pub fn particles(&self) -> &Particles {
        &self.cloud.positions
    }

    /// A hash of its file.
    pub fn hash(&self) -> u128 {
        self.hash
    }

    /// Skins it, on the threads of the pool that this is called in, and in so much memory if that can be. What does not
    /// fit is put into the folder of the outputs for a while. The settings ask for no attributes that were not asked
    /// for when it was read.
    ///
    /// # Errors
    /// Those of every stage.
    pub fn skin(
        &self,
        settings: &Settings,
        obstacles: &ObstacleFiles,
        outputs: &OutputOptions,
        memory_bytes: u64,
    ) -> Result<Reconstruction, FrameError> {
        let path = &*self.path;
        let mut loaded = stage(path, Stage::Read, || {
            let of_obstacle = |error| Cause::Obstacle(Box::new(error));
            let found = obstacles.find(self.number).map_err(of_obstacle)?;
            obstacles.load(found, settings, memory_bytes).map_err(of_obstacle)
        })?;
        let mut warnings = self.warnings.clone();
        warnings.append(&mut loaded.warnings);
        let obstacles = loaded.recorded.clone();
        let given = FrameInput::InMemory(self.cloud.clone());
        let method = LevelSetSkinning;
        let plan = stage(path, Stage::Read, || method.plan(&given, &loaded, settings, memory_bytes))?;
        let rasterize = || method.rasterize(given, loaded, settings, &plan, &outputs.folder);
        let rasterized = stage(path, Stage::Rasterize, rasterize)?;
        let smoothed = stage(path, Stage::Smooth, || method.smooth(rasterized, settings, &mut |_| {}))?;
        let surface = stage(path, Stage::Contour, || method.contour(smoothed, settings, outputs))?;
        warnings.extend(surface_warnings(&surface, outputs, settings));
        warnings.extend(left_out(&surface.report));
        Ok(Reconstruction { surface, obstacles, warnings })
    }
}

/// A stage of the frame at `path`; a panic becomes an error of this frame.
fn stage<T>(path: &Path, during: Stage, work: impl FnOnce() -> Result<T, Cause>) -> Result<T, FrameError> {
    let failed = |cause| FrameError { path: path.to_owned(), during, cause };
    FrameError::catch(path, during, work)?.map_err(failed)
}
