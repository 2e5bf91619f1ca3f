//! Canonical paths: a file must be found under the same path under which it was recorded.
//!
//! A user may give a folder as `../cache`, from any current folder, through links. Links in its parent
//! folders are resolved. The folder itself may be a link and stays one, because users may redirect it for the
//! next shot.

use std::io;
use std::path::{Path, PathBuf};

/// The path by which the daemon identifies a file or folder, which may not exist: absolute, without `.` and
/// `..`, and without links except in the last component.
///
/// # Errors
/// When the path is empty, or there is no current folder.
pub fn canonical_path(path: &Path) -> io::Result<PathBuf> {
    let path = std::path::absolute(path)?;
    Ok(match (path.parent(), path.file_name()) {
        (Some(folder), Some(name)) => resolved(folder).join(name),
        // The path ends in `..`, which only the system can resolve.
        _ => resolved(&path),
    })
}

/// Resolves the links of the folder, as far as it exists.
fn resolved(folder: &Path) -> PathBuf {
    if let Ok(real) = folder.canonicalize() {
        return real;
    }
    match (folder.parent(), folder.file_name()) {
        (Some(outer), Some(name)) => resolved(outer).join(name),
        // In a missing folder, `..` is resolved by name.
        (Some(outer), None) => resolved(outer).parent().unwrap_or(outer).to_owned(),
        (None, _) => folder.to_owned(),
    }
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;

    #[test]
    fn different_paths_of_a_file_have_one_canonical_path() {
        let scratch = tempfile::tempdir().expect("a folder");
        let top = scratch.path().canonicalize().expect("there");
        fs::create_dir_all(top.join("a/b")).expect("made");
        symlink(top.join("a"), top.join("link")).expect("linked");
        for (typed, expected) in [
            ("a/b/c.ply", "a/b/c.ply"),
            ("a/../a/./b/c.ply", "a/b/c.ply"),
            ("link/b/c.ply", "a/b/c.ply"),
            ("a/b/..", "a"),
            ("link", "link"),
            ("a/b/../../link", "link"),
            ("missing/x/../c.ply", "missing/c.ply"),
            ("link/missing/c.ply", "a/missing/c.ply"),
        ] {
            assert_eq!(canonical_path(&top.join(typed)).expect(typed), top.join(expected), "{typed}");
        }
        assert!(canonical_path(Path::new("")).is_err());
    }
}
