//! The output records for `--skip-done`, one file in each folder of outputs.

use std::cell::Cell;
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use crate::pipeline::OutputStates;

use super::console::Console;

/// The recorded states of the outputs of a run. Without `--skip-done`, only outputs that failed validation or
/// already have a record are recorded.
pub(super) struct OutputRecords {
    folders: BTreeSet<PathBuf>,
    states: OutputStates,
    /// When to save next while frames finish.
    next_save: Cell<Instant>,
}

/// The save interval: an interrupted run loses at most the records since the last save.
const SAVED_EVERY: Duration = Duration::from_secs(5);

/// Saving takes at most 1 / `SAVING_SHARE` of the run time.
const SAVING_SHARE: u32 = 20;

impl OutputRecords {
    /// Reads the records of all these folders of outputs.
    pub(super) fn load(folders: impl IntoIterator<Item = PathBuf>) -> OutputRecords {
        let folders: BTreeSet<PathBuf> = folders.into_iter().collect();
        let states = OutputStates::default();
        folders.iter().for_each(|folder| states.load(folder));
        OutputRecords { folders, states, next_save: Cell::new(Instant::now() + SAVED_EVERY) }
    }

    pub(super) fn states(&self) -> &OutputStates {
        &self.states
    }

    /// Saves the records after a finished frame if the interval has passed, so that an interrupted run keeps
    /// them. Errors are ignored here: [`save`](OutputRecords::save) reports them at the end.
    pub(super) fn frame_finished(&self) {
        let start = Instant::now();
        if start < self.next_save.get() {
            return;
        }
        for folder in &self.folders {
            let _ = self.states.save(folder);
        }
        let pause = SAVED_EVERY.max(start.elapsed() * SAVING_SHARE);
        self.next_save.set(Instant::now() + pause);
    }

    /// Saves the records. A failure is only a warning, because the outputs themselves are good.
    pub(super) fn save(&self, console: &Console) {
        for folder in &self.folders {
            if let Err(error) = self.states.save(folder) {
                console.warning(format_args!(
                    "{}: cannot record the hashes of the outputs and which of them failed validation, so the \
                     next --skip-done may skip damaged outputs and outputs that failed validation: {error}",
                    folder.display()
                ));
            }
        }
    }
}
