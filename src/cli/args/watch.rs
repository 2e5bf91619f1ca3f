//! The options of the daemon.
//!
//! All but the folders themselves are keys of `meniscus.toml`, too, under the same names with
//! underscores; so none has a default here, and what is given overrides the file.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};

use super::formats::FormatArgs;
use super::merge::{OptionSet, option_set};
use super::method::MethodArgs;
use super::render::RunArgs;
use crate::cli::quantities::{parse_bytes, parse_duration, parse_listen, parse_poll, parse_rescan};
use crate::surface::options::ranged;
use crate::watch::{Order, Poll};

#[derive(Clone, Debug, Default, Args)]
#[command(after_long_help = WATCHING)]
pub(in crate::cli) struct WatchArgs {
    /// Folders to watch; they take the place of the [[watch]] blocks of a --config
    ///
    /// A folder need not be there yet. One that goes away is waited for.
    #[arg(value_name = "DIR", required_unless_present = "config")]
    pub(in crate::cli) inputs: Vec<PathBuf>,

    /// Folder for the results; it is made if it is not there
    ///
    /// dam.0012.bgeo becomes DIR/dam.0012.glb and so on, sub/dam.0012.bgeo becomes
    /// DIR/sub/dam.0012.glb. What is done is remembered in DIR/.meniscus.
    #[arg(long, value_name = "DIR", required_unless_present = "config")]
    pub(in crate::cli) out: Option<PathBuf>,

    /// Read folders and settings from this file; options given here override it
    ///
    /// examples/meniscus.toml in the sources has every key, explained. SIGHUP reads it again.
    #[arg(long, value_name = "FILE")]
    pub(in crate::cli) config: Option<PathBuf>,

    /// Convert what is there, and end
    #[arg(long)]
    pub(in crate::cli) once: bool,

    /// With --once: exit with status 0 though some results fail validation
    #[arg(long, requires = "once")]
    pub(in crate::cli) allow_violations: bool,

    #[command(flatten)]
    pub(in crate::cli) frames: FrameArgs,

    #[command(flatten, next_help_heading = "Daemon")]
    pub(in crate::cli) daemon: DaemonArgs,

    /// The same, typed here, where others on this machine may see it
    #[arg(long, value_name = "TOKEN", conflicts_with = "token_file", help_heading = "Daemon")]
    pub(in crate::cli) token: Option<String>,
}

option_set! {
    /// What is a frame, and what becomes of it: the keys of a `[[watch]]` block.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(in crate::cli) struct FrameArgs {
        /// Only files whose name matches, such as 'dam.*.bgeo'; or, with a / in it and --recursive, whose
        /// path within DIR does, such as '*/fluid*.ply'
        ///
        /// By default all whose names say that they hold particles, and text that does. Hidden files
        /// and results of this program are never taken.
        #[arg(long, value_name = "GLOB")]
        pub(in crate::cli) pattern: Option<String>,

        /// Watch sub-folders, too
        #[arg(long)]
        pub(in crate::cli) recursive: bool,

        /// A frame is complete when the file of this name lies beside it, such as {name}.ok
        ///
        /// {name} is the frame's name, {stem} the name without its extension. Frames then wait for
        /// theirs. Without it, {stem}.done is proof where it is there.
        #[arg(long, value_name = "NAME")]
        pub(in crate::cli) sentinel: Option<String>,

        #[command(flatten)]
        pub(in crate::cli) formats: FormatArgs,

        #[command(flatten)]
        pub(in crate::cli) method: MethodArgs,
    }
}

option_set! {
    /// How the daemon goes about it: the keys of the `[daemon]` block.
    #[derive(Clone, Debug, Default, PartialEq, Args)]
    pub(in crate::cli) struct DaemonArgs {
        /// Which of several waiting frames is next [default: natural]
        #[arg(long, value_name = "WHICH", ignore_case = true)]
        pub(in crate::cli) order: Option<Order>,

        #[command(flatten)]
        pub(in crate::cli) run: RunArgs,

        /// Frames under way at once, at most, 1 to 1024; by the number of threads by default
        #[arg(long, value_name = "N", value_parser = ranged::<u16>(1..=1024))]
        pub(in crate::cli) in_flight: Option<u16>,

        /// Begin no frame while the disk of the results has less room than this [default: 1GiB]
        #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
        pub(in crate::cli) disk_floor: Option<u64>,

        /// How long a file must be left alone before it is read [default: 500ms]
        #[arg(long, value_name = "TIME", value_parser = parse_duration)]
        pub(in crate::cli) settle: Option<Duration>,

        /// The same, for a file whose format cannot tell whether it is complete [default: 4 times
        /// --settle, at least 2s]
        #[arg(long, value_name = "TIME", value_parser = parse_duration)]
        pub(in crate::cli) unproven: Option<Duration>,

        /// The same, for a file whose format says that it is not complete: then it has failed
        /// [default: 30s; with --once as --unproven]
        #[arg(long, value_name = "TIME", value_parser = parse_duration)]
        pub(in crate::cli) stalled: Option<Duration>,

        /// Look at the folders so often; auto does where the system does not tell of changes, as on
        /// network file systems [default: auto]
        #[arg(long, value_name = "TIME", value_parser = parse_poll)]
        pub(in crate::cli) poll: Option<Poll>,

        /// About how often everything is looked at, whatever the system said [default: 60s]
        #[arg(long, value_name = "TIME", value_parser = parse_rescan)]
        pub(in crate::cli) rescan: Option<Duration>,

        /// Folder to remember in what is done; .meniscus in the folder for the results by default
        #[arg(long, value_name = "DIR")]
        pub(in crate::cli) journal: Option<PathBuf>,

        /// How the log on the standard error is written [default: text]
        #[arg(long, value_name = "HOW", ignore_case = true)]
        pub(in crate::cli) log: Option<LogChoice>,

        /// Show what is going on at this address, such as 127.0.0.1:7700: a page, and an interface for programs
        ///
        /// Nothing is shown by default. It only shows, and changes nothing. Another address than one of this machine
        /// alone demands a token. Port 0 takes one that is free, and the log says which.
        #[arg(long, value_name = "ADDRESS", value_parser = parse_listen)]
        pub(in crate::cli) listen: Option<SocketAddr>,

        /// Show it only to those who know the first line of this file: 16 letters or digits or more
        #[arg(long, value_name = "FILE")]
        pub(in crate::cli) token_file: Option<PathBuf>,

        /// How long frames under way may take to finish when the daemon is asked to end [default: 30s]
        #[arg(long, value_name = "TIME", value_parser = parse_duration)]
        pub(in crate::cli) stop_deadline: Option<Duration>,
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum LogChoice {
    /// Lines to read
    Text,
    /// An object on each line
    Json,
}

impl FrameArgs {
    /// These, and where one is not given, that of a file; a spacing takes the place of one in either form.
    pub(in crate::cli) fn over_file(&self, file: &FrameArgs) -> FrameArgs {
        let mut file = file.clone();
        if self.method.to_options().spacing.is_some() {
            (file.method.particle_radius, file.method.options.spacing) = (None, None);
        }
        self.clone().over(file)
    }
}

const WATCHING: &str = "\
When a frame is read:
  A file is read when it is complete, by the first of: it was renamed into place; its sentinel is
  there; its format says so and it was left alone for --settle; it was left alone for --unproven.
  One that is written again later is converted again. Inputs are never moved, changed or removed.

  What is done is remembered in a journal, and survives a restart. `meniscus status --out DIR` tells
  it, and `meniscus why FILE --out DIR` why a frame was converted or not.

Signals:
  SIGTERM, SIGINT  finish the frames under way, within --stop-deadline, and end; a second one ends
                   at once. Nothing half written is left either way
  SIGHUP           read the --config file again; where it is wrong, go on as before

Exit status:
  0    with --once: every frame is converted. Without: the daemon was asked to end, and did
  1    with --once: some frames failed, were left, or failed validation; each is named, with why
  2    the command cannot be carried out; with --once also: no frame was converted
  130  ended at once by a second SIGINT; 143 by a second SIGTERM";
