//! The stages of a frame, joined by bounded channels.
//!
//! ```text
//!   next ──▶ read ──▶ rasterize ──▶ smooth ──▶ contour ══▶ write ──▶ finished
//!    ▲      1 thread     └── a lane for each core ──┘     some threads   │
//!    └────────────── as many frames as may be in flight ─────────────────┘
//! ```
//!
//! Several frames are under way at once, and a slow stage holds back the ones before it. The next frame is
//! asked for only when there is room for one, so that whoever is asked can decide late which it is.
//!
//! The three stages of the method compute in one pool of threads, a frame in each of as many *seats* as the
//! pool has threads. When several frames are there, each thread has one of its own and none waits for
//! another; when there is one, the others have nothing better to do than to take their share of it. A frame
//! keeps its seat from rasterizing to the end of contouring: nothing half computed waits and costs memory.
//! What the frames take together is bounded by a [budget](super::budget), too.
//!
//! `line` has what the stages share; `read`, `compute` and `write` are its threads.
//!
//! Each stage runs under `catch_unwind`: a broken invariant costs its own frame only. A frame that failed,
//! or was done already, leaves at once and overtakes others; [`run`] puts outcomes back in order.

mod compute;
mod line;
mod read;
mod write;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::thread;

use crossbeam::channel::bounded;
use rayon::ThreadPool;

use super::crew::{Crew, Tasks};
use super::frame::{Frame, Outcome, Stage};
use super::memory::default_memory_bytes;
use super::method::Method;
use super::observer::Observer;
use super::output_states::OutputStates;
use super::steps::StepsFoundBy;

use line::{Ended, Line, is_failure};

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
pub struct Conduct<'a> {
    /// Where all computing happens.
    pub pool: &'a ThreadPool,
    /// What to do when a frame fails, or changes while it is read. To stop, frames keep their order
    /// on the whole way: one at a time in each stage.
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
    /// Hears how frames advance.
    pub observer: Option<&'a dyn Observer>,
}

impl<'a> Conduct<'a> {
    /// On these threads, as `meniscus convert` does it where nobody asks for anything: it goes on when a frame fails,
    /// makes again what is done, writes no certificates, and has [so many](default_in_flight) frames under way and
    /// [so much](default_memory_bytes) memory.
    pub fn new(pool: &'a ThreadPool) -> Conduct<'a> {
        Conduct {
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

/// How many frames it takes to keep so many threads busy: one for each, and some that are read or written.
pub fn default_in_flight(threads: usize) -> usize {
    threads + writer_count(threads) + 1
}

/// Encoding takes a small part of the time of computing; waiting for the disk need not be waited for.
fn writer_count(lane_count: usize) -> usize {
    lane_count / 2 + 1
}

/// Converts the frames of a list; `finished` hears of each, by its index and in order, as soon as all
/// before it are finished.
pub fn run<M: Method>(
    method: &M,
    frames: &[Frame],
    conduct: &Conduct<'_>,
    mut finished: impl FnMut(usize, Outcome),
) {
    let mut frames = frames.iter().cloned().enumerate();
    let mut early = BTreeMap::new();
    let mut is_stopped = false;
    let mut told_count = 0;
    stream(
        method,
        || frames.next(),
        conduct,
        |index, _, outcome| {
            early.insert(index, outcome);
            while let Some(outcome) = early.remove(&told_count) {
                // A frame after the one that failed may have failed before it.
                let outcome = if is_stopped { Outcome::NotStarted } else { outcome };
                is_stopped |= conduct.on_error == OnError::Stop && is_failure(&outcome);
                finished(told_count, outcome);
                told_count += 1;
            }
        },
    );
}

/// Converts the frames that `next` returns, until it returns `None`. It is asked when there is room for one
/// frame more, and may block. `K` is the caller's own word for the frame. `finished` hears of each frame as
/// soon as it is known what came of it, in whatever order, on the thread of the caller.
pub fn stream<M: Method, K: Send>(
    method: &M,
    next: impl FnMut() -> Option<(K, Frame)> + Send,
    conduct: &Conduct<'_>,
    finished: impl FnMut(K, Frame, Outcome),
) {
    stream_seen(method, &|_, _| {}, next, conduct, finished);
}

/// The same; `began` hears of each stage that a frame begins, on the thread of the stage: it must be quick.
pub fn stream_seen<M: Method, K: Send>(
    method: &M,
    began: &(dyn Fn(&Frame, Stage) + Sync),
    next: impl FnMut() -> Option<(K, Frame)> + Send,
    conduct: &Conduct<'_>,
    finished: impl FnMut(K, Frame, Outcome),
) {
    let lane_count = match conduct.on_error {
        OnError::Stop => 1,
        OnError::Continue => conduct.pool.current_num_threads().min(conduct.in_flight).max(1),
    };
    let tasks = Tasks::default();
    conduct.pool.in_place_scope(|scope| {
        let line = Line::new(method, began, conduct, Crew::new(scope, &tasks), lane_count);
        drive(&line, lane_count, next, finished);
    });
}

/// Starts the threads of the stages, and tells what they make of the frames.
fn drive<M: Method, K: Send>(
    line: &Line<'_, '_, '_, M>,
    lane_count: usize,
    next: impl FnMut() -> Option<(K, Frame)> + Send,
    mut finished: impl FnMut(K, Frame, Outcome),
) {
    let (room, no_room) = bounded(line.conduct.in_flight.max(1));
    let (done, outcomes) = bounded(1);
    let (to_rasterize, to_rasterize_from) = bounded(0);
    let (to_smooth, to_smooth_from) = bounded(0);
    let (to_contour, to_contour_from) = bounded(0);
    let (to_write, to_write_from) = bounded(1);
    thread::scope(move |scope| {
        for _ in 0..lane_count {
            let (from, to, ended) = (to_rasterize_from.clone(), to_smooth.clone(), done.clone());
            scope.spawn(move || line.rasterize(&from, &to, &ended));
            let (from, to, ended) = (to_smooth_from.clone(), to_contour.clone(), done.clone());
            scope.spawn(move || line.smooth(&from, &to, &ended));
            let (from, to, ended) = (to_contour_from.clone(), to_write.clone(), done.clone());
            scope.spawn(move || line.contour(&from, &to, &ended));
        }
        for _ in 0..writer_count(lane_count) {
            let (from, ended) = (to_write_from.clone(), done.clone());
            scope.spawn(move || line.write(&from, &ended));
        }
        scope.spawn(move || line.read(next, &room, &to_rasterize, &done));
        // The stages end when the one before has: this thread's own ends of the channels must not keep them.
        drop((to_smooth, to_contour, to_write));
        drop((to_rasterize_from, to_smooth_from, to_contour_from, to_write_from));
        for Ended { key, frame, outcome } in outcomes {
            finished(key, frame, outcome);
            // There is a token in it for each frame that is not finished.
            let _ = no_room.try_recv();
        }
    });
}
