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

use anyhow::{Error, Result, anyhow};
use clap::error::{ContextKind, ContextValue};
use clap::{Arg, ArgAction, Args, Command};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::args::{DaemonArgs, FrameArgs, OptionSet, option_set};
use super::wording::option_name;
use crate::pipeline::read_regular_text;

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

/// The path and the text of a file.
struct ConfigSource<'a> {
    path: &'a Path,
    text: &'a str,
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

/// A value and its offset in the file.
type ConfigValue<'a> = Spanned<DeValue<'a>>;

fn parse(source: &ConfigSource<'_>) -> Result<ConfigFile> {
    let root = DeTable::parse(source.text).map_err(|error| {
        let span = error.span().unwrap_or_default();
        let mut message = error.message().replace('\n', ", ");
        if let ("duplicate key", Some(key)) = (&*message, source.text.get(span.clone())) {
            message = format!("duplicate key `{key}`: remove one");
        }
        source.error(span.start, message)
    })?;
    let mut file = ConfigFile { path: source.path.to_owned(), watches: Vec::new(), daemon: None };
    for (key, value) in root.get_ref() {
        let start = value.span().start;
        match (&**key.get_ref(), value.get_ref()) {
            ("daemon", DeValue::Table(table)) => {
                file.daemon = Some(source.options("[daemon]", start, table)?);
            }
            ("daemon", _) => return Err(source.error(start, "write one block, [daemon]")),
            ("watch", DeValue::Array(blocks)) => {
                for block in blocks {
                    let start = block.span().start;
                    let DeValue::Table(table) = block.get_ref() else {
                        return Err(source.error(start, "`watch` must contain blocks, [[watch]]"));
                    };
                    file.watches.push(source.options("[[watch]]", start, table)?);
                }
            }
            ("watch", _) => return Err(source.error(start, "write [[watch]], not [watch]")),
            (name, _) => {
                let what = format!("unknown key `{name}` outside all blocks: expected [daemon] or [[watch]]");
                return Err(source.error(key.span().start, what));
            }
        }
    }
    Ok(file)
}

impl ConfigSource<'_> {
    /// The line number, from 1, of the byte at `offset`.
    fn line(&self, offset: usize) -> usize {
        let before = &self.text.as_bytes()[..offset.min(self.text.len())];
        1 + before.iter().filter(|&&byte| byte == b'\n').count()
    }

    fn error(&self, offset: usize, what: impl Display) -> Error {
        anyhow!("{}:{}: {what}", self.path.display(), self.line(offset))
    }

    /// The options that the keys of the block at `offset` set.
    ///
    /// # Errors
    /// If a key is unknown or a value is invalid. The message is about the first such key in the file.
    fn options<O: Args + OptionSet + Default>(
        &self,
        block: &str,
        offset: usize,
        table: &DeTable<'_>,
    ) -> Result<ConfigBlock<O>> {
        let command = command::<O>();
        let mut entries: Vec<_> = table.iter().collect();
        entries.sort_by_key(|(key, _)| key.span().start);
        let mut options = O::default();
        for (key, value) in entries {
            let Some(option) = command.get_arguments().find(|option| key_of(option) == *key.get_ref()) else {
                return Err(self.error(key.span().start, unknown_key(key.get_ref(), block, &command)));
            };
            let invalid =
                |why: String| self.error(value.span().start, format_args!("`{}`{why}", key.get_ref()));
            let words = self.words(option, value).map_err(|why| invalid(format!(" {why}")))?;
            // Each key is parsed alone: the parser would report conflicts as those of options.
            let matches = command.clone().try_get_matches_from(words);
            let set = matches.and_then(|matches| O::from_arg_matches(&matches));
            options = options.over(set.map_err(|error| invalid(format!(": {}", reason(&error))))?);
        }
        let line = self.line(offset);
        Ok(ConfigBlock { options, line, place: format!("{}:{line}: {block}", self.path.display()) })
    }

    /// The command-line arguments that set an option to a value. A list sets an option that may be repeated
    /// several times, and is a text with commas for other options.
    fn words(&self, option: &Arg, value: &ConfigValue<'_>) -> Result<Vec<OsString>, String> {
        let is_path = option.get_value_parser().type_id() == TypeId::of::<PathBuf>();
        let mut texts = match value.get_ref() {
            DeValue::Array(items) if items.is_empty() && !is_path => return Err("is empty".to_owned()),
            DeValue::Array(items) => items.iter().map(text).collect::<Result<Vec<_>, _>>()?,
            _ => vec![text(value)?],
        };
        if !is_list(option) {
            texts = vec![texts.join(",")];
        }
        let words = texts.into_iter().map(|text| {
            let mut word = OsString::from(format!("{}=", option_name(option.get_id().as_str())));
            if is_path && text.is_empty() {
                return Err("is empty: expected a path".to_owned());
            }
            if is_path {
                // Relative paths are relative to the file's folder.
                word.push(self.path.parent().unwrap_or(Path::new("")).join(text));
            } else {
                word.push(text);
            }
            Ok(word)
        });
        words.collect()
    }
}

/// A value in command-line syntax.
fn text(value: &ConfigValue<'_>) -> Result<String, String> {
    match value.get_ref() {
        DeValue::String(text) => Ok(text.to_string()),
        DeValue::Boolean(switch) => Ok(switch.to_string()),
        DeValue::Float(number) => Ok(number.as_str().to_owned()),
        DeValue::Integer(number) => i128::from_str_radix(number.as_str(), number.radix())
            .map(|number| number.to_string())
            .map_err(|_| format!("contains {number}, which is too large")),
        DeValue::Array(_) => Err("contains a list in a list".to_owned()),
        DeValue::Table(_) => Err("is a block: expected a value".to_owned()),
        DeValue::Datetime(_) => Err("is a date: write text in quotes".to_owned()),
    }
}

/// Why an option does not accept a value: the message of its parser, or the list of accepted words.
fn reason(error: &clap::Error) -> String {
    match (error.source(), error.get(ContextKind::InvalidValue), error.get(ContextKind::ValidValue)) {
        (None, Some(ContextValue::String(word)), Some(ContextValue::Strings(known))) => {
            format!("`{word}` is unknown: expected one of {}", known.join(", "))
        }
        (source, ..) => source.map_or_else(|| error.to_string(), ToString::to_string),
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
