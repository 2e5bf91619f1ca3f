//! Selects the frames of each sequence from the inputs.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use anyhow::{Result, anyhow, bail};
use meniscus_formats::Neighbor;

use crate::pipeline::{
    self, FrameFile, OutFolderError, Sequence, check_out_folder, file_of, is_level_set,
    single_frame_sequences, single_frames_note,
};

use super::args::MethodArgs;
use super::choices::refuse_misplaced_rounds;
use super::console::Console;
use super::frame_selection::FrameSelection;
use super::inputs::find_inputs;
use super::out_folder::folder_of;
use super::wording::{counted_are, pluralize};

/// The frames to convert.
pub(super) struct InputSelection {
    /// At least one, except in a shard without frames.
    pub(super) sequences: Vec<SelectedSequence>,
    /// The sequences without any selected frame.
    pub(super) unselected: Vec<Sequence>,
    /// Every file that the inputs name, selected or not.
    pub(super) found: Vec<PathBuf>,
    /// Whether every path was readable, so that these are all the frames.
    pub(super) is_complete: bool,
}

/// A sequence, and its frames to convert.
pub(super) struct SelectedSequence {
    pub(super) sequence: Sequence,
    /// At least one.
    pub(super) selected: Vec<FrameFile>,
}

/// Finds the frames that the inputs name, and selects those with the requested numbers.
///
/// # Errors
/// If an input names no frame, or no frame is selected.
pub(super) fn select_frames(
    inputs: &[PathBuf],
    numbers: Option<&FrameSelection>,
    method: &MethodArgs,
    console: &mut Console,
) -> Result<InputSelection> {
    refuse_misplaced_rounds(method, inputs)?;
    let found = find_inputs(inputs)?;
    found.report(console);
    for (what, (first, count)) in &found.skipped {
        let is_one_folder = inputs.iter().filter(|input| input.is_dir()).count() < 2;
        let name =
            Path::new(first.file_name().filter(|_| is_one_folder).unwrap_or(first.as_os_str())).display();
        let [one, several] = what.map_or(["not a particle file", "not particle files"], Neighbor::words);
        match count {
            1 => console.print_line(format_args!("skipped {name}: {one}")),
            _ => {
                let others = pluralize(count - 1, "other file");
                console.print_line(format_args!("skipped {name} and {others}: {several}"));
            }
        }
    }
    let is_complete = found.unreadable.is_empty();
    let paths: Vec<PathBuf> = found.files.iter().map(|file| file.path.clone()).collect();
    let sequences = pipeline::sequences(found.files);
    if method.to_options().needs_spacing() {
        warn_of_single_frames(&sequences, console);
    }
    let has_selected =
        |sequence: &Sequence| sequence.frames.iter().any(|file| FrameSelection::takes(numbers, file));
    let unselected = sequences.iter().filter(|sequence| !has_selected(sequence)).cloned().collect();
    let sequences = without_conflicts(selected_of(sequences, numbers)?, console);
    if let Some(selection) = numbers {
        let existing = selected_files(&sequences).filter_map(FrameFile::number).collect();
        for (range, count) in selection.missing(&existing) {
            console.warning(format_args!("--frames {range}: {} missing", counted_are(count)));
        }
    }
    Ok(InputSelection { sequences, unselected, found: paths, is_complete })
}

/// The sequences with their selected frames; sequences without any are dropped.
///
/// # Errors
/// If no frames are selected.
pub(super) fn selected_of(
    sequences: Vec<Sequence>,
    numbers: Option<&FrameSelection>,
) -> Result<Vec<SelectedSequence>> {
    let frame_count: usize = sequences.iter().map(|sequence| sequence.frames.len()).sum();
    refuse_times(numbers, &sequences)?;
    let select = |sequence: Sequence| {
        let is_selected = |file: &&FrameFile| FrameSelection::takes(numbers, file);
        let selected: Vec<_> = sequence.frames.iter().filter(is_selected).cloned().collect();
        (!selected.is_empty()).then_some(SelectedSequence { sequence, selected })
    };
    let selected: Vec<_> = sequences.into_iter().filter_map(select).collect();
    if selected.is_empty() {
        bail!("--frames selects none of the {frame_count} frames");
    }
    Ok(selected)
}

/// Refuses a selection of numbers for sequences whose names have times.
///
/// # Errors
/// Which sequence has times, and how to select its frames.
pub(super) fn refuse_times<'a>(
    numbers: Option<&FrameSelection>,
    sequences: impl IntoIterator<Item = &'a Sequence>,
) -> Result<()> {
    let mut sequences = sequences.into_iter().filter(|_| numbers.is_some());
    match sequences.find(|sequence| sequence.frames.iter().any(FrameFile::has_time)) {
        Some(sequence) => bail!(
            "--frames selects frame numbers, and the names of {} have times: select its files by a glob, such as '*_0.[0-4]*'",
            sequence.name
        ),
        None => Ok(()),
    }
}

/// The only sequence of these files, for a command that needs exactly one; `why` is the reason for the error
/// message.
///
/// # Errors
/// If there are several sequences, or none.
pub(super) fn only_sequence(files: Vec<FrameFile>, why: &str) -> Result<Sequence> {
    <[Sequence; 1]>::try_from(pipeline::sequences(files)).map(|[sequence]| sequence).map_err(|sequences| {
        let named = sequences.iter().take(SEQUENCES_NAMED).map(|sequence| &*sequence.name);
        let others = (sequences.len() > SEQUENCES_NAMED).then_some("..");
        anyhow!(
            "{why}, and there are {} sequences: {}: name one of them, by a pattern such as dam.####.ply",
            sequences.len(),
            named.chain(others).collect::<Vec<_>>().join(", ")
        )
    })
}

/// Maximum number of sequences named in the error message.
const SEQUENCES_NAMED: usize = 5;

/// The selected frames of these sequences.
pub(super) fn selected_files(sequences: &[SelectedSequence]) -> impl Iterator<Item = &FrameFile> + Clone {
    sequences.iter().flat_map(|sequence| &sequence.selected)
}

/// Leaves out frames whose outputs would have the same names as those of an earlier frame in the same folder,
/// as with `dam.1.ply` and `dam.1.bgeo`. (The daemon converts whichever of the two is complete first.) Adding
/// the extensions to the names of such outputs is no alternative: the name of an output would then depend on
/// the other files in the folder.
fn without_conflicts(sequences: Vec<SelectedSequence>, console: &mut Console) -> Vec<SelectedSequence> {
    let mut owner_of: HashMap<(PathBuf, String), PathBuf> = HashMap::new();
    let mut kept = Vec::new();
    for mut selected in sequences {
        let mut conflicts: Vec<(PathBuf, PathBuf)> = Vec::new();
        selected.selected.retain(|file| {
            let folder = file_of(&file.path).parent().map(Path::to_owned).unwrap_or_default();
            let owner = owner_of.entry((folder, file.stem())).or_insert_with(|| file.path.clone());
            let is_conflict = *owner != file.path;
            conflicts.extend(is_conflict.then(|| (owner.clone(), file.path.clone())));
            !is_conflict
        });
        if let Some((owner, other)) = conflicts.first() {
            let left_out = match conflicts.len() - 1 {
                0 => "is left out: convert it".to_owned(),
                count => format!(
                    "and {} of {} are left out: convert them",
                    pluralize(count, "more frame"),
                    selected.sequence.name
                ),
            };
            let what = format!(
                "{} and {other} would both become {}.*: \
                 {other} {left_out} with a separate command and another --out",
                owner.display(),
                FrameFile::new(other.clone()).stem(),
                other = other.display()
            );
            console.leave_out(conflicts.len(), what);
        }
        kept.extend((!selected.selected.is_empty()).then_some(selected));
    }
    kept
}

/// Warns about folders whose files look like one sequence but form many: each of these sequences gets a voxel
/// size of its own.
fn warn_of_single_frames(sequences: &[Sequence], console: &Console) {
    for (folder, count) in single_frame_sequences(sequences) {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { &folder };
        console.warning(format_args!("{}: {}", folder.display(), single_frames_note(count)));
    }
}

/// Refuses level sets for a command that needs particles; `command` is its name in the message.
///
/// # Errors
/// Which file is a level set, and what to use instead.
pub(super) fn refuse_level_sets(selection: &InputSelection, command: &str) -> Result<()> {
    match selected_files(&selection.sequences).find(|file| is_level_set(&file.path)) {
        Some(file) => bail!(
            "{}: {command} needs particles, and this is a level set: convert it separately with `meniscus convert`",
            file.path.display()
        ),
        None => Ok(()),
    }
}

/// Refuses an output path, such as that of a report, whose folder is missing or that names something other
/// than a regular file.
///
/// # Errors
/// The reason.
pub(super) fn check_output_path(what: &str, path: &Path) -> Result<()> {
    if let Some(folder) = path.parent()
        && !folder.as_os_str().is_empty()
        && !folder.is_dir()
    {
        bail!("{}: the folder for {what} does not exist", folder.display());
    }
    if let Ok(metadata) = path.metadata()
        && !metadata.is_file()
    {
        bail!("{}: not a regular file, so {what} cannot replace it", path.display());
    }
    check_writable(what, path)
}

/// Refuses a path where no file can be created. A symbolic link is not checked: some outputs replace the link
/// and others its target, so an error shows only on writing.
///
/// # Errors
/// The reason.
fn check_writable(what: &str, path: &Path) -> Result<()> {
    if path.is_symlink() {
        return Ok(());
    }
    let folder = folder_of(path);
    match check_out_folder(folder) {
        Err(OutFolderError::Write { folder, source }) => {
            bail!("{}: cannot write {what} into this folder: {source}", folder.display())
        }
        other => Ok(other?),
    }
}
