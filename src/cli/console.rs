//! What is printed: results on the standard output, errors and the progress bar on the standard
//! error.
//!
//! Somebody who closes the standard output early has read enough: that is no error, and work goes
//! on in silence.

use std::fmt::{self, Display};
use std::io::{self, Write};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

/// Both outputs, and the bar that may be on one of them.
#[derive(Debug)]
pub(super) struct Console {
    bar: Option<ProgressBar>,
    /// Nothing more is printed on the standard output: it is closed, or failed.
    muted: bool,
    failure: Option<io::Error>,
}

impl Console {
    pub(super) fn new() -> Console {
        Console { bar: None, muted: false, failure: None }
    }

    /// Prints a line of results.
    pub(super) fn say(&mut self, line: impl Display) {
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
        print_error(self.bar.as_ref(), line);
    }

    /// Shows a bar for so many frames, if the standard error is a terminal; of a lone frame only its stage. Returns
    /// whether the bar stands in for a line about each frame.
    pub(super) fn show_bar(&mut self, frame_count: usize) -> bool {
        if frame_count == 0 || !io::IsTerminal::is_terminal(&io::stderr()) {
            return false;
        }
        let template = if frame_count == 1 { STAGE } else { BAR };
        let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
        let style = style.with_key("rate", |state: &ProgressState, text: &mut dyn fmt::Write| {
            // Text in memory takes everything.
            let _ = write!(text, "{:.1}", state.per_sec());
        });
        let bar = ProgressBar::with_draw_target(Some(frame_count as u64), ProgressDrawTarget::stderr());
        // The time left goes on while a frame takes long.
        bar.enable_steady_tick(TICK);
        self.bar = Some(bar.with_style(style));
        frame_count > 1
    }

    /// The bar, if one is shown.
    pub(super) fn bar(&self) -> Option<ProgressBar> {
        self.bar.clone()
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

/// Prints a line on the standard error, with the bar out of the way. If that fails, there is nowhere to report it.
pub(super) fn print_error(bar: Option<&ProgressBar>, line: impl Display) {
    let _ = suspended(bar, || writeln!(io::stderr().lock(), "{line}"));
}

const BAR: &str = "{bar:32} {pos}/{len} frames, {rate} a second, {eta} left  {wide_msg}";

/// The same of a lone frame.
const STAGE: &str = "{wide_msg}";

/// The bar is drawn anew so often.
const TICK: Duration = Duration::from_millis(500);
