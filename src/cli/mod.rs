//! The command line: what was typed becomes settings and a list of frames, and what came of them
//! becomes lines and an exit status.
//!
//! Flags end here: the layers below see [`crate::surface::options::Settings`] and frames only.

mod allocator;
mod args;
mod camera_file;
mod choices;
mod clock;
mod config_file;
mod console;
mod conversion;
mod convert;
mod destination;
mod flicker;
mod frame_selection;
mod info;
mod inputs;
mod interrupt;
mod level_sets;
mod machine;
mod manual;
mod out_folder;
mod output_records;
mod plan;
mod print_settings;
mod progress;
mod quantities;
mod remedies;
mod render;
mod render_session;
mod resolving;
mod run;
mod selecting;
mod sequence;
mod sheets;
mod standard_input;
mod status;
mod suggest;
mod vary;
mod verify;
mod watch;
mod why;
mod wording;

use std::ffi::OsString;
use std::process::ExitCode;

use clap::Parser;
use meniscus_formats::escaped;

pub use allocator::give_memory_back;

use args::{Cli, Command};
use console::Console;

/// What came of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum CommandOutcome {
    /// All that was asked for is there.
    Done,
    /// Some of it is.
    SomeFailed,
    /// None of it is.
    NothingDone,
}

impl CommandOutcome {
    /// Of frames of which so many are done and so many failed. Results that broke a guarantee are there, and yet not all is
    /// well.
    fn of(done_count: usize, failed_count: usize, has_violations: bool) -> CommandOutcome {
        match (failed_count, done_count) {
            (0, _) if !has_violations => CommandOutcome::Done,
            (1.., 0) => CommandOutcome::NothingDone,
            _ => CommandOutcome::SomeFailed,
        }
    }
}

/// How many frames, cells or files are done, and how many failed.
#[derive(Clone, Copy, Debug, Default)]
struct DoneCounts {
    done_count: usize,
    failed_count: usize,
}

impl DoneCounts {
    /// Counts one.
    fn add(&mut self, is_done: bool) {
        *if is_done { &mut self.done_count } else { &mut self.failed_count } += 1;
    }

    fn verdict(self) -> CommandOutcome {
        CommandOutcome::of(self.done_count, self.failed_count, false)
    }
}

/// Whether a configuration file with this text would be understood; nothing of it is done.
///
/// # Errors
/// What is wrong with it, and on which line.
#[doc(hidden)]
pub fn check_config(text: &str) -> anyhow::Result<()> {
    config_file::check(text)
}

/// The same error about arguments whose control characters are escaped: a shell may have put the names of
/// files among them.
fn printable(error: clap::Error, arguments: &[OsString]) -> clap::Error {
    let escaped = arguments.iter().map(|argument| escaped(argument.to_string_lossy()).to_string());
    // No error any more: it was about bytes that are not UTF-8, which its message does not repeat.
    Cli::try_parse_from(escaped).err().unwrap_or(error)
}

/// Runs the command in `arguments`, the program's name first. The exit status is 0 when all was
/// done, 1 when some of it failed, 2 when nothing was done or the command makes no sense.
pub fn run(arguments: impl IntoIterator<Item = impl Into<OsString>>) -> ExitCode {
    let arguments: Vec<OsString> = arguments.into_iter().map(Into::into).collect();
    let typed = match Cli::try_parse_from(&arguments) {
        Ok(typed) => typed,
        Err(help_or_error) => {
            let help_or_error = suggest::with_suggestion(printable(help_or_error, &arguments), &arguments);
            // A closed output is no error, and there is nobody to tell of any other.
            let _ = help_or_error.print();
            return ExitCode::from(u8::try_from(help_or_error.exit_code()).unwrap_or(2));
        }
    };
    let mut console = Console::new();
    // The daemon finishes the frames under way.
    if !matches!(typed.command, Command::Watch(_)) {
        interrupt::clean_up_when_interrupted();
    }
    let verdict = match typed.command {
        Command::Convert(args) => convert::convert(&args, &mut console),
        Command::Plan(args) => plan::plan(&args, &mut console),
        Command::Verify(args) => verify::verify(&args, &mut console),
        Command::Sequence(args) => sequence::sequence(&args, &mut console),
        Command::Render(args) => render::render(&args, &mut console),
        Command::ContactSheet(args) => sheets::contact_sheet(&args, &mut console),
        Command::Tune(args) => sheets::tune(&args, &mut console),
        Command::Flicker(args) => flicker::score(&args, &mut console),
        Command::Info(args) => info::info(&args, &mut console),
        Command::Watch(args) => watch::watch(&args),
        Command::Status(args) => status::status(&args, &mut console),
        Command::Why(args) => why::why(&args, &mut console),
        Command::Completions(args) => manual::completions(&args, &mut console),
        Command::Man(args) => manual::man(&args),
    };
    let mut verdict = verdict.unwrap_or_else(|error| {
        console.hide_bar();
        console.error(wording::with_causes(&error));
        CommandOutcome::NothingDone
    });
    if verdict == CommandOutcome::Done && console.failed_count() > 0 {
        console.error("frames are missing from the results, for the reasons above");
        verdict = CommandOutcome::SomeFailed;
    }
    if let Err(error) = console.finish() {
        Console::new().warn(format_args!("error: cannot write to the standard output: {error}"));
        return ExitCode::from(2);
    }
    match verdict {
        CommandOutcome::Done => ExitCode::SUCCESS,
        CommandOutcome::SomeFailed => ExitCode::from(1),
        CommandOutcome::NothingDone => ExitCode::from(2),
    }
}
