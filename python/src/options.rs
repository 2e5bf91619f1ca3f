//! The options of the method by name. All of them come from the definition in the core, so a new option needs
//! no code here.

use clap::Args;
use meniscus::surface::options::{OptionName, ValueKind};
use meniscus::surface::{AttributeSelection, Length, Options, Settings};
use meniscus_formats::listed;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::errors::OptionError;

/// Names of options, and their values as text.
pub(crate) type Pairs = Vec<(String, String)>;

/// The options with these names and values.
///
/// # Errors
/// `OptionError` for an unknown name, or for text that is not a valid value of the option.
pub(crate) fn parse(pairs: &[(String, String)]) -> PyResult<Options> {
    let mut options = Options::default();
    for (name, text) in pairs {
        let Some(info) = Options::info(name) else {
            return Err(OptionError::new_err(format!("unknown option `{name}`")));
        };
        if options.set(name, text).is_none() {
            let why = why_not(name, info.kind, text);
            return Err(OptionError::new_err(format!("option `{name}`: {why}")));
        }
    }
    Ok(options)
}

/// The name of an option in messages, as a keyword argument.
pub(crate) fn keyword(option: OptionName) -> String {
    let name = if option.name == "obstacle" { "obstacles" } else { option.name };
    option.value.map_or(format!("`{name}`"), |value| format!("`{name}=\"{value}\"`"))
}

/// Why this text is not a value of the option.
fn why_not(name: &str, kind: ValueKind, text: &str) -> String {
    let choices = choices(&command(), name);
    match kind {
        _ if !choices.is_empty() => format!("`{text}` is unknown: expected one of {}", choices.join(", ")),
        ValueKind::Length => {
            text.parse::<Length>().err().unwrap_or_else(|| format!("`{text}` is not a length"))
        }
        ValueKind::Number => format!("`{text}` is not a number"),
        ValueKind::Count => format!("`{text}` is not a whole number of at least 0"),
        ValueKind::Switch => format!("`{text}` is not True or False"),
        ValueKind::Text => format!("`{text}` is not a value of this option"),
    }
}

/// The options as the command line defines them, with their help and their choices.
fn command() -> clap::Command {
    <Options as Args>::augment_args(clap::Command::new("options"))
}

/// The words that an option accepts; empty if its values are not words.
fn choices(command: &clap::Command, name: &str) -> Vec<String> {
    let is_switch = Options::info(name).is_some_and(|info| info.kind == ValueKind::Switch);
    let argument = command.get_arguments().find(|argument| argument.get_id() == name && !is_switch);
    let words = argument.map(clap::Arg::get_possible_values).unwrap_or_default();
    // Hidden words are former names.
    words.iter().filter(|word| !word.is_hide_set()).map(|word| word.get_name().to_owned()).collect()
}

/// Every option, in the order of the command line's help: `name`, `group`, `kind`, `range`, `choices` and
/// `help`.
#[pyfunction]
pub(crate) fn option_table(py: Python<'_>) -> PyResult<Vec<Bound<'_, PyDict>>> {
    let command = command();
    let mut table = Vec::new();
    for info in Options::ALL {
        let argument = command.get_arguments().find(|argument| argument.get_id() == info.name);
        let help = argument.and_then(|argument| argument.get_long_help().or(argument.get_help()));
        let kind = match info.kind {
            ValueKind::Number => "number",
            ValueKind::Count => "count",
            ValueKind::Switch => "switch",
            ValueKind::Length => "length",
            ValueKind::Text => "text",
        };
        let row = PyDict::new(py);
        row.set_item("name", info.name)?;
        row.set_item("group", info.group.heading().unwrap_or("General"))?;
        row.set_item("kind", kind)?;
        row.set_item("range", Options::range(info.name))?;
        row.set_item("choices", choices(&command, info.name))?;
        row.set_item("help", help.map(ToString::to_string).unwrap_or_default())?;
        table.push(row);
    }
    Ok(table)
}

/// The given options with values in their shortest form, in the order of `option_table`. Raises `OptionError`
/// for unknown names and invalid values.
#[pyfunction]
pub(crate) fn check_options(pairs: Pairs) -> PyResult<Vec<(&'static str, String)>> {
    Ok(parse(&pairs)?.to_pairs())
}

/// Warnings about deprecated presets and about options that have no effect; empty for invalid options.
#[pyfunction]
pub(crate) fn option_warnings(pairs: Pairs, has_obstacles: bool) -> PyResult<Vec<String>> {
    let options = parse(&pairs)?;
    if Settings::check(&options).is_err() {
        return Ok(Vec::new());
    }
    let successor = options.preset.and_then(|preset| Some((preset, preset.successor()?)));
    let deprecated = successor
        .map(|(preset, other)| format!("the preset `{preset}` is deprecated: use preset=\"{other}\""));
    let ignored = options.ineffective(has_obstacles).into_iter();
    let ignored = ignored.map(|(name, needed)| {
        let needed = listed(needed.iter().copied().map(keyword).collect(), "and");
        format!("`{name}` is ignored: it is for {needed} only")
    });
    Ok(deprecated.into_iter().chain(ignored).collect())
}

/// The attributes that the surface gets: all, or those with these names; `None` if neither is given.
pub(crate) fn selection(all: bool, names: Vec<String>) -> Option<AttributeSelection> {
    match (all, names.is_empty()) {
        (true, _) => Some(AttributeSelection::All),
        (false, true) => None,
        (false, false) => Some(AttributeSelection::Named(names)),
    }
}
