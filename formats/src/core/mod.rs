//! The ground floor: what readers and writers of formats share. Nothing here knows a format.
//!
//! ```text
//!   error, limits             errors, and what a file may make a reader use
//!   data                      particles, meshes, level sets and pictures, as readers return them and writers take them
//!   row                       what a format says of itself in the table of formats
//!   batches, container        reading in parts: rows of a file, and the frames of one that has several
//!   bytes, number, text, xml  pieces of files
//!   columns, first_column     which names are positions, velocities, radii
//!   named_arrays, records     columns of values
//!   vertex_attributes, placed_mesh, options, provenance   what writers of meshes share
//!   times                     which files join several frames
//!   steps, sequence, sequence_points, narrow_points   what writers of sequences and of points share
//!   matrix                    transforms
//!   compression, zip, zstd, lzf, blosc         decompression
//! ```

pub mod batches;
pub(crate) mod blosc;
pub mod bytes;
pub mod columns;
pub mod compression;
pub(crate) mod container;
pub mod data;
pub mod error;
pub(crate) mod first_column;
pub mod limits;
pub(crate) mod lzf;
pub(crate) mod matrix;
pub(crate) mod named_arrays;
pub(crate) mod narrow_points;
pub(crate) mod neighbor;
pub(crate) mod number;
pub(crate) mod options;
pub(crate) mod placed_mesh;
pub mod provenance;
pub(crate) mod records;
pub(crate) mod row;
pub(crate) mod sequence;
pub(crate) mod sequence_points;
pub(crate) mod steps;
pub(crate) mod text;
pub(crate) mod times;
pub(crate) mod vertex_attributes;
pub(crate) mod xml;
pub(crate) mod zip;
pub(crate) mod zstd;
