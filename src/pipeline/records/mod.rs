//! Records: which frames are done, provenance in outputs, and the report of a run.
//!
//! ```text
//!   frame_records     which frames are done, and why     provenance        written into each output
//!                     the others are not
//!   record_file       the file that a process appends to record_line       its lines
//!   known_records     what these files say               figures           measurements in a record
//!   reason            why a frame is in its state        content           frames, outputs and other files
//!   record            the report of a run                frame_warnings    warnings from measurements
//! ```

pub(super) mod content;
pub(super) mod figures;
pub(super) mod frame_records;
pub(super) mod frame_warnings;
mod known_records;
pub(super) mod provenance;
pub(super) mod reason;
pub(super) mod record;
mod record_file;
pub(super) mod record_line;
