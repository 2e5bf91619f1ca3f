//! The options of what is written: the same for every command that converts, and for the keys of a file.
//!
//! Nothing here has a default of its own, so that it is known what was given: an option overrides
//! what stands in a file.

use std::sync::LazyLock;

use clap::builder::PossibleValue;
use clap::{Args, ValueEnum};

use super::merge::option_set;
use crate::cli::quantities::{PictureSize, parse_meters_per_unit, parse_picture_size};
use crate::pipeline::{CameraChoice, OutputFormat};

option_set! {
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(in crate::cli) struct FormatArgs {
        /// Which axis of the particles points up: in glTF it must be y, and z is turned there; USD says it [default: y]
        #[arg(long, value_name = "AXIS", ignore_case = true)]
        pub(in crate::cli) up: Option<UpChoice>,

        /// Length of a world unit in metres, 1e-9 to 1e9, for USD: 0.01 where particles are in centimetres [default: 1]
        #[arg(long, value_name = "M", value_parser = parse_meters_per_unit)]
        pub(in crate::cli) meters_per_unit: Option<f64>,

        /// Write .glb in small integers: a quarter to a third smaller, positions to a 65535th of the frame's width
        ///
        /// By the extension KHR_mesh_quantization, which Blender and browsers read. Other formats keep their positions; the attributes of
        /// vertices stay as they are. Triangles that have no area in 16 bits are taken out of the mesh of every format. A frame so wide that a vertex is moved by more than a 50th of a voxel is told of.
        #[arg(long)]
        pub(in crate::cli) quantize: bool,

        /// Store 16-bit values in .vdb: smaller, with three decimal digits
        #[arg(long)]
        pub(in crate::cli) vdb_half: bool,

        /// How values are packed in .vdb [default: blosc]
        #[arg(long, value_name = "HOW", ignore_case = true)]
        pub(in crate::cli) vdb_compression: Option<CompressionChoice>,

        /// Write a picture of each frame, too: one camera for the whole sequence [default: none]
        #[arg(long, value_name = "FORMAT", ignore_case = true)]
        pub(in crate::cli) preview: Option<PreviewChoice>,

        /// Width and height of pictures, pixels, each 16 to 8192 [default: 1280x720]
        #[arg(long, value_name = "SIZE", value_parser = parse_picture_size)]
        pub(in crate::cli) preview_size: Option<PictureSize>,

        /// Where pictures are taken from: auto, or a list such as azimuth=32,elevation=22,view=30,zoom=1,up=z
        /// or eye=1:2:3,target=0:0:0,view=40,up=y [default: auto]
        #[arg(long, value_name = "SPEC")]
        pub(in crate::cli) camera: Option<CameraChoice>,
    }
}

/// Defines the values of an option that takes some of the formats that are written.
macro_rules! format_choice {
    ($(#[$doc:meta])* $name:ident, $is_one:expr) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(in crate::cli) struct $name(pub(in crate::cli) OutputFormat);

        impl ValueEnum for $name {
            fn value_variants<'a>() -> &'a [$name] {
                static VARIANTS: LazyLock<Vec<$name>> =
                    LazyLock::new(|| OutputFormat::ALL.into_iter().filter($is_one).map($name).collect());
                &VARIANTS
            }

            fn to_possible_value(&self) -> Option<PossibleValue> {
                Some(PossibleValue::new(self.0.extension()).help(self.0.help()))
            }
        }
    };
}

format_choice! {
    /// A format of `--format`.
    Format, |format| !format.is_picture()
}
format_choice! {
    /// A format of `--preview`.
    PreviewChoice, |format| format.is_picture()
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum UpChoice {
    /// As glTF has it
    Y,
    /// As Blender and many simulators have it
    Z,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum CompressionChoice {
    /// All values as they are
    None,
    /// Active values only
    Active,
    /// Active values only, compressed: OpenVDB's default
    Blosc,
}
