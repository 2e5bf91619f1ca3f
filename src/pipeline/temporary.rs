//! Files that are being written, under names that nobody looks for.
//!
//! A temporary file lies in the folder of the file that it becomes, so that the rename stays within one file
//! system. Its name begins with a dot: programs that watch for frames do not take it for one. It ends in a
//! random number, because several machines may write into one shared folder, and what another one is writing
//! must not be touched.
//!
//! ```text
//!   .dam.0012.glb.tmp-9f3c02d1a47be658
//!   └ hidden      └ 16 hexadecimal digits, another number each time
//! ```
//!
//! Who writes one holds an advisory lock on it until it is renamed. A process that is killed leaves its files
//! and loses its locks: so [`sweep_temporaries`] knows which nobody will finish.
//!
//! A file that cannot be removed is remembered, and [`remove_left_behind`] tries again: before the next temporary file is
//! created, in each round of the daemon, and at the end.

use std::collections::HashSet;
use std::fmt;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::hash::{BuildHasher, RandomState};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use super::file_set::{Recovery, is_record_name, record_of_old_file, recover, remove_old_file};
use super::open::open_itself;
use super::stamp::FileStamp;

/// A file that is removed unless it is renamed: also when the writer panics.
pub(super) struct Temporary {
    path: PathBuf,
    file: File,
}

impl Temporary {
    /// Creates a file beside `path`.
    ///
    /// # Errors
    /// When the system refuses.
    pub(super) fn create(path: &Path) -> io::Result<Temporary> {
        let name = path.file_name().ok_or(io::ErrorKind::InvalidFilename)?.to_string_lossy();
        Temporary::create_named(path, || temporary_name(&name, random_number()))
    }

    /// Creates a file beside `path`, under the first of these names that is free.
    ///
    /// # Errors
    /// When the system refuses.
    pub(super) fn create_named(path: &Path, mut next_name: impl FnMut() -> String) -> io::Result<Temporary> {
        remove_left_behind();
        // Locked until the file is known: a stop misses none.
        let mut under_way = under_way();
        let mut attempt_count = 0;
        loop {
            let temporary = path.with_file_name(next_name());
            attempt_count += 1;
            let found = match create_locked(&temporary) {
                Ok(Some(file)) => {
                    under_way.insert(temporary.clone());
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

    /// Where it is.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// The file, open for writing.
    pub(super) fn file(&self) -> &File {
        &self.file
    }

    /// Gives up the lock and leaves the file to [`remove_left_behind`].
    pub(super) fn keep(mut self) {
        let path = std::mem::take(&mut self.path);
        under_way().remove(&path);
        drop(self);
        leave_behind(path);
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        if self.path.as_os_str().is_empty() {
            return;
        }
        // The error that led here is the one worth telling; after a rename the file has another name.
        if remove_if_there(&self.path).is_err() {
            leave_behind(self.path.clone());
        }
        under_way().remove(&self.path);
    }
}

/// Removes a file, if there is one.
///
/// # Errors
/// When the system refuses.
pub(super) fn remove_if_there(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

/// Files of this process that could not be removed.
fn left_behind() -> MutexGuard<'static, HashSet<PathBuf>> {
    static LEFT_BEHIND: LazyLock<Mutex<HashSet<PathBuf>>> = LazyLock::new(Mutex::default);
    // As below.
    LEFT_BEHIND.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Remembers a file that could not be removed.
pub(super) fn leave_behind(path: PathBuf) {
    left_behind().insert(path);
}

/// Tries again to remove what could not be removed before. Returns how many files are left.
pub fn remove_left_behind() -> usize {
    // Not locked meanwhile: the disk may take its time.
    let paths = std::mem::take(&mut *left_behind());
    for path in paths {
        let is_record = is_record_name(&path.file_name().unwrap_or_default().to_string_lossy());
        let removed = if is_record { recover(&path).map(|_| ()) } else { remove_if_there(&path) };
        if removed.is_err() {
            leave_behind(path);
        }
    }
    left_behind().len()
}

/// The temporary files of this process.
pub(super) fn under_way() -> MutexGuard<'static, HashSet<PathBuf>> {
    static UNDER_WAY: LazyLock<Mutex<HashSet<PathBuf>>> = LazyLock::new(Mutex::default);
    // A set of names is in order whatever panicked beside it.
    UNDER_WAY.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A new file with its lock; `None` where somebody swept it away before it was locked.
fn create_locked(path: &Path) -> io::Result<Option<File>> {
    // Only ever a new file: never one that somebody else is writing, and never through a link that
    // somebody laid there.
    let file = OpenOptions::new().write(true).create_new(true).open(path)?;
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => return Ok(None),
        Ok(()) => {}
        // A file system without locks: those who sweep see that, too.
        Err(TryLockError::Error(_)) => {}
    }
    Ok(is_still_at(path, &file).then_some(file))
}

/// Whether the name leads to this file.
fn is_still_at(path: &Path, file: &File) -> bool {
    let stamps = FileStamp::of_path(path).and_then(|there| Ok((there, FileStamp::of(&file.metadata()?))));
    stamps.is_ok_and(|(there, ours)| there.inode == ours.inode)
}

/// What [`sweep_temporaries`] did.
#[derive(Debug, Default)]
pub struct Swept {
    /// How many temporary files it removed, and sets of files it completed or undid.
    pub count: usize,
    /// Records that it left in place: which, why, and what to do.
    pub warnings: Vec<String>,
}

/// Why a folder cannot be swept.
#[derive(Debug)]
pub enum SweepError {
    /// It cannot be listed.
    Folder(io::Error),
    /// Files that an interrupted process replaced only in part cannot be put back.
    Recover {
        /// The record of these files.
        record: PathBuf,
        /// Why.
        source: io::Error,
    },
}

impl fmt::Display for SweepError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            SweepError::Folder(source) => source.fmt(f),
            SweepError::Recover { record, source } => write!(
                f,
                "{}: an interrupted conversion replaced only some of the files in this record, and the others cannot be \
                 put back: {source}; remove the cause and start again, or remove the record to keep the files as they are",
                record.display()
            ),
        }
    }
}

impl std::error::Error for SweepError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            SweepError::Folder(source) | SweepError::Recover { source, .. } => Some(source),
        }
    }
}

/// Whether a file disappeared between two calls.
fn is_gone(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::StaleNetworkFileHandle)
}

/// Removes the temporary files in a folder that nobody is writing, of whatever process or machine, after it has completed each
/// set of files whose process was killed, or put the old files back. Where the file system has no locks, that is
/// those that nobody has written to for a day. Those that may not be removed are left.
///
/// # Errors
/// When the folder cannot be read, or files cannot be put back.
pub fn sweep_temporaries(folder: &Path) -> Result<Swept, SweepError> {
    let (mut records, mut temporaries, mut old_files) = (Vec::new(), Vec::new(), Vec::new());
    for entry in fs::read_dir(folder).map_err(SweepError::Folder)? {
        let entry = match entry {
            Err(error) if is_gone(&error) => continue,
            entry => entry.map_err(SweepError::Folder)?,
        };
        let name = entry.file_name().to_string_lossy().into_owned();
        // One whose type is unknown is gone, or cannot be opened, either.
        let is_file = || entry.file_type().is_ok_and(|kind| kind.is_file());
        if let Some(record) = record_of_old_file(&entry.path()) {
            old_files.push((entry.path(), record));
        } else if is_record_name(&name) && is_file() {
            records.push(entry.path());
        } else if is_temporary_name(&name) && is_file() {
            temporaries.push(entry.path());
        }
    }
    let (mut swept, mut is_other_at_it, mut failure) = (Swept::default(), false, None);
    for path in records {
        match recover(&path) {
            Ok(Recovery::Done) => swept.count += 1,
            Ok(Recovery::InUse) => is_other_at_it = true,
            Ok(Recovery::Left(warning)) => {
                is_other_at_it = true;
                swept.warnings.push(warning);
            }
            // It belongs to another account.
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => is_other_at_it = true,
            // Another process, such as another shard, has just recovered it.
            Err(error) if is_gone(&error) => is_other_at_it = true,
            Err(source) => failure = Some(SweepError::Recover { record: path, source }),
        }
    }
    // Whoever completes a set needs its temporary files.
    if !is_other_at_it && failure.is_none() {
        swept.count += temporaries.iter().filter(|path| sweep(path).unwrap_or(false)).count();
    }
    for (path, record) in old_files {
        let _ = remove_old_file(&path, &record);
    }
    failure.map_or(Ok(swept), Err)
}

/// Removes a temporary file that nobody is writing.
fn sweep(path: &Path) -> io::Result<bool> {
    let Some(_locked) = lock_abandoned(path)? else { return Ok(false) };
    // Locked until it is gone: whoever created it just now finds that out.
    fs::remove_file(path)?;
    Ok(true)
}

/// A file that a process has left, locked; `None` where its process lives.
///
/// # Errors
/// When the system refuses.
pub(super) fn lock_abandoned(path: &Path) -> io::Result<Option<File>> {
    // Some file systems lock only what is open for writing.
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

/// A hidden name for what will be called `name`; as much of that as fits.
fn temporary_name(name: &str, number: u64) -> String {
    let suffix = format!("{TEMPORARY_MARK}{number:016x}");
    let bytes_max = NAME_BYTES_MAX - 1 - suffix.len();
    let kept_bytes = (0..=bytes_max.min(name.len())).rev().find(|&end| name.is_char_boundary(end));
    format!(".{}{suffix}", &name[..kept_bytes.unwrap_or(0)])
}

/// Whether a file may be called so only as a temporary one of this program.
pub(super) fn is_temporary_name(name: &str) -> bool {
    let is_digit = |byte: u8| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
    let number = name.strip_prefix('.').and_then(|name| name.rsplit_once(TEMPORARY_MARK));
    number.is_some_and(|(_, number)| number.len() == 16 && number.bytes().all(is_digit))
}

/// Another number at each call, in each process and on each machine.
pub(super) fn random_number() -> u64 {
    // The keys of hash maps come from the system's randomness.
    RandomState::new().hash_one(std::process::id())
}

/// What stands before the number.
const TEMPORARY_MARK: &str = ".tmp-";

/// The longest file name on most file systems.
const NAME_BYTES_MAX: usize = 255;

/// Random names that are taken one after the other mean that something else is wrong.
const ATTEMPTS_MAX: usize = 16;

/// No frame takes so long to write.
const UNLOCKED_AGE_MAX: Duration = Duration::from_secs(24 * 60 * 60);

#[cfg(test)]
mod tests {
    use super::*;
    use tempfile::tempdir;

    #[test]
    fn what_somebody_else_is_writing_is_left_alone() {
        let folder = tempdir().expect("a folder");
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
        assert_eq!(fs::read_dir(folder.path()).expect("there").count(), 1);
        let always_taken = Temporary::create_named(&path, || temporary_name("a.glb", 0));
        assert_eq!(always_taken.err().map(|error| error.kind()), Some(io::ErrorKind::AlreadyExists));
    }

    #[test]
    fn only_what_nobody_writes_is_swept() {
        let folder = tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        let written = Temporary::create(&path).expect("created");
        let left = folder.path().join(temporary_name("a.glb", 7));
        fs::write(&left, "half a fra").expect("written");
        let others = [
            "a.glb.tmp-0123456789abcdef",
            ".a.tmp-0123456789abcdeg",
            ".a.tmp-012",
            ".tmp",
            ".a.glb",
            "a.glb",
        ];
        for name in others {
            fs::write(folder.path().join(name), "of somebody else").expect("written");
        }
        fs::create_dir(folder.path().join(temporary_name("folder", 7))).expect("made");
        assert_eq!(sweep_temporaries(folder.path()).expect("readable").count, 1);
        assert!(!left.exists() && written.path.exists());
        assert_eq!(fs::read_dir(folder.path()).expect("there").count(), others.len() + 2);
        // As when its process was killed: the file stays and the lock goes.
        let killed = written.path.clone();
        written.file.unlock().expect("unlocked");
        assert_eq!(sweep_temporaries(folder.path()).expect("readable").count, 1);
        assert!(!killed.exists());
        assert!(sweep_temporaries(&folder.path().join("missing")).is_err());
    }

    #[test]
    #[cfg(unix)]
    fn a_link_is_not_followed_and_not_swept() {
        let folder = tempdir().expect("a folder");
        let precious = folder.path().join("precious");
        fs::write(&precious, "precious").expect("written");
        let link = folder.path().join(temporary_name("a.glb", 7));
        std::os::unix::fs::symlink(&precious, &link).expect("linked");
        assert_eq!(sweep_temporaries(folder.path()).expect("readable").count, 0);
        assert!(link.is_symlink() && precious.exists());
    }

    #[test]
    fn without_locks_only_what_is_old_is_abandoned() {
        let unsupported = || Err(TryLockError::Error(io::ErrorKind::Unsupported.into()));
        assert!(!is_abandoned(unsupported(), Duration::from_secs(3600)));
        assert!(is_abandoned(unsupported(), Duration::from_secs(25 * 3600)));
        assert!(!is_abandoned(Err(TryLockError::WouldBlock), Duration::from_secs(25 * 3600)));
    }

    #[test]
    fn a_file_that_was_swept_before_it_was_locked_is_not_used() {
        let folder = tempdir().expect("a folder");
        let path = folder.path().join("a");
        let file = File::create(&path).expect("created");
        assert!(is_still_at(&path, &file));
        fs::remove_file(&path).expect("removed");
        assert!(!is_still_at(&path, &file));
        fs::write(&path, "of somebody else").expect("written");
        assert!(!cfg!(unix) || !is_still_at(&path, &file));
    }

    /// The folder that it lies in is exchanged for a file: then nothing in it can be removed.
    #[test]
    #[cfg(unix)]
    fn file_that_cannot_be_removed_is_removed_later() {
        let folder = tempdir().expect("a folder");
        let [inner, away] = ["inner", "away"].map(|name| folder.path().join(name));
        fs::create_dir(&inner).expect("made");
        let temporary = Temporary::create(&inner.join("a.glb")).expect("created");
        let name = temporary.path.file_name().expect("a name").to_owned();
        fs::rename(&inner, &away).expect("renamed");
        fs::write(&inner, "in the way").expect("written");
        drop(temporary);
        assert!(away.join(&name).exists() && remove_left_behind() > 0);
        fs::remove_file(&inner).expect("removed");
        fs::rename(&away, &inner).expect("renamed");
        // Any writer tries again.
        let start = std::time::Instant::now();
        while inner.join(&name).exists() {
            assert!(start.elapsed() < Duration::from_secs(60), "it is left");
            drop(Temporary::create(&folder.path().join("b.glb")).expect("created"));
        }
    }

    #[test]
    fn long_names_are_no_hindrance() {
        let folder = tempdir().expect("a folder");
        for name in ["a".repeat(251) + ".glb", "ü".repeat(125) + ".glb", String::from("a")] {
            let temporary = Temporary::create(&folder.path().join(&name)).expect("created");
            let name = temporary.path.file_name().expect("a name").to_string_lossy().into_owned();
            assert!(name.len() <= NAME_BYTES_MAX && is_temporary_name(&name), "{name}");
        }
    }
}
