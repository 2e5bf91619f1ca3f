//! Formats of pictures: OpenEXR and PNG.

pub mod exr;
pub mod png;
