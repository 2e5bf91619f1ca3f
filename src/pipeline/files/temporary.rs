//! Temporary files, under names that other programs ignore.
//!
//! A temporary file is in the folder of its final file, so that the rename stays within one file system. Its
//! name begins with a dot, so that programs that watch for frames ignore it. It ends in a random number,
//! because several machines may write into one shared folder, and must not touch each other's files.
//!
//! ```text
//!   .dam.0012.glb.tmp-9f3c02d1a47be658
//!   └ hidden      └ 16 hexadecimal digits, random each time
//! ```
//!
//! The writer holds an advisory lock on the file until it is renamed. A process that is killed leaves its
//! files but loses its locks, so [`sweep_temporaries`](super::sweep::sweep_temporaries) can identify
//! abandoned files.
//!
//! A file that cannot be removed is recorded; [`remove_left_behind`](super::sweep::remove_left_behind) tries
//! again.

use std::collections::HashSet;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::hash::{BuildHasher, RandomState};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use super::identity::is_still_at;
use super::open::open_itself;

/// A temporary file. Dropping it, also in a panic, removes the file unless it was renamed.
pub(crate) struct Temporary {
    path: PathBuf,
    file: File,
}

impl Temporary {
    /// Creates a file beside `path`.
    ///
    /// # Errors
    /// When the system reports an error.
    pub(crate) fn create(path: &Path) -> io::Result<Temporary> {
        let name = path.file_name().ok_or(io::ErrorKind::InvalidFilename)?.to_string_lossy();
        Temporary::create_named(path, || temporary_name(&name, random_number()))
    }

    /// Creates a file beside `path`, under the first of these names that is not taken.
    fn create_named(path: &Path, mut next_name: impl FnMut() -> String) -> io::Result<Temporary> {
        // The mutex of the set is held until the new file is in the set, so that `stop_writing`, which locks
        // the same mutex, removes every temporary file.
        let mut temporaries = active_temporaries();
        let mut attempt_count = 0;
        loop {
            let temporary = path.with_file_name(next_name());
            attempt_count += 1;
            let found = match create_locked(&temporary) {
                Ok(Some(file)) => {
                    temporaries.insert(temporary.clone());
                    return Ok(Temporary { path: temporary, file });
                }
                Ok(None) => io::ErrorKind::AlreadyExists.into(),
                Err(error) => error,
            };
            if found.kind() != io::ErrorKind::AlreadyExists || attempt_count == ATTEMPTS_MAX {
                return Err(found);
            }
        }
    }

    /// Its path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The file, open for writing.
    pub(crate) fn file(&self) -> &File {
        &self.file
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        // After a rename there is nothing to remove. An error here is not reported: the error that made the
        // caller drop the file is more useful.
        if remove_if_exists(&self.path).is_err() {
            record_left_behind(self.path.clone());
        }
        active_temporaries().remove(&self.path);
    }
}

/// Removes a file, if it exists.
///
/// # Errors
/// When the system reports an error.
pub(crate) fn remove_if_exists(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

/// Files of this process that could not be removed.
fn left_behind() -> MutexGuard<'static, HashSet<PathBuf>> {
    static LEFT_BEHIND: LazyLock<Mutex<HashSet<PathBuf>>> = LazyLock::new(Mutex::default);
    // A poisoned set is consistent, as in `active_temporaries`.
    LEFT_BEHIND.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Takes the list of all files of this process that could not be removed.
pub(crate) fn take_left_behind() -> HashSet<PathBuf> {
    std::mem::take(&mut *left_behind())
}

/// The number of files of this process that could not be removed.
pub(crate) fn left_behind_count() -> usize {
    left_behind().len()
}

/// Records a file that could not be removed.
pub(crate) fn record_left_behind(path: PathBuf) {
    left_behind().insert(path);
}

/// The temporary files of this process.
pub(crate) fn active_temporaries() -> MutexGuard<'static, HashSet<PathBuf>> {
    static ACTIVE: LazyLock<Mutex<HashSet<PathBuf>>> = LazyLock::new(Mutex::default);
    // Each update is a single insertion or removal, so a set whose lock is poisoned is still consistent.
    ACTIVE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Creates a locked file; `None` if another process swept it away before it was locked.
pub(crate) fn create_locked(path: &Path) -> io::Result<Option<File>> {
    // Opens neither an existing file, because another process may be writing it, nor a link.
    let file = OpenOptions::new().write(true).create_new(true).open(path)?;
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => return Ok(None),
        Ok(()) => {}
        // The file system has no locks. Sweeps then judge by the age of the file.
        Err(TryLockError::Error(_)) => {}
    }
    Ok(is_still_at(path, &file).then_some(file))
}

/// Locks a file that a process has abandoned. Returns `None` if the file is still in use, or no longer
/// exists.
///
/// # Errors
/// When the system reports an error.
pub(crate) fn lock_abandoned(path: &Path) -> io::Result<Option<File>> {
    // Some file systems only lock files that are open for writing.
    let file = match open_itself(path, OpenOptions::new().read(true).write(true)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file?,
    };
    let age = SystemTime::now().duration_since(file.metadata()?.modified()?).unwrap_or(Duration::ZERO);
    let is_abandoned = is_abandoned(file.try_lock(), age);
    Ok((is_abandoned && is_still_at(path, &file)).then_some(file))
}

fn is_abandoned(locked: Result<(), TryLockError>, age: Duration) -> bool {
    match locked {
        Ok(()) => true,
        Err(TryLockError::WouldBlock) => false,
        Err(TryLockError::Error(_)) => age > UNLOCKED_AGE_MAX,
    }
}

/// A hidden name for the file `name`, truncated if it is too long.
pub(crate) fn temporary_name(name: &str, number: u64) -> String {
    let suffix = format!("{TEMPORARY_MARK}{number:016x}");
    let bytes_max = NAME_BYTES_MAX - 1 - suffix.len();
    let kept_bytes = (0..=bytes_max.min(name.len())).rev().find(|&end| name.is_char_boundary(end));
    format!(".{}{suffix}", &name[..kept_bytes.unwrap_or(0)])
}

/// Whether this is the name of a temporary file of this program.
pub(crate) fn is_temporary_name(name: &str) -> bool {
    let is_digit = |byte: u8| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
    let number = name.strip_prefix('.').and_then(|name| name.rsplit_once(TEMPORARY_MARK));
    number.is_some_and(|(_, number)| number.len() == 16 && number.bytes().all(is_digit))
}

/// A different number at each call, in each process and on each machine.
pub(crate) fn random_number() -> u64 {
    // The keys of hash maps come from the system's randomness.
    RandomState::new().hash_one(std::process::id())
}

/// The part of a temporary file's name before its number.
const TEMPORARY_MARK: &str = ".tmp-";

/// The longest file name on most file systems.
const NAME_BYTES_MAX: usize = 255;

/// Maximum number of names to try: if this many random names are taken, something else is wrong.
const ATTEMPTS_MAX: usize = 16;

/// On a file system without locks, a temporary file older than this is abandoned: no frame takes so long to
/// write.
const UNLOCKED_AGE_MAX: Duration = Duration::from_secs(24 * 60 * 60);

#[cfg(test)]
mod tests {
    use super::*;
    use tempfile::tempdir;

    #[test]
    fn file_of_another_writer_is_not_touched() {
        let folder = tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        let occupied = folder.path().join(temporary_name("a.glb", 0));
        fs::write(&occupied, "of another writer").expect("written");
        let mut number = 0;
        let mut count_up = || {
            number += 1;
            temporary_name("a.glb", number - 1)
        };
        let temporary = Temporary::create_named(&path, &mut count_up).expect("created");
        assert_eq!(temporary.path, folder.path().join(temporary_name("a.glb", 1)));
        drop(temporary);
        assert_eq!(fs::read_to_string(&occupied).expect("still there"), "of another writer");
        assert_eq!(fs::read_dir(folder.path()).expect("there").count(), 1);
        let always_taken = Temporary::create_named(&path, || temporary_name("a.glb", 0));
        assert_eq!(always_taken.err().map(|error| error.kind()), Some(io::ErrorKind::AlreadyExists));
    }

    #[test]
    fn without_locks_only_old_files_are_abandoned() {
        let unsupported = || Err(TryLockError::Error(io::ErrorKind::Unsupported.into()));
        assert!(!is_abandoned(unsupported(), Duration::from_secs(3600)));
        assert!(is_abandoned(unsupported(), Duration::from_secs(25 * 3600)));
        assert!(!is_abandoned(Err(TryLockError::WouldBlock), Duration::from_secs(25 * 3600)));
    }

    #[test]
    #[cfg_attr(windows, ignore = "a file that is open stays until it is closed")]
    fn file_swept_before_it_was_locked_is_not_used() {
        let folder = tempdir().expect("a folder");
        let path = folder.path().join("a");
        let file = File::create(&path).expect("created");
        assert!(is_still_at(&path, &file));
        fs::remove_file(&path).expect("removed");
        assert!(!is_still_at(&path, &file));
        fs::write(&path, "of another writer").expect("written");
        assert!(!is_still_at(&path, &file));
    }

    #[test]
    fn long_names_are_truncated() {
        let folder = tempdir().expect("a folder");
        for name in ["a".repeat(251) + ".glb", "ü".repeat(125) + ".glb", String::from("a")] {
            let temporary = Temporary::create(&folder.path().join(&name)).expect("created");
            let name = temporary.path.file_name().expect("a name").to_string_lossy().into_owned();
            assert!(name.len() <= NAME_BYTES_MAX && is_temporary_name(&name), "{name}");
        }
    }
}
