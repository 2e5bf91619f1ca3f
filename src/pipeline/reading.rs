//! From a file to particles.

use std::fs;
use std::path::Path;

use meniscus_formats::{Limits, ParticleFrame, Positions, read_particles};

use crate::particles::Particles;

use super::frame::{FrameError, Stage};

/// What the pipeline needs of a file.
#[derive(Clone, Debug)]
pub struct ReadFrame {
    /// The particles.
    pub particles: Particles,
    /// What a user should know though the file was read.
    pub notes: Vec<String>,
}

/// The bytes of a file.
///
/// # Errors
/// When the system refuses.
pub fn read_file(path: &Path) -> Result<Vec<u8>, FrameError> {
    fs::read(path).map_err(|error| FrameError::file(path, Stage::Read, error))
}

/// The particles in the bytes of the file at `path`.
///
/// # Errors
/// When they are no particles that can be read.
pub fn parse_particles(path: &Path, bytes: &[u8]) -> Result<ReadFrame, FrameError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let frame = read_particles(bytes, &name, &Limits::default())
        .map_err(|error| FrameError::file(path, Stage::Read, error))?;
    let ParticleFrame { positions, notes, .. } = frame;
    Ok(ReadFrame { particles: particles(positions), notes })
}

/// The same vectors under the method's own type.
pub fn particles(positions: Positions) -> Particles {
    match positions {
        Positions::F32(positions) => Particles::Single(positions),
        Positions::F64(positions) => Particles::Double(positions),
    }
}
