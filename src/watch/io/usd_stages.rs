//! The stages of a folder of outputs: written from the records, at the start and when frames are recorded.
//!
//! The records have all frames, also those whose inputs were removed. A stage lists every output of these
//! frames that exists, so the old file of a frame that is converted again, or that failed, plays until a new
//! one replaces it. The names of outputs are those of `convert`.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::pipeline::{
    FrameFile, FrameRecords, OutputOptions, RecordLine, RecordedFrame, Sequence, UnfinishedState,
    UsdStageFrame, UsdStageSequence, are_same_file, canonical_path, next_stage_update, output_sequence,
    sequences, sweep_temporaries_of, write_stage,
};
use crate::watch::config::WatchConfig;

use super::selection::{FileFilter, PatternError};

/// How soon a stage that cannot be written, or has no frames, is tried again.
const RETRY: Duration = Duration::from_secs(10);

/// The stages of one folder of outputs.
pub(super) struct FolderUsdStages {
    stages: Vec<WatchedUsdStage>,
    /// When they are written next; `None` while they are up to date.
    due: Option<Instant>,
    /// The earliest time at which the stages are written again.
    paused_until: Instant,
}

/// A stage, and where its frames come from.
struct WatchedUsdStage {
    /// At least one. All have this stage.
    blocks: Vec<UsdStageBlock>,
    /// The error that was logged last, until the stage can be written again.
    logged_error: Option<String>,
    /// The warnings about left-out frames that were logged already.
    logged_warnings: HashSet<String>,
}

/// A watched folder, and the files in it that are frames: other blocks may watch the same folder for other
/// files.
struct UsdStageBlock {
    input: PathBuf,
    filter: FileFilter,
    outputs: OutputOptions,
}

impl FolderUsdStages {
    /// The stages of the frames whose outputs are in this folder.
    ///
    /// # Errors
    /// When the pattern of a watch is invalid.
    pub(super) fn new(folder: &Path, config: &WatchConfig) -> Result<FolderUsdStages, PatternError> {
        let mut stages: Vec<WatchedUsdStage> = Vec::new();
        for watch in &config.watches {
            let is_here = are_same_file(&watch.outputs.folder, folder);
            let Some(stage) = watch.outputs.stage.as_ref().filter(|_| is_here) else { continue };
            // Removes what a killed daemon left. The stage may be outside the folder of outputs, which is swept as a
            // whole.
            if let Err(error) = sweep_temporaries_of(&stage.path) {
                let path = stage.path.display();
                tracing::warn!("cannot look for half-written files of the stage {path}: {error}");
            }
            let filter = FileFilter::new(watch.pattern.as_deref(), Vec::new())?;
            let input = canonical_path(&watch.input);
            let block = UsdStageBlock { input, filter, outputs: watch.outputs.clone() };
            match stages.iter_mut().find(|known| known.blocks[0].outputs.stage.as_ref() == Some(stage)) {
                Some(known) => known.blocks.push(block),
                None => stages.push(WatchedUsdStage {
                    blocks: vec![block],
                    logged_error: None,
                    logged_warnings: HashSet::new(),
                }),
            }
        }
        let now = Instant::now();
        Ok(FolderUsdStages { due: (!stages.is_empty()).then_some(now), stages, paused_until: now })
    }

    /// Makes the stages due if this record may change what they play.
    pub(super) fn note(&mut self, line: &RecordLine) {
        let is_of_frame = matches!(line, RecordLine::Done(_) | RecordLine::Unfinished(_));
        if !self.stages.is_empty() && is_of_frame {
            self.due.get_or_insert(self.paused_until);
        }
    }

    /// When the stages are written next.
    pub(super) fn due(&self) -> Option<Instant> {
        self.due
    }

    /// Writes the stages if they are due, or if they are out of date and must be written `at_once`.
    pub(super) fn write(&mut self, records: &FrameRecords, at_once: bool) {
        let start = Instant::now();
        let is_due = self.due.is_some_and(|due| at_once || due <= start);
        if !is_due {
            return;
        }
        let mut must_retry = false;
        let frames = records.latest().frames;
        for stage in &mut self.stages {
            must_retry |= !stage.write(&frames);
        }
        self.paused_until = next_stage_update(start);
        self.due = must_retry.then(|| Instant::now() + RETRY);
    }
}

impl WatchedUsdStage {
    /// Writes the stage. Returns false if it must be tried again: after an error, or if it has no frames. An error
    /// is logged once, and so is the recovery.
    fn write(&mut self, frames: &HashMap<PathBuf, RecordedFrame>) -> bool {
        let written = write_stage(&self.blocks[0].outputs, &self.sequences(frames));
        if let Ok(Some(report)) = &written {
            for why in &report.left_out {
                if self.logged_warnings.insert(why.clone()) {
                    tracing::warn!("{why}");
                }
            }
        }
        let is_empty = matches!(&written, Ok(Some(report)) if report.frame_count == 0);
        let error = written.err().map(|error| error.to_string());
        match (&error, &self.logged_error) {
            (Some(error), logged) if logged.as_ref() != Some(error) => {
                tracing::error!("cannot write the stage: {error}");
            }
            (None, Some(_)) => tracing::info!("the stage can be written again"),
            _ => {}
        }
        self.logged_error = error;
        self.logged_error.is_none() && !is_empty
    }

    /// The recorded frames, numbered and grouped by the names of their inputs, as by `convert`: the name of an
    /// output may have one more number, because that of a step begins with the name of its file.
    fn sequences(&self, frames: &HashMap<PathBuf, RecordedFrame>) -> Vec<UsdStageSequence> {
        let mut of_blocks: Vec<Vec<FrameFile>> = self.blocks.iter().map(|_| Vec::new()).collect();
        // Frames that were never converted have no outputs: a file with the name of one belongs to another frame.
        let played = frames.iter().filter(|(_, frame)| match frame.unfinished_state() {
            Some(UnfinishedState::Refused | UnfinishedState::Ignored) => false,
            Some(UnfinishedState::Waiting) => frame.done.is_some(),
            _ => true,
        });
        for (input, _) in played {
            let file = FrameFile::new(input.to_path_buf());
            let takes = |block: &UsdStageBlock| block.filter.takes(&block.input, file.file());
            if let Some(index) = self.blocks.iter().position(takes) {
                of_blocks[index].push(file.in_watched_folder(&self.blocks[index].input));
            }
        }
        let of_block = |(block, files): (&UsdStageBlock, Vec<FrameFile>)| -> Vec<UsdStageSequence> {
            sequences(files).iter().map(|sequence| block.sequence(sequence)).collect()
        };
        self.blocks.iter().zip(of_blocks).flat_map(of_block).collect()
    }
}

impl UsdStageBlock {
    /// The outputs of a sequence: sub-folders are mirrored below the folder of outputs.
    fn sequence(&self, Sequence { frames, .. }: &Sequence) -> UsdStageSequence {
        let (folder, sequence) = frames.first().map(FrameFile::sequence).unwrap_or_default();
        let folders = self.within_input(&folder).components();
        let folders = folders.map(|folder| folder.as_os_str().to_string_lossy().into_owned());
        let name = folders.chain([output_sequence(&sequence)]).collect::<Vec<_>>().join("/");
        UsdStageSequence { name, frames: frames.iter().map(|file| self.frame(file)).collect() }
    }

    fn frame(&self, file: &FrameFile) -> UsdStageFrame {
        let folder = self.within_input(file.file().parent().unwrap_or(Path::new("")));
        let outputs = OutputOptions { folder: self.outputs.folder.join(folder), ..self.outputs.clone() };
        UsdStageFrame::new(&outputs, &file.stem(), file.number())
    }

    fn within_input<'a>(&self, folder: &'a Path) -> &'a Path {
        folder.strip_prefix(&self.input).unwrap_or(Path::new(""))
    }
}
