//! The formats in which the points beside a surface are written, such as spray.

use std::io::Write;

use crate::abc;
use crate::core::data::{ParticleFrame, Provenance};
use crate::core::error::Result;
use crate::core::limits::Limits;
use crate::core::options::MeshOptions;
use crate::houdini::bgeo;
use crate::ply;
use crate::read_particles;
use crate::table::OutputFormat;
use crate::usd::usda;
use crate::usd::usdc;
use crate::vtk;

/// A format of points.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PointFormat {
    /// Binary PLY.
    Ply,
    /// VTK's `.vtp`.
    Vtp,
    /// Classic BGEO.
    Bgeo,
    /// USD as text: a prim of the type `Points`.
    Usda,
    /// Binary USD: the same.
    Usdc,
    /// Alembic: an object with the schema `Points`.
    Abc,
}

impl PointFormat {
    /// All formats.
    pub const ALL: [PointFormat; 6] = [
        PointFormat::Ply,
        PointFormat::Vtp,
        PointFormat::Bgeo,
        PointFormat::Usda,
        PointFormat::Usdc,
        PointFormat::Abc,
    ];

    /// The file extension, without the dot.
    pub fn extension(self) -> &'static str {
        match self {
            PointFormat::Ply => "ply",
            PointFormat::Vtp => "vtp",
            PointFormat::Bgeo => "bgeo",
            PointFormat::Usda => "usda",
            PointFormat::Usdc => "usdc",
            PointFormat::Abc => "abc",
        }
    }

    /// A one-line description for `--help`.
    pub fn help(self) -> &'static str {
        match self {
            PointFormat::Ply => "Binary PLY",
            PointFormat::Vtp => "VTK PolyData",
            PointFormat::Bgeo => "Classic BGEO, for Houdini and Partio",
            PointFormat::Usda => "USD as text, with a prim of the type Points",
            PointFormat::Usdc => "Binary USD, with a prim of the type Points",
            PointFormat::Abc => "Alembic, with an object of the schema Points",
        }
    }

    /// The format with the same extension as this format of surfaces.
    pub fn beside(format: OutputFormat) -> Option<PointFormat> {
        PointFormat::ALL.into_iter().find(|points| points.extension() == format.extension())
    }

    /// Writes points with all their attributes. Of the options, the up axis and the length of a unit matter to some
    /// formats.
    ///
    /// # Errors
    /// [`Error::Io`](crate::Error::Io) if `out` fails; [`Error::Invalid`](crate::Error::Invalid) if an attribute has the
    /// wrong number of values; [`Error::TooLarge`](crate::Error::TooLarge) beyond the limits of the format.
    pub fn write(
        self,
        points: &ParticleFrame,
        options: &MeshOptions,
        provenance: &Provenance,
        out: &mut dyn Write,
    ) -> Result<()> {
        match self {
            PointFormat::Ply => ply::write_particles(points, provenance, out),
            PointFormat::Vtp => vtk::write_particles(points, provenance, out),
            PointFormat::Bgeo => bgeo::write(points, out),
            PointFormat::Usda => usda::write_particles(points, options, provenance, out),
            PointFormat::Usdc => usdc::write_particles(points, options, provenance, out),
            PointFormat::Abc => abc::write_particles(points, options, provenance, out),
        }
    }

    /// Reads points that this crate wrote, as they were given to [`PointFormat::write`], apart from what the format
    /// does not hold exactly: neither the up axis nor the unit of a file has an effect on them.
    ///
    /// # Errors
    /// Those of [`read_particles`]; [`Error::Unsupported`](crate::Error::Unsupported) or
    /// [`Error::Invalid`](crate::Error::Invalid) if another program wrote or changed the file.
    pub fn read(self, bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
        let name = format!("points.{}", self.extension());
        match self {
            PointFormat::Abc => abc::read_own_points(bytes, limits),
            PointFormat::Usda | PointFormat::Usdc => {
                let frame = read_particles(bytes, &name, limits)?;
                Ok(ParticleFrame { attributes: usdc::as_before(frame.attributes), ..frame })
            }
            PointFormat::Ply | PointFormat::Vtp | PointFormat::Bgeo => read_particles(bytes, &name, limits),
        }
    }

    /// Notes on data that a file does not hold exactly.
    pub fn notes(self, points: &ParticleFrame) -> Vec<String> {
        match self {
            PointFormat::Ply => ply::particle_notes(points),
            PointFormat::Vtp => vtk::particle_notes(points),
            PointFormat::Usda => usda::particle_notes(points),
            PointFormat::Usdc => usdc::particle_notes(points),
            PointFormat::Abc => abc::particle_notes(points),
            PointFormat::Bgeo => Vec::new(),
        }
    }
}
