//! The options of `flicker`.

use std::path::PathBuf;

use clap::Args;

use crate::cli::frame_selection::FrameSelection;
use crate::cli::quantities::{parse_fps, parse_positive};
use crate::surface::options::ranged;
use crate::surface::particles::ParticleFilter;

#[derive(Debug, Args)]
#[command(after_long_help = DEFINITION)]
pub(in crate::cli) struct FlickerArgs {
    /// The surfaces, from any program: meshes such as .glb, .obj, .ply or .vtp
    ///
    /// A folder, files, globs, or a numbered pattern such as dam.####.glb, of one sequence. Of a folder with
    /// meshes in several formats, those in .glb are used, or else those in the next format of `convert
    /// --format`.
    #[arg(required = true, value_name = "MESHES")]
    pub(in crate::cli) meshes: Vec<PathBuf>,

    /// The particles of the same frames: a folder, a file, a glob, or a numbered pattern such as
    /// cache/dam.####.bgeo
    #[arg(long, required = true, value_name = "PARTICLES")]
    pub(in crate::cli) particles: Vec<PathBuf>,

    /// Frames of particles per second; needed if the particles have velocities but no ids
    #[arg(
        long,
        value_name = "N",
        allow_negative_numbers = true,
        value_parser = parse_fps,
        conflicts_with = "dt"
    )]
    pub(in crate::cli) fps: Option<f64>,

    /// Time between consecutive frames of particles, in the unit of time of the velocities, instead of --fps
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true, value_parser = parse_positive)]
    pub(in crate::cli) dt: Option<f64>,

    /// Distance between particles, the unit of the scores, in world units [default: measured as by convert]
    #[arg(long, value_name = "D", allow_negative_numbers = true, value_parser = parse_positive)]
    pub(in crate::cli) spacing: Option<f64>,

    /// Use only the particles that meet this condition, as given to convert
    #[arg(long = "where", value_name = "CONDITION")]
    pub(in crate::cli) filter: Option<ParticleFilter>,

    /// Points on the surface of each frame
    #[arg(
        long,
        value_name = "N",
        default_value_t = 20_000,
        allow_negative_numbers = true,
        value_parser = ranged::<u32>(100..=1_000_000)
    )]
    pub(in crate::cli) samples: u32,

    /// Score only frames with these numbers, such as 1-240 or 1-10,20; their neighbours are read as well
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    pub(in crate::cli) frames: Option<FrameSelection>,

    /// Write the scores of each frame to this file
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) csv: Option<PathBuf>,

    /// Write the 1000 points that flicker most to this file: frame, position, flicker
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) points: Option<PathBuf>,

    /// Plot the score of each frame, and show where the worst frames flicker: a name that ends with .png
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) picture: Option<PathBuf>,

    /// Number of threads, 1 to 1024 [default: all cores]; does not affect results
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(1..=1024))]
    pub(in crate::cli) threads: Option<u16>,
}

const DEFINITION: &str = "\
What is scored:
  Points on the surface of a frame, evenly by area, are advected to the frames before and after it with the
  particles around them, which are followed by their ids if all frames have them, else by their velocities.
  A point's flicker is the second difference of its signed distances to the three surfaces, in particle
  spacings. The score is the root of its mean square: 0 for a surface that moves as its particles do.

  A distance of more than 2 spacings counts as 2. Points with no particle within 3 spacings are
  counted and left out. A frame is scored if the frames before and after it have a mesh and particles.

Exit status:
  0    every frame between two others is scored
  1    some frames could not be read, so they and their neighbours are not scored
  2    the command is invalid, or no frame is scored";
