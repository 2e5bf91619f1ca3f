//! Files: their names, what they are, and how they appear whole or not at all.
//!
//! ```text
//!   names, number_pattern, frame_number   names, and the numbers in them    shown  paths as users see them
//!   stamp       tells a file that was written again      open         opens files without waiting at pipes
//!   input_file  a file that others may write meanwhile   path_identity  whether two names are one file
//!   temporary   a file until it is whole                 staged_file  whole, and not under its name yet
//!   file_set    replaces several files, or none          sink         files appear, whole, or do not
//!   sweep       removes what a killed process left       out_folder   the folder of outputs before a run
//!   json        values that JSON has no form for
//! ```

pub(super) mod file_set;
pub(super) mod frame_number;
pub(super) mod input_file;
pub(crate) mod json;
pub(super) mod names;
pub(super) mod number_pattern;
pub(super) mod open;
pub(super) mod out_folder;
pub(super) mod path_identity;
pub(super) mod shown;
pub(super) mod sink;
pub(super) mod staged_file;
pub(super) mod stamp;
pub(super) mod sweep;
pub(super) mod temporary;
