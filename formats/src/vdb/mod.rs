//! OpenVDB files: level sets and what else is known of their voxels out, grids of floats and of vectors in.
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
//! A node stores one value per slot; where a slot has no child that value, a *tile*, holds for all
//! voxels under it. A level set is a float grid whose background is the half width of its band,
//! whose voxels are active exactly where |φ| is less, and whose inactive voxels and tiles are
//! exactly + background outside and − background inside.
//!
//! The writer is our own, since no crate writes these files that is more than a first release; the
//! reader is our own, since the one crate that is older loses the sign of inactive voxels.
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
mod tree;
mod uuid;
mod write;

pub use metadata::MetaValue;
pub use read::{GridInfo, Transform, grids, read_level_set, read_vectors};
pub use read_tree::{GridData, LevelSetData, Tile, VectorGridData};
pub use write::{Encoded, WriteOptions, encode, grid_notes, write};

use read::{first_grid_metadata, last_grid_end};

/// The format's name in errors.
const FORMAT: &str = "OpenVDB";

/// How values are packed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// All values of each leaf, as they are.
    None,
    /// Only the values of active voxels.
    #[serde(rename = "active", alias = "active_mask")]
    ActiveMask,
    /// Only the values of active voxels, in Blosc frames with LZ4: what OpenVDB does by default.
    #[default]
    Blosc,
}

impl Compression {
    /// All of them.
    pub const ALL: [Compression; 3] = [Compression::None, Compression::ActiveMask, Compression::Blosc];

    /// Its name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Compression::None => "none",
            Compression::ActiveMask => "active",
            Compression::Blosc => "blosc",
        }
    }
}

/// What the table of formats says of it.
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

/// More bytes than the descriptor of a grid has that a writer of this crate made.
const DESCRIPTOR_BYTES_MAX: u64 = 64 << 10;
