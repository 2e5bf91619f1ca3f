//! What is printed: results on the standard output, errors and the progress bar on the standard
//! error.
//!
//! Somebody who closes the standard output early has read enough: that is no error, and work goes
//! on in silence.

use std::fmt::{self, Display};
use std::io::{self, Write};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

/// Both outputs, and the bar that may be on one of them.
#[derive(Debug)]
pub(super) struct Console {
    bar: Option<ProgressBar>,
    /// Nothing more is printed on the standard output: it is closed, or failed.
    muted: bool,
    failure: Option<io::Error>,
    failed_count: usize,
    /// The standard output is for a file.
    out_is_taken: bool,
}

impl Console {
    pub(super) fn new() -> Console {
        Console { bar: None, muted: false, failure: None, failed_count: 0, out_is_taken: false }
    }

    /// From now on, all lines go to the standard error: a file is written to the standard output.
    pub(super) fn leave_out_to_a_file(&mut self) {
        self.out_is_taken = true;
    }

    /// Prints a line of results.
    pub(super) fn say(&mut self, line: impl Display) {
        if self.out_is_taken {
            return self.warn(line);
        }
        if self.muted {
            return;
        }
        let print = || {
            let mut out = io::stdout().lock();
            writeln!(out, "{line}").and_then(|()| out.flush())
        };
        if let Err(error) = suspended(self.bar.as_ref(), print) {
            self.muted = true;
            self.failure = Some(error).filter(|error| error.kind() != io::ErrorKind::BrokenPipe);
        }
    }

    /// Prints an error or a warning.
    pub(super) fn warn(&self, line: impl Display) {
        // There is nobody left to tell that this failed.
        let _ = suspended(self.bar.as_ref(), || writeln!(io::stderr().lock(), "{line}"));
    }

    /// Prints an error that makes the command fail, whatever else succeeds: part of the input is left out.
    pub(super) fn fail(&mut self, line: impl Display) {
        self.warn(line);
        self.failed_count += 1;
    }

    /// How many such errors there were.
    pub(super) fn failed_count(&self) -> usize {
        self.failed_count
    }

    /// Shows a bar for so many frames, if somebody watches. Whether it does.
    pub(super) fn show_bar(&mut self, frame_count: usize) -> bool {
        if frame_count < 2 || !io::IsTerminal::is_terminal(&io::stderr()) {
            return false;
        }
        let style = ProgressStyle::with_template(BAR).unwrap_or_else(|_| ProgressStyle::default_bar());
        let style = style.with_key("rate", |state: &ProgressState, text: &mut dyn fmt::Write| {
            // Text in memory takes everything.
            let _ = write!(text, "{:.1}", state.per_sec());
        });
        let bar = ProgressBar::with_draw_target(Some(frame_count as u64), ProgressDrawTarget::stderr());
        self.bar = Some(bar.with_style(style));
        true
    }

    /// One frame more is done.
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

    /// Whether all that was said was heard, or not wanted.
    pub(super) fn finish(self) -> io::Result<()> {
        self.failure.map_or(Ok(()), Err)
    }
}

/// Prints with the bar out of the way.
fn suspended<T>(bar: Option<&ProgressBar>, print: impl FnOnce() -> T) -> T {
    match bar {
        Some(bar) => bar.suspend(print),
        None => print(),
    }
}

const BAR: &str = "{bar:32} {pos}/{len} frames, {rate} a second, {eta} left";
