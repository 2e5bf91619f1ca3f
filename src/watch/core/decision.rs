//! Decides whether to convert a frame, from its record in the journal and its current state on disk.
//!
//! ```text
//!   its record        │ none      queued or     failed,       failed          done
//!                     │           in progress   may succeed   permanently
//!   ──────────────────┼─────────────────────────────────────────────────────────────────────────
//!   same stamp and    │ convert   convert       convert       skip            skip, if its outputs
//!   settings          │                                                       exist
//!   same size and     │ convert   convert       convert       compare the     compare the
//!   settings, new     │                                       content         content
//!   stamp             │
//!   anything else     │ convert   convert       convert       convert         convert
//! ```
//!
//! The decision is a pure function: the caller has inspected the disk. A file that was copied or touched has
//! another time or inode, but may have the same content. Only then is the content read, and its hash compared
//! with the recorded one.

use std::fmt;
use std::path::{Path, PathBuf};

use crate::pipeline::FileStamp;

use crate::watch::journal::{JournaledFrame, JournaledStatus};

/// What to do with a frame, and why. Displays as the reason: a clause without a full stop.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Leave it as it is.
    Skip(SkipReason),
    /// Only its content can decide: hash it, and call [`decide`] again.
    CompareContent,
    /// Convert it.
    Convert(ConvertReason),
}

/// Why a frame is not converted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SkipReason {
    /// It is converted, and all its outputs exist.
    Done,
    /// It failed, and would fail again.
    FailedUnchanged,
}

/// Why a frame is converted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ConvertReason {
    /// The journal has no record of it.
    New,
    /// Its content changed.
    InputChanged,
    /// Its settings changed.
    SettingsChanged,
    /// This output is missing, or is not the file that was written.
    OutputMissing(PathBuf),
    /// It was queued or in progress when the daemon exited.
    WasInterrupted,
    /// It failed with an error that may be temporary.
    Retry,
    /// It was refused, usually because its outputs conflict with other files; the reason may be gone now.
    WasRefused,
}

/// Decides about a frame from its record, its stamp, the fingerprint of its current settings, the first
/// output that is missing or damaged, and the hash of its content, if known.
pub fn decide(
    record: Option<&JournaledFrame>,
    stamp: &FileStamp,
    settings: &str,
    missing_output: Option<&Path>,
    hash: Option<u128>,
) -> Decision {
    let Some(record) = record else { return Decision::Convert(ConvertReason::New) };
    let skip_reason = match record.status {
        JournaledStatus::Queued => return Decision::Convert(ConvertReason::WasInterrupted),
        JournaledStatus::Retrying | JournaledStatus::RetriesExhausted => {
            return Decision::Convert(ConvertReason::Retry);
        }
        JournaledStatus::Refused => return Decision::Convert(ConvertReason::WasRefused),
        JournaledStatus::Done => SkipReason::Done,
        JournaledStatus::Failed => SkipReason::FailedUnchanged,
    };
    if record.stamp.size != stamp.size {
        return Decision::Convert(ConvertReason::InputChanged);
    }
    if record.settings != settings {
        return Decision::Convert(ConvertReason::SettingsChanged);
    }
    // A failed frame has no outputs.
    if let Some(output) = missing_output.filter(|_| skip_reason == SkipReason::Done) {
        return Decision::Convert(ConvertReason::OutputMissing(output.to_owned()));
    }
    match (record.hash, hash) {
        _ if record.stamp.still_holds(stamp) => Decision::Skip(skip_reason),
        (Some(_), None) => Decision::CompareContent,
        (Some(recorded), Some(hash)) if recorded == hash => Decision::Skip(skip_reason),
        _ => Decision::Convert(ConvertReason::InputChanged),
    }
}

impl fmt::Display for Decision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Decision::Skip(reason) => reason.fmt(f),
            Decision::CompareContent => {
                f.write_str("its time or inode has changed but not its size, so its content must be compared with the recorded hash")
            }
            Decision::Convert(reason) => reason.fmt(f),
        }
    }
}

impl fmt::Display for SkipReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            SkipReason::Done => {
                "it is done: its input, settings and obstacles have not changed, and its outputs exist"
            }
            SkipReason::FailedUnchanged => {
                "it failed, and neither it nor its settings or obstacles have changed since"
            }
        })
    }
}

impl fmt::Display for ConvertReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ConvertReason::New => f.write_str("it is new: the journal has no record of it"),
            ConvertReason::InputChanged => f.write_str("its content changed: it was written again"),
            ConvertReason::SettingsChanged => {
                f.write_str("its settings or obstacles have changed since it was converted")
            }
            ConvertReason::OutputMissing(path) => {
                write!(f, "its output {} is missing or was changed", path.display())
            }
            ConvertReason::WasInterrupted => f.write_str("the daemon exited before it finished the frame"),
            ConvertReason::Retry => f.write_str("it failed with an error that may be temporary"),
            ConvertReason::WasRefused => f.write_str("it was refused for a reason that may be gone now"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: &str = "unchanged";
    const HASH: u128 = 7;

    fn record(status: JournaledStatus) -> JournaledFrame {
        JournaledFrame {
            status,
            stamp: stamp(),
            hash: Some(HASH),
            settings: SETTINGS.to_owned(),
            outputs: Vec::new(),
            reason: None,
            attempt_count: 1,
            at_ms: 0,
            particle_count: None,
            seconds: None,
            flaws: Vec::new(),
            figures: None,
        }
    }

    fn stamp() -> FileStamp {
        FileStamp { size: 100, modified_ns: 200, inode: 300, changed_ns: Some(400) }
    }

    /// The current state, to compare with the record.
    struct Now {
        stamp: FileStamp,
        settings: &'static str,
        missing_output: Option<&'static Path>,
    }

    const ALIKE: fn() -> Now = || Now { stamp: stamp(), settings: SETTINGS, missing_output: None };

    #[track_caller]
    fn check(status: JournaledStatus, now: &Now, wanted: &Decision) {
        let Now { stamp, settings, missing_output } = now;
        assert_eq!(decide(Some(&record(status)), stamp, settings, *missing_output, None), *wanted);
    }

    fn touched() -> Now {
        Now { stamp: FileStamp { modified_ns: 201, ..stamp() }, ..ALIKE() }
    }

    fn moved() -> Now {
        Now { stamp: FileStamp { inode: 301, ..stamp() }, ..ALIKE() }
    }

    fn longer() -> Now {
        Now { stamp: FileStamp { size: 101, ..stamp() }, ..ALIKE() }
    }

    fn other_settings() -> Now {
        Now { settings: "others", ..ALIKE() }
    }

    fn output_gone() -> Now {
        Now { missing_output: Some(Path::new("/out/a.glb")), ..ALIKE() }
    }

    /// `chmod`, a new hard link, or a rewrite that set the modification time back.
    fn status_changed() -> Now {
        Now { stamp: FileStamp { changed_ns: Some(401), ..stamp() }, ..ALIKE() }
    }

    #[test]
    fn frame_without_a_record_is_converted() {
        let decision = decide(None, &stamp(), SETTINGS, None, None);
        assert_eq!(decision, Decision::Convert(ConvertReason::New));
    }

    #[test]
    fn done_frame_is_skipped_while_nothing_has_changed() {
        let missing = ConvertReason::OutputMissing("/out/a.glb".into());
        check(JournaledStatus::Done, &ALIKE(), &Decision::Skip(SkipReason::Done));
        check(JournaledStatus::Done, &touched(), &Decision::CompareContent);
        check(JournaledStatus::Done, &moved(), &Decision::CompareContent);
        check(JournaledStatus::Done, &status_changed(), &Decision::CompareContent);
        check(JournaledStatus::Done, &longer(), &Decision::Convert(ConvertReason::InputChanged));
        check(JournaledStatus::Done, &other_settings(), &Decision::Convert(ConvertReason::SettingsChanged));
        check(JournaledStatus::Done, &output_gone(), &Decision::Convert(missing.clone()));
        // The content is not read if the decision is certain without it.
        let touched_and_gone = Now { stamp: touched().stamp, ..output_gone() };
        check(JournaledStatus::Done, &touched_and_gone, &Decision::Convert(missing));
        let touched_and_set = Now { stamp: touched().stamp, ..other_settings() };
        check(JournaledStatus::Done, &touched_and_set, &Decision::Convert(ConvertReason::SettingsChanged));
    }

    #[test]
    fn failed_frame_is_skipped_until_something_changes() {
        check(JournaledStatus::Failed, &ALIKE(), &Decision::Skip(SkipReason::FailedUnchanged));
        check(JournaledStatus::Failed, &output_gone(), &Decision::Skip(SkipReason::FailedUnchanged));
        check(JournaledStatus::Failed, &touched(), &Decision::CompareContent);
        check(JournaledStatus::Failed, &longer(), &Decision::Convert(ConvertReason::InputChanged));
        check(JournaledStatus::Failed, &other_settings(), &Decision::Convert(ConvertReason::SettingsChanged));
    }

    #[test]
    fn unfinished_frame_is_converted() {
        for now in [ALIKE(), touched(), moved(), longer(), other_settings(), output_gone()] {
            check(JournaledStatus::Queued, &now, &Decision::Convert(ConvertReason::WasInterrupted));
            check(JournaledStatus::Retrying, &now, &Decision::Convert(ConvertReason::Retry));
            check(JournaledStatus::RetriesExhausted, &now, &Decision::Convert(ConvertReason::Retry));
            check(JournaledStatus::Refused, &now, &Decision::Convert(ConvertReason::WasRefused));
        }
    }

    #[test]
    fn status_change_time_missing_from_the_record_is_ignored() {
        let old = FileStamp { changed_ns: None, ..stamp() };
        let record = JournaledFrame { stamp: old, ..record(JournaledStatus::Done) };
        let decision = decide(Some(&record), &stamp(), SETTINGS, None, None);
        assert_eq!(decision, Decision::Skip(SkipReason::Done));
    }

    #[test]
    fn without_a_recorded_hash_a_new_stamp_means_a_changed_input() {
        for status in [JournaledStatus::Done, JournaledStatus::Failed] {
            let record = JournaledFrame { hash: None, ..record(status) };
            let decision = decide(Some(&record), &touched().stamp, SETTINGS, None, None);
            assert_eq!(decision, Decision::Convert(ConvertReason::InputChanged));
        }
    }

    #[test]
    fn touched_frame_is_decided_by_its_hash() {
        let cases = [
            (JournaledStatus::Done, Decision::Skip(SkipReason::Done)),
            (JournaledStatus::Failed, Decision::Skip(SkipReason::FailedUnchanged)),
        ];
        let decide =
            |status, hash| decide(Some(&record(status)), &touched().stamp, SETTINGS, None, Some(hash));
        for (status, same) in cases {
            assert_eq!(decide(status, HASH), same);
            assert_eq!(decide(status, HASH + 1), Decision::Convert(ConvertReason::InputChanged));
        }
        assert_eq!(decide(JournaledStatus::Queued, HASH), Decision::Convert(ConvertReason::WasInterrupted));
        assert_eq!(decide(JournaledStatus::Retrying, HASH), Decision::Convert(ConvertReason::Retry));
        assert_eq!(decide(JournaledStatus::Refused, HASH), Decision::Convert(ConvertReason::WasRefused));
    }

    #[test]
    fn reasons_display_as_clauses() {
        let missing = Decision::Convert(ConvertReason::OutputMissing("/out/a.glb".into()));
        assert_eq!(missing.to_string(), "its output /out/a.glb is missing or was changed");
        let settings = Decision::Convert(ConvertReason::SettingsChanged);
        assert_eq!(settings.to_string(), "its settings or obstacles have changed since it was converted");
    }
}
