//! Which paths lead to the same file or folder.
//!
//! ```text
//!   in/dam.1.ply   a hard link, a link, another mount, or another case of the letters: the same file
//!   in/../in/x     the same directory entry as `in/x`, which may be a link itself
//! ```

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

/// Identifies a file or folder, whatever path leads to it. Links are followed.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum FileId {
    /// Its device and its inode.
    Inode(u64, u64),
    /// The canonical path of what does not exist or has no inode, as [`entry_key`] gives it.
    Path(PathBuf),
}

impl FileId {
    /// The identity of the file or folder at a path, existing or not.
    pub fn of(path: &Path) -> FileId {
        match device_and_inode(path) {
            Ok((device, inode)) => FileId::Inode(device, inode),
            Err(_) => FileId::Path(entry_key(canonical_path(path))),
        }
    }
}

/// Whether two paths lead to the same file or folder, existing or not.
pub fn are_same_file(one: &Path, other: &Path) -> bool {
    FileId::of(one) == FileId::of(other)
}

/// Whether an open file still has this path. A link at the path is not followed.
pub(crate) fn is_still_at(path: &Path, file: &File) -> bool {
    let is_link = path.symlink_metadata().is_ok_and(|metadata| metadata.is_symlink());
    match (system::numbers_at(path), system::numbers(file)) {
        (Ok(at_path), Ok(open)) => !is_link && at_path == open,
        _ => false,
    }
}

/// The device and the inode of the file or folder at a path; on Windows, the volume and the index. Links are
/// followed.
///
/// # Errors
/// When the path does not exist, or the system refuses.
pub(crate) fn device_and_inode(path: &Path) -> io::Result<(u64, u64)> {
    system::numbers_at(path)
}

/// A path as a key, in which the case of letters does not matter on Windows and macOS: their volumes usually
/// ignore it. A volume that distinguishes it gets one key for two entries, so that one of the two is left out
/// and reported.
pub fn entry_key(path: PathBuf) -> PathBuf {
    if !cfg!(any(windows, target_os = "macos")) {
        return path;
    }
    match path.to_str() {
        Some(text) => text.to_lowercase().into(),
        None => path,
    }
}

/// The path of a directory entry, which may not exist: absolute, without `.` and `..`, and without links
/// except in the last component. Renaming a file to this path replaces the entry, and not what a link there
/// leads to.
pub fn canonical_path(path: &Path) -> PathBuf {
    // This fails for an empty path, or without a current folder.
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    match (path.parent(), path.file_name()) {
        (Some(folder), Some(name)) => resolved(folder, |path| dunce::canonicalize(path)).join(name),
        // The path ends in `..`, which only the system can resolve.
        _ => resolved(&path, |path| dunce::canonicalize(path)),
    }
}

/// The absolute path without links, also in the last component, to compare with others. What does not exist is taken by
/// name; so is a path that the system does not resolve, as Wine does not if it is long. On Windows all have the same
/// prefix, whatever their length.
pub(crate) fn real_path(path: &Path) -> PathBuf {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    resolved(&path, Path::canonicalize)
}

/// Resolves the links of the folder, as far as it exists.
fn resolved(folder: &Path, canonicalize: fn(&Path) -> io::Result<PathBuf>) -> PathBuf {
    if let Ok(real) = canonicalize(folder) {
        return real;
    }
    match (folder.parent(), folder.file_name()) {
        (Some(outer), Some(name)) => resolved(outer, canonicalize).join(name),
        // In a missing folder, `..` is resolved by name.
        (Some(outer), None) => resolved(outer, canonicalize).parent().unwrap_or(outer).to_owned(),
        (None, _) => folder.to_owned(),
    }
}

#[cfg(unix)]
mod system {
    use std::fs::{File, Metadata};
    use std::io;
    use std::os::unix::fs::MetadataExt;
    use std::path::Path;

    pub(super) fn numbers_at(path: &Path) -> io::Result<(u64, u64)> {
        Ok(numbers_of(&path.metadata()?))
    }

    pub(super) fn numbers(file: &File) -> io::Result<(u64, u64)> {
        Ok(numbers_of(&file.metadata()?))
    }

    fn numbers_of(metadata: &Metadata) -> (u64, u64) {
        (metadata.dev(), metadata.ino())
    }
}

#[cfg(windows)]
mod system {
    use std::fs::File;
    use std::io;
    use std::os::windows::fs::OpenOptionsExt;
    use std::path::Path;

    use winapi_util::file::information;

    pub(super) fn numbers_at(path: &Path) -> io::Result<(u64, u64)> {
        // Without access to its contents, a file can be opened while its writer has it exclusively. The flag is
        // needed to open folders.
        const FILE_FLAG_BACKUP_SEMANTICS: u32 = 0x0200_0000;
        numbers(&File::options().access_mode(0).custom_flags(FILE_FLAG_BACKUP_SEMANTICS).open(path)?)
    }

    pub(super) fn numbers(file: &File) -> io::Result<(u64, u64)> {
        let information = information(file)?;
        match information.file_index() {
            // Some network drives have no index.
            0 => Err(io::ErrorKind::Unsupported.into()),
            index => Ok((information.volume_serial_number(), index)),
        }
    }
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
        let top = dunce::canonicalize(scratch.path()).expect("there");
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
