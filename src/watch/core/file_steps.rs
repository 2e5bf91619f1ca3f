//! The steps of files, as they were found.

use std::collections::HashMap;

use crate::pipeline::{FileFrames, FileStamp, FrameError};

use super::frames::FrameId;

/// The steps of a file.
#[derive(Debug)]
pub(in crate::watch) struct FileSteps {
    /// The place of each among them.
    pub(super) index_of: HashMap<FrameId, usize>,
    pub(super) found: FileFrames,
}

impl FileSteps {
    /// Whether a step is as it was when its file had this stamp.
    pub(super) fn is_kept_since(&self, id: &FrameId, stamp: &FileStamp) -> bool {
        self.index_of.get(id).is_some_and(|&index| index < self.found.kept_since(stamp))
    }
}

/// A complete file that is to be gone through.
#[derive(Debug)]
pub(in crate::watch) struct StepsOrder {
    pub(in crate::watch) id: FrameId,
    pub(in crate::watch) stamp: FileStamp,
    /// Why the frame is refused if it has no steps: what its outputs would replace.
    pub(in crate::watch) conflict: Option<String>,
}

/// What came of it.
#[derive(Debug)]
pub(in crate::watch) struct FoundSteps {
    pub(in crate::watch) order: StepsOrder,
    /// Its frames; `None` if the file was written again meanwhile.
    pub(in crate::watch) frames: Result<Option<FileFrames>, FrameError>,
}
