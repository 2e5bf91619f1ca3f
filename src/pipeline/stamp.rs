//! What the file system says of a file, and how it tells a file that was written again.

use std::fs::Metadata;
use std::io;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// Size, time of the last write, and which file it is: two files with equal stamps are taken for the
/// same one, unchanged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct FileStamp {
    /// Bytes.
    pub size: u64,
    /// Nanoseconds since 1970 of the last write; negative before.
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
        // On a system that keeps no times, the size and the number have to do.
        let modified = metadata.modified().ok().and_then(nanoseconds);
        FileStamp { size: metadata.len(), modified_ns: modified.unwrap_or(0), inode: inode(metadata) }
    }
}

/// Since 1970; `None` some centuries from then.
fn nanoseconds(time: SystemTime) -> Option<i64> {
    match time.duration_since(UNIX_EPOCH) {
        Ok(after) => i64::try_from(after.as_nanos()).ok(),
        Err(before) => i64::try_from(before.duration().as_nanos()).ok().map(|before| -before),
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn times_before_1970_differ_like_others() {
        let second = Duration::from_secs(1);
        let times = [UNIX_EPOCH - second, UNIX_EPOCH, UNIX_EPOCH + second];
        assert_eq!(times.map(nanoseconds), [Some(-1_000_000_000), Some(0), Some(1_000_000_000)]);
        assert_eq!(nanoseconds(UNIX_EPOCH + 86_400 * second * 365_000), None);
    }
}
