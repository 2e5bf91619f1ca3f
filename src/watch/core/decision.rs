//! Why a frame is converted, or is not: what the journal says of it against what is there.
//!
//! ```text
//!   the record says │ nothing   waiting or     failed for   failed          done
//!                   │           under way      now          for good
//!   ────────────────┼──────────────────────────────────────────────────────────────────────────
//!   same input,     │ convert   convert        convert      skip            skip, if its outputs
//!   same settings   │                                                       are there; if one was
//!                   │                                                       touched, contents decide
//!   same size, else │ convert   convert        convert      the content     the content decides
//!   a new stamp     │                                       decides
//!   anything else   │ convert   convert        convert      convert         convert
//! ```
//!
//! Pure: whoever asks has looked at the disk. A copied or touched file has another time or number
//! and still the same content; only then is it worth reading, to find out.

use std::fmt;
use std::path::{Path, PathBuf};

use crate::pipeline::FileStamp;

use crate::watch::journal::{FrameRecord, Standing};

/// What is to become of a frame, and why. Displays as the reason: a clause without its full stop.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Decision {
    /// It stays as it is.
    Skip(SkipReason),
    /// Its content decides: hash it, and ask [`decide_by_content`].
    CompareContent,
    /// It is converted.
    Convert(ConvertReason),
}

/// Why a frame is not converted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SkipReason {
    /// All of it is there.
    Done,
    /// It failed, and would again.
    FailedUnchanged,
}

/// Why a frame is converted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ConvertReason {
    /// Nothing is recorded of it.
    New,
    /// It has other content than it had.
    InputChanged,
    /// It is to be converted with other settings.
    SettingsChanged,
    /// This output is gone, or is not what was written.
    OutputMissing(PathBuf),
    /// It waited or was under way when the daemon ended.
    WasUnderWay,
    /// It failed in a way that may pass.
    Retry,
    /// Other files kept it from being converted, and may not any more.
    WasRefused,
}

/// How the outputs of a frame compare with their records.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutputsNow<'a> {
    /// All of them have the recorded stamps, or the recorded bytes.
    AsRecorded,
    /// All of them have the recorded sizes, but one has another stamp: only its bytes can tell whether it is damaged.
    Touched,
    /// This one is missing, or has another size or other bytes.
    Missing(&'a Path),
}

/// Decides about a frame by its record, its stamp, the fingerprint of the settings it would be converted with now, and
/// its outputs.
pub fn decide(
    record: Option<&FrameRecord>,
    stamp: &FileStamp,
    settings: &str,
    outputs: OutputsNow<'_>,
) -> Decision {
    let Some(record) = record else { return Decision::Convert(ConvertReason::New) };
    let skip_reason = match record.standing {
        Standing::Queued => return Decision::Convert(ConvertReason::WasUnderWay),
        Standing::Retrying | Standing::GivenUp => return Decision::Convert(ConvertReason::Retry),
        Standing::Refused => return Decision::Convert(ConvertReason::WasRefused),
        Standing::Done => SkipReason::Done,
        Standing::Failed => SkipReason::FailedUnchanged,
    };
    if record.stamp.size != stamp.size {
        return Decision::Convert(ConvertReason::InputChanged);
    }
    if record.settings != settings {
        return Decision::Convert(ConvertReason::SettingsChanged);
    }
    match (outputs, skip_reason) {
        (OutputsNow::Missing(output), SkipReason::Done) => {
            return Decision::Convert(ConvertReason::OutputMissing(output.to_owned()));
        }
        (OutputsNow::Touched, SkipReason::Done) => return Decision::CompareContent,
        // A failed frame has no outputs.
        (_, SkipReason::FailedUnchanged) | (OutputsNow::AsRecorded, _) => {}
    }
    match (record.stamp.still_holds(stamp), record.hash) {
        (true, _) => Decision::Skip(skip_reason),
        (false, Some(_)) => Decision::CompareContent,
        (false, None) => Decision::Convert(ConvertReason::InputChanged),
    }
}

/// Decides about a frame of which [`decide`] said [`Decision::CompareContent`]. Where it is skipped,
/// its new stamp is worth recording: the next look need not read it again.
pub fn decide_by_content(record: &FrameRecord, hash: u128) -> Decision {
    match record.standing {
        _ if record.hash != Some(hash) => Decision::Convert(ConvertReason::InputChanged),
        Standing::Done => Decision::Skip(SkipReason::Done),
        Standing::Failed => Decision::Skip(SkipReason::FailedUnchanged),
        Standing::Queued => Decision::Convert(ConvertReason::WasUnderWay),
        Standing::Retrying | Standing::GivenUp => Decision::Convert(ConvertReason::Retry),
        Standing::Refused => Decision::Convert(ConvertReason::WasRefused),
    }
}

impl fmt::Display for Decision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Decision::Skip(reason) => reason.fmt(f),
            Decision::CompareContent => f.write_str(
                "it or an output of it was touched, moved or written again in the same size, so that contents decide",
            ),
            Decision::Convert(reason) => reason.fmt(f),
        }
    }
}

impl fmt::Display for SkipReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            SkipReason::Done => {
                "it is done: its input, settings and obstacles are those recorded, and its outputs are there"
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
            ConvertReason::New => f.write_str("nothing is recorded of it: it is new"),
            ConvertReason::InputChanged => f.write_str("it was written again, and is not what it was"),
            ConvertReason::SettingsChanged => {
                f.write_str("its settings or obstacles are others than those it was converted with")
            }
            ConvertReason::OutputMissing(path) => {
                write!(f, "its output {} is gone, or is not as it was written", path.display())
            }
            ConvertReason::WasUnderWay => {
                f.write_str("it was waiting or under way when it was last recorded")
            }
            ConvertReason::Retry => f.write_str("it failed in a way that may pass"),
            ConvertReason::WasRefused => f.write_str("other files kept it from that, and may not any more"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: &str = "as before";
    const HASH: u128 = 7;

    fn record(standing: Standing) -> FrameRecord {
        FrameRecord {
            standing,
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

    /// What is there now, against the record.
    struct Now {
        stamp: FileStamp,
        settings: &'static str,
        outputs: OutputsNow<'static>,
    }

    const ALIKE: fn() -> Now = || Now { stamp: stamp(), settings: SETTINGS, outputs: OutputsNow::AsRecorded };

    #[track_caller]
    fn check(standing: Standing, now: &Now, wanted: &Decision) {
        assert_eq!(decide(Some(&record(standing)), &now.stamp, now.settings, now.outputs), *wanted);
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
        Now { outputs: OutputsNow::Missing(Path::new("/out/a.glb")), ..ALIKE() }
    }

    fn output_touched() -> Now {
        Now { outputs: OutputsNow::Touched, ..ALIKE() }
    }

    /// `chmod`, a new hard link, or a rewrite that set the modification time back.
    fn status_changed() -> Now {
        Now { stamp: FileStamp { changed_ns: Some(401), ..stamp() }, ..ALIKE() }
    }

    #[test]
    fn what_was_never_seen_is_converted() {
        let decision = decide(None, &stamp(), SETTINGS, OutputsNow::AsRecorded);
        assert_eq!(decision, Decision::Convert(ConvertReason::New));
    }

    #[test]
    fn done_is_skipped_while_all_is_as_recorded() {
        let missing = ConvertReason::OutputMissing("/out/a.glb".into());
        check(Standing::Done, &ALIKE(), &Decision::Skip(SkipReason::Done));
        check(Standing::Done, &touched(), &Decision::CompareContent);
        check(Standing::Done, &moved(), &Decision::CompareContent);
        check(Standing::Done, &status_changed(), &Decision::CompareContent);
        check(Standing::Done, &output_touched(), &Decision::CompareContent);
        check(Standing::Done, &longer(), &Decision::Convert(ConvertReason::InputChanged));
        check(Standing::Done, &other_settings(), &Decision::Convert(ConvertReason::SettingsChanged));
        check(Standing::Done, &output_gone(), &Decision::Convert(missing.clone()));
        // Nothing is read where it is certain without.
        let touched_and_gone = Now { stamp: touched().stamp, ..output_gone() };
        check(Standing::Done, &touched_and_gone, &Decision::Convert(missing));
        let touched_and_set = Now { stamp: touched().stamp, ..other_settings() };
        check(Standing::Done, &touched_and_set, &Decision::Convert(ConvertReason::SettingsChanged));
    }

    #[test]
    fn failed_is_skipped_until_something_changes() {
        check(Standing::Failed, &ALIKE(), &Decision::Skip(SkipReason::FailedUnchanged));
        check(Standing::Failed, &output_gone(), &Decision::Skip(SkipReason::FailedUnchanged));
        check(Standing::Failed, &output_touched(), &Decision::Skip(SkipReason::FailedUnchanged));
        check(Standing::Failed, &touched(), &Decision::CompareContent);
        check(Standing::Failed, &longer(), &Decision::Convert(ConvertReason::InputChanged));
        check(Standing::Failed, &other_settings(), &Decision::Convert(ConvertReason::SettingsChanged));
    }

    #[test]
    fn unfinished_work_is_taken_up() {
        for now in [ALIKE(), touched(), moved(), longer(), other_settings(), output_gone()] {
            check(Standing::Queued, &now, &Decision::Convert(ConvertReason::WasUnderWay));
            check(Standing::Retrying, &now, &Decision::Convert(ConvertReason::Retry));
            check(Standing::GivenUp, &now, &Decision::Convert(ConvertReason::Retry));
            check(Standing::Refused, &now, &Decision::Convert(ConvertReason::WasRefused));
        }
    }

    #[test]
    fn record_without_status_change_time_is_not_compared_in_it() {
        let old = FileStamp { changed_ns: None, ..stamp() };
        let record = FrameRecord { stamp: old, ..record(Standing::Done) };
        let decision = decide(Some(&record), &stamp(), SETTINGS, OutputsNow::AsRecorded);
        assert_eq!(decision, Decision::Skip(SkipReason::Done));
    }

    #[test]
    fn without_a_hash_another_stamp_is_another_input() {
        for standing in [Standing::Done, Standing::Failed] {
            let record = FrameRecord { hash: None, ..record(standing) };
            let decision = decide(Some(&record), &touched().stamp, SETTINGS, OutputsNow::AsRecorded);
            assert_eq!(decision, Decision::Convert(ConvertReason::InputChanged));
        }
    }

    #[test]
    fn content_decides() {
        let cases = [
            (Standing::Done, Decision::Skip(SkipReason::Done)),
            (Standing::Failed, Decision::Skip(SkipReason::FailedUnchanged)),
            (Standing::Queued, Decision::Convert(ConvertReason::WasUnderWay)),
            (Standing::Retrying, Decision::Convert(ConvertReason::Retry)),
            (Standing::Refused, Decision::Convert(ConvertReason::WasRefused)),
        ];
        for (standing, same) in cases {
            assert_eq!(decide_by_content(&record(standing), HASH), same);
            let other = decide_by_content(&record(standing), HASH + 1);
            assert_eq!(other, Decision::Convert(ConvertReason::InputChanged));
        }
    }

    #[test]
    fn reasons_are_told() {
        let missing = Decision::Convert(ConvertReason::OutputMissing("/out/a.glb".into()));
        assert_eq!(missing.to_string(), "its output /out/a.glb is gone, or is not as it was written");
        let settings = Decision::Convert(ConvertReason::SettingsChanged);
        assert_eq!(
            settings.to_string(),
            "its settings or obstacles are others than those it was converted with"
        );
    }
}
