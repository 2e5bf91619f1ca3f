//! Decides when a file may be read: as soon as there is proof that its writer has finished.
//!
//! ```text
//!                  renamed into place ──────────────────────────────────────────▶ ready
//!                  its sentinel exists ─────────────────────────────────────────▶ ready
//!   every change   ├─ settle ─┤ its format shows it ────────────────────────────▶ ready
//!   starts anew    ├──── unverifiable ───┤ its format cannot show it ────────────▶ ready
//!                  ├──────── stalled, at least 30 s ──────┤ its writer has it open ▶ ready
//!                  ├───────────────── stalled ────────────┤ it is incomplete ────▶ ready, to report it
//! ```
//!
//! The first proof wins. A rename proves only that the file was complete when it was renamed, so it counts
//! only while the file is unchanged. If frames wait for a sentinel, nothing else counts. Closing a file
//! proves nothing: many writers close it and open it again. But while a writer has it open, the writer may
//! change it without a trace, by a memory map: it has its final size from the start, and its times are those
//! of the first change.
//!
//! The functions here read no clock and no disk: callers pass the time and the file's state.

use std::ffi::OsString;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use meniscus_formats::Completeness;

use crate::pipeline::{FileStamp, FrameFile, Reason};
use crate::watch::config::{STALLED_MIN, StabilityTimeouts, Watch};

/// The default name of a sentinel.
pub(crate) const DEFAULT_SENTINEL: &str = "{stem}.done";

/// The state of a file when it was inspected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Seen {
    /// Identifies the content of the file: changes when the file does.
    pub(crate) stamp: FileStamp,
    /// How long ago the file or its metadata changed last, by the clock of this machine. `None` if the file
    /// system has another clock, or the change lies in the future.
    pub(crate) age: Option<Duration>,
}

/// What an event says about a file, besides that it may have changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum FileHint {
    /// Nothing else.
    Changed,
    /// It was renamed into place.
    Renamed,
    /// A program that has it open has written to it.
    Written,
    /// A program that had it open for writing has closed it.
    Closed,
}

/// A file that may become a frame: its last known state, and since when it has not changed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Candidate {
    stamp: FileStamp,
    /// When the file was first seen in this state, or when it was last touched without another change.
    seen_at: Instant,
    /// How long it had been unchanged by then.
    age: Duration,
    /// Whether it was renamed into place in this state.
    renamed: bool,
    /// Whether it was written and not closed since, as far as events show.
    is_open: bool,
}

/// How long after a file was found open it is checked again.
const RECHECK: Duration = Duration::from_secs(1);

/// The file that marks a frame as complete.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Sentinel {
    /// Whether the frame waits for it; otherwise it is one of several possible proofs.
    pub(crate) is_required: bool,
    /// Whether it exists, and [`counts`](sentinel_counts).
    pub(crate) exists: bool,
}

/// Whether a file may be read now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Readiness {
    /// It may be read.
    Ready(Proof),
    /// It may not be read yet.
    Waiting {
        /// When to check again if nothing changes before; `None` if only a change can help.
        until: Option<Instant>,
        /// The missing proof.
        why: Reason,
    },
}

/// Why a file may be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Proof {
    /// It was renamed into place.
    Renamed,
    /// Its sentinel exists.
    Sentinel,
    /// It is unchanged for `settle`, and its format says that it is complete, or its reader detects
    /// truncation.
    Format,
    /// It is unchanged for `unverifiable`.
    Unchanged,
    /// It is incomplete and unchanged for `stalled`: it is read, so that the error is reported.
    Stalled,
}

impl Candidate {
    /// A file that is seen for the first time.
    pub(crate) fn new(now: Instant, seen: &Seen, hint: FileHint) -> Candidate {
        Candidate {
            stamp: seen.stamp,
            seen_at: now,
            age: seen.age.unwrap_or_default(),
            renamed: hint == FileHint::Renamed,
            // Setting the modification time sends the same event as writing, which sets both times.
            is_open: hint == FileHint::Written
                && seen.stamp.changed_ns.is_none_or(|changed_ns| changed_ns == seen.stamp.modified_ns),
        }
    }

    /// Updates the candidate with the current state of the file, and what an event said about it.
    pub(crate) fn see(&mut self, now: Instant, seen: &Seen, hint: FileHint) {
        let later = Candidate::new(now, seen, hint);
        let is_same_file = seen.stamp.inode == self.stamp.inode;
        let is_open = later.is_open || hint == FileHint::Changed && is_same_file && self.is_open;
        if seen.stamp != self.stamp {
            // A change of status alone, for example by `chmod`, does not invalidate the proof by rename.
            let renamed_before =
                self.renamed && self.stamp.without_status_change() == seen.stamp.without_status_change();
            *self = Candidate { renamed: later.renamed || renamed_before, is_open, ..later };
            return;
        }
        self.renamed |= later.renamed;
        self.is_open = is_open;
        // The file was touched, although its size and times are the same.
        if seen.age.is_some_and(|age| age < self.unchanged_for(now)) {
            (self.seen_at, self.age) = (later.seen_at, later.age);
        }
    }

    /// The file's last known stamp.
    pub(crate) fn stamp(&self) -> &FileStamp {
        &self.stamp
    }

    /// Whether the file may be read. Calls `completeness`, and `is_open`, only if the result matters.
    /// `is_open` returns whether a program has the file open for writing; its argument is how long the file has
    /// been unchanged.
    pub(crate) fn readiness(
        &self,
        now: Instant,
        timeouts: &StabilityTimeouts,
        sentinel: Sentinel,
        completeness: impl FnOnce() -> Completeness,
        is_open: impl FnOnce(Duration) -> bool,
    ) -> Readiness {
        match sentinel {
            Sentinel { exists: true, .. } => return Readiness::Ready(Proof::Sentinel),
            Sentinel { is_required: true, .. } => {
                return Readiness::Waiting { until: None, why: Reason::NoSentinel };
            }
            _ if self.renamed => return Readiness::Ready(Proof::Renamed),
            _ => {}
        }
        self.remaining_wait(now, timeouts.settle, Reason::Changing).unwrap_or_else(|| match completeness() {
            Completeness::Complete => {
                self.wait_while_open(now, timeouts, is_open).unwrap_or(Readiness::Ready(Proof::Format))
            }
            // Nobody fills such a file through a memory map, and a simulation that appends steps keeps it open.
            Completeness::NeedsReading => Readiness::Ready(Proof::Format),
            Completeness::Unknown => self
                .remaining_wait(now, timeouts.unverifiable, Reason::Unverifiable)
                .unwrap_or(Readiness::Ready(Proof::Unchanged)),
            Completeness::Incomplete { expected, found } => self
                .remaining_wait(now, timeouts.stalled, Reason::Incomplete { expected, found })
                .unwrap_or(Readiness::Ready(Proof::Stalled)),
        })
    }

    /// How long to wait because a program has the file open for writing.
    fn wait_while_open(
        &self,
        now: Instant,
        timeouts: &StabilityTimeouts,
        is_open: impl FnOnce(Duration) -> bool,
    ) -> Option<Readiness> {
        if self.is_open
            && let Some(waiting) = self.remaining_wait(now, timeouts.stalled, Reason::Open)
        {
            return Some(waiting);
        }
        // A writer that keeps a file open for so long, without a change, has probably forgotten it.
        if self.unchanged_for(now) >= timeouts.stalled.max(STALLED_MIN) {
            return None;
        }
        // Perhaps no event tells when it is closed.
        let until = now.checked_add(RECHECK);
        is_open(self.unchanged_for(now)).then_some(Readiness::Waiting { until, why: Reason::Open })
    }

    /// `None` if the file has been unchanged for at least `wanted`; otherwise how long to wait.
    fn remaining_wait(&self, now: Instant, wanted: Duration, why: Reason) -> Option<Readiness> {
        let missing = wanted.checked_sub(self.unchanged_for(now)).filter(|missing| !missing.is_zero())?;
        Some(Readiness::Waiting { until: now.checked_add(missing), why })
    }

    fn unchanged_for(&self, now: Instant) -> Duration {
        now.saturating_duration_since(self.seen_at).saturating_add(self.age)
    }
}

impl fmt::Display for Proof {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Proof::Renamed => "it was renamed into place",
            Proof::Sentinel => "its sentinel exists",
            Proof::Format => {
                "it has not changed for --settle; if it is incomplete, reading it will detect that"
            }
            Proof::Unchanged => "it has not changed for 4 times --settle, so it counts as complete",
            Proof::Stalled => "it is incomplete and no longer changes, so it is read to report the error",
        })
    }
}

/// Whether a sentinel applies to the current content of the frame: false if the frame was written after the
/// sentinel.
pub(crate) fn sentinel_counts(sentinel: &FileStamp, frame: &FileStamp) -> bool {
    frame.modified_ns <= sentinel.modified_ns
}

/// The path of a frame's sentinel. In the pattern, `{name}` is replaced by the name of the frame's file, and
/// `{stem}` by that name without the extensions of particle files. A relative pattern starts from the folder
/// of the frame.
pub(crate) fn sentinel_path(frame: &Path, pattern: &str) -> PathBuf {
    let name = frame.file_name().unwrap_or_default();
    let stem = stem(frame);
    let mut sentinel = OsString::new();
    let mut rest = pattern;
    while let Some(start) = rest.find('{') {
        let (before, placeholder) = rest.split_at(start);
        sentinel.push(before);
        let (value, length) = match () {
            () if placeholder.starts_with("{name}") => (name, "{name}".len()),
            () if placeholder.starts_with("{stem}") => (&*stem, "{stem}".len()),
            () => ("{".as_ref(), "{".len()),
        };
        sentinel.push(value);
        rest = &placeholder[length..];
    }
    sentinel.push(rest);
    frame.with_file_name(sentinel)
}

/// The path of this frame's sentinel.
pub(crate) fn path_of_sentinel(watch: &Watch, frame: &Path) -> PathBuf {
    sentinel_path(frame, sentinel_pattern(watch))
}

/// Whether this path could be the sentinel of some frame.
pub(crate) fn may_be_sentinel(watch: &Watch, path: &Path) -> bool {
    let pattern = sentinel_pattern(watch);
    let end = pattern.rsplit('}').next().unwrap_or(pattern);
    path.as_os_str().as_encoded_bytes().ends_with(end.as_bytes())
}

fn sentinel_pattern(watch: &Watch) -> &str {
    watch.sentinel.as_deref().unwrap_or(DEFAULT_SENTINEL)
}

/// The name of a frame's file without the extensions of particle files. The name need not be valid UTF-8.
fn stem(frame: &Path) -> OsString {
    let file = FrameFile::known(frame.to_owned(), false);
    let dots = |name: &str| name.matches('.').count();
    let extension_count = dots(&file.name()) - dots(&file.stem());
    let mut stem = PathBuf::from(frame.file_name().unwrap_or_default());
    for _ in 0..extension_count {
        stem.set_extension("");
    }
    stem.into_os_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMEOUTS: StabilityTimeouts = StabilityTimeouts {
        settle: Duration::from_millis(500),
        unverifiable: Duration::from_millis(2000),
        stalled: Duration::from_millis(10_000),
    };
    const HALF: Completeness = Completeness::Incomplete { expected: 100, found: 50 };

    /// One step of a test case.
    enum Step {
        /// The file is seen with this size, modification time, inode, and age in milliseconds.
        See(u64, i64, u64, Option<u64>),
        /// The same, by an event with this hint.
        Hint(FileHint, u64, i64, u64, Option<u64>),
        /// Checks the readiness, given the sentinel and what the format says, against the expected answer.
        Ask(Sentinel, Completeness, Answer),
        /// The same, while a program has the file open.
        AskOpen(Sentinel, Completeness, Answer),
    }

    #[derive(Debug, PartialEq)]
    enum Answer {
        Ready(Proof),
        /// Waiting until this many milliseconds after the start.
        Until(u64, Reason),
        Never(Reason),
    }

    use Answer::{Never, Ready, Until};
    use Completeness::{Complete, NeedsReading, Unknown};
    use FileHint::{Changed, Closed, Renamed, Written};
    use Step::{Ask, AskOpen, Hint, See};

    const NONE: Sentinel = Sentinel { is_required: false, exists: false };

    fn stamp(size: u64, modified_ns: i64, inode: u64) -> FileStamp {
        FileStamp { size, modified_ns, inode, changed_ns: None }
    }

    /// Runs the steps, each at its time in milliseconds after the start.
    fn check(case: &str, steps: &[(u64, Step)]) {
        let start = Instant::now();
        let at = |ms: u64| start + Duration::from_millis(ms);
        let mut candidate: Option<Candidate> = None;
        for (ms, step) in steps {
            let (stamp, age, hint) = match step {
                &See(size, modified, inode, age) => (stamp(size, modified, inode), age, Changed),
                &Hint(hint, size, modified, inode, age) => (stamp(size, modified, inode), age, hint),
                Ask(sentinel, completeness, expected) | AskOpen(sentinel, completeness, expected) => {
                    let is_open = matches!(step, AskOpen(..));
                    let candidate = candidate.expect("seen before");
                    let answer = match candidate.readiness(
                        at(*ms),
                        &TIMEOUTS,
                        *sentinel,
                        || *completeness,
                        |_| is_open,
                    ) {
                        Readiness::Ready(proof) => Ready(proof),
                        Readiness::Waiting { until: None, why } => Never(why),
                        Readiness::Waiting { until: Some(until), why } => {
                            Until((until - start).as_millis().try_into().expect("soon"), why)
                        }
                    };
                    assert_eq!(answer, *expected, "{case}, at {ms} ms");
                    continue;
                }
            };
            let seen = Seen { stamp, age: age.map(Duration::from_millis) };
            match &mut candidate {
                None => candidate = Some(Candidate::new(at(*ms), &seen, hint)),
                Some(candidate) => candidate.see(at(*ms), &seen, hint),
            }
            assert_eq!(*candidate.expect("seen").stamp(), stamp, "{case}, at {ms} ms");
        }
    }

    #[test]
    fn format_determines_how_long_to_wait() {
        check(
            "complete",
            &[
                (0, See(100, 1, 1, Some(0))),
                (0, Ask(NONE, Complete, Until(500, Reason::Changing))),
                (499, Ask(NONE, Complete, Until(500, Reason::Changing))),
                (500, Ask(NONE, Complete, Ready(Proof::Format))),
                (500, Ask(NONE, NeedsReading, Ready(Proof::Format))),
            ],
        );
        check(
            "format without a length",
            &[
                (0, See(100, 1, 1, Some(0))),
                (600, Ask(NONE, Unknown, Until(2000, Reason::Unverifiable))),
                (2000, Ask(NONE, Unknown, Ready(Proof::Unchanged))),
            ],
        );
        check(
            "abandoned by its writer",
            &[
                (0, See(50, 1, 1, Some(0))),
                (9999, Ask(NONE, HALF, Until(10_000, Reason::Incomplete { expected: 100, found: 50 }))),
                (10_000, Ask(NONE, HALF, Ready(Proof::Stalled))),
            ],
        );
        check(
            "last written an hour ago",
            &[
                (0, See(100, 1, 1, Some(3_600_000))),
                (0, Ask(NONE, Complete, Ready(Proof::Format))),
                (0, Ask(NONE, Unknown, Ready(Proof::Unchanged))),
                (0, Ask(NONE, HALF, Ready(Proof::Stalled))),
            ],
        );
        check(
            "last written a second ago",
            &[
                (0, See(100, 1, 1, Some(1000))),
                (0, Ask(NONE, Complete, Ready(Proof::Format))),
                (0, Ask(NONE, Unknown, Until(1000, Reason::Unverifiable))),
            ],
        );
        check(
            "without a trusted clock",
            &[
                (0, See(100, 1, 1, None)),
                (400, See(100, 1, 1, None)),
                (499, Ask(NONE, Complete, Until(500, Reason::Changing))),
                (500, Ask(NONE, Complete, Ready(Proof::Format))),
            ],
        );
    }

    #[test]
    fn every_change_restarts_the_wait() {
        check(
            "a slow writer",
            &[
                (0, See(10, 1, 1, Some(0))),
                (1000, See(40, 2, 1, Some(200))),
                (1200, Ask(NONE, HALF, Until(1300, Reason::Changing))),
                (3000, See(70, 3, 1, Some(0))),
                (3600, Ask(NONE, HALF, Until(13_000, Reason::Incomplete { expected: 100, found: 50 }))),
                (5000, See(100, 4, 1, Some(0))),
                (5499, Ask(NONE, Complete, Until(5500, Reason::Changing))),
                (5500, Ask(NONE, Complete, Ready(Proof::Format))),
            ],
        );
        check(
            "closed, then reopened to append",
            &[
                (0, See(100, 1, 1, Some(0))),
                (400, See(160, 2, 1, Some(0))),
                (500, Ask(NONE, Complete, Until(900, Reason::Changing))),
                (900, Ask(NONE, Complete, Ready(Proof::Format))),
            ],
        );
        check(
            "its header corrected, the size the same",
            &[
                (0, See(100, 1, 1, Some(0))),
                (400, See(100, 2, 1, Some(0))),
                (600, Ask(NONE, Complete, Until(900, Reason::Changing))),
            ],
        );
    }

    #[test]
    fn any_difference_counts_as_a_change() {
        check(
            "replaced by another file of the same size and time",
            &[
                (0, See(100, 1, 1, Some(3_600_000))),
                (0, Ask(NONE, Complete, Ready(Proof::Format))),
                (100, See(100, 1, 2, Some(0))),
                (100, Ask(NONE, Complete, Until(600, Reason::Changing))),
            ],
        );
        check(
            "modification time set back, as copying programs do",
            &[
                (0, See(100, 900, 1, Some(0))),
                (300, See(100, 5, 1, Some(0))),
                (600, Ask(NONE, Complete, Until(800, Reason::Changing))),
                (800, Ask(NONE, Complete, Ready(Proof::Format))),
            ],
        );
        check(
            "modification time in the future",
            &[
                (0, See(100, i64::MAX, 1, None)),
                (0, Ask(NONE, Complete, Until(500, Reason::Changing))),
                (500, Ask(NONE, Complete, Ready(Proof::Format))),
            ],
        );
        check(
            "touched with the same size and times",
            &[
                (0, See(100, 1, 1, Some(450))),
                (40, See(100, 1, 1, Some(10))),
                (60, Ask(NONE, Complete, Until(530, Reason::Changing))),
                (530, Ask(NONE, Complete, Ready(Proof::Format))),
            ],
        );
        check(
            "seen again unchanged",
            &[
                (0, See(100, 1, 1, Some(0))),
                (450, See(100, 1, 1, Some(451))),
                (500, Ask(NONE, Complete, Ready(Proof::Format))),
            ],
        );
    }

    #[test]
    fn rename_proves_completeness_of_the_renamed_file_only() {
        check(
            "renamed into place",
            &[
                (0, Hint(Renamed, 100, 1, 1, Some(0))),
                (0, Ask(NONE, HALF, Ready(Proof::Renamed))),
                (10, See(100, 1, 1, Some(10))),
                (10, Ask(NONE, HALF, Ready(Proof::Renamed))),
            ],
        );
        check(
            "seen before the rename event arrives",
            &[
                (0, See(100, 1, 1, Some(0))),
                (1, Hint(Renamed, 100, 1, 1, Some(1))),
                (1, Ask(NONE, Unknown, Ready(Proof::Renamed))),
            ],
        );
        check(
            "written again after its rename",
            &[
                (0, Hint(Renamed, 100, 1, 1, Some(0))),
                (10, See(0, 2, 1, Some(0))),
                (10, Ask(NONE, HALF, Until(510, Reason::Changing))),
                (20, See(50, 3, 1, Some(0))),
                (600, Ask(NONE, HALF, Until(10_020, Reason::Incomplete { expected: 100, found: 50 }))),
                (700, Hint(Renamed, 100, 4, 2, Some(0))),
                (700, Ask(NONE, Complete, Ready(Proof::Renamed))),
            ],
        );
    }

    /// A memory map fills a file without an event, and without a change of its size and times.
    #[test]
    fn complete_file_is_read_when_its_writer_closes_it() {
        check(
            "closed after a while",
            &[
                (0, Hint(Written, 100, 1, 1, Some(0))),
                (600, See(100, 1, 1, Some(600))),
                (600, Ask(NONE, Complete, Until(10_000, Reason::Open))),
                (600, Ask(NONE, Unknown, Until(2000, Reason::Unverifiable))),
                (3000, Hint(Closed, 100, 1, 1, Some(3000))),
                (3000, Ask(NONE, Complete, Ready(Proof::Format))),
                (3100, Hint(Written, 100, 2, 1, Some(0))),
                (3600, Ask(NONE, Complete, Until(13_100, Reason::Open))),
                (3600, Ask(NONE, NeedsReading, Ready(Proof::Format))),
            ],
        );
        check(
            "never closed",
            &[(0, Hint(Written, 100, 1, 1, Some(0))), (10_000, Ask(NONE, Complete, Ready(Proof::Format)))],
        );
        check(
            "never closed, and still open",
            &[
                (0, Hint(Written, 100, 1, 1, Some(0))),
                (9_999, AskOpen(NONE, Complete, Until(10_000, Reason::Open))),
                (10_000, AskOpen(NONE, Complete, Until(11_000, Reason::Open))),
                (29_999, AskOpen(NONE, Complete, Until(30_999, Reason::Open))),
                (30_000, AskOpen(NONE, Complete, Ready(Proof::Format))),
            ],
        );
        check(
            "opened before the daemon started",
            &[
                (0, See(100, 1, 1, Some(0))),
                (500, AskOpen(NONE, Complete, Until(1500, Reason::Open))),
                (500, AskOpen(NONE, NeedsReading, Ready(Proof::Format))),
                (1500, Ask(NONE, Complete, Ready(Proof::Format))),
            ],
        );
        check(
            "replaced by another file",
            &[
                (0, Hint(Written, 100, 1, 1, Some(0))),
                (100, See(100, 1, 2, Some(0))),
                (600, Ask(NONE, Complete, Ready(Proof::Format))),
            ],
        );
    }

    #[test]
    fn required_sentinel_is_awaited_and_optional_one_is_a_proof() {
        let wanted = |exists| Sentinel { is_required: true, exists };
        check(
            "required",
            &[
                (0, Hint(Renamed, 100, 1, 1, Some(3_600_000))),
                (0, Ask(wanted(false), Complete, Never(Reason::NoSentinel))),
                (90_000, Ask(wanted(false), HALF, Never(Reason::NoSentinel))),
                (90_000, Ask(wanted(true), HALF, Ready(Proof::Sentinel))),
            ],
        );
        check(
            "optional",
            &[
                (0, See(100, 1, 1, Some(0))),
                (0, Ask(NONE, Complete, Until(500, Reason::Changing))),
                (0, Ask(Sentinel { is_required: false, exists: true }, Unknown, Ready(Proof::Sentinel))),
            ],
        );
        let (older, frame, later) = (stamp(0, 9, 7), stamp(100, 10, 1), stamp(0, 11, 7));
        assert!(!sentinel_counts(&older, &frame), "the sentinel is for earlier content");
        assert!(sentinel_counts(&later, &frame));
        assert!(sentinel_counts(&stamp(0, 10, 7), &frame), "written within the same clock tick");
    }

    #[test]
    fn completeness_is_computed_only_if_it_matters() {
        let start = Instant::now();
        let seen = Seen { stamp: stamp(1, 1, 1), age: None };
        let missing = Sentinel { is_required: true, exists: false };
        for (hint, sentinel) in [(Changed, NONE), (Renamed, NONE), (Changed, missing)] {
            let candidate = Candidate::new(start, &seen, hint);
            candidate.readiness(start, &TIMEOUTS, sentinel, || panic!("needless"), |_| panic!("needless"));
        }
    }

    #[test]
    fn sentinel_path_replaces_name_and_stem() {
        for (frame, pattern, expected) in [
            ("/f/dam.0012.bgeo.gz", DEFAULT_SENTINEL, "/f/dam.0012.done"),
            ("/f/dam.0012.bgeo.sc", DEFAULT_SENTINEL, "/f/dam.0012.done"),
            ("/f/frame.0001", DEFAULT_SENTINEL, "/f/frame.0001.done"),
            ("/f/dam.ply", "{name}.ok", "/f/dam.ply.ok"),
            ("/f/dam.ply", "done/{stem}", "/f/done/dam"),
            ("/f/dam.ply", ".{name}-{stem}-{x}{", "/f/.dam.ply-dam-{x}{"),
            ("/f/{stem}.ply", "{name}.done", "/f/{stem}.ply.done"),
            ("dam.ply", "READY", "READY"),
        ] {
            assert_eq!(sentinel_path(Path::new(frame), pattern), Path::new(expected), "{frame} {pattern}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn sentinel_path_of_name_that_is_not_utf8() {
        use std::os::unix::ffi::OsStrExt;
        let path = |bytes: &[u8]| PathBuf::from(std::ffi::OsStr::from_bytes(bytes));
        assert_eq!(sentinel_path(&path(b"/f/d\xe4m.1.ply.gz"), DEFAULT_SENTINEL), path(b"/f/d\xe4m.1.done"));
    }
}
