//! Writes surfaces and particles to files, and files that show all frames; reads pictures again.
//!
//! ```text
//!   writing           surfaces, one file for each format
//!   particle_files    particles without a surface
//!   spray_files       the points beside a surface
//!   sequence_file     all frames in one file
//!   usd_stage         a file that plays the files of the frames
//!   picture_file      reads pictures from .png
//! ```

pub(super) mod particle_files;
pub(super) mod picture_file;
pub(super) mod sequence_file;
pub(super) mod spray_files;
pub(super) mod usd_stage;
pub(super) mod writing;
