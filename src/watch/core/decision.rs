//! Decides whether to convert a frame again, from what is recorded of it and its current state on disk.
//!
//! ```text
//!   its record                │ failed     done                         none, or any other state
//!   ──────────────────────────┼──────────────────────────────────────────────────────────────────
//!   same stamp and settings   │ skip       skip, if its outputs exist   convert
//!   anything else             │ convert    convert                      convert
//! ```
//!
//! The decision is a pure function: the caller has inspected the disk. To convert a frame, the pipeline first
//! reads it: a file that was only copied or touched has another time or inode, but the same content, and the
//! pipeline finds it done.

use std::path::Path;

use crate::pipeline::{FileStamp, Reason, RecordedFrame, UnfinishedState};

/// Why a frame is to be converted, from its record, its stamp, whether it was recorded with these settings, and
/// the first output that is missing or damaged; `None` if it stays as it is.
pub(crate) fn reason_by_record(
    record: Option<&RecordedFrame>,
    stamp: &FileStamp,
    has_settings: impl Fn(&RecordedFrame) -> bool,
    unfit_output: Option<&Path>,
) -> Option<Reason> {
    let Some(record) = record else { return Some(Reason::New) };
    let recorded_stamp = match (&record.unfinished, &record.done) {
        (Some(unfinished), done) => match unfinished.state {
            UnfinishedState::Ignored => return Some(Reason::New),
            UnfinishedState::Waiting if done.is_none() => return Some(Reason::New),
            UnfinishedState::Waiting => return Some(Reason::InputChanged),
            UnfinishedState::Queued => return Some(Reason::Interrupted),
            UnfinishedState::Retrying | UnfinishedState::AwaitsRestart => return Some(Reason::Retry),
            UnfinishedState::Refused => return Some(Reason::ConflictGone),
            UnfinishedState::Failed => unfinished.stamp,
        },
        (None, Some(done)) => done.stamp,
        (None, None) => return Some(Reason::New),
    };
    if recorded_stamp.size != stamp.size {
        return Some(Reason::InputChanged);
    }
    if !has_settings(record) {
        return Some(Reason::SettingsChanged);
    }
    // Outputs of a failed frame are older than its failure: whether they exist does not matter.
    if let Some(output) = unfit_output.filter(|_| record.unfinished.is_none()) {
        return Some(Reason::OutputChanged { output: output.to_owned() });
    }
    (!recorded_stamp.still_holds(stamp)).then_some(Reason::Touched)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::pipeline::UnfinishedRecord;
    use crate::watch::test_records::{done_record, unfinished_record};

    fn stamp() -> FileStamp {
        FileStamp { size: 100, modified_ns: 5, inode: 9, changed_ns: Some(6) }
    }

    /// The record of a frame in this state; `None` if it is done.
    fn record(state: Option<UnfinishedState>) -> RecordedFrame {
        let path = Path::new("/in/a.ply");
        let unfinished = state
            .map(|state| Arc::new(UnfinishedRecord { stamp: stamp(), ..unfinished_record(path, state) }));
        let done = unfinished.is_none().then(|| done_record(path, stamp()));
        RecordedFrame { done, unfinished }
    }

    #[test]
    fn record_and_disk_determine_the_reason() {
        use UnfinishedState::{AwaitsRestart, Failed, Ignored, Queued, Refused, Retrying, Waiting};
        let output = Path::new("/out/a.glb");
        let is_missing = Reason::OutputChanged { output: output.to_owned() };
        let touched = FileStamp { modified_ns: 6, ..stamp() };
        let moved = FileStamp { inode: 10, ..stamp() };
        let status_changed = FileStamp { changed_ns: Some(7), ..stamp() };
        let longer = FileStamp { size: 101, ..stamp() };
        for (state, now, has_settings, missing, expected) in [
            (None, stamp(), true, None, None),
            (None, touched, true, None, Some(Reason::Touched)),
            (None, moved, true, None, Some(Reason::Touched)),
            (None, status_changed, true, None, Some(Reason::Touched)),
            (None, longer, true, None, Some(Reason::InputChanged)),
            (None, touched, false, None, Some(Reason::SettingsChanged)),
            (None, touched, true, Some(output), Some(is_missing)),
            (Some(Failed), stamp(), true, Some(output), None),
            (Some(Failed), touched, true, None, Some(Reason::Touched)),
            (Some(Failed), stamp(), false, None, Some(Reason::SettingsChanged)),
            (Some(Queued), stamp(), true, None, Some(Reason::Interrupted)),
            (Some(Retrying), stamp(), true, None, Some(Reason::Retry)),
            (Some(AwaitsRestart), stamp(), true, None, Some(Reason::Retry)),
            (Some(Refused), stamp(), true, None, Some(Reason::ConflictGone)),
            (Some(Waiting), stamp(), true, None, Some(Reason::New)),
            (Some(Ignored), stamp(), true, None, Some(Reason::New)),
        ] {
            let reason = reason_by_record(Some(&record(state)), &now, |_| has_settings, missing);
            assert_eq!(reason, expected, "{state:?} {now:?} {has_settings} {missing:?}");
        }
        assert_eq!(reason_by_record(None, &stamp(), |_| true, None), Some(Reason::New));
    }
}
