//! What is to be made of which frames, and by which shard.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::pipeline::{
    Frame, Job, MeasuredSpacing, ObstacleFiles, OutputOptions, are_one_file, certificate_path, entry,
    file_of, output_path,
};
use crate::surface::options::Settings;

/// All that a shard needs to know.
#[derive(Clone, Debug)]
pub struct ShardPlan {
    /// In the order of the report.
    pub sequences: Vec<PlannedSequence>,
    /// In the order in which they are dealt.
    pub frames: Vec<PlannedFrame>,
    /// The frames of each shard, by their index: one follows the other, and each frame has one.
    pub shards: Vec<Range<usize>>,
    /// What stands in the way of all frames: paths and patterns, absolute.
    pub obstacles: Vec<PathBuf>,
}

/// Frames that share their settings.
#[derive(Clone, Debug)]
pub struct PlannedSequence {
    /// What to call it.
    pub name: String,
    /// What is made of its frames.
    pub job: Job,
    /// Its settings; of level sets, for any voxel size.
    pub settings: Arc<Settings>,
    /// Where the voxel size is from, unless it was given.
    pub measured: Option<MeasuredSpacing>,
    /// What is written of it, and where: the folder, absolute, is the same for all sequences. A camera that is needed is fixed.
    pub outputs: Arc<OutputOptions>,
}

/// A frame, and to which sequence it belongs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedFrame {
    /// The file of particles, absolute.
    pub input: PathBuf,
    /// What its outputs are called: a file name, without folder and extension.
    pub stem: String,
    /// Its number, where it has one.
    pub number: Option<u64>,
    /// The size of the file when the plan was made.
    pub size_bytes: u64,
    /// An index into the sequences.
    pub sequence: usize,
}

impl ShardPlan {
    /// The folder of all outputs.
    pub fn out(&self) -> Option<&Path> {
        self.sequences.first().map(|sequence| sequence.outputs.folder.as_path())
    }

    /// The same plan for outputs that lie elsewhere.
    pub fn with_out(mut self, folder: &Path) -> ShardPlan {
        for sequence in &mut self.sequences {
            Arc::make_mut(&mut sequence.outputs).folder = folder.to_owned();
        }
        self
    }

    /// Whether a path is that of an input, an output or a certificate: what nothing else may be written over.
    pub fn names(&self, path: &Path) -> bool {
        let path = entry(path);
        let is_output = |planned: &PlannedFrame| {
            self.outputs(planned).any(|output| output.file_name() == path.file_name())
        };
        let folder = self.out().and_then(|folder| folder.canonicalize().ok());
        let is_input = |planned: &PlannedFrame| {
            let input = file_of(&planned.input);
            // Looking at all files of a shot would keep a file server busy.
            input.file_name() == path.file_name() && are_one_file(input, &path)
        };
        self.frames.iter().any(is_input)
            || (folder.as_deref() == path.parent() && self.frames.iter().any(is_output))
    }

    /// The files that a frame becomes: its outputs, and its certificate.
    pub(super) fn outputs(&self, planned: &PlannedFrame) -> impl Iterator<Item = PathBuf> {
        let OutputOptions { folder, formats, .. } = &*self.sequences[planned.sequence].outputs;
        let outputs = formats.iter().map(|&format| output_path(folder, &planned.stem, format));
        outputs.chain([certificate_path(folder, &planned.stem)])
    }

    /// A frame as the pipeline takes it.
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
