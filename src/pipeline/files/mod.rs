//! Files: names, identity, and atomic writes.
//!
//! ```text
//!   names, number_pattern, frame_number   names, and the numbers in them
//!   shown         paths as users see them                open         opens files without blocking on pipes
//!   stamp         detects that a file was written again  input_file   a file that may change during a read
//!   identity      which paths lead to the same file      json         values that JSON cannot represent
//!   temporary     a file that is not complete yet        host         the name of this machine
//!   checked_line  lines of JSON with a checksum          atomic_write  writes files atomically
//!   named_files   the files that a frame was read from besides its own
//!   sweep         cleans up after killed processes       out_folder   checks the output folder before a run
//! ```

pub(super) mod atomic_write;
pub(crate) mod checked_line;
pub(super) mod frame_number;
pub(super) mod host;
pub(super) mod identity;
pub(super) mod input_file;
pub(crate) mod json;
pub(super) mod named_files;
pub(super) mod names;
pub(super) mod number_pattern;
pub(super) mod open;
pub(super) mod out_folder;
pub(super) mod shown;
pub(super) mod stamp;
pub(super) mod sweep;
pub(super) mod temporary;
