//! The lines in files of records: what is remembered of frames, sequences and the daemon.

use std::fmt;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::figures::Figures;
use super::frame_records::SettingValues;
use super::reason::Reason;
use crate::pipeline::files::json::{hex, path, raw, text};
use crate::pipeline::files::named_files::NamedFiles;
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::input::around::RecordedAround;
use crate::pipeline::input::measured_spacing::MeasuredSpacing;
use crate::pipeline::target::framing::Framed;
use crate::pipeline::target::viewpoint::CameraChoice;

/// One line of a file of records. Cheap to clone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordLine {
    /// The settings to which records refer by their id.
    Settings {
        /// A hash of the values.
        id: String,
        /// Names and values.
        values: SettingValues,
    },
    /// A frame was converted.
    Done(Arc<DoneRecord>),
    /// Why a frame is not done.
    Unfinished(Arc<UnfinishedRecord>),
    /// What all frames of a sequence share.
    Sequence {
        /// The sequence.
        key: SequenceKey,
        /// Its spacing and camera.
        shared: Box<SharedSettings>,
    },
    /// The state of the daemon.
    Daemon(DaemonRecord),
}

/// A frame that was converted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DoneRecord {
    /// The path of its outputs in the folder, without extension.
    #[serde(with = "path")]
    pub name: PathBuf,
    /// Its input.
    #[serde(with = "path")]
    pub input: PathBuf,
    /// The stamp of the input when it was read.
    pub stamp: FileStamp,
    /// The hash of the input's bytes.
    #[serde(with = "hex")]
    pub input_hash: u128,
    /// The files that it was read from besides its input, if there are any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub named: Option<Arc<NamedFiles>>,
    /// The names and hashes of its obstacle files.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub obstacles: String,
    /// The frames before and after it with which it is averaged.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub around: Vec<RecordedAround>,
    /// A hash of the stamps of its obstacle files when the daemon queued it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub obstacle_stamp: Option<String>,
    /// The id of its settings.
    pub settings: String,
    /// The camera of its pictures, if it has any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<String>,
    /// Its outputs.
    pub outputs: Vec<OutputFile>,
    /// The checks that failed, in words.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub violations: Option<String>,
    /// Warnings about faults of the frame, one sentence each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub flaws: Vec<String>,
    /// When this was recorded, in milliseconds since 1970.
    pub at_ms: u64,
    /// Its measurements.
    pub figures: Arc<Figures>,
    /// The results of all checks, as JSON; `None` for particles.
    #[serde(with = "raw", default, skip_serializing_if = "Option::is_none")]
    pub certificate: Option<Arc<str>>,
}

/// An output of a frame when it was written.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutputFile {
    /// Its name, without folder.
    #[serde(with = "path")]
    pub name: PathBuf,
    /// What the file system said about it.
    pub stamp: FileStamp,
    /// The hash of its bytes.
    #[serde(with = "hex")]
    pub hash: u128,
}

/// An output that is not as it was recorded, according to its stamp.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChangedOutput {
    /// Its path.
    pub path: PathBuf,
    /// Whether it does not exist.
    pub is_missing: bool,
}

/// A frame that is not done, or not known to be.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct UnfinishedRecord {
    /// The path of its outputs in the folder, without extension.
    #[serde(with = "path")]
    pub name: PathBuf,
    /// Its input.
    #[serde(with = "path")]
    pub input: PathBuf,
    /// Its state.
    pub state: UnfinishedState,
    /// Why.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<Reason>,
    /// The stamp of the input.
    #[serde(default)]
    pub stamp: FileStamp,
    /// If it failed, the files that it was read from besides its input, if there are any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub named: Option<Arc<NamedFiles>>,
    /// The id of its settings; empty if they are not known.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub settings: String,
    /// A hash of the stamps of its obstacle files, if the daemon queued it with obstacles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub obstacle_stamp: Option<String>,
    /// The number of attempts to convert it.
    #[serde(default)]
    pub attempts: u32,
    /// When this was recorded, in milliseconds since 1970.
    pub at_ms: u64,
}

/// The state of a frame that is not done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UnfinishedState {
    /// It is not read yet, because its writer may not have finished it.
    Waiting,
    /// It is queued or in progress.
    Queued,
    /// It failed with an error that may be temporary, and will be retried.
    Retrying,
    /// It cannot be converted until it changes.
    Failed,
    /// It cannot be converted because of other files. They may change while the frame does not, so it is
    /// inspected again when the daemon starts.
    Refused,
    /// Only a changed file or a restart of the daemon can help: all retries failed, or the memory limit is too
    /// low.
    #[serde(rename = "given_up")]
    AwaitsRestart,
    /// It turned out not to be a frame.
    Ignored,
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
pub struct SharedSettings {
    /// The particle spacing, if it was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub measured: Option<MeasuredSpacing>,
    /// The camera of its pictures, if there are any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<SequenceCamera>,
    /// When this was recorded, in milliseconds since 1970.
    pub at_ms: u64,
}

/// A camera that was fitted to a frame, and refitted when later frames left the picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "CameraForm", into = "CameraForm")]
pub struct SequenceCamera {
    /// The camera options; if they change, the camera is fitted again.
    pub requested: String,
    /// The fitted camera.
    pub framed: Framed,
}

/// The serialized form of a camera: exact numbers.
#[derive(Serialize, Deserialize)]
struct CameraForm {
    requested: String,
    #[serde(with = "text")]
    camera: CameraChoice,
    /// The corners of the box to which it was fitted.
    around: [ExactPoint; 2],
    #[serde(with = "text::list", default, skip_serializing_if = "Vec::is_empty")]
    earlier: Vec<CameraChoice>,
}

#[derive(Serialize, Deserialize)]
struct ExactPoint(#[serde(with = "text")] f64, #[serde(with = "text")] f64, #[serde(with = "text")] f64);

impl From<SequenceCamera> for CameraForm {
    fn from(SequenceCamera { requested, framed }: SequenceCamera) -> CameraForm {
        let Framed { camera, around, earlier } = framed;
        CameraForm { requested, camera, around: around.map(|DVec3 { x, y, z }| ExactPoint(x, y, z)), earlier }
    }
}

impl From<CameraForm> for SequenceCamera {
    fn from(CameraForm { requested, camera, around, earlier }: CameraForm) -> SequenceCamera {
        let around = around.map(|ExactPoint(x, y, z)| DVec3::new(x, y, z));
        SequenceCamera { requested, framed: Framed { camera, around, earlier } }
    }
}

/// A daemon that writes into the folder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DaemonRecord {
    /// Its process id.
    pub pid: u32,
    /// The host name of its machine.
    pub host: String,
    /// When its process started to watch, in milliseconds since 1970.
    pub started_ms: u64,
    /// Its state. "Running" does not prove that it still runs.
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

impl RecordLine {
    /// A later line replaces an earlier one with the same key.
    pub(super) fn key(&self) -> String {
        match self {
            RecordLine::Settings { id, .. } => format!("settings {id}"),
            RecordLine::Done(done) => {
                let hashes: Vec<u128> = done.outputs.iter().map(|file| file.hash).collect();
                let DoneRecord { name, input_hash, obstacles, around, settings, camera, .. } = &**done;
                format!(
                    "done {name:?} {input_hash:x} {settings} {obstacles} {around:?} {camera:?} {hashes:x?}"
                )
            }
            RecordLine::Unfinished(record) => format!("unfinished {:?}", record.input),
            RecordLine::Sequence { key, .. } => format!("sequence {key:?}"),
            RecordLine::Daemon(_) => "daemon".to_owned(),
        }
    }
}

impl DoneRecord {
    /// The paths of its outputs; `folder` is that of the records.
    pub fn output_paths(&self, folder: &Path) -> impl Iterator<Item = PathBuf> + use<'_> {
        let name = folder.join(&self.name);
        self.outputs.iter().map(move |file| name.with_file_name(&file.name))
    }

    /// The first output that is missing, or has another stamp than recorded. No file is read.
    pub fn changed_output(&self, folder: &Path) -> Option<ChangedOutput> {
        let is_as_recorded = |path: &Path, recorded: &FileStamp| {
            FileStamp::of_path(path).is_ok_and(|now| recorded.still_holds(&now))
        };
        let mut outputs = self.output_paths(folder).zip(&self.outputs);
        let (path, _) = outputs.find(|(path, file)| !is_as_recorded(path, &file.stamp))?;
        let is_missing = path.symlink_metadata().is_err();
        Some(ChangedOutput { path, is_missing })
    }

    /// Whether a later record says the same about the same input and settings.
    pub(super) fn is_replaced_by(&self, other: &DoneRecord) -> bool {
        self.input_hash == other.input_hash
            && self.settings == other.settings
            && self.obstacles == other.obstacles
            && self.around == other.around
            && self.camera == other.camera
            && self.outputs.iter().map(|file| file.hash).eq(other.outputs.iter().map(|file| file.hash))
    }

    /// Whether all its names stay within the folder of the outputs.
    pub(super) fn is_plain(&self) -> bool {
        let is_plain = |path: &Path| path.components().all(|part| matches!(part, Component::Normal(_)));
        let is_name = |file: &OutputFile| is_plain(&file.name) && file.name.components().count() == 1;
        is_plain(&self.name) && !self.outputs.is_empty() && self.outputs.iter().all(is_name)
    }
}

impl UnfinishedState {
    /// Whether the frame has failed, until something changes.
    pub fn is_failure(self) -> bool {
        matches!(self, UnfinishedState::Failed | UnfinishedState::Refused | UnfinishedState::AwaitsRestart)
    }
}

impl fmt::Display for UnfinishedState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            UnfinishedState::Waiting => "not yet complete",
            UnfinishedState::Queued => "queued or in progress",
            UnfinishedState::Retrying => "failed, will be retried",
            UnfinishedState::Failed | UnfinishedState::AwaitsRestart => "failed",
            UnfinishedState::Refused => "not converted",
            UnfinishedState::Ignored => "not a frame",
        })
    }
}
