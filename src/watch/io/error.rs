//! Why a daemon cannot run.

use std::fmt;
use std::path::PathBuf;

use crate::pipeline::OutFolderError;

use super::lock::LockError;
use super::selection::PatternError;

/// Why a daemon cannot run.
#[derive(Debug)]
pub enum DaemonError {
    /// A folder cannot hold outputs.
    Out(OutFolderError),
    /// A folder of outputs cannot be read, or its records cannot be read.
    Folder {
        /// The folder.
        folder: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// Another process has locked the folder of outputs.
    Locked(LockError),
    /// A pattern is invalid.
    Pattern(PatternError),
    /// A folder that is to be converted once is unavailable.
    Unavailable {
        /// The folder.
        folder: PathBuf,
        /// The cause.
        why: String,
    },
    /// The system refuses to start a thread, or a thread has ended early.
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
            DaemonError::Threads(why) => write!(f, "cannot run the daemon's threads: {why}"),
        }
    }
}

impl std::error::Error for DaemonError {}
