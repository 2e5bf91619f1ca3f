//! What the core hears, and what it asks for.
//!
//! ```text
//!   workers, pipeline, commands ──Event──▶ Core::handle ──Effect──▶ workers, pipeline, journal, log
//! ```
//!
//! Every event about a file may come late, twice or never: each says what the file was at some time, and results of
//! requests carry the number of the request.

use std::collections::BTreeSet;
use std::fmt;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use crate::pipeline::{FileFrames, FileStamp, Frame, FrameError, ObstacleStamps, Outcome};
use crate::surface::options::Settings;
use crate::watch::journal::{Entry, JournaledFrame, OutputCheck, OutputRecord};

use super::completeness::{Candidate, Proof, Seen, WaitReason};
use super::frames::FrameId;
use super::sequences::{MeasureOrder, SpacingResult};

/// The time, by both clocks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Now {
    pub(crate) at: Instant,
    /// Milliseconds since 1970, for records.
    pub(crate) unix_ms: u64,
}

/// Something that happened outside of the core.
#[derive(Debug)]
pub(crate) enum Event {
    /// A file was found, at a time that may be a little in the past.
    FileSeen { id: FrameId, seen: Seen, at: Instant, renamed: bool },
    /// A file is gone.
    FileGone(FrameId),
    /// The system refuses to say what a file is.
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
    /// A file was searched for steps.
    StepsFound(FoundSteps),
    /// A pipeline has room for one more frame.
    FrameWanted { pipeline: usize },
    /// A pipeline cannot begin a frame that it got, because its outputs cannot be written now.
    FrameReturned { id: FrameId, frame: Box<Frame>, found: OutputDirState },
    /// A pipeline has finished with a frame.
    FrameFinished(Box<FrameFinished>),
    /// All frames of a pipeline are finished, and it has ended.
    PipelineEnded { pipeline: usize },
    /// The state of a folder of outputs.
    OutputDirChecked(OutputDirState),
    /// The journal of a folder of outputs is on the disk.
    JournalSynced,
    /// A worker has not answered for a long time.
    WorkerStalled(Worker),
    /// A worker that had stalled has answered.
    WorkerAnswered(Worker),
}

/// A thread that does the I/O of one watched folder or of one folder of outputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Worker {
    /// Of the root with this index.
    Root(usize),
    /// Of the folder of outputs with this index.
    Output(usize),
}

/// What a scan found.
#[derive(Debug, Default)]
pub(crate) struct Scan {
    /// The files that the selection takes, in no particular order.
    pub(crate) files: Vec<(PathBuf, Seen)>,
    /// The folders that were looked into, the one that was asked for first.
    pub(crate) folders: Vec<PathBuf>,
    /// Paths that could not be examined, and why: they may be, or hold, frames.
    pub(crate) problems: Vec<(PathBuf, String)>,
    /// Links that the selection takes and whose target is missing; it may be written later.
    pub(crate) dangling: Vec<PathBuf>,
    /// Whether the scan was made because events were lost.
    pub(crate) after_loss: bool,
}

/// A folder of outputs as it was found.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OutputDirState {
    pub(crate) output: usize,
    pub(crate) presence: Presence,
    /// Free bytes, if the file system says.
    pub(crate) free_bytes: Option<u64>,
}

/// Whether a folder of outputs is the one that was opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Presence {
    There,
    /// It was removed, and was made again: what was in it is gone.
    MadeAgain,
    /// Another file system is in its place: its own is not mounted.
    Away,
}

/// The obstacles of frames, by the frames' numbers.
#[derive(Debug)]
pub(crate) enum FoundObstacleStamps {
    /// The same for all frames.
    Same(Arc<ObstacleStamps>),
    PerNumber(std::collections::HashMap<Option<u64>, Arc<ObstacleStamps>>),
}

/// A frame that a pipeline has finished with.
#[derive(Debug)]
pub(crate) struct FrameFinished {
    pub(crate) id: FrameId,
    /// Its outputs, if they are there.
    pub(crate) outputs: Vec<OutputRecord>,
    pub(crate) outcome: Outcome,
    /// Of a frame that failed because the disk is full: free bytes there.
    pub(crate) free_bytes: Option<u64>,
}

/// Asks what a file is now. The answer comes as soon as the first of these says no.
#[derive(Debug)]
pub(crate) struct Inspect {
    pub(crate) id: FrameId,
    /// The number of this request.
    pub(crate) number: u64,
    /// What the file was when this was asked.
    pub(crate) stamp: FileStamp,
    /// If only this is asked: whether it is still the same file.
    pub(crate) only_stamp: bool,
    /// What the journal says of it, if the frame stays as it is while this holds.
    pub(crate) recorded: Option<Recorded>,
    /// The file may still be written.
    pub(crate) candidate: Option<Candidate>,
    /// The files that the frame becomes.
    pub(crate) outputs: Vec<PathBuf>,
}

/// A frame that stays as it is while its outputs are as they were written, and its obstacles too.
#[derive(Debug)]
pub(crate) struct Recorded {
    pub(crate) record: Arc<JournaledFrame>,
    /// The settings of its sequence, if only its obstacles can tell whether they are those recorded.
    pub(crate) settings: Option<(Arc<Settings>, Arc<str>)>,
}

/// The answer to [`Inspect`].
#[derive(Debug)]
pub(crate) struct Inspected {
    pub(crate) id: FrameId,
    pub(crate) number: u64,
    pub(crate) found: InspectionResult,
    /// The files of its obstacles; `None` without obstacles.
    pub(crate) obstacles: Option<Arc<ObstacleStamps>>,
}

/// What an inspection found.
#[derive(Debug)]
pub(crate) enum InspectionResult {
    /// The file is gone.
    Gone,
    /// The system refuses to say what it is.
    Unreadable(io::Error),
    /// It is another file than was asked about.
    Changed(Seen, Instant),
    /// It is the same file, and more was not asked.
    Same,
    /// Outputs and obstacles are as recorded.
    AsRecorded,
    /// Its outputs are missing because their folder is not mounted.
    OutputsAway,
    /// It is not complete.
    Waiting { until: Option<Instant>, why: WaitReason },
    /// It is complete.
    Complete(Complete),
}

/// A file that is complete.
#[derive(Debug)]
pub(crate) struct Complete {
    /// Why it is complete, if that was asked.
    pub(crate) proof: Option<Proof>,
    /// A recorded output that is not as it was written.
    pub(crate) changed_output: Option<(PathBuf, OutputCheck)>,
    pub(crate) contents: FileContents,
    /// A file that its outputs would replace: why the frame is refused.
    pub(crate) conflict: Option<String>,
}

/// What a file is, by its first bytes.
#[derive(Debug)]
pub(crate) enum FileContents {
    /// A frame, or a step of a file.
    Frame,
    /// Of a kind that may have several steps.
    MaybeSteps,
    /// No particles: some other file, or an output of this program.
    NotParticles,
    Unreadable(io::Error),
}

/// Something for the worker of a root to do.
#[derive(Debug)]
pub(crate) enum RootRequest {
    Inspect(Box<Inspect>),
    /// Scan everything.
    Scan,
    /// Look at the obstacles of frames with these numbers.
    StampObstacles(BTreeSet<Option<u64>>),
}

/// Something that takes long, for the other thread of a root.
#[derive(Debug)]
pub(crate) enum SlowRequest {
    Measure(Box<MeasureOrder>),
    FindSteps(StepsOrder),
}

/// A complete file that is to be searched for steps.
#[derive(Debug)]
pub(crate) struct StepsOrder {
    pub(crate) id: FrameId,
    pub(crate) stamp: FileStamp,
    /// Why the frame is refused if it has no steps: what its outputs would replace.
    pub(crate) conflict: Option<String>,
}

/// The result of a search for steps.
#[derive(Debug)]
pub(crate) struct FoundSteps {
    pub(crate) order: StepsOrder,
    /// The frames of the file; `None` if it was written again meanwhile.
    pub(crate) frames: Result<Option<FileFrames>, FrameError>,
}

/// Something for the worker of a folder of outputs to do.
#[derive(Debug)]
pub(crate) enum OutputRequest {
    /// Add a record to the journal, and then log this: what the log says is in the journal.
    Record(Entry, Option<Log>),
    /// Look at the folder now.
    Check,
    /// Write the journal to the disk: the daemon ends.
    Sync,
}

/// A line of the log, which is written after the state that it is about can be seen.
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

/// A frame to convert, and what is known of the outputs that it has.
#[derive(Debug)]
pub(crate) struct Start {
    pub(crate) id: FrameId,
    pub(crate) frame: Box<Frame>,
    pub(crate) known_outputs: Vec<OutputRecord>,
}

/// Something that the core wants done. Effects are carried out in order.
#[derive(Debug)]
pub(crate) enum Effect {
    Root(usize, RootRequest),
    Slow(usize, SlowRequest),
    Output(usize, OutputRequest),
    /// Give a frame to a pipeline that wants one.
    Start(usize, Start),
    /// Start a pipeline beside those that hang.
    StartPipeline(usize),
    /// Tell a pipeline that there are no more frames.
    EndPipeline(usize),
    Log(Log),
}
