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

mod block;
mod key_lines;
mod option_keys;

use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Error, Result, anyhow};
use clap::Args;
use toml::de::DeTable;

use super::args::{DaemonArgs, FrameArgs, option_set};
use crate::pipeline::read_regular_text;

pub(super) use key_lines::BlockKeys;

use block::{ConfigSource, ConfigTable};
use option_keys::{keys, renamed};

/// The content of a file.
#[derive(Clone, Debug)]
pub(super) struct ConfigFile {
    /// Its path.
    pub(super) path: PathBuf,
    /// In the order of the file.
    pub(super) watches: Vec<WatchBlock>,
    pub(super) daemon: BlockKeys<DaemonArgs>,
    /// Warnings about keys with former names.
    pub(super) warnings: Vec<String>,
}

/// A `[[watch]]` block.
#[derive(Clone, Debug)]
pub(super) struct WatchBlock {
    pub(super) keys: BlockKeys<WatchKeys>,
    pub(super) input: PathBuf,
    pub(super) output: Option<PathBuf>,
    pub(super) frames: FrameArgs,
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
    let root = ConfigTable::new(source, "", root.get_ref(), 0)?;
    let blocks = root.blocks("watch")?;
    let watches: Result<Vec<WatchBlock>> = blocks.iter().map(watch_block).collect();
    let daemon_block = root.block("daemon")?;
    let no_block = || Ok(BlockKeys::new(source.path, 1));
    let daemon = daemon_block.as_ref().map_or_else(no_block, ConfigTable::keys);
    let warnings = blocks.iter().chain(&daemon_block).flat_map(ConfigTable::warnings).collect();
    Ok(ConfigFile { path: source.path.to_owned(), watches: watches?, daemon: daemon?, warnings })
}

fn watch_block(block: &ConfigTable<'_>) -> Result<WatchBlock> {
    let keys: BlockKeys<WatchKeys> = block.keys()?;
    let WatchKeys { input, output, frames } = keys.options();
    let input = input.ok_or_else(|| block.error("this [[watch]] block names no input"))?;
    Ok(WatchBlock { keys, input, output, frames })
}

option_set! {
    /// The keys of a `[[watch]]` block.
    #[derive(Clone, Debug, Default, Args)]
    pub(super) struct WatchKeys {
        #[arg(long)]
        input: Option<PathBuf>,

        #[arg(long)]
        output: Option<PathBuf>,

        #[command(flatten)]
        pub(super) frames: FrameArgs,
    }
}

/// The keys that a block may have. An empty name means the top level of the file.
fn keys_of(block: &str) -> Vec<String> {
    match block {
        "watch" => keys::<WatchKeys>(),
        "daemon" => keys::<DaemonArgs>(),
        _ => ["watch", "daemon"].map(str::to_owned).to_vec(),
    }
}

/// The current name of a key of a block that was renamed.
fn current_key(block: &str, former: &str) -> Option<String> {
    match block {
        "watch" => renamed::<WatchKeys>(former),
        "daemon" => renamed::<DaemonArgs>(former),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
