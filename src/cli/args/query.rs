//! The options of the commands that query a daemon's state.

use std::path::PathBuf;

use clap::Args;

#[derive(Debug, Args)]
#[command(after_long_help = STATUS_JSON)]
pub(in crate::cli) struct StatusArgs {
    /// Print what is recorded of this frame only: its state, the reason, its outputs
    #[arg(value_name = "FRAME")]
    pub(in crate::cli) frame: Option<PathBuf>,

    /// The daemon's folder for the results
    #[arg(long, value_name = "DIR", required_unless_present = "config")]
    pub(in crate::cli) out: Option<PathBuf>,

    /// The daemon's configuration file: show all its folders for results
    #[arg(long, value_name = "FILE", conflicts_with = "out")]
    pub(in crate::cli) config: Option<PathBuf>,

    /// Write JSON
    #[arg(long)]
    pub(in crate::cli) json: bool,
}

const STATUS_JSON: &str = "\
Exit status:
  0    no frame has failed; with FRAME: it has not failed
  1    some frames have failed; with --config also: nothing is recorded in some of the folders
  2    nothing is recorded in the folder; with FRAME: nothing is recorded of it

JSON: an object with the following; with --config a list of such objects; with FRAME a frame
  output           the folder
  daemon           null if none is known, or an object with
                     running         true or false; null if the file system has no locks
                     held_by         the process that holds the folder now
                     state           running, paused, starting, stopped, killed
                     paused_because  the reason, if it is paused
                     pid, host, started_ms, at_ms
                                     of the last daemon; at_ms: when it entered this state
  counts           the numbers of frames that are done, queued, retrying, waiting, failed
  failed, retrying, waiting, last_done, flawed
                   frames, each with input, state, outputs, attempts, settings and at_ms, and if they
                   are known reason, particles, seconds and flaws. waiting: files that are not yet
                   complete; last_done: the newest first, five at most; flawed: those converted without
                   some particles, or that failed validation. state: waiting, queued, done, retrying,
                   failed, refused (because of other files), given_up (after all retries), ignored (not a
                   frame). settings: equal for frames that were converted with the same settings
Times that end in _ms are milliseconds since 1970.";
