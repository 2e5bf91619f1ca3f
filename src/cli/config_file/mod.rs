//! `meniscus.toml`: the folders to watch, and the settings.
//!
//! ```text
//!   [daemon]              order, threads, memory …        at most one
//!   [[watch]]             input, output, formats, voxel_size …    any number
//! ```
//!
//! Keys are the command-line options with underscores, and the options' own parsers check the values.
//! Relative paths are relative to the file's folder, so that the file can be moved together with the folders
//! that it names. An unknown key is an error that states its line: silently ignoring a misspelt key could
//! waste a night of computation.

use std::any::TypeId;
use std::error::Error as _;
use std::ffi::OsString;
use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Error, Result, anyhow};
use clap::error::{ContextKind, ContextValue};
use clap::{Arg, ArgAction, Args, Command};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::pipeline::read_regular_text;
use crate::surface::options::{MethodOptions, ValueKind};
use crate::watch::Poll;

use super::args::{DaemonArgs, FrameArgs, OptionSet, option_set};
use super::wording::option_name;

/// The content of a file.
#[derive(Clone, Debug)]
pub(super) struct ConfigFile {
    /// Its path.
    pub(super) path: PathBuf,
    /// In the order of the file.
    pub(super) watches: Vec<ConfigBlock<WatchKeys>>,
    pub(super) daemon: Option<ConfigBlock<DaemonArgs>>,
}

/// Reads the file at `path`.
///
/// # Errors
/// If it cannot be read, or is invalid: the message has the file, the line and the valid values.
pub(super) fn read_config_file(path: &Path) -> Result<ConfigFile> {
    let text = read_regular_text(path).map_err(|error| match error.kind() {
        io::ErrorKind::InvalidData => anyhow!("{}: this is not a text file", path.display()),
        _ => Error::new(error).context(format!("cannot read {}", path.display())),
    })?;
    parse(&ConfigSource { path, text: &text })
}

/// Checks the text of a configuration file.
pub(super) fn check(text: &str) -> Result<()> {
    parse(&ConfigSource { path: Path::new("meniscus.toml"), text }).map(drop)
}

fn parse(source: &ConfigSource<'_>) -> Result<ConfigFile> {
    let root = DeTable::parse(source.text).map_err(|error| {
        let span = error.span().unwrap_or_default();
        let mut message = error.message().replace('\n', ", ");
        if let ("duplicate key", Some(key)) = (&*message, source.text.get(span.clone())) {
            message = format!("duplicate key `{key}`: remove one");
        }
        source.error(span.start, message)
    })?;
    let root = ConfigTable::root(source, root.get_ref(), &["watch", "daemon"])?;
    let watches = root.blocks("watch")?.iter().map(ConfigTable::options).collect::<Result<Vec<_>>>()?;
    let daemon = root.block("daemon")?.map(|block| block.options()).transpose()?;
    Ok(ConfigFile { path: source.path.to_owned(), watches, daemon })
}

option_set! {
    /// The keys of a `[[watch]]` block.
    #[derive(Clone, Debug, Default, Args)]
    pub(super) struct WatchKeys {
        #[arg(long)]
        pub(super) input: Option<PathBuf>,

        #[arg(long)]
        pub(super) output: Option<PathBuf>,

        #[command(flatten)]
        pub(super) frames: FrameArgs,
    }
}

// Reads a table of a TOML file key by key.
//
// The options of the command line define the keys: a key is the name of an option with underscores, and the
// option's own parser checks the value. Every error names the file, the line and the valid values.

/// The path and the text of a configuration file.
struct ConfigSource<'a> {
    path: &'a Path,
    text: &'a str,
}

impl ConfigSource<'_> {
    /// The line number, from 1, of the byte at `offset`.
    fn line(&self, offset: usize) -> usize {
        let before = &self.text.as_bytes()[..offset.min(self.text.len())];
        1 + before.iter().filter(|&&byte| byte == b'\n').count()
    }

    fn error(&self, offset: usize, what: impl Display) -> anyhow::Error {
        anyhow!("{}:{}: {what}", self.path.display(), self.line(offset))
    }
}

/// The options that a block sets.
#[derive(Clone, Debug)]
pub(super) struct ConfigBlock<O> {
    pub(super) options: O,
    /// The line where the block starts, from 1.
    pub(super) line: usize,
    /// The file, the line and the name of the block, for messages: `meniscus.toml:3: [[watch]]`.
    pub(super) place: String,
}

/// A table of the file.
struct ConfigTable<'a> {
    source: &'a ConfigSource<'a>,
    table: &'a DeTable<'a>,
    /// The offset of the block in the file, in bytes.
    start: usize,
    /// The block in messages, such as `[daemon]`.
    name: String,
}

/// A value and its offset in the file.
type ConfigValue<'a> = &'a Spanned<DeValue<'a>>;

impl<'a> ConfigTable<'a> {
    /// The whole file, with blocks of these names only.
    fn root(
        source: &'a ConfigSource<'a>,
        table: &'a DeTable<'a>,
        blocks: &[&str],
    ) -> Result<ConfigTable<'a>> {
        if let Some(key) = table.keys().find(|key| !blocks.contains(&&**key.get_ref())) {
            let what =
                format!("unknown key `{}` outside all blocks: expected [daemon] or [[watch]]", key.get_ref());
            return Err(source.error(key.span().start, what));
        }
        Ok(ConfigTable { source, table, start: 0, name: String::new() })
    }

    fn child(&self, name: String, value: ConfigValue<'a>) -> Option<ConfigTable<'a>> {
        let (source, start) = (self.source, value.span().start);
        value.get_ref().as_table().map(|table| ConfigTable { source, table, start, name })
    }

    /// The only block of this name.
    fn block(&self, name: &str) -> Result<Option<ConfigTable<'a>>> {
        let Some(value) = self.table.get(name) else { return Ok(None) };
        let block = self.child(format!("[{name}]"), value);
        block.map(Some).ok_or_else(|| self.wrong(name, &format!("one block, [{name}]"), value))
    }

    /// All blocks of this name.
    fn blocks(&self, name: &str) -> Result<Vec<ConfigTable<'a>>> {
        let wanted = format!("any number of blocks, [[{name}]]");
        let Some(value) = self.table.get(name) else { return Ok(Vec::new()) };
        if value.get_ref().is_table() {
            let what = format_args!("`{name}` is one block: write [[{name}]], not [{name}]");
            return Err(self.source.error(value.span().start, what));
        }
        let array = value.get_ref().as_array().ok_or_else(|| self.wrong(name, &wanted, value))?;
        let block = |item| self.child(format!("[[{name}]]"), item);
        array.iter().map(|item| block(item).ok_or_else(|| self.wrong(name, &wanted, item))).collect()
    }

    /// The options that the keys of the block set.
    ///
    /// # Errors
    /// If a key is unknown or a value is invalid. The message is about the first such key in the file, and
    /// states the valid values.
    fn options<O: Args + OptionSet + Default>(&self) -> Result<ConfigBlock<O>> {
        let command = command::<O>();
        let mut entries: Vec<_> = self.table.iter().collect();
        entries.sort_by_key(|(key, _)| key.span().start);
        let mut options = O::default();
        for (key, value) in entries {
            let (start, key) = (key.span().start, key.get_ref());
            let Some(option) = command.get_arguments().find(|option| key_of(option) == *key) else {
                return Err(self.source.error(start, unknown_key(key, &self.name, &command)));
            };
            let words = self.words(key, option, value)?;
            // Each key is parsed alone: the parser would report conflicts as those of options.
            let matches = command.clone().try_get_matches_from(words);
            let set = matches.and_then(|matches| O::from_arg_matches(&matches)).map_err(|error| {
                self.source.error(value.span().start, format_args!("`{key}`: {}", reason(&error, option)))
            })?;
            options = options.over(set);
        }
        let (path, line) = (self.source.path, self.source.line(self.start));
        let place = format!("{}:{line}: {}", path.display(), self.name);
        Ok(ConfigBlock { options, line, place })
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
            let text = |item| self.text(key, option, item, "contains", &wanted);
            return array.iter().map(|item| text(item).map(word)).collect();
        }
        let text = self.text(key, option, value, "is", &wanted)?;
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
        verb: &str,
        wanted: &str,
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

/// The message for a key that is unknown in a block, whose keys are these options.
fn unknown_key(key: &str, block: &str, command: &Command) -> String {
    let option = format!("--{}", key.to_lowercase().replace('_', "-"));
    let is_meant =
        |name: &str| command.get_arguments().find(|option| option_name(option.get_id().as_str()) == name);
    let similar = match command.clone().try_get_matches_from([&option]) {
        Err(error) => match error.get(ContextKind::SuggestedArg) {
            Some(ContextValue::String(similar)) => is_meant(similar),
            _ => None,
        },
        Ok(_) => None,
    };
    match is_meant(&option).or(similar) {
        Some(meant) => format!("unknown key `{key}` in {block}; did you mean `{}`?", key_of(meant)),
        None => format!("unknown key `{key}` in {block}: examples/meniscus.toml has every key, explained"),
    }
}

/// A command line with these options only.
fn command<O: Args>() -> Command {
    O::augment_args(Command::new("file").no_binary_name(true).disable_help_flag(true))
}

/// The key of an option: its name, or the plural if it takes a list.
fn key_of(option: &Arg) -> String {
    let plural = if is_list(option) { "s" } else { "" };
    format!("{}{plural}", option.get_id())
}

fn is_list(option: &Arg) -> bool {
    matches!(option.get_action(), ArgAction::Append)
}

#[cfg(test)]
mod tests;
