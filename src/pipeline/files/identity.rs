//! Which paths lead to the same file or folder.
//!
//! ```text
//!   in/dam.1.ply   a hard link, a link, another mount, or another case of the letters: the same file
//!   in/../in/x     the same directory entry as `in/x`, which may be a link itself
//! ```

use std::fs::{File, Metadata};
use std::path::{Path, PathBuf};

/// Identifies a file or folder, whatever path leads to it. Links are followed.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum FileId {
    /// Its device and its inode.
    Inode(u64, u64),
    /// The canonical path of what does not exist, or is on a system without inodes.
    Path(PathBuf),
}

impl FileId {
    /// The identity of the file or folder at a path, existing or not.
    pub fn of(path: &Path) -> FileId {
        match path.metadata().ok().and_then(|metadata| device_and_inode(&metadata)) {
            Some((device, inode)) => FileId::Inode(device, inode),
            None => FileId::Path(path.canonicalize().unwrap_or_else(|_| canonical_path(path))),
        }
    }
}

/// Whether two paths lead to the same file or folder, existing or not.
pub fn are_same_file(one: &Path, other: &Path) -> bool {
    FileId::of(one) == FileId::of(other)
}

/// Whether an open file still has this path. A link at the path is not followed. On systems without inodes,
/// whether anything has this path.
pub(crate) fn is_still_at(path: &Path, file: &File) -> bool {
    match (path.symlink_metadata(), file.metadata()) {
        (Ok(at_path), Ok(open)) => device_and_inode(&at_path) == device_and_inode(&open),
        _ => false,
    }
}

/// The path of a directory entry, which may not exist: absolute, without `.` and `..`, and without links
/// except in the last component. Renaming a file to this path replaces the entry, and not what a link there
/// leads to.
pub fn canonical_path(path: &Path) -> PathBuf {
    // This fails for an empty path, or without a current folder.
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    match (path.parent(), path.file_name()) {
        (Some(folder), Some(name)) => resolved(folder).join(name),
        // The path ends in `..`, which only the system can resolve.
        _ => resolved(&path),
    }
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

/// The device and the inode of a file; `None` on systems without inodes.
#[cfg(unix)]
pub(crate) fn device_and_inode(metadata: &Metadata) -> Option<(u64, u64)> {
    use std::os::unix::fs::MetadataExt;
    Some((metadata.dev(), metadata.ino()))
}

/// The device and the inode of a file; `None` on systems without inodes.
#[cfg(not(unix))]
pub(crate) fn device_and_inode(_metadata: &Metadata) -> Option<(u64, u64)> {
    None
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;

    #[test]
    fn paths_of_one_file_are_the_same_and_names_of_links_are_not_resolved() {
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
            assert_eq!(canonical_path(&top.join(typed)), top.join(expected), "{typed}");
            assert!(are_same_file(&top.join(typed), &top.join(expected)), "{typed}");
        }
        fs::write(top.join("file"), "").expect("written");
        fs::hard_link(top.join("file"), top.join("hard")).expect("linked");
        symlink("file", top.join("soft")).expect("linked");
        symlink("nowhere", top.join("dangling")).expect("linked");
        fs::write(top.join("other"), "").expect("written");
        for (one, other, are_same) in [
            ("file", "hard", true),
            ("hard", "soft", true),
            ("link", "a", true),
            ("dangling", "a/../dangling", true),
            ("file", "other", false),
            ("file", "missing", false),
            ("missing", "other missing", false),
        ] {
            assert_eq!(are_same_file(&top.join(one), &top.join(other)), are_same, "{one} {other}");
        }
        let open = |name: &str| File::open(top.join(name)).expect("there");
        assert!(is_still_at(&top.join("hard"), &open("file")));
        assert!(!is_still_at(&top.join("soft"), &open("file")));
        assert!(!is_still_at(&top.join("other"), &open("file")));
        assert!(!is_still_at(&top.join("missing"), &open("file")));
    }
}
