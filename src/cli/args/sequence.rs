//! The options of a sequence file: one animated file with all frames of a sequence.

use std::path::PathBuf;

use clap::Args;

use crate::cli::quantities::parse_fps;
use crate::pipeline::METERS_PER_UNIT;
use crate::surface::options::ranged;

#[derive(Debug, Args)]
#[command(after_long_help = PLAYING)]
pub(in crate::cli) struct SequenceArgs {
    /// The .glb, .abc or .usdc files of the frames, as convert wrote them: files, a folder, globs, or
    /// numbered patterns such as dam.####.glb
    #[arg(required = true, value_name = "INPUT")]
    pub(in crate::cli) inputs: Vec<PathBuf>,

    /// The sequence file to write: a .glb with an animation, or a .usda, .usdc or .abc with time samples
    #[arg(short, long, value_name = "FILE")]
    pub(in crate::cli) output: PathBuf,

    /// Frame rate of the sequence file, per second, more than 0 and at most 1000; use that of your scene
    #[arg(long, value_name = "N", default_value_t = FPS, value_parser = parse_fps)]
    pub(in crate::cli) fps: f64,

    /// Length of a world unit in metres, 1e-9 to 1e9, for USD [default: 1]
    #[arg(long, value_name = "M", value_parser = ranged::<f64>(METERS_PER_UNIT))]
    pub(in crate::cli) meters_per_unit: Option<f64>,
}

/// The default frames per second.
pub(in crate::cli) const FPS: f64 = 24.0;

const PLAYING: &str = "\
The number of a frame determines when it is shown; if a frame is missing, the previous frame is held. In USD the numbers
are the time codes, and in an .abc frame n is at n / --fps seconds. In a .glb the differences between the numbers are divided
by their greatest common divisor: frames 0, 100 and 300 play at frames 0, 1 and 3. If some names have no number, or the
numbers do not increase, frames are counted from 1.

The file may replace an older sequence file, and no other file.

Frame n of a scene shows frame n of the .glb if the scene has the same frames per second as --fps: in Blender set the frame
rate (24 by default) before importing. At a lower rate the scene skips frames.

A .glb has a node for each frame, and shows one after the other by animating their scales in steps; it must stay below
4 GiB. USD and .abc have no such limit: each is one mesh with time samples. Do not blend between the samples: vertices
with the same index in two frames are different points of the surface.

All frames are read as .glb; those in .abc or .usdc are converted in memory, which takes two to four times the size of the
file. So a frame must stay below 4 GiB as .glb, and the sequence file has what a .glb has: integers are floats, without those
beyond 2^24, and there are no quads and no strings.

Exit status:
  0    all frames are in the sequence file
  1    some frames could not be read, and are left out; each is named, with the reason
  2    no sequence file was written";
