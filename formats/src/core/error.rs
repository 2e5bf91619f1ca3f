//! Errors of readers and writers, with enough detail for users to fix their files.
//!
//! The kinds differ because they call for different reactions. `Io` may be temporary. `Truncated` may
//! disappear when the program that writes the file continues. `Invalid` means that the file must change,
//! `Unsupported` that this program must change, and `TooLarge` and `MemoryLimit` that a limit must change.
//! The caller, which opened the file, adds the name of the file.

use std::{fmt, io};

use crate::core::text::excerpt;

/// A result with this crate's error type.
pub type Result<T> = std::result::Result<T, Error>;

/// A location in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Position {
    /// Offset in bytes from the start of the (decompressed) file.
    Offset(u64),
    /// Line number, starting at 1.
    Line(u64),
    /// The file as a whole.
    File,
}

impl fmt::Display for Position {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Position::Offset(offset) => write!(f, "at byte {offset}"),
            Position::Line(line) => write!(f, "at line {line}"),
            Position::File => write!(f, "in the file"),
        }
    }
}

/// Why a file could not be read or written.
#[derive(Debug)]
pub enum Error {
    /// The operating system reported an error.
    Io(io::Error),
    /// The file ends too early. The bytes so far may be the beginning of a valid file.
    Truncated {
        /// The format's name, such as `PLY`; empty if the file is too short to recognise.
        format: &'static str,
        /// Location of the error.
        position: Position,
        /// One sentence: what was expected and what was found.
        what: String,
    },
    /// The file violates its format.
    Invalid {
        /// The format's name, such as `PLY`.
        format: &'static str,
        /// Location of the error.
        position: Position,
        /// One sentence: what was expected and what was found.
        what: String,
    },
    /// The file seems valid, but this program does not support it.
    Unsupported {
        /// The format's name, such as `Houdini JSON geometry`.
        format: &'static str,
        /// One sentence: what the file is, and what to do instead.
        what: String,
    },
    /// The file exceeds one of the [`crate::Limits`].
    TooLarge {
        /// The format's name.
        format: &'static str,
        /// One sentence: what the file needs and what the limit is.
        what: String,
    },
    /// Reading the file, or using what was read, needs more memory than [`crate::Limits::memory_bytes`].
    MemoryLimit {
        /// What needs the memory, such as "reading the file".
        what: String,
        /// The required memory in MiB, rounded up; `None` if it is only known to be more than the limit.
        needed_mebibytes: Option<u64>,
        /// The limit in MiB, rounded down.
        limit_mebibytes: u64,
    },
}

impl Error {
    /// Creates an [`Error::Truncated`].
    pub fn truncated(format: &'static str, position: Position, what: impl Into<String>) -> Error {
        Error::Truncated { format, position, what: what.into() }
    }

    /// Creates an [`Error::Invalid`].
    pub fn invalid(format: &'static str, position: Position, what: impl Into<String>) -> Error {
        Error::Invalid { format, position, what: what.into() }
    }

    /// Creates an [`Error::Unsupported`].
    pub fn unsupported(format: &'static str, what: impl Into<String>) -> Error {
        Error::Unsupported { format, what: what.into() }
    }

    /// Creates an [`Error::TooLarge`].
    pub fn too_large(format: &'static str, what: impl Into<String>) -> Error {
        Error::TooLarge { format, what: what.into() }
    }

    /// The same error with another format name: that of the container format.
    pub(crate) fn with_format(self, format: &'static str) -> Error {
        match self {
            Error::Truncated { position, what, .. } => Error::Truncated { format, position, what },
            Error::Invalid { position, what, .. } => Error::Invalid { format, position, what },
            Error::Unsupported { what, .. } => Error::Unsupported { format, what },
            Error::TooLarge { what, .. } => Error::TooLarge { format, what },
            Error::Io(_) | Error::MemoryLimit { .. } => self,
        }
    }

    /// The same error about one of several files, which it names.
    pub(crate) fn in_file(mut self, path: &str) -> Error {
        match &mut self {
            Error::Truncated { what, .. }
            | Error::Invalid { what, .. }
            | Error::Unsupported { what, .. }
            | Error::TooLarge { what, .. } => *what = format!("{}: {what}", excerpt(path)),
            Error::Io(source) => {
                *source = io::Error::new(source.kind(), format!("{}: {source}", excerpt(path)))
            }
            Error::MemoryLimit { .. } => {}
        }
        self
    }

    /// The same error with its line number increased by `count`, for a reader that started `count` lines into
    /// the file.
    pub fn with_line_offset(mut self, count: u64) -> Error {
        if let Error::Truncated { position: Position::Line(line), .. }
        | Error::Invalid { position: Position::Line(line), .. } = &mut self
        {
            *line = line.saturating_add(count);
        }
        self
    }

    /// Whether the file ends too early, which can mean that it is still being written.
    pub fn is_truncated(&self) -> bool {
        matches!(self, Error::Truncated { .. })
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Error::Io(source) => write!(f, "{source}"),
            // Without a recognised format, the message alone describes the whole file.
            Error::Truncated { format: "", what, .. } | Error::Invalid { format: "", what, .. } => {
                f.write_str(what)
            }
            Error::Truncated { format, position: Position::File, what }
            | Error::Invalid { format, position: Position::File, what } => write!(f, "{format}: {what}"),
            Error::Truncated { format, position, what } | Error::Invalid { format, position, what } => {
                write!(f, "{format}, {position}: {what}")
            }
            Error::Unsupported { format: "", what } => f.write_str(what),
            Error::Unsupported { format, what } => write!(f, "{format}: {what}"),
            Error::TooLarge { format, what } => write!(f, "{format}: {what}"),
            Error::MemoryLimit { what, needed_mebibytes: Some(needed), limit_mebibytes: limit } => write!(
                f,
                "{what} needs {needed} MiB of memory, and the limit is {limit} MiB: use --memory {needed}MiB or more"
            ),
            Error::MemoryLimit { what, needed_mebibytes: None, limit_mebibytes: limit } => {
                write!(f, "{what} needs more than {limit} MiB of memory, the limit: use a larger --memory")
            }
        }
    }
}

impl std::error::Error for Error {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Error::Io(source) => Some(source),
            _ => None,
        }
    }
}

impl From<io::Error> for Error {
    fn from(source: io::Error) -> Error {
        Error::Io(source)
    }
}
