//! `meniscus status FRAME`: prints what is recorded of one frame.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

use crate::cli::CommandOutcome;
use crate::cli::console::Console;
use crate::cli::wording::{ago, pluralize, significant};
use crate::pipeline::{
    LatestRecords, RecordedFrame, UnfinishedState, canonical_path, file_of, natural_order, now_ms, step_of,
};

use super::{FrameStatus, Holder};

/// Prints the record of a frame in each of these output folders that has one.
///
/// # Errors
/// If nothing is recorded of it, or something cannot be read.
pub(super) fn print(
    frame: &Path,
    folders: &[PathBuf],
    as_json: bool,
    console: &mut Console,
) -> Result<CommandOutcome> {
    let path = known_path(frame);
    let (mut is_found, mut has_failed) = (false, false);
    for folder in folders {
        let state = super::recorded(folder, console)?;
        if let Some((first, last)) = steps_of(&state, &path) {
            bail!("{}: it has several frames: give one of them, from {first} to {last}", frame.display());
        }
        let Some((input, record)) = find_frame(&state, &path) else { continue };
        let may_have_daemon = !matches!(Holder::of(folder)?, Holder::Unlocked);
        let absolute = dunce::canonicalize(folder).unwrap_or_else(|_| folder.clone());
        let status = FrameStatus::new(input, record, &absolute, may_have_daemon);
        if as_json {
            console.print_json(&status)?;
        } else {
            console.print_lines(status.details(now_ms(), file_of(input).exists()));
            if !may_have_daemon && status.is_to_come() {
                console.print_line(format_args!("no daemon is running for {}: start one", folder.display()));
            }
        }
        is_found = true;
        has_failed |= status.has_failed();
    }
    if !is_found {
        bail!(
            "{}: nothing is recorded of it: a frame must be in a watched folder, must not be hidden, and must \
             match --pattern (by default: be a particle file)",
            frame.display()
        );
    }
    Ok(if has_failed { CommandOutcome::SomeFailed } else { CommandOutcome::Done })
}

/// The path by which the daemon identifies a frame.
fn known_path(frame: &Path) -> PathBuf {
    let file = canonical_path(file_of(frame));
    match (step_of(frame), frame.file_name()) {
        (Some(_), Some(step)) => file.join(step),
        _ => file,
    }
}

/// The record of a frame. The watched folder may be a link: then the recorded path is another one.
fn find_frame<'a>(state: &'a LatestRecords, path: &Path) -> Option<(&'a Path, &'a RecordedFrame)> {
    let is_meant =
        |input: &Path| input == path || input.file_name() == path.file_name() && known_path(input) == path;
    let exact = state.frames.get_key_value(path);
    let found = exact.or_else(|| state.frames.iter().find(|(input, _)| is_meant(input)));
    found.map(|(input, record)| (&**input, record))
}

/// The first and the last of the frames that are recorded of this file, if it is one with steps.
fn steps_of(state: &LatestRecords, file: &Path) -> Option<(String, String)> {
    let steps = state.frames.keys().filter(|input| input.parent() == Some(file));
    let mut steps: Vec<String> = steps.map(|input| input.display().to_string()).collect();
    steps.sort_by(|a, b| natural_order(a, b));
    Some((steps.first()?.clone(), steps.last()?.clone()))
}

impl FrameStatus {
    fn has_failed(&self) -> bool {
        self.state.is_some_and(UnfinishedState::is_failure)
    }

    /// Whether a daemon will convert, or try to convert, the frame without further changes.
    fn is_to_come(&self) -> bool {
        self.state.is_some_and(|state| !state.is_failure() && state != UnfinishedState::Ignored)
    }

    /// Everything that is recorded, as lines of text; `now_ms` is in milliseconds since 1970.
    fn details(&self, now_ms: u64, file_exists: bool) -> Vec<String> {
        let mut lines = vec![self.input.clone()];
        let mut line = |name: &str, text: &str| lines.push(format!("  {name:<9} {text}"));
        let state = self.state.map_or_else(|| "done".to_owned(), |state| state.to_string());
        line("state", &format!("{state}, {}", ago(self.at_ms, now_ms)));
        if let Some(reason) = &self.reason {
            line("reason", reason);
        }
        if let Some(when) = self.next_try {
            line("next try", when);
        }
        if !file_exists {
            line("file", "it no longer exists");
        }
        if self.attempts > 1 {
            line("attempts", &self.attempts.to_string());
        }
        if let Some(count) = self.particles {
            line("input", &pluralize(count, "particle"));
        }
        if let Some(seconds) = self.seconds {
            line("time", &format!("{} s", significant(seconds)));
        }
        self.flaws.iter().for_each(|flaw| line("flaw", flaw));
        self.outputs.iter().for_each(|output| line("output", output));
        if !self.settings.is_empty() {
            line("settings", &self.settings);
        }
        lines
    }
}
