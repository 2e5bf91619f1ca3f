//! What is shown: a frame, the daemon, and how it went.

use std::path::PathBuf;
use std::sync::Arc;

use serde::Serialize;

use super::figures::Figures;

/// How far a frame is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameState {
    /// Its file may still be written, or its sequence has no settings yet.
    Waiting,
    /// It waits for its turn.
    Queued,
    /// It is in one of the stages.
    Working,
    /// It failed, and is tried again.
    Retrying,
    /// Its outputs are there.
    Done,
    /// It failed.
    Failed,
}

/// A frame in a line.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameSummary {
    /// Its path within the watched folder; with several folders, their numbers from 1 before it.
    pub name: Arc<str>,
    /// How far it is.
    pub state: FrameState,
    /// The stage it is in, if it is in one: read, rasterize, smooth, contour or write.
    pub stage: Option<&'static str>,
    /// Why it failed, or waits.
    pub reason: Option<String>,
    /// Since when it is so, in milliseconds since 1970.
    pub since_ms: u64,
    /// Particles in it, where that is known.
    pub particles: Option<usize>,
    /// How long it took in all, in seconds, where that is known.
    pub seconds: Option<f64>,
    /// The name of the output that is its surface as .glb.
    pub surface: Option<String>,
    /// The name of the output that is a picture of it.
    pub picture: Option<String>,
}

/// All that is shown of a frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameView {
    /// In a line.
    #[serde(flatten)]
    pub summary: FrameSummary,
    /// Failures in a row that may pass by themselves.
    pub attempts: u32,
    /// The size of its file.
    pub input_bytes: u64,
    /// What was made of it.
    pub outputs: Vec<OutputView>,
    /// What was measured, if it was converted in this run.
    pub figures: Option<Arc<Figures>>,
    /// What its outputs are called, but for their extensions.
    #[serde(skip)]
    pub stem: PathBuf,
}

/// A file that was made of a frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OutputView {
    /// Its path within the folder of the outputs; with several watched folders, the number of its own before it.
    pub name: String,
    /// As it was written.
    pub size_bytes: u64,
    /// Where it is.
    #[serde(skip)]
    pub path: PathBuf,
}

/// How many frames are how far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// [`FrameState::Waiting`].
    pub waiting: usize,
    /// [`FrameState::Queued`].
    pub queued: usize,
    /// [`FrameState::Working`].
    pub working: usize,
    /// [`FrameState::Retrying`].
    pub retrying: usize,
    /// [`FrameState::Done`].
    pub done: usize,
    /// [`FrameState::Failed`].
    pub failed: usize,
}

impl Counts {
    pub(super) fn of(&mut self, state: FrameState) -> &mut usize {
        match state {
            FrameState::Waiting => &mut self.waiting,
            FrameState::Queued => &mut self.queued,
            FrameState::Working => &mut self.working,
            FrameState::Retrying => &mut self.retrying,
            FrameState::Done => &mut self.done,
            FrameState::Failed => &mut self.failed,
        }
    }
}

/// How the daemon is.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Status {
    /// Why it begins no frame, while it begins none.
    pub paused: Option<String>,
    /// Watched folders that are not there, and why.
    pub unavailable: Vec<String>,
    /// No further frame is begun: it ends.
    pub stopping: bool,
    /// The least free room among the disks of the outputs.
    pub disk_free_bytes: Option<u64>,
    /// What the process holds now.
    pub memory_bytes: Option<u64>,
}

/// How it was at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Sample {
    /// Milliseconds since 1970.
    pub at_ms: u64,
    /// Frames that are still written.
    pub waiting: usize,
    /// Frames that wait for their turn.
    pub queued: usize,
    /// Frames in the stages.
    pub working: usize,
    /// Frames that failed.
    pub failed: usize,
    /// Frames converted since the daemon began.
    pub converted: u64,
    /// What the process held.
    pub memory_bytes: Option<u64>,
}
