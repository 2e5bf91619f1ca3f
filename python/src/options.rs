//! The options of the method by name. All of them come from the definition in the core, so a new option needs
//! no code here.

use meniscus::surface::attributes::ComputedAttribute;
use meniscus::surface::options::{OptionName, ValueKind};
use meniscus::surface::{AttributeSelection, Options, Settings};
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
        if Options::info(name).is_none() {
            return Err(OptionError::new_err(format!("unknown option `{name}`")));
        }
        options.set(name, text).map_err(|why| OptionError::new_err(format!("option `{name}`: {why}")))?;
    }
    Ok(options)
}

/// The name of an option in messages, as a keyword argument.
pub(crate) fn keyword(option: OptionName) -> String {
    let name = if option.name == "obstacle" { "obstacles" } else { option.name };
    option.value.map_or(format!("`{name}`"), |value| format!("`{name}=\"{value}\"`"))
}

/// Every option, in the order of the command line's help: `name`, `group`, `kind`, `range`, `choices`, other
/// names of these, and `help`.
#[pyfunction]
pub(crate) fn option_table(py: Python<'_>) -> PyResult<Vec<Bound<'_, PyDict>>> {
    let mut table = Vec::new();
    for info in Options::ALL {
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
        row.set_item("choices", info.words.iter().map(|word| word.name).collect::<Vec<_>>())?;
        let others = info.words.iter().flat_map(|word| word.others);
        row.set_item("other_names", others.copied().collect::<Vec<_>>())?;
        row.set_item("help", info.help().join("\n\n"))?;
        table.push(row);
    }
    Ok(table)
}

/// The names of the attributes that are computed if they are asked for.
#[pyfunction]
pub(crate) fn computed_attributes() -> Vec<&'static str> {
    ComputedAttribute::ALL.into_iter().map(ComputedAttribute::name).collect()
}

/// The given options with values in their shortest form, in the order of `option_table`. Raises `OptionError`
/// for unknown names and invalid values.
#[pyfunction]
pub(crate) fn check_options(pairs: Pairs) -> PyResult<Vec<(&'static str, String)>> {
    Ok(parse(&pairs)?.to_pairs())
}

/// Resolved options as names and values in text, without those that have no effect and are not in `given`:
/// with them, a call would warn about options that its caller never chose.
pub(crate) fn effective_pairs(
    resolved: &Options,
    has_obstacles: bool,
    given: &[(String, String)],
) -> Vec<(&'static str, String)> {
    let ineffective = resolved.ineffective(has_obstacles);
    let is_kept = |name: &str| {
        given.iter().any(|(given, _)| given == name) || ineffective.iter().all(|(other, _)| *other != name)
    };
    resolved.to_pairs().into_iter().filter(|(name, _)| is_kept(name)).collect()
}

/// Warnings about options that have no effect; empty for invalid options.
#[pyfunction]
pub(crate) fn option_warnings(pairs: Pairs, has_obstacles: bool) -> PyResult<Vec<String>> {
    let options = parse(&pairs)?;
    if Settings::check(&options).is_err() {
        return Ok(Vec::new());
    }
    let ignored = options.ineffective(has_obstacles).into_iter().map(|(name, needed)| {
        let needed = listed(needed.iter().copied().map(keyword).collect(), "and");
        format!("`{name}` is ignored: it is for {needed} only")
    });
    Ok(ignored.collect())
}

/// The attributes that the surface gets: all, or those with these names; `None` if neither is given.
pub(crate) fn selection(all: bool, names: Vec<String>) -> Option<AttributeSelection> {
    match (all, names.is_empty()) {
        (true, _) => Some(AttributeSelection::All),
        (false, true) => None,
        (false, false) => Some(AttributeSelection::Named(names)),
    }
}
