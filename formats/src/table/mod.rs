//! The table of formats: one row per format, and the only list of formats in the code.
//!
//! Each format describes itself in its own module, in a static row; this file lists the rows. The rest of the
//! program derives from the rows which files it recognises and reads, `--format` and its help, which options
//! have an effect, what an output records, how an output is checked for completeness, and which notes users
//! get.
//!
//! ```text
//!   FormatRow    name, extensions, signatures │ reads particles? │ reads a mesh?
//!   OutputRow    the same, and: help │ content and its writer │ options │ provenance │ integrity
//! ```
//!
//! Beside it is what needs several families of formats:
//!
//! ```text
//!   probe, neighbor, integrity    what a file is, what lies beside frames, and whether a file is complete
//!   batches, steps, container     reading in parts, in any format; paraview: files that list others
//!   loaded, point_formats, mesh   frames that were read; formats of points beside surfaces; meshes of any format
//!   abc_sequence, to_glb          sequences from `.glb` frames, and those frames from other formats
//! ```

pub(crate) mod abc_sequence;
mod batches;
pub mod container;
pub mod integrity;
pub(crate) mod loaded;
pub mod mesh;
pub(crate) mod neighbor;
pub(crate) mod paraview;
pub(crate) mod point_formats;
pub mod probe;
pub mod steps;
pub(crate) mod to_glb;

use std::fmt;
use std::io::{Read, Write};
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::core::data::{MeshView, Provenance};
use crate::core::error::{Error, Result};
use crate::core::options::{MeshOptions, WriteOption};
use crate::core::provenance::HEAD_BYTES_MAX;
use crate::core::row::{Content, FormatRow, MeshWriter, OutputRow, ParticleWriter};

/// Generates the two format enums from the rows.
macro_rules! formats {
    (
        written { $($(#[$written_doc:meta])* $written:ident => $output_row:path,)+ }
        read_only { $($(#[$read_doc:meta])* $read:ident => $row:path,)+ }
    ) => {
        /// A format that files can be recognised as.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum Format {
            $($(#[$written_doc])* $written,)+
            $($(#[$read_doc])* $read,)+
        }

        /// A format that files are written in.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum OutputFormat {
            $($(#[$written_doc])* $written,)+
        }

        impl Format {
            /// All formats; the writable ones come first.
            pub const ALL: [Format; [$(stringify!($written),)+ $(stringify!($read),)+].len()] =
                [$(Format::$written,)+ $(Format::$read,)+];

            pub(crate) fn row(self) -> &'static FormatRow {
                match self {
                    $(Format::$written => &$output_row.format,)+
                    $(Format::$read => &$row,)+
                }
            }

            /// The corresponding output format, if this format is written.
            pub fn output(self) -> Option<OutputFormat> {
                match self {
                    $(Format::$written => Some(OutputFormat::$written),)+
                    _ => None,
                }
            }
        }

        impl OutputFormat {
            /// All output formats, in the order of the table.
            pub const ALL: [OutputFormat; [$(stringify!($written)),+].len()] = [$(OutputFormat::$written,)+];

            pub(crate) fn row(self) -> &'static OutputRow {
                match self {
                    $(OutputFormat::$written => &$output_row,)+
                }
            }
        }
    };
}

formats! {
    written {
        /// Binary glTF.
        Glb => crate::meshes::gltf::GLB,
        /// glTF as text, with its buffer embedded.
        Gltf => crate::meshes::gltf::GLTF,
        /// OpenVDB: sparse volumes.
        Vdb => crate::vdb::ROW,
        /// Wavefront OBJ.
        Obj => crate::meshes::obj::ROW,
        /// PLY, with points or a mesh.
        Ply => crate::ply::ROW,
        /// VTK's XML formats: `.vtp`, which is written, and `.vtu`.
        Vtp => crate::vtk::ROW,
        /// USD as text.
        Usda => crate::usd::usda::ROW,
        /// Binary USD.
        Usdc => crate::usd::usdc::ROW,
        /// Alembic.
        Abc => crate::abc::ROW,
        /// Binary STL.
        Stl => crate::meshes::stl::ROW,
        /// A picture: colours only.
        Png => crate::pictures::png::ROW,
        /// A picture: colours, depth, normals and more.
        Exr => crate::pictures::exr::ROW,
    }
    read_only {
        /// Houdini's binary geometry format before version 12, which many simulators still write.
        ClassicBgeo => crate::houdini::bgeo::ROW,
        /// Houdini's binary geometry format since version 12.
        HoudiniJsonBinary => crate::houdini::BINARY,
        /// Houdini JSON geometry compressed with Blosc.
        HoudiniSc => crate::houdini::CONTAINER,
        /// VTK's legacy format, text or binary.
        VtkLegacy => crate::vtk::LEGACY_ROW,
        /// ParaView's lists of files: `.pvd`, `.vtk.series`, `.pvtu`, `.pvtp`, `.vtpd` and `.vtm`.
        VtkIndex => crate::table::paraview::INDEX_ROW,
        /// A text table: CSV, tab- or space-separated.
        Delimited => crate::tables::csv::ROW,
        /// LAMMPS dump: a table of particles for each time step.
        LammpsDump => crate::tables::lammps::ROW,
        /// XYZ atoms as text: a count, a comment, then one atom per line; frames can follow one another.
        XyzAtoms => crate::tables::xyz_ext::ROW,
        /// One NumPy array.
        Npy => crate::arrays::npy::ROW,
        /// Point clouds of the Point Cloud Library.
        Pcd => crate::points::pcd::ROW,
        /// OpenVDB with grids of points.
        VdbPoints => crate::vdb::POINTS,
        /// glTF with points, binary or as text.
        GltfPoints => crate::meshes::gltf::POINTS,
        /// Named NumPy arrays in a ZIP archive.
        Npz => crate::arrays::npy::ARCHIVE_ROW,
        /// Krakatoa's particles: records with named channels, compressed.
        Prt => crate::points::prt::ROW,
        /// JSON: lists of positions or of other attributes.
        Json => crate::arrays::json::ROW,
        /// HDF5, with one frame or several.
        Hdf5 => crate::arrays::hdf5::ROW,
        /// XDMF: an index of data sets in HDF5 files.
        Xdmf => crate::arrays::xdmf::ROW,
        /// USD in a ZIP archive.
        Usdz => crate::usd::points::PACKAGE_ROW,
    }
}

impl Format {
    /// The name shown to users.
    pub fn name(self) -> &'static str {
        self.row().name
    }

    /// File extensions, in lower case and without the dot.
    pub fn extensions(self) -> &'static [&'static str] {
        self.row().extensions
    }

    /// Whether files of this format can be read as meshes.
    pub fn has_mesh(self) -> bool {
        self.row().read_mesh.is_some()
    }

    /// Whether files of this format can be read as particles.
    pub fn has_particles(self) -> bool {
        self.row().particles.is_some()
    }
}

impl OutputFormat {
    /// The output format with this extension, given in lower case and without the dot.
    pub fn from_extension(extension: &str) -> Option<OutputFormat> {
        OutputFormat::ALL.into_iter().find(|format| format.extension() == extension)
    }

    /// The file extension, without the dot.
    pub fn extension(self) -> &'static str {
        self.row().format.extensions.first().copied().unwrap_or_default()
    }

    /// A one-line description for `--help`.
    pub fn help(self) -> &'static str {
        self.row().help
    }

    /// What files of this format contain.
    pub fn content(self) -> &'static Content {
        &self.row().content
    }

    /// The mesh writer, if the format has one.
    pub fn mesh(self) -> Option<&'static MeshWriter> {
        match self.content() {
            Content::Mesh(writer) => Some(writer),
            Content::LevelSet | Content::Picture(_) => None,
        }
    }

    /// The particle writer, if the format has one.
    pub fn particles(self) -> Option<&'static ParticleWriter> {
        self.row().write_particles.as_ref()
    }

    /// Whether files of this format have no origin: see [`MeshWriter::lacks_origin`].
    pub fn lacks_origin(self) -> bool {
        self.mesh().is_some_and(|writer| writer.lacks_origin)
    }

    /// Whether files of this format contain a mesh.
    pub fn is_mesh(self) -> bool {
        self.mesh().is_some()
    }

    /// Whether files of this format are pictures.
    pub fn is_picture(self) -> bool {
        matches!(self.content(), Content::Picture(_))
    }

    /// Whether files of this format have attributes such as velocities.
    pub fn has_attributes(self) -> bool {
        self.row().has_attributes
    }

    /// Whether an option affects files of this format.
    pub fn has_option(self, option: WriteOption) -> bool {
        self.row().options.contains(&option)
    }

    /// The options that affect files of this format.
    pub fn options(self) -> &'static [WriteOption] {
        self.row().options
    }

    /// Writes a mesh.
    ///
    /// # Errors
    /// The errors of [`MeshWriter::write`]; [`Error::Unsupported`] if the format cannot store meshes.
    pub fn write_mesh(
        self,
        mesh: &MeshView,
        options: &MeshOptions,
        provenance: &Provenance,
        out: &mut dyn Write,
    ) -> Result<()> {
        let writer = self
            .mesh()
            .ok_or_else(|| Error::unsupported(self.row().format.name, "this format cannot store meshes"))?;
        writer.write(mesh, options, provenance, out)
    }
}

impl fmt::Display for OutputFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.extension())
    }
}

impl FromStr for OutputFormat {
    type Err = String;

    /// The format with this extension.
    fn from_str(extension: &str) -> std::result::Result<OutputFormat, String> {
        OutputFormat::from_extension(extension).ok_or_else(|| format!("unknown format `{extension}`"))
    }
}

impl Serialize for OutputFormat {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.serialize_str(self.extension())
    }
}

impl<'de> Deserialize<'de> for OutputFormat {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<OutputFormat, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

/// Reads the first `HEAD_BYTES_MAX` bytes of a file, and returns the provenance that a writer of this crate stored there.
/// Returns an empty list for files of other programs.
///
/// # Errors
///
/// [`crate::Error::Io`] if reading fails; [`crate::Error::Invalid`] if the head is not of this format.
pub fn read_provenance(format: OutputFormat, file: impl Read) -> Result<Vec<(String, String)>> {
    let mut head = Vec::new();
    file.take(HEAD_BYTES_MAX).read_to_end(&mut head)?;
    (format.row().read_provenance)(&head)
}
