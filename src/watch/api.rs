//! What the daemon and its caller say to each other.

/// What may be asked of a running daemon.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DaemonRequest {
    /// Finish the frames under way, and end.
    Finish,
    /// The same, to begin again with another configuration.
    Reload,
}

/// What a running daemon tells whoever runs it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Notice {
    /// Everything was looked at once, and from now on changes are heard.
    Ready,
    /// Where it is, in one line.
    Status(String),
    /// It is not stuck. Comes at least every two seconds.
    Alive,
    /// No further frame is begun.
    Stopping,
    /// The time for finishing the frames under way is over: whoever is in a hurry may end the process.
    Overdue,
}

/// What came of a run.
#[derive(Clone, Debug)]
pub struct WatchSummary {
    /// Why it ended.
    pub ended: EndReason,
    /// Frames whose outputs are there: made in this run, or found done.
    pub done_count: usize,
    /// Those among them whose results break a guarantee.
    pub broken_count: usize,
    /// Each frame that failed, in natural order.
    pub failed: Vec<FailedFrame>,
    /// Frames that were seen and are left for the next time.
    pub left_count: usize,
}

/// A frame that failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FailedFrame {
    /// A sentence: which frame, and why.
    pub what: String,
    /// How many frames were finished since that was told; `None` if it was known from an earlier run, and not told in
    /// this one.
    pub frames_since: Option<usize>,
}

/// Why a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EndReason {
    /// Everything that was there is done, and that was all that was asked for.
    Drained,
    /// By [`DaemonRequest::Finish`].
    Finish,
    /// By [`DaemonRequest::Reload`].
    Reload,
}
