//! The inputs and outputs of the core: events and effects.
//!
//! ```text
//!   workers, pipeline ──Event──▶ Core::handle ──Effect──▶ workers, pipeline, records, log
//! ```
//!
//! An event about a file may arrive late, twice or never. So each event contains the state of the file at a
//! given time, and each result of a request carries the number of the request.

use std::collections::{BTreeSet, HashMap};
use std::fmt;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use meniscus_formats::Neighbor;

use crate::pipeline::{
    ChangedOutput, FileFrames, FileStamp, Frame, FrameError, NamedFiles, ObstacleStamps, Outcome, Reason,
    RecordLine, RecordedFrame,
};

use super::completeness::{Candidate, FileHint, Proof, Seen};
use super::frames::FrameId;
use super::sequences::{MeasureOrder, SpacingResult};

/// The current time, by both clocks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Now {
    pub(crate) at: Instant,
    /// Milliseconds since 1970, for records.
    pub(crate) unix_ms: u64,
}

/// Something that happened outside the core.
#[derive(Debug)]
pub(crate) enum Event {
    /// A file was found, at a time that may be slightly in the past.
    FileSeen { id: FrameId, seen: Seen, at: Instant, hint: FileHint },
    /// A file was removed.
    FileRemoved(FrameId),
    /// The system refuses to inspect a file.
    FileUnreadable(FrameId, io::Error),
    /// A file changed that may be the sentinel of a frame.
    SentinelSeen(usize, PathBuf),
    /// All files in one folder of a root.
    FolderScanned { root: usize, files: Vec<(PathBuf, Seen)>, at: Instant },
    /// All files of a root, or why it is unavailable.
    RootScanned { root: usize, found: Result<Scan, String>, at: Instant },
    /// The result of [`RootRequest::Inspect`].
    Inspected(Box<Inspected>),
    /// The result of [`RootRequest::StampObstacles`].
    ObstaclesStamped { root: usize, stamps: FoundObstacleStamps },
    /// A sequence was measured.
    Measured(Box<SpacingResult>),
    /// The search of a file for steps has ended.
    StepsFound(FoundSteps),
    /// The pipeline has a free slot for a frame.
    FrameRequested,
    /// The pipeline has finished with a frame.
    FrameFinished(Box<FrameFinished>),
    /// All frames of the pipeline are finished, and it has ended.
    PipelineEnded,
    /// The state of a folder of outputs.
    OutputFolderChecked(OutputFolderState),
    /// The answer to [`OutputRequest::Sync`]: whether the records and the stages are on the disk.
    OutputSynced(bool),
}

/// What a scan found.
#[derive(Debug, Default)]
pub(crate) struct Scan {
    /// The files that the selection takes, in no particular order.
    pub(crate) files: Vec<(PathBuf, Seen)>,
    /// The folders that were scanned, starting with the requested one.
    pub(crate) folders: Vec<PathBuf>,
    /// Paths that could not be examined, and why: they may be frames, or contain some.
    pub(crate) problems: Vec<(PathBuf, String)>,
    /// Selected links whose targets are missing; the targets may be written later.
    pub(crate) dangling: Vec<PathBuf>,
    /// Whether lost events caused the scan.
    pub(crate) after_loss: bool,
}

/// The state of a folder of outputs at a check.
#[derive(Clone, Debug)]
pub(crate) struct OutputFolderState {
    pub(crate) output: usize,
    /// Whether it was removed, and is created again.
    pub(crate) was_removed: bool,
    /// Why it is not locked any more, as when another daemon has created it again.
    pub(crate) lost: Option<String>,
    /// Free bytes, if the file system reports them.
    pub(crate) free_bytes: Option<u64>,
}

/// The stamps of the obstacles of frames, by frame number.
#[derive(Debug)]
pub(crate) enum FoundObstacleStamps {
    /// All frames have the same stamps.
    Same(Arc<ObstacleStamps>),
    PerNumber(HashMap<Option<i64>, Arc<ObstacleStamps>>),
}

/// A frame that the pipeline has finished with.
#[derive(Debug)]
pub(crate) struct FrameFinished {
    pub(crate) id: FrameId,
    pub(crate) outcome: Outcome,
    /// Free bytes on the disk of the outputs, if the file system reports them.
    pub(crate) free_bytes: Option<u64>,
    /// The files besides its own from which the frame would be read, if it cannot be read.
    pub(crate) named: Option<Arc<NamedFiles>>,
}

/// Requests the state of a file.
#[derive(Debug)]
pub(crate) struct Inspect {
    pub(crate) id: FrameId,
    /// The number of this request.
    pub(crate) number: u64,
    /// The stamp of the file at the time of the request.
    pub(crate) stamp: FileStamp,
    pub(crate) extent: InspectionExtent,
    /// Set if the frame is not converted again while this check passes.
    pub(crate) record_check: Option<RecordCheck>,
    /// The file's candidate state, if it may still be written.
    pub(crate) candidate: Option<Candidate>,
    /// The output files of the frame.
    pub(crate) outputs: Vec<PathBuf>,
}

/// What an inspection looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum InspectionExtent {
    /// Whether the file is unchanged, and nothing else.
    Stamp,
    /// The outputs and obstacles by the record, then whether the file is unchanged, then its kind and conflicts.
    All,
    /// Like `All`, for a file whose stamp was read just now: if the outputs and obstacles are as recorded,
    /// the stamp is not read again.
    AllOfJustSeen,
}

/// The check of a frame against its record: while its outputs and obstacles are as recorded, it stays as it
/// is.
#[derive(Debug)]
pub(crate) struct RecordCheck {
    pub(crate) record: RecordedFrame,
    /// Whether the stamps of its obstacles are compared.
    pub(crate) checks_obstacles: bool,
}

/// The answer to [`Inspect`].
#[derive(Debug)]
pub(crate) struct Inspected {
    pub(crate) id: FrameId,
    pub(crate) number: u64,
    pub(crate) found: InspectionResult,
    /// The stamps of its obstacles; `None` without obstacles.
    pub(crate) obstacles: Option<Arc<ObstacleStamps>>,
}

/// The result of an inspection.
#[derive(Debug)]
pub(crate) enum InspectionResult {
    /// The file is gone.
    Missing,
    /// The system refuses to inspect it.
    Unreadable(io::Error),
    /// It is not the file that the request was about.
    Changed(Seen, Instant),
    /// It is the same file, and no further check was requested.
    Same,
    /// Outputs and obstacles are as recorded.
    AsRecorded,
    /// It is incomplete.
    Waiting { until: Option<Instant>, why: Reason },
    /// It is complete.
    Complete(Complete),
}

/// A file that is complete.
#[derive(Debug)]
pub(crate) struct Complete {
    /// Why it counts as complete; `None` if that was not checked.
    pub(crate) proof: Option<Proof>,
    /// A recorded output that has changed.
    pub(crate) changed_output: Option<ChangedOutput>,
    /// Whether files that it names have changed since it was recorded.
    pub(crate) has_changed_files: bool,
    pub(crate) contents: FileContents,
    /// Set if the outputs of the frame would replace a file: the reason to refuse the frame.
    pub(crate) conflict: Option<String>,
}

/// The kind of a file, by its first bytes.
#[derive(Debug)]
pub(crate) enum FileContents {
    /// A frame, or a step of a file.
    Frame,
    /// A file of a format that may contain several steps.
    MaybeSteps,
    /// No particles: an unrelated file, or an output of this program.
    NotParticles,
    /// A file of the simulation without particles.
    Neighbor(Neighbor),
    Unreadable(io::Error),
}

/// A request to the worker of a root.
#[derive(Debug)]
pub(crate) enum RootRequest {
    Inspect(Box<Inspect>),
    /// Scan the whole folder.
    Scan,
    /// Stamp the obstacles of frames with these numbers.
    StampObstacles(BTreeSet<Option<i64>>),
}

/// A request that may take minutes, for a thread of its own.
#[derive(Debug)]
pub(crate) enum SlowRequest {
    Measure(Box<MeasureOrder>),
    FindSteps(StepsOrder),
}

/// A complete file to search for steps.
#[derive(Debug)]
pub(crate) struct StepsOrder {
    pub(crate) id: FrameId,
    pub(crate) stamp: FileStamp,
    /// The reason to refuse the frame if the file has no steps: its outputs would replace a file.
    pub(crate) conflict: Option<String>,
}

/// The result of a search for steps.
#[derive(Debug)]
pub(crate) struct FoundSteps {
    pub(crate) order: StepsOrder,
    /// The frames of the file; `None` if the file changed during the search.
    pub(crate) frames: Result<Option<FileFrames>, UnreadableFrame>,
}

/// Why a frame cannot be read.
#[derive(Debug)]
pub(crate) struct UnreadableFrame {
    pub(crate) error: FrameError,
    /// The files besides its own from which it would be read, if there are any.
    pub(crate) named: Option<Arc<NamedFiles>>,
}

/// A request to the worker of a folder of outputs.
#[derive(Debug)]
pub(crate) enum OutputRequest {
    /// Write a record, then this log line: the log never runs ahead of the records.
    Record(RecordLine, Option<Log>),
    /// Sync the records to the disk and write the stages, because the daemon is about to exit.
    Sync,
}

/// A log line that is written only after the state that it describes is visible.
pub(crate) struct Log(Box<dyn FnOnce() + Send>);

impl Log {
    pub(crate) fn new(write: impl FnOnce() + Send + 'static) -> Log {
        Log(Box::new(write))
    }

    pub(crate) fn write(self) {
        (self.0)();
    }
}

impl fmt::Debug for Log {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Log")
    }
}

/// A frame for the pipeline.
#[derive(Debug)]
pub(crate) struct FrameToConvert {
    pub(crate) id: FrameId,
    pub(crate) frame: Box<Frame>,
}

/// An action that the core requests. Effects are carried out in order.
#[derive(Debug)]
pub(crate) enum Effect {
    Root(usize, RootRequest),
    Slow(SlowRequest),
    Output(usize, OutputRequest),
    /// Give a frame to the pipeline, which has asked for one.
    Convert(FrameToConvert),
    Log(Log),
}
