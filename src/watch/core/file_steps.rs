//! The steps of files, as they were found.

use std::collections::HashMap;

use crate::pipeline::{FileFrames, FileStamp, FrameError};

use super::frames::FrameId;

/// The steps of a file.
#[derive(Debug)]
pub(crate) struct FileSteps {
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
pub(crate) struct StepsOrder {
    pub(crate) id: FrameId,
    pub(crate) stamp: FileStamp,
    /// Why the frame is refused if it has no steps: what its outputs would replace.
    pub(crate) conflict: Option<String>,
}

/// What came of it.
#[derive(Debug)]
pub(crate) struct FoundSteps {
    pub(crate) order: StepsOrder,
    /// Its frames; `None` if the file was written again meanwhile.
    pub(crate) frames: Result<Option<FileFrames>, FrameError>,
}
