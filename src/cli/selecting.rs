//! From inputs to the frames that were meant, sequence by sequence.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use anyhow::{Result, anyhow, bail};

use crate::farm::ShardPlan;
use crate::pipeline::{
    self, FrameFile, OutFolderError, Sequence, are_one_file, check_out_folder, file_of, is_level_set,
    single_frame_sequences, single_frames_note,
};

use super::args::MethodArgs;
use super::choices::refuse_stray_rounds;
use super::console::Console;
use super::frame_selection::FrameSelection;
use super::inputs::find_inputs;
use super::out_folder::folder_of;
use super::wording::{counted, counted_are};

/// What to convert.
pub(super) struct InputSelection {
    /// At least one.
    pub(super) sequences: Vec<SelectedSequence>,
    /// Every file that the inputs stand for, selected or not.
    pub(super) found: Vec<PathBuf>,
    /// No path was unreadable: there are no frames but these.
    pub(super) is_complete: bool,
}

/// A sequence, and which of its frames to convert.
pub(super) struct SelectedSequence {
    pub(super) sequence: Sequence,
    /// At least one.
    pub(super) selected: Vec<FrameFile>,
}

/// Finds the frames that the inputs stand for, and those of them with numbers that are asked for.
///
/// # Errors
/// When an input stands for no frame, or none is selected.
pub(super) fn select_frames(
    inputs: &[PathBuf],
    numbers: Option<&FrameSelection>,
    method: &MethodArgs,
    console: &mut Console,
) -> Result<InputSelection> {
    refuse_stray_rounds(method, inputs)?;
    let found = find_inputs(inputs)?;
    found.report(console);
    if let Some((first, count)) = &found.passed_over {
        let is_one_folder = inputs.iter().filter(|input| input.is_dir()).count() < 2;
        let name =
            Path::new(first.file_name().filter(|_| is_one_folder).unwrap_or(first.as_os_str())).display();
        match count {
            1 => console.say(format_args!("passed over {name}: no frame of particles")),
            _ => {
                let others = counted(count - 1, "other file");
                console.say(format_args!("passed over {name} and {others}: no frames of particles"));
            }
        }
    }
    let is_complete = found.unreadable.is_empty();
    let paths: Vec<PathBuf> = found.files.iter().map(|file| file.path.clone()).collect();
    let sequences = pipeline::sequences(found.files);
    if method.to_options().needs_spacing() {
        warn_of_single_frames(&sequences, console);
    }
    let sequences = without_rivals(selected_of(sequences, numbers)?, console);
    if let Some(selection) = numbers {
        let there = selected_files(&sequences).filter_map(FrameFile::number).collect();
        for (range, count) in selection.missing(&there) {
            console.warning(format_args!("--frames {range}: {} not there", counted_are(count)));
        }
    }
    Ok(InputSelection { sequences, found: paths, is_complete })
}

/// The sequences, each with the frames whose numbers are asked for, and without those that have none of these.
///
/// # Errors
/// When none are left.
pub(super) fn selected_of(
    sequences: Vec<Sequence>,
    numbers: Option<&FrameSelection>,
) -> Result<Vec<SelectedSequence>> {
    let frame_count: usize = sequences.iter().map(|sequence| sequence.frames.len()).sum();
    let select = |sequence: Sequence| {
        let is_selected = |file: &&FrameFile| FrameSelection::takes(numbers, file);
        let selected: Vec<_> = sequence.frames.iter().filter(is_selected).cloned().collect();
        (!selected.is_empty()).then_some(SelectedSequence { sequence, selected })
    };
    let selected: Vec<_> = sequences.into_iter().filter_map(select).collect();
    match selected.is_empty() {
        true => bail!("--frames selects none of the {frame_count} frames"),
        false => Ok(selected),
    }
}

/// The only sequence of these files, of which one sequence is needed, and why.
///
/// # Errors
/// When there are several, or none.
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

/// More sequences than that are not named where there should be one.
const SEQUENCES_NAMED: usize = 5;

/// The selected frames of these sequences.
pub(super) fn selected_files(sequences: &[SelectedSequence]) -> impl Iterator<Item = &FrameFile> + Clone {
    sequences.iter().flat_map(|sequence| &sequence.selected)
}

/// Leaves out frames whose outputs would have the names of those of an earlier frame in the same folder, as `dam.1.ply`
/// beside `dam.1.bgeo` would. The daemon takes the one that is complete first. Full names for both would change with what else is in the folder.
fn without_rivals(sequences: Vec<SelectedSequence>, console: &mut Console) -> Vec<SelectedSequence> {
    let mut owner_of: HashMap<(PathBuf, String), PathBuf> = HashMap::new();
    let mut kept = Vec::new();
    for mut selected in sequences {
        let mut rivals: Vec<(PathBuf, PathBuf)> = Vec::new();
        selected.selected.retain(|file| {
            let folder = file_of(&file.path).parent().map(Path::to_owned).unwrap_or_default();
            let owner = owner_of.entry((folder, file.stem())).or_insert_with(|| file.path.clone());
            let is_rival = *owner != file.path;
            rivals.extend(is_rival.then(|| (owner.clone(), file.path.clone())));
            !is_rival
        });
        if let Some((owner, rival)) = rivals.first() {
            let others = match rivals.len() - 1 {
                0 => String::new(),
                count => format!(" and {} of {}", counted(count, "more frame"), selected.sequence.name),
            };
            console.fail(format_args!(
                "{} and {} would both become {}.*: converting only the first; convert the second{others} into another \
                 folder",
                owner.display(),
                rival.display(),
                FrameFile::new(rival.clone()).stem()
            ));
        }
        kept.extend((!selected.selected.is_empty()).then_some(selected));
    }
    kept
}

/// Names the folders whose files look like one sequence and are many: each of these gets its own voxel size.
fn warn_of_single_frames(sequences: &[Sequence], console: &Console) {
    for (folder, count) in single_frame_sequences(sequences) {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { &folder };
        console.warning(format_args!("{}: {}", folder.display(), single_frames_note(count)));
    }
}

/// Refuses level sets where there must be particles, for a command that is called so.
///
/// # Errors
/// Which, and what does them.
pub(super) fn refuse_level_sets(selection: &InputSelection, command: &str) -> Result<()> {
    match selected_files(&selection.sequences).find(|file| is_level_set(&file.path)) {
        Some(file) => bail!(
            "{}: a level set, and {command} is for particles: `meniscus convert` does level sets, by themselves",
            file.path.display()
        ),
        None => Ok(()),
    }
}

/// Refuses a report that could not be written, or would replace the plan or a file that is named in it.
///
/// # Errors
/// Why.
pub(super) fn refuse_report_of_plan(report: Option<&Path>, plan: &ShardPlan, plan_path: &Path) -> Result<()> {
    let Some(report) = report else { return Ok(()) };
    refuse_odd_place("the report", report)?;
    if are_one_file(report, plan_path) {
        bail!("{}: the report would replace the plan", report.display());
    }
    if plan.names(report) {
        bail!("{}: the report would replace a file of the plan", report.display());
    }
    Ok(())
}

/// Refuses to write something, such as a report, where it could not be, or would replace what is no file.
///
/// # Errors
/// Why not.
pub(super) fn refuse_odd_place(what: &str, path: &Path) -> Result<()> {
    if let Some(folder) = path.parent()
        && !folder.as_os_str().is_empty()
        && !folder.is_dir()
    {
        bail!("{}: there is no such folder for {what}", folder.display());
    }
    if let Ok(there) = path.metadata()
        && !there.is_file()
    {
        bail!("{}: {what} would replace what is there, which is no ordinary file", path.display());
    }
    refuse_shut_folder(what, path)
}

/// Refuses to write something where no file can be made. Of a link it shows when it is written: then some take its place,
/// and some that of what it names.
///
/// # Errors
/// Why not.
fn refuse_shut_folder(what: &str, path: &Path) -> Result<()> {
    if path.is_symlink() {
        return Ok(());
    }
    let folder = folder_of(path);
    match check_out_folder(folder) {
        Err(OutFolderError::Write { folder, source }) => {
            bail!(
                "{}: nothing can be written into this folder, and {what} is to be: {source}",
                folder.display()
            )
        }
        other => Ok(other?),
    }
}
