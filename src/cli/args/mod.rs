//! The parsed command line. Only the command-line layer uses these types.
//!
//! Options for numbers accept a leading minus sign, so that the range check reports `-1` as out of range, and
//! clap does not report it as an unknown option.

mod farm;
mod flicker;
mod formats;
mod manual;
mod merge;
mod method;
mod method_options;
mod query;
mod render;
mod sequence;
mod sheets;
mod watch;

use std::path::PathBuf;

use clap::builder::TypedValueParser;
use clap::{Args, Parser, Subcommand};

use crate::pipeline::OnError;
use crate::surface::options::ranged;
use crate::surface::reconstruction::DEVIATION_MAX_VOXELS;

use super::frame_selection::FrameSelection;
use super::quantities::one_of;

use farm::parse_shard;

pub(super) use farm::{FrameShard, ShardChoice, VerifyArgs};
pub(super) use flicker::FlickerArgs;
pub(super) use formats::FormatArgs;
use formats::SEQUENCE_FILE;
pub(super) use manual::{CompletionsArgs, ManArgs};
pub(super) use merge::{OptionSet, option_set};
pub(super) use method::MethodArgs;
pub(super) use method_options::MethodOptionArgs;
pub(super) use query::StatusArgs;
pub(super) use render::{PictureArgs, RenderArgs, RunArgs};
pub(super) use sequence::{FPS, SequenceArgs};
pub(super) use sheets::{ContactSheetArgs, TuneArgs};
pub(super) use watch::{DaemonArgs, FrameArgs, LogChoice, WatchArgs};

/// Convert particles into smooth meshes and level sets.
#[derive(Debug, Parser)]
#[command(name = "meniscus", version, max_term_width = 100)]
pub(super) struct Cli {
    #[command(subcommand)]
    pub(super) command: Command,
}

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    /// Convert frames of particles into meshes and level sets.
    Convert(Box<ConvertArgs>),
    /// Verify results: whether every frame is complete and up to date, and passed validation.
    Verify(VerifyArgs),
    /// Combine the frames of a sequence into one animated file.
    Sequence(SequenceArgs),
    /// Render pictures of frames: level sets, meshes, or particles, which are converted first.
    Render(Box<RenderArgs>),
    /// Show the frames of a sequence on one sheet.
    ContactSheet(Box<ContactSheetArgs>),
    /// Show one frame under a grid of settings, with the command for each, to choose by eye.
    Tune(Box<TuneArgs>),
    /// Score how much a sequence of surfaces flickers, compared with its particles.
    Flicker(Box<FlickerArgs>),
    /// Print the contents of files: particles, meshes, level sets.
    Info(InfoArgs),
    /// Watch folders, and convert every frame as it arrives.
    Watch(Box<WatchArgs>),
    /// Print the state of a daemon, or of one frame: finished, waiting and failed frames, with reasons.
    Status(StatusArgs),
    /// Print a script for shells that completes commands, options and values.
    Completions(CompletionsArgs),
    /// Write the manual: a page for each command.
    Man(ManArgs),
}

option_set! {
    #[derive(Clone, Debug, PartialEq, Args)]
    #[command(after_long_help = CHOOSING)]
    pub(super) struct ConvertArgs {
        /// Files, folders, globs, or numbered patterns such as dam.####.bgeo, dam.%04d.bgeo, dam.{}.bgeo
        ///
        /// PLY, BGEO of any version, VTK, NumPy arrays, LAMMPS dumps, XYZ files of atoms, raw XYZ (32-bit
        /// binary positions without a header) and delimited text, optionally compressed by gzip or zstd. The
        /// format is detected from the content, except for raw XYZ, which has no signature. Level sets in
        /// .vdb are converted to meshes. Frames are in natural order (9 before 10); files whose names differ
        /// only in the frame number form one sequence, and share their settings. `-` reads one file from the
        /// standard input, in any format but raw XYZ.
        #[arg(required_unless_present = "print_settings", value_name = "INPUT")]
        pub(super) inputs: Vec<PathBuf>,

        /// Folder for the results; for a single frame also a file such as dam.glb, or - for the standard
        /// output
        ///
        /// dam.0012.bgeo becomes DIR/dam.0012.glb and so on; a missing folder is created. If PATH is a file,
        /// its extension selects the format. A new folder whose name ends like a file, such as shot.obj, is
        /// written shot.obj/. Files are written under temporary names, and renamed when they are complete. A
        /// result that would replace an input, particles, or a mesh or a level set of another program is
        /// refused.
        #[arg(short, long, value_name = "PATH", required_unless_present = "print_settings")]
        pub(super) out: Option<PathBuf>,

        #[command(flatten)]
        pub(super) formats: FormatArgs,

        /// Convert only frames with these numbers, such as 1-240x2 (every other frame) or 1-10,20,30-40x5
        #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
        pub(super) frames: Option<FrameSelection>,

        /// Write the measurements of each frame to this file, as JSON
        #[arg(long, value_name = "FILE")]
        pub(super) report: Option<PathBuf>,

        /// Skip frames that are done: recorded with the same input, settings and version, and unchanged
        #[arg(long)]
        pub(super) skip_done: bool,

        /// Maximum distance by which smoothing may move the surface of a .vdb level set, in voxels, 0 to 3
        /// [default: 0]
        ///
        /// By default a level set is converted to a mesh unchanged. With a value above 0 it is first replaced
        /// by the smoothest surface within that distance. The voxel size is that of the file. Options for
        /// particles are refused.
        #[arg(long, value_name = "VOXELS", allow_negative_numbers = true, value_parser = deviation())]
        pub(super) max_deviation: Option<f64>,

        /// Write the particles unchanged, as ply or vtp, without a surface
        ///
        /// Every attribute keeps its name and type, and positions keep 64 bits. Options for surfaces are
        /// refused.
        #[arg(long)]
        pub(super) particles_only: bool,

        /// Convert only part K of N of the frames, and skip finished ones: 1/60, or slurm for the task of a
        /// job array
        ///
        /// The parts are consecutive frames. Each part measures the settings on the same frames, so together
        /// the parts write the files of a single run. The folder of the results must exist.
        #[arg(long, value_name = "K/N", value_parser = parse_shard)]
        pub(super) shard: Option<ShardChoice>,

        #[command(flatten)]
        pub(super) method: MethodArgs,

        #[command(flatten, next_help_heading = "Run")]
        pub(super) run: RunArgs,

        /// After a failed frame, stop or continue with the next [default: continue]
        #[arg(long, value_name = "WHAT", value_parser = on_error(), help_heading = "Run")]
        pub(super) on_error: Option<OnError>,

        /// Exit with status 0 even if some results fail validation
        ///
        /// Each result is validated, with the vertex positions that are in its file: every particle is
        /// inside, the surface is between its bounds, the mesh is closed. A result that fails validation is
        /// kept, and the frame is named. Without this option the exit status is then 1.
        #[arg(long, help_heading = "Run")]
        pub(super) allow_violations: bool,

        /// Print the resolved settings (those of the preset, overridden by the given options) as keys of a
        /// configuration file, and convert nothing
        ///
        /// If none of INPUT, --spacing and --voxel-size is given, lengths are in units of the particle
        /// spacing.
        #[arg(long, help_heading = "Run")]
        pub(super) print_settings: bool,

        /// After the conversion, combine the frames into one animated .glb, .usda, .usdc or .abc, as
        /// `meniscus sequence` does; may be repeated; requires a single sequence, and glb in --format
        #[arg(long, value_name = "FILE", help_heading = SEQUENCE_FILE)]
        pub(super) sequence: Vec<PathBuf>,
    }
}

#[derive(Debug, Args)]
pub(super) struct InfoArgs {
    /// Files of particles, meshes or level sets
    #[arg(required = true, value_name = "FILE")]
    pub(super) files: Vec<PathBuf>,

    /// Write JSON: a list with an object for each file
    #[arg(long)]
    pub(super) json: bool,
}

fn on_error() -> impl TypedValueParser<Value = OnError> {
    one_of([
        (OnError::Stop, "stop", "Stop: write exactly the frames before the one that failed"),
        (OnError::Continue, "continue", "Continue with the next frame"),
    ])
}

/// Parses the value of `--max-deviation` in voxels. The width of the narrow band limits it.
fn deviation() -> impl TypedValueParser<Value = f64> {
    ranged::<f64>(0.0..=DEVIATION_MAX_VOXELS.into())
}

const CHOOSING: &str = "\
Choosing the spacing, the voxel size and the radii:
  The particle spacing d, twice the particle radius of the simulation, is the only number you may
  need: --spacing. Without it, d is measured on the first, middle and last frame of the sequence,
  printed, and the same for every frame.

  A LENGTH is a number in world units, the particles' unit of length; or in particle spacings, such as
  0.6d; or in voxels, such as 5h. Exceptions: --spacing has no other unit than the world unit, and
  --voxel-size cannot be in voxels.

  By default, lengths and the amount (pseudo-time) of smoothing scale with d. The voxel size h is
  0.4 d: half of it shows more detail of the same surface, and takes about four times the time and the
  memory. On a coarse grid radii are raised to √3·h, the diagonal of a voxel, so that no particle
  falls between the voxels.

  The smoothed surface encloses a sphere of radius r_min around every particle, and each of its points
  is within r_max of some particle. Particles in sheets and filaments are flattened instead
  (--thin-radius), and particles without neighbours are smaller (--lone-radius).

  --radius-ratio  r_max / r_min: how far smoothing may move the surface. More is smoother, less
                  follows the particles more closely.
  --radius-init   where smoothing starts: about 0.9 spacings or more. The spheres of neighbouring
                  particles must overlap, or the surface begins with holes that smoothing cannot close.
  --position-smoothing
                  how far particles are first moved towards the mean of their neighbours. More makes the
                  surface smoother and steadier; 0 keeps every original position inside the surface.

  With --preset paper the radii follow h, as in the paper. If h is smaller than half the spacing,
  neighbouring spheres would not overlap: also give the radii, in spacings, for example
  --voxel-size 0.25d --radius-min 0.866d --radius-init 1.3d.

Exit status:
  0    every frame was converted, or was done already
  1    some frames failed, or their results failed validation; each is named, with the reason, and
       the others are complete
  2    the command is invalid, or no frame was converted
  130  interrupted: existing results are complete, and --skip-done continues from there";

#[cfg(test)]
mod tests;
