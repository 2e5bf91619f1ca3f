//! What there is of a frame: whether its outputs are there, whole, made as they were to be, and certified.
//!
//! ```text
//!   a file is missing             ─▶ Missing      ┐
//!   the end of one is missing,                    │
//!   or its bytes are not those                    ├ to be made again
//!   that were certified           ─▶ Damaged      │
//!   made from another input, or                   │
//!   by other settings             ─▶ Stale        ┘
//!   the certificate did not hold  ─▶ Uncertified    made again it would be the same
//!   else                          ─▶ Done
//! ```
//!
//! A shard asks this before it converts a frame, and the whole is asked the same once all shards are through: so what is found
//! wanting in the end is what a shard that runs again makes again, and nothing else.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use meniscus_formats::{Error, is_whole, read_provenance};
use twox_hash::XxHash3_128;

use super::certificate_file::{CertifiedFrame, certificate_path, read_certificate};
use super::frame_warnings::does_not_hold;
use super::provenance::{hash_text, provenance};
use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::files::open::open_regular;
use crate::pipeline::input::frame::{Frame, Job};
use crate::pipeline::input::level_set_file::LevelSetFile;
use crate::pipeline::input::steps::{StepsFoundBy, read_step, step_of};
use crate::pipeline::target::outputs::{OutputFormat, output_path};

/// What there is of a frame; a sentence where it is not all there should be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum InspectedState {
    /// All of it, as it was to be.
    Done,
    /// Not all files; and whether none of them is there.
    Missing {
        /// Which.
        why: String,
        /// As though it had never been made.
        are_all: bool,
    },
    /// A file has lost bytes, or has others.
    Damaged(String),
    /// A file was made from another state of the input, by other settings, or by another version.
    Stale(String),
    /// All of it; and what was checked did not hold.
    Uncertified(String),
}

/// What is known of the input of a frame; `None` is not known, and not compared.
#[derive(Clone, Debug, Default)]
pub(crate) struct MadeFrom {
    /// The hash of the file.
    pub(crate) input_hash: Option<u128>,
    /// What is recorded of obstacles.
    pub(crate) obstacles: Option<String>,
}

/// What there is of a frame, and of what it is made from.
#[derive(Clone, Debug)]
pub struct Inspection {
    /// What there is of its outputs.
    pub state: InspectedState,
    /// Whether its input can be read, so that it could be compared.
    pub input_is_there: bool,
    /// The same of all its obstacles.
    pub obstacles_are_there: bool,
}

/// Looks at the outputs of a frame, and at its input and obstacles as far as they are there.
///
/// Only an input or obstacle that does not exist is left out of the comparison: its user may have removed it. If it exists
/// and cannot be read, the outputs may be of another state of it, so the frame is not done.
pub fn inspect(frame: &Frame) -> Inspection {
    let (input_hash, input_fault) = match hash_of_input(&frame.input) {
        Ok(hash) => (Some(hash), None),
        Err(error) if is_not_found(&error) => (None, None),
        Err(error) => (None, Some(format!("{}: {error}", frame.input.display()))),
    };
    let (obstacles, obstacle_fault) = match frame.obstacles.find(frame.number) {
        Ok(found) => (Some(found.recorded()), None),
        Err(error) if error.source.as_ref().is_some_and(is_not_found) => (None, None),
        Err(error) => (None, Some(error.to_string())),
    };
    let (input_is_there, obstacles_are_there) = (input_hash.is_some(), obstacles.is_some());
    let frame = &with_voxel_size_of_input(frame);
    let state = inspect_made_from(frame, &MadeFrom { input_hash, obstacles });
    let input_fault =
        input_fault.map(|fault| format!("{fault}; the results cannot be compared with their input"));
    let obstacle_fault =
        obstacle_fault.map(|fault| format!("{fault}; the results cannot be compared with their obstacle"));
    let state = match (state, input_fault.or(obstacle_fault)) {
        (InspectedState::Done | InspectedState::Uncertified(_), Some(fault)) => InspectedState::Stale(fault),
        (state, _) => state,
    };
    Inspection { state, input_is_there, obstacles_are_there }
}

/// A frame of a level set with the voxel size of its file, as far as that can be read; any other as it is.
fn with_voxel_size_of_input(frame: &Frame) -> Frame {
    let read = |frame: &Frame| {
        let voxel_size = LevelSetFile::read(&frame.input, false).ok()?.scene().lattice.voxel_size;
        frame.settings.with_voxel_size(voxel_size).ok()
    };
    let settings = matches!(frame.job, Job::LevelSet { .. }).then(|| read(frame)).flatten();
    Frame { settings: settings.map_or_else(|| Arc::clone(&frame.settings), Arc::new), ..frame.clone() }
}

fn is_not_found(error: &Error) -> bool {
    matches!(error, Error::Io(error) if error.kind() == io::ErrorKind::NotFound)
}

/// The hash of an input.
///
/// # Errors
/// When it cannot be read, is not a regular file, has no such step, or changes meanwhile.
fn hash_of_input(path: &Path) -> Result<u128, Error> {
    let changed = || io::Error::other("the file changed while it was read");
    let Some(step) = step_of(path) else {
        let file = InputFile::open(path)?;
        if !file.is_regular() {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "not a regular file").into());
        }
        let hash = file.hash()?;
        return if file.is_unchanged()? { Ok(hash) } else { Err(changed().into()) };
    };
    let (bytes, _) = read_step(step, StepsFoundBy::Reader)?.ok_or_else(changed)?;
    Ok(XxHash3_128::oneshot(&bytes))
}

/// The same, of a frame of whose input all is known: `None` if it must be made again, and else what its certificate says
/// does not hold.
pub(crate) fn certified_fault(frame: &Frame, input_hash: u128, obstacles: &str) -> Option<Option<String>> {
    let made_from = MadeFrom { input_hash: Some(input_hash), obstacles: Some(obstacles.to_owned()) };
    match inspect_made_from(frame, &made_from) {
        InspectedState::Done => Some(None),
        InspectedState::Uncertified(why) => Some(Some(why)),
        InspectedState::Missing { .. } | InspectedState::Damaged(_) | InspectedState::Stale(_) => None,
    }
}

fn inspect_made_from(frame: &Frame, made_from: &MadeFrom) -> InspectedState {
    let options = &*frame.outputs;
    let outputs: Vec<(OutputFormat, PathBuf)> = options
        .formats
        .iter()
        .map(|&format| (format, output_path(&options.folder, &frame.stem, format)))
        .collect();
    let certificate_path = certificate_path(&options.folder, &frame.stem);
    let paths: Vec<PathBuf> = outputs.iter().map(|(_, path)| path.clone()).collect();
    let is_missing = |path: &&PathBuf| matches!(path.try_exists(), Ok(false));
    let missing: Vec<String> =
        paths.iter().chain([&certificate_path]).filter(is_missing).map(|path| name_of(path)).collect();
    if !missing.is_empty() {
        let are_all = missing.len() == paths.len() + 1;
        return InspectedState::Missing { why: missing.join(", "), are_all };
    }
    let certified = read_certificate(&certificate_path)
        .map_err(|why| InspectedState::Damaged(format!("{}: {why}", name_of(&certificate_path))));
    let state = outputs
        .iter()
        .try_for_each(|(format, path)| look_at(frame, made_from, *format, path))
        .and_then(|()| certified.and_then(|certified| agrees(&certified, made_from, &paths)));
    state.err().unwrap_or(InspectedState::Done)
}

/// Looks at a file by itself: its end, and what it says of itself.
fn look_at(
    frame: &Frame,
    made_from: &MadeFrom,
    format: OutputFormat,
    path: &Path,
) -> Result<(), InspectedState> {
    let damaged = |why: String| InspectedState::Damaged(format!("{}: {why}", name_of(path)));
    let unreadable = |error: meniscus_formats::Error| damaged(error.to_string());
    let mut file = open_regular(path).map_err(|error| damaged(error.to_string()))?;
    let recorded = read_provenance(format, &file).map_err(unreadable)?;
    if !is_whole(format, &mut file).map_err(unreadable)? {
        return Err(damaged("its end is missing, or something follows it".to_owned()));
    }
    let hash = made_from.input_hash.unwrap_or_default();
    let obstacles = made_from.obstacles.as_deref().unwrap_or_default();
    let wanted = provenance(frame, (hash, obstacles), format);
    match difference(&recorded, &wanted, (made_from, &frame.job)) {
        None => Ok(()),
        Some(difference) => Err(InspectedState::Stale(format!("{}: {difference}", name_of(path)))),
    }
}

/// The first thing that a file says of itself other than it was to be.
fn difference(
    recorded: &[(String, String)],
    wanted: &[(String, String)],
    (made_from, job): (&MadeFrom, &Job),
) -> Option<String> {
    let is_level_set = matches!(job, Job::LevelSet { .. });
    let is_compared = |name: &str| match name {
        // The input says it; and .stl has one hash of all settings.
        "voxel_size" | "settings" if is_level_set => made_from.input_hash.is_some(),
        "input_hash" => made_from.input_hash.is_some(),
        "obstacles" | "void_threshold" => made_from.obstacles.is_some(),
        _ => true,
    };
    let value_in = |pairs: &[(String, String)], name: &str| {
        pairs.iter().find(|(other, _)| other == name).map(|(_, value)| value.clone())
    };
    let all = wanted.iter().chain(recorded).map(|(name, _)| name.as_str());
    let differs = |name: &&str| value_in(recorded, name) != value_in(wanted, name);
    let name = all.filter(|name| is_compared(name)).find(differs)?;
    Some(match (name, value_in(recorded, name), value_in(wanted, name)) {
        ("input_hash", Some(_), Some(_)) => "made from another state of the input".to_owned(),
        ("obstacles", Some(_), Some(_)) => "made among another state of the obstacles".to_owned(),
        (_, Some(was), Some(wanted)) => format!("{name} is {was}, and was to be {wanted}"),
        (_, None, Some(wanted)) => format!("{name} is not recorded, and was to be {wanted}"),
        (_, was, _) => format!("{name} is {}, and was not asked for", was.unwrap_or_default()),
    })
}

/// Whether a certificate is of these files and this input, and holds.
fn agrees(certified: &CertifiedFrame, made_from: &MadeFrom, paths: &[PathBuf]) -> Result<(), InspectedState> {
    if !certified.is_about(paths) {
        return Err(InspectedState::Stale("the certificate is of other files".to_owned()));
    }
    certified.check_bytes(paths).map_err(InspectedState::Damaged)?;
    if made_from.input_hash.is_some_and(|hash| hash_text(hash) != certified.input_hash) {
        return Err(InspectedState::Stale("the certificate is of another state of the input".to_owned()));
    }
    match &certified.fault {
        None => Ok(()),
        Some(fault) => Err(InspectedState::Uncertified(does_not_hold(fault))),
    }
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}
