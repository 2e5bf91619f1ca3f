//! Reads a table of a TOML file key by key.
//!
//! The options of the command line define the keys: a key is the name of an option with underscores, and the
//! option's own parser checks the value. Every error names the file, the line and the valid values.

use std::any::TypeId;
use std::error::Error as _;
use std::ffi::OsString;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Result, anyhow};
use clap::error::{ContextKind, ContextValue};
use clap::{Arg, ArgAction, Args, CommandFactory as _};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::key_lines::BlockKeys;
use super::option_keys::{command, has_former_key, is_list, key_of};
use super::{current_key, keys_of};
use crate::cli::args::Cli;
use crate::cli::wording::option_name;
use crate::surface::options::{MethodOptions, ValueKind};
use crate::watch::Poll;

/// The path and the text of a configuration file.
pub(super) struct ConfigSource<'a> {
    pub(super) path: &'a Path,
    pub(super) text: &'a str,
}

impl ConfigSource<'_> {
    /// The line number, from 1, of the byte at `offset`.
    pub(super) fn line(&self, offset: usize) -> usize {
        let before = &self.text.as_bytes()[..offset.min(self.text.len())];
        1 + before.iter().filter(|&&byte| byte == b'\n').count()
    }

    pub(super) fn error(&self, offset: usize, what: impl Display) -> anyhow::Error {
        anyhow!("{}:{}: {what}", self.path.display(), self.line(offset))
    }
}

/// A table whose keys are all known.
pub(super) struct ConfigTable<'a> {
    source: &'a ConfigSource<'a>,
    table: &'a DeTable<'a>,
    /// The offset of the block in the file, in bytes.
    pub(super) start: usize,
    /// The keys that have their former names: their offsets in the file, and a message.
    deprecated: Vec<(usize, String)>,
}

/// A value and its offset in the file.
type ConfigValue<'a> = &'a Spanned<DeValue<'a>>;

impl<'a> ConfigTable<'a> {
    /// The block called `name`, which starts at `start`.
    ///
    /// # Errors
    /// If a key is unknown, or is given under its current and under its former name. The message names the
    /// first such key; for an unknown one, also the most similar known one.
    pub(super) fn new(
        source: &'a ConfigSource<'a>,
        name: &str,
        table: &'a DeTable<'a>,
        start: usize,
    ) -> Result<ConfigTable<'a>> {
        let known = keys_of(name);
        let unknown = table.keys().filter(|key| known.iter().all(|known| known != key.get_ref()));
        let mut deprecated = Vec::new();
        let mut faults = Vec::new();
        for key in unknown {
            let (offset, key) = (key.span().start, key.get_ref());
            match current_key(name, key) {
                None => faults.push((offset, unknown_key(key, name))),
                Some(current) if table.contains_key(&*current) => {
                    faults.push((offset, format!("`{key}` is the former name of `{current}`: remove it")));
                }
                Some(current) => deprecated.push((offset, format!("`{key}` is deprecated: use `{current}`"))),
            }
        }
        match faults.into_iter().min_by_key(|(offset, _)| *offset) {
            Some((offset, fault)) => Err(source.error(offset, fault)),
            None => Ok(ConfigTable { source, table, start, deprecated }),
        }
    }

    /// A warning for each key that has its former name.
    pub(super) fn warnings(&self) -> impl Iterator<Item = String> {
        self.deprecated.iter().map(|(offset, what)| self.source.error(*offset, what).to_string())
    }

    /// An error about the block as a whole.
    pub(super) fn error(&self, what: impl Display) -> anyhow::Error {
        self.source.error(self.start, what)
    }

    /// The only block of this name.
    pub(super) fn block(&self, name: &str) -> Result<Option<ConfigTable<'a>>> {
        let Some(value) = self.table.get(name) else { return Ok(None) };
        match value.get_ref().as_table() {
            Some(table) => ConfigTable::new(self.source, name, table, value.span().start).map(Some),
            None => Err(self.wrong(name, &format!("one block, [{name}]"), value)),
        }
    }

    /// All blocks of this name.
    pub(super) fn blocks(&self, name: &str) -> Result<Vec<ConfigTable<'a>>> {
        let wanted = format!("any number of blocks, [[{name}]]");
        let Some(value) = self.table.get(name) else { return Ok(Vec::new()) };
        if value.get_ref().is_table() {
            let what = format_args!("`{name}` is one block: write [[{name}]], not [{name}]");
            return Err(self.source.error(value.span().start, what));
        }
        let array = value.get_ref().as_array().ok_or_else(|| self.wrong(name, &wanted, value))?;
        let block = |item: ConfigValue<'a>| match item.get_ref().as_table() {
            Some(table) => ConfigTable::new(self.source, name, table, item.span().start),
            None => Err(self.wrong(name, &wanted, item)),
        };
        array.iter().map(block).collect()
    }

    /// The options that each key of the block sets.
    ///
    /// # Errors
    /// If a value is invalid. The message is about the first invalid value in the file, and states the valid
    /// ones.
    pub(super) fn keys<O: Args>(&self) -> Result<BlockKeys<O>> {
        let command = command::<O>();
        let parsed = |words: &[OsString]| {
            let matches = command.clone().try_get_matches_from(words);
            matches.and_then(|matches| O::from_arg_matches(&matches))
        };
        let mut entries: Vec<_> = self.table.iter().collect();
        entries.sort_by_key(|(key, _)| key.span().start);
        let mut keys = BlockKeys::new(self.source.path, self.source.line(self.start));
        for (key, value) in entries {
            let key = key.get_ref();
            let is_meant = |option: &&Arg| key_of(option) == *key || has_former_key(option, key);
            let Some(option) = command.get_arguments().find(is_meant) else { continue };
            // Each key is parsed alone: the parser rejects two options that set the same quantity, such as
            // --spacing and --particle-radius, but a file may have both keys.
            let set = parsed(&self.words(key, option, value)?).map_err(|error| {
                self.source.error(value.span().start, format_args!("`{key}`: {}", reason(&error, option)))
            })?;
            keys.add(&key_of(option), self.source.line(value.span().start), set);
        }
        Ok(keys)
    }

    /// The command-line arguments that set an option to a value.
    fn words(&self, key: &str, option: &Arg, value: ConfigValue<'a>) -> Result<Vec<OsString>> {
        let name = option_name(option.get_id().as_str());
        let word = |text: OsString| {
            let mut word = OsString::from(format!("{name}="));
            word.push(text);
            word
        };
        let wanted = wanted(option);
        if is_list(option) {
            let list = format!("a list in brackets, in which each item is {wanted}");
            let array = value.get_ref().as_array().ok_or_else(|| self.wrong(key, &list, value))?;
            if array.is_empty() && !is_path(option) {
                let what = format_args!("`{key}` is empty: expected {list}");
                return Err(self.source.error(value.span().start, what));
            }
            let text = |item| self.text(key, option, item, ("contains", &wanted));
            return array.iter().map(|item| text(item).map(word)).collect();
        }
        let text = self.text(key, option, value, ("is", &wanted))?;
        Ok(match option.get_action() {
            ArgAction::SetTrue if text == "true" => vec![name.into()],
            ArgAction::SetTrue => Vec::new(),
            _ => vec![word(text)],
        })
    }

    /// A value in command-line syntax. `verb` says what the key does with it: is, contains.
    fn text(
        &self,
        key: &str,
        option: &Arg,
        value: ConfigValue<'a>,
        (verb, wanted): (&str, &str),
    ) -> Result<OsString> {
        if let (true, DeValue::Array(items)) = (takes_commas(option), value.get_ref()) {
            if items.is_empty() {
                let what = format_args!("`{key}` is empty: expected {wanted}");
                return Err(self.source.error(value.span().start, what));
            }
            let text = |item: ConfigValue<'a>| match item.get_ref() {
                DeValue::String(text) => Ok(text.to_string()),
                value => number_text(value)
                    .ok_or_else(|| self.unexpected(key, "contains", "numbers, or text in quotes", item)),
            };
            return Ok(items.iter().map(text).collect::<Result<Vec<_>>>()?.join(",").into());
        }
        let kind = kind_of(option);
        let is_switch = kind == Some(ValueKind::Switch);
        let is_length = kind == Some(ValueKind::Length);
        let is_number = is_length || matches!(kind, Some(ValueKind::Number | ValueKind::Count));
        let text = match value.get_ref() {
            DeValue::Boolean(switch) if is_switch => Some(switch.to_string()),
            value @ DeValue::Float(_) if is_number => number_text(value),
            value @ DeValue::Integer(_) if is_number || is::<u64>(option) => number_text(value),
            DeValue::String(text) if is_length || !is_number && !is_switch => Some(text.to_string()),
            _ => None,
        };
        let text = text.ok_or_else(|| self.unexpected(key, verb, wanted, value))?;
        if !is_path(option) {
            return Ok(text.into());
        }
        if text.is_empty() {
            let what = format_args!("`{key}` is empty: expected a path");
            return Err(self.source.error(value.span().start, what));
        }
        // Relative paths are relative to the file's folder.
        Ok(self.source.path.parent().unwrap_or(Path::new("")).join(text).into_os_string())
    }

    fn wrong(&self, key: &str, wanted: &str, value: ConfigValue<'_>) -> anyhow::Error {
        self.unexpected(key, "is", wanted, value)
    }

    fn unexpected(&self, key: &str, verb: &str, wanted: &str, value: ConfigValue<'_>) -> anyhow::Error {
        let found = match value.get_ref() {
            DeValue::Integer(integer) => integer.to_string(),
            DeValue::Float(float) => float.to_string(),
            DeValue::Boolean(boolean) => boolean.to_string(),
            DeValue::String(_) => "text".to_owned(),
            DeValue::Array(_) => "a list".to_owned(),
            DeValue::Table(_) => "one block".to_owned(),
            DeValue::Datetime(_) => "a date".to_owned(),
        };
        self.source.error(value.span().start, format_args!("`{key}` {verb} {found}: expected {wanted}"))
    }
}

/// A number as the command line takes it; `None` for other values.
fn number_text(value: &DeValue<'_>) -> Option<String> {
    match value {
        DeValue::Float(number) => Some(number.as_str().to_owned()),
        DeValue::Integer(number) => {
            i128::from_str_radix(number.as_str(), number.radix()).ok().map(|number| number.to_string())
        }
        _ => None,
    }
}

/// Whether the text of an option may be a list with commas, for which the file may have a list.
fn takes_commas(option: &Arg) -> bool {
    let names = option.get_value_names().unwrap_or_default();
    !is_list(option) && names.iter().any(|name| ["BOX", "LIST", "SPEC"].contains(&name.as_str()))
}

fn is_path(option: &Arg) -> bool {
    is::<PathBuf>(option)
}

/// Whether the values of an option have this type.
fn is<T: 'static>(option: &Arg) -> bool {
    option.get_value_parser().type_id() == TypeId::of::<T>()
}

/// The kind of the values of an option: that of the method's options by their description, and that of
/// others by their type; `None` for paths, durations and sizes.
fn kind_of(option: &Arg) -> Option<ValueKind> {
    if let Some(info) = MethodOptions::info(option.get_id().as_str()) {
        return Some(info.kind);
    }
    match () {
        () if is::<bool>(option) => Some(ValueKind::Switch),
        () if is::<f64>(option) => Some(ValueKind::Number),
        () if is::<u32>(option) || is::<u16>(option) => Some(ValueKind::Count),
        () => None,
    }
}

/// The kind of value that an option needs in the file, as text for messages.
fn wanted(option: &Arg) -> String {
    let words = option.get_possible_values();
    let words: Vec<String> = words.iter().map(|word| format!("\"{}\"", word.get_name())).collect();
    let wanted = match kind_of(option) {
        Some(ValueKind::Switch) => "true or false",
        _ if !words.is_empty() => return format!("one of {}", words.join(", ")),
        Some(ValueKind::Length) => "a number in world units, or text in quotes with a unit, such as \"0.6d\"",
        Some(ValueKind::Number) => "a number",
        Some(ValueKind::Count) => "a whole number",
        _ if is::<u64>(option) => "bytes, or text in quotes, with a unit, such as \"8GiB\"",
        _ if is::<Duration>(option) || is::<Poll>(option) => "text in quotes, with a unit, such as \"2s\"",
        _ if is_path(option) => "a path in quotes",
        _ if takes_commas(option) => "text in quotes, or a list in brackets",
        _ => "text in quotes",
    };
    wanted.to_owned()
}

/// Why an option does not accept a value: the message of its parser, or the list of accepted words.
fn reason(error: &clap::Error, option: &Arg) -> String {
    match (error.source(), error.get(ContextKind::InvalidValue)) {
        (Some(source), _) => source.to_string(),
        (None, Some(ContextValue::String(word))) => {
            format!("`{word}` is not known: expected {}", wanted(option))
        }
        (None, _) => error.to_string(),
    }
}

/// The message for a key that is unknown in this block.
fn unknown_key(key: &str, block: &str) -> String {
    let known = keys_of(block);
    let location = |name| match name {
        "watch" => "a [[watch]] block",
        "daemon" => "the [daemon] block",
        _ => "the file, outside all blocks",
    };
    let has_key = |other: &&str| keys_of(other).iter().any(|known| known == key);
    if let Some(other) = ["watch", "daemon"].into_iter().find(has_key) {
        return format!("`{key}` does not belong in {}, but in {}", location(block), location(other));
    }
    let location = location(block);
    if let Some(nearest) = nearest(key, &known) {
        return format!("unknown key `{key}` in {location}; did you mean `{nearest}`?");
    }
    let convert = Cli::command().find_subcommand("convert").cloned().unwrap_or_default();
    let is_meant = |option: &&Arg| option.get_id() == key || has_former_key(option, key);
    match convert.get_arguments().find(is_meant) {
        Some(option) if option.get_id() == "max_deviation" => format!(
            "unknown key `{key}` in {location}: the daemon does not smooth level sets; `meniscus convert \
             --max-deviation` does"
        ),
        Some(option) => format!(
            "unknown key `{key}` in {location}: {} is an option of `meniscus convert`, and not of the daemon",
            option_name(option.get_id().as_str())
        ),
        None if known.len() <= LISTED_MAX => {
            format!("unknown key `{key}` in {location}; it knows {}", known.join(", "))
        }
        None => format!("unknown key `{key}` in {location}: examples/meniscus.toml has every key, explained"),
    }
}

/// Maximum number of known keys in a message: more would hide the cause.
const LISTED_MAX: usize = 20;

/// The most similar known key, if one is similar enough.
fn nearest<'k>(key: &str, known: &'k [String]) -> Option<&'k str> {
    let key = key.to_lowercase().replace('-', "_");
    let likeness = |known: &str| strsim::jaro_winkler(&key, known);
    let nearest = known.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
    (likeness(nearest) >= LIKENESS_MIN).then_some(nearest)
}

/// The minimum similarity of a suggestion, from 0 to 1 (equal): a less similar one would confuse.
const LIKENESS_MIN: f64 = 0.75;
