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

use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Error, Result, anyhow};
use clap::Args;
use toml::de::DeTable;

use super::args::{DaemonArgs, FrameArgs, option_set};
use crate::pipeline::read_regular_text;

pub(super) use block::ConfigBlock;

use block::{ConfigSource, ConfigTable};

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

#[cfg(test)]
mod tests;
