//! Prints results on the standard output, and errors and the progress of a run on the standard error.
//!
//! If the reader closes the standard output early, as `head` does, that is not an error: the command
//! continues without printing.

use std::fmt::{self, Display};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};
use meniscus_formats::{escaped, is_unsafe};
use serde::Serialize;

use crate::pipeline::{Frame, FrameReport, Observer, Stage, shown};
use crate::surface::options::{Integrator, Settings};
use crate::surface::reconstruction::MemoryPlan;

/// Both outputs, and the progress bar on the standard error.
#[derive(Debug)]
pub(super) struct Console {
    bar: Option<ProgressBar>,
    /// Whether only warnings and errors are printed: as requested, or because the standard output is closed or failed.
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
    pub(super) fn print_to_stderr_only(&mut self) {
        self.out_is_taken = true;
    }

    /// Prints only warnings and errors from now on.
    pub(super) fn be_quiet(&mut self) {
        self.muted = true;
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
        if self.muted {
            return;
        }
        if self.out_is_taken {
            return print_on_error(self.bar.as_ref(), text);
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
        if frame_count == 0 || self.muted || !io::IsTerminal::is_terminal(&io::stderr()) {
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
fn print_error(bar: Option<&ProgressBar>, line: impl Display) {
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

// Progress of a run: the stage and percentage of the oldest frame in flight, and an estimate before a frame
// that will take long or need much memory.

/// Receives the pipeline's events, and displays them.
#[derive(Debug)]
pub(super) struct ProgressDisplay {
    /// The bar for stage and percentage, if it is shown.
    bar: Option<ProgressBar>,
    /// Threads per frame.
    threads_per_frame: f64,
    state: Mutex<RunProgress>,
}

#[derive(Debug, Default)]
struct RunProgress {
    /// In order of their start.
    active: Vec<ActiveFrame>,
    /// Seconds of computing per GiB of [`work_gib`]: the maximum over the finished frames of this run.
    measured_s_per_gib: Option<f64>,
    /// The last printed estimate: similar ones are not printed again.
    announced: Option<FrameEstimate>,
}

#[derive(Debug)]
struct ActiveFrame {
    input: PathBuf,
    stage: Stage,
    /// The finished part of the stage, from 0 to 1.
    fraction: f64,
    /// The amount of computation, as by [`work_gib`].
    work_gib: f64,
}

/// The estimated cost of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct FrameEstimate {
    bytes: u64,
    seconds: f64,
}

/// An estimate is printed if it exceeds one of these values.
const ANNOUNCED_FROM: FrameEstimate = FrameEstimate { bytes: 1 << 30, seconds: 60.0 };

/// The estimate of a later frame is printed if it exceeds the last printed one by this factor.
const ANNOUNCED_AGAIN: f64 = 1.5;

const GIB: f64 = (1_u64 << 30) as f64;

/// Seconds of computing per GiB of [`work_gib`] on one thread with the default integrator: a third more than
/// for the large frames of docs/performance.md. Once the run has finished a frame, measured values replace
/// this one.
const S_PER_GIB: f64 = 25.0;

/// How many times longer a frame takes in tiles: some parts are computed twice, and data goes through files.
const TILED: f64 = 3.0;

/// The shares of a frame's time: read, rasterize, smooth, contour, write, preview.
const SHARES: [f64; 6] = [0.05, 0.3, 0.45, 0.15, 0.03, 0.02];

impl ProgressDisplay {
    /// Progress for this number of frames on this number of threads.
    pub(super) fn new(frame_count: usize, thread_count: usize, bar: Option<ProgressBar>) -> ProgressDisplay {
        let side_by_side = frame_count.clamp(1, thread_count.max(1));
        let threads_per_frame = thread_count as f64 / side_by_side as f64;
        ProgressDisplay { bar, threads_per_frame, state: Mutex::default() }
    }

    /// Records that a frame is finished, with its report if it was converted.
    pub(super) fn finished(&self, frame: &Frame, report: Option<&FrameReport>) {
        let mut state = self.lock();
        let Some(index) = state.active.iter().position(|one| one.input == frame.input) else { return };
        let ended = state.active.remove(index);
        if let Some(report) = report.filter(|_| ended.work_gib > 0.0) {
            let measured = report.seconds.computing() / ended.work_gib;
            state.measured_s_per_gib =
                Some(state.measured_s_per_gib.map_or(measured, |most| most.max(measured)));
        }
        self.show(&state);
    }

    fn show(&self, state: &RunProgress) {
        if let Some(bar) = &self.bar {
            bar.set_message(state.active.first().map_or_else(String::new, ActiveFrame::status_text));
        }
    }

    fn estimate(
        &self,
        state: &RunProgress,
        settings: &Settings,
        plan: &MemoryPlan,
        given_bytes: u64,
    ) -> FrameEstimate {
        let bytes = plan.memory_bytes.saturating_add(given_bytes);
        let per_gib = state
            .measured_s_per_gib
            .unwrap_or_else(|| S_PER_GIB * integrator_factor(settings) / self.threads_per_frame);
        FrameEstimate { bytes, seconds: work_gib(plan) * per_gib }
    }

    /// A poisoned lock is still used: a panic during an update leaves at worst a wrong number.
    fn lock(&self) -> MutexGuard<'_, RunProgress> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Observer for ProgressDisplay {
    fn planned(&self, frame: &Frame, plan: &MemoryPlan, given_bytes: u64) {
        let mut state = self.lock();
        let estimate = self.estimate(&state, &frame.settings, plan, given_bytes);
        if let Some(one) = state.find(frame) {
            one.work_gib = work_gib(plan);
        }
        if estimate.is_worth_announcing(state.announced) {
            state.announced = Some(estimate);
            drop(state);
            print_error(self.bar.as_ref(), estimate.announcement(&frame.input));
        }
    }

    fn began(&self, frame: &Frame, stage: Stage) {
        let mut state = self.lock();
        match state.find(frame) {
            Some(one) => (one.stage, one.fraction) = (stage, 0.0),
            None => {
                let input = frame.input.clone();
                state.active.push(ActiveFrame { input, stage, fraction: 0.0, work_gib: 0.0 });
            }
        }
        self.show(&state);
    }

    fn advanced(&self, frame: &Frame, _stage: Stage, fraction: f64) {
        let mut state = self.lock();
        if let Some(one) = state.find(frame) {
            one.fraction = fraction;
        }
        self.show(&state);
    }
}

impl RunProgress {
    fn find(&mut self, frame: &Frame) -> Option<&mut ActiveFrame> {
        self.active.iter_mut().find(|one| one.input == frame.input)
    }
}

impl ActiveFrame {
    fn status_text(&self) -> String {
        let before: f64 = SHARES[..self.stage as usize].iter().sum();
        let percent = 100.0 * (before + SHARES[self.stage as usize] * self.fraction);
        let name = self.input.file_name().unwrap_or_default().to_string_lossy();
        format!("{name}: {}, about {percent:.0} %", self.stage)
    }
}

impl FrameEstimate {
    fn is_worth_announcing(&self, last: Option<FrameEstimate>) -> bool {
        let is_large = |over: FrameEstimate| self.bytes > over.bytes || self.seconds > over.seconds;
        let again = last.map(|last| FrameEstimate {
            bytes: (last.bytes as f64 * ANNOUNCED_AGAIN) as u64,
            seconds: last.seconds * ANNOUNCED_AGAIN,
        });
        is_large(ANNOUNCED_FROM) && again.is_none_or(is_large)
    }

    fn announcement(&self, input: &Path) -> String {
        let time = match self.seconds {
            seconds if seconds < 60.0 => "less than a minute".to_owned(),
            seconds if seconds < 5400.0 => format!("{:.0} min", (seconds / 60.0).ceil()),
            seconds => format!("{:.1} h", seconds / 3600.0),
        };
        let memory = match self.bytes as f64 / GIB {
            gib if gib < 1.0 => format!("{:.0} MiB", (1024.0 * gib).ceil()),
            gib => format!("{gib:.1} GiB"),
        };
        format!("note: {}: will need about {memory} of memory and {time} (estimates)", shown(input))
    }
}

/// The amount of computation, measured by the memory in GiB that the [`MemoryPlan`] gives for a frame without
/// tiles, times [`TILED`] if the frame is computed in tiles.
fn work_gib(plan: &MemoryPlan) -> f64 {
    let tiled = if plan.tile_leaves.is_some() { TILED } else { 1.0 };
    plan.in_core_bytes as f64 / GIB * tiled
}

/// The approximate time of an integrator, relative to the default one.
fn integrator_factor(settings: &Settings) -> f64 {
    match settings.smoothing.integrator {
        Integrator::Fast => 1.0,
        Integrator::Implicit => 3.0,
        // An explicit step applies the operator once; the default integrator applies it some dozens of times
        // in all.
        Integrator::Explicit | Integrator::Adaptive => (f64::from(settings.smoothing.steps) / 40.0).max(1.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    use crate::pipeline::{FrameFile, OutputFormat, OutputOptions};
    use crate::surface::options::MethodOptions;

    fn frame(name: &str) -> Frame {
        let settings = Settings::paper(0.1, &MethodOptions::default()).expect("settings");
        let outputs = OutputOptions::new("out", &[OutputFormat::Glb]);
        Frame::new(&FrameFile::new(name.into()), &Arc::new(settings), &Arc::new(outputs))
    }

    fn plan(gib: u64) -> MemoryPlan {
        MemoryPlan { memory_bytes: gib << 30, tile_leaves: None, in_core_bytes: gib << 30 }
    }

    #[test]
    fn oldest_frame_is_shown_with_stage_and_percentage() {
        let bar = ProgressBar::hidden();
        let progress = ProgressDisplay::new(2, 1, Some(bar.clone()));
        let [one, two] = ["in/dam.1.ply", "in/dam.2.ply"].map(frame);
        progress.began(&one, Stage::Read);
        progress.began(&two, Stage::Read);
        progress.began(&one, Stage::Smooth);
        assert_eq!(bar.message(), "dam.1.ply: smooth, about 35 %");
        progress.advanced(&one, Stage::Smooth, 0.5);
        assert_eq!(bar.message(), "dam.1.ply: smooth, about 57 %");
        progress.finished(&one, None);
        assert_eq!(bar.message(), "dam.2.ply: read, about 0 %");
        progress.began(&two, Stage::Preview);
        assert_eq!(bar.message(), "dam.2.ply: preview, about 98 %");
        progress.finished(&two, None);
        assert_eq!(bar.message(), "");
    }

    #[test]
    fn large_frame_is_announced_once_and_a_much_larger_one_again() {
        let announced = |large: FrameEstimate, last| large.is_worth_announcing(last);
        let large = FrameEstimate { bytes: 2 << 30, seconds: 90.0 };
        let small = FrameEstimate { bytes: 1 << 29, seconds: 10.0 };
        assert!(!announced(small, None));
        assert!(announced(large, None));
        assert!(announced(FrameEstimate { seconds: 61.0, ..small }, None));
        assert!(announced(FrameEstimate { bytes: 2 << 30, ..small }, None));
        assert!(!announced(large, Some(large)));
        assert!(announced(FrameEstimate { seconds: 200.0, ..large }, Some(large)));
        assert_eq!(
            large.announcement(Path::new("dam.ply")),
            "note: dam.ply: will need about 2.0 GiB of memory and 2 min (estimates)"
        );
        let little = FrameEstimate { bytes: 30 << 20, seconds: 90.0 };
        let announcement = little.announcement(Path::new("dam.ply"));
        assert_eq!(announcement, "note: dam.ply: will need about 30 MiB of memory and 2 min (estimates)");
    }

    #[test]
    fn estimate_follows_what_this_run_measured() {
        let progress = ProgressDisplay::new(10, 2, None);
        let frame = frame("in/dam.1.ply");
        let estimate = |progress: &ProgressDisplay| {
            progress.estimate(&progress.lock(), &frame.settings, &plan(2), 0).seconds
        };
        assert_eq!(estimate(&progress), 2.0 * S_PER_GIB);
        // A single frame has all threads.
        assert_eq!(estimate(&ProgressDisplay::new(1, 2, None)), S_PER_GIB);
        progress.began(&frame, Stage::Read);
        progress.planned(&frame, &plan(1), 0);
        let mut report = FrameReport::default();
        report.seconds.smooth = 7.0;
        progress.finished(&frame, Some(&report));
        assert_eq!(estimate(&progress), 14.0);
    }
}
