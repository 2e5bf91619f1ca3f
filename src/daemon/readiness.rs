//! When a file may be read: as soon as there is a proof that its writer has finished.
//!
//! ```text
//!                  renamed into place ──────────────────────────────────────────▶ ready
//!                  its sentinel is there ───────────────────────────────────────▶ ready
//!   every change   ├─ settle ─┤ its format tells ───────────────────────────────▶ ready
//!   starts anew    ├──────── unproven ───┤ its format has no way of telling ─────▶ ready
//!                  ├───────────────── stalled ────────────┤ it declares more ────▶ ready, to say so
//! ```
//!
//! The first proof wins. A rename proves something of the file that was renamed, so it counts as long as
//! the file is the one that was seen then; and where frames wait for a sentinel, nothing else counts.
//! That a file is closed proves nothing: many writers close and open again.
//!
//! Nothing here knows a clock or a disk: both are arguments.

use std::ffi::OsString;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use meniscus_formats::Completeness;

use crate::pipeline::{FileStamp, FrameFile};

use super::config::Patience;
use super::scan::Seen;

/// The name of a sentinel where nobody gave one.
pub const DEFAULT_SENTINEL: &str = "{stem}.done";

/// A file that may become a frame, as it was seen last, and since when it has not changed.
#[derive(Clone, Copy, Debug)]
pub struct Candidate {
    stamp: FileStamp,
    /// When it was seen for the first time as it is, or touched since.
    seen_at: Instant,
    /// For how long it had been left alone by then.
    age: Duration,
    /// Whether it was renamed into place as it is.
    renamed: bool,
}

/// The file that says that a frame is complete.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sentinel {
    /// There is no such thing.
    None,
    /// The frame waits for it.
    Wanted {
        /// Whether it is there, and [`counts`](sentinel_counts).
        there: bool,
    },
    /// It is a proof among others.
    Optional {
        /// Whether it is there, and [`counts`](sentinel_counts).
        there: bool,
    },
}

/// Whether a file may be read now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Readiness {
    /// It may.
    Ready(Proof),
    /// It may not yet.
    Waiting {
        /// When to ask again, if nothing changes before; `None` if only a change can help.
        until: Option<Instant>,
        /// What is missing.
        why: WaitReason,
    },
}

/// Why a file may be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Proof {
    /// It was renamed into place.
    Renamed,
    /// Its sentinel is there.
    Sentinel,
    /// Its format tells, or its reader will; and it was left alone.
    Format,
    /// It was left alone for long.
    Unchanged,
    /// It is not complete, and has been left alone for so long that it is to be said.
    Stalled,
}

/// Why a file may not be read yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WaitReason {
    /// Its sentinel is not there, or older than the frame.
    Sentinel,
    /// It changed just now.
    Changing,
    /// Its format cannot tell whether it is complete.
    Unproven,
    /// Its format says that it is not complete.
    Incomplete {
        /// Bytes that it declares, at least.
        expected: u64,
        /// Bytes that there are.
        found: u64,
    },
}

impl Candidate {
    /// A file that is seen for the first time.
    pub fn new(now: Instant, seen: &Seen, renamed: bool) -> Candidate {
        Candidate { stamp: seen.stamp, seen_at: now, age: seen.age.unwrap_or_default(), renamed }
    }

    /// Takes in what is seen of the file now, and whether it was renamed into place since.
    pub fn see(&mut self, now: Instant, seen: &Seen, renamed: bool) {
        let later = Candidate::new(now, seen, renamed);
        if seen.stamp != self.stamp {
            *self = later;
            return;
        }
        self.renamed |= renamed;
        // Touched in a way that its size and times do not show.
        if seen.age.is_some_and(|age| age < self.unchanged_for(now)) {
            (self.seen_at, self.age) = (later.seen_at, later.age);
        }
    }

    /// The file as it was seen last.
    pub fn stamp(&self) -> &FileStamp {
        &self.stamp
    }

    /// Whether the file may be read. `completeness` is asked for only if it matters.
    pub fn readiness(
        &self,
        now: Instant,
        patience: &Patience,
        sentinel: Sentinel,
        completeness: impl FnOnce() -> Completeness,
    ) -> Readiness {
        match sentinel {
            Sentinel::Wanted { there: true } | Sentinel::Optional { there: true } if !self.renamed => {
                return Readiness::Ready(Proof::Sentinel);
            }
            Sentinel::Wanted { there: true } => return Readiness::Ready(Proof::Sentinel),
            Sentinel::Wanted { there: false } => {
                return Readiness::Waiting { until: None, why: WaitReason::Sentinel };
            }
            _ if self.renamed => return Readiness::Ready(Proof::Renamed),
            _ => {}
        }
        self.left_alone(now, patience.settle, WaitReason::Changing).unwrap_or_else(|| match completeness() {
            Completeness::Complete | Completeness::ByReading => Readiness::Ready(Proof::Format),
            Completeness::Unproven => self
                .left_alone(now, patience.unproven, WaitReason::Unproven)
                .unwrap_or(Readiness::Ready(Proof::Unchanged)),
            Completeness::Incomplete { expected, found } => self
                .left_alone(now, patience.stalled, WaitReason::Incomplete { expected, found })
                .unwrap_or(Readiness::Ready(Proof::Stalled)),
        })
    }

    /// How to wait until the file has been left alone for so long; `None` if it has.
    fn left_alone(&self, now: Instant, wanted: Duration, why: WaitReason) -> Option<Readiness> {
        let missing = wanted.checked_sub(self.unchanged_for(now)).filter(|missing| !missing.is_zero())?;
        Some(Readiness::Waiting { until: now.checked_add(missing), why })
    }

    fn unchanged_for(&self, now: Instant) -> Duration {
        now.saturating_duration_since(self.seen_at).saturating_add(self.age)
    }
}

impl fmt::Display for Readiness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Readiness::Ready(proof) => write!(f, "ready: {proof}"),
            Readiness::Waiting { why, .. } => write!(f, "waiting: {why}"),
        }
    }
}

impl fmt::Display for Proof {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Proof::Renamed => "it was renamed into place",
            Proof::Sentinel => "its sentinel is there",
            Proof::Format => "it was left alone, and its format tells whether it is complete",
            Proof::Unchanged => "it was left alone for long, and its format cannot tell more",
            Proof::Stalled => "it is not complete, but nobody has been writing it for long",
        })
    }
}

impl fmt::Display for WaitReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            WaitReason::Sentinel => f.write_str("its sentinel is missing, or older than the frame"),
            WaitReason::Changing => f.write_str("it changed just now"),
            WaitReason::Unproven => f.write_str(
                "its format cannot tell whether it is complete, so it must be left alone for longer",
            ),
            WaitReason::Incomplete { expected, found } => {
                write!(f, "it is not complete: {found} of at least {expected} bytes")
            }
        }
    }
}

/// Whether a sentinel says something of the frame as it is: not if the frame was written after it.
pub fn sentinel_counts(sentinel: &FileStamp, frame: &FileStamp) -> bool {
    frame.modified_ns <= sentinel.modified_ns
}

/// The sentinel of a frame: `{name}` in the pattern stands for the name of its file, `{stem}` for the
/// same without the extensions of particles. It is in the frame's folder, or where a pattern with `/`
/// leads from there.
pub fn sentinel_path(frame: &Path, pattern: &str) -> PathBuf {
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

/// The name of a frame's file without what says that it is one of particles, be it text or not.
fn stem(frame: &Path) -> OsString {
    let file = FrameFile::new(frame.to_owned());
    let dots = |name: &str| name.matches('.').count();
    let extension_count = dots(&file.name()) - dots(&file.stem());
    let mut stem = PathBuf::from(frame.file_name().unwrap_or_default());
    for _ in 0..extension_count {
        stem.set_extension("");
    }
    stem.into_os_string()
}
