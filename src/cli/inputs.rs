//! From what was typed as INPUT to files.
//!
//! ```text
//!   dam.0012.bgeo      there is such a file        that file
//!   frames             there is such a folder      the frames in it
//!   dam.####.bgeo      a number in the name        dam.0012.bgeo, dam.10000.bgeo
//!   dam.%04d.bgeo      the same
//!   dam.{}.bgeo        a number of any width       dam.7.bgeo
//!   shots/*/dam*.ply   anything else with * ? []   what matches
//! ```
//!
//! What exists is taken by its name, so that odd characters in names never get in the way.

use std::collections::HashSet;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use glob::MatchOptions;
use meniscus_formats::looks_like_particles;

use crate::pipeline::{FrameFile, NumberPattern, files_in, has_particle_extension, is_own_output};

/// The files that were meant.
#[derive(Debug, Default)]
pub(super) struct Found {
    /// Each once.
    pub(super) files: Vec<FrameFile>,
    /// Files in folders that are no frames.
    pub(super) passed_over_count: usize,
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
        } else {
            found.add_pattern(input)?;
        }
    }
    let mut seen = HashSet::new();
    found.files.retain(|file| seen.insert(entry(&file.path)));
    Ok(found)
}

impl Found {
    /// Takes in what was found elsewhere, each file once.
    pub(super) fn add(&mut self, found: Found) {
        let mut seen: HashSet<PathBuf> = self.files.iter().map(|file| entry(&file.path)).collect();
        self.files.extend(found.files.into_iter().filter(|file| seen.insert(entry(&file.path))));
        self.passed_over_count += found.passed_over_count;
        self.warnings.extend(found.warnings);
    }

    fn add_folder(&mut self, folder: &Path) -> Result<()> {
        let files = files_in(folder).with_context(|| folder.display().to_string())?;
        let count_before = self.files.len();
        let file_count = files.len();
        for path in files {
            match is_frame(&path) {
                Ok(true) => self.files.push(FrameFile::new(path)),
                Ok(false) => self.passed_over_count += 1,
                Err(error) => self.warnings.push(cannot_read(&path, &error)),
            }
        }
        if self.files.len() == count_before {
            bail!("{}: no frames of particles among the {file_count} files of this folder", folder.display());
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
            bail!("{pattern}: no such file or folder");
        }
        if self.files.len() == count_before {
            bail!("{pattern}: no file matches");
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
        let paths = glob::glob_with(pattern, GLOB_OPTIONS).with_context(|| pattern.to_owned())?;
        let warnings = &mut self.warnings;
        let found = paths.filter_map(|path| {
            path.map_err(|error| warnings.push(cannot_read(error.path(), error.error()))).ok()
        });
        Ok(found.collect())
    }
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
    let promises = has_particle_extension(&name) && !has_plain_text_extension(&name);
    // A folder may hold the results of an earlier run beside the frames, and a .ply may be either.
    Ok((promises || head_is_of_particles(path, &name)?) && !is_own_output(path))
}

fn head_is_of_particles(path: &Path, name: &str) -> io::Result<bool> {
    let mut head = Vec::new();
    File::open(path)?.take(HEAD_BYTES).read_to_end(&mut head)?;
    Ok(looks_like_particles(&head, name))
}

/// Names that readme files and logs have, too.
fn has_plain_text_extension(name: &str) -> bool {
    let name = name.to_ascii_lowercase();
    let name = name.strip_suffix(".gz").unwrap_or(&name);
    [".txt", ".dat", ".asc"].iter().any(|extension| name.ends_with(extension))
}

/// What two ways of writing the same name have in common.
fn entry(path: &Path) -> PathBuf {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    folder.join(path.file_name().unwrap_or_default())
}

const GLOB_OPTIONS: MatchOptions =
    MatchOptions { case_sensitive: true, require_literal_separator: true, require_literal_leading_dot: true };
