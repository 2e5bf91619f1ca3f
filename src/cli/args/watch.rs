//! The options of the daemon.
//!
//! All options but the folders are also keys of `meniscus.toml`, with underscores in their names. None has a
//! default here: a default on the command line would look like a given option, and override the file.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};

use super::formats::FormatArgs;
use super::merge::option_set;
use super::method::MethodArgs;
use super::render::RunArgs;
use crate::cli::quantities::{parse_bytes, parse_duration, parse_listen, parse_poll};
use crate::watch::{Order, Poll};

#[derive(Clone, Debug, Default, Args)]
#[command(after_long_help = WATCHING)]
pub(in crate::cli) struct WatchArgs {
    /// Folders to watch; they replace the [[watch]] blocks of a --config
    ///
    /// A folder need not exist yet. If one disappears, the daemon waits for it.
    #[arg(value_name = "DIR", required_unless_present = "config")]
    pub(in crate::cli) inputs: Vec<PathBuf>,

    /// Folder for the results; created if missing
    ///
    /// dam.0012.bgeo becomes DIR/dam.0012.glb and so on, sub/dam.0012.bgeo becomes DIR/sub/dam.0012.glb. The
    /// records of converted frames are in DIR/.meniscus.
    #[arg(long, value_name = "DIR", required_unless_present = "config")]
    pub(in crate::cli) out: Option<PathBuf>,

    /// Read folders and settings from this file; options given here override it
    ///
    /// examples/meniscus.toml in the sources has every key, explained.
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) config: Option<PathBuf>,

    /// Convert the existing frames, and exit
    #[arg(long)]
    pub(in crate::cli) once: bool,

    /// With --once: exit with status 0 even if some results fail validation
    #[arg(long, requires = "once")]
    pub(in crate::cli) allow_violations: bool,

    #[command(flatten)]
    pub(in crate::cli) frames: FrameArgs,

    #[command(flatten, next_help_heading = "Daemon")]
    pub(in crate::cli) daemon: DaemonArgs,
}

option_set! {
    /// Which files are frames, and how they are converted: the keys of a `[[watch]]` block.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(in crate::cli) struct FrameArgs {
        /// Convert only files whose names match this pattern, such as 'dam.*.bgeo'. With --recursive, a
        /// pattern that contains / is compared with the path within DIR, such as '*/fluid*.ply'
        ///
        /// By default all files with an extension of a particle format, and text files that hold particles.
        /// Hidden files and results of meniscus are never taken.
        #[arg(long, value_name = "GLOB")]
        pub(in crate::cli) pattern: Option<String>,

        /// Watch sub-folders as well
        #[arg(long)]
        pub(in crate::cli) recursive: bool,

        /// Name of the sentinel: a frame is complete when a file of this name, such as {name}.ok, is beside
        /// it
        ///
        /// {name} is the frame's name, {stem} the name without its extension. Frames then wait for their
        /// sentinels. Without this option, {stem}.done counts as a sentinel if it exists.
        #[arg(long, value_name = "NAME")]
        pub(in crate::cli) sentinel: Option<String>,

        #[command(flatten)]
        pub(in crate::cli) formats: FormatArgs,

        #[command(flatten)]
        pub(in crate::cli) method: MethodArgs,
    }
}

option_set! {
    /// Settings of the daemon itself: the keys of the `[daemon]` block.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(in crate::cli) struct DaemonArgs {
        /// Which of several waiting frames to convert next [default: natural]
        #[arg(long, value_name = "WHICH", ignore_case = true)]
        pub(in crate::cli) order: Option<Order>,

        #[command(flatten)]
        pub(in crate::cli) run: RunArgs,

        /// Start no frame while the disk of the results has less free space than this [default: 1GiB]
        #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
        pub(in crate::cli) disk_floor: Option<u64>,

        /// How long a file must be unchanged before it is read [default: 500ms]
        ///
        /// If its format cannot show whether it is complete: four times as long. If its format shows that it
        /// is incomplete: at least 30s, with --once four times as long; then it is read, and its frame fails
        /// with a message about the missing part.
        #[arg(long, value_name = "TIME", value_parser = parse_duration)]
        pub(in crate::cli) settle: Option<Duration>,

        /// Find changes by scanning the folders at this interval; auto does so only where the operating
        /// system sends no file-system events, as on network file systems [default: auto]
        #[arg(long, value_name = "TIME", value_parser = parse_poll)]
        pub(in crate::cli) poll: Option<Poll>,

        /// Format of the log on the standard error [default: text]
        #[arg(long, value_name = "HOW", ignore_case = true)]
        pub(in crate::cli) log: Option<LogChoice>,

        /// Serve a status page and an HTTP API at this address, such as 127.0.0.1:7700
        ///
        /// Off by default, and read-only. An address that other machines can reach requires a token. With
        /// port 0 the system chooses a free port, which the log states.
        #[arg(long, value_name = "ADDRESS", value_parser = parse_listen)]
        pub(in crate::cli) listen: Option<SocketAddr>,

        /// Require clients to send the token in the first line of this file: 16 to 256 characters, letters,
        /// digits or - _ . ~
        #[arg(long, value_name = "FILE")]
        pub(in crate::cli) token_file: Option<PathBuf>,
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum LogChoice {
    /// Lines of text: short ones on a terminal, and elsewhere with all fields
    Text,
    /// One JSON object per line
    Json,
}

const WATCHING: &str = "\
When a frame is read:
  A file is read as soon as one of these is true:
    it was renamed into place
    its sentinel exists
    its format shows that it is complete, and it has not changed for --settle
    its format cannot show whether it is complete, and it has not changed for 4 times --settle
  A file that is written again later is converted again. Inputs are never moved, changed or removed.

  Records in the folder for the results say which frames are finished, so a restarted daemon resumes
  where it left off.
  `meniscus status --out DIR` prints them, and `meniscus status FRAME --out DIR` what is recorded of
  one frame.

Signals:
  SIGTERM, SIGINT  finish the frames in flight within 30s, and exit; a second one exits at once.
                   Neither leaves partial files

Exit status:
  0    with --once: every frame is converted. Without: the daemon stopped on request
  1    with --once: some frames failed, were not converted (for example because their sentinel is
       missing), or failed validation; or the stage or the records could not be written. Each is
       named, with the reason
  2    the command is invalid; with --once also: no frame was converted
  130  stopped at once by a second SIGINT; 143 by a second SIGTERM";
