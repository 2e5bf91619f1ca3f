//! The content of the journal: the last record of each frame, each sequence and the daemon.
//!
//! These types are serialized directly, so a field that is renamed needs its old name as its `serde` name.
//! Frames and their outputs, of which there may be very many, are read through [`FrameForm`] and
//! [`OutputForm`].

use std::collections::HashMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Deserializer, Serialize};

use crate::pipeline::files::json::{hex, path, text};
use crate::pipeline::{
    CameraChoice, FileStamp, Framed, InputFile, MeasuredSpacing, OutputFile, is_level_set,
};
use crate::watch::Reason;
use crate::watch::status_store::Figures;

/// The content of a journal.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JournalState {
    /// The frames, by the paths of their inputs.
    pub frames: HashMap<Arc<Path>, Arc<JournaledFrame>>,
    /// The particle spacing and the camera of each sequence.
    pub sequences: HashMap<SequenceKey, JournaledSequence>,
    /// The daemon that wrote last. The state "running" does not prove that it still runs.
    pub daemon: Option<DaemonRecord>,
    /// The number of damaged lines that were skipped.
    pub damaged_line_count: usize,
}

/// The record of a frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct JournaledFrame {
    /// Its status.
    #[serde(rename = "standing")]
    pub status: JournaledStatus,
    /// The stamp of its input when this was recorded.
    #[serde(flatten)]
    pub stamp: FileStamp,
    /// The hash of its content, if it was read.
    #[serde(with = "hex::option", skip_serializing_if = "Option::is_none")]
    pub hash: Option<u128>,
    /// The fingerprint of the settings with which it was, or would be, converted.
    pub settings: String,
    /// Its outputs.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub outputs: Vec<OutputRecord>,
    /// Why it has this status; `None` if it is done.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<Reason>,
    /// The number of attempts.
    #[serde(rename = "attempts")]
    pub attempt_count: u32,
    /// When this was recorded, in milliseconds since 1970.
    pub at_ms: u64,
    /// The number of its particles, if it was converted from particles.
    #[serde(rename = "particles", skip_serializing_if = "Option::is_none")]
    pub particle_count: Option<usize>,
    /// The time of its conversion in seconds, if it was converted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// Warnings about a converted frame, one sentence each.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub flaws: Vec<String>,
    /// The measurements of a converted frame, as in `/api/frames/NAME`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub figures: Option<Arc<Figures>>,
}

impl JournaledFrame {
    /// A record with this status, and nothing else.
    pub fn new(status: JournaledStatus) -> JournaledFrame {
        JournaledFrame {
            status,
            stamp: FileStamp::default(),
            hash: None,
            settings: String::new(),
            outputs: Vec::new(),
            reason: None,
            attempt_count: 0,
            at_ms: 0,
            particle_count: None,
            seconds: None,
            flaws: Vec::new(),
            figures: None,
        }
    }
}

/// The status of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JournaledStatus {
    /// It is not read yet, because its writer may not have finished it.
    Waiting,
    /// It is queued or in progress.
    Queued,
    /// All its outputs exist.
    Done,
    /// It cannot be converted until it changes.
    Failed,
    /// It failed with an error that may be temporary, and will be retried.
    Retrying,
    /// It cannot be converted because of other files. They may change while the frame does not, so it is
    /// inspected again when the daemon starts.
    Refused,
    /// It failed with an error that may be temporary, and all retries failed: it is retried when the daemon
    /// starts.
    #[serde(rename = "given_up")]
    RetriesExhausted,
    /// It turned out not to be a frame.
    Ignored,
}

/// An output of a frame.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "OutputForm")]
pub struct OutputRecord {
    /// Its path.
    #[serde(with = "path")]
    pub path: PathBuf,
    /// Its stamp when it was written; without a hash, only its size is known.
    #[serde(flatten)]
    pub stamp: FileStamp,
    /// The hash of its content; `None` in journals of older versions.
    #[serde(with = "hex::option", skip_serializing_if = "Option::is_none")]
    pub hash: Option<u128>,
}

/// How an output compares with its record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutputCheck {
    /// It has the recorded stamp.
    Unchanged,
    /// It has the recorded size but another stamp: its hash decides.
    Touched,
    /// It is missing or has another size: a truncated output counts as missing.
    Missing,
}

impl OutputRecord {
    /// An output of which only the size is known.
    pub fn of_size(path: PathBuf, size_bytes: u64) -> OutputRecord {
        let stamp = FileStamp { size: size_bytes, ..FileStamp::default() };
        OutputRecord { path, stamp, hash: None }
    }

    /// An output at this path.
    pub fn of(path: PathBuf, file: &OutputFile) -> OutputRecord {
        OutputRecord { path, stamp: file.stamp, hash: Some(file.hash) }
    }

    /// Compares the file with the record, without reading it.
    pub fn check(&self) -> OutputCheck {
        match FileStamp::of_path(&self.path) {
            Ok(now) if now.size != self.stamp.size => OutputCheck::Missing,
            Ok(now) if self.hash.is_some() && !self.stamp.still_holds(&now) => OutputCheck::Touched,
            Ok(_) => OutputCheck::Unchanged,
            Err(_) => OutputCheck::Missing,
        }
    }

    /// Whether the file has the recorded content. It is read only if its stamp differs.
    pub fn has_recorded_bytes(&self) -> bool {
        match (self.check(), self.hash) {
            (OutputCheck::Touched, Some(hash)) => {
                InputFile::open(&self.path).and_then(|file| file.hash()).is_ok_and(|now| now == hash)
            }
            (check, _) => check == OutputCheck::Unchanged,
        }
    }
}

/// The form of a frame's record for reading: the fields of its stamp are listed, because with `flatten` all
/// fields would be copied first, and a large journal would take several times as long to read.
#[derive(Deserialize)]
struct FrameForm {
    #[serde(with = "path")]
    input: Arc<Path>,
    standing: JournaledStatus,
    size_bytes: u64,
    #[serde(default)]
    modified_ns: i64,
    #[serde(default)]
    inode: u64,
    #[serde(default)]
    changed_ns: Option<i64>,
    #[serde(with = "hex::option", default)]
    hash: Option<u128>,
    settings: String,
    #[serde(default)]
    outputs: Vec<OutputRecord>,
    #[serde(default)]
    reason: Option<Reason>,
    attempts: u32,
    at_ms: u64,
    #[serde(default)]
    particles: Option<usize>,
    #[serde(default)]
    seconds: Option<f64>,
    #[serde(default)]
    flaws: Vec<String>,
    #[serde(default)]
    figures: Option<Arc<Figures>>,
}

/// The form of an output's record for reading.
#[derive(Deserialize)]
struct OutputForm {
    #[serde(with = "path")]
    path: PathBuf,
    size_bytes: u64,
    #[serde(default)]
    modified_ns: i64,
    #[serde(default)]
    inode: u64,
    #[serde(default)]
    changed_ns: Option<i64>,
    #[serde(with = "hex::option", default)]
    hash: Option<u128>,
}

fn read_frame<'de, D: Deserializer<'de>>(from: D) -> Result<(Arc<Path>, Arc<JournaledFrame>), D::Error> {
    let form = FrameForm::deserialize(from)?;
    let record = JournaledFrame {
        status: form.standing,
        stamp: FileStamp {
            size: form.size_bytes,
            modified_ns: form.modified_ns,
            inode: form.inode,
            changed_ns: form.changed_ns,
        },
        hash: form.hash,
        settings: form.settings,
        outputs: form.outputs,
        reason: form.reason,
        attempt_count: form.attempts,
        at_ms: form.at_ms,
        // Journals of earlier versions have 0 for a level set.
        particle_count: form.particles.filter(|&count| count > 0 || !is_level_set(&form.input)),
        seconds: form.seconds,
        flaws: form.flaws,
        figures: form.figures,
    };
    Ok((form.input, Arc::new(record)))
}

impl From<OutputForm> for OutputRecord {
    fn from(
        OutputForm { path, size_bytes, modified_ns, inode, changed_ns, hash }: OutputForm,
    ) -> OutputRecord {
        OutputRecord { path, stamp: FileStamp { size: size_bytes, modified_ns, inode, changed_ns }, hash }
    }
}

/// Identifies a sequence by its name and the user's options: other options yield other settings.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct SequenceKey {
    /// The folder of its frames.
    #[serde(with = "path")]
    pub folder: PathBuf,
    /// The name of its frames, with `{}` in place of the number: `dam.{}.bgeo`.
    pub name: String,
    /// The fingerprint of the user's options.
    pub choices: String,
}

/// The particle spacing and the camera that were determined for all frames of a sequence.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct JournaledSequence {
    /// The particle spacing, if it was measured.
    #[serde(flatten)]
    pub measured: Option<MeasuredSpacing>,
    /// The camera of its pictures, if there are any.
    #[serde(flatten)]
    pub camera: Option<SequenceCamera>,
}

/// A camera that was fitted to a frame, and refitted when later frames left the picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "CameraForm", into = "CameraForm")]
pub struct SequenceCamera {
    /// The camera options; if they change, the camera is fitted again.
    pub requested: String,
    /// The fitted camera.
    pub framed: Framed,
}

/// The serialized form of a camera.
#[derive(Serialize, Deserialize)]
struct CameraForm {
    /// The camera options, and the fitted camera.
    camera: [String; 2],
    /// The corners of the box to which it was fitted: six numbers, or none.
    #[serde(with = "text::list", default, skip_serializing_if = "Vec::is_empty")]
    camera_around: Vec<f64>,
    /// The earlier cameras.
    #[serde(with = "text::list", default, skip_serializing_if = "Vec::is_empty")]
    earlier_cameras: Vec<CameraChoice>,
}

impl From<SequenceCamera> for CameraForm {
    fn from(
        SequenceCamera { requested: asked, framed: Framed { camera, around, earlier } }: SequenceCamera,
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
            requested: asked,
            framed: Framed { camera: camera.parse()?, around, earlier: earlier_cameras },
        })
    }
}

/// The daemon that writes the journal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DaemonRecord {
    /// Its process id.
    pub pid: u32,
    /// The host name of its machine.
    pub host: String,
    /// When its process started to watch, in milliseconds since 1970.
    pub started_ms: u64,
    /// Its state.
    pub state: DaemonState,
    /// When it entered this state, in milliseconds since 1970.
    pub at_ms: u64,
}

/// The state of a daemon.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DaemonState {
    /// It converts frames or waits for them.
    Running,
    /// It starts no frames, for this reason.
    Paused(String),
    /// It exited in an orderly way.
    Stopped,
}

impl fmt::Display for JournaledStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            JournaledStatus::Waiting => "not yet complete",
            JournaledStatus::Queued => "queued or in progress",
            JournaledStatus::Done => "done",
            JournaledStatus::Failed => "failed",
            JournaledStatus::Retrying => "failed, will be retried",
            JournaledStatus::Refused => "not converted",
            JournaledStatus::RetriesExhausted => "failed, after all retries",
            JournaledStatus::Ignored => "not a frame",
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

/// The key of a record: a later record replaces an earlier one with the same key.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) enum RecordKey {
    Frame(Arc<Path>),
    Sequence(SequenceKey),
    Daemon,
}

/// A record: one line of the journal. Cheap to clone: one copy stays in memory, and one is written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(in crate::watch) enum Entry {
    #[serde(deserialize_with = "read_frame")]
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
}

impl Entry {
    pub(super) fn key(&self) -> RecordKey {
        match self {
            Entry::Frame { input, .. } => RecordKey::Frame(Arc::clone(input)),
            Entry::Sequence { key, .. } => RecordKey::Sequence(key.clone()),
            Entry::Daemon(_) => RecordKey::Daemon,
        }
    }
}

impl JournalState {
    /// Adds a record, which replaces the earlier one with the same key.
    pub(in crate::watch) fn take(&mut self, entry: Entry) {
        match entry {
            Entry::Frame { input, record } => {
                self.frames.insert(input, record);
            }
            Entry::Sequence { key, record } => {
                self.sequences.insert(key, *record);
            }
            Entry::Daemon(record) => self.daemon = Some(record),
        }
    }

    /// The record with this key.
    pub(super) fn entry(&self, key: &RecordKey) -> Option<Entry> {
        match key {
            RecordKey::Frame(input) => self.frames.get_key_value(input).map(frame_entry),
            RecordKey::Sequence(key) => self.sequences.get_key_value(key).map(sequence_entry),
            RecordKey::Daemon => self.daemon.clone().map(Entry::Daemon),
        }
    }

    /// All records, unordered.
    pub(super) fn entries(&self) -> impl Iterator<Item = Entry> + '_ {
        let frames = self.frames.iter().map(frame_entry);
        let sequences = self.sequences.iter().map(sequence_entry);
        frames.chain(sequences).chain(self.daemon.clone().map(Entry::Daemon))
    }

    /// The number of records.
    pub(super) fn entry_count(&self) -> usize {
        self.frames.len() + self.sequences.len() + usize::from(self.daemon.is_some())
    }
}

fn frame_entry((input, record): (&Arc<Path>, &Arc<JournaledFrame>)) -> Entry {
    Entry::Frame { input: Arc::clone(input), record: Arc::clone(record) }
}

fn sequence_entry((key, record): (&SequenceKey, &JournaledSequence)) -> Entry {
    Entry::Sequence { key: key.clone(), record: Box::new(record.clone()) }
}
