//! Finds the files that the INPUT arguments name, and selects the frames of each sequence.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use glob::{MatchOptions, Pattern};
use meniscus_formats::{Error, Neighbor};
use walkdir::{DirEntry, WalkDir};

use crate::pipeline::{
    self, FrameFile, NumberPattern, OutFolderError, Sequence, SniffedContent, canonical_path,
    check_out_folder, content, content_with, entry_key, file_of, files_in, files_joined_by, frames_in,
    is_absent, is_level_set, is_mesh, is_named_list, is_number, is_sequence_file, is_spray, may_be_file,
    promises_particles, refuse_foreign, shown, single_frame_sequences, single_frames_note, size_bytes,
    step_of,
};
use crate::surface::options::{ColumnNames, MethodOptions};

use super::args::MethodArgs;
use super::console::Console;
use super::destination::folder_of;
use super::frame_selection::FrameSelection;
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
    let choices = method.to_options();
    let found = find_inputs(inputs, choices.columns.as_ref())?;
    found.report(console);
    for (what, (first, count)) in &found.skipped {
        let is_one_folder = inputs.iter().filter(|input| input.is_dir()).count() < 2;
        let name =
            Path::new(first.file_name().filter(|_| is_one_folder).unwrap_or(first.as_os_str())).display();
        let [one, several] = what.map_or(["not a particle file", "not particle files"], Neighbor::words);
        let hint = match (what, count) {
            (Some(Neighbor::Table), 1) => "; if it is a frame, name its columns with --columns",
            (Some(Neighbor::Table), _) => "; if they are frames, name their columns with --columns",
            _ => "",
        };
        match count {
            1 => console.print_line(format_args!("skipped {name}: {one}{hint}")),
            _ => {
                let others = pluralize(count - 1, "other file");
                console.print_line(format_args!("skipped {name} and {others}: {several}{hint}"));
            }
        }
    }
    let is_complete = found.unreadable.is_empty();
    let paths: Vec<PathBuf> = found.files.iter().map(|file| file.path.clone()).collect();
    let sequences = pipeline::sequences(found.files);
    if choices.needs_measuring() {
        warn_of_single_frames(&sequences, &choices, console);
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
    let mut owner_of: HashMap<PathBuf, PathBuf> = HashMap::new();
    let mut kept = Vec::new();
    for mut selected in sequences {
        let mut conflicts: Vec<(PathBuf, PathBuf)> = Vec::new();
        selected.selected.retain(|file| {
            let folder = file_of(&file.path).parent().map(Path::to_owned).unwrap_or_default();
            let outputs = entry_key(folder.join(file.stem()));
            let owner = owner_of.entry(outputs).or_insert_with(|| file.path.clone());
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
fn warn_of_single_frames(sequences: &[Sequence], choices: &MethodOptions, console: &Console) {
    for (folder, count) in single_frame_sequences(sequences) {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { &folder };
        console.warning(format_args!("{}: {}", folder.display(), single_frames_note(count, choices)));
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

// Expands the INPUT arguments into files.
//
// ```text
//   dam.0012.bgeo      an existing file           that file
//   frames             an existing folder         the frames in it, or in its sub-folders of times, 0.05
//   dam.####.bgeo      a number of ≥ 4 digits     dam.0012.bgeo, dam.10000.bgeo
//   dam.%04d.bgeo      the same
//   dam.{}.bgeo        a number of any width       dam.7.bgeo, dam.-7.bgeo, dam.0.5.bgeo
//   shots/*/dam*.ply   anything else with * ? []   the matching files
//   dump.lammpstrj     a file with several steps   each of them
//   dump.lammpstrj/step=1000   one of its steps    that step
// ```
//
// An argument that names an existing path means that path, so special characters in names do no harm.

/// The files that the inputs name.
#[derive(Debug, Default)]
pub(super) struct MatchedInputs {
    /// Without duplicates.
    pub(super) files: Vec<FrameFile>,
    /// Files in folders that are not frames, by what they are (`None` is unrelated): the first by path, and
    /// the count.
    pub(super) skipped: BTreeMap<Option<Neighbor>, (PathBuf, usize)>,
    /// Paths that could not be examined and may be or contain frames, each with the reason.
    pub(super) unreadable: Vec<(PathBuf, String)>,
    /// Other warnings, one sentence each.
    pub(super) warnings: Vec<String>,
    /// Tables in the folder that is being searched in which no position was found. They are frames if nothing else is:
    /// their errors then say what was expected.
    pub(super) tables: Vec<PathBuf>,
}

/// Finds the files that the inputs name. In folders, tables that have these columns are frames.
///
/// # Errors
/// If an input matches no file.
pub(super) fn find_inputs(inputs: &[PathBuf], columns: Option<&ColumnNames>) -> Result<MatchedInputs> {
    let found = search(inputs, columns, false)?;
    match found.unreadable.first() {
        Some((path, why)) if found.files.is_empty() => bail!("{}: {why}", shown(path)),
        _ => Ok(found),
    }
}

/// Finds the files that the inputs name. If `others_in` finds files of other kinds in an input, `add` adds
/// them, and the input need not contain particles.
///
/// # Errors
/// If an input matches no file, or a folder cannot be read.
pub(super) fn find_with_others(
    inputs: &[PathBuf],
    columns: Option<&ColumnNames>,
    others_in: impl Fn(&Path) -> Result<Vec<FrameFile>>,
    add: impl Fn(&mut MatchedInputs, Vec<FrameFile>, &Path),
) -> Result<MatchedInputs> {
    let mut all = MatchedInputs::default();
    for input in inputs {
        let (others, one) = (others_in(input)?, std::slice::from_ref(input));
        if others.is_empty() {
            all.add(find_inputs(one, columns)?);
            continue;
        }
        let mut found = search(one, columns, true)?;
        add(&mut found, others, input);
        all.add(found);
    }
    Ok(all)
}

/// The inputs, with each folder replaced by its files of one format: the first of these formats, given by
/// their extensions, that the folder contains. Sequence files are left out. `what` names the files in the
/// error.
///
/// # Errors
/// If a folder contains no such files, or cannot be read.
pub(super) fn with_files_of_folders(
    inputs: &[PathBuf],
    formats: &[&[&str]],
    what: &str,
) -> Result<Vec<PathBuf>> {
    let mut paths = Vec::new();
    for input in inputs {
        if !input.is_dir() {
            paths.push(input.clone());
            continue;
        }
        let files = files_in(input).with_context(|| input.display().to_string())?;
        let files_of = |extensions: &&[&str]| -> Vec<PathBuf> {
            let is_of_format = |path: &&PathBuf| {
                let extension = path.extension().unwrap_or_default();
                extensions.iter().any(|known| extension.eq_ignore_ascii_case(known))
            };
            let is_other = |path: &&PathBuf| is_sequence_file(path) || is_spray(path);
            files.iter().filter(is_of_format).filter(|path| !is_other(path)).cloned().collect()
        };
        let Some(found) = formats.iter().map(files_of).find(|found| !found.is_empty()) else {
            bail!("{}: this folder contains no {what}", input.display());
        };
        paths.extend(found);
    }
    Ok(paths)
}

/// Finds the files. Folders without frames are refused unless `may_be_empty` is set.
fn search(inputs: &[PathBuf], columns: Option<&ColumnNames>, may_be_empty: bool) -> Result<MatchedInputs> {
    let mut found = MatchedInputs::default();
    for input in inputs {
        match input.metadata() {
            Ok(metadata) if metadata.is_dir() => found.add_folder(input, columns, may_be_empty)?,
            Ok(_) => found.files.push(FrameFile::new(input.clone())),
            // A link that cannot be followed: reading it later reports the error.
            Err(_) if input.is_symlink() => found.files.push(FrameFile::new(input.clone())),
            Err(_) if step_of(input).is_some_and(|(file, _)| file.is_file()) => {
                size_bytes(input).map_err(|error| anyhow!("{}: {error}", shown(input)))?;
                found.files.push(FrameFile::new(input.clone()));
            }
            Err(error) if !is_absent(input, &error) && !is_pattern(input) => {
                bail!("{}: {error}", shown(input))
            }
            Err(_) => found.add_pattern(input)?,
        }
    }
    // A pattern may match surfaces and the points beside them, which are not frames.
    let (spray, others): (Vec<_>, Vec<_>) =
        std::mem::take(&mut found.files).into_iter().partition(|file| is_spray(&file.path));
    for file in if others.is_empty() { spray } else { others } {
        let path = file.path.clone();
        match frames_of(file) {
            Ok(frames) => found.files.extend(frames),
            Err(error) => found.unreadable.push((path, error.to_string())),
        }
    }
    let mut seen = HashSet::new();
    found.files.retain(|file| seen.insert(entry_key(canonical_path(&file.path))));
    Ok(found)
}

/// Why a file cannot be read as particles, after its name, if its first bytes show that it is of another kind.
fn why_unsupported(path: &Path) -> Option<String> {
    match refuse_foreign(path) {
        Err(error @ Error::Unsupported { .. }) => {
            Some(format!("{}: {error}", path.file_name()?.to_string_lossy()))
        }
        _ => None,
    }
}

/// Expands a file with several steps into its steps. A file whose steps cannot be listed is returned as it
/// is: reading it reports the error.
///
/// # Errors
/// If the file exceeds a limit, such as the maximum number of steps. Without this error, the whole file would
/// be read as one frame, and fail then.
fn frames_of(file: FrameFile) -> Result<Vec<FrameFile>, Error> {
    if step_of(&file.path).is_some() {
        return Ok(vec![file]);
    }
    match frames_in(&file.path) {
        Ok(frames) if frames.len() > 1 => Ok(frames.into_iter().map(FrameFile::new).collect()),
        Err(error @ Error::TooLarge { .. }) => Err(error),
        _ => Ok(vec![file]),
    }
}

impl MatchedInputs {
    /// Merges the files of another search, without duplicates.
    pub(super) fn add(&mut self, found: MatchedInputs) {
        let key = |file: &FrameFile| entry_key(canonical_path(&file.path));
        let mut seen: HashSet<PathBuf> = self.files.iter().map(key).collect();
        self.files.extend(found.files.into_iter().filter(|file| seen.insert(key(file))));
        for (what, (first, count)) in found.skipped {
            self.skip(what, first, count);
        }
        self.unreadable.extend(found.unreadable);
        self.warnings.extend(found.warnings);
    }

    /// Prints the warnings, and an error for each path that could not be examined. Such an error makes the
    /// command fail.
    pub(super) fn report(&self, console: &mut Console) {
        for warning in &self.warnings {
            console.warning(warning);
        }
        for (path, why) in &self.unreadable {
            console.fail(format_args!("{}: {why}", shown(path)));
        }
    }

    /// The number of files and unreadable paths.
    fn count(&self) -> usize {
        self.files.len() + self.unreadable.len()
    }

    /// Counts files that are not frames; `first` is the first of them by path.
    fn skip(&mut self, what: Option<Neighbor>, first: PathBuf, count: usize) {
        let (before, count_before) = self.skipped.remove(&what).unwrap_or_else(|| (first.clone(), 0));
        self.skipped.insert(what, (before.min(first), count_before + count));
    }

    /// Adds the frames in a folder, or in its sub-folders of times if it has none itself.
    fn add_folder(&mut self, folder: &Path, columns: Option<&ColumnNames>, may_be_empty: bool) -> Result<()> {
        let files = files_in(folder).with_context(|| folder.display().to_string())?;
        let (count_before, mesh_count_before) = (self.count(), self.mesh_count());
        self.add_files(&files, columns);
        if self.count() == count_before {
            for folder in numbered_folders_in(folder) {
                match files_in(&folder) {
                    Ok(files) => self.add_files(&files, columns),
                    Err(error) => self.note_unreadable(&folder, &error),
                }
            }
        }
        let tables = std::mem::take(&mut self.tables);
        if self.count() == count_before && !may_be_empty {
            self.files.extend(tables.into_iter().map(FrameFile::new));
        } else {
            tables.into_iter().for_each(|path| self.skip(Some(Neighbor::Table), path, 1));
        }
        if self.count() == count_before && !may_be_empty {
            let mut hints = Vec::new();
            if self.mesh_count() > mesh_count_before {
                hints.push(
                    "the folder has meshes: `render` and `contact-sheet` show them, and `convert` takes their points if you give \
                     them by name or by a pattern"
                        .to_owned(),
                );
            } else if files.iter().any(|path| is_mesh(path)) {
                hints.push("the folder has meshes: `render` and `contact-sheet` show them".to_owned());
            }
            if files.iter().any(|path| is_level_set(path)) {
                hints.push(format!(
                    "the folder has level sets: `convert` takes them by name, or by a pattern such as '{}', and `render` and \
                     `contact-sheet` show them",
                    folder.join("*.vdb").display()
                ));
            }
            let subfolder_count = subfolder_count(folder);
            if hints.is_empty() && subfolder_count > 0 {
                hints.push(format!(
                    "the folder has {}: give them by name",
                    pluralize(subfolder_count, "sub-folder")
                ));
            }
            if hints.is_empty() && files.is_empty() {
                bail!("{}: the folder is empty", folder.display());
            }
            if hints.is_empty() {
                hints.extend(files.iter().find_map(|path| why_unsupported(path)));
            }
            let hint: String = hints.iter().map(|hint| format!("; {hint}")).collect();
            bail!(
                "{}: no frames of particles among the {} of this folder{hint}",
                folder.display(),
                pluralize(files.len(), "file")
            );
        }
        Ok(())
    }

    /// Adds those of the files in a folder that are frames. The files that another one joins to a frame are not.
    fn add_files(&mut self, files: &[PathBuf], columns: Option<&ColumnNames>) {
        let joined: HashSet<PathBuf> =
            files.iter().filter(|path| joins_files(path)).flat_map(|path| files_joined_by(path)).collect();
        for path in files {
            if joined.contains(path) {
                self.skip(Some(Neighbor::Part), path.clone(), 1);
                continue;
            }
            match content_in_folder(path, columns) {
                Ok(SniffedContent::Particles | SniffedContent::OwnParticles) => {
                    self.files.push(FrameFile::new(path.clone()));
                }
                Ok(SniffedContent::Neighbor(Neighbor::Table)) => self.tables.push(path.clone()),
                Ok(SniffedContent::Neighbor(neighbor)) => self.skip(Some(neighbor), path.clone(), 1),
                Ok(SniffedContent::OwnOutput | SniffedContent::NotParticles) => {
                    self.skip(None, path.clone(), 1);
                }
                // The file was removed since it was listed, or it is a dangling link whose name is not that
                // of a frame.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => self.unreadable.push((path.clone(), error.to_string())),
            }
        }
    }

    /// The number of meshes that were skipped.
    fn mesh_count(&self) -> usize {
        self.skipped.get(&Some(Neighbor::Mesh)).map_or(0, |(_, count)| *count)
    }

    fn add_pattern(&mut self, input: &Path) -> Result<()> {
        let pattern = input
            .to_str()
            .ok_or_else(|| anyhow!("{}: no such file, and a pattern must be valid UTF-8", input.display()))?;
        let count_before = self.count();
        let name = input.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        if let Some(number) = NumberPattern::find(name) {
            self.add_numbered(input, &number)?;
            if self.count() == count_before && number.width_min > 1 {
                bail!(
                    "{pattern}: no file matches; for numbers of any width, write {}{{}}{}",
                    number.before,
                    number.after
                );
            }
        } else if pattern.contains(WILDCARDS) {
            let paths = self.matching(pattern)?;
            self.files.extend(paths.into_iter().filter(|path| may_be_file(path)).map(FrameFile::new));
        } else {
            // Houdini and other programs write the frame number like this.
            let is_foreign = name.contains("$F") || name.contains("@@");
            let hint = if is_foreign { "; the number is written ####, as in dam.####.bgeo" } else { "" };
            bail!("{pattern}: no such file or folder{hint}");
        }
        if self.count() == count_before {
            bail!("{pattern}: no file matches");
        }
        Ok(())
    }

    fn add_numbered(&mut self, input: &Path, number: &NumberPattern<'_>) -> Result<()> {
        for folder in self.folders(input.parent().unwrap_or(Path::new("")))? {
            let files = files_in(&folder).unwrap_or_else(|error| {
                self.note_unreadable(&folder, &error);
                Vec::new()
            });
            for path in files {
                let span =
                    path.file_name().and_then(|name| name.to_str()).and_then(|name| number.span_in(name));
                if let Some(span) = span {
                    self.files.push(FrameFile::with_number_at(path, span));
                }
            }
        }
        Ok(())
    }

    /// The folders that match the folder part of a pattern.
    fn folders(&mut self, pattern: &Path) -> Result<Vec<PathBuf>> {
        if pattern.as_os_str().is_empty() || pattern.is_dir() {
            return Ok(vec![pattern.to_owned()]);
        }
        let mut paths = self.matching(&pattern.to_string_lossy())?;
        paths.retain(|path| match path.metadata() {
            Ok(metadata) => metadata.is_dir(),
            Err(error) => {
                self.note_unreadable(path, &error);
                false
            }
        });
        Ok(paths)
    }

    /// The paths that match a glob, sorted by name in each folder. `**` matches nested folders, without those
    /// that a cycle of links repeats. Folders that cannot be listed are recorded as unreadable.
    ///
    /// The walker of the crate `glob` does not end if a folder has two links to its parents, and panics at
    /// names that are not UTF-8.
    fn matching(&mut self, pattern: &str) -> Result<Vec<PathBuf>> {
        let pattern = if cfg!(windows) { pattern.replace('\\', "/") } else { pattern.to_owned() };
        let glob = Glob::new(&pattern)?;
        let base = if glob.base.is_empty() { "." } else { glob.base };
        let depth_max = if glob.is_deep() { usize::MAX } else { glob.parts.len() };
        let walk =
            WalkDir::new(base).min_depth(1).max_depth(depth_max).follow_links(true).sort_by_file_name();
        let mut found = Vec::new();
        for entry in walk.into_iter().filter_entry(|entry| glob.leads_to(entry)) {
            let path = match &entry {
                Ok(entry) => entry.path(),
                Err(error) => error.path().unwrap_or(Path::new(base)),
            };
            let path = if glob.base.is_empty() { path.strip_prefix(".").unwrap_or(path) } else { path };
            // A link that cannot be followed is treated as a file: reading it later reports the error.
            if entry.is_ok() || path.is_symlink() {
                found.extend(glob.matches(path).then(|| path.to_owned()));
            } else if let Err(error) = &entry
                && let Some(error) = error.io_error()
            {
                self.note_unreadable(path, error);
            }
        }
        Ok(found)
    }

    /// Records a path that cannot be examined and may contain frames. A missing path is not recorded.
    fn note_unreadable(&mut self, path: &Path, error: &io::Error) {
        if error.kind() != io::ErrorKind::NotFound {
            self.unreadable.push((path.to_owned(), error.to_string()));
        }
    }
}

/// A glob such as `shots/*/dam*.ply`, split into its parts.
struct Glob<'p> {
    whole: Pattern,
    /// The folder where the search starts: the part before the first wildcard.
    base: &'p str,
    /// The patterns for the names below `base`, one per level.
    parts: Vec<Pattern>,
}

impl<'p> Glob<'p> {
    fn new(pattern: &'p str) -> Result<Glob<'p>> {
        let literal = &pattern[..pattern.find(WILDCARDS).unwrap_or(pattern.len())];
        let (base, rest) = pattern.split_at(literal.rfind('/').map_or(0, |slash| slash + 1));
        let names: Vec<&str> = rest.split('/').filter(|name| !["", "."].contains(name)).collect();
        let parse = |part: &str| Pattern::new(part).with_context(|| pattern.to_owned());
        let whole = parse(&format!("{base}{}", names.join("/")))?;
        Ok(Glob { whole, base, parts: names.iter().map(|name| parse(name)).collect::<Result<_>>()? })
    }

    /// Whether `**` matches folders at any depth.
    fn is_deep(&self) -> bool {
        self.parts.iter().any(|part| part.as_str() == "**")
    }

    fn matches(&self, path: &Path) -> bool {
        self.whole.matches_with(&path.to_string_lossy(), GLOB_OPTIONS)
    }

    /// Whether an entry can match, or be a folder on the way to paths that match.
    fn leads_to(&self, entry: &DirEntry) -> bool {
        let name = entry.file_name().to_string_lossy();
        let parts = &self.parts[..entry.depth().min(self.parts.len())];
        if parts.iter().any(|part| part.as_str() == "**") {
            let asks_for_hidden = self.parts.iter().any(|part| part.as_str().starts_with('.'));
            return asks_for_hidden || !name.starts_with('.');
        }
        // The folder where the search starts has no part.
        parts.last().is_none_or(|part| part.matches_with(&name, GLOB_OPTIONS))
    }
}

/// The characters that make text a glob.
const WILDCARDS: [char; 3] = ['*', '?', '['];

/// The number of sub-folders of a folder, without hidden ones.
fn subfolder_count(folder: &Path) -> usize {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let is_hidden = |name: &std::ffi::OsStr| name.as_encoded_bytes().starts_with(b".");
    entries.filter(|entry| !is_hidden(&entry.file_name()) && entry.path().is_dir()).count()
}

/// Whether a path can be a pattern: its name has a placeholder for a number, or it contains wildcards.
pub(super) fn is_pattern(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    NumberPattern::find(name).is_some() || path.to_string_lossy().contains(WILDCARDS)
}

/// What a file in a folder is. A name that promises a frame is sufficient for a file that cannot be read:
/// reading the frame reports the error. Level sets are only taken by name.
///
/// # Errors
/// If only the content can decide, and it cannot be read.
fn content_in_folder(path: &Path, columns: Option<&ColumnNames>) -> io::Result<SniffedContent> {
    if is_level_set(path) {
        return Ok(SniffedContent::NotParticles);
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    content_with(path, columns)
        .or_else(|error| if promises_particles(&name) { Ok(SniffedContent::Particles) } else { Err(error) })
}

/// Whether a file joins other files to frames.
fn joins_files(path: &Path) -> bool {
    is_named_list(path) && matches!(content(path), Ok(SniffedContent::Particles))
}

/// The sub-folders of a folder whose names are numbers, such as those of times.
fn numbered_folders_in(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let names = entries.map(|entry| entry.file_name()).filter(|name| name.to_str().is_some_and(is_number));
    names.map(|name| folder.join(name)).filter(|path| path.is_dir()).collect()
}

const GLOB_OPTIONS: MatchOptions =
    MatchOptions { case_sensitive: true, require_literal_separator: true, require_literal_leading_dot: true };
