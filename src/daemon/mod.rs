//! Folders to frames: watches, settles, queues, remembers.

mod config;
pub mod decision;
pub mod journal;
pub mod lock;
pub mod mounts;
pub mod readiness;
pub mod scan;
pub mod selection;
pub mod watcher;

use std::fmt;

use crossbeam::channel::Receiver;

pub use config::{Config, Order, Patience, Poll, Watch};

/// What the outside asks of a running daemon.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Finish what is under way, within the deadline, and end.
    Finish,
    /// The same; the caller then runs it again, with another configuration.
    Reload,
}

/// What a running daemon tells the outside.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Notice {
    /// It watches, and has looked at everything once.
    Ready,
    /// What it is doing, in a line.
    Status(String),
    /// It is alive: at least every two seconds.
    Alive,
    /// It begins to finish.
    Stopping,
}

/// What came of a run.
#[derive(Clone, Debug)]
pub struct Summary {
    /// Why it ended.
    pub ended: Ended,
    /// Frames whose outputs are there: made in this run, or found done.
    pub done_count: usize,
    /// A sentence for each frame that failed.
    pub failed: Vec<String>,
    /// Frames that were seen and are left for the next time.
    pub left_count: usize,
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

/// Why the daemon cannot work.
#[derive(Debug)]
pub struct DaemonError {
    /// What is wrong.
    pub what: String,
}

impl fmt::Display for DaemonError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)
    }
}

impl std::error::Error for DaemonError {}

/// Watches and converts until it is told to end, or, with `once`, until everything is done.
///
/// # Errors
/// When it cannot work at all.
pub fn run(
    config: &Config,
    _commands: &Receiver<Command>,
    _notices: &mut dyn FnMut(Notice),
) -> Result<Summary, DaemonError> {
    let folder_count = config.watches.len();
    Err(DaemonError { what: format!("the loop that watches {folder_count} folders is not there yet") })
}
