//! Which files a program has open for writing, as far as Linux shows it: `/proc` lists the open files and the
//! shared memory maps of the processes of the same user.

use std::collections::HashSet;
use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// The files that a search found.
struct OpenFileSearch {
    began: Instant,
    took: Duration,
    files: HashSet<PathBuf>,
}

/// How long the files of one search are used: one search suffices for many files.
const VALID: Duration = Duration::from_millis(250);

/// Where searching takes long, the files are used for this many times as long as the search took.
const VALID_PER_SEARCH: u32 = 10;

/// Whether a process of this user has this file open for writing, or mapped into its memory to write to it.
/// A search that began before the last change of the file, `unchanged_for` ago, does not count.
pub(crate) fn is_open_for_writing(file: &Path, unchanged_for: Duration) -> bool {
    static LAST: Mutex<Option<OpenFileSearch>> = Mutex::new(None);

    let Ok(path) = file.canonicalize() else { return false };
    let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
    let is_valid = |search: &&OpenFileSearch| {
        search.began.elapsed() < VALID.max(search.took * VALID_PER_SEARCH).min(unchanged_for)
    };
    if let Some(search) = last.as_ref().filter(is_valid) {
        return search.files.contains(&path);
    }
    let began = Instant::now();
    let files = written_files();
    let is_open = files.contains(&path);
    *last = Some(OpenFileSearch { began, took: began.elapsed(), files });
    is_open
}

/// The files that processes of this user may write to. Processes of others are skipped, because their open
/// files cannot be listed.
fn written_files() -> HashSet<PathBuf> {
    let processes = fs::read_dir("/proc").into_iter().flatten().flatten();
    processes
        .flat_map(|process| [open_files(&process.path()), mapped_files(&process.path())])
        .flatten()
        .collect()
}

/// The files that this process has open for writing.
fn open_files(process: &Path) -> Vec<PathBuf> {
    const WRITABLE: u32 = 0o200;
    let entries = fs::read_dir(process.join("fd")).into_iter().flatten().flatten();
    let written = entries
        .filter(|entry| entry.metadata().is_ok_and(|metadata| metadata.permissions().mode() & WRITABLE != 0));
    // Pipes and sockets have names that are no paths.
    written.filter_map(|entry| entry.path().read_link().ok()).filter(|path| path.is_absolute()).collect()
}

/// The files that this process has mapped into its memory to write to them.
fn mapped_files(process: &Path) -> Vec<PathBuf> {
    let maps = fs::read(process.join("maps")).unwrap_or_default();
    let written = |line: &[u8]| {
        // Address range, permissions, offset, device, inode, path.
        let permissions = line.split(|byte| *byte == b' ').nth(1)?;
        let path = line.windows(2).position(|bytes| bytes == b" /").map(|at| &line[at + 1..])?;
        let is_written = permissions.contains(&b'w') && permissions.ends_with(b"s");
        is_written.then(|| OsStr::from_bytes(path).into())
    };
    maps.split(|byte| *byte == b'\n').filter_map(written).collect()
}
