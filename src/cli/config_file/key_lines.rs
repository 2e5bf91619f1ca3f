//! Finds the key of a configuration file that an error is about.
//!
//! The options of the command line and the keys of the file are checked together, by functions that know
//! neither files nor lines. So the key is found by trial: without it, the same check has no error, or another
//! one.

use std::path::{Path, PathBuf};

use anyhow::{Error, Result, anyhow};
use clap::Args;

use super::option_keys::{command, key_of};
use crate::cli::args::OptionSet;
use crate::cli::wording::{option_name, with_causes};

/// The options of a block, key by key.
#[derive(Clone, Debug)]
pub(in crate::cli) struct BlockKeys<O> {
    path: PathBuf,
    /// The line where the block starts.
    line: usize,
    /// The name and the line of each key, and what it sets; in the order of the file.
    entries: Vec<(String, usize, O)>,
}

impl<O> BlockKeys<O> {
    /// The block that starts at this line, without keys.
    pub(super) fn new(path: &Path, line: usize) -> BlockKeys<O> {
        BlockKeys { path: path.to_owned(), line, entries: Vec::new() }
    }

    /// Adds a key, which sets these options.
    pub(super) fn add(&mut self, key: &str, line: usize, options: O) {
        self.entries.push((key.to_owned(), line, options));
    }

    /// The line where the block starts.
    pub(in crate::cli) fn line(&self) -> usize {
        self.line
    }

    /// The place of a key, for messages; without such a key, that of the block.
    pub(in crate::cli) fn place(&self, key: &str) -> String {
        let path = self.path.display();
        match self.entries.iter().find(|(name, ..)| name == key) {
            Some((_, line, _)) => format!("{path}:{line}: `{key}`"),
            None => format!("{path}:{}", self.line),
        }
    }
}

impl<O: Args + OptionSet + Clone + Default> BlockKeys<O> {
    /// The options that all keys set together.
    pub(in crate::cli) fn options(&self) -> O {
        self.options_without(&[])
    }

    fn options_without(&self, left_out: &[&str]) -> O {
        let entries = self.entries.iter().filter(|(key, ..)| !left_out.contains(&&**key));
        entries.fold(O::default(), |options, (.., set)| options.over(set.clone()))
    }

    /// Adds the file and the line to an error of `check`, and speaks of keys where it names options. Returns
    /// the error unchanged if the block is not its cause, but the command line.
    ///
    /// The keys `required` are never the cause, and `check` may rely on them.
    pub(in crate::cli) fn locate<T>(
        &self,
        error: Error,
        required: &[&str],
        check: impl Fn(&O) -> Result<T>,
    ) -> Error {
        let text = with_causes(&error);
        let error_without =
            |keys: &[&str]| check(&self.options_without(keys)).err().map(|other| with_causes(&other));
        let is_cause = |other: &Option<String>| other.as_ref() != Some(&text);
        let optional = || self.entries.iter().filter(|(key, ..)| !required.contains(&&**key));
        let all: Vec<&str> = optional().map(|(key, ..)| &**key).collect();
        let path = self.path.display();
        let named = with_keys::<O>(&text);
        let is_named = |key: &str| named.contains(&format!("`{key}`"));
        let causes = optional().map(|(key, line, _)| (key, line, error_without(&[key])));
        let causes = causes.filter(|(.., other)| is_cause(other));
        // A message is about the keys that it names. Another key may only change the numbers in it.
        let cause = causes.min_by_key(|(key, _, other)| (!is_named(key), other.is_some()));
        match cause {
            Some((key, line, _)) if is_named(key) => anyhow!("{path}:{line}: {named}"),
            Some((key, line, _)) => anyhow!("{path}:{line}: `{key}`: {named}"),
            None if is_cause(&error_without(&all)) => anyhow!("{path}:{}: {named}", self.line),
            None => error,
        }
    }
}

/// A message that names these options as keys: `--token-file` becomes `token_file` in backticks.
fn with_keys<O: Args>(text: &str) -> String {
    command::<O>().get_arguments().fold(text.to_owned(), |text, option| {
        let name = option_name(option.get_id().as_str());
        let mut parts = text.split(&name);
        let mut named = parts.next().unwrap_or_default().to_owned();
        for part in parts {
            // Another name may begin with this one.
            let is_whole = !part.starts_with(|next: char| next == '-' || next.is_alphanumeric());
            let is_quoted = named.ends_with('`') && part.starts_with('`');
            named += &match (is_whole, is_quoted) {
                (false, _) => name.clone(),
                (true, true) => key_of(option),
                (true, false) => format!("`{}`", key_of(option)),
            };
            named += part;
        }
        named
    })
}
