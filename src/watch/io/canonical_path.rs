//! One name for each file: what is remembered under one must be found under the same.
//!
//! A folder may be typed as `../cache`, from anywhere, through links. Links in the folders that lead to it
//! are followed; the folder itself may be a link, and stays one, because somebody may let it lead
//! elsewhere for the next shot.

use std::io;
use std::path::{Path, PathBuf};

/// The path by which the daemon knows a file or folder, which need not exist: absolute, without `.` and
/// `..`, and without links but for the last part.
///
/// # Errors
/// When the path is empty, or there is no current folder.
pub fn known_path(path: &Path) -> io::Result<PathBuf> {
    let path = std::path::absolute(path)?;
    Ok(match (path.parent(), path.file_name()) {
        (Some(folder), Some(name)) => resolved(folder).join(name),
        // It ends in `..`: which folder that is, only the system can tell.
        _ => resolved(&path),
    })
}

/// The folder without links, as far as it exists.
fn resolved(folder: &Path) -> PathBuf {
    if let Ok(real) = folder.canonicalize() {
        return real;
    }
    match (folder.parent(), folder.file_name()) {
        (Some(outer), Some(name)) => resolved(outer).join(name),
        // What is not there has no `..` but the one that its name says.
        (Some(outer), None) => resolved(outer).parent().unwrap_or(outer).to_owned(),
        (None, _) => folder.to_owned(),
    }
}

/// The path of `file` as one below `folder`, where it lies there, whatever names either has.
pub fn below(folder: &Path, file: &Path) -> Option<PathBuf> {
    let real = resolved(file.parent()?).join(file.file_name()?);
    let within = real.strip_prefix(resolved(folder)).ok()?;
    Some(folder.join(within))
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;

    #[test]
    fn a_file_has_one_name() {
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
            assert_eq!(known_path(&top.join(typed)).expect(typed), top.join(expected), "{typed}");
        }
        assert!(known_path(Path::new("")).is_err());
    }

    #[test]
    fn a_file_is_found_below_a_folder_by_any_name() {
        let scratch = tempfile::tempdir().expect("a folder");
        let top = scratch.path().canonicalize().expect("there");
        fs::create_dir_all(top.join("a/b")).expect("made");
        symlink(top.join("a"), top.join("link")).expect("linked");
        for (folder, file) in [("a", "a/b/c.ply"), ("a", "link/b/c.ply"), ("link", "a/b/c.ply")] {
            let found = below(&top.join(folder), &top.join(file));
            assert_eq!(found, Some(top.join(folder).join("b/c.ply")), "{folder} {file}");
        }
        assert_eq!(below(&top.join("a/b"), &top.join("a/c.ply")), None);
    }
}
