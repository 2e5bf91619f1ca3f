//! The log on the standard error: one line for each event.

use std::env;
use std::fmt;
use std::io::{self, IsTerminal};

use anyhow::{Result, anyhow};
use meniscus_formats::escaped;
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::field::RecordFields;
use tracing_subscriber::fmt::format::{DefaultFields, Writer};
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::registry::LookupSpan;

use crate::cli::args::LogChoice;
use crate::cli::console::escaped_json;

/// The environment variable that sets the least severe level to log: `error`, `warn`, `info` or `debug`.
const LEVEL_VARIABLE: &str = "MENISCUS_LOG";

/// Starts logging. Call it once per process.
///
/// # Errors
/// If logging has started already, or the level in the environment is unknown.
pub(super) fn start(choice: LogChoice) -> Result<()> {
    let level = match env::var(LEVEL_VARIABLE) {
        Ok(text) => text.parse().map_err(|_| {
            anyhow!("{LEVEL_VARIABLE} is `{text}`: expected `error`, `warn`, `info` or `debug`")
        })?,
        Err(_) => Level::INFO,
    };
    let log = tracing_subscriber::fmt()
        .with_max_level(level)
        .with_target(false)
        .with_writer(io::stderr)
        .with_ansi(choice == LogChoice::Text && io::stderr().is_terminal())
        // By default the formatter reports a failed write with `eprintln!`. Here the standard error itself
        // has failed, so `eprintln!` would panic.
        .log_internal_errors(false);
    let started = match choice {
        LogChoice::Text => log.fmt_fields(EscapedFields).try_init(),
        LogChoice::Json => log.json().flatten_event(true).map_event_format(EscapedJson).try_init(),
    };
    started.map_err(|error| anyhow!("cannot start the log: {error}"))
}

/// The fields of an event as text, the message first. Values may come from files and file names, so
/// everything that could forge a line or control the terminal is escaped.
struct EscapedFields;

impl<'writer> FormatFields<'writer> for EscapedFields {
    fn format_fields<R: RecordFields>(&self, mut writer: Writer<'writer>, fields: R) -> fmt::Result {
        let mut text = String::new();
        DefaultFields::new().format_fields(Writer::new(&mut text), fields)?;
        write!(writer, "{}", escaped(text))
    }
}

/// Events as JSON, without characters that could control the terminal.
struct EscapedJson<F>(F);

impl<S, N, F> FormatEvent<S, N> for EscapedJson<F>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
    F: FormatEvent<S, N>,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let mut text = String::new();
        self.0.format_event(context, Writer::new(&mut text), event)?;
        writer.write_str(&escaped_json(&text))
    }
}
