//! A table of a TOML file, read key by key.
//!
//! Every error names the file and the line, and says what would be right.

use std::fmt::Display;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Result, anyhow};
use clap::ValueEnum;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::keys_of;

/// The file.
pub(super) struct Source<'a> {
    pub(super) path: &'a Path,
    pub(super) text: &'a str,
}

impl Source<'_> {
    /// The line, from 1, of the byte at `offset`.
    pub(super) fn line(&self, offset: usize) -> usize {
        let before = &self.text.as_bytes()[..offset.min(self.text.len())];
        1 + before.iter().filter(|&&byte| byte == b'\n').count()
    }

    pub(super) fn error(&self, offset: usize, what: impl Display) -> anyhow::Error {
        anyhow!("{}:{}: {what}", self.path.display(), self.line(offset))
    }
}

/// A table whose keys are all known.
pub(super) struct Block<'a> {
    source: &'a Source<'a>,
    table: &'a DeTable<'a>,
    /// Where it begins in the file.
    pub(super) start: usize,
}

impl<'a> Block<'a> {
    /// The block called `name`, which begins at `start`.
    ///
    /// # Errors
    /// The first key in it that is unknown, and the nearest one that is known.
    pub(super) fn new(
        source: &'a Source<'a>,
        name: &str,
        table: &'a DeTable<'a>,
        start: usize,
    ) -> Result<Block<'a>> {
        let known = keys_of(name);
        let unknown = table.keys().filter(|key| !known.contains(&&**key.get_ref()));
        match unknown.min_by_key(|key| key.span().start) {
            Some(key) => Err(source.error(key.span().start, unknown_key(key.get_ref(), name))),
            None => Ok(Block { source, table, start }),
        }
    }

    /// What is wrong with the block as a whole.
    pub(super) fn error(&self, what: impl Display) -> anyhow::Error {
        self.source.error(self.start, what)
    }

    /// The only block of this name.
    pub(super) fn block(&self, name: &str) -> Result<Option<Block<'a>>> {
        self.get(name, &format!("one block, [{name}]"), |value| value.as_table())?
            .map(|(table, start)| Block::new(self.source, name, table, start))
            .transpose()
    }

    /// All blocks of this name.
    pub(super) fn blocks(&self, name: &str) -> Result<Vec<Block<'a>>> {
        let wanted = format!("any number of blocks, [[{name}]]");
        let Some((array, start)) = self.get(name, &wanted, DeValue::as_array)? else {
            return Ok(Vec::new());
        };
        let block = |value: &'a Spanned<DeValue<'a>>| match value.get_ref().as_table() {
            Some(table) => Block::new(self.source, name, table, value.span().start),
            None => Err(self.wrong(name, &wanted, value.get_ref(), start)),
        };
        array.iter().map(block).collect()
    }

    /// A number, with a decimal point or without.
    pub(super) fn number(&self, key: &str) -> Result<Option<f64>> {
        let number = |value: &DeValue<'_>| match value {
            DeValue::Float(float) => float.as_str().parse().ok(),
            DeValue::Integer(_) => integer(value).map(|integer| integer as f64),
            _ => None,
        };
        Ok(self.get(key, "a number", number)?.map(|(number, _)| number))
    }

    /// A number within the limits of an option.
    pub(super) fn number_as(&self, key: &str, parse: fn(&str) -> Result<f64, String>) -> Result<Option<f64>> {
        let number = |value: &DeValue<'_>| match value {
            DeValue::Float(float) => Some(float.as_str().to_owned()),
            DeValue::Integer(_) => integer(value).map(|integer| integer.to_string()),
            _ => None,
        };
        let found = self.get(key, "a number", number)?;
        found.map(|(text, start)| self.understood(key, parse(&text), start)).transpose()
    }

    /// A whole number in a range.
    pub(super) fn count<T>(&self, key: &str, range: RangeInclusive<T>) -> Result<Option<T>>
    where
        T: TryFrom<i128> + PartialOrd + Display,
    {
        let wanted = format!("a whole number from {} to {}", range.start(), range.end());
        let count = |value: &DeValue<'_>| {
            integer(value).and_then(|count| T::try_from(count).ok()).filter(|count| range.contains(count))
        };
        Ok(self.get(key, &wanted, count)?.map(|(count, _)| count))
    }

    /// True or false; false where it is not there.
    pub(super) fn switch(&self, key: &str) -> Result<bool> {
        Ok(self.get(key, "true or false", DeValue::as_bool)?.is_some_and(|(switch, _)| switch))
    }

    pub(super) fn text(&self, key: &str) -> Result<Option<String>> {
        Ok(self.string(key, "text in quotes")?.map(|(text, _)| text.to_owned()))
    }

    /// A path, from the file's folder if it is relative.
    pub(super) fn path(&self, key: &str) -> Result<Option<PathBuf>> {
        let Some((text, start)) = self.string(key, "a path in quotes")? else { return Ok(None) };
        self.path_of(key, text, start).map(Some)
    }

    /// Paths, from the file's folder where they are relative; none where the key is not there.
    pub(super) fn paths(&self, key: &str) -> Result<Vec<PathBuf>> {
        let wanted = "a list of paths in brackets, each in quotes";
        let Some((array, _)) = self.get(key, wanted, DeValue::as_array)? else { return Ok(Vec::new()) };
        let path = |value: &'a Spanned<DeValue<'a>>| match value.get_ref().as_str() {
            Some(text) => self.path_of(key, text, value.span().start),
            None => Err(self.wrong(key, wanted, value.get_ref(), value.span().start)),
        };
        array.iter().map(path).collect()
    }

    fn path_of(&self, key: &str, text: &str, start: usize) -> Result<PathBuf> {
        if text.is_empty() {
            return Err(self.source.error(start, format_args!("`{key}` is empty: it wants a path")));
        }
        Ok(self.source.path.parent().unwrap_or(Path::new("")).join(text))
    }

    /// What `parse` makes of text.
    pub(super) fn parsed<T>(&self, key: &str, parse: fn(&str) -> Result<T, String>) -> Result<Option<T>> {
        self.string(key, "text in quotes, with a unit")?
            .map(|(text, start)| self.understood(key, parse(text), start))
            .transpose()
    }

    /// What is written as on the command line.
    pub(super) fn as_typed<T: FromStr<Err = String>>(&self, key: &str) -> Result<Option<T>> {
        self.string(key, "text in quotes")?
            .map(|(text, start)| self.understood(key, text.parse(), start))
            .transpose()
    }

    /// A size as text, or as a number of bytes.
    pub(super) fn size(&self, key: &str, parse: fn(&str) -> Result<u64, String>) -> Result<Option<u64>> {
        match self.table.get(key).map(Spanned::get_ref) {
            Some(DeValue::Integer(_)) => self.count(key, 0..=u64::MAX),
            _ => self.parsed(key, parse),
        }
    }

    /// One of several words.
    pub(super) fn choice<T: ValueEnum>(&self, key: &str) -> Result<Option<T>> {
        self.string(key, &one_of::<T>())?.map(|(text, start)| self.chosen(key, text, start)).transpose()
    }

    /// A list of one word or more.
    pub(super) fn choices<T: ValueEnum>(&self, key: &str) -> Result<Option<Vec<T>>> {
        let wanted = format!("a list in brackets, each {}", one_of::<T>());
        let Some((array, start)) = self.get(key, &wanted, DeValue::as_array)? else { return Ok(None) };
        if array.is_empty() {
            return Err(self.source.error(start, format_args!("`{key}` is empty: it wants {wanted}")));
        }
        let chosen = array.iter().map(|value| match value.get_ref().as_str() {
            Some(text) => self.chosen(key, text, value.span().start),
            None => Err(self.wrong(key, &wanted, value.get_ref(), value.span().start)),
        });
        chosen.collect::<Result<Vec<T>>>().map(Some)
    }

    fn chosen<T: ValueEnum>(&self, key: &str, text: &str, start: usize) -> Result<T> {
        let chosen =
            T::from_str(text, true).map_err(|_| format!("`{text}` is not known: it wants {}", one_of::<T>()));
        self.understood(key, chosen, start)
    }

    fn understood<T>(&self, key: &str, parsed: Result<T, String>, start: usize) -> Result<T> {
        parsed.map_err(|why| self.source.error(start, format_args!("`{key}`: {why}")))
    }

    fn string(&self, key: &str, wanted: &str) -> Result<Option<(&'a str, usize)>> {
        self.get(key, wanted, |value| value.as_str())
    }

    /// The value of a key, as `read` has it, and where it stands.
    fn get<T>(
        &self,
        key: &str,
        wanted: &str,
        read: impl FnOnce(&'a DeValue<'a>) -> Option<T>,
    ) -> Result<Option<(T, usize)>> {
        let Some(value) = self.table.get(key) else { return Ok(None) };
        let start = value.span().start;
        match read(value.get_ref()) {
            Some(read) => Ok(Some((read, start))),
            None => Err(self.wrong(key, wanted, value.get_ref(), start)),
        }
    }

    fn wrong(&self, key: &str, wanted: &str, value: &DeValue<'_>, start: usize) -> anyhow::Error {
        let is = match value {
            DeValue::Integer(integer) => integer.to_string(),
            DeValue::Float(float) => float.to_string(),
            DeValue::Boolean(boolean) => boolean.to_string(),
            DeValue::String(_) => "text".to_owned(),
            DeValue::Array(_) => "a list".to_owned(),
            DeValue::Table(_) => "one block".to_owned(),
            DeValue::Datetime(_) => "a date".to_owned(),
        };
        self.source.error(start, format_args!("`{key}` is {is}: it wants {wanted}"))
    }
}

/// Integers of any base.
fn integer(value: &DeValue<'_>) -> Option<i128> {
    let integer = value.as_integer()?;
    i128::from_str_radix(integer.as_str(), integer.radix()).ok()
}

fn one_of<T: ValueEnum>() -> String {
    let names = T::value_variants().iter().filter_map(ValueEnum::to_possible_value);
    let names: Vec<String> = names.map(|value| format!("\"{}\"", value.get_name())).collect();
    format!("one of {}", names.join(", "))
}

/// What to say of a key that no block of this name has.
fn unknown_key(key: &str, block: &str) -> String {
    let known = keys_of(block);
    let place = |name| match name {
        "watch" => "a [[watch]] block",
        "daemon" => "the [daemon] block",
        _ => "the file, outside all blocks",
    };
    let elsewhere = ["watch", "daemon"].into_iter().find(|&other| keys_of(other).contains(&key));
    if let Some(other) = elsewhere {
        return format!("`{key}` does not belong in {}, but in {}", place(block), place(other));
    }
    match nearest(key, known) {
        Some(nearest) => format!("unknown key `{key}` in {}; did you mean `{nearest}`?", place(block)),
        None => format!("unknown key `{key}` in {}; it knows {}", place(block), known.join(", ")),
    }
}

/// The known key that somebody most likely meant, if there is one that is like it.
fn nearest(key: &str, known: &[&'static str]) -> Option<&'static str> {
    let key = key.to_lowercase().replace('-', "_");
    let likeness = |known: &str| strsim::jaro_winkler(&key, known);
    let nearest = known.iter().copied().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
    (likeness(nearest) >= LIKENESS_MIN).then_some(nearest)
}

/// Below this a guess is more confusing than helpful; 1 is the same word.
const LIKENESS_MIN: f64 = 0.75;
