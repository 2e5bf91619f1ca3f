//! From a file to particles.

use std::io::{self, Read};
use std::path::Path;

use meniscus_formats::compression::read_head;
use meniscus_formats::{AttributeRole, FilePositions, Limits, ParticleFrame, read_particles, refuse_foreign};

use crate::surface::particles::{Cloud, Particles, Shapes};

use super::attributes::Wanted;
use super::steps::{StepsFoundBy, by_lines_of_file, file_of, read_step, step_of};
use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::files::input_file::read_unchanged;
use crate::pipeline::files::open::open_regular;
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::warning::Warning;

/// What the pipeline needs of a file.
#[derive(Clone, Debug)]
pub struct ReadFrame {
    /// The particles.
    pub cloud: Cloud,
    /// What a user should know though the file was read.
    pub warnings: Vec<Warning>,
    /// The name of the velocities, where the file has some that are not wanted.
    pub unused_velocity: Option<String>,
}

/// The bytes of a file, or of a step of one.
///
/// # Errors
/// When the system refuses.
pub fn read_file(path: &Path) -> Result<Vec<u8>, FrameError> {
    let fail = |error: meniscus_formats::Error| FrameError::file(path, Stage::Read, error);
    match step_of(path) {
        None => {
            refuse_large_foreign(path).map_err(fail)?;
            read_unchecked(path).map_err(|error| fail(error.into()))
        }
        Some(step) => match read_step(step, StepsFoundBy::Reader).map_err(fail)? {
            Some((bytes, _)) => Ok(bytes),
            None => Err(FrameError { path: path.to_owned(), during: Stage::Read, cause: Cause::Changed }),
        },
    }
}

/// The bytes of a frame and the stamp of its file; `None` when that was written, replaced or removed meanwhile.
///
/// # Errors
/// When the system refuses, or there is no such step in the file.
pub(crate) fn read_frame_unchanged(
    path: &Path,
    steps_found_by: StepsFoundBy,
) -> meniscus_formats::Result<Option<(Vec<u8>, FileStamp)>> {
    match step_of(path) {
        None => {
            refuse_large_foreign(path)?;
            Ok(read_unchanged(path)?)
        }
        Some(step) => read_step(step, steps_found_by),
    }
}

/// Refuses a large file that nothing reads before all of it is in memory.
fn refuse_large_foreign(path: &Path) -> meniscus_formats::Result<()> {
    let metadata = path.metadata()?;
    if !metadata.is_file() || metadata.len() < LARGE_BYTES {
        return Ok(());
    }
    let head = read_head(open_regular(path)?, LARGE_HEAD_BYTES)?;
    refuse_foreign(&head, &path.file_name().unwrap_or_default().to_string_lossy())
}

/// From here on a file is worth a look at its head.
const LARGE_BYTES: u64 = 1 << 20;

/// More than any format needs to be recognized.
const LARGE_HEAD_BYTES: u64 = 1 << 16;

/// The bytes of a file, which may change meanwhile.
fn read_unchecked(path: &Path) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open_regular(path)?.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// The particles in the bytes of the file at `path`, with the attributes that are wanted.
///
/// # Errors
/// When they are no particles that can be read, or lack what is needed.
pub fn parse_particles(path: &Path, bytes: &[u8], wanted: &Wanted) -> Result<ReadFrame, FrameError> {
    let name = file_of(path).file_name().unwrap_or_default().to_string_lossy();
    let frame = read_particles(bytes, &name, &Limits::default())
        .map_err(|error| FrameError::file(path, Stage::Read, by_lines_of_file(path, error)))?;
    let ParticleFrame { positions, attributes, notes } = frame;
    let unfit = |what| FrameError { path: path.to_owned(), during: Stage::Read, cause: Cause::Missing(what) };
    let velocity = attributes.iter().find(|attribute| attribute.role == Some(AttributeRole::Velocity));
    let unused_velocity =
        velocity.map(|attribute| attribute.name.clone()).filter(|name| !wanted.has_velocity(name));
    let (attributes, missing) = wanted.of(attributes).map_err(unfit)?;
    let warnings = notes.into_iter().map(Warning::Sentence).chain(missing).collect();
    let cloud = Cloud { positions: particles(positions), shapes: Shapes::Balls, attributes };
    Ok(ReadFrame { cloud, warnings, unused_velocity })
}

/// The same vectors under the method's own type.
pub fn particles(positions: FilePositions) -> Particles {
    match positions {
        FilePositions::F32(positions) => Particles::Single(positions),
        FilePositions::F64(positions) => Particles::Double(positions),
    }
}
