//! The options of the commands that query a daemon's state.

use std::path::PathBuf;

use clap::Args;

#[derive(Debug, Args)]
#[command(after_long_help = STATUS_JSON)]
pub(in crate::cli) struct StatusArgs {
    /// The daemon's folder for the results
    #[arg(long, value_name = "DIR")]
    pub(in crate::cli) out: PathBuf,

    /// The daemon's journal folder, if it is not DIR/.meniscus
    #[arg(long, value_name = "DIR")]
    pub(in crate::cli) journal: Option<PathBuf>,

    /// Write JSON
    #[arg(long)]
    pub(in crate::cli) json: bool,
}

#[derive(Debug, Args)]
pub(in crate::cli) struct WhyArgs {
    /// The frame: a particle file
    #[arg(value_name = "FILE")]
    pub(in crate::cli) file: PathBuf,

    /// The daemon's folder for the results
    #[arg(long, value_name = "DIR", required_unless_present = "config")]
    pub(in crate::cli) out: Option<PathBuf>,

    /// The daemon's journal folder, if it is not DIR/.meniscus
    #[arg(long, value_name = "DIR")]
    pub(in crate::cli) journal: Option<PathBuf>,

    /// The daemon's configuration file; without it, the settings come from the journal
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) config: Option<PathBuf>,
}

const STATUS_JSON: &str = "\
Exit status:
  0    no frame has failed
  1    some frames have failed
  2    there is nothing to tell: no daemon ever worked there

JSON: an object with
  output, journal  the folders
  daemon           null where none is known, or an object with
                     running         true or false; null where the disk has no locks to ask
                     held_by         who has the folder now
                     state           running, paused, starting, stopped, killed
                     paused_because  why, where it is paused
                     pid, host, started_ms, at_ms
                                     of the daemon that was last there; at_ms: in this state since
  watches          the folders that are, or were last, watched for these results, each with input,
                   pattern, recursive, sentinel and formats; null where the journal does not say
  counts           how many frames are done, queued, retrying, failed
  failed, retrying, last_done, flawed
                   frames, each with input, outputs, attempts and at_ms, and where they are known
                   reason, particles, seconds and flaws. last_done: the newest first, five at most;
                   flawed: those done with particles left out, or with a guarantee that is broken
  waiting          files that a daemon at work takes for frames once their writers have finished, each
                   with input and reason. On a network file system, whose clock is another, only those
                   whose sentinel is missing, or that are not complete
  waiting_cut_short
                   true where there may be more of these: they are looked for in the watched folders
                   for 3 s, and among 10000 files that the journal does not know, at most
  damaged_lines    lines of the journal that cannot be read; they cost work and nothing else
Times that end in _ms are milliseconds since 1970.";
