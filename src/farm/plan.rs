//! A plan: which frames to convert, with which settings, and in which shard.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::pipeline::{
    Frame, Job, MeasuredSpacing, ObstacleFiles, OutputOptions, are_same_file, canonical_entry,
    certificate_path, file_of, output_path,
};
use crate::surface::options::Settings;

/// A plan for all shards.
#[derive(Clone, Debug)]
pub struct ShardPlan {
    /// In the order of the report.
    pub sequences: Vec<PlannedSequence>,
    /// In the order of the shards.
    pub frames: Vec<PlannedFrame>,
    /// The frames of each shard, as a range of indices: the ranges are contiguous, and together they cover
    /// all frames.
    pub shards: Vec<Range<usize>>,
    /// The obstacles of all frames: absolute paths and patterns.
    pub obstacles: Vec<PathBuf>,
}

/// Frames that share their settings.
#[derive(Clone, Debug)]
pub struct PlannedSequence {
    /// The name for messages.
    pub name: String,
    /// The kind of conversion.
    pub job: Job,
    /// The settings. For level sets, they apply to any voxel size.
    pub settings: Arc<Settings>,
    /// The measurement that the voxel size follows from; `None` if nothing was measured.
    pub measured: Option<MeasuredSpacing>,
    /// The output options. The folder is absolute, and the same for all sequences; a camera, if there is one,
    /// is fixed.
    pub outputs: Arc<OutputOptions>,
}

/// A frame, and the sequence that it belongs to.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedFrame {
    /// The particle file, absolute.
    pub input: PathBuf,
    /// The base name of its outputs: a file name without folder and extension.
    pub stem: String,
    /// The frame number, if the frame has one.
    pub number: Option<i64>,
    /// The size of the particle file when the plan was made.
    pub size_bytes: u64,
    /// An index into the sequences.
    pub sequence: usize,
}

impl ShardPlan {
    /// The folder of all outputs.
    pub fn out(&self) -> Option<&Path> {
        self.sequences.first().map(|sequence| sequence.outputs.folder.as_path())
    }

    /// The stage of all frames.
    pub fn stage(&self) -> Option<&Path> {
        Some(self.sequences.first()?.outputs.stage.as_ref()?.path.as_path())
    }

    /// The same plan with another output folder, which then also has the stage.
    pub fn with_out(mut self, folder: &Path) -> ShardPlan {
        for sequence in &mut self.sequences {
            let outputs = Arc::make_mut(&mut sequence.outputs);
            folder.clone_into(&mut outputs.folder);
            if let Some(stage) = &mut outputs.stage
                && let Some(name) = stage.path.file_name()
            {
                stage.path = folder.join(name);
            }
        }
        self
    }

    /// Whether a path is an input, an output or a certificate of the plan, which other files must not
    /// replace.
    pub fn names(&self, path: &Path) -> bool {
        let path = canonical_entry(path);
        let is_output = |planned: &PlannedFrame| {
            self.outputs(planned).any(|output| output.file_name() == path.file_name())
        };
        let folder = self.out().and_then(|folder| folder.canonicalize().ok());
        let is_input = |planned: &PlannedFrame| {
            let input = file_of(&planned.input);
            // Names are compared first: a stat call for every file of a shot would load a file server.
            input.file_name() == path.file_name() && are_same_file(input, &path)
        };
        self.frames.iter().any(is_input)
            || self.stage().is_some_and(|stage| canonical_entry(stage) == path)
            || (folder.as_deref() == path.parent() && self.frames.iter().any(is_output))
    }

    /// The files that are written for a frame: its outputs, and its certificate.
    pub(super) fn outputs(&self, planned: &PlannedFrame) -> impl Iterator<Item = PathBuf> {
        let OutputOptions { folder, formats, .. } = &*self.sequences[planned.sequence].outputs;
        let outputs = formats.iter().map(|&format| output_path(folder, &planned.stem, format));
        outputs.chain([certificate_path(folder, &planned.stem)])
    }

    /// The frame in the form that the pipeline takes.
    pub fn frame(&self, planned: &PlannedFrame, obstacles: &Arc<ObstacleFiles>) -> Frame {
        let sequence = &self.sequences[planned.sequence];
        Frame {
            input: planned.input.clone(),
            job: sequence.job,
            stem: planned.stem.clone(),
            settings: Arc::clone(&sequence.settings),
            outputs: Arc::clone(&sequence.outputs),
            number: planned.number,
            obstacles: Arc::clone(obstacles),
            framing: None,
        }
    }
}
