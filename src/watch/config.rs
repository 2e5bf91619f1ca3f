//! What the daemon is to do: every number resolved and checked.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::pipeline::files::json::path;
use crate::pipeline::{Job, OutputOptions, is_level_set};
use crate::surface::options::MethodOptions;

/// All that one run of the daemon goes by.
#[derive(Clone, Debug)]
pub struct WatchConfig {
    /// The folders to watch.
    pub watches: Vec<Watch>,
    /// Convert what is there, and end.
    pub once: bool,
    /// Which of several waiting frames is next.
    pub order: Order,
    /// Threads to compute on.
    pub threads: usize,
    /// Frames between their reading and their last byte written, at most.
    pub in_flight: usize,
    /// Bytes that the frames under way may take together. A frame that needs more by itself is skinned in
    /// tiles that wait on disk; one that cannot be fails, and says what it needs.
    pub memory_bytes: u64,
    /// No frame is begun while the file system of its outputs has less room than this.
    pub disk_floor_bytes: u64,
    /// How long a file must be left alone before it is read.
    pub patience: Patience,
    /// When to look by oneself instead of waiting for the system's word.
    pub poll: Poll,
    /// About how often everything is looked at, whatever the system said.
    pub rescan_every: Duration,
    /// The folder of the journal; `.meniscus` in the folder of the outputs by default.
    pub journal: Option<PathBuf>,
    /// How long frames under way may take to finish when the daemon is asked to end.
    pub stop_deadline: Duration,
}

/// One folder to watch, and what becomes of the frames in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Watch {
    /// The folder. It need not be there yet.
    #[serde(with = "path")]
    pub input: PathBuf,
    /// A glob for the path of a frame within the folder; any particle file by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pattern: Option<String>,
    /// Its sub-folders too.
    pub recursive: bool,
    /// The name of the file that says that a frame is complete, with `{name}` and `{stem}` for the
    /// frame's. Where it is given, frames wait for theirs; without it, `{stem}.done` is taken as proof
    /// where it is there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sentinel: Option<String>,
    /// What is written, and where.
    pub outputs: OutputOptions,
    /// All other choices of the method.
    #[serde(with = "by_name")]
    pub choices: MethodOptions,
    /// Absolute paths of what stands in the way; a name with a place for a number, as `body.####.obj`, stands for
    /// a file of each frame.
    #[serde(with = "path::list", default, skip_serializing_if = "Vec::is_empty")]
    pub obstacles: Vec<PathBuf>,
}

impl Watch {
    /// What is made of its frames.
    pub fn job(&self) -> Job {
        if names_level_sets(self.pattern.as_deref()) { Job::level_set(0.0) } else { Job::Surface }
    }

    /// Whether its frames need a particle spacing that is not given.
    pub(super) fn needs_spacing(&self) -> bool {
        self.job() == Job::Surface && self.choices.needs_spacing()
    }
}

/// Whether a pattern is for level sets: only one that ends in `.vdb` is. Any other takes no .vdb, because these may be outputs,
/// of this daemon or of another program, which nobody wants to have converted again.
pub fn names_level_sets(pattern: Option<&str>) -> bool {
    pattern.is_some_and(|pattern| is_level_set(Path::new(pattern)))
}

/// Which of several waiting frames is next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum Order {
    /// By name, numbers as numbers
    Natural,
    /// The one written last
    Latest,
}

/// How long a file must be left alone before it is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Patience {
    /// One that its own format says is complete, or whose reader would find out.
    pub settle: Duration,
    /// One whose format cannot tell.
    pub unproven: Duration,
    /// One that its own format says is not complete: then it is read, to say so.
    pub stalled: Duration,
}

/// When to look at folders by oneself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Poll {
    /// Where the system does not tell of changes: on network file systems.
    Auto,
    /// So often, everywhere.
    Every(Duration),
}

/// The options of the method by name, as text: numbers that results depend on come back to the last bit.
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
        let options = MethodOptions::from_pairs(pairs.iter().map(|(name, value)| (&**name, &**value)));
        options.ok_or_else(|| D::Error::custom("an option is unknown, or has a value that it cannot have"))
    }
}
