//! Decides which files are frames: by name, and if names are ambiguous, by the first bytes.
//!
//! ```text
//!   frames ─┬─ dam.0001.bgeo         taken: has a particle extension, or matches the pattern
//!           ├─ notes.txt             taken by name; then its content decides
//!           ├─ .dam.0002.bgeo.tmp    hidden: never
//!           └─ surfaces ── dam.ply   in an excluded folder: never
//! ```
//!
//! The folder of the outputs is excluded if it lies in the watched folder. But it may also be the watched
//! folder itself, or contain it: then frames and outputs lie side by side, and only their
//! [content](crate::pipeline::content()) can distinguish them. So, of the watched and the excluded folders
//! that contain a file, the innermost decides whether the file is excluded. The content also distinguishes level
//! sets from points in `.vdb`: level sets are frames only if the pattern ends in `.vdb`, and never if this program
//! wrote them.

use std::ffi::OsStr;
use std::fmt;
use std::path::{Path, PathBuf};

use glob::{MatchOptions, Pattern};

use crate::pipeline::has_particle_extension;

/// Selects files by name.
#[derive(Clone, Debug)]
pub struct FileFilter {
    pattern: Option<Pattern>,
    /// Whether sub-folders are scanned.
    is_deep: bool,
    excluded: Vec<PathBuf>,
}

/// Why a pattern is invalid.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PatternError {
    message: String,
}

impl fmt::Display for PatternError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for PatternError {}

impl FileFilter {
    /// Takes the files that `pattern` matches: a glob for the name of a file in the root, or, if it contains
    /// a `/`, for the path of a file in the root or its sub-folders. A pattern that ends in `**`, like no
    /// pattern, takes names with an extension of particle files; without a pattern, only those in the root.
    ///
    /// Hidden files are never taken. Files in one of the `excluded` folders are not taken, unless the root
    /// itself lies in that folder.
    ///
    /// # Errors
    /// When the pattern is malformed.
    pub fn new(pattern: Option<&str>, excluded: Vec<PathBuf>) -> Result<FileFilter, PatternError> {
        let pattern = pattern.map(parse_pattern).transpose()?;
        let is_deep =
            pattern.as_ref().is_some_and(|pattern| pattern.as_str().contains('/') || takes_any(pattern));
        Ok(FileFilter { pattern, is_deep, excluded })
    }

    /// Whether the name of a file within `root` selects it. Excluded folders are compared by path here; only
    /// a scan resolves links.
    pub fn takes(&self, root: &Path, path: &Path) -> bool {
        let Ok(within) = path.strip_prefix(root) else { return false };
        let depth = within.components().count();
        let is_here = depth == 1 || (depth > 1 && self.is_deep);
        let excludes = |folder: &PathBuf| path.starts_with(folder) && !root.starts_with(folder);
        is_here && !self.excluded.iter().any(excludes) && !is_hidden_path(within) && self.takes_name(within)
    }

    /// Whether the path of a file within the root selects it.
    pub(crate) fn takes_name(&self, within: &Path) -> bool {
        let name = within.file_name().unwrap_or_default().to_string_lossy();
        match &self.pattern {
            None => has_particle_extension(&name),
            Some(pattern) if takes_any(pattern) => {
                has_particle_extension(&name)
                    && pattern.matches_with(&within.to_string_lossy(), MATCH_OPTIONS)
            }
            Some(pattern) if !pattern.as_str().contains('/') => pattern.matches_with(&name, MATCH_OPTIONS),
            Some(pattern) => pattern.matches_with(&within.to_string_lossy(), MATCH_OPTIONS),
        }
    }

    /// Whether a folder within the root is entered, by its path alone.
    pub(crate) fn enters(&self, root: &Path, folder: &Path) -> bool {
        folder.strip_prefix(root).is_ok_and(|within| self.is_deep && !is_hidden_path(within))
    }

    /// Whether sub-folders are scanned.
    pub(crate) fn is_deep(&self) -> bool {
        self.is_deep
    }

    /// Folders whose files are not frames.
    pub(crate) fn excluded(&self) -> &[PathBuf] {
        &self.excluded
    }
}

fn parse_pattern(text: &str) -> Result<Pattern, PatternError> {
    Pattern::new(text).map_err(|error| PatternError {
        message: format!("`{text}` is not a valid pattern: {}, at {}", error.msg, error.pos),
    })
}

/// Whether the pattern selects folders and leaves the names of files open: `**`, `shots/**`.
fn takes_any(pattern: &Pattern) -> bool {
    pattern.as_str().rsplit('/').next() == Some("**")
}

/// Whether the name is that of a hidden file.
pub(crate) fn is_hidden(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b".")
}

fn is_hidden_path(within: &Path) -> bool {
    within.components().any(|part| is_hidden(part.as_os_str()))
}

const MATCH_OPTIONS: MatchOptions =
    MatchOptions { case_sensitive: true, require_literal_separator: true, require_literal_leading_dot: true };

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pattern_matches_the_name_or_with_a_slash_the_path() {
        let root = Path::new("/frames");
        for (pattern, path, expected) in [
            (None, "/frames/dam.1.ply", true),
            (None, "/frames/b/dam.1.BGEO.gz", false),
            (Some("**"), "/frames/b/dam.1.BGEO.gz", true),
            (Some("**"), "/frames/dam.1.ply", true),
            (Some("**"), "/frames/b/notes.md", false),
            (Some("**"), "/frames/.cache/dam.1.ply", false),
            (Some("b/**"), "/frames/b/c/dam.1.ply", true),
            (Some("b/**"), "/frames/dam.1.ply", false),
            (None, "/frames/notes.md", false),
            (None, "/frames/.dam.1.ply", false),
            (None, "/frames/.cache/dam.1.ply", false),
            (None, "/elsewhere/dam.1.ply", false),
            (None, "/frames", false),
            (Some("dam.*.ply"), "/frames/b/dam.1.ply", false),
            (Some("dam.*.ply"), "/frames/dam.ply", false),
            (Some("*/dam.*"), "/frames/b/dam.0001", true),
            (Some("*/dam.*"), "/frames/dam.0001", false),
            (Some("*/dam.*"), "/frames/b/c/dam.0001", false),
            (Some("**/dam.*"), "/frames/b/c/dam.0001", true),
            (Some("**/dam.*"), "/frames/dam.0001", true),
            (Some("*"), "/frames/.dam.1.ply", false),
            (Some(".*"), "/frames/.dam.1.ply", false),
            (None, "/frames/dam.1.vdb", true),
            (Some("dam.*"), "/frames/dam.1.vdb", true),
            (Some("dam.*.vdb"), "/frames/dam.1.vdb", true),
            (Some("**/*.vdb"), "/frames/b/dam.1.VDB", false),
            (Some("*.vdb"), "/frames/dam.1.ply", false),
        ] {
            let selection = FileFilter::new(pattern, Vec::new()).expect("a pattern");
            assert_eq!(selection.takes(root, Path::new(path)), expected, "{pattern:?} {path}");
        }
    }

    #[test]
    fn invalid_pattern_is_refused() {
        for pattern in ["a[", "a**", "b/**.ply"] {
            let error = FileFilter::new(Some(pattern), Vec::new()).expect_err(pattern).to_string();
            assert!(error.starts_with(&format!("`{pattern}` is not a valid pattern")), "{error}");
        }
    }
}
