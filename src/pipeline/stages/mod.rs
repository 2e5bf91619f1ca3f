//! The stages of a frame, joined by bounded channels.
//!
//! ```text
//!   next ──▶ read ──▶ rasterize ──▶ smooth ──▶ contour ──▶ write ──▶ finished
//!    ▲                                                                   │
//!    └──────────────── as many frames as may be in flight ───────────────┘
//! ```
//!
//! Several frames are under way at once, each in another stage or several in one. A stage begins with a frame only when there
//! is a place for what it makes in the channel behind it. So a slow stage holds back the stages before it, and in the end the
//! caller, who is asked for the next frame only when there is room for it, and can decide late which it is.
//!
//! Reading has one thread, and writing has some, which wait for the disk. Rasterizing, smoothing and contouring have one thread
//! each, which only decides when a frame may begin. All computing happens in the pool, where the earliest frame comes
//! [first](super::scheduler): with many frames each thread of the pool has one of its own, and with one frame they share it.
//!
//! The frames under way are bounded in number, by `in_flight`, and in bytes, by a [budget](super::budget).
//!
//! Not every frame needs every stage: particles that are only written in another format are parsed by the first one, and go
//! through the other two as they are.
//!
//! Each stage runs under `catch_unwind`: a broken invariant costs its own frame only. A frame that failed,
//! or was done already, leaves at once and overtakes others; [`run`] puts outcomes back in order.
//!
//! `shared` has what goes from stage to stage; `read`, `compute` and `write` are the stages.

mod compute;
mod read;
mod shared;
mod write;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::thread;

use crossbeam::channel::bounded;
use rayon::ThreadPool;

use crate::pipeline::input::frame::{Frame, Outcome};
use crate::pipeline::input::steps::StepsFoundBy;
use crate::pipeline::memory::default_memory_bytes;
use crate::pipeline::method::Method;
use crate::pipeline::observer::Observer;
use crate::pipeline::records::output_states::OutputStates;
use crate::pipeline::scheduler::{Scheduler, TaskQueue};

use shared::{FinishedFrame, StageContext, Stages, is_failure, link};

/// What to do when a frame fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnError {
    /// Write exactly the frames before the one that failed.
    Stop,
    /// Go on with the next frame.
    Continue,
}

/// How frames are converted.
#[derive(Clone, Copy, Debug)]
pub struct PipelineOptions<'a> {
    /// Where all computing happens.
    pub pool: &'a ThreadPool,
    /// What to do when a frame fails, or changes while it is read. To stop, frames keep their order: each stage has
    /// one at a time.
    pub on_error: OnError,
    /// Leave frames alone whose outputs are there, made from the same input by the same settings
    /// and the same version of this program.
    pub skip_done: bool,
    /// Write the certificate of each frame beside its outputs, with their hashes. Then a frame is not done without it,
    /// nor with other bytes than those it was written for.
    pub certificates: bool,
    /// As many frames, at most, have been asked for and are not finished; at least one.
    pub in_flight: usize,
    /// As many bytes, about, the frames under way may take together. A frame that needs more by itself is
    /// skinned in tiles that wait on disk; one that cannot be fails, and says what it needs.
    pub memory_bytes: u64,
    /// Who goes through a file with several frames that was written again. Where it is another, reading never waits for that.
    pub steps_found_by: StepsFoundBy,
    /// Folders of outputs that mirror folders of inputs: links below them are not written through, for other accounts may
    /// have made them.
    pub mirrors: &'a [PathBuf],
    /// The recorded states of outputs: a frame is not done if an output has other bytes than were recorded. What is written
    /// is recorded; without `skip_done`, only where a frame fails validation or its outputs have records already. `None`:
    /// bytes are neither recorded nor compared.
    pub output_states: Option<&'a OutputStates>,
    /// Is notified of the stages that frames begin, and how they advance.
    pub observer: Option<&'a dyn Observer>,
}

impl<'a> PipelineOptions<'a> {
    /// On these threads, as `meniscus convert` does it where nobody asks for anything: it goes on when a frame fails,
    /// makes again what is done, writes no certificates, and has [so many](default_in_flight) frames under way and
    /// [so much](default_memory_bytes) memory.
    pub fn new(pool: &'a ThreadPool) -> PipelineOptions<'a> {
        PipelineOptions {
            pool,
            on_error: OnError::Continue,
            skip_done: false,
            certificates: false,
            in_flight: default_in_flight(pool.current_num_threads()),
            memory_bytes: default_memory_bytes(),
            steps_found_by: StepsFoundBy::Reader,
            mirrors: &[],
            output_states: None,
            observer: None,
        }
    }

    /// What is recorded of the outputs of a frame, as far as records are kept: `None` if one has other bytes than were
    /// recorded, and else what did not hold when the frame was checked.
    pub(super) fn recorded_fault(&self, outputs: &[PathBuf]) -> Option<Option<String>> {
        self.output_states.map_or(Some(None), |states| states.recorded_fault(outputs))
    }

    /// Records the outputs of a frame that were just written, and what did not hold when it was checked, if records are
    /// kept. A fault is saved at once: after an interrupted run nothing else says that the frame failed validation.
    pub(super) fn record(&self, outputs: &[PathBuf], fault: Option<&str>) {
        if let Some(states) = self.output_states
            && (self.skip_done || fault.is_some() || states.has_any(outputs))
        {
            states.record(outputs, fault);
            if fault.is_some()
                && let Some(folder) = outputs.first().and_then(|path| path.parent())
            {
                // What fails here is tried again at the end of the run, and reported there.
                let _ = states.save(folder);
            }
        }
    }
}

/// How many frames it takes to keep this many threads busy: one for each, and some that are read or written.
pub fn default_in_flight(threads: usize) -> usize {
    threads + writer_count(threads) + 1
}

/// Encoding takes a small part of the time of computing; waiting for the disk need not be waited for.
fn writer_count(thread_count: usize) -> usize {
    thread_count / 2 + 1
}

/// Converts the frames of a list; `finished` hears of each, by its index and in order, as soon as all
/// before it are finished.
pub fn run<M: Method>(
    method: &M,
    frames: &[Frame],
    options: &PipelineOptions<'_>,
    mut finished: impl FnMut(usize, Outcome),
) {
    let mut frames = frames.iter().cloned().enumerate();
    let mut early = BTreeMap::new();
    let mut is_stopped = false;
    let mut finished_count = 0;
    stream(
        method,
        || frames.next(),
        options,
        |index, _, outcome| {
            early.insert(index, outcome);
            while let Some(outcome) = early.remove(&finished_count) {
                // A frame after the one that failed may have failed before it.
                let outcome = if is_stopped { Outcome::NotStarted } else { outcome };
                is_stopped |= options.on_error == OnError::Stop && is_failure(&outcome);
                finished(finished_count, outcome);
                finished_count += 1;
            }
        },
    );
}

/// Converts the frames that `next` returns, until it returns `None`. It is asked when there is room for one
/// frame more, and may block. `K` is what the caller knows the frame by. `finished` hears of each frame as
/// soon as its outcome is known, in whatever order, on the thread of the caller.
pub fn stream<M: Method, K: Send>(
    method: &M,
    next: impl FnMut() -> Option<(K, Frame)> + Send,
    options: &PipelineOptions<'_>,
    finished: impl FnMut(K, Frame, Outcome),
) {
    let shared = StageContext::new(method, options);
    let tasks = TaskQueue::default();
    options.pool.in_place_scope(|scope| {
        let stages = Stages { shared: &shared, scheduler: Scheduler::new(scope, &tasks) };
        drive(&stages, next, finished);
    });
}

/// Starts the threads of the stages, and reports the outcomes of the frames.
fn drive<'scope, 'env: 'scope, M: Method, K: Send + 'env>(
    stages: &Stages<'_, 'scope, 'env, M>,
    next: impl FnMut() -> Option<(K, Frame)> + Send,
    mut finished: impl FnMut(K, Frame, Outcome),
) {
    let options = stages.shared.options;
    let in_flight = options.in_flight.max(1);
    // As many frames at most, in each stage and behind it.
    let width = match options.on_error {
        OnError::Stop => 1,
        OnError::Continue => options.pool.current_num_threads().min(in_flight),
    };
    let (room, no_room) = bounded(in_flight);
    // A thread of the pool never waits to report an outcome.
    let (done, outcomes) = bounded(in_flight);
    let (to_rasterize, to_rasterize_from) = bounded(0);
    let (to_smooth, to_smooth_from) = link(width);
    let (to_contour, to_contour_from) = link(width);
    let (to_write, to_write_from) = link(width);
    thread::scope(move |scope| {
        for _ in 0..writer_count(width) {
            let (from, done) = (to_write_from.clone(), done.clone());
            scope.spawn(move || stages.write(&from, &done));
        }
        let reader_done = done.clone();
        scope.spawn(move || stages.read(next, &room, &to_rasterize, &reader_done));
        let of_stage = done.clone();
        scope.spawn(move || stages.rasterize(&to_rasterize_from, &to_smooth, &of_stage));
        let of_stage = done.clone();
        scope.spawn(move || stages.smooth(&to_smooth_from, &to_contour, &of_stage));
        scope.spawn(move || stages.contour(&to_contour_from, &to_write, &done));
        // The stages end when the one before has: this thread's own end of a channel must not keep them.
        drop(to_write_from);
        for FinishedFrame { key, frame, outcome } in outcomes {
            finished(key, frame, outcome);
            // There is a token in it for each frame that is not finished.
            let _ = no_room.try_recv();
        }
    });
}
