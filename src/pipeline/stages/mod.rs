//! The stages of a frame, joined by bounded channels.
//!
//! ```text
//!   next ──▶ read ──▶ rasterize ──▶ smooth ──▶ contour ──▶ write ──▶ finished
//!    ▲                                                                   │
//!    └────────── up to the maximum number of frames in flight ───────────┘
//! ```
//!
//! Several frames are in flight at once, in different stages or in the same one. A compute stage starts a
//! frame only when the channel after it has a free slot, so a slow stage blocks the stages before it. This
//! backpressure reaches the caller: the pipeline asks for the next frame only when there is room for one, so the
//! caller can choose that frame at the last moment.
//!
//! Reading has one thread and writing has several, which wait for the disk. Rasterizing, smoothing and
//! contouring have one thread each, which only decides when a frame may start. All computing, except the
//! encoding of meshes in binary formats, happens in the pool, where the earliest frame comes [first](super::scheduler): with many frames each thread of the pool
//! has a separate frame, and with one frame all threads share it.
//!
//! The frames in flight are limited in number, by `in_flight`, and in bytes, by a [budget](super::budget).
//!
//! Not every frame needs every stage: particles that are only converted to another format are parsed by the
//! first compute stage, and pass unchanged through the other two.
//!
//! Each stage runs under `catch_unwind`: a broken invariant fails only its frame. A frame that failed, or was
//! done already, leaves at once and overtakes others; [`run`] restores the order of outcomes.
//!
//! A [`WorkItem`] moves from stage to stage until its frame is a [`FinishedFrame`]. After each compute
//! stage it passes a [link]: the stage reserves a slot in it before it starts a frame, so a thread of the pool never
//! waits for room in a channel. `smoothed` keeps frames for those that are averaged with them.

mod compute;
mod frame_cache;
mod history;
mod read;
mod smoothed;
mod spray;
mod velocities;
mod write;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Instant;

use crossbeam::channel::{Receiver, Sender, bounded};
use meniscus_formats::{Loaded, ParticleFrame};
use rayon::ThreadPool;

use crate::pipeline::budget::{Budget, Reservation};
use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::input::around::{FoundFrame, KnownHashes};
use crate::pipeline::input::attributes::AttributeRequest;
use crate::pipeline::input::frame::{Frame, InputState, Outcome, Seconds};
use crate::pipeline::input::frame_input::FrameInput;
use crate::pipeline::input::obstacles::FrameObstacles;
use crate::pipeline::input::reading::{hash_of, parse_particles, read_frame_unchanged};
use crate::pipeline::input::steps::IndexPolicy;
use crate::pipeline::memory::default_memory_bytes;
use crate::pipeline::observer::Observer;
use crate::pipeline::scheduler::{Scheduler, TaskQueue};
use crate::pipeline::semaphore::{Permit, Semaphore};
use crate::pipeline::warning::Warning;
use crate::surface::particles::ParticleCloud;
use crate::surface::reconstruction::MemoryPlan;
use crate::surface::spray::Spray;

use compute::{contour_stage, rasterize_stage, smooth_stage};
use history::{KnownHistories, KnownHistory};
use smoothed::{Computing, Gate, SmoothedFrames, User};
use spray::KnownSides;

/// What to do when a frame fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnError {
    /// Write exactly the frames before the one that failed.
    Stop,
    /// Go on with the next frame.
    Continue,
}

/// The options of a conversion.
#[derive(Clone, Copy, Debug)]
pub struct PipelineOptions<'a> {
    /// The thread pool for all computing.
    pub pool: &'a ThreadPool,
    /// What to do when a frame fails, or changes while it is read. With `Stop`, frames keep their order: each
    /// stage handles one frame at a time.
    pub on_error: OnError,
    /// Skip frames that are done according to their [records](Frame::records).
    pub skip_done: bool,
    /// The maximum number of frames that were requested and are not finished; at least one.
    pub in_flight: usize,
    /// The approximate limit on the memory of all frames in flight, in bytes. A frame that alone needs more
    /// is reconstructed in tiles on disk; if that is impossible, it fails with the amount that it needs.
    pub memory_bytes: u64,
    /// Which thread indexes a file with several frames after the file has changed. If it is not the reading
    /// thread, reading never waits for the index.
    pub index_policy: IndexPolicy,
    /// Receives the progress of frames.
    pub observer: Option<&'a dyn Observer>,
}

impl<'a> PipelineOptions<'a> {
    /// The defaults of `meniscus convert` on this pool: continue when a frame fails, overwrite frames that
    /// are done, and use the [default number](default_in_flight) of frames in flight and the
    /// [default memory](default_memory_bytes).
    pub fn new(pool: &'a ThreadPool) -> PipelineOptions<'a> {
        PipelineOptions {
            pool,
            on_error: OnError::Continue,
            skip_done: false,
            in_flight: default_in_flight(pool.current_num_threads()),
            memory_bytes: default_memory_bytes(),
            index_policy: IndexPolicy::OnRead,
            observer: None,
        }
    }
}

/// The number of frames that keep this many threads busy: one for each, plus some that are read or written.
pub fn default_in_flight(threads: usize) -> usize {
    threads + writer_count(threads) + 1
}

/// The number of threads that write. Encoding takes little time compared to computing, so more threads would
/// only wait for the disk.
fn writer_count(thread_count: usize) -> usize {
    thread_count / 2 + 1
}

/// Converts the frames of a list. `finished` receives each outcome with the index of its frame, in order, as
/// soon as all earlier frames are finished.
pub fn run(frames: &[Frame], options: &PipelineOptions<'_>, mut finished: impl FnMut(usize, Outcome)) {
    let mut frames = frames.iter().cloned().enumerate();
    let mut early = BTreeMap::new();
    let mut is_stopped = false;
    let mut finished_count = 0;
    stream(
        || frames.next(),
        options,
        |index, _, outcome| {
            early.insert(index, outcome);
            while let Some(outcome) = early.remove(&finished_count) {
                // Frames after the failed one may have failed even earlier. They are reported as not started.
                let outcome = if is_stopped { Outcome::NotStarted } else { outcome };
                is_stopped |= options.on_error == OnError::Stop && is_failure(&outcome);
                finished(finished_count, outcome);
                finished_count += 1;
            }
        },
    );
}

/// Converts the frames that `next` returns, until it returns `None`. Calls `next` when there is room for one
/// more frame; `next` may block. `K` identifies a frame for the caller. `finished` receives each outcome as
/// soon as it is known, in any order, on the thread of the caller.
pub fn stream<K: Send>(
    next: impl FnMut() -> Option<(K, Frame)> + Send,
    options: &PipelineOptions<'_>,
    finished: impl FnMut(K, Frame, Outcome),
) {
    let shared = StageContext::new(options);
    let tasks = TaskQueue::default();
    options.pool.in_place_scope(|scope| {
        let stages = Stages { shared: &shared, scheduler: Scheduler::new(scope, &tasks) };
        drive(&stages, next, finished);
    });
}

/// Starts the threads of the stages, and reports the outcomes of the frames.
fn drive<'scope, 'env: 'scope, K: Send + 'env>(
    stages: &Stages<'_, 'scope, 'env>,
    next: impl FnMut() -> Option<(K, Frame)> + Send,
    mut on_finished: impl FnMut(K, Frame, Outcome),
) {
    let options = stages.shared.options;
    let in_flight = options.in_flight.max(1);
    // The maximum number of frames in a compute stage and in the channel after it, together.
    let width = match options.on_error {
        OnError::Stop => 1,
        OnError::Continue => options.pool.current_num_threads().min(in_flight),
    };
    // Holds a token for each frame that is not finished.
    let (token_sender, token_receiver) = bounded(in_flight);
    // The channel has room for all frames in flight, so that a thread of the pool never waits to report an
    // outcome.
    let (finished, finished_from) = bounded(in_flight);
    let (to_rasterize, to_rasterize_from) = bounded(0);
    let (to_smooth, to_smooth_from) = link(width);
    let (to_contour, to_contour_from) = link(width);
    let (to_write, to_write_from) = link(width);
    thread::scope(move |scope| {
        for _ in 0..writer_count(width) {
            let (from, finished) = (to_write_from.clone(), finished.clone());
            scope.spawn(move || stages.write(&from, &finished));
        }
        scope.spawn({
            let finished = finished.clone();
            move || stages.read(next, &token_sender, &to_rasterize, &finished)
        });
        scope.spawn({
            let finished = finished.clone();
            move || {
                let receive = || {
                    let mut item = to_rasterize_from.recv().ok()?;
                    item.info.memory.reserve_compute(item.info.needed_bytes);
                    item.info.computing = item.info.user.as_ref().map(|user| user.begin(&item.frame.input));
                    Some(item)
                };
                stages.compute(Stage::Rasterize, receive, &to_smooth, &finished, rasterize_stage);
            }
        });
        scope.spawn({
            let finished = finished.clone();
            let receive = move || to_smooth_from.receive();
            move || stages.compute(Stage::Smooth, receive, &to_contour, &finished, smooth_stage)
        });
        scope.spawn(move || {
            let smoothed = &stages.shared.smoothed;
            let mut gate = Gate::new(&to_contour_from, smoothed);
            let receive = || {
                gate.receive(|item: &WorkItem<'_, _, _>| {
                    let reach = item.frame.settings.temporal;
                    let is_averaged = |found: &&FoundFrame| found.frame.steps.unsigned_abs() <= reach;
                    let mut around =
                        item.info.around.iter().filter(is_averaged).map(|found| &*found.frame.path);
                    !smoothed.is_computing(&mut around)
                })
            };
            stages.compute(Stage::Contour, receive, &to_write, &finished, contour_stage);
        });
        // A stage ends when the one before it has ended, so this thread must drop its ends of the channels.
        drop(to_write_from);
        for FinishedFrame { key, frame, outcome } in finished_from {
            on_finished(key, frame, outcome);
            let _ = token_receiver.try_recv();
        }
    });
}

/// The state that all stages share.
struct StageContext<'env> {
    options: &'env PipelineOptions<'env>,
    budget: Budget,
    smoothed: SmoothedFrames,
    hashes: KnownHashes,
    sides: Mutex<KnownSides>,
    histories: Mutex<KnownHistories>,
    /// The place of the first frame that failed.
    first_failed: AtomicUsize,
}

/// The stages of one call of [`stream`]. The threads of the stages borrow this.
struct Stages<'a, 'scope, 'env> {
    shared: &'env StageContext<'env>,
    scheduler: Scheduler<'a, 'scope, 'env>,
}

/// A frame on its way through the stages, with the result of the last one.
struct WorkItem<'env, K, T> {
    /// Its place in the order of requests: the lowest computes first.
    order: usize,
    /// The caller's key for the frame.
    key: K,
    frame: Frame,
    info: InputInfo<'env>,
    /// The result of the last stage.
    content: T,
}

/// What reading a frame determines, for the later stages.
struct InputInfo<'env> {
    input: InputState,
    seconds: Seconds,
    noted: InputNotes,
    obstacles: ObstacleSummary,
    /// The frames before and after it.
    around: Vec<FoundFrame>,
    /// Keeps smoothed frames available while it exists; `None` if this frame is not averaged.
    user: Option<User<'env>>,
    /// While it exists, frames around this one wait at the gate. Dropped when this frame is smoothed.
    computing: Option<Computing<'env>>,
    /// The peak memory of the frame in all stages, in bytes.
    needed_bytes: u64,
    memory: Reservation<'env>,
}

/// The obstacles of a frame, as far as its record and its report need them.
#[derive(Default)]
struct ObstacleSummary {
    recorded: String,
    open_edge_count: usize,
}

/// What reading a frame leaves for its end.
#[derive(Default)]
struct InputNotes {
    warnings: Vec<Warning>,
    /// The name of the velocity attribute, if the file has one and no option requests it.
    unused_velocity: Option<String>,
    /// The particles that are not in the surface, if the settings ask for them.
    spray: Option<Spray>,
    /// The frames around that could not be read, and may be at the next attempt: by how many frames each is later.
    unread: Vec<i32>,
    /// Whether the velocities of the particles are not those of the file.
    has_computed_velocities: bool,
}

/// The result of reading.
enum ReadContent {
    /// For a surface, with the plan of its reconstruction.
    Surface { input: Box<FrameInput>, obstacles: FrameObstacles, plan: MemoryPlan },
    /// Particles for conversion to another format.
    Particles(Loaded),
}

/// What one compute stage passes to the next one.
enum Passed<T> {
    /// A surface in progress.
    Surface(T),
    /// Particles without a surface.
    Particles(Box<ParticleFrame>),
}

impl<T> Passed<T> {
    /// Runs a stage of a surface; particles pass unchanged.
    fn try_map<U, E>(self, stage: impl FnOnce(T) -> Result<U, E>) -> Result<Passed<U>, E> {
        match self {
            Passed::Surface(surface) => stage(surface).map(Passed::Surface),
            Passed::Particles(particles) => Ok(Passed::Particles(particles)),
        }
    }
}

/// A frame and its outcome.
struct FinishedFrame<K> {
    key: K,
    frame: Frame,
    outcome: Outcome,
}

/// Smoothed frames that are kept for others may take this fraction of the memory, and so may the sides of particles, and
/// their origins.
const KEPT_SHARE: u64 = 4;

/// Locks what stages share. Each change is complete before the lock is released, and what is kept is compared with the
/// files before it is used, so a panic leaves nothing inconsistent.
fn lock<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<'env> StageContext<'env> {
    /// The state before the first frame.
    fn new(options: &'env PipelineOptions<'env>) -> StageContext<'env> {
        let budget = Budget::new(options.memory_bytes);
        let limit_bytes = options.memory_bytes / KEPT_SHARE;
        StageContext {
            options,
            budget,
            smoothed: SmoothedFrames::new(limit_bytes),
            hashes: KnownHashes::default(),
            sides: Mutex::new(KnownSides::new(limit_bytes, 1, |sides| {
                sides.as_ref().map_or(0, |sides| sides.size_bytes() as u64)
            })),
            // A frame may have two sets of rest coordinates.
            histories: Mutex::new(KnownHistories::new(limit_bytes, 2, KnownHistory::size_bytes)),
            first_failed: AtomicUsize::new(usize::MAX),
        }
    }

    /// The content of another frame, if its hash is this one.
    fn content_of(&self, path: &Path, hash: u128) -> Result<Loaded, FrameError> {
        let failed = |cause| FrameError { path: path.to_owned(), during: Stage::Read, cause };
        let read = read_frame_unchanged(path, self.options.index_policy);
        let read = read.map_err(|error| failed(Cause::File(error)))?;
        let read = read.filter(|read| hash_of(&read.content) == hash);
        read.map(|read| read.content).ok_or_else(|| failed(Cause::Changed))
    }

    /// The particles of another frame, if its hash is this one.
    fn particles_of(
        &self,
        path: &Path,
        hash: u128,
        wanted: &AttributeRequest,
    ) -> Result<ParticleCloud, FrameError> {
        Ok(parse_particles(path, self.content_of(path, hash)?, wanted)?.cloud)
    }

    /// Reports that a frame begins a stage.
    fn begin(&self, frame: &Frame, stage: Stage) {
        if let Some(observer) = self.options.observer {
            observer.began(frame, stage);
        }
    }

    /// Runs a stage of a surface, and measures it.
    fn measured<T>(
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

    /// Reports the outcome of the frame at this place in the order of requests. Returns whether the caller still
    /// receives outcomes.
    fn finish<K>(&self, order: usize, finished: &Sender<FinishedFrame<K>>, frame: FinishedFrame<K>) -> bool {
        if is_failure(&frame.outcome) {
            self.first_failed.fetch_min(order, Ordering::Relaxed);
        }
        finished.send(frame).is_ok()
    }

    /// Whether a frame before this one failed, under [`OnError::Stop`].
    fn is_stopped_before(&self, order: usize) -> bool {
        self.options.on_error == OnError::Stop && self.first_failed.load(Ordering::Relaxed) < order
    }
}

/// The outcome of a frame with this error.
fn outcome_of(error: FrameError) -> Outcome {
    if matches!(error.cause, Cause::Changed) { Outcome::Changed } else { Outcome::Failed(error) }
}

/// Whether a frame was attempted and has no outputs.
fn is_failure(outcome: &Outcome) -> bool {
    matches!(outcome, Outcome::Failed(_) | Outcome::Changed)
}

/// A bounded channel between two stages, whose slots are reserved before use.
fn link<T>(capacity: usize) -> (Outlet<T>, Inlet<T>) {
    let (items, from) = bounded(capacity);
    (Outlet { items, slots: Semaphore::new(capacity) }, Inlet(from))
}

/// The end of a link that a stage sends to.
#[derive(Clone)]
struct Outlet<T> {
    items: Sender<(Permit, T)>,
    slots: Semaphore,
}

/// The end of a link that a stage receives from.
struct Inlet<T>(Receiver<(Permit, T)>);

/// A reserved slot in a link: it becomes free when it is dropped, or when the item is received.
struct LinkSlot<T> {
    items: Sender<(Permit, T)>,
    permit: Permit,
}

impl<T> Outlet<T> {
    /// Waits for a free slot.
    fn reserve(&self) -> LinkSlot<T> {
        LinkSlot { items: self.items.clone(), permit: self.slots.acquire() }
    }
}

impl<T> LinkSlot<T> {
    /// Sends, without waiting.
    fn send(self, item: T) {
        // This fails only if the next stage is gone, and then the caller is, too.
        let _ = self.items.try_send((self.permit, item));
    }
}

impl<T> Inlet<T> {
    /// The items, each with a permit that is dropped when the item is received.
    fn items(&self) -> &Receiver<(Permit, T)> {
        &self.0
    }

    /// Waits for the next item; `None` once the stage before has ended.
    fn receive(&self) -> Option<T> {
        self.0.recv().ok().map(|(_, item)| item)
    }
}

impl<T> Clone for Inlet<T> {
    fn clone(&self) -> Inlet<T> {
        Inlet(self.0.clone())
    }
}
