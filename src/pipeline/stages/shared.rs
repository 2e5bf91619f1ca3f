//! The shared state of the stages, and the types that they exchange.
//!
//! A [`WorkItem`] moves from stage to stage until its frame is a [`FinishedFrame`]. Between two stages it
//! passes a [link]: a bounded channel in which a stage reserves a slot before it starts a frame. So a slow
//! stage blocks the one before it, and a thread of the pool never waits for room in a channel.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use crossbeam::channel::{Receiver, Sender, bounded};
use meniscus_formats::ParticleFrame;

use crate::pipeline::budget::{Budget, Reservation};
use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::input::around::{FoundFrame, KnownHashes};
use crate::pipeline::input::frame::{Frame, InputState, Outcome, Seconds};
use crate::pipeline::input::frame_input::FrameInput;
use crate::pipeline::input::obstacles::FrameObstacles;
use crate::pipeline::scheduler::Scheduler;
use crate::pipeline::semaphore::{Permit, Semaphore};
use crate::pipeline::warning::Warning;
use crate::surface::reconstruction::MemoryPlan;

use super::smoothed::{Computing, SmoothedFrames, User};
use super::{OnError, PipelineOptions};

/// The state that all stages share.
pub(super) struct StageContext<'env> {
    pub(super) options: &'env PipelineOptions<'env>,
    pub(super) budget: Budget,
    pub(super) smoothed: SmoothedFrames,
    pub(super) hashes: KnownHashes,
    /// The number of the first frame that failed.
    first_failed: AtomicUsize,
}

/// The stages of one call of [`stream`](super::stream). The threads of the stages borrow this.
pub(super) struct Stages<'a, 'scope, 'env> {
    pub(super) shared: &'env StageContext<'env>,
    pub(super) scheduler: Scheduler<'a, 'scope, 'env>,
}

/// A frame between two stages.
pub(super) struct WorkItem<'env, K, T> {
    /// The number of the frame, in the order of requests.
    pub(super) number: usize,
    /// The caller's key for the frame.
    pub(super) key: K,
    pub(super) frame: Frame,
    pub(super) info: InputInfo<'env>,
    /// The result of the last stage.
    pub(super) content: T,
}

/// What reading a frame determines, for the later stages.
pub(super) struct InputInfo<'env> {
    pub(super) input: InputState,
    pub(super) seconds: Seconds,
    pub(super) noted: Noted,
    pub(super) obstacles: ObstacleSummary,
    /// The frames before and after it.
    pub(super) around: Vec<FoundFrame>,
    /// If it is averaged with others.
    pub(super) user: Option<User<'env>>,
    /// Until the frame is smoothed, if others are averaged with it.
    pub(super) computing: Option<Computing<'env>>,
    /// The peak memory of the frame in all stages, in bytes.
    pub(super) needed_bytes: u64,
    pub(super) memory: Reservation<'env>,
}

/// The obstacles of a frame, as far as its record and its report need them.
#[derive(Default)]
pub(super) struct ObstacleSummary {
    pub(super) recorded: String,
    pub(super) open_edge_count: usize,
}

/// Warnings about the input.
#[derive(Default)]
pub(super) struct Noted {
    pub(super) warnings: Vec<Warning>,
    /// The name of the velocity attribute, if the file has one and no option requests it.
    pub(super) unused_velocity: Option<String>,
}

/// The result of reading.
pub(super) enum ReadContent {
    /// For a surface, with the plan of its reconstruction.
    Surface { input: Box<FrameInput>, obstacles: FrameObstacles, plan: MemoryPlan },
    /// The bytes of a particle file, for conversion to another format.
    Particles(Vec<u8>),
}

/// What one compute stage passes to the next one.
pub(super) enum Passed<T> {
    /// A surface in progress.
    Surface(T),
    /// Particles without a surface.
    Particles(Box<ParticleFrame>),
}

impl<T> Passed<T> {
    /// Runs a stage of a surface; particles pass unchanged.
    pub(super) fn try_map<U, E>(self, stage: impl FnOnce(T) -> Result<U, E>) -> Result<Passed<U>, E> {
        match self {
            Passed::Surface(surface) => stage(surface).map(Passed::Surface),
            Passed::Particles(particles) => Ok(Passed::Particles(particles)),
        }
    }
}

/// A frame and its outcome.
pub(super) struct FinishedFrame<K> {
    pub(super) key: K,
    pub(super) frame: Frame,
    pub(super) outcome: Outcome,
}

/// Smoothed frames that are kept for others may take this fraction of the memory.
const KEPT_SHARE: u64 = 4;

impl<'env> StageContext<'env> {
    /// The state before the first frame.
    pub(super) fn new(options: &'env PipelineOptions<'env>) -> StageContext<'env> {
        let budget = Budget::new(options.memory_bytes);
        StageContext {
            options,
            budget,
            smoothed: SmoothedFrames::new(options.memory_bytes / KEPT_SHARE),
            hashes: KnownHashes::default(),
            first_failed: AtomicUsize::new(usize::MAX),
        }
    }

    /// Reports that a frame begins a stage.
    pub(super) fn begin(&self, frame: &Frame, stage: Stage) {
        if let Some(observer) = self.options.observer {
            observer.began(frame, stage);
        }
    }

    /// Runs a stage of a surface, and measures it.
    pub(super) fn measured<T>(
        &self,
        stage: Stage,
        frame: &Frame,
        info: &mut InputInfo<'_>,
        work: impl FnOnce() -> Result<T, Cause>,
    ) -> Result<T, FrameError> {
        self.begin(frame, stage);
        let start = Instant::now();
        let made = work();
        *info.seconds.of_stage(stage) = start.elapsed().as_secs_f64();
        made.map_err(|cause| frame.failed(stage, cause))
    }

    /// Reports the outcome of the frame with this number. Returns whether the caller still receives outcomes.
    pub(super) fn finish<K>(
        &self,
        number: usize,
        to: &Sender<FinishedFrame<K>>,
        finished: FinishedFrame<K>,
    ) -> bool {
        if is_failure(&finished.outcome) {
            self.first_failed.fetch_min(number, Ordering::Relaxed);
        }
        to.send(finished).is_ok()
    }

    /// Whether a frame before this one failed, under [`OnError::Stop`].
    pub(super) fn is_stopped_before(&self, number: usize) -> bool {
        self.options.on_error == OnError::Stop && self.first_failed.load(Ordering::Relaxed) < number
    }
}

/// The outcome of a frame with this error.
pub(super) fn outcome_of(error: FrameError) -> Outcome {
    if matches!(error.cause, Cause::Changed) { Outcome::Changed } else { Outcome::Failed(error) }
}

/// Whether a frame was attempted and has no outputs.
pub(super) fn is_failure(outcome: &Outcome) -> bool {
    matches!(outcome, Outcome::Failed(_) | Outcome::Changed)
}

/// A bounded channel between two stages, whose slots are reserved before use.
pub(super) fn link<T>(capacity: usize) -> (Outlet<T>, Inlet<T>) {
    let (items, from) = bounded(capacity);
    (Outlet { items, slots: Semaphore::new(capacity) }, Inlet(from))
}

/// The end of a link that a stage sends to.
#[derive(Clone)]
pub(super) struct Outlet<T> {
    items: Sender<(Permit, T)>,
    slots: Semaphore,
}

/// The end of a link that a stage receives from.
pub(super) struct Inlet<T>(Receiver<(Permit, T)>);

/// A reserved slot in a link: it becomes free when it is dropped, or when the item is received.
pub(super) struct LinkSlot<T> {
    items: Sender<(Permit, T)>,
    permit: Permit,
}

impl<T> Outlet<T> {
    /// Waits for a free slot.
    pub(super) fn reserve(&self) -> LinkSlot<T> {
        LinkSlot { items: self.items.clone(), permit: self.slots.acquire() }
    }
}

impl<T> LinkSlot<T> {
    /// Sends, without waiting.
    pub(super) fn send(self, item: T) {
        // This fails only if the next stage is gone, and then the caller is, too.
        let _ = self.items.try_send((self.permit, item));
    }
}

impl<T> Inlet<T> {
    /// The items, each with a permit that is dropped when the item is received.
    pub(super) fn items(&self) -> &Receiver<(Permit, T)> {
        &self.0
    }

    /// Waits for the next item; `None` once the stage before has ended.
    pub(super) fn receive(&self) -> Option<T> {
        self.0.recv().ok().map(|(_, item)| item)
    }
}

impl<T> Clone for Inlet<T> {
    fn clone(&self) -> Inlet<T> {
        Inlet(self.0.clone())
    }
}
