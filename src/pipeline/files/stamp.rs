//! File stamps (size, times, inode), which show that a file was written again.

use std::fs::Metadata;
use std::io;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

/// Size, times and inode of a file: two files with equal stamps are treated as the same, unchanged file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct FileStamp {
    /// In bytes.
    #[serde(rename = "size_bytes")]
    pub size: u64,
    /// The modification time in nanoseconds since 1970; negative before.
    #[serde(default)]
    pub modified_ns: i64,
    /// The inode number; 0 on Windows.
    #[serde(default)]
    pub inode: u64,
    /// The status change time (ctime) in nanoseconds since 1970. A program can set back the modification
    /// time, but not the status change time, which therefore reveals a rewritten file with its old
    /// modification time. `chmod`, new hard links and restored backups change this time, too. So if only this
    /// time differs, the contents have to be compared. `None` on systems without ctime.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub changed_ns: Option<i64>,
}

impl FileStamp {
    /// The stamp of the file at `path`; follows links.
    ///
    /// # Errors
    /// When the system reports an error.
    pub fn of_path(path: &Path) -> io::Result<FileStamp> {
        Ok(FileStamp::of(&path.metadata()?))
    }

    /// The stamp of a file with this metadata.
    pub fn of(metadata: &Metadata) -> FileStamp {
        // On a system without file times, only the size and the inode are compared.
        let modified = metadata.modified().ok().and_then(nanoseconds);
        FileStamp {
            size: metadata.len(),
            modified_ns: modified.unwrap_or(0),
            inode: inode(metadata),
            changed_ns: status_change(metadata),
        }
    }

    /// Whether a file that had this stamp is unchanged, given its current stamp `now`. The status change time
    /// is compared only if both stamps have it.
    pub fn still_holds(&self, now: &FileStamp) -> bool {
        let changes = self.changed_ns.zip(now.changed_ns);
        self.without_status_change() == now.without_status_change()
            && changes.is_none_or(|(was, is)| was == is)
    }

    /// The same stamp without the status change time.
    #[must_use]
    pub fn without_status_change(&self) -> FileStamp {
        FileStamp { changed_ns: None, ..*self }
    }
}

/// The current time in milliseconds since 1970. A clock before 1970 counts as 1970.
pub fn now_ms() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

/// Nanoseconds since 1970; `None` for times that do not fit into 64 bits.
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

/// Windows has a number, too, but only for an open file.
#[cfg(windows)]
fn inode(_metadata: &Metadata) -> u64 {
    0
}

#[cfg(unix)]
fn status_change(metadata: &Metadata) -> Option<i64> {
    use std::os::unix::fs::MetadataExt;
    metadata.ctime().checked_mul(1_000_000_000)?.checked_add(metadata.ctime_nsec())
}

#[cfg(windows)]
fn status_change(_metadata: &Metadata) -> Option<i64> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn unknown_status_change_is_not_compared() {
        let stamp = |changed_ns| FileStamp { size: 1, modified_ns: 2, inode: 3, changed_ns };
        for (was, now, expected) in [
            (Some(4), Some(4), true),
            (Some(4), Some(5), false),
            (None, Some(5), true),
            (Some(4), None, true),
            (None, None, true),
        ] {
            assert_eq!(stamp(was).still_holds(&stamp(now)), expected, "{was:?} {now:?}");
        }
        assert!(!stamp(None).still_holds(&FileStamp { size: 9, ..stamp(None) }));
    }

    #[cfg(unix)]
    #[test]
    fn rewritten_file_with_old_modification_time_has_another_stamp() {
        use std::fs::{self, File};
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a");
        fs::write(&path, "text").expect("written");
        let before = FileStamp::of_path(&path).expect("there");
        let modified = fs::metadata(&path).and_then(|metadata| metadata.modified()).expect("a time");
        // The file system's clock ticks every few milliseconds.
        while FileStamp::of_path(&path).expect("there").changed_ns == before.changed_ns {
            fs::write(&path, "TEXT").expect("written");
            File::options()
                .write(true)
                .open(&path)
                .and_then(|file| file.set_modified(modified))
                .expect("set");
        }
        let after = FileStamp::of_path(&path).expect("there");
        assert_eq!(after.without_status_change(), before.without_status_change());
        assert!(!before.still_holds(&after));
    }

    #[test]
    fn times_before_1970_differ_like_others() {
        let second = Duration::from_secs(1);
        let times = [UNIX_EPOCH - second, UNIX_EPOCH, UNIX_EPOCH + second];
        assert_eq!(times.map(nanoseconds), [Some(-1_000_000_000), Some(0), Some(1_000_000_000)]);
        assert_eq!(nanoseconds(UNIX_EPOCH + 86_400 * second * 365_000), None);
    }
}
