//! Which files are frames: by their names, and, where names do not tell, by their first bytes.
//!
//! ```text
//!   frames ─┬─ dam.0001.bgeo         taken: a name of particles, or one that the pattern matches
//!           ├─ notes.txt             taken, and then told by its content
//!           ├─ .dam.0002.bgeo.tmp    hidden: never
//!           └─ surfaces ── dam.ply   in an excluded folder: never
//! ```
//!
//! The folder of the outputs is excluded where it lies in the watched one. But it may also be the watched
//! one, or lie around it: then frames and outputs stand side by side, and only [`content`] tells them
//! apart. Level sets (.vdb) are taken only by a pattern that ends in `.vdb`, and never those that this program wrote. So, of the watched and the excluded folders, the innermost around a file decides.

use std::ffi::OsStr;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use glob::{MatchOptions, Pattern};
use meniscus_formats::compression::read_head;
use meniscus_formats::{Format, looks_like_particles, probe, read_provenance};

use crate::pipeline::{
    are_particles, has_particle_extension, is_level_set, open_regular, promises_particles,
};

use crate::watch::config::names_level_sets;

/// Which files are frames, as far as their names tell.
#[derive(Clone, Debug)]
pub struct FileFilter {
    pattern: Option<Pattern>,
    recursive: bool,
    excluded: Vec<PathBuf>,
}

/// Why a pattern is none.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PatternError {
    what: String,
}

/// What a file is, by a look at its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SniffedContent {
    /// A frame, or what its name promises to be one: to be read, if only to say what is wrong with it.
    Particles,
    /// Something that this program wrote.
    OwnOutput,
    /// Anything else.
    NotParticles,
}

impl fmt::Display for PatternError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)
    }
}

impl std::error::Error for PatternError {}

impl FileFilter {
    /// Takes what `pattern` matches: a glob, for the file's name if there is no `/` in it, else for its
    /// path within the root. Without a pattern, names that end like those of particles.
    ///
    /// Nothing is taken that is hidden, or that lies in one of the `excluded` folders, unless the root
    /// lies in it as well.
    ///
    /// # Errors
    /// When the pattern is malformed, or reaches into sub-folders though it is not to be `recursive`.
    pub fn new(
        pattern: Option<&str>,
        recursive: bool,
        excluded: Vec<PathBuf>,
    ) -> Result<FileFilter, PatternError> {
        let pattern = pattern.map(|text| parse_pattern(text, recursive)).transpose()?;
        Ok(FileFilter { pattern, recursive, excluded })
    }

    /// Whether the name of a file within `root` says that it is a frame. Excluded folders are known by
    /// their names here: only a scan sees through links.
    pub fn takes(&self, root: &Path, path: &Path) -> bool {
        let Ok(within) = path.strip_prefix(root) else { return false };
        let depth = within.components().count();
        let is_here = depth == 1 || (depth > 1 && self.recursive);
        let excludes = |folder: &PathBuf| path.starts_with(folder) && !root.starts_with(folder);
        is_here && !self.excluded.iter().any(excludes) && !is_hidden_path(within) && self.takes_name(within)
    }

    /// Whether its name, and the way to it from the root, say that a file is a frame.
    pub(crate) fn takes_name(&self, within: &Path) -> bool {
        let name = within.file_name().unwrap_or_default().to_string_lossy();
        if is_level_set(within) && !names_level_sets(self.pattern.as_ref().map(Pattern::as_str)) {
            return false;
        }
        match &self.pattern {
            None => has_particle_extension(&name),
            Some(pattern) if !pattern.as_str().contains('/') => pattern.matches_with(&name, MATCH_OPTIONS),
            Some(pattern) => pattern.matches_with(&within.to_string_lossy(), MATCH_OPTIONS),
        }
    }

    /// Whether a folder within the root is looked into, as far as its name tells.
    pub(crate) fn enters(&self, root: &Path, folder: &Path) -> bool {
        folder.strip_prefix(root).is_ok_and(|within| self.recursive && !is_hidden_path(within))
    }

    /// Whether sub-folders are looked into.
    pub(crate) fn is_recursive(&self) -> bool {
        self.recursive
    }

    /// Folders whose files are no frames.
    pub(crate) fn excluded(&self) -> &[PathBuf] {
        &self.excluded
    }
}

fn parse_pattern(text: &str, recursive: bool) -> Result<Pattern, PatternError> {
    let pattern = Pattern::new(text).map_err(|error| PatternError {
        what: format!("`{text}` is no pattern: {}, at {}", error.msg, error.pos),
    })?;
    if text.contains('/') && !recursive {
        let what = format!("`{text}` reaches into sub-folders, which are only looked into if asked for");
        return Err(PatternError { what });
    }
    Ok(pattern)
}

/// Looks at the first bytes of a file.
///
/// # Errors
/// When it cannot be read.
pub fn content(path: &Path) -> io::Result<SniffedContent> {
    const HEAD_BYTES: u64 = 64 << 10; // holds the provenance of every output
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    if !path.metadata()?.is_file() {
        return Ok(SniffedContent::NotParticles);
    }
    let head = read_head(open_regular(path)?, HEAD_BYTES)?;
    let promises = promises_particles(&name) || is_level_set(path);
    Ok(if is_own_output(&head, &name) {
        SniffedContent::OwnOutput
    } else if promises || looks_like_particles(&head, &name) {
        SniffedContent::Particles
    } else {
        SniffedContent::NotParticles
    })
}

/// Whether a name is one that listings leave out.
pub(crate) fn is_hidden(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b".")
}

fn is_hidden_path(within: &Path) -> bool {
    within.components().any(|part| is_hidden(part.as_os_str()))
}

/// Whether these are the first bytes of a file that carries this program's provenance.
fn is_own_output(head: &[u8], name: &str) -> bool {
    let format = probe(head, name).kind.format().and_then(Format::output);
    let Some(format) = format.filter(|format| !format.is_picture()) else { return false };
    // A head that is damaged carries none.
    read_provenance(format, head).is_ok_and(|recorded| {
        recorded.iter().any(|(name, _)| name == "generator") && !are_particles(&recorded)
    })
}

const MATCH_OPTIONS: MatchOptions =
    MatchOptions { case_sensitive: true, require_literal_separator: true, require_literal_leading_dot: true };

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    use tempfile::tempdir;

    #[test]
    fn patterns_are_for_names_or_for_ways() {
        let root = Path::new("/frames");
        for (pattern, path, expected) in [
            (None, "/frames/dam.1.ply", true),
            (None, "/frames/b/dam.1.BGEO.gz", true),
            (None, "/frames/notes.md", false),
            (None, "/frames/.dam.1.ply", false),
            (None, "/frames/.cache/dam.1.ply", false),
            (None, "/elsewhere/dam.1.ply", false),
            (None, "/frames", false),
            (Some("dam.*.ply"), "/frames/b/dam.1.ply", true),
            (Some("dam.*.ply"), "/frames/dam.ply", false),
            (Some("*/dam.*"), "/frames/b/dam.0001", true),
            (Some("*/dam.*"), "/frames/dam.0001", false),
            (Some("*/dam.*"), "/frames/b/c/dam.0001", false),
            (Some("**/dam.*"), "/frames/b/c/dam.0001", true),
            (Some("**/dam.*"), "/frames/dam.0001", true),
            (Some("*"), "/frames/.dam.1.ply", false),
            (Some(".*"), "/frames/.dam.1.ply", false),
            (None, "/frames/dam.1.vdb", false),
            (Some("*"), "/frames/dam.1.vdb", false),
            (Some("dam.*"), "/frames/dam.1.vdb", false),
            (Some("dam.*.vdb"), "/frames/dam.1.vdb", true),
            (Some("**/*.vdb"), "/frames/b/dam.1.VDB", false),
            (Some("*.vdb"), "/frames/dam.1.ply", false),
        ] {
            let selection = FileFilter::new(pattern, true, Vec::new()).expect("a pattern");
            assert_eq!(selection.takes(root, Path::new(path)), expected, "{pattern:?} {path}");
        }
    }

    #[test]
    fn patterns_that_could_never_match_are_refused() {
        for (pattern, recursive, words) in
            [("a[", true, "`a[` is no pattern"), ("b/*.ply", false, "sub-folders")]
        {
            let error = FileFilter::new(Some(pattern), recursive, Vec::new()).expect_err(pattern).to_string();
            assert!(error.contains(words), "{error}");
        }
    }

    #[test]
    fn content_tells_frames_from_outputs_and_notes() {
        use meniscus_formats::{MeshOptions, MeshView, OutputFormat, gltf, ply};
        let folder = tempdir().expect("a folder");
        let of = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            fs::write(&path, bytes).expect("written");
            content(&path).expect("readable")
        };
        assert_eq!(of("a.ply", b"ply\nformat ascii 1.0\ncomment by hand\n"), SniffedContent::Particles);
        assert_eq!(of("broken.ply", b"what is this"), SniffedContent::Particles);
        assert_eq!(of("empty.bgeo", b""), SniffedContent::Particles);
        assert_eq!(of("table.txt", b"x y z\n1 2 3\n"), SniffedContent::Particles);
        assert_eq!(of("frame.0001", b"BgeoV\0\0\0\x05"), SniffedContent::Particles);
        assert_eq!(of("readme.txt", b"Read me, please.\n"), SniffedContent::NotParticles);
        assert_eq!(of("mesh.obj", b"v 1 2 3\nv 4 5 6\n"), SniffedContent::NotParticles);
        let mesh = MeshView {
            positions: &[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            normals: &[[0.0, 0.0, 1.0]; 3],
            triangles: &[[0, 1, 2]],
            origin: [0.0; 3],
            attributes: &[],
        };
        let maker = [("generator".to_owned(), "meniscus".to_owned())];
        let mut bytes = Vec::new();
        ply::write::write_mesh(&mesh, &maker, &mut bytes).expect("written");
        assert_eq!(of("surface.ply", &bytes), SniffedContent::OwnOutput);
        bytes.clear();
        ply::write::write_mesh(&mesh, &[], &mut bytes).expect("written");
        assert_eq!(of("foreign.ply", &bytes), SniffedContent::Particles);
        bytes.clear();
        OutputFormat::Obj.write_mesh(&mesh, &MeshOptions::default(), &maker, &mut bytes).expect("written");
        assert_eq!(of("surface.obj", &bytes), SniffedContent::OwnOutput);
        bytes.clear();
        gltf::write_glb(&mesh, &MeshOptions::default(), &maker, &mut bytes).expect("written");
        assert_eq!(of("surface.glb", &bytes), SniffedContent::OwnOutput);
        assert!(content(&folder.path().join("gone.ply")).is_err());
    }
}
