//! Checks on disk whether a frame is complete. The daemon, `status` and `why` use the same checks.

use std::path::Path;
use std::time::Instant;

use meniscus_formats::{Completeness, completeness};

use crate::pipeline::{FileStamp, open_regular};
use crate::watch::config::{StabilityTimeouts, Watch};
use crate::watch::core::completeness::{Candidate, Readiness, Sentinel, path_of_sentinel, sentinel_counts};

#[cfg(target_os = "linux")]
use super::writers::is_open_for_writing;

/// Other systems do not show it without unsafe code.
#[cfg(not(target_os = "linux"))]
fn is_open_for_writing(_file: &Path, _unchanged_for: std::time::Duration) -> bool {
    false
}

/// Whether this file may be read now.
pub(crate) fn readiness_of(
    file: &Path,
    candidate: &Candidate,
    now: Instant,
    watch: &Watch,
    timeouts: &StabilityTimeouts,
) -> Readiness {
    let sentinel = FileStamp::of_path(&path_of_sentinel(watch, file));
    let sentinel = Sentinel {
        is_required: watch.sentinel.is_some(),
        // A sentinel of an earlier version of the frame proves nothing.
        exists: sentinel.is_ok_and(|sentinel| sentinel_counts(&sentinel, candidate.stamp())),
    };
    candidate.readiness(
        now,
        timeouts,
        sentinel,
        || completeness_of(file),
        |unchanged_for| is_open_for_writing(file, unchanged_for),
    )
}

/// The completeness according to the file format. Errors are ignored here, because reading the frame reports
/// them.
fn completeness_of(path: &Path) -> Completeness {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let check = || completeness(&mut open_regular(path)?, &name);
    check().unwrap_or(Completeness::Unknown)
}
