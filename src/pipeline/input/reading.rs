//! Reads files, and parses particles.

use std::io;
use std::iter;
use std::path::Path;

use meniscus_formats::compression::read_head;
use meniscus_formats::{
    AttributeRole, Error, FileAttribute, FilePositions, Loaded, ParticleFrame, Values, check_supported,
    particles_of,
};

use twox_hash::XxHash3_128;

use crate::surface::options::{ColumnNames, ReadOptions};
use crate::surface::particles::{OwnedPositions, ParticleCloud, Shapes};

use super::attributes::AttributeRequest;
use super::filter::{keep_chosen, several_kinds, various_sizes};
use super::steps::{IndexPolicy, StampedContent, by_lines_of_file, file_of, read_part};
use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::files::input_file::{InputFile, read_unchanged};
use crate::pipeline::files::open::{open_regular, read_regular};
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::memory::reading_limits;
use crate::pipeline::warning::Warning;

/// The contents of a particle file that the pipeline needs.
#[derive(Clone, Debug)]
pub struct ParsedParticles {
    /// The particles.
    pub cloud: ParticleCloud,
    /// Warnings about the file, which could be read nevertheless.
    pub warnings: Vec<Warning>,
    /// The name of the velocity attribute, if the file has one that was not requested.
    pub unused_velocity: Option<String>,
}

/// The content of a file, or of a step of a file.
///
/// # Errors
/// When the system reports an error.
pub fn read_file(path: &Path) -> Result<Loaded, FrameError> {
    let fail = |error: meniscus_formats::Error| FrameError::file(path, Stage::Read, error);
    let Some(read) = read_part(path, IndexPolicy::OnRead) else {
        refuse_large_foreign(path).map_err(fail)?;
        return read_regular(path).map(Loaded::Bytes).map_err(|error| fail(error.into()));
    };
    match read.map_err(fail)? {
        Some(read) => Ok(read.content),
        None => Err(FrameError { path: path.to_owned(), during: Stage::Read, cause: Cause::Changed }),
    }
}

/// The content of a frame; `None` if the file was written, replaced or removed
/// meanwhile.
///
/// # Errors
/// When the system reports an error, or the file has no such step.
pub(crate) fn read_frame_unchanged(
    path: &Path,
    index_policy: IndexPolicy,
) -> meniscus_formats::Result<Option<StampedContent>> {
    read_part(path, index_policy).unwrap_or_else(|| {
        refuse_large_foreign(path)?;
        let whole = |(bytes, stamp)| StampedContent { content: Loaded::Bytes(bytes), stamp, named: None };
        Ok(read_unchanged(path)?.map(whole))
    })
}

/// Refuses a large file of an unknown format before all of it is read into memory.
fn refuse_large_foreign(path: &Path) -> meniscus_formats::Result<()> {
    let metadata = path.metadata()?;
    if !metadata.is_file() || metadata.len() < LARGE_BYTES {
        return Ok(());
    }
    refuse_foreign(path)
}

/// Refuses a file of an unknown format, by its first bytes.
///
/// # Errors
/// Why the file cannot be read as particles.
pub fn refuse_foreign(path: &Path) -> meniscus_formats::Result<()> {
    let head = read_head(open_regular(path)?, HEAD_BYTES)?;
    check_supported(&head, &path.file_name().unwrap_or_default().to_string_lossy())
}

/// From this size on, the format of a file is checked by its head before the file is read.
const LARGE_BYTES: u64 = 1 << 20;

/// More bytes than any format needs to be recognized.
const HEAD_BYTES: u64 = 1 << 16;

/// Parses particles from the content of the frame at `path`, with all attributes, and with new names for columns.
///
/// # Errors
/// When it has no valid particles.
pub fn read_particles_of(
    path: &Path,
    content: Loaded,
    columns: Option<&ColumnNames>,
) -> Result<ParticleFrame, FrameError> {
    let name = file_of(path).file_name().unwrap_or_default().to_string_lossy();
    particles_of(content, &name, columns.map_or(&[], ColumnNames::pairs), &reading_limits())
        .map_err(|error| FrameError::file(path, Stage::Read, by_lines_of_file(path, error)))
}

/// Parses particles from the content of the frame at `path`: those that meet the condition of the request, with
/// the requested attributes.
///
/// # Errors
/// When it has no valid particles, or lacks an attribute that is required or in the condition.
pub fn parse_particles(
    path: &Path,
    content: Loaded,
    wanted: &AttributeRequest,
) -> Result<ParsedParticles, FrameError> {
    let ReadOptions { columns, filter } = &wanted.reading;
    let mut frame = read_particles_of(path, content, columns.as_ref())?;
    let missing_error =
        |what| FrameError { path: path.to_owned(), during: Stage::Read, cause: Cause::Missing(what) };
    let about_kinds = match filter {
        Some(_) => keep_chosen(&mut frame, filter.as_ref()).map_err(missing_error)?,
        None => several_kinds(iter::once(&frame.attributes[..])),
    };
    let about_sizes =
        if wanted.uses_radii() { None } else { various_sizes(iter::once(&frame.attributes[..])) };
    let ParticleFrame { positions, attributes, notes } = frame;
    let velocity = attributes.iter().find(|attribute| attribute.role == Some(AttributeRole::Velocity));
    let unused_velocity =
        velocity.map(|attribute| attribute.name.clone()).filter(|name| !wanted.has_velocity(name));
    let (attributes, missing) = wanted.select(attributes).map_err(missing_error)?;
    let warnings = notes.into_iter().map(Warning::new).chain(about_kinds).chain(about_sizes).chain(missing);
    let warnings = warnings.collect();
    let cloud = ParticleCloud { positions: particles(positions), shapes: Shapes::Uniform, attributes };
    Ok(ParsedParticles { cloud, warnings, unused_velocity })
}

/// Converts positions to the type of the reconstruction.
pub fn particles(positions: FilePositions) -> OwnedPositions {
    match positions {
        FilePositions::F32(positions) => OwnedPositions::F32(positions),
        FilePositions::F64(positions) => OwnedPositions::F64(positions),
    }
}

/// The hash of an input.
///
/// # Errors
/// When it cannot be read, is not a regular file, has no such step, or changes during the read.
pub fn hash_of_input(path: &Path) -> Result<u128, Error> {
    Ok(hash_and_stamp(path, IndexPolicy::OnRead)?.0)
}

/// Like [`hash_of_input`], with the stamp of the file.
pub(crate) fn hash_and_stamp(path: &Path, index_policy: IndexPolicy) -> Result<(u128, FileStamp), Error> {
    let changed = || io::Error::other("the file changed while it was read");
    let Some(read) = read_part(path, index_policy) else {
        let file = InputFile::open(path)?;
        if !file.is_regular() {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "not a regular file").into());
        }
        let hash = file.hash()?;
        return if file.is_unchanged()? { Ok((hash, file.stamp())) } else { Err(changed().into()) };
    };
    let StampedContent { content, stamp, .. } = read?.ok_or_else(changed)?;
    Ok((hash_of(&content), stamp))
}

/// The XXH3 hash, of 128 bits, of the bytes of a frame, or of all that is known of its particles.
pub fn hash_of(content: &Loaded) -> u128 {
    let (format, frame) = match content {
        Loaded::Bytes(bytes) => return XxHash3_128::oneshot(bytes),
        Loaded::Particles(format, frame) => (format, frame),
    };
    let ParticleFrame { positions, attributes, notes } = &**frame;
    let mut hasher = XxHash3_128::new();
    hasher.write(format!("{format:?} {} {notes:?}", positions.len()).as_bytes());
    hasher.write(match positions {
        FilePositions::F32(positions) => bytemuck::cast_slice(positions),
        FilePositions::F64(positions) => bytemuck::cast_slice(positions),
    });
    for FileAttribute { name, arity, role, values } in attributes {
        let (number, bytes): (_, &[u8]) = match values {
            Values::F32(values) => ("f32", bytemuck::cast_slice(values)),
            Values::F64(values) => ("f64", bytemuck::cast_slice(values)),
            Values::U8(values) => ("u8", values),
            Values::I32(values) => ("i32", bytemuck::cast_slice(values)),
            Values::I64(values) => ("i64", bytemuck::cast_slice(values)),
            Values::Strings { table, indices } => {
                hasher.write(format!("{table:?}").as_bytes());
                ("string", bytemuck::cast_slice(indices))
            }
        };
        hasher.write(format!("{name:?} {arity} {role:?} {number}").as_bytes());
        hasher.write(bytes);
    }
    hasher.finish_128()
}
