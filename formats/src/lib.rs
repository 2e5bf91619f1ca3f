//! Bytes to plain data and back: the files that meniscus reads and writes.
//!
//! This crate knows nothing of grids, level sets or stages. A reader turns the bytes of one file
//! into plain vectors ([`data`]); a writer turns borrowed slices into bytes. Every reader treats
//! its input as hostile: counts are compared with the bytes that remain before anything is
//! allocated, and every failure is an [`Error`] that names the place and what was expected there.

pub mod data;
pub mod error;
pub mod gltf;
mod le_bytes;
pub mod limits;
pub mod obj;
pub mod ply;
pub mod provenance;
pub mod vdb;

pub use data::{
    Attribute, LevelSetView, MeshData, MeshView, ParticleFrame, Positions, Provenance, Role, Values,
};
pub use error::{Error, Place, Result};
pub use limits::Limits;
