//! Removes temporary files on Ctrl-C or SIGTERM, so that no partial output remains.
//!
//! The frames in flight are discarded; finished ones remain, and `--skip-done` continues from there.

use std::fs;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

/// Folders to remove when the process is interrupted.
static FOLDERS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Registers a folder to be removed when the process is interrupted; see [`clean_up_when_interrupted`].
pub(super) fn remove_when_interrupted(folder: PathBuf) {
    FOLDERS.lock().unwrap_or_else(PoisonError::into_inner).push(folder);
}

/// From now on, an interrupted process removes its temporary files before it exits.
#[cfg(unix)]
pub(super) fn clean_up_when_interrupted() {
    use signal_hook::consts::{SIGINT, SIGTERM};
    use signal_hook::iterator::Signals;

    // Without the handler, everything but the cleanup works.
    let Ok(mut signals) = Signals::new([SIGINT, SIGTERM]) else { return };
    std::thread::spawn(move || {
        if let Some(signal) = signals.forever().next() {
            crate::pipeline::stop_writing();
            for folder in FOLDERS.lock().unwrap_or_else(PoisonError::into_inner).iter() {
                // The process exits, so a failure cannot be retried.
                let _ = fs::remove_dir_all(folder);
            }
            // The exit status that shells use for a process that a signal ended: 130 for Ctrl-C.
            std::process::exit(128 + signal);
        }
    });
}

/// On other systems there is no handler: the system ends the process.
#[cfg(not(unix))]
pub(super) fn clean_up_when_interrupted() {}
