//! The options of farms: converting and verifying shards.

use std::path::PathBuf;

use clap::Args;

use crate::surface::options::{expected, ranged};

#[derive(Debug, Args)]
#[command(after_long_help = VERIFY_STATUSES)]
pub(in crate::cli) struct VerifyArgs {
    /// Folder with the results
    #[arg(value_name = "DIR")]
    pub(in crate::cli) folder: PathBuf,

    /// Files, folders, globs, or numbered patterns, as for convert: also report their frames without results
    #[arg(long, value_name = "INPUT", num_args = 1..)]
    pub(in crate::cli) input: Vec<PathBuf>,

    /// Write the state of each frame to this file, as JSON
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) report: Option<PathBuf>,

    /// Number of reading threads, 1 to 1024 [default: all cores]
    #[arg(long, value_name = "N", value_parser = ranged::<u16>(1..=1024))]
    pub(in crate::cli) threads: Option<u16>,
}

/// Which part of the frames to convert.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::cli) enum ShardChoice {
    /// One of several consecutive parts of nearly equal size.
    Part(FrameShard),
    /// The part that Slurm's environment variables name.
    Slurm,
}

/// A shard: the part `index`, from 0, of `count` parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::cli) struct FrameShard {
    pub(in crate::cli) index: usize,
    pub(in crate::cli) count: usize,
}

/// Parses a shard such as `3/60`, or `slurm`.
pub(in crate::cli) fn parse_shard(text: &str) -> Result<ShardChoice, String> {
    if text == "slurm" {
        return Ok(ShardChoice::Slurm);
    }
    let number = |digits: &str| digits.bytes().all(|byte| byte.is_ascii_digit()).then(|| digits.parse().ok());
    let parts = text.split_once('/').and_then(|(number_text, count)| {
        let (number, count): (usize, usize) = (number(number_text)??, number(count)??);
        (1..=count).contains(&number).then(|| FrameShard { index: number - 1, count })
    });
    expected(text, parts.map(ShardChoice::Part), "K/N, with K from 1 to N, such as 3/60; or slurm")
}

const VERIFY_STATUSES: &str = "\
State of a frame:
  done        the results have the bytes that were written, were made from the current input with the settings of the
              other frames of the sequence, possibly in other formats, and passed validation
  missing     a result does not exist, or there is no record of the frame
  damaged     a result was changed or replaced after it was written
  stale       made from another version of the input, with other settings or by another version of meniscus
  violations  as done, but a check of the surface failed: converting again would give the same result

Exit status:
  0    every frame is done
  1    some frames are not done
  2    no frame is done, or the command is invalid";
