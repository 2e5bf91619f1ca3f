//! Records for tests. The hashes are arbitrary; an unfinished record is newer than a done one.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::pipeline::{DoneRecord, FileStamp, OutputFile, UnfinishedRecord, UnfinishedState, settings_id};

fn name_of(input: &Path) -> PathBuf {
    input.file_stem().expect("a name").into()
}

/// The record of a frame with one output, a `.glb`.
pub(crate) fn done_record(input: &Path, stamp: FileStamp) -> Arc<DoneRecord> {
    let name = name_of(input);
    let output = OutputFile { name: name.with_added_extension("glb"), stamp: FileStamp::default(), hash: 8 };
    let no_settings = [].into();
    Arc::new(DoneRecord {
        name,
        input: input.to_owned(),
        stamp,
        input_hash: 7,
        named: None,
        obstacles: String::new(),
        around: Vec::new(),
        obstacle_stamp: None,
        settings: settings_id(&no_settings),
        camera: None,
        outputs: vec![output],
        violations: None,
        flaws: Vec::new(),
        at_ms: 1,
        figures: Arc::default(),
        certificate: None,
    })
}

/// The record of a frame in this state.
pub(crate) fn unfinished_record(input: &Path, state: UnfinishedState) -> UnfinishedRecord {
    UnfinishedRecord {
        name: name_of(input),
        input: input.to_owned(),
        state,
        reason: None,
        stamp: FileStamp::default(),
        named: None,
        settings: String::new(),
        obstacle_stamp: None,
        attempts: 0,
        at_ms: 2,
    }
}
