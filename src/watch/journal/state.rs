//! What the journal knows: the last record of each frame, each sequence, and the daemon itself, and what it
//! was asked for.
//!
//! Every record here is written as it is: a field that is renamed needs its old name as a `serde` name.

use std::collections::HashMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Deserializer, Serialize};

use crate::pipeline::files::json::{hex, path, text};
use crate::pipeline::{CameraChoice, FileStamp, Framed, MeasuredSpacing, OutputState};
use crate::watch::config::{Patience, Watch};
use crate::watch::status_store::Figures;

/// All that is remembered.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JournalState {
    /// By the path of the input.
    pub frames: HashMap<Arc<Path>, Arc<JournaledFrame>>,
    /// The settings that sequences were given by their first frame.
    pub sequences: HashMap<SequenceKey, JournaledSequence>,
    /// The daemon that wrote last. That it says "running" is no proof that it is.
    pub daemon: Option<DaemonRecord>,
    /// What it was asked for.
    pub plan: Option<PlanRecord>,
    /// Lines of the journal that could not be read, and were passed over.
    pub damaged_line_count: usize,
}

/// What became of a frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JournaledFrame {
    /// How far it has come.
    pub standing: Standing,
    /// The input, as it was when this was recorded.
    #[serde(flatten)]
    pub stamp: FileStamp,
    /// The hash of its content, where it was read.
    #[serde(with = "hex::option", default, skip_serializing_if = "Option::is_none")]
    pub hash: Option<u128>,
    /// The fingerprint of the settings that it was, or was to be, converted with.
    pub settings: String,
    /// What was made of it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub outputs: Vec<OutputRecord>,
    /// Why it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// How often it was attempted.
    #[serde(rename = "attempts")]
    pub attempt_count: u32,
    /// When this was recorded, in milliseconds since 1970.
    pub at_ms: u64,
    /// Particles in it, where it was converted.
    #[serde(rename = "particles", default, skip_serializing_if = "Option::is_none")]
    pub particle_count: Option<usize>,
    /// How long it took, in seconds, where it was converted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// What is not as it should be though it was converted, a sentence each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub flaws: Vec<String>,
    /// What was measured on it, where it was converted, as `/api/frames/NAME` has it. For people: what cannot be read is left out.
    #[serde(deserialize_with = "figures_or_none", default, skip_serializing_if = "Option::is_none")]
    pub figures: Option<Arc<Figures>>,
}

fn figures_or_none<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Arc<Figures>>, D::Error> {
    Ok(serde_json::from_value(serde_json::Value::deserialize(from)?).ok())
}

/// How far a frame has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
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
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutputRecord {
    /// Where it is.
    #[serde(with = "path")]
    pub path: PathBuf,
    /// What the file system said of it; without a hash, only its size is known.
    #[serde(flatten)]
    pub stamp: FileStamp,
    /// The hash of its bytes; `None` in journals of older versions.
    #[serde(with = "hex::option", default, skip_serializing_if = "Option::is_none")]
    pub hash: Option<u128>,
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
    /// An output of this state, or, where that is not known, of this size.
    pub fn new(path: PathBuf, size_bytes: u64, state: Option<OutputState>) -> OutputRecord {
        let of_size = FileStamp { size: size_bytes, ..FileStamp::default() };
        let stamp = state.map_or(of_size, |state| state.stamp);
        OutputRecord { path, stamp, hash: state.map(|state| state.hash) }
    }

    /// Its stamp and the hash of its bytes.
    pub fn state(&self) -> Option<OutputState> {
        Some(OutputState { stamp: self.stamp, hash: self.hash? })
    }

    /// Compares the file with the record, without reading it.
    pub fn check(&self) -> OutputCheck {
        match (FileStamp::of_path(&self.path), self.state()) {
            (Ok(now), _) if now.size != self.stamp.size => OutputCheck::Missing,
            (Ok(now), Some(state)) if !state.stamp.still_holds(&now) => OutputCheck::Touched,
            (Ok(_), _) => OutputCheck::Unchanged,
            (Err(_), _) => OutputCheck::Missing,
        }
    }

    /// Whether the file has the recorded bytes. It is read only if its stamp differs.
    pub fn has_recorded_bytes(&self) -> bool {
        match self.state() {
            Some(state) => state.now(&self.path).is_ok_and(|now| now.hash == state.hash),
            None => self.check() == OutputCheck::Unchanged,
        }
    }
}

/// A sequence, and what the user chose for it: other choices make other settings.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct SequenceKey {
    /// The folder of its frames.
    #[serde(with = "path")]
    pub folder: PathBuf,
    /// The name of its frames, `{}` in place of the number: `dam.{}.bgeo`.
    pub name: String,
    /// The fingerprint of what the user chose.
    pub choices: String,
}

/// What some frames of a sequence have fixed for all of them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct JournaledSequence {
    /// The particle spacing, where it was not given.
    #[serde(flatten)]
    pub measured: Option<MeasuredSpacing>,
    /// Where its pictures are taken from, if any are.
    #[serde(flatten)]
    pub camera: Option<SequenceCamera>,
}

/// A camera that was placed by a frame, and refitted where later ones left its picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "CameraForm", into = "CameraForm")]
pub struct SequenceCamera {
    /// What was asked for; with something else, another is placed.
    pub asked: String,
    /// What came of it.
    pub framed: Framed,
}

/// A camera as it stands in the journal.
#[derive(Serialize, Deserialize)]
struct CameraForm {
    /// What was asked for, and where it is.
    camera: [String; 2],
    /// The corners of what it is placed around: six numbers, or none.
    #[serde(with = "text::list", default, skip_serializing_if = "Vec::is_empty")]
    camera_around: Vec<f64>,
    /// The cameras before it.
    #[serde(with = "text::list", default, skip_serializing_if = "Vec::is_empty")]
    earlier_cameras: Vec<CameraChoice>,
}

impl From<SequenceCamera> for CameraForm {
    fn from(
        SequenceCamera { asked, framed: Framed { camera, around, earlier } }: SequenceCamera,
    ) -> CameraForm {
        let corners = around.into_iter().flatten();
        CameraForm {
            camera: [asked, camera.to_string()],
            camera_around: corners.flat_map(|corner| corner.to_array()).collect(),
            earlier_cameras: earlier,
        }
    }
}

impl TryFrom<CameraForm> for SequenceCamera {
    type Error = String;

    fn try_from(
        CameraForm { camera: [asked, camera], camera_around, earlier_cameras }: CameraForm,
    ) -> Result<SequenceCamera, String> {
        let around = match camera_around[..] {
            [] => None,
            [x, y, z, to_x, to_y, to_z] => Some([DVec3::new(x, y, z), DVec3::new(to_x, to_y, to_z)]),
            _ => return Err("camera_around is not six numbers".to_owned()),
        };
        Ok(SequenceCamera {
            asked,
            framed: Framed { camera: camera.parse()?, around, earlier: earlier_cameras },
        })
    }
}

/// The daemon that writes the journal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlanRecord {
    /// The folders that are watched for these outputs.
    pub watches: Vec<Watch>,
    /// How long files must be left alone.
    #[serde(flatten)]
    pub patience: Patience,
}

/// What a daemon is doing.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
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
pub(super) enum RecordKey {
    Frame(Arc<Path>),
    Sequence(SequenceKey),
    Daemon,
    Plan,
}

/// One record, as a line has it. Cheap to clone: one is kept in memory, and one is written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(in crate::watch) enum Entry {
    Frame {
        #[serde(with = "path")]
        input: Arc<Path>,
        #[serde(flatten)]
        record: Arc<JournaledFrame>,
    },
    Sequence {
        #[serde(flatten)]
        key: SequenceKey,
        #[serde(flatten)]
        record: Box<JournaledSequence>,
    },
    Daemon(DaemonRecord),
    Plan(PlanRecord),
}

impl Entry {
    pub(super) fn key(&self) -> RecordKey {
        match self {
            Entry::Frame { input, .. } => RecordKey::Frame(Arc::clone(input)),
            Entry::Sequence { key, .. } => RecordKey::Sequence(key.clone()),
            Entry::Daemon(_) => RecordKey::Daemon,
            Entry::Plan(_) => RecordKey::Plan,
        }
    }
}

impl JournalState {
    /// Takes a record in, in place of the one before it.
    pub(in crate::watch) fn take(&mut self, entry: Entry) {
        match entry {
            Entry::Frame { input, record } => {
                self.frames.insert(input, record);
            }
            Entry::Sequence { key, record } => {
                self.sequences.insert(key, *record);
            }
            Entry::Daemon(record) => self.daemon = Some(record),
            Entry::Plan(record) => self.plan = Some(record),
        }
    }

    /// The record of this key.
    pub(super) fn entry(&self, key: &RecordKey) -> Option<Entry> {
        match key {
            RecordKey::Frame(input) => self.frames.get_key_value(input).map(frame_entry),
            RecordKey::Sequence(key) => self.sequences.get_key_value(key).map(sequence_entry),
            RecordKey::Daemon => self.daemon.clone().map(Entry::Daemon),
            RecordKey::Plan => self.plan.clone().map(Entry::Plan),
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

fn frame_entry((input, record): (&Arc<Path>, &Arc<JournaledFrame>)) -> Entry {
    Entry::Frame { input: Arc::clone(input), record: Arc::clone(record) }
}

fn sequence_entry((key, record): (&SequenceKey, &JournaledSequence)) -> Entry {
    Entry::Sequence { key: key.clone(), record: Box::new(record.clone()) }
}
