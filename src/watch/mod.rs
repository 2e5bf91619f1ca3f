//! Folders to frames: watches, settles, queues, remembers.
//!
//! ```text
//!   watcher ──hints──▶ ┌──────────┐ ──queue──▶ pipeline: read ─▶ rasterize ─▶ smooth ─▶ contour ─▶ write
//!   scans ────────────▶│          │ ◀─outcomes─┘
//!   commands ─────────▶│ the loop │ ──▶ journal: what was done, and what failed
//!                      │          │ ◀──▶ a thread that measures spacings
//!                      └──────────┘ ◀──▶ a thread that goes through files for their steps
//!
//!   root       a watched folder, there or not     scan, watcher   what is in it, what has changed
//!   readiness  when a file is complete            sequences       settings, fixed once for each sequence
//!   frames     how far each frame is              hints           what was heard, what scans say
//!   rounds     the loop itself                    queue           which frame is next
//!   steps      files with several frames
//!   outcomes   what became of it                  retry, room     what is tried again, and when
//!   journal    what is known after a restart      decision        why a frame is, or is not, converted
//!   lock       one daemon for one folder          explain         the same, for whoever asks
//!   showing    what there is to see of all that
//! ```
//!
//! One thread has all the state and works at its own pace. What comes from outside is a hint, and
//! only makes it look sooner: an event says that a file may have changed, a scan says what is there. So
//! an event that is lost, doubled or late changes nothing but the time.
//!
//! What is remembered is an append-only journal that may be lost, for the outputs say themselves what
//! they were made from; what is written appears by rename. So a daemon may be killed at any moment.

pub mod board;
mod config;
pub mod decision;
mod evidence;
pub mod explain;
mod frames;
mod hints;
pub mod journal;
pub mod lock;
mod looking;
mod measuring;
pub mod mounts;
mod outcomes;
pub mod place;
mod queue;
pub mod readiness;
mod rescans;
mod retry;
mod room;
mod root;
mod rounds;
pub mod scan;
pub mod selection;
mod sequences;
mod showing;
mod steps;
mod stores;
pub mod waiting;
pub mod watcher;

use std::fmt;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use crossbeam::channel::{Receiver, bounded, unbounded};
use rayon::ThreadPoolBuilder;

pub use config::{Config, Order, Patience, Poll, Watch, names_level_sets};

use crate::pipeline::{
    Frame, LevelSetSkinning, Observer, OnError, OutFolderError, OutputStates, PipelineOptions, Stage,
    StepsFoundBy, stream,
};
use crate::watch::board::Board;

use frames::FrameId;
use lock::LockError;
use queue::Queue;
use rounds::Daemon;
use selection::PatternError;

/// What may be asked of a running daemon.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Finish the frames under way, and end.
    Finish,
    /// The same, to begin again with another configuration.
    Reload,
}

/// What a running daemon tells whoever runs it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Notice {
    /// Everything was looked at once, and from now on changes are heard.
    Ready,
    /// Where it is, in one line.
    Status(String),
    /// It is not stuck. Comes at least every two seconds.
    Alive,
    /// No further frame is begun.
    Stopping,
    /// The time for finishing the frames under way is over: whoever is in a hurry may end the process.
    Overdue,
}

/// What came of a run.
#[derive(Clone, Debug)]
pub struct Summary {
    /// Why it ended.
    pub ended: Ended,
    /// Frames whose outputs are there: made in this run, or found done.
    pub done_count: usize,
    /// Those among them whose results break a guarantee.
    pub broken_count: usize,
    /// Each frame that failed, in natural order.
    pub failed: Vec<FailedFrame>,
    /// Frames that were seen and are left for the next time.
    pub left_count: usize,
}

/// A frame that failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FailedFrame {
    /// A sentence: which frame, and why.
    pub what: String,
    /// How many frames were finished since that was told; `None` if it was known from an earlier run, and not told in
    /// this one.
    pub frames_since: Option<usize>,
}

/// Why a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// Everything that was there is done, and that was all that was asked for.
    Drained,
    /// By [`Command::Finish`].
    Finish,
    /// By [`Command::Reload`].
    Reload,
}

/// Why a daemon cannot run.
#[derive(Debug)]
pub enum DaemonError {
    /// A folder takes no outputs.
    Out(OutFolderError),
    /// A folder of outputs cannot be looked at, or its journal not be opened.
    Folder {
        /// Which.
        folder: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Somebody else has the folder of the outputs.
    Locked(LockError),
    /// A pattern is none.
    Pattern(PatternError),
    /// A folder that is to be converted once is not there.
    Unavailable {
        /// Which.
        folder: PathBuf,
        /// Why.
        why: String,
    },
    /// The system refuses to start threads, or one has ended before its time.
    Threads(String),
}

impl fmt::Display for DaemonError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            DaemonError::Out(error) => write!(f, "{error}"),
            DaemonError::Folder { folder, source } => write!(f, "{}: {source}", folder.display()),
            DaemonError::Locked(error) => write!(f, "{error}"),
            DaemonError::Pattern(error) => write!(f, "{error}"),
            DaemonError::Unavailable { folder, why } => write!(f, "{}: {why}", folder.display()),
            DaemonError::Threads(why) => write!(f, "the threads: {why}"),
        }
    }
}

impl std::error::Error for DaemonError {}

/// Watches and converts until a command ends it, or, where that is all that was asked for, until
/// everything is converted. What there is to see of it is shown on the `board`, if there is one.
///
/// # Errors
/// When it cannot begin. What happens to single frames is no error here: it is logged, kept in the
/// journal and counted.
pub fn run(
    config: &Config,
    board: Option<&Board>,
    commands: &Receiver<Command>,
    notices: &mut dyn FnMut(Notice),
) -> Result<Summary, DaemonError> {
    let pool = ThreadPoolBuilder::new()
        .num_threads(config.threads)
        .thread_name(|index| format!("compute {index}"))
        .build()
        .map_err(|error| DaemonError::Threads(error.to_string()))?;
    let queue = Queue::new(config.order);
    let (to_loop, outcomes) = bounded(config.in_flight);
    let (to_measure, orders) = unbounded();
    let (to_loop_measured, measured) = unbounded();
    let (to_find_steps, steps_orders) = unbounded();
    let (to_loop_found, found_steps) = unbounded();
    let output_states = OutputStates::default();
    let daemon = Daemon::open(config, board, (&queue, &output_states), (to_measure, to_find_steps), notices)?;
    let mirrors: Vec<PathBuf> = daemon.stores.iter().map(|store| store.folder.clone()).collect();
    let pipeline_options = PipelineOptions {
        pool: &pool,
        on_error: OnError::Continue,
        skip_done: true,
        certificates: false,
        in_flight: config.in_flight,
        memory_bytes: config.memory_bytes,
        // There is a thread for that.
        steps_found_by: StepsFoundBy::Another,
        mirrors: &mirrors,
        output_states: Some(&output_states),
        observer: board.map(|board| board as &dyn Observer),
    };
    let is_over = AtomicBool::new(false);
    let (queue, pool, is_over) = (&queue, &pool, &is_over);
    thread::scope(|scope| {
        scope.spawn(move || {
            // Nobody listens only when the loop is gone, and then nobody needs to know.
            stream(
                &LevelSetSkinning,
                || queue.next(),
                &pipeline_options,
                |root, frame, outcome| {
                    let _ = to_loop.send((FrameId::new(root, &frame.input), frame, outcome));
                },
            );
        });
        scope.spawn(move || {
            for order in orders {
                if to_loop_measured.send(pool.install(|| sequences::measure(order))).is_err() {
                    return;
                }
            }
        });
        scope.spawn(move || {
            for order in steps_orders {
                if to_loop_found.send(steps::find_steps(order, is_over)).is_err() {
                    return;
                }
            }
        });
        // Frames under way are finished, whatever ends the loop: the scope waits for them. It would wait
        // for ever for these threads if what they listen to outlived the loop.
        let _closing = Closing(queue, is_over);
        let (outcomes, measured, found_steps) = (outcomes, measured, found_steps);
        let mut daemon = daemon;
        daemon.run(commands, &outcomes, &measured, &found_steps)
    })
}

impl Observer for Board {
    fn began(&self, frame: &Frame, stage: Stage) {
        self.stage_began(&frame.outputs.folder.join(&frame.stem), stage);
    }
}

/// Closes the queue when the loop ends, and says that it is over, also where it ends in a panic.
struct Closing<'a>(&'a Queue, &'a AtomicBool);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        self.0.close();
        self.1.store(true, Ordering::Relaxed);
    }
}
