//! The options of picture sheets.

use std::path::PathBuf;

use clap::Args;

use super::render::PictureArgs;
use crate::cli::frame_selection::FrameSelection;
use crate::cli::quantities::{PictureSize, parse_picture_size};
use crate::cli::varied_option::VariedOption;
use crate::surface::options::ranged;

#[derive(Debug, Args)]
#[command(after_long_help = CONTACT_SHEETS)]
pub(in crate::cli) struct ContactSheetArgs {
    /// A folder of pictures, level sets in .vdb, meshes or particles; or files, globs, numbered patterns of
    /// them
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
#[command(after_long_help = TUNING)]
pub(in crate::cli) struct TuneArgs {
    /// Particles, as convert takes them: a file, or a folder, glob or numbered pattern with one sequence
    ///
    /// Of a sequence, the middle frame is shown, unless --frames selects another.
    #[arg(required = true, value_name = "INPUT")]
    pub(in crate::cli) inputs: Vec<PathBuf>,

    /// The sheet: a name that ends with .png
    #[arg(short, long, value_name = "FILE")]
    pub(in crate::cli) output: PathBuf,

    /// An option of convert for surfaces, with the values to show, such as preset=fluid,noisy,splash
    /// [default: position-smoothing=0,0.5,0.7,0.9 and radius-min=0.85d,1d,1.15d,1.45d]
    ///
    /// Given once, the values fill the sheet; given twice, the first option differs from row to row, and the
    /// second from column to column. Values are written as on the command line, and separated by commas.
    #[arg(long, value_name = "OPTION=VALUES")]
    pub(in crate::cli) vary: Vec<VariedOption>,

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

const TUNING: &str = "\
What is shown:
  A close-up of the part of the frame with the most surface, 16 particle spacings wide; with --camera
  zoom=1 the whole frame. --camera and --camera-from select any other view.

  All other options apply to every cell; without --vary, an option that is given is not varied. For
  each cell, the command that converts INPUT with its settings is on the sheet, and is printed with
  the time that the cell took.

Exit status:
  0    every cell has its picture
  1    some settings were refused or failed: their cells have the reasons, and the others are shown
  2    the command is invalid, or no cell has a picture: no sheet was written";

const CONTACT_SHEETS: &str = "\
What is shown:
  Each sequence has its own part of the sheet and one camera; files outside sequences share a part.
  Existing pictures are cheapest, then level sets, meshes and particles. Pictures are used only if they
  show all existing frames with one camera, and none of --camera, --camera-from and --up is given. The
  title says which kind was used.

Exit status:
  0    every frame is on the sheet
  1    some frames failed: their cells have the reasons, and the others are shown
  2    the command is invalid, or no frame could be shown: no sheet was written";
