//! Suggests the intended option for an unknown one.

use std::ffi::OsString;

use clap::builder::StyledStr;
use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, Error};
use strsim::jaro;

use super::args::Cli;

/// Returns the error. If the argument resembles `--output` and the command only has `--out`, the error
/// suggests `--out`: clap's own measure of similarity prefers other options, such as `--up` for `--ouput`.
pub(super) fn with_suggestion(mut error: Error, arguments: &[OsString]) -> Error {
    let Some(ContextValue::String(typed)) = error.get(ContextKind::InvalidArg) else { return error };
    let nearness = |option: &str| jaro(typed, option);
    let found = match error.get(ContextKind::SuggestedArg) {
        Some(ContextValue::String(suggested)) => nearness(suggested),
        _ => NEAR,
    };
    if nearness("--output") > found
        && let Some(usage) = usage_of_out_alone(arguments)
    {
        error.insert(ContextKind::SuggestedArg, ContextValue::String("--out".to_owned()));
        error.insert(ContextKind::Usage, ContextValue::StyledStr(usage));
    }
    error
}

/// The usage of the command, if it has `--out` and no `--output`.
fn usage_of_out_alone(arguments: &[OsString]) -> Option<StyledStr> {
    let mut program = Cli::command();
    program.build();
    let command = program.find_subcommand_mut(arguments.get(1)?)?;
    let has = |long| command.get_arguments().any(|option| option.get_long() == Some(long));
    (has("out") && !has("output")).then(|| command.render_usage())
}

/// The minimum similarity for a suggestion; 1 means equal.
const NEAR: f64 = 0.8;
