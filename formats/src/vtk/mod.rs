//! VTK files: the legacy format, and the XML formats `.vtp` and `.vtu`.
//!
//! All contain points, cells and data, in several pieces and encodings. Particles are the points, with the
//! arrays that have a value for each point. Cells are skipped when particles are read. When a mesh is read,
//! the flat cells become its triangles. Meshes are written as `.vtp`.
//!
//! The layouts were derived from files of VTK, meshio, PyVista and SPlisHSPlasH.

use crate::mesh_options::WriteOption;
use crate::provenance::from_strings;
use crate::row::Integrity;
use crate::row::{Content, FormatRow, MeshEncoder, MeshWriter, OutputRow, ParticleInput, ParticleWriter};

mod appended;
mod blocks;
mod cells;
mod legacy;
mod neighbor;
mod pieces;
mod read_strings;
mod write;
mod write_particles;
mod xml;
mod xml_arrays;
mod xml_polys;

pub use legacy::{read as read_legacy, read_mesh as read_legacy_mesh};
pub(crate) use neighbor::legacy_neighbor;
pub use pieces::POLYGONS_NOTE;
pub use write::{attribute_notes, write_mesh};
pub use write_particles::{particle_notes, write_particles};
pub(crate) use xml::neighbor as xml_neighbor;
pub use xml::read as read_xml;
pub use xml_polys::{holds_polys, read_mesh};

use appended::ends_as_written;
use read_strings::field_strings;

/// The formats' names in errors.
const LEGACY: &str = "legacy VTK";
const XML: &str = "VTK XML";

/// The row of the legacy format in the table of formats.
pub(crate) static LEGACY_ROW: FormatRow = FormatRow {
    signatures: &[b"# vtk DataFile"],
    beginnings: &[b"# vtk DataFile Version "],
    particles: Some(ParticleInput::new(read_legacy)),
    read_mesh: Some(|bytes, limits, _| read_legacy_mesh(bytes, limits)),
    ..FormatRow::new(LEGACY, &["vtk"])
};

/// The row of the XML formats in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        particles: Some(ParticleInput::needs_reading(read_xml)),
        read_mesh: Some(|bytes, limits, _| read_mesh(bytes, limits)),
        ..FormatRow::new(XML, &["vtp", "vtu"])
    },
    help: "VTK PolyData, for ParaView",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Stream(|mesh, options, provenance, mut out| {
            write_mesh(mesh, options, provenance, &mut out)
        }))
    }),
    write_particles: Some(ParticleWriter {
        write: |particles, provenance, mut out| write_particles(particles, provenance, &mut out),
        notes: particle_notes,
    }),
    has_attributes: true,
    options: &[WriteOption::Quads],
    read_provenance: |head| Ok(from_strings(field_strings(head)?)),
    integrity: Integrity::Tail(ends_as_written),
};
