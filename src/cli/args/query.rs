//! The options of the commands that query a daemon's state.

use std::path::PathBuf;

use clap::Args;

#[derive(Debug, Args)]
#[command(after_long_help = STATUS_JSON)]
pub(in crate::cli) struct StatusArgs {
    /// The daemon's folder for the results
    #[arg(long, value_name = "DIR", required_unless_present = "config")]
    pub(in crate::cli) out: Option<PathBuf>,

    /// The daemon's journal folder, if it is not DIR/.meniscus
    #[arg(long, value_name = "DIR")]
    pub(in crate::cli) journal: Option<PathBuf>,

    /// The daemon's configuration file: show all its folders for results
    #[arg(long, value_name = "FILE", conflicts_with_all = ["out", "journal"])]
    pub(in crate::cli) config: Option<PathBuf>,

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
  1    some frames have failed; with --config also: no daemon has ever used some of the folders
  2    no daemon has ever used the folder

JSON: an object with the following; with --config a list of such objects
  output, journal  the folders
  daemon           null if none is known, or an object with
                     running         true or false; null if the file system has no locks
                     held_by         the process that holds the folder now
                     state           running, paused, starting, stopped, killed
                     paused_because  the reason, if it is paused
                     pid, host, started_ms, at_ms
                                     of the last daemon; at_ms: when it entered this state
                     refused_reload  at_ms and reason, if the last SIGHUP could not reload the
                                     configuration; otherwise null
  watches          the folders that are, or were last, watched for these results, each with input,
                   pattern, recursive, sentinel and formats; null if the journal does not say
  counts           the numbers of frames that are done, queued, retrying, failed
  failed, retrying, last_done, flawed
                   frames, each with input, outputs, attempts and at_ms, and if they are known
                   reason, particles, seconds and flaws. last_done: the newest first, five at most;
                   flawed: those converted without some particles, or that failed validation
  waiting          files that a running daemon will convert once they are complete, each with input
                   and reason. On a network file system, whose clock may differ, only those whose
                   sentinel is missing, or that are known to be incomplete
  waiting_cut_short
                   true if there may be more of these: the search in the watched folders is limited to
                   3 s and to 10000 files that are not in the journal
  damaged_lines    unreadable lines of the journal; they cost repeated work and nothing else
Times that end in _ms are milliseconds since 1970.";
