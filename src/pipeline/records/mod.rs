//! Records: provenance in outputs, certificates beside them, states of outputs, and the report of a run.
//!
//! ```text
//!   provenance        written into each output           certificate_file  written beside a frame's outputs
//!   inspection        the state of a frame's outputs     output_states     finds outputs with damaged bytes
//!   record            the report of a run                frame_warnings    warnings from measurements
//!   sequence_file     all frames in one file             stage_file        plays the files of the frames
//!   picture_file      reads pictures from .png           content           frames, outputs and other files
//! ```

pub(super) mod certificate_file;
pub(super) mod content;
pub(super) mod frame_warnings;
pub(super) mod inspection;
pub(super) mod output_states;
pub(super) mod picture_file;
pub(super) mod provenance;
pub(super) mod record;
pub(super) mod sequence_file;
pub(super) mod stage_file;
