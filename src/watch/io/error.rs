//! Why a daemon cannot run.

use std::fmt;
use std::path::PathBuf;

use crate::pipeline::OutFolderError;

use super::lock::LockError;
use super::selection::PatternError;

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
        source: std::io::Error,
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
