//! Suggests the intended option for an unknown one.

use std::ffi::OsString;

use clap::builder::StyledStr;
use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, Error};
use strsim::jaro;

use super::args::Cli;

/// The same error; but whoever types nearly `--output` where there is only `--out` is told of that. By their letters
/// alone others are nearer: `--ouput` is more like `--up`.
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

/// How the command is used, if it has `--out` and no `--output`.
fn usage_of_out_alone(arguments: &[OsString]) -> Option<StyledStr> {
    let mut program = Cli::command();
    program.build();
    let command = program.find_subcommand_mut(arguments.get(1)?)?;
    let has = |long| command.get_arguments().any(|option| option.get_long() == Some(long));
    (has("out") && !has("output")).then(|| command.render_usage())
}

/// Options that are less alike, of 1, have nothing to do with each other.
const NEAR: f64 = 0.8;
