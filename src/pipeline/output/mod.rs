//! Writes surfaces and particles to files.
//!
//! ```text
//!   writing           surfaces, one file for each format
//!   particle_files    particles without a surface
//!   spray_files       the points beside a surface
//! ```

pub(super) mod particle_files;
pub(super) mod spray_files;
pub(super) mod writing;
