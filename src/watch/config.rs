//! The daemon's configuration: all numbers are resolved and checked.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::selection::FileFilter;
use crate::pipeline::{Job, OutputOptions, SniffedContent, content, is_level_set, is_named_list};
use crate::surface::options::MethodOptions;

/// The configuration of one run of the daemon.
#[derive(Clone, Debug)]
pub struct WatchConfig {
    /// The folders to watch.
    pub watches: Vec<Watch>,
    /// Convert the existing frames, then exit.
    pub once: bool,
    /// Which of the waiting frames is converted next.
    pub order: Order,
    /// Number of compute threads.
    pub threads: usize,
    /// Memory limit, in bytes, for all frames in progress together. A frame that exceeds the limit alone is
    /// reconstructed out of core, in tiles kept on disk; if that is impossible, it fails with a message that
    /// says how much memory it needs.
    pub memory_bytes: u64,
    /// No frame is started while the file system of its outputs has less free space than this.
    pub disk_floor_bytes: u64,
    /// How long a file must be unchanged before it is read.
    pub settle: Duration,
    /// How long a frame waits for those around it with which it is averaged.
    pub temporal_wait: Duration,
    /// When to poll instead of waiting for file-system events.
    pub poll: Poll,
}

/// One watched folder, and how its frames are converted.
#[derive(Clone, Debug, PartialEq)]
pub struct Watch {
    /// The folder. It may not exist yet.
    pub input: PathBuf,
    /// A glob for the names of frames, or for their paths within the folder (see
    /// [`FileFilter::new`](super::selection::FileFilter::new)); any particle file by default.
    pub pattern: Option<String>,
    /// Whether the frames are level sets, and not particles: see [`names_level_sets`].
    pub has_level_sets: bool,
    /// The name of the file that marks a frame as complete; `{name}` and `{stem}` are replaced by those of
    /// the frame. If it is given, each frame waits for its sentinel. Otherwise `{stem}.done` proves
    /// completeness if it exists, but is not required.
    pub sentinel: Option<String>,
    /// What to write, and where.
    pub outputs: OutputOptions,
    /// The options of the method.
    pub choices: MethodOptions,
    /// Absolute paths of obstacles. A path with a placeholder for the frame number, such as `body.####.obj`,
    /// means one file for each frame.
    pub obstacles: Vec<PathBuf>,
}

impl Watch {
    /// The kind of job that converts its frames.
    pub fn job(&self) -> Job {
        if self.has_level_sets { Job::level_set(0.0) } else { Job::Surface }
    }

    /// Whether particles must be measured before its frames are converted.
    pub(super) fn needs_measuring(&self) -> bool {
        self.job() == Job::Surface && self.choices.needs_measuring()
    }
}

/// Whether the frames of a folder are level sets: only a pattern that ends in `.vdb` selects them, unless the first
/// frame that matches it has points. Otherwise they are skipped, because they may be outputs, of this daemon or of
/// another program, which must not be converted again. `output` is the folder of the results.
pub fn names_level_sets(folder: &Path, pattern: Option<&str>, output: &Path) -> bool {
    let Some(pattern) = pattern.filter(|pattern| is_level_set(Path::new(pattern))) else { return false };
    let Ok(filter) = FileFilter::new(Some(pattern), vec![output.to_owned()]) else { return false };
    let is_frame = |path: &PathBuf| {
        filter.takes(folder, path) && !content(path).is_ok_and(|found| found == SniffedContent::OwnOutput)
    };
    let all = format!("{}/{pattern}", glob::Pattern::escape(&folder.to_string_lossy()));
    let first = glob::glob(&all).into_iter().flatten().flatten().find(is_frame);
    first.is_none_or(|first| is_level_set(&first))
}

/// Whether a pattern selects lists of files, such as `.pvd`: by its extension. Other patterns skip a list if each file
/// that it names is a frame beside it.
pub(super) fn names_lists(pattern: Option<&str>) -> bool {
    pattern.is_some_and(|pattern| is_named_list(Path::new(pattern)))
}

/// Which of the waiting frames is converted next.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Order {
    /// By name, in natural order: frame.2 before frame.10
    Natural,
    /// By modification time: the most recently written frame first
    Latest,
}

/// How long a file must be unchanged before it is read. All follow from one option.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StabilityTimeouts {
    /// For a file whose format says that it is complete, or whose reader detects truncation.
    pub(crate) settle: Duration,
    /// For a file whose format cannot show whether it is complete.
    pub(crate) unverifiable: Duration,
    /// For a file whose format says that it is incomplete. The file is then read anyway, to report the error.
    pub(crate) stalled: Duration,
}

/// The shortest wait for the rest of an incomplete file, and for a program that has a file open to close it.
pub(super) const STALLED_MIN: Duration = Duration::from_secs(30);

impl StabilityTimeouts {
    pub(super) fn new(settle: Duration, once: bool) -> StabilityTimeouts {
        let unverifiable = settle.saturating_mul(4);
        // With `once` the daemon gives up incomplete files earlier, because their writers may be gone.
        let stalled = if once { unverifiable } else { STALLED_MIN.max(unverifiable) };
        StabilityTimeouts { settle, unverifiable, stalled }
    }
}

/// When to poll folders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Poll {
    /// Where the operating system sends no file-system events, as on network file systems.
    Auto,
    /// Everywhere, at this interval.
    Every(Duration),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timeouts_follow_settle() {
        for (settle, once, expected) in [
            (500, false, [500, 2000, 30_000]),
            (20_000, false, [20_000, 80_000, 80_000]),
            (500, true, [500, 2000, 2000]),
            (0, false, [0, 0, 30_000]),
        ] {
            let StabilityTimeouts { settle, unverifiable, stalled } =
                StabilityTimeouts::new(Duration::from_millis(settle), once);
            assert_eq!([settle, unverifiable, stalled].map(|time| time.as_millis()), expected);
        }
    }
}
