//! The three compute stages of the method. Each has one thread, which starts frames in the thread pool and
//! computes nothing itself.

use crossbeam::channel::Sender;

use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::input::filter::keep_chosen;
use crate::pipeline::input::frame::Frame;
use crate::pipeline::input::reading::read_particles_of;
use crate::pipeline::method::{self, StagedInput};
use crate::surface::reconstruction::FrameSurface;

use super::shared::{
    FinishedFrame, InputInfo, Outlet, Passed, ReadContent, StageContext, Stages, WorkItem, outcome_of,
};

impl<'scope, 'env: 'scope> Stages<'_, 'scope, 'env> {
    /// Computes a stage of each frame that `receive` returns, in the thread pool. Sends the result to the next
    /// stage, or reports the failure.
    pub(super) fn compute<K: Send + 'env, A: Send + 'env, B: Send + 'env>(
        &self,
        stage: Stage,
        receive: impl Fn() -> Option<WorkItem<'env, K, A>>,
        to: &Outlet<WorkItem<'env, K, B>>,
        finished: &Sender<FinishedFrame<K>>,
        work: fn(&StageContext<'env>, A, &Frame, &mut InputInfo<'env>) -> Result<B, FrameError>,
    ) {
        let shared = self.shared;
        loop {
            let slot = to.reserve();
            let Some(item) = receive() else { return };
            let finished = finished.clone();
            self.scheduler.spawn(item.number, move || {
                let WorkItem { number, key, frame, mut info, content } = item;
                let made =
                    FrameError::catch(&frame.input, stage, || work(shared, content, &frame, &mut info));
                match made.flatten() {
                    Ok(content) => slot.send(WorkItem { number, key, frame, info, content }),
                    Err(error) => {
                        drop((slot, info));
                        let outcome = outcome_of(error);
                        shared.finish(number, &finished, FinishedFrame { key, frame, outcome });
                    }
                }
            });
        }
    }
}

/// Rasterizes particles, or bounds a level set: both result in a level set and its bounds.
pub(super) fn rasterize(
    shared: &StageContext<'_>,
    content: ReadContent,
    frame: &Frame,
    info: &mut InputInfo<'_>,
) -> Result<Passed<StagedInput>, FrameError> {
    let (input, obstacles, plan) = match content {
        ReadContent::Particles(bytes) => return parsed(&bytes, frame),
        ReadContent::Surface { input, obstacles, plan } => (*input, obstacles, plan),
    };
    // A frame in tiles creates this folder and writes scratch files into it.
    let scratch = &frame.outputs.folder;
    shared.refuse_links(scratch)?;
    let work = || method::rasterize(input, obstacles, &frame.settings, &plan, scratch);
    shared.measured(Stage::Rasterize, frame, info, work).map(Passed::Surface)
}

/// Smooths a level set.
pub(super) fn smooth(
    shared: &StageContext<'_>,
    content: Passed<StagedInput>,
    frame: &Frame,
    info: &mut InputInfo<'_>,
) -> Result<Passed<StagedInput>, FrameError> {
    let advanced = &mut |fraction| {
        if let Some(observer) = shared.options.observer {
            observer.advanced(frame, Stage::Smooth, fraction);
        }
    };
    content.try_map(|rasterized| {
        let work = || rasterized.smooth(&frame.settings, advanced).map_err(Cause::Scratch);
        shared.measured(Stage::Smooth, frame, info, work)
    })
}

/// Contours a level set. Then releases the memory that only computing needs.
pub(super) fn contour(
    shared: &StageContext<'_>,
    content: Passed<StagedInput>,
    frame: &Frame,
    info: &mut InputInfo<'_>,
) -> Result<Passed<FrameSurface>, FrameError> {
    content.try_map(|smoothed| {
        let work = || method::contour(smoothed, &frame.settings, &frame.outputs);
        let surface = shared.measured(Stage::Contour, frame, info, work)?;
        let packing_bytes = surface.attributes.packing_bytes() as u64;
        let surface_bytes = surface.size_bytes().saturating_mul(WRITING_MEMORY);
        let writing_bytes = packing_bytes.saturating_add(frame.outputs.picture_bytes());
        info.memory.resize(surface_bytes.saturating_add(writing_bytes));
        Ok(surface)
    })
}

fn parsed<T>(bytes: &[u8], frame: &Frame) -> Result<Passed<T>, FrameError> {
    let mut particles = read_particles_of(&frame.input, bytes)?;
    let about_choice = keep_chosen(&mut particles, frame.settings.filter.as_ref());
    let about_choice = about_choice.map_err(|why| frame.failed(Stage::Read, Cause::Missing(why)))?;
    particles.notes.extend(about_choice.map(|warning| warning.to_string()));
    Ok(Passed::Particles(Box::new(particles)))
}

/// The memory for writing a surface, as a multiple of the surface's size: the surface itself, and its encoded
/// level set.
const WRITING_MEMORY: u64 = 2;
