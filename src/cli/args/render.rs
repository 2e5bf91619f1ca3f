//! The options of `meniscus render`.

use std::path::PathBuf;

use clap::Args;

use meniscus_formats::UpAxis;

use super::formats::{picture_format, up_axis};
use super::merge::option_set;
use super::method::MethodArgs;
use crate::cli::frame_selection::FrameSelection;
use crate::cli::quantities::{PictureSize, parse_bytes, parse_picture_size};
use crate::pipeline::{CameraChoice, OutputFormat};
use crate::surface::options::ranged;

#[derive(Debug, Args)]
#[command(after_long_help = CAMERAS)]
pub(in crate::cli) struct RenderArgs {
    /// Level sets in .vdb, meshes, or any input of convert: files, folders, globs, numbered patterns
    ///
    /// Particles are first converted to a surface with the options below, as convert does it.
    #[arg(required = true, value_name = "INPUT")]
    pub(in crate::cli) inputs: Vec<PathBuf>,

    /// The picture of one frame: a name that ends with .png or .exr
    #[arg(short, long, value_name = "FILE", conflicts_with_all = ["out", "format"], required_unless_present = "out")]
    pub(in crate::cli) output: Option<PathBuf>,

    /// Folder for the pictures of any number of frames; created if missing
    ///
    /// dam.0012.bgeo becomes DIR/dam.0012.png.
    #[arg(long, value_name = "DIR")]
    pub(in crate::cli) out: Option<PathBuf>,

    /// The format of the pictures in --out [default: png]
    #[arg(long, value_name = "FORMAT", value_parser = picture_format())]
    pub(in crate::cli) format: Option<OutputFormat>,

    /// Only frames with these numbers, such as 1-240x2 (every other frame) or 1-10,20,30-40x5
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    pub(in crate::cli) frames: Option<FrameSelection>,

    /// Width and height, pixels, each 16 to 8192
    #[arg(long, value_name = "SIZE", value_parser = parse_picture_size, default_value = "1280x720")]
    pub(in crate::cli) size: PictureSize,

    /// Number of pictures of each frame, 2 to 1000, in a full turn around it: frame.000.png and so on
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(2..=1000))]
    pub(in crate::cli) turntable: Option<u16>,

    /// Show the particles on the left, the surface on the right
    #[arg(long)]
    pub(in crate::cli) particles: bool,

    #[command(flatten)]
    pub(in crate::cli) pictures: PictureArgs,
}

/// The camera and settings of pictures, shared by every command that renders some.
#[derive(Clone, Debug, Args)]
pub(in crate::cli) struct PictureArgs {
    /// Where pictures are taken from: auto, or a list of key=value, such as azimuth=32,zoom=2, which
    /// `meniscus render --help` explains [default: auto]
    #[arg(long, value_name = "SPEC", conflicts_with = "camera_from")]
    pub(in crate::cli) camera: Option<CameraChoice>,

    /// Use the camera of this file: a .glb or .gltf with a camera, or a picture that meniscus wrote
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) camera_from: Option<PathBuf>,

    /// Axis of the world that points up, unless --camera sets it; a camera of a .glb or .gltf is rotated to
    /// it [default: y]
    #[arg(long, value_name = "AXIS", ignore_case = true, value_parser = up_axis())]
    pub(in crate::cli) up: Option<UpAxis>,

    #[command(flatten)]
    pub(in crate::cli) method: MethodArgs,

    #[command(flatten, next_help_heading = "Run")]
    pub(in crate::cli) run: RunArgs,
}

option_set! {
    /// The resources that a command may use.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(in crate::cli) struct RunArgs {
        /// Number of threads, 1 to 1024 [default: all cores]. Results do not depend on it
        #[arg(long, value_name = "N", value_parser = ranged::<u16>(1..=1024))]
        pub(in crate::cli) threads: Option<u16>,

        /// Memory limit for all frames and pictures in flight together, such as 8GiB [default: half of the
        /// available memory]
        ///
        /// A frame that needs more is converted in tiles, which are stored in temporary files beside the
        /// results; the result is the same. If even that does not fit, the frame fails with an error that
        /// says how much memory it needs at least.
        #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
        pub(in crate::cli) memory: Option<u64>,
    }
}

const CAMERAS: &str = "\
Cameras:
  By default a fixed camera shows the whole sequence, according to the bounds of its first, middle
  and last frame. Keys are separated by commas:
    azimuth, elevation  degrees from the front to the right, and above the horizon [default: 32 and 22]
    zoom                1 fits the bounds, 2 shows them twice as large [default: 1]
    view                vertical angle of view, in degrees [default: 30]
    up                  axis of the world that points up, y or z [default: that of --up]
    ground              height of the ground, or none [default: the lowest point of the bounds]
  or, instead of the first three:
    eye, target         position of the camera, and the point that it looks at, such as 1:2:3
    top                 direction that points up in the picture, such as 0:1:0 [default: that of up]

Layers of a multi-part .exr, one part each:
  beauty     R G B A      linear, 16 bits; A is 1, because the ground is in the picture
  coverage   Y            the part of the pixel that the surface covers, 16 bits
  depth      Z            along the camera's axis, world units; 1e10 where no surface is visible
  normals    N.X N.Y N.Z  outward, in world space, 16 bits
  position   P.X P.Y P.Z  world units
  velocity   V.X V.Y V.Z  world units per second, if the particles have it
  curvature  Y            mean curvature, per world unit; positive where the fluid bulges

Exit status:
  0    every picture was written
  1    some frames failed; each is named, with the reason
  2    the command is invalid, or no picture was written";
