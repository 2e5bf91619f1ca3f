//! The stages of a folder of outputs: written from the journal, at the start and when frames are recorded.
//!
//! The journal has the outputs of all frames, also of those whose inputs were removed, and of frames that are
//! converted again: their old files play until the new ones replace them.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::pipeline::{
    FrameFile, OutputFormat, OutputOptions, Sequence, StageFrame, StageSequence, next_stage_update,
    sequences, sweep_temporaries, write_stage,
};
use crate::watch::config::WatchConfig;
use crate::watch::journal::{Entry, JournaledFrame};

use super::canonical_path::canonical_path;

/// How soon a stage that cannot be written is tried again.
const RETRY: Duration = Duration::from_secs(10);

/// The stages of one folder of outputs.
pub(super) struct FolderStages {
    stages: Vec<WatchedStage>,
    /// When they are written next; `None` while they are up to date.
    due: Option<Instant>,
    /// They are not written before.
    paused_until: Instant,
}

/// A stage, and where its frames come from.
struct WatchedStage {
    outputs: OutputOptions,
    /// The watched folders.
    inputs: Vec<PathBuf>,
    /// Whether it was logged that it cannot be written.
    is_failure_logged: bool,
}

impl FolderStages {
    /// The stages of the frames whose outputs are in this folder.
    pub(super) fn new(folder: &Path, config: &WatchConfig) -> FolderStages {
        let mut stages: Vec<WatchedStage> = Vec::new();
        for watch in &config.watches {
            let is_here = watch.outputs.folder.canonicalize().is_ok_and(|of_watch| of_watch == folder);
            let Some(stage) = watch.outputs.stage.as_ref().filter(|_| is_here) else { continue };
            // Left by a killed daemon, if the stage is outside of the folder of outputs.
            let _ = stage.path.parent().map(sweep_temporaries);
            let input = canonical_path(&watch.input).unwrap_or_else(|_| watch.input.clone());
            match stages.iter_mut().find(|known| known.outputs.stage.as_ref() == Some(stage)) {
                Some(known) => known.inputs.push(input),
                None => stages.push(WatchedStage {
                    outputs: watch.outputs.clone(),
                    inputs: vec![input],
                    is_failure_logged: false,
                }),
            }
        }
        let now = Instant::now();
        FolderStages { due: (!stages.is_empty()).then_some(now), stages, paused_until: now }
    }

    /// A record may change what the stages play.
    pub(super) fn note(&mut self, entry: &Entry) {
        if !self.stages.is_empty() && matches!(entry, Entry::Frame { .. }) {
            self.due.get_or_insert(self.paused_until);
        }
    }

    /// When the stages are written next.
    pub(super) fn due(&self) -> Option<Instant> {
        self.due
    }

    /// Writes the stages if they are due, or if they are out of date and must be written `at_once`.
    pub(super) fn write(&mut self, frames: &HashMap<Arc<Path>, Arc<JournaledFrame>>, at_once: bool) {
        let start = Instant::now();
        if self.due.is_none_or(|due| due > start && !at_once) {
            return;
        }
        let mut has_failed = false;
        for stage in &mut self.stages {
            has_failed |= !stage.write(frames);
        }
        self.paused_until = next_stage_update(start);
        self.due = has_failed.then(|| Instant::now() + RETRY);
    }
}

impl WatchedStage {
    /// Writes the stage, and returns whether that succeeded. A failure and the recovery are logged once.
    fn write(&mut self, frames: &HashMap<Arc<Path>, Arc<JournaledFrame>>) -> bool {
        let written = write_stage(&self.outputs, &self.sequences(frames));
        match &written {
            Err(error) if !self.is_failure_logged => tracing::error!("cannot write the stage: {error}"),
            Ok(_) if self.is_failure_logged => tracing::info!("the stage can be written again"),
            _ => {}
        }
        self.is_failure_logged = written.is_err();
        written.is_ok()
    }

    /// The recorded frames, which their outputs identify: their numbers are those of the inputs.
    fn sequences(&self, frames: &HashMap<Arc<Path>, Arc<JournaledFrame>>) -> Vec<StageSequence> {
        let format = self.outputs.stage_mesh_format().unwrap_or(OutputFormat::Vdb);
        let has_volumes = self.outputs.formats.contains(&OutputFormat::Vdb);
        let mut volumes: HashMap<PathBuf, PathBuf> = HashMap::new();
        let mut files = Vec::new();
        for (input, record) in frames {
            if !self.inputs.iter().any(|folder| input.starts_with(folder)) {
                continue;
            }
            let Some(file) = output_in(record, format) else { continue };
            files.push(FrameFile::known(file.to_owned(), false));
            if let Some(volume) = output_in(record, OutputFormat::Vdb).filter(|_| has_volumes) {
                volumes.insert(file.to_owned(), volume.to_owned());
            }
        }
        let frame = |file: &FrameFile| StageFrame {
            number: file.number(),
            mesh: (format != OutputFormat::Vdb).then(|| file.path.clone()),
            volume: volumes.get(&file.path).cloned(),
        };
        let sequence = |Sequence { frames, .. }: Sequence| {
            let name = frames.first().map_or(String::new(), |file| file.sequence().1);
            StageSequence { name, frames: frames.iter().map(frame).collect() }
        };
        sequences(files).into_iter().map(sequence).collect()
    }
}

/// The output of a frame in a format.
fn output_in(record: &JournaledFrame, format: OutputFormat) -> Option<&Path> {
    let has_format = |path: &&Path| path.extension().is_some_and(|extension| extension == format.extension());
    record.outputs.iter().map(|output| &*output.path).find(has_format)
}
