//! The three stages of the method, as the pipeline sees them.

use std::fs::File;
use std::io;
use std::path::Path;
use std::time::Instant;

use crate::surface::options::Settings;
use crate::surface::skin::tiled::{self, TiledError, TiledFrame};
use crate::surface::skin::{
    self, BoundedBand, FrameSurface, MemoryPlan, PlanInputs, SHELF_COUNT, ShapedSource, Storage, Targets,
    TooLarge, Unfit,
};

use crate::pipeline::error::Cause;
use crate::pipeline::input::frame_input::{FrameInput, LevelSetInput};
use crate::pipeline::input::level_set_file::level_set_limits;
use crate::pipeline::input::obstacles::FrameObstacles;
use crate::pipeline::output::writing::VDB_HALF_WIDTH_VOXELS;
use crate::pipeline::target::outputs::{OutputFormat, OutputOptions};
use crate::pipeline::target::stored::stored;

/// The three stages of the method. Tests put a quick or a failing one in its place.
///
/// # Errors
/// Each call fails when its particles are on disk and cannot be read or were changed, when there is too little
/// memory, or when there is no room on the disk for what does not fit into it.
pub trait Method: Sync {
    /// What rasterization hands to smoothing.
    type Rasterized: Send;
    /// What smoothing hands to contouring.
    type Smoothed: Send;

    /// How the frame is to be skinned in so much memory.
    fn plan(
        &self,
        particles: &FrameInput,
        obstacles: &FrameObstacles,
        settings: &Settings,
        allowed_bytes: u64,
    ) -> Result<MemoryPlan, Cause>;
    /// The first stage, among obstacles. What does not fit into memory may be written to files without a name in `scratch`.
    fn rasterize(
        &self,
        particles: FrameInput,
        obstacles: FrameObstacles,
        settings: &Settings,
        plan: &MemoryPlan,
        scratch: &Path,
    ) -> Result<Self::Rasterized, Cause>;
    /// The second stage; `advanced` hears how much of it is done, from 0 to 1.
    fn smooth(
        &self,
        rasterized: Self::Rasterized,
        settings: &Settings,
        advanced: &mut dyn FnMut(f64),
    ) -> Result<Self::Smoothed, Cause>;
    /// The third stage, for what is to be written.
    fn contour(
        &self,
        smoothed: Self::Smoothed,
        settings: &Settings,
        outputs: &OutputOptions,
    ) -> Result<FrameSurface, Cause>;
}

/// The method that this program is for.
#[derive(Clone, Copy, Debug)]
pub struct LevelSetSkinning;

/// A frame between two stages: in memory, or in tiles on disk.
pub enum StagedSurface<T> {
    /// Whole; and its particles, where their attributes are wanted later.
    Whole(T, Option<ShapedSource<FrameInput>>),
    /// In tiles.
    Tiled(Box<TiledFrame<ShapedSource<FrameInput>>>),
    /// From a level set that was given.
    OfLevelSet(Box<BoundedBand>),
}

impl Method for LevelSetSkinning {
    type Rasterized = StagedSurface<skin::Rasterized>;
    type Smoothed = StagedSurface<skin::Smoothed>;

    fn plan(
        &self,
        particles: &FrameInput,
        obstacles: &FrameObstacles,
        settings: &Settings,
        allowed_bytes: u64,
    ) -> Result<MemoryPlan, Cause> {
        if let FrameInput::LevelSet(given) = particles {
            let LevelSetInput { band, slack_voxels, .. } = &**given;
            let whole_bytes = skin::resurfacing_bytes(band, *slack_voxels, settings);
            level_set_limits(allowed_bytes).check_level_set(whole_bytes, "").map_err(Cause::File)?;
            let memory_bytes = whole_bytes.saturating_sub(particles.size_bytes());
            return Ok(MemoryPlan { memory_bytes, tile_leaves: None, whole_bytes });
        }
        // What is given is there beside what the plan takes.
        let given_bytes = particles.size_bytes().saturating_add(obstacles.all_bytes);
        let planned = skin::plan(
            particles,
            settings,
            PlanInputs {
                obstacles: &obstacles.obstacles,
                attribute_bytes: particles.attribute_bytes(settings),
            },
            allowed_bytes.saturating_sub(given_bytes),
        )?;
        planned.map_err(|unfit| match unfit {
            Unfit::TooLarge(too_large) => {
                let least_bytes = too_large.least_bytes.saturating_add(given_bytes);
                Cause::TooLarge(TooLarge { least_bytes, allowed_bytes, ..too_large })
            }
            Unfit::TooFine(too_fine) => Cause::TooFine(too_fine),
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
            let LevelSetInput { band, origin, slack_voxels } = *given;
            let mut bounded = skin::bound(band, origin, slack_voxels, settings);
            bounded.report_mut().seconds.rasterize = started.elapsed().as_secs_f64();
            return Ok(StagedSurface::OfLevelSet(Box::new(bounded)));
        }
        let (particles, shaping) = particles.shaped(settings)?;
        let Some(tile_leaves) = plan.tile_leaves else {
            let mut rasterized = skin::rasterize(&particles, settings, shaping, obstacles)?;
            rasterized.report_mut().seconds.rasterize = started.elapsed().as_secs_f64();
            particles.given().check_unchanged()?;
            return Ok(StagedSurface::Whole(rasterized, settings.attributes.is_some().then_some(particles)));
        };
        let storages =
            (0..SHELF_COUNT).map(|_| ScratchFile::storage(scratch)).collect::<io::Result<Vec<_>>>();
        let storages = storages.map_err(Cause::Scratch)?;
        let mut frame = tiled::rasterize(particles, settings, shaping, obstacles, tile_leaves, storages)?;
        frame.report_mut().seconds.rasterize = started.elapsed().as_secs_f64();
        // It will be read once more; but what follows takes a while.
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
            StagedSurface::Whole(rasterized, particles) => {
                let mut smoothed = skin::smooth_observed(rasterized, settings, advanced);
                smoothed.report_mut().seconds.smooth = started.elapsed().as_secs_f64();
                StagedSurface::Whole(smoothed, particles)
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
            StagedSurface::Whole(smoothed, particles) => {
                (skin::contour(smoothed, settings, &stored(outputs)), particles)
            }
            StagedSurface::Tiled(frame) => {
                let (surface, particles) = tiled::contour(*frame, settings, &stored(outputs))?;
                particles.given().check_unchanged()?;
                (surface, Some(particles))
            }
            StagedSurface::OfLevelSet(band) => (band.contour(settings, &stored(outputs)), None),
        };
        surface.report.seconds.contour = started.elapsed().as_secs_f64();
        // Those on disk have no attributes that are wanted.
        let in_memory = |given| match given {
            FrameInput::InMemory(cloud) => Some(cloud),
            FrameInput::OnDisk(_) | FrameInput::LevelSet(_) => None,
        };
        let is_wanted = settings.attributes.is_some();
        let cloud = particles.filter(|_| is_wanted).and_then(|particles| particles.into_cloud(in_memory));
        if let Some(cloud) = cloud {
            let started = Instant::now();
            skin::transfer(&mut surface, &cloud, settings, targets(outputs));
            if let Some(transfer) = &mut surface.report.transfer {
                transfer.seconds = started.elapsed().as_secs_f64();
            }
        }
        Ok(surface)
    }
}

/// Where the files that are to be written have places for attributes.
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

/// A file without a name, which is gone when it is closed: when the process ends, however it ends.
struct ScratchFile(File);

impl ScratchFile {
    fn storage(folder: &Path) -> io::Result<Box<dyn Storage>> {
        // Outputs come later: their folder may not be there yet.
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

/// Where reading at a place moves the file's own: tiles come one after the other, so nobody minds.
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
