//! Files that appear whole or not at all.
//!
//! ```text
//!   .dam.0012.glb.tmp-9f3c…  written, flushed, on the disk
//!            │ rename
//!            ▼
//!   dam.0012.glb             never seen half written, whatever stops the program
//! ```
//!
//! The temporary file lies in the same folder, so that the rename stays within one file system.
//! Its name begins with a dot: programs that watch for frames do not take it for one. It ends in a
//! random number, because several machines may write into one shared folder, and what another one
//! is writing must not be touched.
//!
//! A program that is about to be stopped takes its temporary files with it, by [`stop_writing`].

use std::collections::HashSet;
use std::fs::{self, File, OpenOptions};
use std::hash::{BuildHasher, RandomState};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};

use meniscus_formats::Result;

/// Large enough that the system call does not matter beside the copy.
const BUFFER_BYTES: usize = 1 << 18;

/// Writes the file at `path`, replacing what is there, once `write` has written all of it.
///
/// # Errors
/// What `write` returns, or what the system refuses. Nothing is left behind then, and a file that
/// was at `path` before is still there, untouched.
pub fn write_whole(path: &Path, write: impl FnOnce(&mut BufWriter<&File>) -> Result<()>) -> Result<()> {
    publish(vec![write_unseen(path, write)?]).map_err(|(_, error)| error)?;
    Ok(())
}

/// A file that is whole and on the disk, and not yet to be seen under its name. It is removed unless it is
/// published.
pub(super) struct Unseen {
    temporary: Temporary,
    path: PathBuf,
    size_bytes: u64,
}

impl Unseen {
    /// The size of the file.
    pub(super) fn size_bytes(&self) -> u64 {
        self.size_bytes
    }
}

/// Writes what is to appear at `path`.
///
/// # Errors
/// What `write` returns, or what the system refuses. Nothing is left behind then.
pub(super) fn write_unseen(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&File>) -> Result<()>,
) -> Result<Unseen> {
    let temporary = Temporary::create(path)?;
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, &temporary.file);
    write(&mut out)?;
    out.flush()?;
    drop(out);
    // Else a crash of the machine could leave the name without the bytes.
    temporary.file.sync_all()?;
    let size_bytes = temporary.file.metadata()?.len();
    Ok(Unseen { temporary, path: path.to_owned(), size_bytes })
}

/// Lets files of one folder appear under their names, in a row, replacing what is there. Returns their
/// paths.
///
/// # Errors
/// The path that cannot be replaced, and why; then none of the files appears.
pub(super) fn publish(files: Vec<Unseen>) -> std::result::Result<Vec<PathBuf>, (PathBuf, io::Error)> {
    // What is sure to fail is found before anything is replaced.
    if let Some(file) = files.iter().find(|file| file.path.symlink_metadata().is_ok_and(|m| m.is_dir())) {
        return Err((file.path.clone(), io::ErrorKind::IsADirectory.into()));
    }
    let mut appeared = Vec::with_capacity(files.len());
    // Locked for all of them: a stop comes before the first or after the last.
    let under_way = under_way();
    for file in &files {
        if let Err(error) = fs::rename(&file.temporary.path, &file.path) {
            for path in &appeared {
                // Without the others it would be half a frame.
                let _ = fs::remove_file(path);
            }
            drop(under_way);
            return Err((file.path.clone(), error));
        }
        appeared.push(file.path.clone());
    }
    drop(under_way);
    if let Some(folder) = appeared.first().and_then(|path| path.parent()) {
        sync_folder(folder);
    }
    Ok(appeared)
}

/// Puts the names in a folder on the disk, where the system can do such a thing. Where it cannot, or
/// fails, a crash of the machine may cost names that are there already; it never shows half a file.
fn sync_folder(folder: &Path) {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let _ = File::open(folder).and_then(|folder| folder.sync_all());
}

/// Removes all files that are not yet whole, and lets no other begin or appear: for a process that ends
/// at once. Whoever is writing waits from now on.
pub fn stop_writing() {
    let under_way = under_way();
    for path in under_way.iter() {
        // There is nobody left to tell.
        let _ = fs::remove_file(path);
    }
    std::mem::forget(under_way);
}

/// A file that is removed unless it is renamed: also when the writer panics.
struct Temporary {
    path: PathBuf,
    file: File,
}

impl Temporary {
    fn create(path: &Path) -> io::Result<Temporary> {
        let name = path.file_name().ok_or(io::ErrorKind::InvalidFilename)?.to_string_lossy();
        Temporary::create_named(path, || temporary_name(&name, random_number()))
    }

    /// Creates a file beside `path`, under the first of these names that is not taken.
    fn create_named(path: &Path, mut next_name: impl FnMut() -> String) -> io::Result<Temporary> {
        // Locked until the file is known: a stop misses none.
        let mut under_way = under_way();
        let mut attempt_count = 0;
        loop {
            let temporary = path.with_file_name(next_name());
            attempt_count += 1;
            // Only ever a new file: never one that somebody else is writing, and never through a
            // link that somebody laid there.
            match OpenOptions::new().write(true).create_new(true).open(&temporary) {
                Ok(file) => {
                    under_way.insert(temporary.clone());
                    return Ok(Temporary { path: temporary, file });
                }
                Err(error)
                    if error.kind() == io::ErrorKind::AlreadyExists && attempt_count < ATTEMPTS_MAX => {}
                Err(error) => return Err(error),
            }
        }
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        // Renamed, it is not there any more. And if it cannot be removed, the error that led here
        // is the one worth telling.
        let _ = fs::remove_file(&self.path);
        under_way().remove(&self.path);
    }
}

/// The temporary files there are.
fn under_way() -> MutexGuard<'static, HashSet<PathBuf>> {
    static UNDER_WAY: LazyLock<Mutex<HashSet<PathBuf>>> = LazyLock::new(Mutex::default);
    // A set of names is in order whatever panicked beside it.
    UNDER_WAY.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A hidden name for what will be called `name`; as much of that as fits.
fn temporary_name(name: &str, number: u64) -> String {
    let suffix = format!(".tmp-{number:016x}");
    let bytes_max = NAME_BYTES_MAX - 1 - suffix.len();
    let kept_bytes = (0..=bytes_max.min(name.len())).rev().find(|&end| name.is_char_boundary(end));
    format!(".{}{suffix}", &name[..kept_bytes.unwrap_or(0)])
}

/// Another number at each call, in each process and on each machine.
fn random_number() -> u64 {
    // The keys of hash maps come from the system's randomness.
    RandomState::new().hash_one(std::process::id())
}

/// The longest file name on most file systems.
const NAME_BYTES_MAX: usize = 255;

/// Random names that are taken one after the other mean that something else is wrong.
const ATTEMPTS_MAX: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;
    use std::panic::{AssertUnwindSafe, catch_unwind};

    fn names_in(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).expect("the folder is there");
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect()
    }

    fn write(path: &Path, text: &str) -> Result<()> {
        write_whole(path, |out| Ok(out.write_all(text.as_bytes())?))
    }

    #[test]
    fn a_file_appears_whole_and_replaces_the_one_before() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        for text in ["first", "second"] {
            write(&path, text).expect("written");
            assert_eq!(fs::read_to_string(&path).expect("readable"), text);
        }
        assert_eq!(names_in(folder.path()), ["a.glb"]);
    }

    #[test]
    fn a_writer_that_fails_leaves_nothing_and_the_old_file_as_it_was() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        write(&path, "old").expect("written");
        let disk_full = |out: &mut BufWriter<File>| {
            out.write_all(&vec![0; 2 * BUFFER_BYTES])?;
            Err(io::Error::from(io::ErrorKind::StorageFull).into())
        };
        assert!(write_whole(&path, disk_full).is_err());
        let panicked = catch_unwind(AssertUnwindSafe(|| write_whole(&path, |_| panic!("a broken writer"))));
        assert!(panicked.is_err());
        assert_eq!(fs::read_to_string(&path).expect("readable"), "old");
        assert_eq!(names_in(folder.path()), ["a.glb"]);
    }

    #[test]
    fn a_folder_in_the_way_leaves_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        fs::create_dir(&path).expect("made");
        assert!(write(&path, "text").is_err());
        assert_eq!(names_in(folder.path()), ["a.glb"]);
        assert!(write(&folder.path().join("missing/a.glb"), "text").is_err());
    }

    #[test]
    #[cfg(unix)]
    fn links_are_replaced_and_never_written_through() {
        let folder = tempfile::tempdir().expect("a folder");
        let precious = folder.path().join("precious");
        fs::write(&precious, "precious").expect("written");
        let path = folder.path().join("a.glb");
        std::os::unix::fs::symlink(&precious, &path).expect("linked");
        write(&path, "text").expect("written");
        assert_eq!(fs::read_to_string(&precious).expect("readable"), "precious");
        assert!(!path.is_symlink());
    }

    #[test]
    fn what_somebody_else_is_writing_is_left_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        let taken = folder.path().join(temporary_name("a.glb", 0));
        fs::write(&taken, "of somebody else").expect("written");
        let mut number = 0;
        let mut count_up = || {
            number += 1;
            temporary_name("a.glb", number - 1)
        };
        let temporary = Temporary::create_named(&path, &mut count_up).expect("created");
        assert_eq!(temporary.path, folder.path().join(temporary_name("a.glb", 1)));
        drop(temporary);
        assert_eq!(fs::read_to_string(&taken).expect("still there"), "of somebody else");
        assert_eq!(names_in(folder.path()).len(), 1);
        let always_taken = Temporary::create_named(&path, || temporary_name("a.glb", 0));
        assert_eq!(always_taken.err().map(|error| error.kind()), Some(io::ErrorKind::AlreadyExists));
    }

    #[test]
    fn long_names_are_no_hindrance() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["a".repeat(251) + ".glb", "ü".repeat(125) + ".glb"] {
            write(&folder.path().join(&name), "text").expect("written");
            assert!(temporary_name(&name, u64::MAX).len() <= NAME_BYTES_MAX);
        }
        assert_eq!(names_in(folder.path()).len(), 2);
    }
}
