//! The three stages of the method, for a frame of the pipeline.

use std::fs::File;
use std::io;
use std::path::Path;

use crate::surface::Storage;
use crate::surface::attributes::has_rest;
use crate::surface::options::Settings;
use crate::surface::particles::ParticleCloud;
use crate::surface::reconstruction::{
    self, FrameSurface, MemoryPlan, MemoryPlanError, PlanInputs, ShapedSource, StageError, StagedFrame,
    Targets, TileStorage, TooLarge,
};
use crate::surface::report::ShapeStats;
use meniscus_formats::Limits;

use crate::pipeline::error::{Cause, ObstacleError};
use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::input::frame_input::{FrameInput, LevelSetInput};
use crate::pipeline::input::obstacles::FrameObstacles;
use crate::pipeline::output::writing::attribute_half_width_voxels;
use crate::pipeline::target::outputs::OutputOptions;

/// What the three stages of the method pass on: their state of a frame of the pipeline.
pub(crate) type FrameInStages = StagedFrame<ShapedSource<FrameInput>>;

/// Plans the reconstruction of a frame, and the pictures among its outputs, within a memory limit. The plan includes
/// the memory of `held_count` such frames, which have one picture and the static obstacles in common; if there are
/// several, the frame has no tiles, because it is averaged with the others.
///
/// # Errors
/// When the frame needs more memory, its voxels are too small, or an obstacle is too far away; the errors of
/// reading particles.
pub(crate) fn plan(
    particles: &FrameInput,
    obstacles: &FrameObstacles,
    settings: &Settings,
    outputs: &OutputOptions,
    (allowed_bytes, held_count): (u64, u64),
) -> Result<MemoryPlan, Cause> {
    let picture_bytes = outputs.picture_bytes();
    if let FrameInput::LevelSet(given) = particles {
        let LevelSetInput { band, max_deviation_voxels, .. } = &**given;
        let level_set_bytes = reconstruction::smooth_level_set_bytes(band, *max_deviation_voxels, settings);
        let in_core_bytes = level_set_bytes.saturating_add(picture_bytes);
        let what = if picture_bytes > 0 { "the level set with its picture" } else { "the level set" };
        Limits::within(allowed_bytes).check_memory(in_core_bytes, what).map_err(Cause::File)?;
        let memory_bytes = in_core_bytes.saturating_sub(particles.size_bytes());
        return Ok(MemoryPlan { memory_bytes, tile_leaves: None, in_core_bytes });
    }
    // The input needs memory in addition to the plan, and so does a picture.
    let given_bytes = particles.size_bytes().saturating_add(obstacles.own_bytes);
    let shared_bytes = (obstacles.all_bytes - obstacles.own_bytes).saturating_add(picture_bytes);
    let share_bytes = allowed_bytes.saturating_sub(shared_bytes) / held_count;
    let of_all = |bytes: u64| bytes.saturating_add(given_bytes).saturating_mul(held_count);
    let planned = reconstruction::plan_memory(
        particles,
        settings,
        PlanInputs {
            obstacles: &obstacles.obstacles,
            attribute_bytes: particles.attribute_bytes(settings),
            allows_tiles: held_count == 1,
        },
        share_bytes.saturating_sub(given_bytes),
    )?;
    let with_picture = |plan: MemoryPlan| MemoryPlan {
        memory_bytes: (of_all(plan.memory_bytes) - given_bytes).saturating_add(picture_bytes),
        in_core_bytes: plan.in_core_bytes.saturating_add(picture_bytes),
        ..plan
    };
    planned.map(with_picture).map_err(|error| match error {
        MemoryPlanError::TooLarge(too_large) => {
            let needed_bytes = of_all(too_large.needed_bytes).saturating_add(shared_bytes);
            Cause::TooLarge(TooLarge { needed_bytes, allowed_bytes, picture_bytes, held_count, ..too_large })
        }
        MemoryPlanError::VoxelTooSmall(too_small) => Cause::VoxelTooSmall(too_small),
        MemoryPlanError::ObstacleTooFar(too_far) => {
            let path = obstacles.paths.get(too_far.index).cloned().unwrap_or_default();
            let source = Some(meniscus_formats::Error::unsupported("", too_far.to_string()));
            Cause::Obstacle(Box::new(ObstacleError { path, source }))
        }
    })
}

/// The first stage: rasterizes particles and obstacles, or bounds a level set. Writes data that do not fit
/// into memory to unnamed files in the folder `scratch`.
///
/// # Errors
/// When particles on disk cannot be read or have changed, or the disk has no room for scratch files.
pub(crate) fn rasterize(
    particles: FrameInput,
    obstacles: FrameObstacles,
    settings: &Settings,
    plan: &MemoryPlan,
    scratch: &Path,
) -> Result<FrameInStages, Cause> {
    if let FrameInput::LevelSet(given) = particles {
        let LevelSetInput { band, origin, max_deviation_voxels } = *given;
        return Ok(StagedFrame::of_level_set(band, origin, max_deviation_voxels, settings));
    }
    let file = particles.file();
    let (particles, shape_stats) = shaped(particles, settings)?;
    let tiles = plan.tile_leaves.map(|leaves| TileStorage::new(leaves, || ScratchFile::storage(scratch)));
    let tiles = tiles.transpose().map_err(Cause::Scratch)?;
    let frame = StagedFrame::rasterize(particles, shape_stats, obstacles.obstacles, settings, tiles)?;
    // Contouring a frame in tiles may read the file again and repeats this check. But smoothing takes a while,
    // so a change is detected now.
    require_unchanged(file.as_deref())?;
    Ok(frame)
}

/// The particles, moved and shaped as the settings require.
fn shaped(
    particles: FrameInput,
    settings: &Settings,
) -> Result<(ShapedSource<FrameInput>, ShapeStats), Cause> {
    let (particles, shape_stats) = match particles {
        FrameInput::InMemory(cloud) => {
            let (cloud, shape_stats) = reconstruction::shape_by_attributes(cloud, settings);
            (FrameInput::InMemory(cloud), shape_stats)
        }
        // A file is read in batches only if the settings need no attributes.
        FrameInput::OnDisk(_) | FrameInput::LevelSet(_) => (particles, ShapeStats::default()),
    };
    reconstruction::shape_by_neighbors(particles, shape_stats, settings)
}

/// The second stage: smooths the level set. `advanced` receives the finished fraction.
///
/// # Errors
/// When the disk has no room for scratch files.
pub(crate) fn smooth(
    frame: FrameInStages,
    settings: &Settings,
    advanced: &mut dyn FnMut(f64),
) -> Result<FrameInStages, Cause> {
    frame.smooth(settings, advanced).map_err(Cause::Scratch)
}

/// The third stage: computes the mesh, and the attributes that the outputs need.
///
/// # Errors
/// Those of [`rasterize`].
pub(crate) fn contour(
    frame: FrameInStages,
    settings: &Settings,
    outputs: &OutputOptions,
) -> Result<FrameSurface, Cause> {
    let (mut surface, particles) = frame.contour(settings, outputs.position_rounding())?;
    let Some(particles) = particles else { return Ok(surface) };
    require_unchanged(particles.given().file().as_deref())?;
    let mut unsmoothed = None;
    // Particles on disk have no selected attributes.
    let cloud = particles.filter_map(|given| match given {
        FrameInput::InMemory(cloud) if settings.has_attributes() => {
            unsmoothed = has_rest(&cloud.attributes).then(|| cloud.positions.clone());
            Some(cloud)
        }
        FrameInput::InMemory(_) | FrameInput::OnDisk(_) | FrameInput::LevelSet(_) => None,
    });
    if let Some(cloud) = cloud {
        let targets = Targets {
            vertices: outputs.formats.iter().any(|format| format.is_mesh()),
            band_half_width_voxels: attribute_half_width_voxels(&outputs.formats),
        };
        let ParticleCloud { positions, shapes, attributes } = cloud.into_moved();
        let surface = &mut surface;
        reconstruction::transfer_attributes(
            surface,
            (positions.into(), unsmoothed.as_ref()),
            &shapes,
            &attributes,
            settings,
            targets,
        );
    }
    Ok(surface)
}

/// Fails if a file was written since it was opened. Call it after the last batch.
fn require_unchanged(file: Option<&InputFile>) -> Result<(), Cause> {
    match file.map_or(Ok(true), InputFile::is_unchanged) {
        Ok(true) => Ok(()),
        Ok(false) => Err(Cause::Changed),
        Err(error) => Err(Cause::File(error.into())),
    }
}

impl From<StageError<Cause>> for Cause {
    fn from(error: StageError<Cause>) -> Cause {
        match error {
            StageError::Source(cause) => cause,
            StageError::Storage(error) => Cause::Scratch(error),
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
#[cfg(windows)]
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
