//! Ctrl-C, and a polite request to end: nothing half written stays behind.
//!
//! A frame that is under way is given up; those that are whole stay, and `--skip-done` goes on from
//! there.

use std::fs;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

/// Folders to remove when the process is interrupted.
static FOLDERS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Has this folder removed when the process is interrupted; see [`clean_up_when_interrupted`].
pub(super) fn remove_when_interrupted(folder: PathBuf) {
    FOLDERS.lock().unwrap_or_else(PoisonError::into_inner).push(folder);
}

/// From now on, an interrupted process removes its temporary files before it ends.
#[cfg(unix)]
pub(super) fn clean_up_when_interrupted() {
    use signal_hook::consts::{SIGINT, SIGTERM};
    use signal_hook::iterator::Signals;

    // Without it everything works but for the cleaning up.
    let Ok(mut signals) = Signals::new([SIGINT, SIGTERM]) else { return };
    std::thread::spawn(move || {
        if let Some(signal) = signals.forever().next() {
            crate::pipeline::stop_writing();
            for folder in FOLDERS.lock().unwrap_or_else(PoisonError::into_inner).iter() {
                // The process ends; there is no time for a second attempt.
                let _ = fs::remove_dir_all(folder);
            }
            // As shells count it: 130 for Ctrl-C.
            std::process::exit(128 + signal);
        }
    });
}

/// Elsewhere the system ends the process as it sees fit.
#[cfg(not(unix))]
pub(super) fn clean_up_when_interrupted() {}
