//! The three compute stages of the method. Each has one thread, which starts frames in the thread pool and
//! computes nothing itself.

use crossbeam::channel::{Receiver, Sender};
use meniscus_formats::{Limits, read_particles};

use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::input::filter::keep_chosen;
use crate::pipeline::input::frame::Frame;
use crate::pipeline::input::steps::{by_lines_of_file, file_of};
use crate::pipeline::method::Method;
use crate::surface::reconstruction::FrameSurface;

use super::shared::{
    FinishedFrame, Inlet, InputInfo, LinkSlot, Outlet, Read, Staged, Stages, WorkItem, outcome_of,
};

impl<'scope, 'env: 'scope, M: Method> Stages<'_, 'scope, 'env, M> {
    /// Rasterizes particles, or bounds a level set: both result in a level set and its bounds. Reserves the
    /// memory for computing a frame.
    pub(super) fn rasterize<K: Send + 'env>(
        &self,
        from: &Receiver<WorkItem<'env, K, Read>>,
        to: &Outlet<WorkItem<'env, K, Staged<M::Rasterized>>>,
        finished: &Sender<FinishedFrame<K>>,
    ) {
        let shared = self.shared;
        loop {
            let slot = to.reserve();
            let Ok(mut item) = from.recv() else { return };
            item.info.memory.reserve_compute(item.info.needed_bytes);
            self.start(Stage::Rasterize, item, (slot, finished), |content, frame, _| match content {
                Read::Particles(bytes) => parsed(&bytes, frame),
                Read::Surface { input, obstacles, plan } => {
                    shared.begin(frame, Stage::Rasterize);
                    let scratch = &frame.outputs.folder;
                    // A frame in tiles creates this folder and writes scratch files into it.
                    shared.refuse_links(scratch)?;
                    let made = shared.method.rasterize(*input, obstacles, &frame.settings, &plan, scratch);
                    staged(made, frame, Stage::Rasterize)
                }
            });
        }
    }

    /// Smooths level sets.
    pub(super) fn smooth<K: Send + 'env>(
        &self,
        from: &Inlet<WorkItem<'env, K, Staged<M::Rasterized>>>,
        to: &Outlet<WorkItem<'env, K, Staged<M::Smoothed>>>,
        finished: &Sender<FinishedFrame<K>>,
    ) {
        let shared = self.shared;
        loop {
            let slot = to.reserve();
            let Some(item) = from.receive() else { return };
            self.start(Stage::Smooth, item, (slot, finished), |content, frame, _| match content {
                Staged::Particles(particles) => Ok(Staged::Particles(particles)),
                Staged::Surface(rasterized) => {
                    shared.begin(frame, Stage::Smooth);
                    let advanced = &mut |fraction| {
                        if let Some(observer) = shared.options.observer {
                            observer.advanced(frame, Stage::Smooth, fraction);
                        }
                    };
                    let made = shared.method.smooth(rasterized, &frame.settings, advanced);
                    staged(made, frame, Stage::Smooth)
                }
            });
        }
    }

    /// Contours level sets. Then releases the memory that only computing needs.
    pub(super) fn contour<K: Send + 'env>(
        &self,
        from: &Inlet<WorkItem<'env, K, Staged<M::Smoothed>>>,
        to: &Outlet<WorkItem<'env, K, Staged<FrameSurface>>>,
        finished: &Sender<FinishedFrame<K>>,
    ) {
        let shared = self.shared;
        loop {
            let slot = to.reserve();
            let Some(item) = from.receive() else { return };
            self.start(Stage::Contour, item, (slot, finished), |content, frame, info| match content {
                Staged::Particles(particles) => Ok(Staged::Particles(particles)),
                Staged::Surface(smoothed) => {
                    shared.begin(frame, Stage::Contour);
                    let made = shared.method.contour(smoothed, &frame.settings, &frame.outputs);
                    if let Ok(surface) = &made {
                        let packing_bytes = surface.attributes.packing_bytes() as u64;
                        let surface_bytes = surface.size_bytes().saturating_mul(WRITING_MEMORY);
                        let writing_bytes = packing_bytes.saturating_add(frame.outputs.picture_bytes());
                        info.memory.resize(surface_bytes.saturating_add(writing_bytes));
                    }
                    staged(made, frame, Stage::Contour)
                }
            });
        }
    }

    /// Runs a stage of a frame in the thread pool. Sends the result to the next stage, or reports the
    /// failure.
    fn start<K: Send + 'env, A: Send + 'env, B: Send + 'env>(
        &self,
        stage: Stage,
        item: WorkItem<'env, K, A>,
        (slot, finished): (LinkSlot<WorkItem<'env, K, B>>, &Sender<FinishedFrame<K>>),
        work: impl FnOnce(A, &Frame, &mut InputInfo<'env>) -> Result<B, FrameError> + Send + 'env,
    ) {
        let (shared, finished) = (self.shared, finished.clone());
        self.scheduler.spawn(item.number, move || {
            let WorkItem { number, key, frame, mut info, content } = item;
            let made = FrameError::catch(&frame.input, stage, || work(content, &frame, &mut info));
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

/// The result of a stage for a surface, or its error.
fn staged<T>(made: Result<T, Cause>, frame: &Frame, stage: Stage) -> Result<Staged<T>, FrameError> {
    made.map(Staged::Surface).map_err(|cause| frame.failed(stage, cause))
}

fn parsed<T>(bytes: &[u8], frame: &Frame) -> Result<Staged<T>, FrameError> {
    let name = file_of(&frame.input).file_name().unwrap_or_default().to_string_lossy();
    let failed = |error| FrameError::file(&frame.input, Stage::Read, by_lines_of_file(&frame.input, error));
    let mut particles = read_particles(bytes, &name, &Limits::default()).map_err(failed)?;
    let about_choice = keep_chosen(&mut particles, frame.settings.filter.as_ref());
    let about_choice = about_choice.map_err(|why| frame.failed(Stage::Read, Cause::Missing(why)))?;
    particles.notes.extend(about_choice.map(|warning| warning.to_string()));
    Ok(Staged::Particles(Box::new(particles)))
}

/// The memory for writing a surface, as a multiple of the surface's size: the surface itself, and its encoded
/// level set.
const WRITING_MEMORY: u64 = 2;
