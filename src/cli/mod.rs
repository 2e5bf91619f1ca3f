//! The command line: parses arguments into settings and a list of frames, and reports the outcome as lines
//! and an exit status.
//!
//! The layers below use [`crate::surface::options::Settings`] and frames, and never see command-line flags.

mod args;
mod batch;
mod config_file;
mod console;
mod convert;
mod destination;
mod flicker;
mod frame_selection;
mod info;
mod inputs;
mod machine;
mod manual;
mod quantities;
mod render;
mod render_session;
mod sequence;
mod settings;
mod sheets;
mod status;
mod stop_requests;
mod verify;
mod watch;
mod wording;

use std::error::Error;
use std::ffi::OsString;
use std::io;
use std::process::ExitCode;

use clap::error::{ContextKind, ErrorKind};
use meniscus_formats::escaped;

use crate::pipeline::is_error_of_machine;
use crate::surface::words::significant;

pub use machine::give_memory_back;
pub use quantities::parse_bytes;

use args::Command;
use console::Console;

/// The outcome of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum CommandOutcome {
    /// Everything succeeded.
    Done,
    /// Some of it failed.
    SomeFailed,
    /// Nothing succeeded.
    NothingDone,
    /// The machine failed: its disk, or a folder that it shares with others.
    MachineFailed,
}

impl CommandOutcome {
    /// The outcome for these numbers of finished and failed frames. Results that fail validation exist, but
    /// count as a partial failure.
    fn of(done_count: usize, failed_count: usize, has_violations: bool) -> CommandOutcome {
        match (failed_count, done_count) {
            (0, _) if !has_violations => CommandOutcome::Done,
            (1.., 0) => CommandOutcome::NothingDone,
            _ => CommandOutcome::SomeFailed,
        }
    }
}

/// The number of finished and failed frames, cells or files.
#[derive(Clone, Copy, Debug, Default)]
struct DoneCounts {
    done_count: usize,
    failed_count: usize,
}

impl DoneCounts {
    /// Counts one frame, cell or file.
    fn add(&mut self, is_done: bool) {
        *if is_done { &mut self.done_count } else { &mut self.failed_count } += 1;
    }

    fn outcome(self) -> CommandOutcome {
        CommandOutcome::of(self.done_count, self.failed_count, false)
    }
}

/// Whether a configuration file with this text is valid; nothing is executed.
///
/// # Errors
/// What is wrong in the file, and on which line.
#[doc(hidden)]
pub fn check_config(text: &str) -> anyhow::Result<()> {
    config_file::check(text)
}

/// Parses the arguments again with control characters escaped, so that the error message, which quotes
/// arguments, is safe to print: a shell glob may have inserted a file name with control characters.
fn printable(error: clap::Error, arguments: &[OsString]) -> clap::Error {
    let escaped = arguments.iter().map(|argument| escaped(argument.to_string_lossy()).to_string());
    // The escaped arguments may parse: then the original error was about bytes that are not UTF-8. Its
    // message does not repeat them, so it can be printed.
    args::parse(escaped).err().unwrap_or(error)
}

/// Options with which other programs get the radius of the particles.
const RADIUS_OPTIONS: [&str; 3] = ["-r", "--radius", "--particle-radius"];

/// The hint for the radius of the particles, as in `-r 0.025`.
fn radius_hint(error: &clap::Error, arguments: &[OsString]) -> Option<String> {
    let invalid = error.get(ContextKind::InvalidArg)?;
    let invalid = invalid.to_string();
    if error.kind() != ErrorKind::UnknownArgument || !RADIUS_OPTIONS.contains(&&*invalid) {
        return None;
    }
    let words = arguments.iter().filter_map(|argument| argument.to_str());
    let radius = words.flat_map(|word| word.split('=')).skip_while(|word| *word != invalid).nth(1);
    let radius: Option<f64> = radius.and_then(|text| text.parse().ok());
    let spacing = radius.map_or("D".to_owned(), |radius| significant(2.0 * radius));
    Some(format!("hint: the spacing of particles is twice their radius: --spacing {spacing}"))
}

/// Runs the command in `arguments`, which begin with the program's name. The exit status is 0 if everything
/// succeeded, 1 if some of it failed, 2 if nothing was done or the command is invalid, 75 if the machine failed.
pub fn run(arguments: impl IntoIterator<Item = impl Into<OsString>>) -> ExitCode {
    ExitCode::from(status_of(arguments))
}

/// Like [`run()`], but returns the exit status as a number, for programs that do not end with an
/// [`ExitCode`]. Configures the allocator, so call it before the process starts threads.
#[doc(hidden)]
pub fn status_of(arguments: impl IntoIterator<Item = impl Into<OsString>>) -> u8 {
    let arguments: Vec<OsString> = arguments.into_iter().map(Into::into).collect();
    let typed = match args::parse(&arguments) {
        Ok(typed) => typed,
        Err(help_or_error) => {
            let help_or_error = printable(help_or_error, &arguments);
            // A closed output is not an error, and other write errors cannot be reported anywhere.
            let _ = help_or_error.print();
            if let Some(hint) = radius_hint(&help_or_error, &arguments) {
                Console::new().warn(hint);
            }
            return u8::try_from(help_or_error.exit_code()).unwrap_or(2);
        }
    };
    give_memory_back();
    let mut console = Console::new();
    // The daemon handles signals itself, to finish the frames in flight.
    if !matches!(typed.command, Command::Watch(_)) {
        machine::clean_up_when_interrupted();
    }
    let outcome = match typed.command {
        Command::Convert(args) => convert::convert(&args, &mut console),
        Command::Verify(args) => verify::verify(&args, &mut console),
        Command::Sequence(args) => sequence::sequence(&args, &mut console),
        Command::Render(args) => render::render(&args, &mut console),
        Command::ContactSheet(args) => sheets::contact_sheet(&args, &mut console),
        Command::Tune(args) => sheets::tune(&args, &mut console),
        Command::Flicker(args) => flicker::score(&args, &mut console),
        Command::Info(args) => info::info(&args, &mut console),
        Command::Watch(args) => watch::watch(&args),
        Command::Status(args) => status::status(&args, &mut console),
        Command::Completions(args) => manual::completions(&args, &mut console),
        Command::Man(args) => manual::man(&args),
    };
    let mut outcome = outcome.unwrap_or_else(|error| {
        console.hide_bar();
        console.error(wording::with_causes(&error));
        let is_of_machine = |cause: &(dyn Error + 'static)| {
            cause.downcast_ref::<io::Error>().is_some_and(is_error_of_machine)
        };
        if error.chain().any(is_of_machine) {
            CommandOutcome::MachineFailed
        } else {
            CommandOutcome::NothingDone
        }
    });
    if outcome == CommandOutcome::Done && console.failed_count() > 0 {
        console.error("frames are missing from the results, for the reasons above");
        outcome = CommandOutcome::SomeFailed;
    }
    if let Err(error) = console.finish() {
        Console::new().warn(format_args!("error: cannot write to the standard output: {error}"));
        return 2;
    }
    match outcome {
        CommandOutcome::Done => 0,
        CommandOutcome::SomeFailed => 1,
        CommandOutcome::NothingDone => 2,
        // EX_TEMPFAIL of sysexits.h.
        CommandOutcome::MachineFailed => 75,
    }
}
