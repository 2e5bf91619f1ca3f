//! Inspects the outputs of a frame: whether they exist, are complete, up to date and certified.
//!
//! ```text
//!   a file is missing             ─▶ Missing      ┐
//!   its bytes are not those                       │
//!   that were certified           ─▶ Damaged      ├ converted again
//!   made from another input, or                   │
//!   with other settings           ─▶ Stale        ┘
//!   validation failed             ─▶ Uncertified    another conversion would give the same result
//!   else                          ─▶ Done
//! ```
//!
//! The hashes are compared before anything is read from the files: damaged bytes may be those that name the
//! input and the settings.
//!
//! A shard inspects a frame before it converts it, and `verify` runs the same inspection for all shards. So a
//! shard that runs again converts exactly the frames that `verify` reports as missing, damaged or stale.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use meniscus_formats::Error;
use twox_hash::XxHash3_128;

use super::certificate_file::{CertifiedFrame, certificate_path, read_certificate};
use super::frame_warnings::does_not_hold;
use super::provenance::{provenance, recorded_provenance};
use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::files::open::open_regular;
use crate::pipeline::input::frame::{Frame, Job};
use crate::pipeline::input::level_set_file::LevelSetFile;
use crate::pipeline::input::steps::{IndexPolicy, read_step, step_of};
use crate::pipeline::memory::default_memory_bytes;
use crate::pipeline::target::outputs::{OutputFormat, output_path};

/// The result of an inspection, with a reason if the frame is not done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum InspectedState {
    /// All outputs are complete and up to date.
    Done,
    /// Some outputs do not exist.
    Missing {
        /// Which ones.
        why: String,
        /// Whether none of them exists, as if the frame had never been converted.
        are_all: bool,
    },
    /// A file is not the one that was certified: it was truncated, changed or replaced.
    Damaged(String),
    /// A file was made from another version of the input, with other settings, or by another version of the
    /// program; or the input or an obstacle exists but cannot be read, so that this is unknown.
    Stale(String),
    /// All outputs are complete and up to date, but a check failed.
    Uncertified(String),
}

/// The known inputs of a frame; `None` is unknown, and not compared.
#[derive(Clone, Debug, Default)]
pub(crate) struct MadeFrom {
    /// The hash of the input file.
    pub(crate) input_hash: Option<u128>,
    /// The names and hashes of its obstacle files, as provenance has them.
    pub(crate) obstacles: Option<String>,
}

/// The state of a frame's outputs and inputs.
#[derive(Clone, Debug)]
pub struct Inspection {
    /// The state of its outputs.
    pub state: InspectedState,
    /// Whether its input could be read, and so was compared.
    pub input_exists: bool,
    /// Whether all its obstacles could be read.
    pub obstacles_exist: bool,
}

/// Inspects the outputs of a frame, and compares them with its input and obstacles if these exist.
///
/// Only an input or obstacle that does not exist is left out of the comparison: the user may have removed it.
/// If it exists and cannot be read, the outputs may be made from another version of it, so the frame is
/// not done.
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
    let (input_exists, obstacles_exist) = (input_hash.is_some(), obstacles.is_some());
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
    Inspection { state, input_exists, obstacles_exist }
}

/// A level-set frame with the voxel size of its file, if that can be read; any other frame unchanged.
fn with_voxel_size_of_input(frame: &Frame) -> Frame {
    let read = |frame: &Frame| {
        let voxel_size =
            LevelSetFile::read(&frame.input, false, default_memory_bytes()).ok()?.scene().lattice.voxel_size;
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
/// When it cannot be read, is not a regular file, has no such step, or changes during the read.
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
    let (bytes, _) = read_step(step, IndexPolicy::OnRead)?.ok_or_else(changed)?;
    Ok(XxHash3_128::oneshot(&bytes))
}

/// Like [`inspect`], for a frame whose inputs are all known. `None`: it must be converted again. `Some`: it
/// is done; contains the failed checks in its certificate, if any.
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
    let is_missing = |path: &&PathBuf| matches!(path.try_exists(), Ok(false));
    let paths = outputs.iter().map(|(_, path)| path).chain([&certificate_path]);
    let missing: Vec<String> = paths.filter(is_missing).map(|path| name_of(path)).collect();
    if !missing.is_empty() {
        let are_all = missing.len() == outputs.len() + 1;
        return InspectedState::Missing { why: missing.join(", "), are_all };
    }
    let state = read_certificate(&certificate_path)
        .map_err(|why| InspectedState::Damaged(format!("{}: {why}", name_of(&certificate_path))))
        .and_then(|certified| inspect_certified(frame, made_from, &outputs, &certified));
    state.err().unwrap_or(InspectedState::Done)
}

/// Inspects the outputs of a frame that has a certificate.
fn inspect_certified(
    frame: &Frame,
    made_from: &MadeFrom,
    outputs: &[(OutputFormat, PathBuf)],
    certified: &CertifiedFrame,
) -> Result<(), InspectedState> {
    let paths: Vec<PathBuf> = outputs.iter().map(|(_, path)| path.clone()).collect();
    if !certified.is_about(&paths) {
        return Err(InspectedState::Stale(
            "the certificate lists other files than the outputs of the frame".to_owned(),
        ));
    }
    certified.check_bytes(&paths).map_err(InspectedState::Damaged)?;
    outputs
        .iter()
        .try_for_each(|(format, path)| inspect_output(frame, made_from, (*format, path), certified))?;
    match &certified.fault {
        None => Ok(()),
        Some(fault) => Err(InspectedState::Uncertified(does_not_hold(fault))),
    }
}

/// Inspects the provenance of a file that has the certified bytes.
fn inspect_output(
    frame: &Frame,
    made_from: &MadeFrom,
    (format, path): (OutputFormat, &Path),
    certified: &CertifiedFrame,
) -> Result<(), InspectedState> {
    let damaged = |why: String| InspectedState::Damaged(format!("{}: {why}", name_of(path)));
    let file = open_regular(path).map_err(|error| damaged(error.to_string()))?;
    let recorded = recorded_provenance(format, &file).map_err(|error| damaged(error.to_string()))?;
    let hash = made_from.input_hash.unwrap_or_default();
    let obstacles = made_from.obstacles.as_deref().unwrap_or_default();
    let wanted = provenance(frame, (hash, obstacles), format);
    if let Some(difference) = difference(&recorded, &wanted, (made_from, &frame.job)) {
        return Err(InspectedState::Stale(format!("{}: {difference}", name_of(path))));
    }
    // The file has the bytes that its writer certified, so it is the certificate that was changed.
    let is_certified =
        |(name, value): &(String, String)| name == "input_hash" && *value == certified.input_hash;
    match recorded.iter().any(is_certified) {
        true => Ok(()),
        false => Err(damaged("the certificate names another input than the file".to_owned())),
    }
}

/// The first entry in a file's provenance that differs from the expected one.
fn difference(
    recorded: &[(String, String)],
    wanted: &[(String, String)],
    (made_from, job): (&MadeFrom, &Job),
) -> Option<String> {
    let is_level_set = matches!(job, Job::LevelSet { .. });
    let is_compared = |name: &str| match name {
        // The voxel size of a level set comes from its file, so it is compared only if that could be read. An
        // .stl has a single hash of all settings, with the voxel size among them.
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
    Some(describe_difference(name, value_in(recorded, name), value_in(wanted, name)))
}

/// Describes an entry that was recorded with one value and is expected with another; `None` is no such entry.
fn describe_difference(name: &str, was: Option<String>, wanted: Option<String>) -> String {
    match (name, was, wanted) {
        ("input_hash", Some(_), Some(_)) => "the input has changed since it was made".to_owned(),
        ("obstacles", Some(_), Some(_)) => "the obstacles have changed since it was made".to_owned(),
        // An .stl has no room for the settings themselves.
        ("settings", ..) => "made with other settings (an .stl records only their hash)".to_owned(),
        ("generator", Some(was), Some(wanted)) => format!("made by {was}; this is {wanted}"),
        (_, Some(was), Some(wanted)) => format!("made with {name} {was}; the current setting is {wanted}"),
        (_, None, Some(wanted)) => format!("made without {name}; the current setting is {wanted}"),
        (_, was, _) => format!("made with {name} {}, which is no longer set", was.unwrap_or_default()),
    }
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn difference_names_the_setting_or_the_program() {
        for (name, was, wanted, expected) in [
            (
                "settings",
                "789771c6485c",
                "b66773ec3eb2",
                "made with other settings (an .stl records only their hash)",
            ),
            (
                "generator",
                "meniscus 0.1.0",
                "meniscus 0.2.0",
                "made by meniscus 0.1.0; this is meniscus 0.2.0",
            ),
            ("voxel_size", "0.07", "0.04", "made with voxel_size 0.07; the current setting is 0.04"),
        ] {
            assert_eq!(describe_difference(name, Some(was.to_owned()), Some(wanted.to_owned())), expected);
        }
    }
}
