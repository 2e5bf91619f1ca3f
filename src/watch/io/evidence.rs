//! What the disk says of whether a frame is complete. The loop and whoever asks it why go by the same.

use std::path::Path;

use meniscus_formats::{Completeness, completeness};

use crate::pipeline::{FileStamp, open_regular};

use crate::watch::config::Watch;
use crate::watch::core::completeness::{Sentinel, path_of_sentinel, sentinel_counts};

/// What the format says; where the file cannot be read, reading it will say why.
pub(crate) fn completeness_of(path: &Path) -> Completeness {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let look = || completeness(&mut open_regular(path)?, &name);
    look().unwrap_or(Completeness::Unproven)
}

/// The sentinel of a frame that is this file.
pub(crate) fn sentinel_of(watch: &Watch, frame: &Path, stamp: &FileStamp) -> Sentinel {
    let proof = FileStamp::of_path(&path_of_sentinel(watch, frame));
    // One that was left of an earlier version of the frame proves nothing.
    let there = proof.is_ok_and(|proof| sentinel_counts(&proof, stamp));
    if watch.sentinel.is_some() { Sentinel::Wanted { there } } else { Sentinel::Optional { there } }
}
