//! The three stages of the method, in the form that the pipeline calls.

use std::fs::File;
use std::io;
use std::path::Path;
use std::time::Instant;

use crate::surface::options::Settings;
use crate::surface::reconstruction::tiled::{self, TiledError, TiledFrame};
use crate::surface::reconstruction::{
    self, BoundedBand, FIELD_STORE_FILES, FrameSurface, MemoryPlan, MemoryPlanError, PlanInputs,
    ShapedSource, Storage, Targets, TooLarge,
};

use crate::pipeline::error::{Cause, ObstacleError};
use crate::pipeline::input::frame_input::{FrameInput, LevelSetInput};
use crate::pipeline::input::level_set_file::level_set_limits;
use crate::pipeline::input::obstacles::FrameObstacles;
use crate::pipeline::output::writing::VDB_HALF_WIDTH_VOXELS;
use crate::pipeline::target::outputs::{OutputFormat, OutputOptions};

/// The three stages of the method. Tests replace them by stages that are quick or fail.
///
/// # Errors
/// Each call fails if the particles are on disk and cannot be read or have changed, if there is too little
/// memory, or if the disk has no room for scratch files.
pub trait Method: Sync {
    /// The result of rasterization.
    type Rasterized: Send;
    /// The result of smoothing.
    type Smoothed: Send;

    /// Plans the reconstruction of the frame, and the pictures among its outputs, within a memory limit.
    fn plan(
        &self,
        particles: &FrameInput,
        obstacles: &FrameObstacles,
        settings: &Settings,
        outputs: &OutputOptions,
        allowed_bytes: u64,
    ) -> Result<MemoryPlan, Cause>;
    /// The first stage: rasterizes particles and obstacles. May write data that do not fit into memory to
    /// unnamed files in the folder `scratch`.
    fn rasterize(
        &self,
        particles: FrameInput,
        obstacles: FrameObstacles,
        settings: &Settings,
        plan: &MemoryPlan,
        scratch: &Path,
    ) -> Result<Self::Rasterized, Cause>;
    /// The second stage: smooths the level set. `advanced` receives the progress, from 0 to 1.
    fn smooth(
        &self,
        rasterized: Self::Rasterized,
        settings: &Settings,
        advanced: &mut dyn FnMut(f64),
    ) -> Result<Self::Smoothed, Cause>;
    /// The third stage: computes the mesh, and the attributes that the outputs need.
    fn contour(
        &self,
        smoothed: Self::Smoothed,
        settings: &Settings,
        outputs: &OutputOptions,
    ) -> Result<FrameSurface, Cause>;
}

/// The method of this program.
#[derive(Clone, Copy, Debug)]
pub struct LevelSetMethod;

/// A frame between two stages: in memory, or in tiles on disk.
pub enum StagedSurface<T> {
    /// In memory, with its particles if their attributes are needed later.
    InMemory(T, Option<ShapedSource<FrameInput>>),
    /// In tiles on disk.
    Tiled(Box<TiledFrame<ShapedSource<FrameInput>>>),
    /// From a level-set file.
    OfLevelSet(Box<BoundedBand>),
}

impl Method for LevelSetMethod {
    type Rasterized = StagedSurface<reconstruction::RasterizedFrame>;
    type Smoothed = StagedSurface<reconstruction::SmoothedFrame>;

    fn plan(
        &self,
        particles: &FrameInput,
        obstacles: &FrameObstacles,
        settings: &Settings,
        outputs: &OutputOptions,
        allowed_bytes: u64,
    ) -> Result<MemoryPlan, Cause> {
        let picture_bytes = outputs.picture_bytes();
        if let FrameInput::LevelSet(given) = particles {
            let LevelSetInput { band, max_deviation_voxels, .. } = &**given;
            let level_set_bytes =
                reconstruction::smooth_level_set_bytes(band, *max_deviation_voxels, settings);
            let in_core_bytes = level_set_bytes.saturating_add(picture_bytes);
            let with_picture = if picture_bytes > 0 { " with its picture" } else { "" };
            let limits = level_set_limits(allowed_bytes);
            limits.check_level_set(in_core_bytes, with_picture).map_err(Cause::File)?;
            let memory_bytes = in_core_bytes.saturating_sub(particles.size_bytes());
            return Ok(MemoryPlan { memory_bytes, tile_leaves: None, in_core_bytes });
        }
        // The input needs memory in addition to the plan, and so does a picture.
        let given_bytes = particles.size_bytes().saturating_add(obstacles.all_bytes);
        let aside_bytes = given_bytes.saturating_add(picture_bytes);
        let planned = reconstruction::plan_memory(
            particles,
            settings,
            PlanInputs {
                obstacles: &obstacles.obstacles,
                attribute_bytes: particles.attribute_bytes(settings),
            },
            allowed_bytes.saturating_sub(aside_bytes),
        )?;
        let with_picture = |plan: MemoryPlan| MemoryPlan {
            memory_bytes: plan.memory_bytes.saturating_add(picture_bytes),
            in_core_bytes: plan.in_core_bytes.saturating_add(picture_bytes),
            ..plan
        };
        planned.map(with_picture).map_err(|error| match error {
            MemoryPlanError::TooLarge(too_large) => {
                let needed_bytes = too_large.needed_bytes.saturating_add(aside_bytes);
                Cause::TooLarge(TooLarge { needed_bytes, allowed_bytes, picture_bytes, ..too_large })
            }
            MemoryPlanError::VoxelTooSmall(too_small) => Cause::VoxelTooSmall(too_small),
            MemoryPlanError::ObstacleTooFar(too_far) => {
                let path = obstacles.paths.get(too_far.index).cloned().unwrap_or_default();
                let source = Some(meniscus_formats::Error::unsupported("", too_far.to_string()));
                Cause::Obstacle(Box::new(ObstacleError { path, source }))
            }
        })
    }

    fn rasterize(
        &self,
        particles: FrameInput,
        FrameObstacles { obstacles, .. }: FrameObstacles,
        settings: &Settings,
        plan: &MemoryPlan,
        scratch: &Path,
    ) -> Result<Self::Rasterized, Cause> {
        let started = Instant::now();
        if let FrameInput::LevelSet(given) = particles {
            let LevelSetInput { band, origin, max_deviation_voxels } = *given;
            let mut bounded = reconstruction::bound_level_set(band, origin, max_deviation_voxels, settings);
            bounded.report_mut().seconds.rasterize = started.elapsed().as_secs_f64();
            return Ok(StagedSurface::OfLevelSet(Box::new(bounded)));
        }
        let (particles, shape_stats) = particles.shaped(settings)?;
        let Some(tile_leaves) = plan.tile_leaves else {
            let mut rasterized = reconstruction::rasterize(&particles, settings, shape_stats, obstacles)?;
            rasterized.report_mut().seconds.rasterize = started.elapsed().as_secs_f64();
            particles.given().check_unchanged()?;
            return Ok(StagedSurface::InMemory(
                rasterized,
                settings.attributes.is_some().then_some(particles),
            ));
        };
        let storages =
            (0..FIELD_STORE_FILES).map(|_| ScratchFile::storage(scratch)).collect::<io::Result<Vec<_>>>();
        let storages = storages.map_err(Cause::Scratch)?;
        let mut frame = tiled::rasterize(particles, settings, shape_stats, obstacles, tile_leaves, storages)?;
        frame.report_mut().seconds.rasterize = started.elapsed().as_secs_f64();
        // Contouring reads the file again and repeats this check. But smoothing takes a while, so a change is
        // detected now.
        frame.source().given().check_unchanged()?;
        Ok(StagedSurface::Tiled(Box::new(frame)))
    }

    fn smooth(
        &self,
        rasterized: Self::Rasterized,
        settings: &Settings,
        advanced: &mut dyn FnMut(f64),
    ) -> Result<Self::Smoothed, Cause> {
        let started = Instant::now();
        Ok(match rasterized {
            StagedSurface::InMemory(rasterized, particles) => {
                let mut smoothed = reconstruction::smooth_observed(rasterized, settings, advanced);
                smoothed.report_mut().seconds.smooth = started.elapsed().as_secs_f64();
                StagedSurface::InMemory(smoothed, particles)
            }
            StagedSurface::Tiled(frame) => {
                let mut smoothed = tiled::smooth(*frame, settings, advanced).map_err(Cause::Scratch)?;
                smoothed.report_mut().seconds.smooth = started.elapsed().as_secs_f64();
                StagedSurface::Tiled(Box::new(smoothed))
            }
            StagedSurface::OfLevelSet(band) => {
                let mut smoothed = band.smooth(settings, advanced);
                smoothed.report_mut().seconds.smooth = started.elapsed().as_secs_f64();
                StagedSurface::OfLevelSet(Box::new(smoothed))
            }
        })
    }

    fn contour(
        &self,
        smoothed: Self::Smoothed,
        settings: &Settings,
        outputs: &OutputOptions,
    ) -> Result<FrameSurface, Cause> {
        let started = Instant::now();
        let (mut surface, particles) = match smoothed {
            StagedSurface::InMemory(smoothed, particles) => {
                (reconstruction::contour(smoothed, settings, outputs.position_rounding()), particles)
            }
            StagedSurface::Tiled(frame) => {
                let (surface, particles) = tiled::contour(*frame, settings, outputs.position_rounding())?;
                particles.given().check_unchanged()?;
                (surface, Some(particles))
            }
            StagedSurface::OfLevelSet(band) => (band.contour(settings, outputs.position_rounding()), None),
        };
        surface.report.seconds.contour = started.elapsed().as_secs_f64();
        // Particles on disk have no selected attributes.
        let in_memory = |given| match given {
            FrameInput::InMemory(cloud) => Some(cloud),
            FrameInput::OnDisk(_) | FrameInput::LevelSet(_) => None,
        };
        let is_wanted = settings.attributes.is_some();
        let cloud = particles.filter(|_| is_wanted).and_then(|particles| particles.into_cloud(in_memory));
        if let Some(cloud) = cloud {
            let started = Instant::now();
            reconstruction::transfer_attributes(&mut surface, &cloud, settings, targets(outputs));
            if let Some(transfer) = &mut surface.report.transfer {
                transfer.seconds = started.elapsed().as_secs_f64();
            }
        }
        Ok(surface)
    }
}

/// The targets for attributes in the output files.
fn targets(outputs: &OutputOptions) -> Targets {
    let has_voxels = |format: &OutputFormat| !format.is_mesh() && format.has_attributes();
    Targets {
        vertices: outputs.formats.iter().any(|format| format.is_mesh()),
        band_half_width_voxels: outputs.formats.iter().any(has_voxels).then_some(VDB_HALF_WIDTH_VOXELS),
    }
}

impl From<TiledError<Cause>> for Cause {
    fn from(error: TiledError<Cause>) -> Cause {
        match error {
            TiledError::Source(cause) => cause,
            TiledError::Storage(error) => Cause::Scratch(error),
        }
    }
}

/// An unnamed file, which disappears when it is closed. The system closes it even if the process is killed.
#[derive(Debug)]
pub struct ScratchFile(File);

impl ScratchFile {
    /// A file in this folder, which is made if it does not exist.
    ///
    /// # Errors
    /// When the system reports an error.
    pub fn storage(folder: &Path) -> io::Result<Box<dyn Storage>> {
        // Outputs are written later, so their folder may not exist yet.
        std::fs::create_dir_all(folder)?;
        Ok(Box::new(ScratchFile(tempfile::tempfile_in(folder)?)))
    }
}

#[cfg(unix)]
impl Storage for ScratchFile {
    fn read(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
        std::os::unix::fs::FileExt::read_exact_at(&self.0, bytes, offset)
    }

    fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        std::os::unix::fs::FileExt::write_all_at(&self.0, bytes, offset)
    }
}

/// Seeks before each access, for systems without reads and writes at a position. Seeking moves the file's
/// cursor, which does not matter: tiles are accessed one after the other.
#[cfg(not(unix))]
impl Storage for ScratchFile {
    fn read(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
        use std::io::{Read, Seek, SeekFrom};
        (&self.0).seek(SeekFrom::Start(offset))?;
        (&self.0).read_exact(bytes)
    }

    fn write(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        use std::io::{Seek, SeekFrom, Write};
        (&self.0).seek(SeekFrom::Start(offset))?;
        (&self.0).write_all(bytes)
    }
}
