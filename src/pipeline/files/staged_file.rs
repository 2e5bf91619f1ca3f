//! Complete files on disk that do not have their final names yet.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::panic::resume_unwind;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread;
use std::time::Duration;

use super::stamp::FileStamp;
use super::temporary::Temporary;

/// Size of the write buffer: large enough that the cost of system calls does not matter.
pub(crate) const BUFFER_BYTES: usize = 1 << 18;

/// Writes a temporary file beside `path` and syncs it to disk. Returns the file and the result of `write`.
///
/// # Errors
/// The error of `write`, or of the system. Then nothing is left behind.
pub(crate) fn write_temporary<T, E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&File>) -> Result<T, E>,
) -> Result<(Temporary, T), E> {
    let temporary = Temporary::create(path)?;
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, temporary.file());
    let written = write(&mut out)?;
    out.flush()?;
    drop(out);
    // Without this, after a rename and a crash of the machine, the final name could lead to a file without
    // its bytes.
    temporary.file().sync_all()?;
    Ok((temporary, written))
}

/// Syncs the file to disk again and again while `write` writes it, so that the disk does not wait for the end
/// of a file of many gigabytes.
///
/// # Errors
/// The error of `write`, or of a sync: the system reports a failed sync only once.
pub(crate) fn sync_while<T, E: From<io::Error>>(
    file: &File,
    write: impl FnOnce() -> Result<T, E>,
) -> Result<T, E> {
    let (end, ended) = channel::<()>();
    thread::scope(|scope| {
        let syncs = scope.spawn(move || {
            while ended.recv_timeout(SYNC_INTERVAL) == Err(RecvTimeoutError::Timeout) {
                file.sync_data()?;
            }
            Ok(())
        });
        let written = write();
        drop(end);
        let synced = syncs.join().unwrap_or_else(|panic| resume_unwind(panic));
        let written = written?;
        synced.map(|()| written).map_err(|error: io::Error| E::from(error))
    })
}

/// How long [`sync_while`] waits before each sync.
const SYNC_INTERVAL: Duration = Duration::from_millis(100);

/// A complete file on disk that does not have its final name yet. It is removed on drop unless it was renamed
/// before.
pub(crate) struct StagedFile {
    temporary: Temporary,
    path: PathBuf,
    stamp: FileStamp,
}

impl StagedFile {
    /// Writes a file under a temporary name; its final name is `path`.
    ///
    /// # Errors
    /// The error of `write`, or of the system. Then nothing is left behind.
    pub(crate) fn write<E: From<io::Error>>(
        path: &Path,
        write: impl FnOnce(&mut BufWriter<&File>) -> Result<(), E>,
    ) -> Result<StagedFile, E> {
        let (temporary, ()) = write_temporary(path, write)?;
        let stamp = FileStamp::of(&temporary.file().metadata()?);
        Ok(StagedFile { temporary, path: path.to_owned(), stamp })
    }

    /// The stamp after the rename to the final path, which changes only the status change time.
    pub(crate) fn stamp_after_rename(&self) -> FileStamp {
        let renamed = FileStamp::of_path(&self.path).ok();
        let is_same = |now: &FileStamp| now.without_status_change() == self.stamp.without_status_change();
        // If another process has replaced the file meanwhile, the hash decides later.
        renamed.filter(is_same).unwrap_or(self.stamp)
    }

    /// The final path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The current path.
    pub(crate) fn written_path(&self) -> &Path {
        self.temporary.path()
    }
}

/// Syncs the names in a folder to disk, if the system supports that. Without this sync, or if it fails, a
/// crash of the machine may lose new names, but it never leaves half a file.
pub(crate) fn sync_folder(folder: &Path) {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let _ = File::open(folder).and_then(|folder| folder.sync_all());
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::os::fd::OwnedFd;

    use super::*;

    #[test]
    fn a_failed_sync_fails_the_file() {
        let (_reader, writer) = io::pipe().expect("a pipe"); // which cannot be synced
        let pipe = File::from(OwnedFd::from(writer));
        let short = sync_while(&pipe, || Ok::<_, io::Error>(7));
        assert_eq!(short.expect("no sync so far"), 7);
        let long = sync_while(&pipe, || {
            thread::sleep(3 * SYNC_INTERVAL);
            Ok::<_, io::Error>(7)
        });
        assert_eq!(long.expect_err("a pipe").kind(), io::ErrorKind::InvalidInput);
        let refused = sync_while(&pipe, || Err::<(), _>(io::Error::other("full")));
        assert_eq!(refused.expect_err("the error of `write`").to_string(), "full");
    }
}
