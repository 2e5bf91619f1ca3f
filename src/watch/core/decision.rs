//! Decides whether to convert a frame again, from its record in the journal and its current state on disk.
//!
//! ```text
//!   its record        │ none      queued or     failed,       failed          done
//!                     │           in progress   may succeed   permanently
//!   ──────────────────┼─────────────────────────────────────────────────────────────────────────
//!   same stamp and    │ convert   convert       convert       skip            skip, if its outputs
//!   settings          │                                                       exist
//!   anything else     │ convert   convert       convert       convert         convert
//! ```
//!
//! The decision is a pure function: the caller has inspected the disk. A file that was copied or touched has
//! another time or inode, but may have the same content. Then the pipeline reads it, and finds it done.

use std::path::Path;

use crate::pipeline::FileStamp;
use crate::watch::Reason;
use crate::watch::journal::{JournaledFrame, JournaledStatus};

/// Why a frame is to be converted, from its record, its stamp, the fingerprint of its current settings, and
/// the first output that is missing or damaged; `None` if it stays as it is.
pub(crate) fn reason_to_convert(
    record: Option<&JournaledFrame>,
    stamp: &FileStamp,
    settings: &str,
    missing_output: Option<&Path>,
) -> Option<Reason> {
    let Some(record) = record else { return Some(Reason::New) };
    match record.status {
        JournaledStatus::Ignored => return Some(Reason::New),
        JournaledStatus::Waiting if record.outputs.is_empty() => return Some(Reason::New),
        JournaledStatus::Waiting => return Some(Reason::InputChanged),
        JournaledStatus::Queued => return Some(Reason::Interrupted),
        JournaledStatus::Retrying | JournaledStatus::RetriesExhausted => return Some(Reason::Retry),
        JournaledStatus::Refused => return Some(Reason::ConflictGone),
        JournaledStatus::Done | JournaledStatus::Failed => {}
    }
    if record.stamp.size != stamp.size {
        return Some(Reason::InputChanged);
    }
    if record.settings != settings {
        return Some(Reason::SettingsChanged);
    }
    // A failed frame has no outputs.
    if let Some(output) = missing_output.filter(|_| record.status == JournaledStatus::Done) {
        return Some(Reason::OutputChanged { output: output.to_owned() });
    }
    (!record.stamp.still_holds(stamp)).then_some(Reason::Touched)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: &str = "unchanged";

    fn stamp() -> FileStamp {
        FileStamp { size: 100, modified_ns: 5, inode: 9, changed_ns: Some(6) }
    }

    fn record(status: JournaledStatus) -> JournaledFrame {
        JournaledFrame { stamp: stamp(), settings: SETTINGS.to_owned(), ..JournaledFrame::new(status) }
    }

    #[test]
    fn record_and_disk_determine_the_reason() {
        use JournaledStatus::{Done, Failed, Ignored, Queued, Refused, RetriesExhausted, Retrying, Waiting};
        let output = Path::new("/out/a.glb");
        let is_missing = Reason::OutputChanged { output: output.to_owned() };
        let touched = FileStamp { modified_ns: 6, ..stamp() };
        let moved = FileStamp { inode: 10, ..stamp() };
        let status_changed = FileStamp { changed_ns: Some(7), ..stamp() };
        let longer = FileStamp { size: 101, ..stamp() };
        for (status, now, settings, missing, expected) in [
            (Done, stamp(), SETTINGS, None, None),
            (Done, touched, SETTINGS, None, Some(Reason::Touched)),
            (Done, moved, SETTINGS, None, Some(Reason::Touched)),
            (Done, status_changed, SETTINGS, None, Some(Reason::Touched)),
            (Done, longer, SETTINGS, None, Some(Reason::InputChanged)),
            (Done, touched, "others", None, Some(Reason::SettingsChanged)),
            (Done, touched, SETTINGS, Some(output), Some(is_missing)),
            (Failed, stamp(), SETTINGS, Some(output), None),
            (Failed, touched, SETTINGS, None, Some(Reason::Touched)),
            (Failed, stamp(), "others", None, Some(Reason::SettingsChanged)),
            (Queued, stamp(), SETTINGS, None, Some(Reason::Interrupted)),
            (Retrying, stamp(), SETTINGS, None, Some(Reason::Retry)),
            (RetriesExhausted, stamp(), SETTINGS, None, Some(Reason::Retry)),
            (Refused, stamp(), SETTINGS, None, Some(Reason::ConflictGone)),
            (Waiting, stamp(), SETTINGS, None, Some(Reason::New)),
            (Ignored, stamp(), SETTINGS, None, Some(Reason::New)),
        ] {
            let reason = reason_to_convert(Some(&record(status)), &now, settings, missing);
            assert_eq!(reason, expected, "{status:?} {now:?} {settings} {missing:?}");
        }
        assert_eq!(reason_to_convert(None, &stamp(), SETTINGS, None), Some(Reason::New));
        // The status change time is unknown.
        let old = FileStamp { changed_ns: None, ..stamp() };
        let record = JournaledFrame { stamp: old, ..record(Done) };
        assert_eq!(reason_to_convert(Some(&record), &stamp(), SETTINGS, None), None);
    }
}
