//! The log: one line for each thing that happened, on the standard error.

use std::io::{self, IsTerminal};

use anyhow::{Result, anyhow};
use tracing::Level;

use crate::cli::args::LogChoice;

/// From now on, what is logged is written. Only once in a process.
///
/// # Errors
/// When there is a log already.
pub(super) fn start(choice: LogChoice) -> Result<()> {
    let log = tracing_subscriber::fmt()
        .with_max_level(Level::INFO)
        .with_target(false)
        .with_writer(io::stderr)
        .with_ansi(choice == LogChoice::Text && io::stderr().is_terminal())
        // They would be told on the standard error, which is what has just failed; and a panic follows.
        .log_internal_errors(false);
    let started = match choice {
        LogChoice::Text => log.try_init(),
        LogChoice::Json => log.json().flatten_event(true).try_init(),
    };
    started.map_err(|error| anyhow!("cannot start the log: {error}"))
}
