//! Why a frame is in its state. The daemon decides, and stores the reason with the record of the frame, where
//! `status` and the status page find it.

use std::fmt;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::pipeline::files::json::path;

/// Why a frame is in its state. Displays as a clause without a full stop.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    /// It is not read yet: its sentinel is missing, or older than the frame.
    NoSentinel,
    /// It is not read yet: it changed just now.
    Changing,
    /// It is not read yet: its format cannot show whether it is complete.
    Unverifiable,
    /// It is not read yet: it looks complete, but the program that writes it has not closed it.
    Open,
    /// It is not read yet: its format shows that it is incomplete.
    Incomplete {
        /// The minimum size that its header declares, in bytes.
        expected: u64,
        /// Its size, in bytes.
        found: u64,
    },
    /// It is to be converted: nothing is recorded of it.
    New,
    /// It is to be converted: it was written again.
    InputChanged,
    /// It is to be read, and converted if its content has changed: its size has not, but its time or inode.
    Touched,
    /// It is to be read, and converted if its content has changed: the program that wrote it has closed it.
    Closed,
    /// It is to be read, and converted if its content has changed: files that it names have other times, sizes or
    /// inodes.
    NamedFilesChanged,
    /// It is to be converted: its settings or obstacles changed.
    SettingsChanged,
    /// It is to be converted: an output is missing, or is not the file that was written.
    OutputChanged {
        /// The output.
        #[serde(with = "path")]
        output: PathBuf,
    },
    /// It waits for the frames around it, with which it is averaged.
    FramesAround,
    /// It is to be converted: the frames before or after it, with which it is averaged, have changed.
    FramesAroundChanged,
    /// It is to be converted: it was queued or in progress when the daemon exited.
    Interrupted,
    /// It is to be converted: it failed with an error that may be temporary.
    Retry,
    /// It is to be converted: it was refused, and the conflict may be gone.
    ConflictGone,
    /// It waits until the particle spacing of its sequence can be measured.
    NoSpacing,
    /// It waits until the preset of its sequence can be chosen by the particles.
    NoPreset,
    /// It waits until the camera of its sequence can be placed.
    NoCamera,
    /// It is not a frame, but a file of this kind.
    NotAFrame(String),
    /// It is not a frame, but a file with several: their number.
    Steps(usize),
    /// It cannot be converted, for now or for good: an error or a conflict with other files.
    Error(String),
}

impl Reason {
    /// Whether both are the same, except for numbers and names.
    pub(crate) fn is_like(&self, other: &Reason) -> bool {
        std::mem::discriminant(self) == std::mem::discriminant(other)
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Reason::NoSentinel => "its sentinel is missing, or older than the frame",
            Reason::Changing => "it changed just now",
            Reason::Unverifiable => {
                "its format cannot show whether it is complete, so it must be unchanged for 4 times --settle"
            }
            Reason::Open => "the program that writes it still has it open",
            Reason::Incomplete { expected, found } => {
                return write!(f, "it is not complete: {found} of at least {expected} bytes");
            }
            Reason::New => "it is new",
            Reason::InputChanged => "it was written again",
            Reason::Touched => "its time or inode has changed: its content is compared",
            Reason::Closed => "the program that wrote it has closed it: its content is compared",
            Reason::NamedFilesChanged => "files that it names have changed: its content is compared",
            Reason::SettingsChanged => "its settings or obstacles have changed since it was converted",
            Reason::OutputChanged { output } => {
                return write!(f, "its output {} is missing or was changed", output.display());
            }
            Reason::FramesAround => {
                "it waits for the frames around it, on which it depends: see --temporal-wait"
            }
            Reason::FramesAroundChanged => {
                "the frames before or after it have changed since it was converted"
            }
            Reason::Interrupted => "the daemon exited before it finished the frame",
            Reason::Retry => "it failed with an error that may be temporary",
            Reason::ConflictGone => "it was refused for a reason that may be gone now",
            Reason::NoSpacing => {
                "cannot measure the particle spacing yet, because no frame of the sequence has 16 particles: \
                 waiting for one that has; or give --spacing"
            }
            Reason::NoPreset => {
                "cannot choose the preset by the particles yet, because no frame of the sequence has 16: \
                 waiting for one that has; or give a --preset other than auto"
            }
            Reason::NoCamera => {
                "cannot place the camera of the pictures yet, because no frame of the sequence has \
                 particles: waiting for one that has; or give eye, target and ground in --camera"
            }
            Reason::NotAFrame(kind) => return write!(f, "it is {kind}"),
            Reason::Steps(count) => return write!(f, "it has {count} steps, each of which is a frame"),
            Reason::Error(error) => error,
        })
    }
}
