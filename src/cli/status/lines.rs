//! The status as text.

use super::{DaemonStatus, FrameStatus, SpacingStatus, StatusCounts, StatusRecord};
use crate::cli::wording::{ago, pluralize, significant};

/// Maximum number of entries printed per list; `--json` has all.
const LISTED_MAX: usize = 20;

impl StatusRecord {
    /// The status as lines of text; `now_ms` is in milliseconds since 1970.
    pub(super) fn lines(&self, now_ms: u64) -> Vec<String> {
        let daemon = match &self.daemon {
            Some(daemon) => daemon.text(now_ms),
            None => "no daemon is known".to_owned(),
        };
        let StatusCounts { done, queued, retrying, failed, waiting: _ } = self.counts;
        let mut lines = vec![
            format!("{}: {daemon}", self.output),
            format!("{done} done, {queued} queued, {retrying} to retry, {failed} failed"),
        ];
        lines.extend(self.spacings.iter().map(SpacingStatus::text));
        let lists = [
            ("not yet complete", &self.waiting),
            ("failed", &self.failed),
            ("to retry", &self.retrying),
            ("done last", &self.last_done),
            ("done, but failed validation or left out particles", &self.flawed),
        ];
        for (title, frames) in lists.into_iter().filter(|(_, frames)| !frames.is_empty()) {
            lines.push(format!("{title}:"));
            lines.extend(frames.iter().take(LISTED_MAX).map(|frame| format!("  {}", frame.text(now_ms))));
            lines.extend(more(frames.len()));
        }
        lines
    }
}

/// A line with the number of entries that are not printed.
fn more(count: usize) -> Option<String> {
    let more = count.checked_sub(LISTED_MAX).filter(|&more| more > 0)?;
    Some(format!("  and {more} more: --json has them all"))
}

impl SpacingStatus {
    fn text(&self) -> String {
        let SpacingStatus { sequence, spacing, measured_on } = self;
        let spacing = significant(*spacing);
        // A run that starts when more frames exist may measure another.
        let advice = match measured_on {
            1 => format!("; --spacing {spacing} makes every run alike"),
            _ => String::new(),
        };
        let frames = pluralize(*measured_on, "frame");
        format!("{sequence}: particle spacing {spacing}, measured on {frames}{advice}")
    }
}

impl DaemonStatus {
    pub(super) fn is_running(&self) -> bool {
        !["stopped", "killed"].contains(&self.state)
    }

    pub(super) fn text(&self, now_ms: u64) -> String {
        let since =
            |at_ms: Option<u64>| at_ms.map_or_else(String::new, |at| format!(", {}", ago(at, now_ms)));
        let who = match (&self.held_by, self.pid, &self.host) {
            (Some(by), _, _) => by.clone(),
            (None, Some(pid), Some(host)) => format!("pid {pid} on {host}"),
            _ => "unknown process".to_owned(),
        };
        match (self.state, &self.paused_because) {
            ("paused", Some(why)) => format!("paused{}: {why} ({who})", since(self.at_ms)),
            ("stopped", _) => format!("the daemon has ended{} ({who})", since(self.at_ms)),
            ("killed", _) => format!("the daemon was killed, or its machine went down ({who})"),
            (state, _) if self.running.is_none() => {
                format!("{state}, according to the records: the file system has no locks ({who})")
            }
            (state, _) => format!("{state} ({who})"),
        }
    }
}

impl FrameStatus {
    pub(super) fn text(&self, now_ms: u64) -> String {
        let mut about = Vec::new();
        about.extend(self.particles.map(|count| pluralize(count, "particle")));
        about.extend(self.seconds.map(|seconds| format!("{} s", significant(seconds))));
        if self.attempts > 1 {
            about.push(format!("{} attempts", self.attempts));
        }
        about.extend(self.next_try.map(|when| format!("next try {when}")));
        about.push(ago(self.at_ms, now_ms));
        let input = &self.input;
        match &self.reason {
            // Most reasons start with the name of their file.
            Some(reason) if reason.contains(input) => format!("{reason} ({})", about.join(", ")),
            Some(reason) => format!("{input}: {reason} ({})", about.join(", ")),
            None => [&[format!("{input}: {}", about.join(", "))], &*self.flaws].concat().join("; "),
        }
    }
}
