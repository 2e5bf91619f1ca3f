//! Checks whether two paths are the same file.
//!
//! A path has two canonical forms: the directory entry that a rename would replace (only links in the
//! folder's path are resolved), and the file that the path leads to (all links are resolved). Two paths are
//! the same file if they have a form in common. On Unix the device and inode are compared as well, which also
//! detects hard links, bind mounts and file systems that ignore case.

use std::fs;
use std::path::{Path, PathBuf};

/// Whether two paths are the same file, existing or not.
pub fn are_same_file(one: &Path, other: &Path) -> bool {
    let identities = identities(one);
    self::identities(other).iter().any(|identity| identities.contains(identity))
}

/// A key that two paths of the same file have in common.
#[derive(PartialEq, Eq, Hash)]
pub(crate) enum Identity {
    Path(PathBuf),
    #[cfg(unix)]
    Inode(u64, u64),
}

/// All keys of a file, existing or not.
pub(crate) fn identities(path: &Path) -> Vec<Identity> {
    let mut identities = vec![Identity::Path(canonical_entry(path))];
    if let Ok(canonical) = path.canonicalize() {
        identities.push(Identity::Path(canonical));
    }
    #[cfg(unix)]
    if let Ok(metadata) = fs::metadata(path) {
        use std::os::unix::fs::MetadataExt;
        identities.push(Identity::Inode(metadata.dev(), metadata.ino()));
    }
    identities
}

/// The canonical directory entry of a path: resolves links in the folder's path, but not the entry itself.
pub fn canonical_entry(path: &Path) -> PathBuf {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    // A folder that cannot be resolved does not exist, so nothing in it can be replaced.
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    folder.join(path.file_name().unwrap_or_default())
}
