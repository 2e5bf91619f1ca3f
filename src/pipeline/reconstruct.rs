//! Reconstructs a single frame in memory, without output files.

use std::path::{Path, PathBuf};
use std::time::Instant;

use meniscus_formats::Loaded;

use crate::surface::attributes::add_computed;
use crate::surface::flicker::MovingParticles;
use crate::surface::options::Settings;
use crate::surface::particles::{OwnedPositions, ParticleCloud};
use crate::surface::reconstruction::{ApartParticles, FrameSurface};

use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::input::attributes::AttributeRequest;
use crate::pipeline::input::frame_input::FrameInput;
use crate::pipeline::input::obstacles::ObstacleFiles;
use crate::pipeline::input::reading::{ParsedParticles, hash_of, parse_particles, read_file};
use crate::pipeline::method::{self, FrameInStages};
use crate::pipeline::output::writing::surface_warnings;
use crate::pipeline::records::frame_warnings::left_out;
use crate::pipeline::target::outputs::OutputOptions;
use crate::pipeline::warning::Warning;

/// A frame that was read, and can be reconstructed any number of times.
#[derive(Clone, Debug)]
pub struct LoadedFrame {
    path: PathBuf,
    number: Option<i64>,
    cloud: ParticleCloud,
    hash: u128,
    warnings: Vec<Warning>,
}

/// A reconstructed frame.
#[derive(Debug)]
pub struct Reconstruction {
    /// Its surface.
    pub surface: FrameSurface,
    /// The seconds that computing it took.
    pub seconds: f64,
    /// The names and hashes of its obstacle files; empty without obstacles.
    pub obstacles: String,
    /// Warnings about the reconstruction.
    pub warnings: Vec<Warning>,
}

/// A frame that has its smoothed level set.
pub(crate) struct SmoothedAlone {
    pub(crate) frame: FrameInStages,
    /// When computing began.
    start: Instant,
    /// The names and hashes of its obstacle files; empty without obstacles.
    pub(crate) obstacles: String,
    warnings: Vec<Warning>,
}

impl LoadedFrame {
    /// Reads the frame at `path`, with the attributes that the settings require. `number` is its frame
    /// number.
    ///
    /// # Errors
    /// When the system reports an error, or the file has no readable particles.
    pub fn read(path: &Path, number: Option<i64>, settings: &Settings) -> Result<LoadedFrame, FrameError> {
        stage(path, Stage::Read, || {
            settings.require_single_frame().map_err(Cause::Settings)?;
            let content = read_file(path).map_err(|error| error.cause)?;
            LoadedFrame::of_content(path, number, content, settings).map_err(|error| error.cause)
        })
    }

    /// Parses the content of the frame at `path`.
    ///
    /// # Errors
    /// When it has no readable particles.
    pub(crate) fn of_content(
        path: &Path,
        number: Option<i64>,
        content: Loaded,
        settings: &Settings,
    ) -> Result<LoadedFrame, FrameError> {
        let hash = hash_of(&content);
        let read = parse_particles(path, content, &AttributeRequest::for_settings(settings))?;
        let ParsedParticles { cloud, warnings, .. } = read;
        Ok(LoadedFrame { path: path.to_owned(), number, cloud, hash, warnings })
    }

    /// The path of its file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The frame with other particles, unless `change` fails.
    pub(crate) fn try_map_cloud<E>(
        self,
        change: impl FnOnce(ParticleCloud) -> Result<ParticleCloud, E>,
    ) -> Result<LoadedFrame, E> {
        Ok(LoadedFrame { cloud: change(self.cloud)?, ..self })
    }

    /// Its particles as other frames follow them.
    pub(crate) fn moving_particles(&self) -> MovingParticles {
        MovingParticles::of(self.cloud.positions.clone(), &self.cloud.attributes)
    }

    /// Its particles, unmodified.
    pub fn particles(&self) -> &OwnedPositions {
        &self.cloud.positions
    }

    /// The hash of its bytes.
    pub fn hash(&self) -> u128 {
        self.hash
    }

    /// Reconstructs the surface on the current thread pool, within the memory limit if possible. For a frame
    /// that does not fit into memory, writes scratch files into the folder of the outputs. The settings must
    /// not require attributes that the settings for reading did not require.
    ///
    /// # Errors
    /// Those of every stage.
    pub fn reconstruct(
        &self,
        settings: &Settings,
        obstacles: &ObstacleFiles,
        outputs: &OutputOptions,
        memory_bytes: u64,
    ) -> Result<Reconstruction, FrameError> {
        let path = &*self.path;
        let (mut loaded, mut spray) = (self.clone(), None);
        let ParticleCloud { positions, attributes, .. } = &mut loaded.cloud;
        add_computed(positions, attributes, settings);
        if settings.spray > 0 {
            let ParticleCloud { positions, attributes, .. } = &loaded.cloud;
            let apart = ApartParticles::find(positions, attributes, settings);
            let (positions, attributes, taken) = apart.take_spray(positions, attributes, &[], settings);
            (loaded.cloud, spray) = (ParticleCloud { positions, attributes, ..loaded.cloud }, Some(taken));
        }
        let smoothed = loaded.smooth(settings, obstacles, outputs, (memory_bytes, 1))?;
        let SmoothedAlone { frame, start, obstacles, mut warnings } = smoothed;
        let surface = stage(path, Stage::Contour, || method::contour(frame, settings, outputs))?;
        let surface = surface.with_spray(spray);
        let seconds = start.elapsed().as_secs_f64();
        warnings.extend(surface_warnings(&surface, outputs, settings));
        warnings.extend(left_out(&surface.report));
        Ok(Reconstruction { surface, seconds, obstacles, warnings })
    }

    /// The first two stages of [`reconstruct`](Self::reconstruct), within the memory limit for this number of frames.
    pub(crate) fn smooth(
        self,
        settings: &Settings,
        obstacles: &ObstacleFiles,
        outputs: &OutputOptions,
        (memory_bytes, held_count): (u64, u64),
    ) -> Result<SmoothedAlone, FrameError> {
        let LoadedFrame { path, number, cloud, mut warnings, .. } = self;
        let path = &*path;
        let mut loaded = stage(path, Stage::Read, || {
            let of_obstacle = |error| Cause::Obstacle(Box::new(error));
            let found = obstacles.find(number).map_err(of_obstacle)?;
            obstacles.load(found, settings, memory_bytes).map_err(of_obstacle)
        })?;
        warnings.append(&mut loaded.warnings);
        let obstacles = loaded.recorded.clone();
        let given = FrameInput::InMemory(cloud);
        let limit = (memory_bytes, held_count);
        let plan = stage(path, Stage::Read, || method::plan(&given, &loaded, settings, outputs, limit))?;
        let start = Instant::now();
        let rasterize = || method::rasterize(given, loaded, settings, &plan, &outputs.folder);
        let frame = stage(path, Stage::Rasterize, rasterize)?;
        let frame = stage(path, Stage::Smooth, || method::smooth(frame, settings, &mut |_| {}))?;
        Ok(SmoothedAlone { frame, start, obstacles, warnings })
    }
}

/// Runs a stage of the frame at `path`; a panic becomes an error of this frame.
fn stage<T>(path: &Path, during: Stage, work: impl FnOnce() -> Result<T, Cause>) -> Result<T, FrameError> {
    let failed = |cause| FrameError { path: path.to_owned(), during, cause };
    FrameError::catch(path, during, work)?.map_err(failed)
}
