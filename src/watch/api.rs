//! What the daemon reports to its caller.

/// What a running daemon reports to its caller.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Notice {
    /// The first scans are complete, and the daemon listens for changes.
    Ready,
    /// A one-line summary of the current state.
    Status(String),
    /// The daemon starts no further frames.
    Stopping,
    /// The deadline for finishing the frames in progress has passed: the caller may kill the process.
    Overdue,
}

/// The result of a run.
#[derive(Clone, Debug)]
pub struct WatchSummary {
    /// Why it ended.
    pub ended: EndReason,
    /// Frames whose outputs exist: converted in this run, or found done.
    pub done_count: usize,
    /// The number of done frames whose results failed validation.
    pub broken_count: usize,
    /// All failed frames, in natural order.
    pub failed: Vec<FailedFrame>,
    /// Frames that were seen and are left for the next run.
    pub left_count: usize,
    /// Whether records or a stage could not be written at the end.
    pub has_unwritten: bool,
}

/// A frame that failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FailedFrame {
    /// Which frame failed, and why, as a sentence.
    pub message: String,
    /// How many frames were finished since the failure was reported; `None` if the failure is from an earlier
    /// run and was not reported in this one.
    pub frames_since: Option<usize>,
}

/// Why a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EndReason {
    /// With `once`: all frames that existed are done.
    Drained,
    /// The caller asked the daemon to finish.
    Finish,
}
