//! PLY.

pub mod write;
