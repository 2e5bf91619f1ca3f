//! Goes through files for their steps, on a thread where that may take its time.

use std::sync::atomic::AtomicBool;

use crate::pipeline::{FileStamp, FrameError, Stage, frames_in_unless};
use crate::watch::core::file_steps::{FoundSteps, StepsOrder};

/// Goes through a file; when all is over, not to its end.
pub(super) fn find_steps(order: StepsOrder, is_over: &AtomicBool) -> FoundSteps {
    let path = &order.id.path;
    let is_same = || FileStamp::of_path(path).is_ok_and(|now| now == order.stamp);
    // It may have waited for the files before it.
    if !is_same() {
        return FoundSteps { order, frames: Ok(None) };
    }
    let read = FrameError::catch(path, Stage::Read, || frames_in_unless(path, is_over));
    let read = read.and_then(|read| read.map_err(|error| FrameError::file(path, Stage::Read, error)));
    let frames = if is_same() { read.map(Some) } else { Ok(None) };
    FoundSteps { order, frames }
}
