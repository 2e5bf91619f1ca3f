//! Whether two names lead to one file.
//!
//! Names are compared after links are followed, in two ways: the entry in its folder that a rename
//! would replace, and the file that the name leads to. On Unix the file's own identity is compared
//! too, which also sees through hard links, bind mounts and file systems that ignore case.

use std::fs;
use std::path::{Path, PathBuf};

/// Whether two paths name one file, be it there or not.
pub fn are_one_file(one: &Path, other: &Path) -> bool {
    let identities = identities(one);
    self::identities(other).iter().any(|identity| identities.contains(identity))
}

/// Something that two names of one file have in common.
#[derive(PartialEq, Eq, Hash)]
pub(crate) enum Identity {
    Path(PathBuf),
    #[cfg(unix)]
    Inode(u64, u64),
}

/// All that is known of the identity of a file, be it there or not.
pub(crate) fn identities(path: &Path) -> Vec<Identity> {
    let mut identities = vec![Identity::Path(entry(path))];
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

/// The entry in its folder that a path names: links in the folder's path are followed, the entry
/// itself is not.
pub fn entry(path: &Path) -> PathBuf {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    // What cannot be resolved does not exist: nothing in it is replaced.
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    folder.join(path.file_name().unwrap_or_default())
}
