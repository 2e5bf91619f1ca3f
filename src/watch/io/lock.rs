//! A lock that allows one daemon for each folder of outputs.
//!
//! ```text
//!   OUT/.meniscus/lock     pid 4711 on render-04 since 2026-03-01T08:15:00Z
//! ```
//!
//! The lock is an advisory lock of the operating system on a file that is never removed. The system releases
//! it when the process ends, for whatever reason, so no code has to guess whether a process id in a file
//! belongs to a live process. The content of the file is for people only.
//!
//! A file system without locks is reported as an error. There is no substitute: a lock file would either stay
//! behind after the daemon is killed, or let a second daemon in.

use std::fmt;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crate::pipeline::host_name;
use crate::pipeline::{STATE_FOLDER, is_still_at, open_itself};

/// The name of the lock file, in the daemon's state folder.
pub(crate) const FILE_NAME: &str = "lock";

/// Number of attempts to take the lock: a process that only checks whether the lock is held takes it for a
/// moment.
const ATTEMPTS_MAX: usize = 5;
const ATTEMPT_PAUSE: Duration = Duration::from_millis(10);

/// Upper limit of the bytes that are read from the lock file. The text written there is shorter.
const HOLDER_BYTES_MAX: u64 = 1024;

/// The exclusive right to write into a folder of outputs. It ends when this value is dropped or the process
/// ends.
#[derive(Debug)]
pub struct OutputLock {
    /// Closing the file releases the lock.
    file: File,
}

/// Why the lock was not taken.
#[derive(Debug)]
pub enum LockError {
    /// Another daemon holds it.
    Held {
        /// The folder of the outputs.
        folder: PathBuf,
        /// A description of the holder.
        by: String,
    },
    /// The file system does not support locks.
    Unsupported {
        /// The folder of the outputs.
        folder: PathBuf,
    },
    /// The system refuses.
    Io {
        /// The lock file.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
}

impl OutputLock {
    /// Locks a folder of outputs, and creates it if it is missing.
    ///
    /// # Errors
    /// When another process holds the lock, the file system does not support locks, or the system refuses.
    pub fn take(out_folder: &Path) -> Result<OutputLock, LockError> {
        let path = lock_path(out_folder);
        let refused = |source| LockError::Io { path: path.clone(), source };
        let state_folder = out_folder.join(STATE_FOLDER);
        if let Err(source) = fs::create_dir_all(&state_folder) {
            let source = match source.kind() {
                io::ErrorKind::AlreadyExists => {
                    io::Error::new(source.kind(), "this must be a folder, but it is a file: remove the file")
                }
                _ => source,
            };
            return Err(LockError::Io { path: state_folder, source });
        }
        let mut options = OpenOptions::new();
        let options = options.read(true).write(true).create(true).truncate(false);
        let file = open_itself(&path, options).map_err(refused)?;
        let mut attempt_count = 1;
        loop {
            match file.try_lock() {
                Ok(()) => break,
                Err(TryLockError::WouldBlock) if attempt_count < ATTEMPTS_MAX => {
                    attempt_count += 1;
                    std::thread::sleep(ATTEMPT_PAUSE);
                }
                Err(error) => return Err(lock_error(error, out_folder, &file)),
            }
        }
        if let Err(error) = write_holder(&file) {
            // The lock is held all the same; only the text about the holder is missing.
            tracing::warn!(
                lock = %path.display(),
                %error,
                "locked the folder, but cannot write the process id into the lock file"
            );
        }
        Ok(OutputLock { file })
    }

    /// Whether the locked file is still that of this folder: it may have been removed.
    pub fn is_in_place(&self, out_folder: &Path) -> bool {
        is_still_at(&lock_path(out_folder), &self.file)
    }

    /// A description of the process that holds the lock of a folder of outputs; `None` if it is free.
    ///
    /// # Errors
    /// When the file system does not support locks, or the system refuses.
    pub fn holder(out_folder: &Path) -> Result<Option<String>, LockError> {
        let path = lock_path(out_folder);
        let file = match open_itself(&path, OpenOptions::new().read(true)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(LockError::Io { path, source }),
            Ok(file) => file,
        };
        // A shared lock, so that two processes that check at the same time do not take each other for a
        // daemon.
        match file.try_lock_shared() {
            Ok(()) => Ok(None),
            Err(error) => match lock_error(error, out_folder, &file) {
                LockError::Held { by, .. } => Ok(Some(by)),
                error => Err(error),
            },
        }
    }
}

fn lock_path(out_folder: &Path) -> PathBuf {
    out_folder.join(STATE_FOLDER).join(FILE_NAME)
}

fn lock_error(error: TryLockError, out_folder: &Path, file: &File) -> LockError {
    let folder = out_folder.to_owned();
    match error {
        TryLockError::WouldBlock => LockError::Held { folder, by: read_holder(file) },
        TryLockError::Error(error) if is_unsupported(&error) => LockError::Unsupported { folder },
        TryLockError::Error(source) => LockError::Io { path: lock_path(out_folder), source },
    }
}

/// Whether the error means that the file system does not support locks.
fn is_unsupported(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::Unsupported || has_no_lock_service(error)
}

/// Whether this is the error of NFS without its lock service, or of Lustre without `flock`.
#[cfg(unix)]
fn has_no_lock_service(error: &io::Error) -> bool {
    use rustix::io::Errno;
    let errno = Errno::from_io_error(error);
    [Errno::NOLCK, Errno::NOSYS, Errno::OPNOTSUPP, Errno::NOTSUP].into_iter().any(|no| errno == Some(no))
}

/// Whether this is the error of a network drive without locks.
#[cfg(windows)]
fn has_no_lock_service(error: &io::Error) -> bool {
    const ERROR_INVALID_FUNCTION: i32 = 1;
    const ERROR_NOT_SUPPORTED: i32 = 50;
    matches!(error.raw_os_error(), Some(ERROR_INVALID_FUNCTION | ERROR_NOT_SUPPORTED))
}

/// Writes a description of the holder over that of the last one, and truncates the file afterwards, so that
/// it is never empty.
fn write_holder(mut file: &File) -> io::Result<()> {
    let text = format!("pid {} on {} since {}\n", std::process::id(), host_name(), since(SystemTime::now()));
    file.write_all(text.as_bytes())?;
    file.set_len(text.len() as u64)
}

/// A time as text. A clock that was never set may have any value, even one that RFC 3339 cannot express.
fn since(now: SystemTime) -> String {
    match now.duration_since(UNIX_EPOCH) {
        Ok(since) if since < YEAR_10000 => humantime::format_rfc3339_seconds(now).to_string(),
        _ => "an unknown time (the system clock is wrong)".to_owned(),
    }
}

/// The start of the year 10 000, since 1970: the text format has only four digits for the year.
const YEAR_10000: Duration = Duration::from_secs(253_402_300_800);

/// Reads the description of the holder. On Windows only the holder can read it.
fn read_holder(file: &File) -> String {
    let mut text = String::new();
    match file.take(HOLDER_BYTES_MAX).read_to_string(&mut text) {
        Ok(_) if !text.trim().is_empty() => text.lines().next().unwrap_or_default().to_owned(),
        _ => "an unknown process".to_owned(),
    }
}

impl fmt::Display for LockError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            LockError::Held { folder, by } => write!(
                f,
                "another daemon writes into {} ({by}): stop that daemon, or choose another folder",
                folder.display()
            ),
            LockError::Unsupported { folder } => write!(
                f,
                "{} is on a file system without locks, so a second daemon could write there, too: choose a \
                 folder on another file system, or mount this one with locks",
                folder.display()
            ),
            LockError::Io { path, source } => write!(f, "cannot lock {}: {source}", path.display()),
        }
    }
}

impl std::error::Error for LockError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            LockError::Io { source, .. } => Some(source),
            LockError::Held { .. } | LockError::Unsupported { .. } => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use std::io::{BufRead, BufReader};
    use std::process::{Command, Stdio};

    fn folder() -> tempfile::TempDir {
        tempfile::tempdir().expect("a folder")
    }

    #[test]
    fn second_lock_fails_and_names_the_holder() {
        let out = folder();
        let out = out.path().join("not/there/yet");
        assert_eq!(OutputLock::holder(&out).expect("no lock"), None);
        let lock = OutputLock::take(&out).expect("the first");

        let error = OutputLock::take(&out).expect_err("the second");
        let LockError::Held { folder, by } = &error else { panic!("{error}") };
        assert_eq!(folder, &out);
        assert_eq!(OutputLock::holder(&out).expect("locks").as_ref(), Some(by));
        if cfg!(unix) {
            let wanted = format!("pid {} on {} since 2", std::process::id(), host_name());
            assert!(by.starts_with(&wanted), "{by}");
            assert!(error.to_string().contains(by.as_str()), "{error}");
        }

        drop(lock);
        assert_eq!(OutputLock::holder(&out).expect("locks"), None);
        OutputLock::take(&out).expect("the first is gone");
    }

    #[test]
    fn clock_before_1970_or_after_9999_has_a_text() {
        assert_eq!(since(UNIX_EPOCH), "1970-01-01T00:00:00Z");
        assert_eq!(since(UNIX_EPOCH + YEAR_10000 - Duration::from_secs(1)), "9999-12-31T23:59:59Z");
        for time in [UNIX_EPOCH - Duration::from_secs(1), UNIX_EPOCH + YEAR_10000] {
            assert_eq!(since(time), "an unknown time (the system clock is wrong)");
        }
    }

    #[test]
    #[cfg(unix)]
    fn lock_that_is_a_link_is_refused_and_its_target_unchanged() {
        use std::os::unix::fs::symlink;
        let out = folder();
        let users_file = out.path().join("precious");
        fs::write(&users_file, "precious").expect("written");
        fs::create_dir(out.path().join(STATE_FOLDER)).expect("made");
        symlink(&users_file, lock_path(out.path())).expect("a link");
        for error in [OutputLock::take(out.path()).err(), OutputLock::holder(out.path()).err()] {
            let error = error.expect("a link").to_string();
            assert!(error.ends_with("lock: not a regular file: a symbolic link"), "{error}");
        }
        assert_eq!(fs::read_to_string(&users_file).expect("there"), "precious");
    }

    #[test]
    fn shorter_holder_text_replaces_a_longer_one() {
        let out = folder();
        drop(OutputLock::take(out.path()).expect("a lock"));
        fs::write(lock_path(out.path()), "x".repeat(500)).expect("a long name");
        let _lock = OutputLock::take(out.path()).expect("a lock");
        let text = fs::read_to_string(lock_path(out.path())).expect("text");
        if cfg!(unix) {
            assert!(text.starts_with("pid ") && text.ends_with("Z\n"), "{text}");
        }
    }

    /// The environment variable with the folder to lock. It is set only in the child process of the test
    /// below.
    const CHILD_FOLDER: &str = "MENISCUS_TEST_LOCK_FOLDER";

    #[test]
    fn killed_process_releases_its_lock() {
        if let Some(out) = std::env::var_os(CHILD_FOLDER) {
            hold_until_killed(Path::new(&out));
        }
        let out = folder();
        let mut child = Command::new(std::env::current_exe().expect("this test"))
            .args(["watch::io::lock::tests::killed_process_releases_its_lock", "--exact", "--nocapture"])
            .env(CHILD_FOLDER, out.path())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a child");
        let stdout = BufReader::new(child.stdout.take().expect("piped"));
        let is_locked_line = |line: io::Result<String>| line.is_ok_and(|line| line.contains("locked"));
        assert!(stdout.lines().any(is_locked_line), "the child takes the lock");

        let error = OutputLock::take(out.path()).expect_err("the child has it");
        assert!(matches!(error, LockError::Held { .. }), "{error}");
        if cfg!(unix) {
            assert!(error.to_string().contains(&format!("pid {} ", child.id())), "{error}");
        }

        child.kill().expect("killed");
        child.wait().expect("ended");
        OutputLock::take(out.path()).expect("the system has taken it back");
    }

    fn hold_until_killed(out: &Path) -> ! {
        let _lock = OutputLock::take(out).expect("a lock");
        writeln!(io::stdout(), "locked").expect("a parent who listens");
        // If the parent ends first, the pipe closes, and the read returns.
        let _ = io::stdin().read_to_end(&mut Vec::new());
        std::process::exit(0)
    }

    #[cfg(unix)]
    #[test]
    fn error_of_a_file_system_without_locks_is_recognized() {
        use rustix::io::Errno;
        for errno in [Errno::NOLCK, Errno::NOSYS, Errno::OPNOTSUPP] {
            let error = TryLockError::Error(errno.into());
            let file = File::open(".").expect("a folder");
            let error = lock_error(error, Path::new("/out"), &file);
            assert!(matches!(error, LockError::Unsupported { .. }), "{error}");
        }
        assert!(!is_unsupported(&Errno::IO.into()));
        assert!(!is_unsupported(&Errno::ACCESS.into()));
    }
}
