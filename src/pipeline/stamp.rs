//! What the file system says of a file, and how it tells a file that was written again.

use std::fs::Metadata;
use std::io;
use std::path::Path;
use std::time::UNIX_EPOCH;

/// Size, time of the last write, and which file it is: two files with equal stamps are taken for the
/// same one, unchanged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct FileStamp {
    /// Bytes.
    pub size: u64,
    /// Nanoseconds since 1970 of the last write.
    pub modified_ns: i64,
    /// The file's number on its file system; 0 where there is no such thing.
    pub inode: u64,
}

impl FileStamp {
    /// The stamp of the file at `path`; links are followed.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn of_path(path: &Path) -> io::Result<FileStamp> {
        Ok(FileStamp::of(&path.metadata()?))
    }

    /// The stamp of a file with this metadata.
    pub fn of(metadata: &Metadata) -> FileStamp {
        // Before 1970, or on a system that keeps no times: the size and the number have to do.
        let modified = metadata.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        FileStamp {
            size: metadata.len(),
            modified_ns: modified.and_then(|time| i64::try_from(time.as_nanos()).ok()).unwrap_or(0),
            inode: inode(metadata),
        }
    }
}

#[cfg(unix)]
fn inode(metadata: &Metadata) -> u64 {
    std::os::unix::fs::MetadataExt::ino(metadata)
}

#[cfg(not(unix))]
fn inode(_metadata: &Metadata) -> u64 {
    0
}
