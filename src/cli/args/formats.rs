//! The output options, shared by all commands that convert and by the configuration file.
//!
//! No option has a default here: a default on the command line would look like a given option, and override
//! the file.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::Args;
use clap::builder::TypedValueParser;
use meniscus_formats::{UpAxis, vdb};

use super::merge::option_set;
use super::sequence::FPS;
use crate::cli::quantities::{PictureSize, one_of, parse_fps, parse_picture_size};
use crate::pipeline::{CameraChoice, METERS_PER_UNIT, OutputFormat, OutputOptions, StageOptions};
use crate::surface::options::{OptionGroup, ranged};

option_set! {
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(in crate::cli) struct FormatArgs {
        /// Formats to write, separated by commas [default: glb,vdb]
        #[arg(
            long, value_name = "LIST", value_delimiter = ',', ignore_case = true, value_parser = surface_format(),
            help_heading = OptionGroup::General.heading()
        )]
        pub(in crate::cli) format: Option<Vec<OutputFormat>>,

        /// Axis of the particles that points up; with z, .glb and .abc are rotated, because they have Y up,
        /// and USD records the axis [default: y]
        #[arg(long, help_heading = FORMATS, value_name = "AXIS", ignore_case = true, value_parser = up_axis())]
        pub(in crate::cli) up: Option<UpAxis>,

        /// Length of a world unit in metres, 1e-9 to 1e9, for USD: 0.01 if particles are in centimetres
        /// [default: 1]
        #[arg(long, help_heading = FORMATS, value_name = "M", value_parser = ranged::<f64>(METERS_PER_UNIT))]
        pub(in crate::cli) meters_per_unit: Option<f64>,

        /// How .vdb stores values: half for 16 bits, with about three significant digits; and the compression
        /// none, active (active values only) or blosc, as in half,blosc [default: blosc]
        #[arg(long, help_heading = FORMATS, value_name = "LIST")]
        pub(in crate::cli) vdb: Option<vdb::ValueEncoding>,

        /// Also write a picture of each frame, with one camera for the whole sequence [default: none]
        #[arg(long, help_heading = FORMATS, value_name = "FORMAT", ignore_case = true, value_parser = picture_format())]
        pub(in crate::cli) preview: Option<OutputFormat>,

        /// Width and height of pictures, in pixels, each 16 to 8192 [default: 1280x720]
        #[arg(long, help_heading = FORMATS, value_name = "SIZE", value_parser = parse_picture_size)]
        pub(in crate::cli) preview_size: Option<PictureSize>,

        /// Camera of the pictures: auto, or a list such as azimuth=32,elevation=22,view=30,zoom=1,up=z or
        /// eye=1:2:3,target=0:0:0,view=40,up=y. Angles are in degrees; `view` is the vertical field of view,
        /// and `zoom=1` fits the surface into the picture [default: auto]
        #[arg(long, help_heading = FORMATS, value_name = "SPEC")]
        pub(in crate::cli) camera: Option<CameraChoice>,

        /// Write a small USD stage that plays the .usdc or .usda files of the frames, and their .vdb files;
        /// requires usdc or usda in --format, or vdb without any mesh format
        ///
        /// FILE must end in .usda. It is replaced while frames arrive: it plays the frames that are complete,
        /// and holds the previous one where a frame is missing. Its paths are relative to its folder, so move
        /// it together with the results. Each sequence is a prim. Every shard updates it.
        #[arg(long, help_heading = SEQUENCE_FILE, value_name = "FILE")]
        pub(in crate::cli) stage: Option<PathBuf>,

        /// Frame rate of the sequence file or the stage, per second, more than 0 and at most 1000; use that
        /// of your scene [default: 24]
        #[arg(long, help_heading = SEQUENCE_FILE, value_name = "N", value_parser = parse_fps)]
        pub(in crate::cli) fps: Option<f64>,
    }
}

/// The help heading of all options except `--format`.
const FORMATS: &str = "Formats";

/// The heading of the options for all frames together.
pub(in crate::cli) const SEQUENCE_FILE: &str = "Sequence file";

/// A surface format.
fn surface_format() -> impl TypedValueParser<Value = OutputFormat> {
    format_if(|format| !format.is_picture())
}

/// An image format.
pub(super) fn picture_format() -> impl TypedValueParser<Value = OutputFormat> {
    format_if(OutputFormat::is_picture)
}

fn format_if(is_one: fn(OutputFormat) -> bool) -> impl TypedValueParser<Value = OutputFormat> {
    let formats = OutputFormat::ALL.into_iter().filter(move |format| is_one(*format));
    one_of(formats.map(|format| (format, format.extension(), format.help())))
}

/// An up axis.
pub(super) fn up_axis() -> impl TypedValueParser<Value = UpAxis> {
    let help = |axis| match axis {
        UpAxis::Y => "As glTF has it",
        UpAxis::Z => "As Blender and many simulators have it",
    };
    one_of(UpAxis::ALL.map(|axis| (axis, axis.name(), help(axis))))
}

impl FormatArgs {
    /// The formats to write, without duplicates: .glb and .vdb by default, and the requested image format.
    pub(in crate::cli) fn written(&self) -> Vec<OutputFormat> {
        let formats = self.format.as_deref().unwrap_or(&[OutputFormat::Glb, OutputFormat::Vdb]);
        let mut written = Vec::new();
        for format in formats.iter().copied().chain(self.preview) {
            if !written.contains(&format) {
                written.push(format);
            }
        }
        written
    }

    /// The output options, with `folder` as their folder.
    ///
    /// # Errors
    /// If --stage has nothing to play.
    pub(in crate::cli) fn outputs(&self, folder: PathBuf) -> Result<OutputOptions> {
        let default = OutputOptions::new(folder, &self.written());
        let mut picture = default.picture;
        picture.size = self.preview_size.map_or(picture.size, |size| size.map(usize::from));
        picture.camera = self.camera.unwrap_or(picture.camera);
        let outputs = OutputOptions {
            up: self.up.unwrap_or(default.up),
            meters_per_unit: self.meters_per_unit.unwrap_or(default.meters_per_unit),
            vdb: self.vdb.unwrap_or(default.vdb),
            picture,
            stage: self.stage.clone().map(|path| StageOptions { path, fps: self.fps.unwrap_or(FPS) }),
            ..default
        };
        check_stage(&outputs)?;
        Ok(outputs)
    }

    /// Refuses a frame rate without a stage: for commands that write no sequence files.
    ///
    /// # Errors
    /// What to give as well.
    pub(in crate::cli) fn refuse_idle_fps(&self) -> Result<()> {
        if self.fps.is_some() && self.stage.is_none() {
            bail!("--fps is for a stage: give --stage as well");
        }
        Ok(())
    }
}

/// Refuses a stage with another extension, and one that plays no files.
fn check_stage(outputs: &OutputOptions) -> Result<()> {
    let Some(StageOptions { path, .. }) = &outputs.stage else { return Ok(()) };
    if path.extension().is_none_or(|extension| !extension.eq_ignore_ascii_case("usda")) {
        bail!("--stage {}: the name of this file must end in .usda", path.display());
    }
    // A user who writes meshes, as by default, expects them in the stage.
    let has_meshes = outputs.formats.iter().any(|format| format.is_mesh());
    let is_of_volumes = outputs.formats.contains(&OutputFormat::Vdb) && !has_meshes;
    if outputs.stage_mesh_format().is_none() && !is_of_volumes {
        bail!(
            "--stage plays the .usdc or .usda files of the frames, and there are none: add usdc to --format, or give \
             --format vdb for a stage of volumes"
        );
    }
    Ok(())
}
