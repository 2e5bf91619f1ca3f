//! The three compute stages of the method. Each has one thread, which starts frames in the thread pool and
//! computes nothing itself.
//!
//! A frame that is averaged over time is smoothed once, and kept for the frames around it: see `smoothed`.

use std::sync::Arc;

use crossbeam::channel::Sender;
use meniscus_formats::{Error, Loaded};

use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::input::around::{
    AroundFrame, FoundFrame, FrameContent, MISSING_OBSTACLES, not_averaged, not_followed,
};
use crate::pipeline::input::filter::keep_chosen;
use crate::pipeline::input::frame::Frame;
use crate::pipeline::input::frame_input::FrameInput;
use crate::pipeline::input::reading::read_particles_of;
use crate::pipeline::method::{self, FrameInStages};
use crate::pipeline::reconstruct::LoadedFrame;
use crate::pipeline::warning::Warning;
use crate::surface::flicker::MovingParticles;
use crate::surface::options::{ReadOptions, Settings};
use crate::surface::reconstruction::FrameSurface;
use crate::surface::temporal::{OtherFrame, TimedFrame, with_particles};

use super::smoothed::SmoothedKey;
use super::spray::{FrameInSequence, SeparatedCloud, sides_around, with_around};
use super::{
    FinishedFrame, InputInfo, Outlet, Passed, ReadContent, StageContext, Stages, WorkItem, outcome_of,
};

impl<'scope, 'env: 'scope> Stages<'_, 'scope, 'env> {
    /// Computes a stage of each frame that `receive` returns, in the thread pool. Sends the result to the next
    /// stage, or reports the failure.
    pub(super) fn compute<K: Send + 'env, A: Send + 'env, B: Send + 'env>(
        &self,
        stage: Stage,
        mut receive: impl FnMut() -> Option<WorkItem<'env, K, A>>,
        to: &Outlet<WorkItem<'env, K, B>>,
        finished: &Sender<FinishedFrame<K>>,
        work: fn(&StageContext<'env>, A, &Frame, &mut InputInfo<'env>) -> Result<B, FrameError>,
    ) {
        let shared = self.shared;
        loop {
            let slot = to.reserve();
            let Some(item) = receive() else { return };
            let finished = finished.clone();
            self.scheduler.spawn(item.order, move || {
                let WorkItem { order, key, frame, mut info, content } = item;
                let made =
                    FrameError::catch(&frame.input, stage, || work(shared, content, &frame, &mut info));
                match made.flatten() {
                    Ok(content) => slot.send(WorkItem { order, key, frame, info, content }),
                    Err(error) => {
                        drop((slot, info));
                        let outcome = outcome_of(error);
                        shared.finish(order, &finished, FinishedFrame { key, frame, outcome });
                    }
                }
            });
        }
    }
}

/// A rasterized frame.
pub(super) struct Rasterized {
    staged: FrameInStages,
    /// Its particles, if it is averaged with others.
    moving: Option<MovingParticles>,
}

/// A smoothed frame.
pub(super) struct Smoothed {
    staged: FrameInStages,
    /// What others need of the frame to be averaged with it, if it is averaged with others.
    timed: Option<Arc<TimedFrame>>,
}

/// The rasterize stage of a frame: rasterizes particles, or bounds a level set. Both result in a level set and its
/// bounds.
pub(super) fn rasterize_stage(
    shared: &StageContext<'_>,
    content: ReadContent,
    frame: &Frame,
    info: &mut InputInfo<'_>,
) -> Result<Passed<Rasterized>, FrameError> {
    let (input, obstacles, plan) = match content {
        ReadContent::Particles(content) => return parsed(content, frame),
        ReadContent::Surface { input, obstacles, plan } => (*input, obstacles, plan),
    };
    // A frame in tiles creates this folder and writes scratch files into it.
    let scratch = &frame.outputs.folder;
    let moving = match &input {
        FrameInput::InMemory(cloud) if frame.is_averaged() => {
            let mut moving = MovingParticles::of(cloud.positions.clone(), &cloud.attributes);
            // Frames around that are read alone have none either.
            moving.velocities.take_if(|_| info.noted.has_computed_velocities);
            Some(moving)
        }
        _ => None,
    };
    let work = || {
        let staged = method::rasterize(input, obstacles, &frame.settings, &plan, scratch)?;
        Ok(Rasterized { staged, moving })
    };
    shared.measured(Stage::Rasterize, frame, info, work).map(Passed::Surface)
}

/// The smooth stage of a frame: smooths its level set.
pub(super) fn smooth_stage(
    shared: &StageContext<'_>,
    content: Passed<Rasterized>,
    frame: &Frame,
    info: &mut InputInfo<'_>,
) -> Result<Passed<Smoothed>, FrameError> {
    let advanced = &mut |fraction| {
        if let Some(observer) = shared.options.observer {
            observer.advanced(frame, Stage::Smooth, fraction);
        }
    };
    content.try_map(|Rasterized { staged, moving }| {
        let work = || {
            let staged = method::smooth(staged, &frame.settings, advanced)?;
            let timed = moving.and_then(|moving| staged.timed(moving, &frame.settings));
            Ok(Smoothed { staged, timed })
        };
        let smoothed = shared.measured(Stage::Smooth, frame, info, work)?;
        if let Some(timed) = &smoothed.timed {
            let content = FrameContent {
                path: frame.input.clone(),
                hash: info.input.hash,
                obstacles: info.obstacles.recorded.clone(),
            };
            let sequence = with_around(frame, info.input.hash, &info.around);
            let sides = sides_around(&sequence, 0, &frame.settings);
            shared.keep(SmoothedKey { content, sides }, &frame.settings, timed);
        }
        info.computing = None;
        Ok(smoothed)
    })
}

/// The contour stage of a frame: contours its level set, which is averaged with those around it first if the settings
/// ask for that. Then releases the memory that only computing needs.
pub(super) fn contour_stage(
    shared: &StageContext<'_>,
    content: Passed<Smoothed>,
    frame: &Frame,
    info: &mut InputInfo<'_>,
) -> Result<Passed<FrameSurface>, FrameError> {
    content.try_map(|Smoothed { mut staged, timed }| {
        let mut around = std::mem::take(&mut info.around);
        let (spray, info_hash) = (info.noted.spray.take(), info.input.hash);
        let (mut other_count, mut warnings) = (0, Vec::new());
        let work = || {
            if let Some(timed) = &timed {
                let others = others(shared, (frame, info_hash), &mut around, &mut warnings);
                other_count = with_particles(&others).count();
                staged.average(timed, &others, &frame.settings);
            }
            Ok(method::contour(staged, &frame.settings, &frame.outputs)?.with_spray(spray))
        };
        let surface = shared.measured(Stage::Contour, frame, info, work)?;
        if other_count > 0 {
            warnings.extend(not_followed(&surface.report.temporal));
        }
        info.around = around;
        info.noted.warnings.append(&mut warnings);
        let packing_bytes = surface.attributes.packing_bytes() as u64;
        let surface_bytes = surface.size_bytes().saturating_mul(WRITING_MEMORY);
        let writing_bytes = packing_bytes.saturating_add(frame.outputs.picture_bytes());
        info.memory.resize(surface_bytes.saturating_add(writing_bytes));
        Ok(surface)
    })
}

/// The frames that a frame is averaged with. One that cannot be made into a level set is left out, with a warning.
fn others(
    shared: &StageContext<'_>,
    (frame, hash): (&Frame, u128),
    around: &mut [FoundFrame],
    warnings: &mut Vec<Warning>,
) -> Vec<OtherFrame> {
    let mut others = Vec::new();
    let all = around.to_vec();
    let sequence = with_around(frame, hash, &all);
    let is_averaged = |found: &&mut FoundFrame| found.frame.steps.unsigned_abs() <= frame.settings.temporal;
    for found in around.iter_mut().filter(is_averaged) {
        let Some(content) = &found.content else { continue };
        let sides = sides_around(&sequence, found.frame.steps, &frame.settings);
        let key = SmoothedKey { content: content.clone(), sides };
        let kept = shared.smoothed.find(&key, &frame.settings);
        let compute = || smoothed_alone(shared, frame, (&found.frame, &key), &sequence);
        let made =
            kept.map_or_else(|| FrameError::catch(&content.path, Stage::Rasterize, compute).flatten(), Ok);
        match made {
            Ok(other) => others.push(OtherFrame { frame: other, steps: found.frame.steps }),
            Err(error) => {
                warnings.push(not_averaged(&error));
                // Otherwise another attempt would end in the same way.
                if !is_of_content(&error.cause, &content.obstacles) {
                    found.content = None;
                }
            }
        }
    }
    others
}

/// Whether the fault is in the content of files, so that every attempt on every machine finds it. `obstacles` are those of
/// the frame, as recorded.
pub(super) fn is_of_content(cause: &Cause, obstacles: &str) -> bool {
    match cause {
        Cause::File(error) => is_lasting(error),
        Cause::Obstacle(_) if obstacles == MISSING_OBSTACLES => true,
        Cause::Obstacle(error) => error.source.as_ref().is_some_and(is_lasting),
        cause => matches!(cause, Cause::Missing(_) | Cause::VoxelTooSmall(_) | Cause::Panic(_)),
    }
}

fn is_lasting(error: &Error) -> bool {
    !matches!(error, Error::Io(_) | Error::MemoryLimit { .. })
}

/// Reads and smooths a frame that is not in the pipeline.
fn smoothed_alone(
    shared: &StageContext<'_>,
    frame: &Frame,
    (around, key): (&AroundFrame, &SmoothedKey),
    sequence: &[FrameInSequence<'_>],
) -> Result<Arc<TimedFrame>, FrameError> {
    let (content, settings) = (&key.content, &frame.settings);
    let path = &content.path;
    let failed = |cause| FrameError { path: path.clone(), during: Stage::Read, cause };
    let loaded = shared.content_of(path, content.hash)?;
    let loaded = LoadedFrame::of_content(path, Some(around.number), loaded, settings)?;
    // Its own conversion warns of what is wrong with its surroundings.
    let loaded = loaded.try_map_cloud(|cloud| {
        let SeparatedCloud { fluid, failures, .. } =
            shared.without_spray(cloud, settings, sequence, around.steps);
        match failures.into_iter().find(|(_, error)| !is_of_content(&error.cause, "")) {
            Some((_, error)) => Err(error),
            None => Ok(fluid),
        }
    })?;
    let moving = loaded.moving_particles();
    let limit = (shared.options.memory_bytes, frame.held_count());
    let smoothed = loaded.smooth(settings, &frame.obstacles, &frame.outputs, limit);
    let smoothed = smoothed.map_err(|FrameError { cause, .. }| failed(cause))?;
    if smoothed.obstacles != content.obstacles {
        return Err(failed(Cause::Changed));
    }
    let timed = smoothed.frame.timed(moving, settings);
    let timed = timed.ok_or_else(|| failed(Cause::Missing("it has no level set in memory".to_owned())))?;
    shared.keep(key.clone(), settings, &timed);
    Ok(timed)
}

impl StageContext<'_> {
    /// Keeps a smoothed frame for those around it, also if several threads work on frames in another order.
    fn keep(&self, key: SmoothedKey, settings: &Arc<Settings>, timed: &Arc<TimedFrame>) {
        let count = 2 * settings.temporal as usize + self.options.pool.current_num_threads();
        self.smoothed.keep(key, settings, Arc::clone(timed), count);
    }
}

fn parsed<T>(content: Loaded, frame: &Frame) -> Result<Passed<T>, FrameError> {
    let ReadOptions { columns, filter } = &frame.settings.reading;
    let mut particles = read_particles_of(&frame.input, content, columns.as_ref())?;
    let about_choice = keep_chosen(&mut particles, filter.as_ref());
    let about_choice = about_choice.map_err(|why| frame.failed(Stage::Read, Cause::Missing(why)))?;
    particles.notes.extend(about_choice.map(|warning| warning.to_string()));
    Ok(Passed::Particles(Box::new(particles)))
}

/// The memory for writing a surface, as a multiple of the surface's size: the surface itself, and its encoded
/// level set.
const WRITING_MEMORY: u64 = 2;
