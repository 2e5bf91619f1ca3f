//! The records of outputs that `--skip-done` compares, one file in each folder of outputs.

use std::collections::BTreeSet;
use std::path::PathBuf;

use crate::pipeline::{Frame, OutputStates};

use super::console::Console;

/// The recorded states of the outputs of a run.
pub(super) struct OutputRecords {
    folders: BTreeSet<PathBuf>,
    states: OutputStates,
}

impl OutputRecords {
    /// Reads the records of all folders that these frames are written to.
    pub(super) fn load(frames: &[Frame]) -> OutputRecords {
        let folders: BTreeSet<PathBuf> = frames.iter().map(|frame| frame.outputs.folder.clone()).collect();
        let states = OutputStates::default();
        folders.iter().for_each(|folder| states.load(folder));
        OutputRecords { folders, states }
    }

    pub(super) fn states(&self) -> &OutputStates {
        &self.states
    }

    /// Writes them back. Losing them costs a check in the next run and nothing else: that is a warning.
    pub(super) fn save(&self, console: &Console) {
        for folder in &self.folders {
            if let Err(error) = self.states.save(folder) {
                console.warn(format_args!(
                    "warning: {}: cannot record the hashes of the outputs, so the next --skip-done cannot notice \
                     damaged ones: {error}",
                    folder.display()
                ));
            }
        }
    }
}
