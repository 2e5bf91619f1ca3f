//! Writes surfaces and particles to files.
//!
//! ```text
//!   writing           surfaces, one file for each format
//!   particle_files    particles without a surface
//!   diagnostics       warns about voxel sizes and radii that do not suit the particles
//! ```

pub(super) mod diagnostics;
pub(super) mod particle_files;
pub(super) mod writing;
