//! What the disk says of whether a frame is complete. The loop and whoever asks it why go by the same.

use std::path::{Path, PathBuf};

use meniscus_formats::{Completeness, completeness};

use crate::pipeline::{FileStamp, open_regular};

use super::config::Watch;
use super::readiness::{DEFAULT_SENTINEL, Sentinel, sentinel_counts, sentinel_path};

/// What the format says; where the file cannot be read, reading it will say why.
pub(super) fn completeness_of(path: &Path) -> Completeness {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let look = || completeness(&mut open_regular(path)?, &name);
    look().unwrap_or(Completeness::Unproven)
}

/// The sentinel of a frame that is this file.
pub(super) fn sentinel_of(watch: &Watch, frame: &Path, stamp: &FileStamp) -> Sentinel {
    let proof = FileStamp::of_path(&path_of_sentinel(watch, frame));
    // One that was left of an earlier version of the frame proves nothing.
    let there = proof.is_ok_and(|proof| sentinel_counts(&proof, stamp));
    if watch.sentinel.is_some() { Sentinel::Wanted { there } } else { Sentinel::Optional { there } }
}

/// The file that says that a frame is complete.
pub(super) fn path_of_sentinel(watch: &Watch, frame: &Path) -> PathBuf {
    sentinel_path(frame, sentinel_pattern(watch))
}

/// Whether some frame's sentinel could have this name.
pub(super) fn may_be_sentinel(watch: &Watch, path: &Path) -> bool {
    let pattern = sentinel_pattern(watch);
    let end = pattern.rsplit('}').next().unwrap_or(pattern);
    path.as_os_str().as_encoded_bytes().ends_with(end.as_bytes())
}

fn sentinel_pattern(watch: &Watch) -> &str {
    watch.sentinel.as_deref().unwrap_or(DEFAULT_SENTINEL)
}
