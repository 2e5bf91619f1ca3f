//! The options of picture sheets.

use std::path::PathBuf;

use clap::Args;

use super::render::PictureArgs;
use crate::cli::frame_selection::FrameSelection;
use crate::cli::parameter_sweep::{ParameterSweep, tuning_help};
use crate::cli::quantities::{PictureSize, parse_picture_size};
use crate::surface::options::ranged;

#[derive(Debug, Args)]
#[command(after_long_help = CONTACT_SHEETS)]
pub(in crate::cli) struct ContactSheetArgs {
    /// A folder of pictures, level sets in .vdb or particles; or files, globs, numbered patterns of them
    ///
    /// If a frame exists in several forms, the cheapest is shown. Particles are converted to a surface for
    /// the sheet with the options below, as convert does it; if one of these is given, only particles are
    /// used.
    #[arg(required = true, value_name = "INPUT")]
    pub(in crate::cli) inputs: Vec<PathBuf>,

    /// The sheet: a name that ends with .png
    #[arg(short, long, value_name = "FILE")]
    pub(in crate::cli) output: PathBuf,

    /// Only frames with these numbers, such as 1-240x2 (every other frame) or 1-10,20,30-40x5
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    pub(in crate::cli) frames: Option<FrameSelection>,

    /// Maximum number of cells for each sequence, 2 to 1000; if a sequence has more frames, evenly spaced
    /// ones are shown, including the first and the last
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(2..=1000), default_value_t = 60)]
    pub(in crate::cli) count: u16,

    /// Cells per row, 1 to 1000 [default: about as many as there are rows]
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(1..=1000))]
    pub(in crate::cli) columns: Option<u16>,

    /// Width and height of a cell, pixels, each 16 to 8192
    #[arg(long, value_name = "SIZE", value_parser = parse_picture_size, default_value = "240x180")]
    pub(in crate::cli) size: PictureSize,

    #[command(flatten)]
    pub(in crate::cli) pictures: PictureArgs,
}

#[derive(Debug, Args)]
#[command(after_long_help = tuning_help())]
pub(in crate::cli) struct TuneArgs {
    /// Particles, as convert takes them: a file, or a folder, glob or numbered pattern with one sequence
    ///
    /// Of a sequence, the middle frame is shown, unless --frames selects another.
    #[arg(required = true, value_name = "INPUT")]
    pub(in crate::cli) inputs: Vec<PathBuf>,

    /// The sheet: a name that ends with .png
    #[arg(short, long, value_name = "FILE")]
    pub(in crate::cli) output: PathBuf,

    /// What differs from cell to cell: one, two or three of the parameters that --help lists below the
    /// options, with or without values
    #[arg(long, value_name = "LIST", default_value = "smoothing,min")]
    pub(in crate::cli) vary: ParameterSweep,

    /// Show the frame with this number; of several, such as 100-200, the middle one is shown
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    pub(in crate::cli) frames: Option<FrameSelection>,

    /// Width and height of a cell, pixels, each 16 to 8192
    #[arg(long, value_name = "SIZE", value_parser = parse_picture_size, default_value = "480x360")]
    pub(in crate::cli) size: PictureSize,

    /// The value of --out in the printed commands, the folder for their results; tune does not create it
    #[arg(long, value_name = "DIR", default_value = "surfaces")]
    pub(in crate::cli) out: PathBuf,

    #[command(flatten)]
    pub(in crate::cli) pictures: PictureArgs,
}

const CONTACT_SHEETS: &str = "\
What is shown:
  Each sequence has its own part of the sheet and one camera; files outside sequences share a part.
  Existing pictures are cheapest, then level sets, then particles. Pictures are used only if they show
  all existing frames with one camera, and none of --camera, --camera-from and --up is given. The
  title says which kind was used.

Exit status:
  0    every frame is on the sheet
  1    some frames failed: their cells have the reasons, and the others are shown
  2    the command is invalid, or no frame could be shown: no sheet was written";
