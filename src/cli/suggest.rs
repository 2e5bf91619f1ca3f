//! Suggests the intended option for an unknown one.

use std::ffi::OsString;

use clap::builder::StyledStr;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Command, CommandFactory, Error};
use meniscus_formats::listed;
use strsim::jaro;

use super::args::Cli;

/// Returns the error with a useful suggestion, or none:
/// - If other commands have the option, they are named.
/// - If the argument resembles `--output` and the command only has `--out`, that is suggested: clap's own
///   measure of similarity prefers other options, such as `--up` for `--ouput`.
/// - Options that hardly resemble the argument are not suggested. Neither is passing it as a value: names of
///   files hardly start with a hyphen.
pub(super) fn with_suggestion(mut error: Error, arguments: &[OsString]) -> Error {
    if error.kind() != ErrorKind::UnknownArgument {
        return error;
    }
    let Some(ContextValue::String(typed)) = error.get(ContextKind::InvalidArg) else { return error };
    let typed = typed.clone();
    let mut program = Cli::command();
    program.build();
    let Some(command) = arguments.get(1).and_then(|name| program.find_subcommand(name)) else { return error };
    let is_out_alone = has_option(command, "out") && !has_option(command, "output");
    let usage = command.clone().render_usage();
    let owners = typed.strip_prefix("--").map(|name| commands_with(&program, name)).unwrap_or_default();
    error.remove(ContextKind::Suggested);
    let is_out_meant = is_out_alone && typed == "--output";
    if !(owners.is_empty() || is_out_meant) {
        error.remove(ContextKind::SuggestedArg);
        error.insert(ContextKind::Usage, ContextValue::StyledStr(usage));
        let tip = StyledStr::from(format!("{typed} is an option of {}", listed(owners, "and")));
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip]));
        return error;
    }
    let nearness = |option: &str| jaro(&typed, option);
    let found = match error.get(ContextKind::SuggestedArg) {
        Some(ContextValue::String(suggested)) => nearness(suggested),
        _ => 0.0,
    };
    if is_out_alone && nearness("--output") > found.max(NEAR) {
        error.insert(ContextKind::SuggestedArg, ContextValue::String("--out".to_owned()));
        error.insert(ContextKind::Usage, ContextValue::StyledStr(usage));
    } else if found < NEAR {
        error.remove(ContextKind::SuggestedArg);
        // The usage would contain the option.
        error.insert(ContextKind::Usage, ContextValue::StyledStr(usage));
    }
    error
}

/// The names of the commands with this long option.
fn commands_with(program: &Command, option: &str) -> Vec<String> {
    let commands = program.get_subcommands().filter(|command| has_option(command, option));
    commands.map(|command| command.get_name().to_owned()).collect()
}

/// Whether a command has a long option with this name, or with this alias.
fn has_option(command: &Command, name: &str) -> bool {
    command.get_arguments().any(|option| {
        let is_alias = || option.get_all_aliases().is_some_and(|aliases| aliases.contains(&name));
        option.get_long() == Some(name) || is_alias()
    })
}

/// The minimum similarity for a suggestion; 1 means equal.
const NEAR: f64 = 0.8;
