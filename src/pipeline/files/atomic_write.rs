//! Atomic file replacement: a file appears complete or not at all.
//!
//! ```text
//!   .dam.0012.glb.tmp-9f3c…  written, flushed, synced to disk
//!            │ rename
//!            ▼
//!   dam.0012.glb             never visible half written, whatever stops the program
//! ```
//!
//! All files of a frame are written before the first of them is renamed. Then they are renamed one after the
//! other. If that is interrupted, some names have new files and others old ones: such a mixture is never
//! recorded as done, so the frame is converted again.
//! [`stop_writing`] removes the temporary files of a program that is about to exit.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::panic::resume_unwind;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread;
use std::time::Duration;

use meniscus_formats::Result;

use super::stamp::FileStamp;
use super::sweep::remove_left_behind;
use super::temporary::{Temporary, active_temporaries};

/// Size of the write buffer: large enough that the cost of system calls does not matter.
const BUFFER_BYTES: usize = 1 << 18;

/// Writes the file at `path` atomically: it replaces an existing file once `write` has written everything.
///
/// # Errors
/// The error of `write`, or of the system. Then nothing is left behind, and an existing file at `path` is
/// unchanged.
pub fn write_atomically(path: &Path, write: impl FnOnce(&mut BufWriter<&File>) -> Result<()>) -> Result<()> {
    commit(&[StagedFile::write(path, write)?]).map_err(|(_, error)| error)?;
    Ok(())
}

/// Writes a temporary file beside `path` and syncs it to disk.
///
/// # Errors
/// The error of `write`, or of the system. Then nothing is left behind.
fn write_temporary(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&File>) -> Result<()>,
) -> Result<Temporary> {
    remove_left_behind();
    let temporary = Temporary::create(path)?;
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, temporary.file());
    write(&mut out)?;
    out.flush()?;
    drop(out);
    // Without this, after a rename and a crash of the machine, the final name could lead to a file without
    // its bytes.
    temporary.file().sync_all()?;
    Ok(temporary)
}

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
    pub(crate) fn write(
        path: &Path,
        write: impl FnOnce(&mut BufWriter<&File>) -> Result<()>,
    ) -> Result<StagedFile> {
        let temporary = write_temporary(path, write)?;
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

/// Renames a file, and holds the lock of [`active_temporaries`] meanwhile, so that [`stop_writing`] runs
/// before or after the rename, but not during it.
fn rename_locked(from: &Path, to: &Path) -> io::Result<()> {
    let rename = || {
        let _temporaries = active_temporaries();
        fs::rename(from, to)
    };
    let mut renamed = rename();
    for _ in 0..RENAME_RETRIES {
        if !renamed.as_ref().is_err_and(is_held_open) {
            break;
        }
        thread::sleep(RENAME_INTERVAL);
        renamed = rename();
    }
    renamed
}

/// How often, and after which time, a rename is tried again: virus scanners and indexers hold a new file for
/// less than a second.
const RENAME_RETRIES: usize = 10;
const RENAME_INTERVAL: Duration = Duration::from_millis(100);

/// Whether the error may mean that another process holds the file open. On Windows it cannot be replaced
/// then, unless that process allows it.
fn is_held_open(error: &io::Error) -> bool {
    const ERROR_ACCESS_DENIED: i32 = 5;
    const ERROR_SHARING_VIOLATION: i32 = 32;
    cfg!(windows) && matches!(error.raw_os_error(), Some(ERROR_ACCESS_DENIED | ERROR_SHARING_VIOLATION))
}

/// Renames staged files of one folder to their final names, one after the other, and replaces existing files.
///
/// # Errors
/// The path that cannot be replaced, and why. Then it and the paths after it have their old files.
pub(crate) fn commit(files: &[StagedFile]) -> std::result::Result<(), (PathBuf, io::Error)> {
    // A folder at a final path is a failure that can be predicted: it is found before anything is replaced.
    if let Some(file) = files.iter().find(|file| file.path().symlink_metadata().is_ok_and(|m| m.is_dir())) {
        return Err((file.path().to_owned(), io::ErrorKind::IsADirectory.into()));
    }
    for file in files {
        rename_locked(file.written_path(), file.path()).map_err(|error| (file.path().to_owned(), error))?;
    }
    if let Some(folder) = files.first().and_then(|file| file.path().parent()) {
        sync_folder(folder);
    }
    Ok(())
}

/// Syncs the names in a folder to disk, if the system supports that. Without this sync, or if it fails, a
/// crash of the machine may lose new names, but it never leaves half a file.
fn sync_folder(folder: &Path) {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let _ = File::open(folder).and_then(|folder| folder.sync_all());
}

/// Syncs the file to disk again and again while `write` writes it, so that the disk does not wait for the end
/// of a file of many gigabytes.
///
/// # Errors
/// The error of `write`, or of a sync: the system reports a failed sync only once.
pub(crate) fn sync_while<T, E: From<io::Error>>(
    file: &File,
    write: impl FnOnce() -> std::result::Result<T, E>,
) -> std::result::Result<T, E> {
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

/// Removes all temporary files, and blocks all further writes and renames. For a process that exits right
/// afterwards: every thread that writes waits forever. It does not wait for a rename that hangs: then the next start
/// of the program removes the files.
pub fn stop_writing() {
    let (done, is_done) = channel();
    let stop = move || {
        let temporaries = active_temporaries();
        for path in temporaries.iter() {
            // An error cannot be reported any more.
            let _ = fs::remove_file(path);
        }
        remove_left_behind();
        std::mem::forget(temporaries);
        let _ = done.send(());
    };
    if thread::Builder::new().name("stop".into()).spawn(stop).is_ok() {
        let _ = is_done.recv_timeout(STOP_TIMEOUT);
    }
}

/// Longer than a file system takes that responds.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use super::*;
    use std::panic::{AssertUnwindSafe, catch_unwind};

    fn names_in(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).expect("the folder exists");
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect()
    }

    fn write(path: &Path, text: &str) -> Result<()> {
        write_atomically(path, |out| Ok(out.write_all(text.as_bytes())?))
    }

    #[test]
    fn file_appears_complete_and_replaces_the_old_one() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        for text in ["first", "second"] {
            write(&path, text).expect("written");
            assert_eq!(fs::read_to_string(&path).expect("readable"), text);
        }
        assert_eq!(names_in(folder.path()), ["a.glb"]);
    }

    #[test]
    fn failing_writer_leaves_the_old_file_unchanged() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        write(&path, "old").expect("written");
        let disk_full = |out: &mut BufWriter<&File>| {
            out.write_all(&vec![0; 2 * BUFFER_BYTES])?;
            Err(io::Error::from(io::ErrorKind::StorageFull).into())
        };
        assert!(write_atomically(&path, disk_full).is_err());
        let panicked =
            catch_unwind(AssertUnwindSafe(|| write_atomically(&path, |_| panic!("a broken writer"))));
        assert!(panicked.is_err());
        assert_eq!(fs::read_to_string(&path).expect("readable"), "old");
        assert_eq!(names_in(folder.path()), ["a.glb"]);
    }

    #[test]
    fn folder_at_the_path_is_an_error_and_leaves_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        fs::create_dir(&path).expect("made");
        assert!(write(&path, "text").is_err());
        assert_eq!(names_in(folder.path()), ["a.glb"]);
        assert!(write(&folder.path().join("missing/a.glb"), "text").is_err());
    }

    #[test]
    #[cfg_attr(windows, ignore = "a file that is open stays until it is closed")]
    fn failed_rename_removes_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        let names = ["a.glb", "a.obj", "a.vdb"];
        let text = |name: &str| fs::read_to_string(path(name)).expect("readable");
        let staged = |text: &'static str| {
            names.map(|name| {
                StagedFile::write(&path(name), |out| Ok(out.write_all(text.as_bytes())?)).expect("written")
            })
        };
        commit(&staged("old")).expect("renamed");
        assert_eq!(names.map(text), ["old"; 3]);
        // Only the rename reveals this.
        let files = staged("new");
        fs::remove_file(files[1].written_path()).expect("removed");
        assert_eq!(commit(&files).expect_err("the second is gone").0, path("a.obj"));
        drop(files);
        assert_eq!(names.map(text), ["new", "old", "old"]);
        // A folder at the path of an output is found before anything is replaced.
        fs::remove_file(path("a.vdb")).expect("removed");
        fs::create_dir(path("a.vdb")).expect("made");
        assert_eq!(commit(&staged("newer")).expect_err("a folder").0, path("a.vdb"));
        assert_eq!(text("a.glb"), "new");
        let mut found = names_in(folder.path());
        found.sort();
        assert_eq!(found, names);
    }

    #[test]
    #[cfg(unix)]
    fn links_are_replaced_and_never_written_through() {
        let folder = tempfile::tempdir().expect("a folder");
        let users_file = folder.path().join("precious");
        fs::write(&users_file, "precious").expect("written");
        let path = folder.path().join("a.glb");
        std::os::unix::fs::symlink(&users_file, &path).expect("linked");
        write(&path, "text").expect("written");
        assert_eq!(fs::read_to_string(&users_file).expect("readable"), "precious");
        assert!(!path.is_symlink());
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn a_failed_sync_fails_the_file() {
        let (_reader, writer) = io::pipe().expect("a pipe"); // which cannot be synced
        let pipe = File::from(std::os::fd::OwnedFd::from(writer));
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
