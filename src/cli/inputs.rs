//! From what was typed as INPUT to files.
//!
//! ```text
//!   dam.0012.bgeo      there is such a file        that file
//!   frames             there is such a folder      the frames in it
//!   dam.####.bgeo      a number in the name        dam.0012.bgeo, dam.10000.bgeo
//!   dam.%04d.bgeo      the same
//!   dam.{}.bgeo        a number of any width       dam.7.bgeo
//!   shots/*/dam*.ply   anything else with * ? []   what matches
//!   dump.lammpstrj     a file with several steps   each of them
//!   dump.lammpstrj/step=1000   one of its steps    that step
//! ```
//!
//! What exists is taken by its name, so that odd characters in names never get in the way.

use std::collections::HashSet;
use std::ffi::OsString;
use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use glob::{MatchOptions, Pattern};
use meniscus_formats::packing::read_head;
use meniscus_formats::{Error, looks_like_particles};

use crate::pipeline::{
    FrameFile, NumberPattern, files_in, frames_in, is_level_set, is_own_output, open_regular,
    promises_particles, size_bytes, step_of,
};

/// The files that were meant.
#[derive(Debug, Default)]
pub(super) struct Found {
    /// Each once.
    pub(super) files: Vec<FrameFile>,
    /// Files in folders that are no frames: the first by path, and how many.
    pub(super) passed_over: Option<(PathBuf, usize)>,
    /// What could not be looked at, a sentence each.
    pub(super) warnings: Vec<String>,
}

/// As much as tells what a file is.
const HEAD_BYTES: u64 = 64 << 10;

/// Finds the files that the inputs stand for.
///
/// # Errors
/// When an input stands for no file at all.
pub(super) fn find_inputs(inputs: &[PathBuf]) -> Result<Found> {
    let mut found = Found::default();
    for input in inputs {
        if input.is_dir() {
            found.add_folder(input)?;
        } else if input.symlink_metadata().is_ok() {
            found.files.push(FrameFile::new(input.clone()));
        } else if step_of(input).is_some_and(|(file, _)| file.is_file()) {
            size_bytes(input).map_err(|error| anyhow!("{}: {error}", input.display()))?;
            found.files.push(FrameFile::new(input.clone()));
        } else {
            found.add_pattern(input)?;
        }
    }
    let (frames, refused): (Vec<_>, Vec<_>) = found.files.into_iter().map(frames_of).partition(Result::is_ok);
    found.files = frames.into_iter().flatten().flatten().collect();
    for error in refused.into_iter().filter_map(Result::err) {
        // Others are not lost for it.
        if found.files.is_empty() {
            return Err(error);
        }
        found.warnings.push(format!("{error}: left out"));
    }
    let mut seen = HashSet::new();
    found.files.retain(|file| seen.insert(entry(&file.path)));
    Ok(found)
}

/// The steps of a file that has several; else the file. One that cannot be looked through is read later, which says why.
///
/// # Errors
/// When it is beyond a limit, such as that of steps: as one frame it would be read whole for nothing.
fn frames_of(file: FrameFile) -> Result<Vec<FrameFile>> {
    if step_of(&file.path).is_some() {
        return Ok(vec![file]);
    }
    match frames_in(&file.path) {
        Ok(frames) if frames.len() > 1 => Ok(frames.into_iter().map(FrameFile::new).collect()),
        Err(error @ Error::TooLarge { .. }) => bail!("{}: {error}", file.path.display()),
        _ => Ok(vec![file]),
    }
}

impl Found {
    /// Takes in what was found elsewhere, each file once.
    pub(super) fn add(&mut self, found: Found) {
        let mut seen: HashSet<PathBuf> = self.files.iter().map(|file| entry(&file.path)).collect();
        self.files.extend(found.files.into_iter().filter(|file| seen.insert(entry(&file.path))));
        if let Some((first, count)) = found.passed_over {
            self.pass_over(first, count);
        }
        self.warnings.extend(found.warnings);
    }

    /// Counts files that are no frames, of which this is the first by path.
    fn pass_over(&mut self, first: PathBuf, count: usize) {
        let (before, count_before) = self.passed_over.take().unwrap_or_else(|| (first.clone(), 0));
        self.passed_over = Some((before.min(first), count_before + count));
    }

    fn add_folder(&mut self, folder: &Path) -> Result<()> {
        let files = files_in(folder).with_context(|| folder.display().to_string())?;
        let count_before = self.files.len();
        let file_count = files.len();
        let has_level_set = files.iter().any(|path| is_level_set(path));
        for path in files {
            match is_frame(&path) {
                Ok(true) => self.files.push(FrameFile::new(path)),
                Ok(false) => self.pass_over(path, 1),
                Err(error) => self.warnings.push(cannot_read(&path, &error)),
            }
        }
        if self.files.len() == count_before {
            let hint = if has_level_set { ": level sets are given by name, or by a pattern" } else { "" };
            bail!(
                "{}: no frames of particles among the {file_count} files of this folder{hint}",
                folder.display()
            );
        }
        Ok(())
    }

    fn add_pattern(&mut self, input: &Path) -> Result<()> {
        let pattern = input
            .to_str()
            .ok_or_else(|| anyhow!("{}: no such file, and no pattern in UTF-8", input.display()))?;
        let count_before = self.files.len();
        let name = input.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        if let Some(number) = NumberPattern::find(name) {
            self.add_numbered(input, &number)?;
            if self.files.len() == count_before && number.width_min > 1 {
                bail!(
                    "{pattern}: no file matches; for numbers of any width, write {}{{}}{}",
                    number.before,
                    number.after
                );
            }
        } else if pattern.contains(['*', '?', '[']) {
            let paths = self.matching(pattern)?;
            self.files.extend(paths.into_iter().filter(|path| path.is_file()).map(FrameFile::new));
        } else {
            // As Houdini and others write the number of a frame.
            let is_foreign = name.contains("$F") || name.contains("@@");
            let hint = if is_foreign { "; the number is written ####, as in dam.####.bgeo" } else { "" };
            bail!("{pattern}: no such file or folder{hint}");
        }
        if self.files.len() == count_before {
            let why = self.warnings.pop().map_or(String::new(), |why| format!("; {why}"));
            bail!("{pattern}: no file matches{why}");
        }
        Ok(())
    }

    fn add_numbered(&mut self, input: &Path, number: &NumberPattern<'_>) -> Result<()> {
        for folder in self.folders(input.parent().unwrap_or(Path::new("")))? {
            for path in files_in(&folder).with_context(|| input.display().to_string())? {
                let span =
                    path.file_name().and_then(|name| name.to_str()).and_then(|name| number.span_in(name));
                if let Some(span) = span {
                    self.files.push(FrameFile::with_number_at(path, span));
                }
            }
        }
        Ok(())
    }

    /// The folders that the folder part of a pattern stands for.
    fn folders(&mut self, pattern: &Path) -> Result<Vec<PathBuf>> {
        if pattern.as_os_str().is_empty() || pattern.is_dir() {
            return Ok(vec![pattern.to_owned()]);
        }
        let mut paths = self.matching(&pattern.to_string_lossy())?;
        paths.retain(|path| path.is_dir());
        Ok(paths)
    }

    /// What matches a glob. A folder that cannot be looked into costs itself only.
    fn matching(&mut self, pattern: &str) -> Result<Vec<PathBuf>> {
        if pattern.split('/').any(|part| part == "**") {
            return self.matching_below(pattern);
        }
        let paths = glob::glob_with(pattern, GLOB_OPTIONS).with_context(|| pattern.to_owned())?;
        let warnings = &mut self.warnings;
        let found = paths.filter_map(|path| {
            path.map_err(|error| warnings.push(cannot_read(error.path(), error.error()))).ok()
        });
        Ok(found.collect())
    }

    /// The same of one with `**`, which stands for folders within folders: each is looked into once, under its own name
    /// rather than that of a link, for links may lead in circles.
    fn matching_below(&mut self, pattern: &str) -> Result<Vec<PathBuf>> {
        let glob = Pattern::new(pattern).with_context(|| pattern.to_owned())?;
        let matches = |path: &Path| glob.matches_with(&path.to_string_lossy(), GLOB_OPTIONS);
        let literal = &pattern[..pattern.find(['*', '?', '[']).unwrap_or(pattern.len())];
        let base = Path::new(&literal[..literal.rfind('/').map_or(0, |slash| slash + 1)]);
        let (mut pending, mut linked) = (vec![base.to_owned()], Vec::new());
        let (mut found, mut seen) = (Vec::new(), HashSet::new());
        found.extend(matches(base).then(|| base.to_owned()));
        while let Some(folder) = pending.pop().or_else(|| linked.pop()) {
            let shown = if folder.as_os_str().is_empty() { Path::new(".") } else { &folder };
            let entries = shown.canonicalize().and_then(|true_name| match seen.insert(true_name) {
                true => entries_of(shown, pattern.contains("/.")),
                false => Ok(Vec::new()),
            });
            let entries = entries.unwrap_or_else(|error| {
                // What is not there has nothing in it.
                if error.kind() != io::ErrorKind::NotFound {
                    self.warnings.push(cannot_read(shown, &error));
                }
                Vec::new()
            });
            for (name, is_link) in entries {
                let path = folder.join(name);
                found.extend(matches(&path).then(|| path.clone()));
                match is_link {
                    _ if !path.is_dir() => {}
                    true => linked.push(path),
                    false => pending.push(path),
                }
            }
        }
        found.sort();
        Ok(found)
    }
}

/// The names in a folder, and which are links.
fn entries_of(folder: &Path, with_hidden: bool) -> io::Result<Vec<(OsString, bool)>> {
    let mut entries = Vec::new();
    for entry in folder.read_dir()? {
        let entry = entry?;
        let name = entry.file_name();
        if with_hidden || !name.as_encoded_bytes().starts_with(b".") {
            entries.push((name, entry.file_type()?.is_symlink()));
        }
    }
    Ok(entries)
}

fn cannot_read(path: &Path, error: &io::Error) -> String {
    format!("{}: left out, because it cannot be read: {error}", path.display())
}

/// Whether a file of a folder is a frame: by its content, or by a name that promises one, so that
/// a broken frame is an error and not passed over.
///
/// # Errors
/// When only the content can tell, and it cannot be read.
fn is_frame(path: &Path) -> io::Result<bool> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    // A folder may hold the results of an earlier run beside the frames, and a .ply may be either.
    Ok((promises_particles(&name) || head_is_of_particles(path, &name)?) && !is_own_output(path))
}

fn head_is_of_particles(path: &Path, name: &str) -> io::Result<bool> {
    let head = read_head(open_regular(path)?, HEAD_BYTES)?;
    Ok(looks_like_particles(&head, name))
}

/// What two ways of writing the same name have in common.
fn entry(path: &Path) -> PathBuf {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    folder.join(path.file_name().unwrap_or_default())
}

const GLOB_OPTIONS: MatchOptions =
    MatchOptions { case_sensitive: true, require_literal_separator: true, require_literal_leading_dot: true };
