//! The outputs of a frame, and their folder.

use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;

use meniscus_formats::{MeshOptions, UpAxis, WriteOption, vdb};
pub use meniscus_formats::{OutputFormat, PointFormat};

use crate::render::Up;
use crate::surface::mesh::PositionRounding;

use super::picture::{PictureOptions, up_of};
use crate::pipeline::files::names::name_of_text;

/// The allowed length of a world unit in metres: from a nanometre to a million kilometres.
pub const METERS_PER_UNIT: RangeInclusive<f64> = 1e-9..=1e9;

/// The allowed numbers of frames per second.
pub const FRAME_RATES: RangeInclusive<f64> = f64::MIN_POSITIVE..=1000.0;

/// Half the width of the band in a .vdb, in voxels: the width that programs expect of a level set.
pub(crate) const VDB_HALF_WIDTH_VOXELS: f32 = 3.0;

/// The outputs of a frame, and their folder.
#[derive(Clone, Debug, PartialEq)]
pub struct OutputOptions {
    /// The folder of all outputs, created if it is missing.
    pub folder: PathBuf,
    /// One file in each of these formats.
    pub formats: Vec<OutputFormat>,
    /// The up axis of the particles. USD records it. In glTF and Alembic y is up: with z, a transform in the
    /// file rotates the mesh.
    pub up: UpAxis,
    /// The length of a world unit in metres, within [`METERS_PER_UNIT`]: 1e-9 to 1e9. USD records it.
    pub meters_per_unit: f64,
    /// How .vdb files store values.
    pub vdb: vdb::ValueEncoding,
    /// The size and camera of pictures.
    pub picture: PictureOptions,
    /// The formats of the points beside the surface, if the settings ask for spray.
    pub spray: Vec<PointFormat>,
    /// The stage that plays the files of the frames.
    pub stage: Option<UsdStageOptions>,
}

/// What a file of a frame contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum OutputKind {
    /// The surface, a picture of it, or the particles of a frame without surface.
    Frame(OutputFormat),
    /// The points beside the surface.
    Spray(PointFormat),
}

/// A stage.
#[derive(Clone, Debug, PartialEq)]
pub struct UsdStageOptions {
    /// The file, with the extension `.usda`.
    pub path: PathBuf,
    /// Frames per second.
    pub fps: f64,
}

impl OutputOptions {
    /// These formats in this folder, with the defaults of `meniscus convert`: y is up, values are not
    /// rounded to 16 bits, and .vdb uses Blosc.
    pub fn new(folder: impl Into<PathBuf>, formats: &[OutputFormat]) -> OutputOptions {
        OutputOptions {
            folder: folder.into(),
            formats: formats.to_vec(),
            up: UpAxis::Y,
            meters_per_unit: 1.0,
            vdb: vdb::ValueEncoding::default(),
            picture: PictureOptions::default(),
            spray: Vec::new(),
            stage: None,
        }
    }

    /// The files of the frame with this stem.
    pub(crate) fn files(&self, stem: &str) -> Vec<(OutputKind, PathBuf)> {
        let of_frame = |&format| (OutputKind::Frame(format), output_path(&self.folder, stem, format));
        let of_spray = |&format| (OutputKind::Spray(format), spray_path(&self.folder, stem, format));
        self.formats.iter().map(of_frame).chain(self.spray.iter().map(of_spray)).collect()
    }

    /// The formats of the points beside a surface unless others are chosen: those of the meshes, or PLY.
    pub fn default_spray(&self) -> Vec<PointFormat> {
        let beside: Vec<PointFormat> = self.formats.iter().copied().filter_map(PointFormat::beside).collect();
        if beside.is_empty() { vec![PointFormat::Ply] } else { beside }
    }

    /// Whether pictures are written.
    pub fn has_pictures(&self) -> bool {
        self.formats.iter().any(|format| format.is_picture())
    }

    /// Upper estimate of the memory for a picture of a frame, in bytes; 0 without pictures.
    pub fn picture_bytes(&self) -> u64 {
        self.picture.largest_bytes(&self.formats)
    }

    /// Whether there are pictures whose camera still depends on the bounds of the sequence.
    pub fn needs_camera(&self) -> bool {
        self.has_pictures() && self.picture.camera.needs_bounds()
    }

    /// Whether an option affects any of the output formats.
    pub fn has_option(&self, option: WriteOption) -> bool {
        self.formats.iter().any(|format| format.has_option(option))
    }

    /// The value of an option as text, as on the command line and in records. Quads are a setting of the
    /// method, and not known here: their value is always `true`, so ask for it only if they are on.
    pub fn value(&self, option: WriteOption) -> String {
        match option {
            WriteOption::Quads => true.to_string(),
            WriteOption::Up => self.up.name().to_owned(),
            WriteOption::MetersPerUnit => self.meters_per_unit.to_string(),
            WriteOption::Values => self.vdb.to_string(),
            WriteOption::Size => {
                let [width, height] = self.picture.size;
                format!("{width}x{height}")
            }
            WriteOption::Camera => self.picture.camera.to_string(),
            WriteOption::TimeSamples => self.has_time_samples().to_string(),
        }
    }

    /// Whether an option has its default value.
    pub fn is_default(&self, option: WriteOption) -> bool {
        self.value(option) == OutputOptions::new("", &[]).value(option)
    }

    /// How positions are rounded: to world positions, if a file has these.
    pub(crate) fn position_rounding(&self) -> PositionRounding {
        if self.formats.iter().any(|format| format.lacks_origin()) {
            PositionRounding::World
        } else {
            PositionRounding::Local
        }
    }

    /// The options for writing meshes. `quads` marks the triangles that form a quad with the next triangle.
    pub(crate) fn mesh(&self, quads: Arc<[bool]>) -> MeshOptions {
        let OutputOptions { up, meters_per_unit, .. } = *self;
        let time_samples = self.has_time_samples();
        MeshOptions { up, meters_per_unit, quads, time_samples, ..MeshOptions::default() }
    }

    /// The options for writing level sets.
    pub(crate) fn vdb(&self) -> vdb::WriteOptions {
        let vdb::ValueEncoding { half, compression } = self.vdb;
        vdb::WriteOptions { half, compression, ..vdb::WriteOptions::default() }
    }

    /// The format of the meshes that a stage plays: .usdc if it is among the outputs, because it needs no
    /// copy of the arrays.
    pub fn stage_mesh_format(&self) -> Option<OutputFormat> {
        [OutputFormat::Usdc, OutputFormat::Usda].into_iter().find(|format| self.formats.contains(format))
    }

    /// The format of the points beside the surfaces that a stage plays.
    pub(crate) fn stage_points_format(&self) -> Option<PointFormat> {
        [PointFormat::Usdc, PointFormat::Usda].into_iter().find(|format| self.spray.contains(format))
    }

    /// Whether the .usda files of points have their arrays as time samples, too.
    pub(crate) fn points_have_time_samples(&self) -> bool {
        self.stage.is_some() && self.stage_points_format() == Some(PointFormat::Usda)
    }

    /// Whether the .usda files of the frames have their arrays as time samples, too.
    fn has_time_samples(&self) -> bool {
        self.stage.is_some() && self.stage_mesh_format() == Some(OutputFormat::Usda)
    }

    /// The up axis of pictures: that of the camera, or else that of the particles.
    pub fn up(&self) -> Up {
        self.picture.camera.up_or(up_of(self.up))
    }

    /// These options with a camera that shows the bounds (minimum and maximum corner in world units).
    pub fn with_camera_around(&self, bounds: [DVec3; 2]) -> OutputOptions {
        let PictureOptions { size, camera } = self.picture;
        let viewpoint = camera.viewpoint(bounds, self.picture.aspect(), up_of(self.up));
        OutputOptions { picture: PictureOptions { size, camera: viewpoint.into() }, ..self.clone() }
    }
}

/// The path of a frame's output: the frame has this stem, and the output this format.
pub fn output_path(folder: &Path, stem: &str, format: OutputFormat) -> PathBuf {
    folder.join(name_of_text(&format!("{stem}.{}", format.extension())))
}

/// The path of the points beside a frame's surface.
pub(crate) fn spray_path(folder: &Path, stem: &str, format: PointFormat) -> PathBuf {
    folder.join(name_of_text(&format!("{stem}{SPRAY_ENDING}{}", format.extension())))
}

/// The end of a name of points beside a surface, before the extension.
const SPRAY_ENDING: &str = ".spray.";

/// Whether a file has the name of points beside a surface.
pub(crate) fn has_spray_name(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let is_one = |format: PointFormat| {
        let stem = name.strip_suffix(format.extension()).and_then(|stem| stem.strip_suffix(SPRAY_ENDING));
        stem.is_some_and(|stem| !stem.is_empty())
    };
    PointFormat::ALL.into_iter().any(is_one)
}
