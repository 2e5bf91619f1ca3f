//! Which files a program has open for writing, as far as Linux shows it: `/proc` lists the open files and the
//! shared memory maps of the processes of the same user.

use std::collections::HashSet;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How long the files of one search are used: one search suffices for many files.
const VALID: Duration = Duration::from_millis(250);

/// Whether a process of this user has this file open for writing, or mapped into its memory to write to it.
pub(crate) fn is_open_for_writing(file: &Path) -> bool {
    static FOUND: Mutex<Option<(Instant, HashSet<PathBuf>)>> = Mutex::new(None);

    let Ok(path) = file.canonicalize() else { return false };
    let mut found = FOUND.lock().unwrap_or_else(PoisonError::into_inner);
    if found.as_ref().is_none_or(|(searched, _)| searched.elapsed() >= VALID) {
        *found = Some((Instant::now(), written_files()));
    }
    found.as_ref().is_some_and(|(_, files)| files.contains(&path))
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
    let maps = fs::read_to_string(process.join("maps")).unwrap_or_default();
    let written = |line: &str| {
        // Address range, permissions, offset, device, inode, path.
        let permissions = line.split(' ').nth(1)?;
        let path = line.find(" /").map(|at| &line[at + 1..])?;
        let is_written = permissions.contains('w') && permissions.ends_with('s');
        is_written.then(|| path.into())
    };
    maps.lines().filter_map(written).collect()
}
