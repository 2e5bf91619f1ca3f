//! The method: particles in, a smooth surface out. No files, no clock of its own, no threads but those of the rayon pool
//! that the caller is in.

pub mod skin;

pub mod options;
pub mod report;

pub mod validation;

pub mod anisotropy;
pub mod attributes;
pub mod contour;
pub mod edits;
pub mod flicker;
pub mod rasterize;
pub mod smooth;
pub mod spacing;

pub mod obstacle;

pub mod level_set;

pub mod grid;
pub mod neighbors;

pub mod mesh;
pub mod particles;
pub mod space;

pub mod simd;

pub(crate) mod words;
