//! Binary USD, `.usdc`, the crate format of the AOUSD Core Specification 1.0, §16.3: writes meshes, of one
//! frame or of a sequence as time samples, and reads the files that it wrote.
//!
//! ```text
//!   0    bootstrap     PXR-USDC, version 0.8.0, offset of the table of contents
//!   88   comment       the provenance, in the same form as in .ply
//!        arrays        points, normals, indices .., each at an offset that is a multiple of 8
//!        values        lists of names, dictionaries, time samples: refer to arrays by their offsets
//!        TOKENS STRINGS FIELDS FIELDSETS PATHS SPECS     what the layer contains: refer to values
//!        table of contents
//! ```
//!
//! No part of the format refers to the comment. The provenance is also in `customLayerData`, but this is in
//! compressed tables at the end of the file, which may have gigabytes, and `--skip-done` reads only the head
//! of a file.
//!
//! The tables are at the end, because OpenUSD overwrites everything from the first table on when it saves a
//! file that it opened. With this order, the writer of a sequence needs only one attribute of one frame in
//! memory.
//!
//! Integers are compressed in the same way as by OpenUSD. Vectors are not compressed, so that programs can
//! map them into memory.
//!
//! The file of a frame has each value twice, as the default and as a time sample, which refer to one array.
//! [Stages](crate::usda::UsdStage) see only time samples; programs that know no times find the default.

use crate::data::{VertexAttribute, VertexValues};
use crate::mesh_options::WriteOption;
use crate::row::Integrity;
use crate::row::{Content, FormatRow, MeshEncoder, MeshWriter, OutputRow};
use crate::usd::renamed;

mod array;
mod contents;
mod floats;
mod frame;
mod integers;
mod layer;
mod lz4;
mod read;
mod read_array;
mod read_samples;
mod read_tables;
mod sequence;
mod tables;
mod value;
mod write;

pub use crate::usd::{LayerInfo, SampledProperty};
pub use frame::{is_layer, to_glb};
pub use read::{UsdcFrame, UsdcLayer};
pub use read_samples::{read_layer_info, read_sampled_properties};
pub use sequence::write_sequence;

use contents::{MAGIC, claimed_bytes};
use layer::read_provenance;
use read::read_mesh;

/// Notes on vertex attributes that a file does not hold exactly.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = renamed(attributes, "usdc");
    for attribute in attributes {
        if let VertexValues::Strings { table, .. } = attribute.values
            && table.iter().any(|text| text.contains('\0'))
        {
            notes.push(format!("{}: the .usdc stores null characters as \\x00", attribute.name));
        }
    }
    notes
}

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        signatures: &[MAGIC],
        read_mesh: Some(|bytes, limits, _| read_mesh(bytes, limits)),
        ..FormatRow::new("binary USD", &["usdc"])
    },
    help: "Binary USD",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Stream(|mesh, options, provenance, mut out| {
            write::write(mesh, options, provenance, &mut out)
        }))
    }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Quads, WriteOption::Up, WriteOption::MetersPerUnit],
    read_provenance,
    integrity: Integrity::Length(claimed_bytes),
};
