//! What can go wrong with a file, told so that its owner can mend it.
//!
//! Five kinds, because they call for five different reactions: `Io` may pass by itself, `Short` may
//! pass when whoever writes the file goes on, `Invalid` needs the file to change, `Unsupported` needs
//! this program to change, `TooLarge` needs a limit to change. The name of the file is added by
//! whoever opened it.

use std::fmt;

/// A result with this crate's error.
pub type Result<T> = std::result::Result<T, Error>;

/// Where in a file something was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Bytes from the start of the (decompressed) file.
    Offset(u64),
    /// Line number, from 1.
    Line(u64),
    /// The file as a whole.
    File,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Place::Offset(offset) => write!(f, "at byte {offset}"),
            Place::Line(line) => write!(f, "at line {line}"),
            Place::File => write!(f, "in the file"),
        }
    }
}

/// Why a file could not be read or written.
#[derive(Debug)]
pub enum Error {
    /// The operating system refused.
    Io(std::io::Error),
    /// The file ends too soon. What there is of it may be the beginning of a good one.
    Short {
        /// The format as users know it, such as `PLY`; nothing where there is too little to tell.
        format: &'static str,
        /// Where.
        place: Place,
        /// One sentence: what was expected and what was found.
        what: String,
    },
    /// The file contradicts its own format.
    Invalid {
        /// The format as users know it, such as `PLY`.
        format: &'static str,
        /// Where.
        place: Place,
        /// One sentence: what was expected and what was found.
        what: String,
    },
    /// The file is fine as far as can be told; this program does not read it.
    Unsupported {
        /// The format as users know it, such as `Houdini JSON geometry`.
        format: &'static str,
        /// One sentence: what it is, and what to do instead.
        what: String,
    },
    /// The file asks for more than the given [`crate::Limits`].
    TooLarge {
        /// The format as users know it.
        format: &'static str,
        /// One sentence: what was asked for and what the limit is.
        what: String,
    },
}

impl Error {
    /// An [`Error::Short`].
    pub fn short(format: &'static str, place: Place, what: impl Into<String>) -> Error {
        Error::Short { format, place, what: what.into() }
    }

    /// An [`Error::Invalid`].
    pub fn invalid(format: &'static str, place: Place, what: impl Into<String>) -> Error {
        Error::Invalid { format, place, what: what.into() }
    }

    /// An [`Error::Unsupported`].
    pub fn unsupported(format: &'static str, what: impl Into<String>) -> Error {
        Error::Unsupported { format, what: what.into() }
    }

    /// An [`Error::TooLarge`].
    pub fn too_large(format: &'static str, what: impl Into<String>) -> Error {
        Error::TooLarge { format, what: what.into() }
    }

    /// The same error under the name of another format, which holds what was being read.
    pub(crate) fn of_format(self, format: &'static str) -> Error {
        match self {
            Error::Short { place, what, .. } => Error::Short { format, place, what },
            Error::Invalid { place, what, .. } => Error::Invalid { format, place, what },
            Error::Unsupported { what, .. } => Error::Unsupported { format, what },
            Error::TooLarge { what, .. } => Error::TooLarge { format, what },
            Error::Io(source) => Error::Io(source),
        }
    }

    /// The same error of a file that has so many more lines before those that were read.
    pub fn lines_later(mut self, count: u64) -> Error {
        if let Error::Short { place: Place::Line(line), .. }
        | Error::Invalid { place: Place::Line(line), .. } = &mut self
        {
            *line = line.saturating_add(count);
        }
        self
    }

    /// Whether the file ends too soon, so that it may still be growing.
    pub fn is_short(&self) -> bool {
        matches!(self, Error::Short { .. })
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Error::Io(source) => write!(f, "{source}"),
            // What is wrong with a file that has no format yet is wrong with all of it.
            Error::Short { format: "", what, .. } | Error::Invalid { format: "", what, .. } => {
                f.write_str(what)
            }
            Error::Short { format, place: Place::File, what }
            | Error::Invalid { format, place: Place::File, what } => write!(f, "{format}: {what}"),
            Error::Short { format, place, what } | Error::Invalid { format, place, what } => {
                write!(f, "{format}, {place}: {what}")
            }
            Error::Unsupported { format: "", what } => f.write_str(what),
            Error::Unsupported { format, what } => write!(f, "{format}: {what}"),
            Error::TooLarge { format, what } => write!(f, "{format}: {what}"),
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

impl From<std::io::Error> for Error {
    fn from(source: std::io::Error) -> Error {
        Error::Io(source)
    }
}
