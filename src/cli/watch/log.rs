//! The log on the standard error: one line for each event. People read it on a terminal, and programs read it
//! elsewhere.

use std::env;
use std::fmt;
use std::io::{self, IsTerminal};

use anyhow::{Result, anyhow};
use meniscus_formats::escaped;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::field::RecordFields;
use tracing_subscriber::fmt::format::{DefaultFields, Writer};
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::registry::LookupSpan;

use crate::cli::args::LogChoice;
use crate::cli::console::escaped_json;
use crate::cli::wording::pluralize;

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
        .with_ansi(false)
        // By default the formatter reports a failed write with `eprintln!`. Here the standard error itself
        // has failed, so `eprintln!` would panic.
        .log_internal_errors(false);
    let started = match choice {
        LogChoice::Text if io::stderr().is_terminal() => log.event_format(ShortLines::new()).try_init(),
        LogChoice::Text => log.fmt_fields(EscapedFields).try_init(),
        LogChoice::Json => log.json().flatten_event(true).map_event_format(EscapedJson).try_init(),
    };
    started.map_err(|error| anyhow!("cannot start the log: {error}"))
}

/// Events as lines for people, like those of `convert`.
struct ShortLines {
    /// The current folder with a separator at its end: paths in it are shown from there.
    folder: Option<String>,
}

impl ShortLines {
    fn new() -> ShortLines {
        let folder = env::current_dir().ok().filter(|folder| folder.parent().is_some());
        ShortLines { folder: folder.map(|folder| folder.join("").display().to_string()) }
    }

    fn line(&self, level: Level, fields: EventFields) -> String {
        let EventFields { message, about, state, numbers, others } = fields;
        let message = match &*state {
            "converted" => described(&numbers),
            "already_done" => "done already".to_owned(),
            _ => {
                let numbers = numbers.iter().map(|(name, value)| format!("{name} {value}"));
                let others = others.iter().map(|(name, value)| format!("{name} {value}"));
                let fields: Vec<String> = others.chain(numbers).collect();
                if fields.is_empty() { message } else { format!("{message} ({})", fields.join(", ")) }
            }
        };
        let level = match level {
            Level::ERROR => "error: ",
            Level::WARN => "warning: ",
            Level::INFO => "",
            _ => "debug: ",
        };
        // A long path is shown once.
        let about =
            about.filter(|about| !message.contains(&**about)).map_or(String::new(), |about| about + ": ");
        self.shortened(&format!("{level}{about}{message}"))
    }

    /// The text with paths in the current folder relative to it.
    fn shortened(&self, text: &str) -> String {
        let Some(folder) = &self.folder else { return text.to_owned() };
        let (mut shortened, mut end) = (String::new(), 0);
        for (start, _) in text.match_indices(&**folder) {
            // The same names may be in the middle of another path.
            let starts_path = text[..start].chars().next_back().is_none_or(|c| " \"'`(,".contains(c));
            if starts_path && start >= end {
                shortened += &text[end..start];
                end = start + folder.len();
            }
        }
        shortened + &text[end..]
    }
}

/// What `convert` says about a converted frame.
fn described(numbers: &[(&str, f64)]) -> String {
    let number = |name| numbers.iter().find(|(known, _)| *known == name).map(|(_, number)| *number);
    let counts = [("particles", "particle"), ("vertices", "vertex"), ("triangles", "triangle")];
    let counts = counts.into_iter().filter_map(|(name, noun)| Some(pluralize(number(name)? as usize, noun)));
    let seconds: f64 =
        numbers.iter().filter(|(name, _)| name.ends_with("_s")).map(|(_, number)| number).sum();
    counts.chain([format!("{seconds:.2} s")]).collect::<Vec<_>>().join(", ")
}

/// The fields of an event.
#[derive(Default)]
struct EventFields {
    message: String,
    /// The file or folder that it is about.
    about: Option<String>,
    state: String,
    numbers: Vec<(&'static str, f64)>,
    others: Vec<(&'static str, String)>,
}

impl EventFields {
    fn add(&mut self, field: &Field, value: String) {
        match field.name() {
            "message" => self.message = value,
            "frame" | "folder" | "sequence" | "path" => self.about = Some(value),
            "state" => self.state = value,
            name => self.others.push((name, value)),
        }
    }
}

impl Visit for EventFields {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.add(field, format!("{value:?}"));
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.add(field, value.to_owned());
    }

    fn record_f64(&mut self, field: &Field, value: f64) {
        self.numbers.push((field.name(), value));
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.record_f64(field, value as f64);
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.record_f64(field, value as f64);
    }
}

impl<S, N> FormatEvent<S, N> for ShortLines
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        _context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let mut fields = EventFields::default();
        event.record(&mut fields);
        writeln!(writer, "{}", escaped(self.line(*event.metadata().level(), fields)))
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;
    use std::sync::{Arc, Mutex};

    /// The lines of a log, in the folder `/shot`.
    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().expect("no panic").write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[track_caller]
    fn assert_logs(log: impl FnOnce(), line: &str) {
        let lines = Lines::default();
        let sink = lines.clone();
        let subscriber = tracing_subscriber::fmt()
            .with_writer(move || sink.clone())
            .event_format(ShortLines { folder: Some("/shot/".to_owned()) })
            .finish();
        tracing::subscriber::with_default(subscriber, log);
        let text = String::from_utf8(lines.0.lock().expect("no panic").clone()).expect("text");
        assert_eq!(text, format!("{line}\n"));
    }

    #[test]
    fn lines_on_a_terminal_are_short() {
        let frame = "/shot/in/dam.1.ply";
        assert_logs(
            || {
                tracing::info!(
                    frame,
                    state = "converted",
                    outputs = "[\"/shot/out/dam.1.glb\"]",
                    particles = Some(216),
                    vertices = 1,
                    triangles = 2,
                    read_s = 0.1,
                    write_s = 0.12,
                    queue = 3,
                    "converted"
                );
            },
            "in/dam.1.ply: 216 particles, 1 vertex, 2 triangles, 0.22 s",
        );
        assert_logs(
            || {
                tracing::info!(
                    frame,
                    state = "already_done",
                    outputs = "[]",
                    queue = 0,
                    "frame was done already"
                )
            },
            "in/dam.1.ply: done already",
        );
        assert_logs(
            || tracing::error!(frame, state = "failed", attempt = 4, "no end"),
            "error: in/dam.1.ply: no end (attempt 4)",
        );
        assert_logs(
            || tracing::warn!(frame, "{frame} and /shot/in/dam.1.csv would both become /mnt/shot/dam.1.*"),
            "warning: in/dam.1.ply and in/dam.1.csv would both become /mnt/shot/dam.1.*",
        );
        assert_logs(
            || tracing::info!(folder = "/shot/in", outputs = "/shot/out", "watching"),
            "in: watching (outputs out)",
        );
        assert_logs(
            || tracing::info!(done = 3, failed = 0, "ended: no frames are left to convert"),
            "ended: no frames are left to convert (done 3, failed 0)",
        );
        assert_logs(|| tracing::info!("\u{1b}[2J"), "\\u{1b}[2J");
    }
}
