//! The options of farms: planning, converting and verifying shards.

use std::path::PathBuf;

use clap::Args;

use crate::cli::frame_selection::FrameSelection;
use crate::farm::SHARDS_MAX;
use crate::surface::options::{expected, ranged};

use super::{FormatArgs, MethodArgs, deviation};

#[derive(Debug, Args)]
pub(in crate::cli) struct PlanArgs {
    /// Files, folders, globs, or numbered patterns, as for convert
    #[arg(required = true, value_name = "INPUT")]
    pub(in crate::cli) inputs: Vec<PathBuf>,

    /// Folder for the results of all shards: every machine must see it, and the inputs, under the same path
    #[arg(long, value_name = "DIR")]
    pub(in crate::cli) out: PathBuf,

    /// Number of shards, 1 to 100000: each gets consecutive frames
    #[arg(long, value_name = "N", value_parser = ranged::<usize>(1..=SHARDS_MAX))]
    pub(in crate::cli) shards: usize,

    /// The plan file to write
    #[arg(short, long, value_name = "FILE")]
    pub(in crate::cli) output: PathBuf,

    #[command(flatten)]
    pub(in crate::cli) formats: FormatArgs,

    /// Convert only frames with these numbers, such as 1-240x2 (every other frame) or 1-10,20,30-40x5
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    pub(in crate::cli) frames: Option<FrameSelection>,

    /// Maximum distance by which smoothing may move the surface of a .vdb level set, in voxels, 0 to 3
    /// [default: 0]
    ///
    /// By default a level set is converted to a mesh unchanged. With a value above 0 it is first replaced by
    /// the smoothest surface within that distance. The voxel size is that of the file. Options for particles
    /// are refused.
    #[arg(
        long,
        alias = "band-slack",
        value_name = "VOXELS",
        allow_negative_numbers = true,
        value_parser = deviation()
    )]
    pub(in crate::cli) max_deviation: Option<f64>,

    #[command(flatten)]
    pub(in crate::cli) method: MethodArgs,
}

#[derive(Debug, Args)]
#[command(after_long_help = VERIFY_STATUSES)]
pub(in crate::cli) struct VerifyArgs {
    /// Folder with the results; it may differ from the folder in the plan
    #[arg(value_name = "DIR")]
    pub(in crate::cli) folder: PathBuf,

    /// The plan that the results were made with
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) plan: PathBuf,

    /// Write the state of each frame to this file, as JSON
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) report: Option<PathBuf>,

    /// Number of reading threads, 1 to 1024 [default: all cores]
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(1..=1024))]
    pub(in crate::cli) threads: Option<u16>,
}

/// Which shard to convert.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::cli) enum ShardChoice {
    /// The shard with this index, from 0.
    Number(u64),
    /// The shard whose index is in Slurm's environment variable `SLURM_ARRAY_TASK_ID`.
    Slurm,
}

/// Parses a shard index, or `slurm`.
pub(in crate::cli) fn parse_shard(text: &str) -> Result<ShardChoice, String> {
    if text == "slurm" {
        return Ok(ShardChoice::Slurm);
    }
    let number = text.parse().ok().filter(|_| text.bytes().all(|byte| byte.is_ascii_digit()));
    expected(text, number.map(ShardChoice::Number), "a shard: a number from 0, or slurm")
}

const VERIFY_STATUSES: &str = "\
State of a frame:
  done     all files exist and are complete, were made from the current input with the plan's settings, match the
           hashes in their certificate (the file beside them with the results of validation), and passed validation
  missing  a file is missing
  damaged  a file was changed or replaced after it was written
  stale    made from another version of the input, with other settings or by another version of meniscus
  failed validation
           all files exist, but a check of the surface failed: converting again would give the same result

Shards with missing, damaged or stale frames are listed: run them again, and they convert only those frames.

Exit status:
  0    every frame is done
  1    some frames are not done
  2    no frame is done, or the command is invalid";
