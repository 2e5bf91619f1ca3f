//! Outputs of a frame: formats, pictures, and their camera.
//!
//! ```text
//!   outputs     formats and their options                picture      renders surfaces
//!   viewpoint   cameras of pictures                      framing      the camera of a sequence
//!   close_up    the most detailed part of a picture
//! ```

pub(super) mod close_up;
pub(super) mod framing;
pub(super) mod outputs;
pub(super) mod picture;
pub(super) mod viewpoint;
