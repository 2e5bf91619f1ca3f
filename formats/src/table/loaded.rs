//! What is read of a frame before its particles are wanted.

use crate::core::data::ParticleFrame;
use crate::table::Format;

/// The content of a frame: bytes, which [`crate::read_particles`] reads, or particles.
#[derive(Clone, Debug, PartialEq)]
pub enum Loaded {
    /// The bytes of a file, or of one of its steps.
    Bytes(Vec<u8>),
    /// The particles of a step of a file of this format that has no bytes of its own.
    Particles(Format, Box<ParticleFrame>),
}
