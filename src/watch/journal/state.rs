//! What the journal knows: the last record of each frame, each sequence, and the daemon itself, and what it
//! was asked for.

use std::collections::HashMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::pipeline::MeasuredSpacing;
use crate::pipeline::{FileStamp, Framed, OutputState};
use crate::watch::board::Figures;
use crate::watch::config::{Patience, Watch};

/// All that is remembered.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct State {
    /// By the path of the input.
    pub frames: HashMap<Arc<Path>, Arc<FrameRecord>>,
    /// The settings that sequences were given by their first frame.
    pub sequences: HashMap<SequenceKey, SequenceRecord>,
    /// The daemon that wrote last. That it says "running" is no proof that it is.
    pub daemon: Option<DaemonRecord>,
    /// What it was asked for.
    pub plan: Option<PlanRecord>,
    /// Lines of the journal that could not be read, and were passed over.
    pub damaged_line_count: usize,
}

/// What became of a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameRecord {
    /// How far it has come.
    pub standing: Standing,
    /// The input, as it was when this was recorded.
    pub stamp: FileStamp,
    /// The hash of its content, where it was read.
    pub hash: Option<u128>,
    /// The fingerprint of the settings that it was, or was to be, converted with.
    pub settings: String,
    /// What was made of it.
    pub outputs: Vec<OutputRecord>,
    /// Why it failed.
    pub reason: Option<String>,
    /// How often it was attempted.
    pub attempt_count: u32,
    /// When this was recorded, in milliseconds since 1970.
    pub at_ms: u64,
    /// Particles in it, where it was converted.
    pub particle_count: Option<usize>,
    /// How long it took, in seconds, where it was converted.
    pub seconds: Option<f64>,
    /// What is not as it should be though it was converted, a sentence each.
    pub flaws: Vec<String>,
    /// What was measured on it, where it was converted.
    pub figures: Option<Arc<Figures>>,
}

/// How far a frame has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Standing {
    /// It waits, or is under way.
    Queued,
    /// All its outputs are there.
    Done,
    /// It cannot be converted, until it changes.
    Failed,
    /// It failed in a way that may pass, and will be attempted again.
    Retrying,
    /// It cannot be converted on account of other files, which may change without it: it is looked at again
    /// when the daemon starts.
    Refused,
    /// It failed in a way that may pass, and not for as long as the daemon tried: it is attempted again when the daemon
    /// starts.
    GivenUp,
}

/// One file that was made of a frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutputRecord {
    /// Where it is.
    pub path: PathBuf,
    /// Bytes.
    pub size_bytes: u64,
    /// Its stamp and the hash of its bytes; `None` in journals of older versions.
    pub state: Option<OutputState>,
}

/// How an output compares with its record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutputCheck {
    /// It has the recorded stamp.
    Unchanged,
    /// It has the recorded size and another stamp: its hash decides.
    Touched,
    /// It is missing, or has another size: one that lost its end is as good as missing.
    Missing,
}

impl OutputRecord {
    /// Compares the file with the record, without reading it.
    pub fn check(&self) -> OutputCheck {
        match (FileStamp::of_path(&self.path), self.state) {
            (Ok(now), _) if now.size != self.size_bytes => OutputCheck::Missing,
            (Ok(now), Some(state)) if !state.stamp.still_holds(&now) => OutputCheck::Touched,
            (Ok(_), _) => OutputCheck::Unchanged,
            (Err(_), _) => OutputCheck::Missing,
        }
    }

    /// Whether the file has the recorded bytes. It is read only if its stamp differs.
    pub fn has_recorded_bytes(&self) -> bool {
        match self.state {
            Some(state) => state.now(&self.path).is_ok_and(|now| now.hash == state.hash),
            None => self.check() == OutputCheck::Unchanged,
        }
    }
}

/// A sequence, and what the user chose for it: other choices make other settings.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct SequenceKey {
    /// The folder of its frames.
    pub folder: PathBuf,
    /// The name of its frames, `{}` in place of the number: `dam.{}.bgeo`.
    pub name: String,
    /// The fingerprint of what the user chose.
    pub choices: String,
}

/// What some frames of a sequence have fixed for all of them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SequenceRecord {
    /// The particle spacing, where it was not given.
    pub measured: Option<MeasuredSpacing>,
    /// Where its pictures are taken from, if any are.
    pub camera: Option<SequenceCamera>,
}

/// A camera that was placed by a frame, and refitted where later ones left its picture.
#[derive(Clone, Debug, PartialEq)]
pub struct SequenceCamera {
    /// What was asked for; with something else, another is placed.
    pub asked: String,
    /// What came of it.
    pub framed: Framed,
}

/// The daemon that writes the journal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DaemonRecord {
    /// Its number on its machine.
    pub pid: u32,
    /// Its machine.
    pub host: String,
    /// When it began, in milliseconds since 1970.
    pub started_ms: u64,
    /// What it is doing.
    pub state: DaemonState,
    /// Since when, in milliseconds since 1970.
    pub at_ms: u64,
}

/// What a daemon was asked for, as far as it concerns the outputs that the journal is about. Apart from
/// [`DaemonRecord`], so that it is written once in a run.
#[derive(Clone, Debug, PartialEq)]
pub struct PlanRecord {
    /// The folders that are watched for these outputs.
    pub watches: Vec<Watch>,
    /// How long files must be left alone.
    pub patience: Patience,
}

/// What a daemon is doing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DaemonState {
    /// It converts what comes, or waits for it.
    Running,
    /// It begins no frame, for this reason.
    Paused(String),
    /// It has ended, in good order.
    Stopped,
}

impl fmt::Display for Standing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Standing::Queued => "queued",
            Standing::Done => "done",
            Standing::Failed => "failed",
            Standing::Retrying => "retrying",
            Standing::Refused => "refused",
            Standing::GivenUp => "given up",
        })
    }
}

impl fmt::Display for DaemonState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            DaemonState::Running => f.write_str("running"),
            DaemonState::Paused(why) => write!(f, "paused: {why}"),
            DaemonState::Stopped => f.write_str("stopped"),
        }
    }
}

/// What a record is about: a later one of the same key replaces an earlier one.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) enum Key {
    Frame(Arc<Path>),
    Sequence(SequenceKey),
    Daemon,
    Plan,
}

/// One record, as a line has it. Cheap to clone: one is kept in memory, and one is written.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::watch) enum Entry {
    Frame(Arc<Path>, Arc<FrameRecord>),
    Sequence(SequenceKey, Box<SequenceRecord>),
    Daemon(DaemonRecord),
    Plan(PlanRecord),
}

impl Entry {
    pub(super) fn key(&self) -> Key {
        match self {
            Entry::Frame(input, _) => Key::Frame(Arc::clone(input)),
            Entry::Sequence(key, _) => Key::Sequence(key.clone()),
            Entry::Daemon(_) => Key::Daemon,
            Entry::Plan(_) => Key::Plan,
        }
    }
}

impl State {
    /// Takes a record in, in place of the one before it.
    pub(in crate::watch) fn take(&mut self, entry: Entry) {
        match entry {
            Entry::Frame(input, record) => {
                self.frames.insert(input, record);
            }
            Entry::Sequence(key, record) => {
                self.sequences.insert(key, *record);
            }
            Entry::Daemon(record) => self.daemon = Some(record),
            Entry::Plan(record) => self.plan = Some(record),
        }
    }

    /// The record of this key.
    pub(super) fn entry(&self, key: &Key) -> Option<Entry> {
        match key {
            Key::Frame(input) => self.frames.get_key_value(input).map(frame_entry),
            Key::Sequence(key) => self.sequences.get_key_value(key).map(sequence_entry),
            Key::Daemon => self.daemon.clone().map(Entry::Daemon),
            Key::Plan => self.plan.clone().map(Entry::Plan),
        }
    }

    /// Every record, in no order.
    pub(super) fn entries(&self) -> impl Iterator<Item = Entry> + '_ {
        let frames = self.frames.iter().map(frame_entry);
        let sequences = self.sequences.iter().map(sequence_entry);
        let plan = self.plan.clone().map(Entry::Plan);
        frames.chain(sequences).chain(plan).chain(self.daemon.clone().map(Entry::Daemon))
    }

    /// How many records there are.
    pub(super) fn entry_count(&self) -> usize {
        let of_daemon = usize::from(self.daemon.is_some()) + usize::from(self.plan.is_some());
        self.frames.len() + self.sequences.len() + of_daemon
    }
}

fn frame_entry((input, record): (&Arc<Path>, &Arc<FrameRecord>)) -> Entry {
    Entry::Frame(Arc::clone(input), Arc::clone(record))
}

fn sequence_entry((key, record): (&SequenceKey, &SequenceRecord)) -> Entry {
    Entry::Sequence(key.clone(), Box::new(record.clone()))
}
