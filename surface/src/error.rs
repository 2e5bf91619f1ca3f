//! Errors of a reconstruction.

use std::fmt;
use std::io;

use crate::cancel::Interrupted;
use crate::obstacle::ObstacleTooFar;
use crate::options::SettingsError;
use crate::spacing::rounding_error;

/// Why [`reconstruct`](crate::reconstruct()) failed.
///
/// Each message is one sentence without a full stop that says what is wrong and what to change.
#[derive(Debug)]
#[non_exhaustive]
pub enum Error {
    /// An option is out of its range, or two options contradict each other. The message names the option, its
    /// value and its range.
    Options(SettingsError),
    /// Neither [`spacing`](crate::Options::spacing) nor a voxel size is given, and the spacing
    /// cannot be measured: fewer than two particles have different finite positions.
    UnknownSpacing,
    /// The particles cannot form a surface: there are none, or every position is not finite or outside the
    /// range of the grid.
    NoParticles {
        /// Number of particles in the input.
        input_count: usize,
    },
    /// The options name an attribute that the particles lack, or whose arity (values per particle) differs.
    MissingAttribute {
        /// The name in the options.
        name: String,
        /// The arity that the option requires.
        arity: usize,
    },
    /// The number of values of an attribute is not its arity times the number of particles.
    AttributeLength {
        /// The name of the attribute.
        name: String,
        /// The number of values that it must have.
        expected: usize,
        /// The number of values that it has.
        found: usize,
    },
    /// No particle meets the condition [`where`](crate::Options::where), or the condition does not suit the
    /// attributes of the particles. The message contains the condition.
    Filter(String),
    /// The voxels are so small that 32-bit positions, or the grid's indices, cannot resolve them over the
    /// whole frame. Usually the unit of length is wrong.
    VoxelTooSmall {
        /// The voxel size, world units.
        voxel_size: f64,
        /// The smallest voxel size that this frame allows, world units.
        least: f64,
    },
    /// Positions are rounded, as 32-bit numbers far from the origin are, to steps larger than a tenth of the
    /// measured particle spacing.
    RoundedPositions {
        /// The step, world units.
        step: f64,
        /// The measured particle spacing, world units.
        spacing: f64,
    },
    /// An obstacle has coordinates that are too large for the voxel size.
    ObstacleTooFar(ObstacleTooFar),
    /// The frame needs more memory than the [limit](crate::Reconstructor::memory_limit). Raise the
    /// limit or choose larger voxels.
    MemoryLimit {
        /// The smallest limit that may be sufficient, in bytes. Usually it is sufficient; it is less if even
        /// counting what the frame needs would exceed the limit by far.
        needed_bytes: u64,
        /// The limit, in bytes.
        limit_bytes: u64,
    },
    /// The [scratch storage](crate::Reconstructor::scratch) cannot be created, read or written.
    Scratch(io::Error),
    /// The [token](crate::CancelToken) was cancelled.
    Cancelled,
}

impl From<Interrupted> for Error {
    fn from(Interrupted: Interrupted) -> Error {
        Error::Cancelled
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Error::Options(error) => error.fmt(f),
            Error::UnknownSpacing => f.write_str(
                "cannot measure the particle spacing: fewer than two particles have different positions; \
                 set `spacing` or `voxel_size`",
            ),
            Error::NoParticles { input_count: 0 } => f.write_str("the frame has no particles"),
            Error::NoParticles { input_count: given } => {
                write!(
                    f,
                    "no usable particle among {given}: all positions are NaN or infinite, or too far from the origin for this \
                     voxel size; check the unit of length, or choose a larger voxel size"
                )
            }
            Error::MissingAttribute { name, arity } => {
                let numbers = if *arity == 1 { "number" } else { "numbers" };
                write!(f, "the particles have no attribute `{name}` with {arity} {numbers} per particle")
            }
            Error::AttributeLength { name, expected, found } => {
                write!(f, "the attribute `{name}` has {found} values; expected {expected}")
            }
            Error::Filter(why) => f.write_str(why),
            Error::VoxelTooSmall { voxel_size, least } => write!(
                f,
                "the voxel size {voxel_size} is too small for this frame; it must be at least {least}"
            ),
            Error::RoundedPositions { step, spacing } => f.write_str(&rounding_error(*step, *spacing)),
            Error::ObstacleTooFar(too_far) => write!(f, "obstacle {} (from 0): {too_far}", too_far.index),
            Error::MemoryLimit { needed_bytes, limit_bytes } => write!(
                f,
                "the frame needs at least {} MiB of memory; the limit is {} MiB: raise it or choose larger voxels",
                needed_bytes.div_ceil(MEBIBYTE),
                limit_bytes / MEBIBYTE
            ),
            Error::Scratch(error) => write!(f, "scratch storage: {error}"),
            Error::Cancelled => f.write_str("cancelled"),
        }
    }
}

const MEBIBYTE: u64 = 1 << 20;

impl std::error::Error for Error {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Error::Options(error) => Some(error),
            Error::Scratch(error) => Some(error),
            _ => None,
        }
    }
}

impl From<SettingsError> for Error {
    fn from(error: SettingsError) -> Error {
        Error::Options(error)
    }
}
