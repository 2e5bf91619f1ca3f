//! The errors of a daemon as a whole; a frame that fails has a [`FrameError`](crate::pipeline::FrameError).

use std::fmt;
use std::path::PathBuf;

use crate::pipeline::OutFolderError;

use super::lock::LockError;
use super::selection::PatternError;

/// Why a daemon cannot run.
#[derive(Debug)]
pub enum DaemonError {
    /// A folder cannot take outputs.
    OutFolderRefused(OutFolderError),
    /// A folder of outputs, or its records, cannot be read.
    OutFolderUnreadable {
        /// The folder.
        folder: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// Another process has locked the folder of outputs.
    Locked(LockError),
    /// A pattern is invalid.
    Pattern(PatternError),
    /// A watched folder is unavailable, and `once` does not wait for it.
    Unavailable {
        /// The folder.
        folder: PathBuf,
        /// The cause.
        why: String,
    },
    /// The system refuses to start a thread.
    Threads(std::io::Error),
    /// The pipeline ended although nothing stopped it: a bug.
    PipelineEnded,
}

impl fmt::Display for DaemonError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            DaemonError::OutFolderRefused(error) => write!(f, "{error}"),
            DaemonError::OutFolderUnreadable { folder, source } => {
                write!(f, "{}: {source}", folder.display())
            }
            DaemonError::Locked(error) => write!(f, "{error}"),
            DaemonError::Pattern(error) => write!(f, "{error}"),
            DaemonError::Unavailable { folder, why } => write!(f, "{}: {why}", folder.display()),
            DaemonError::Threads(why) => write!(f, "cannot run the daemon's threads: {why}"),
            DaemonError::PipelineEnded => f.write_str(
                "the pipeline ended unexpectedly, which is a bug: restart the daemon, and report the bug with \
                 the log",
            ),
        }
    }
}

impl std::error::Error for DaemonError {}
