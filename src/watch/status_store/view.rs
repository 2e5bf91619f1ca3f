//! The views that clients see: frames, the daemon, and samples over time.

use std::path::PathBuf;
use std::sync::Arc;

use serde::Serialize;

use crate::pipeline::Figures;

/// The state of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameProgress {
    /// Its file may still be written, or its sequence has no settings yet.
    Waiting,
    /// It is queued.
    Queued,
    /// It is in one of the stages.
    Working,
    /// It failed, and will be retried.
    Retrying,
    /// Its outputs exist.
    Done,
    /// It failed.
    Failed,
}

/// A frame in brief.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameSummary {
    /// Its path within the watched folder; with several folders, prefixed with the folder's number, from 1.
    pub name: Arc<str>,
    /// Its state.
    pub state: FrameProgress,
    /// The current stage, if it is in one: one of [`STAGES`](super::STAGES).
    pub stage: Option<&'static str>,
    /// Why it failed or waits.
    pub reason: Option<String>,
    /// When it entered this state, in milliseconds since 1970.
    pub since_ms: u64,
    /// The number of its particles, if known.
    pub particles: Option<usize>,
    /// The total time of its conversion in seconds, if known.
    pub seconds: Option<f64>,
    /// The name of the output with its surface as .glb.
    pub surface: Option<String>,
    /// The name of the output with its picture.
    pub picture: Option<String>,
}

/// All details of a frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameView {
    /// The frame in brief.
    #[serde(flatten)]
    pub summary: FrameSummary,
    /// Number of consecutive failures that may be temporary.
    pub attempts: u32,
    /// The size of its file, in bytes.
    pub input_bytes: u64,
    /// Its outputs.
    pub outputs: Vec<OutputView>,
    /// The measurements of its conversion, if known.
    pub figures: Option<Arc<Figures>>,
    /// The path of its outputs without their extensions.
    #[serde(skip)]
    pub stem: PathBuf,
}

/// An output of a frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OutputView {
    /// Its path within the folder of outputs; with several watched folders, prefixed with the number of its
    /// watched folder.
    pub name: String,
    /// Its size when it was written.
    pub size_bytes: u64,
    /// Its path on disk.
    #[serde(skip)]
    pub path: PathBuf,
}

/// The number of frames in each state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct StateCounts {
    /// [`FrameProgress::Waiting`].
    pub waiting: usize,
    /// [`FrameProgress::Queued`].
    pub queued: usize,
    /// [`FrameProgress::Working`].
    pub working: usize,
    /// [`FrameProgress::Retrying`].
    pub retrying: usize,
    /// [`FrameProgress::Done`].
    pub done: usize,
    /// [`FrameProgress::Failed`].
    pub failed: usize,
}

impl StateCounts {
    pub(super) fn of(&mut self, state: FrameProgress) -> &mut usize {
        match state {
            FrameProgress::Waiting => &mut self.waiting,
            FrameProgress::Queued => &mut self.queued,
            FrameProgress::Working => &mut self.working,
            FrameProgress::Retrying => &mut self.retrying,
            FrameProgress::Done => &mut self.done,
            FrameProgress::Failed => &mut self.failed,
        }
    }
}

/// The status of the daemon.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LiveStatus {
    /// Why no frames are started; `None` if they are.
    pub paused: Option<String>,
    /// Unavailable folders, and why.
    pub unavailable: Vec<String>,
    /// Whether the daemon is stopping and starts no further frames.
    pub stopping: bool,
    /// The least free space of all file systems of outputs, in bytes.
    pub disk_free_bytes: Option<u64>,
    /// Resident memory of the process, in bytes.
    pub memory_bytes: Option<u64>,
}

/// The expected number of results, and the time until they are done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Forecast {
    /// Frames that were seen and have not failed permanently: the final number of results if no more frames
    /// arrive.
    pub expected_count: usize,
    /// The time until the remaining frames are done at the current rate, in seconds; `None` if it is unknown,
    /// or no frames remain.
    pub seconds_left: Option<f64>,
}

impl Forecast {
    /// Computes the forecast from the counts and the last samples. The rate is that of the last minutes with
    /// work.
    pub(super) fn new<'a>(
        counts: &StateCounts,
        samples: impl DoubleEndedIterator<Item = &'a StatusSample>,
    ) -> Forecast {
        let StateCounts { waiting, queued, working, retrying, done, failed: _ } = *counts;
        let left_count = waiting + queued + working + retrying;
        let (mut converted_count, mut work_ms) = (0, 0);
        let mut later: Option<&StatusSample> = None;
        for sample in samples.rev() {
            if let Some(later) = later.filter(|_| sample.queued + sample.working > 0) {
                converted_count += later.converted.saturating_sub(sample.converted);
                work_ms += later.at_ms.saturating_sub(sample.at_ms);
            }
            if work_ms >= RATE_OVER_MS {
                break;
            }
            later = Some(sample);
        }
        let is_known = left_count > 0 && converted_count > 0;
        let seconds_left =
            is_known.then(|| left_count as f64 * work_ms as f64 / 1e3 / converted_count as f64);
        Forecast { expected_count: left_count + done, seconds_left }
    }
}

/// The period over which the rate is measured.
const RATE_OVER_MS: u64 = 300_000;

/// A sample of the status.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct StatusSample {
    /// Milliseconds since 1970.
    pub at_ms: u64,
    /// Frames that are still being written.
    pub waiting: usize,
    /// Frames in the queue.
    pub queued: usize,
    /// Frames in a stage.
    pub working: usize,
    /// Frames that failed.
    pub failed: usize,
    /// Frames converted since the daemon started.
    pub converted: u64,
    /// Resident memory of the process, in bytes.
    pub memory_bytes: Option<u64>,
}
