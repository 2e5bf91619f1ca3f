//! The daemon's configuration: all numbers are resolved and checked.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::pipeline::files::json::path;
use crate::pipeline::{Job, OutputOptions, is_level_set};
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
    /// Maximum number of frames between the start of their reading and the end of their writing.
    pub in_flight: usize,
    /// Memory limit, in bytes, for all frames in progress together. A frame that exceeds the limit alone is
    /// reconstructed out of core, in tiles kept on disk; if that is impossible, it fails with a message that
    /// says how much memory it needs.
    pub memory_bytes: u64,
    /// No frame is started while the file system of its outputs has less free space than this.
    pub disk_floor_bytes: u64,
    /// How long a file must be unchanged before it is read.
    pub timeouts: StabilityTimeouts,
    /// When to poll instead of waiting for file-system events.
    pub poll: Poll,
    /// Approximate interval between full scans, which run even without events.
    pub rescan_every: Duration,
    /// The folder of the journal; `.meniscus` in the folder of the outputs by default.
    pub journal: Option<PathBuf>,
    /// How long frames in progress may take to finish after a request to stop.
    pub stop_deadline: Duration,
}

/// One watched folder, and how its frames are converted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Watch {
    /// The folder. It may not exist yet.
    #[serde(with = "path")]
    pub input: PathBuf,
    /// A glob for the path of a frame within the folder; any particle file by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pattern: Option<String>,
    /// Whether to watch sub-folders, too.
    pub recursive: bool,
    /// The name of the file that marks a frame as complete; `{name}` and `{stem}` are replaced by those of
    /// the frame. If it is given, each frame waits for its sentinel. Otherwise `{stem}.done` proves
    /// completeness if it exists, but is not required.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sentinel: Option<String>,
    /// What to write, and where.
    pub outputs: OutputOptions,
    /// The options of the method.
    #[serde(with = "by_name")]
    pub choices: MethodOptions,
    /// Absolute paths of obstacles. A path with a placeholder for the frame number, such as `body.####.obj`,
    /// means one file for each frame.
    #[serde(with = "path::list", default, skip_serializing_if = "Vec::is_empty")]
    pub obstacles: Vec<PathBuf>,
}

impl Watch {
    /// The kind of job that converts its frames.
    pub fn job(&self) -> Job {
        if names_level_sets(self.pattern.as_deref()) { Job::level_set(0.0) } else { Job::Surface }
    }

    /// Whether its frames need a particle spacing and none is given.
    pub(super) fn needs_spacing(&self) -> bool {
        self.job() == Job::Surface && self.choices.needs_spacing()
    }
}

/// Whether a pattern selects level sets: only a pattern that ends in `.vdb` does. Other patterns skip .vdb
/// files, because these may be outputs, of this daemon or of another program, which must not be converted
/// again.
pub fn names_level_sets(pattern: Option<&str>) -> bool {
    pattern.is_some_and(|pattern| is_level_set(Path::new(pattern)))
}

/// Which of the waiting frames is converted next.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Order {
    /// By name, in natural order: frame.2 before frame.10
    Natural,
    /// By modification time: the most recently written frame first
    Latest,
}

/// How long a file must be unchanged before it is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StabilityTimeouts {
    /// For a file whose format says that it is complete, or whose reader detects truncation.
    pub settle: Duration,
    /// For a file whose format cannot show whether it is complete.
    #[serde(alias = "unproven")]
    pub unverifiable: Duration,
    /// For a file whose format says that it is incomplete. The file is then read anyway, to report the error.
    pub stalled: Duration,
}

/// When to poll folders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Poll {
    /// Where the operating system sends no file-system events, as on network file systems.
    Auto,
    /// Everywhere, at this interval.
    Every(Duration),
}

/// Serializes the options of the method as a map of names to text. Text keeps numbers exact to the last bit,
/// because results depend on them.
mod by_name {
    use std::collections::BTreeMap;

    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    use crate::surface::options::MethodOptions;

    pub(super) fn serialize<S: Serializer>(options: &MethodOptions, to: S) -> Result<S::Ok, S::Error> {
        options.to_pairs().into_iter().collect::<BTreeMap<_, _>>().serialize(to)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<MethodOptions, D::Error> {
        let pairs = BTreeMap::<String, String>::deserialize(from)?;
        let mut options = MethodOptions::default();
        for (name, value) in &pairs {
            options.set(name, value).map_err(|_| {
                D::Error::custom(format!("unknown option or invalid value: {name} = {value}"))
            })?;
        }
        Ok(options)
    }
}
