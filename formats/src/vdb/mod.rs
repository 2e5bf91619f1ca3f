//! OpenVDB files: writes level sets and attributes of their voxels; reads grids of floats and of vectors.
//!
//! ```text
//!   header      magic, version 224, UUID, metadata of the file, number of grids
//!   descriptor  name, Tree_float_5_4_3[_HalfFloat], three file offsets      ┐
//!   grid        compression, metadata, transform                            │ per
//!   topology    root ─▶ nodes of 32³ ─▶ nodes of 16³ ─▶ masks of 8³ leaves  │ grid
//!   buffers     per leaf in the same order: mask, values                    ┘
//!
//!   voxels across:  root child 4096 = 32 · 128,   128 = 16 · 8,   leaf 8
//! ```
//!
//! A node stores one value per slot. If a slot has no child, its value applies to all voxels of the slot:
//! this is a *tile*. A level set is a float grid. Its background is the half width of its band. A voxel is
//! active exactly if |φ| is less than the background. Inactive voxels and tiles are exactly the positive
//! background outside, and the negative background inside.
//!
//! This crate has its own writer, because the other crates that write these files are first releases. It has
//! its own reader, because the one older crate loses the sign of inactive voxels.
//!
//! This work is based on:
//! the file format of OpenVDB 10, <https://www.openvdb.org>

use serde::{Deserialize, Serialize};

use crate::mesh_options::WriteOption;
use crate::provenance::from_strings;
use crate::row::Integrity;
use crate::row::{Content, FormatRow, OutputRow};

mod band_grids;
mod cursor;
mod encode_leaves;
mod layout;
mod metadata;
mod read;
mod read_tree;
mod sign_flood;
mod transform;
mod tree;
mod uuid;
mod write;

pub use metadata::MetaValue;
pub use read::{
    GridInfo, LevelSetOutline, grids, has_velocity, level_set_outline, read_level_set, read_vectors,
};
pub use read_tree::{ConstantTile, GridData, LevelSetData, VectorGridData};
pub use transform::Transform;
pub use write::{EncodedVdb, WriteOptions, encode, grid_notes, write};

use read::{first_grid_metadata, last_grid_end};

/// The format's name in errors.
const FORMAT: &str = "OpenVDB";

/// The compression of values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// All values of each leaf, uncompressed.
    None,
    /// Only the values of active voxels.
    #[serde(rename = "active")]
    ActiveMask,
    /// Only the values of active voxels, in Blosc frames with LZ4: OpenVDB's default.
    #[default]
    Blosc,
}

impl Compression {
    /// All compression methods.
    pub const ALL: [Compression; 3] = [Compression::None, Compression::ActiveMask, Compression::Blosc];

    /// The name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Compression::None => "none",
            Compression::ActiveMask => "active",
            Compression::Blosc => "blosc",
        }
    }
}

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow { signatures: &[b" BDV\0\0\0\0"], ..FormatRow::new(FORMAT, &["vdb"]) },
    help: "The level set, for OpenVDB",
    content: Content::LevelSet,
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Half, WriteOption::Compression],
    read_provenance: |head| {
        let string = |(key, value)| match value {
            MetaValue::String(value) => Some((key, value)),
            _ => None,
        };
        Ok(from_strings(first_grid_metadata(head)?.into_iter().filter_map(string).collect()))
    },
    integrity: Integrity::Length(|head, read| last_grid_end(head, |start| read(start, DESCRIPTOR_BYTES_MAX))),
};

/// Longer than any descriptor of a grid that this crate writes.
const DESCRIPTOR_BYTES_MAX: u64 = 64 << 10;
