//! Writes surfaces and particles to files.
//!
//! ```text
//!   writing           surfaces, one file for each format
//!   particle_files    particles without a surface
//!   diagnostics       voxels and radii that do not fit the particles
//! ```

pub(super) mod diagnostics;
pub(super) mod particle_files;
pub(super) mod writing;
