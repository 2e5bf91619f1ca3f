//! What is shown: a frame, the daemon, and how it went.

use std::path::PathBuf;
use std::sync::Arc;

use serde::Serialize;

use super::figures::Figures;

/// How far a frame is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameProgress {
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
    pub state: FrameProgress,
    /// The stage it is in, if it is in one: one of [`STAGES`](super::STAGES).
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
    /// What was measured when it was converted, if that is known.
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

/// How the daemon is.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LiveStatus {
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

/// How many results are to be expected, and when.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Forecast {
    /// Frames that were seen so far and did not fail for good: as many will be done if no more come.
    pub expected_count: usize,
    /// How long the frames that are left will take at the present rate, in seconds; `None` while that is not known, and
    /// when none is left.
    pub seconds_left: Option<f64>,
}

impl Forecast {
    /// By the counts and the last samples. The rate is that of the last minutes in which there was work.
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

/// The rate of a forecast is measured over so long.
const RATE_OVER_MS: u64 = 300_000;

/// How it was at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct StatusSample {
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
