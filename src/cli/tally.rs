//! What became of frames that have no sequence: each is told, and all are counted.

use std::collections::HashSet;
use std::path::Path;

use crate::pipeline::{FrameReport, Outcome, gist, keeps_guarantees, shown};

use super::Verdict;
use super::console::Console;
use super::wording::{counted, failed_validation};

/// What became of the frames.
#[derive(Default)]
pub(super) struct Tally {
    /// Whether surfaces may fail validation; `None` for frames without surfaces.
    allow_violations: Option<bool>,
    done_count: usize,
    failed_count: usize,
    /// Frames that are done and break a guarantee.
    broken_count: usize,
    /// The gist of what was told of frames, and how often it was not told again.
    told: HashSet<String>,
    untold_count: usize,
}

impl Tally {
    /// The tally of frames that become surfaces.
    pub(super) fn of_surfaces(allow_violations: bool) -> Tally {
        Tally { allow_violations: Some(allow_violations), ..Tally::default() }
    }

    /// Tells what became of a frame; `described` says of one that was made how it is.
    pub(super) fn note(
        &mut self,
        input: &Path,
        outcome: &Outcome,
        described: impl Fn(&FrameReport) -> String,
        (has_bar, console): (bool, &mut Console),
    ) {
        let name = shown(input);
        match outcome {
            Outcome::Converted(report) => {
                self.done_count += 1;
                let is_broken = self.allow_violations.is_some() && !keeps_guarantees(report);
                self.broken_count += usize::from(is_broken);
                for note in &report.notes {
                    if self.told.insert(gist(note)) {
                        console.warn(format_args!("warning: {name}: {note}"));
                    } else {
                        self.untold_count += 1;
                    }
                }
                if !has_bar {
                    console.say(format_args!("{name}: {}", described(report)));
                }
            }
            Outcome::AlreadyDone { fault, .. } => {
                self.done_count += 1;
                if let Some(fault) = fault.as_ref().filter(|_| self.allow_violations.is_some()) {
                    self.broken_count += 1;
                    console.warn(format_args!("warning: {name}: {fault}"));
                }
                if !has_bar {
                    console.say(format_args!("{name}: done already"));
                }
            }
            Outcome::Changed => {
                self.failed_count += 1;
                console.warn(format_args!("error: {name}: the file was written while it was read"));
            }
            Outcome::Failed(error) => {
                self.failed_count += 1;
                console.warn(format_args!("error: {error}"));
            }
            Outcome::NotStarted => {}
        }
        console.advance_bar();
    }

    /// The summary, and the verdict.
    pub(super) fn finish(&self, frame_count: usize, seconds: f64, console: &mut Console) -> Verdict {
        let &Tally { done_count, failed_count, broken_count, untold_count, .. } = self;
        let mut summary = format!("{}: {done_count} done", counted(frame_count, "frame"));
        if failed_count > 0 {
            summary += &format!(", {failed_count} failed");
        }
        let not_started_count = frame_count - done_count - failed_count;
        if not_started_count > 0 {
            summary += &format!(", {not_started_count} not started");
        }
        console.say(format_args!("{summary}, in {seconds:.2} s"));
        if untold_count > 0 {
            let more = counted(untold_count, "more warning");
            console.warn(format_args!("{more} like those of earlier frames"));
        }
        let has_violations = self
            .allow_violations
            .is_some_and(|allow| say_violations((broken_count, frame_count), "", allow, console));
        Verdict::of(done_count, failed_count, has_violations)
    }
}

/// Says how many frames of all failed validation, and returns whether that is a failure of the command: it is unless
/// violations are allowed.
pub(super) fn say_violations(
    (broken_count, frame_count): (usize, usize),
    details: &str,
    allow_violations: bool,
    console: &Console,
) -> bool {
    if broken_count == 0 {
        return false;
    }
    let what = failed_validation(broken_count, frame_count, details);
    match allow_violations {
        true => console.warn(format_args!("warning: {what}")),
        false => console.warn(format_args!("error: {what}; --allow-violations accepts them")),
    }
    !allow_violations
}
