//! Prints results on the standard output, and errors and the progress bar on the standard error.
//!
//! If the reader closes the standard output early, as `head` does, that is not an error: the command
//! continues without printing.

use std::fmt::{self, Display};
use std::io::{self, Write};
use std::time::Duration;

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};
use meniscus_formats::{escaped, is_unsafe};
use serde::Serialize;

/// Both outputs, and the progress bar on the standard error.
#[derive(Debug)]
pub(super) struct Console {
    bar: Option<ProgressBar>,
    /// Whether the standard output is closed or failed, so that nothing more is printed there.
    muted: bool,
    failure: Option<io::Error>,
    failed_count: usize,
    left_out_count: usize,
    /// Whether the standard output is reserved for a file.
    out_is_taken: bool,
}

impl Console {
    pub(super) fn new() -> Console {
        Console {
            bar: None,
            muted: false,
            failure: None,
            failed_count: 0,
            left_out_count: 0,
            out_is_taken: false,
        }
    }

    /// Sends all lines to the standard error from now on, because a file is written to the standard output.
    pub(super) fn leave_out_to_a_file(&mut self) {
        self.out_is_taken = true;
    }

    /// Prints a line of results. Control characters are [`escaped`]: they could forge a line or control the
    /// terminal.
    pub(super) fn print_line(&mut self, line: impl Display) {
        self.print(escaped(line));
    }

    /// Prints several lines of results, each escaped.
    pub(super) fn print_lines(&mut self, lines: impl IntoIterator<Item = impl Display>) {
        lines.into_iter().for_each(|line| self.print_line(line));
    }

    /// Prints a record as JSON, which has its own escapes.
    pub(super) fn print_json(&mut self, record: &impl Serialize) -> serde_json::Result<()> {
        self.print(json_text(record)?);
        Ok(())
    }

    /// Prints text that meniscus generates, such as a script or [`json_text`], without escapes.
    pub(super) fn print_raw(&mut self, text: &str) {
        self.print(text.trim_end());
    }

    fn print(&mut self, text: impl Display) {
        if self.out_is_taken {
            return print_on_error(self.bar.as_ref(), text);
        }
        if self.muted {
            return;
        }
        let print = || {
            let mut out = io::stdout().lock();
            writeln!(out, "{text}").and_then(|()| out.flush())
        };
        if let Err(error) = suspended(self.bar.as_ref(), print) {
            self.muted = true;
            self.failure = Some(error).filter(|error| error.kind() != io::ErrorKind::BrokenPipe);
        }
    }

    /// Prints an error or a warning on one line. Control characters are [`escaped`]: they could forge a line
    /// or control the terminal.
    pub(super) fn warn(&self, line: impl Display) {
        print_error(self.bar.as_ref(), line);
    }

    /// Prints a warning.
    pub(super) fn warning(&self, what: impl Display) {
        self.warn(format_args!("warning: {what}"));
    }

    /// Prints an error.
    pub(super) fn error(&self, what: impl Display) {
        self.warn(format_args!("error: {what}"));
    }

    /// Prints an error about a missing part of the input. The command then fails even if all frames succeed.
    pub(super) fn fail(&mut self, what: impl Display) {
        self.error(what);
        self.failed_count += 1;
    }

    /// Like [`fail`](Console::fail), for an error about this number of frames, which are left out.
    pub(super) fn leave_out(&mut self, count: usize, what: impl Display) {
        self.fail(what);
        self.left_out_count += count;
    }

    /// The number of frames that are left out.
    pub(super) fn left_out_count(&self) -> usize {
        self.left_out_count
    }

    /// The number of errors that [`fail`](Console::fail) printed.
    pub(super) fn failed_count(&self) -> usize {
        self.failed_count
    }

    /// Shows a progress bar for this number of frames if the standard error is a terminal; for a single
    /// frame, only its stage. Returns true if the bar replaces the line that is otherwise printed for each
    /// frame.
    pub(super) fn show_bar(&mut self, frame_count: usize) -> bool {
        if frame_count == 0 || !io::IsTerminal::is_terminal(&io::stderr()) {
            return false;
        }
        let template = if frame_count == 1 { STAGE } else { BAR };
        let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
        let style = style.with_key("pace", |state: &ProgressState, text: &mut dyn fmt::Write| {
            // Before the first frame is done, there is no pace to show.
            if state.pos() > 0 {
                let left = HumanDuration(state.eta());
                // Writing into a string cannot fail.
                let _ = write!(text, ", {:.1} a second, {left:#} left", state.per_sec());
            }
        });
        let bar = ProgressBar::with_draw_target(Some(frame_count as u64), ProgressDrawTarget::stderr());
        // Without ticks, the time left would stand still while a long frame is computed.
        bar.enable_steady_tick(TICK);
        self.bar = Some(bar.with_style(style));
        frame_count > 1
    }

    /// The progress bar, if it is shown.
    pub(super) fn bar(&self) -> Option<ProgressBar> {
        self.bar.clone()
    }

    /// Advances the bar by one frame.
    pub(super) fn advance_bar(&self) {
        if let Some(bar) = &self.bar {
            bar.inc(1);
        }
    }

    pub(super) fn hide_bar(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }

    /// Returns the error if writing to the standard output failed. A reader that closes the output is not an
    /// error.
    pub(super) fn finish(self) -> io::Result<()> {
        self.failure.map_or(Ok(()), Err)
    }
}

/// A record as JSON, without characters that could control the terminal.
pub(super) fn json_text(record: &impl Serialize) -> serde_json::Result<String> {
    Ok(escaped_json(&serde_json::to_string_pretty(record)?))
}

/// Escapes the characters of JSON text that could control the terminal, and that Serde does not escape.
pub(super) fn escaped_json(json: &str) -> String {
    let mut text = String::with_capacity(json.len());
    for char in json.chars() {
        match char {
            _ if char != '\n' && is_unsafe(char) => text += &format!("\\u{:04x}", u32::from(char)),
            _ => text.push(char),
        }
    }
    text
}

/// Prints while the bar is hidden.
fn suspended<T>(bar: Option<&ProgressBar>, print: impl FnOnce() -> T) -> T {
    match bar {
        Some(bar) => bar.suspend(print),
        None => print(),
    }
}

/// Prints an error or a warning on one line. Control characters are [`escaped`]: they could forge a line or
/// control the terminal.
pub(super) fn print_error(bar: Option<&ProgressBar>, line: impl Display) {
    print_on_error(bar, escaped(line));
}

/// Prints text on the standard error while the bar is hidden. A failure cannot be reported anywhere.
fn print_on_error(bar: Option<&ProgressBar>, text: impl Display) {
    let _ = suspended(bar, || writeln!(io::stderr().lock(), "{text}"));
}

const BAR: &str = "{bar:20} {pos}/{len} frames{pace}  {wide_msg}";

/// The template for a single frame.
const STAGE: &str = "{wide_msg}";

/// The redraw interval of the bar.
const TICK: Duration = Duration::from_millis(500);
