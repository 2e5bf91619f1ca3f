//! Why a frame was not converted, or a run cannot begin.

use std::any::Any;
use std::fmt;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use crate::surface::options::SettingsError;
use crate::surface::reconstruction::{TooLarge, VoxelTooSmall};

use crate::pipeline::files::number_pattern::is_link_loop;
use crate::pipeline::files::out_folder::is_disk_full;
use crate::pipeline::files::shown::shown;

/// The stages of a frame, as shown to users.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// File to particles.
    Read,
    /// Particles to level sets.
    Rasterize,
    /// Smoothing.
    Smooth,
    /// Level set to mesh.
    Contour,
    /// Mesh and level set to files.
    Write,
    /// Level set to pictures.
    Preview,
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Stage::Read => "read",
            Stage::Rasterize => "rasterize",
            Stage::Smooth => "smooth",
            Stage::Contour => "contour",
            Stage::Write => "write",
            Stage::Preview => "preview",
        })
    }
}

/// Why a frame was not converted.
#[derive(Debug)]
pub struct FrameError {
    /// The file that caused the error: the input, or the output that could not be written. For
    /// [`Cause::Scratch`], the path of the outputs without an extension, because scratch files are in their
    /// folder.
    pub path: PathBuf,
    /// The stage that failed.
    pub during: Stage,
    /// Why.
    pub cause: Cause,
}

/// The cause of an error.
#[derive(Debug)]
pub enum Cause {
    /// The file is invalid, or the system reports an error.
    File(meniscus_formats::Error),
    /// The input was written, replaced or removed while it was read.
    Changed,
    /// An output would replace a file that may be the only copy of its data.
    Conflict(Box<Conflict>),
    /// An obstacle cannot be read.
    Obstacle(Box<ObstacleError>),
    /// The particles lack an attribute that the settings require, or its values are unusable.
    Missing(String),
    /// The settings are invalid for the voxel size of a level set.
    Settings(SettingsError),
    /// The frame does not fit into the memory limit.
    TooLarge(TooLarge),
    /// The voxels are too small for the frame.
    VoxelTooSmall(VoxelTooSmall),
    /// Scratch files could not be written to disk beside the outputs.
    Scratch(io::Error),
    /// A bug in this program: a broken invariant, with the panic's message.
    Panic(String),
}

/// An error in an obstacle of a frame.
#[derive(Debug)]
pub struct ObstacleError {
    /// The obstacle's file; for a moving obstacle, the file for this frame.
    pub path: PathBuf,
    /// Why it cannot be read; `None` if it was written during the read.
    pub source: Option<meniscus_formats::Error>,
}

impl fmt::Display for ObstacleError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "obstacle {}: ", self.path.display())?;
        match &self.source {
            Some(source) => source.fmt(f),
            None => f.write_str("changed while it was read"),
        }
    }
}

/// Why a run cannot begin, or a frame cannot be converted.
#[derive(Debug)]
pub enum Conflict {
    /// An output would replace an input or an obstacle, or would later be read as one.
    Replaces {
        /// The output.
        output: PathBuf,
        /// What it would do: `would replace the input`.
        fault: &'static str,
        /// The path or the pattern of the other file, as given.
        file: PathBuf,
    },
    /// Two files that the run writes have the same path.
    SameOutput {
        /// Their path.
        output: PathBuf,
        /// What they are made from, or what they are.
        makers: [String; 2],
        /// What to do.
        remedy: String,
    },
    /// An output would replace particles, or a mesh or a level set of another program.
    ReplacesData {
        /// The output.
        output: PathBuf,
    },
}

impl fmt::Display for Conflict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Conflict::Replaces { output, fault, file } => write!(
                f,
                "the output {} {fault} {}: choose another folder or format",
                output.display(),
                file.display()
            ),
            Conflict::SameOutput { output, makers: [first, second], remedy } => {
                write!(f, "{first} and {second} would both become {}: {remedy}", output.display())
            }
            Conflict::ReplacesData { output } => write!(
                f,
                "the output {} would replace a file that is not a surface of meniscus, or is only the beginning of one: \
                 move that file away, or choose another folder or format",
                output.display()
            ),
        }
    }
}

impl std::error::Error for Conflict {}

impl FrameError {
    /// An error caused by a file.
    pub fn file(path: &Path, during: Stage, source: impl Into<meniscus_formats::Error>) -> FrameError {
        FrameError { path: path.to_owned(), during, cause: Cause::File(source.into()) }
    }

    /// Whether an output could not be written because the disk or a quota is full: the write can succeed once
    /// there is space.
    pub fn is_disk_full(&self) -> bool {
        let source = match &self.cause {
            Cause::File(meniscus_formats::Error::Io(source)) if self.during == Stage::Write => source,
            Cause::Scratch(source) => source,
            _ => return false,
        };
        is_disk_full(source)
    }

    /// Whether the machine failed, its disk or a shared folder, and not the input or its settings: the frame may
    /// succeed elsewhere or later.
    pub fn is_of_machine(&self) -> bool {
        match &self.cause {
            Cause::File(meniscus_formats::Error::Io(source)) => is_error_of_machine(source),
            Cause::Scratch(_) => true,
            _ => false,
        }
    }

    /// Runs `work` on the frame at `path`; a panic becomes an error of this frame.
    ///
    /// # Errors
    /// If `work` panics, with the panic's message.
    pub fn catch<T>(path: &Path, during: Stage, work: impl FnOnce() -> T) -> Result<T, FrameError> {
        // All state that `work` changes is dropped with the frame, so no other code sees it in an
        // inconsistent state.
        catch_unwind(AssertUnwindSafe(work)).map_err(|payload| FrameError {
            path: path.to_owned(),
            during,
            cause: Cause::Panic(panic_message(&*payload)),
        })
    }
}

/// Whether a system error is one of the machine, and not of the path or the content of a file.
pub(crate) fn is_error_of_machine(error: &io::Error) -> bool {
    use io::ErrorKind::{
        AddrInUse, AddrNotAvailable, BrokenPipe, InvalidData, InvalidFilename, InvalidInput, IsADirectory,
        NotADirectory, NotFound, PermissionDenied, UnexpectedEof,
    };
    let is_of_path = matches!(
        error.kind(),
        NotFound | NotADirectory | IsADirectory | InvalidFilename | InvalidInput | PermissionDenied
    );
    let is_of_request =
        matches!(error.kind(), AddrInUse | AddrNotAvailable | BrokenPipe | InvalidData | UnexpectedEof);
    !is_of_path && !is_of_request && !is_link_loop(error)
}

fn panic_message(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().copied();
    text.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message").to_owned()
}

impl fmt::Display for FrameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let FrameError { path, during, cause } = self;
        write!(f, "{}: ", shown(path))?;
        match cause {
            Cause::File(source) if *during == Stage::Read => source.fmt(f),
            Cause::File(source) => write!(f, "cannot {during}: {source}"),
            Cause::Changed => f.write_str("changed while it was read"),
            Cause::Conflict(conflict) => conflict.fmt(f),
            Cause::Obstacle(error) => error.fmt(f),
            Cause::Missing(what) => f.write_str(what),
            Cause::Settings(error) => error.fmt(f),
            Cause::TooLarge(too_large) => too_large.fmt(f),
            Cause::VoxelTooSmall(too_small) => too_small.fmt(f),
            Cause::Scratch(source) => write!(
                f,
                "cannot write temporary files beside the results (the frame does not fit into memory): {source}"
            ),
            Cause::Panic(what) => {
                write!(f, "internal error in the {during} stage: {what}; please report it")
            }
        }
    }
}

impl std::error::Error for FrameError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match &self.cause {
            Cause::File(source) => Some(source),
            Cause::Conflict(source) => Some(&**source),
            Cause::Obstacle(error) => error.source.as_ref().map(|source| source as _),
            Cause::Settings(source) => Some(source),
            Cause::TooLarge(source) => Some(source),
            Cause::VoxelTooSmall(source) => Some(source),
            Cause::Scratch(source) => Some(source),
            Cause::Changed | Cause::Missing(_) | Cause::Panic(_) => None,
        }
    }
}
