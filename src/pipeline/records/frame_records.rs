//! The record of finished frames: files of lines in `.meniscus`, in the folder of the outputs.
//!
//! ```text
//!   OUT/dam.0012.glb, OUT/dam.0012.vdb
//!   OUT/.meniscus/frames-51e07b3a-9f3c02d1a47be658     one file for each process that writes at the same time
//!     41d07e5522a98c3f {"settings":{"id":"7d1c…","values":{"voxel_size":"0.02", … }}}
//!     8f3a09c1d2e4b576 {"done":{"name":"dam.0012","input_hash":"…","settings":"7d1c…","outputs":[ … ], … }}
//!     c2609b1ea0f347d8 {"failed":{"name":"dam.0013","reason":" … "}}
//! ```
//!
//! `convert`, its shards, `watch` and `verify` read all these files. A record states that an input became
//! outputs with these hashes under these settings, and that stays true, so the order of records and the
//! clocks of machines do not matter: a frame is done if one of its records has the wanted input and settings,
//! and its outputs have the recorded bytes.
//!
//! ```text
//!   no record, or an output does not exist      ─▶ Missing    ┐
//!   made from another input or with other
//!   settings                                    ─▶ Stale      ├ converted again
//!   its bytes are not those that were written   ─▶ Damaged    ┘
//!   validation failed                           ─▶ DoneWithViolations   another conversion would give the same
//!   else                                        ─▶ Done
//! ```
//!
//! **Losing a record only costs time**: its frame is converted again. So a line is one write without a sync, a
//! torn or damaged line is skipped, and nothing is recorded before all outputs of a frame have their names.
//!
//! A process appends to a file of its own, beside which it holds a lock (`frames-….lock`): one that an earlier
//! process of this machine has left, or a new one. So there are as many files as processes that ever wrote at the
//! same time, and no process waits for another one, also on network file systems. Locks do not always reach other
//! machines, so the name of a file contains a hash of the machine's name.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Component, Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::pipeline::files::checked_line::{push_line, record_of_line};
use crate::pipeline::files::host::host_name;
use crate::pipeline::files::identity::is_still_at;
use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::files::json::{hex, path};
use crate::pipeline::files::open::{open_itself, open_own, require_own_folder};
use crate::pipeline::files::stamp::{FileStamp, now_ms};
use crate::pipeline::files::temporary::{create_locked, random_number, remove_if_exists};

/// The folder for this program's own files, in the folder of outputs.
pub const STATE_FOLDER: &str = ".meniscus";

/// The start of the name of a file of records; 8 hexadecimal digits for the machine and 16 others follow.
const FILE_PREFIX: &str = "frames-";

/// The extension of the lock of a file of records.
const LOCK_EXTENSION: &str = "lock";

/// A longer line is not a record.
const LINE_BYTES_MAX: u64 = 1 << 20;

/// A larger file is not continued.
const CONTINUED_BYTES_MAX: u64 = 1 << 30;

/// How often the files are listed, if some disappear meanwhile.
const LISTINGS_MAX: usize = 3;

/// Other records are read again after this many times as long as reading them took.
const PAUSE_PER_READ: u32 = 10;

/// A file with fewer lines is not compacted.
const COMPACTED_LINES_MIN: usize = 1000;

/// The state of a frame's outputs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ResultState {
    /// There is no record of it, or an output does not exist; says which.
    Missing(String),
    /// It was made from another input, with other settings, or by another version of this program.
    Stale(String),
    /// An output was changed, truncated or replaced after it was written.
    Damaged(String),
    /// All outputs are complete and up to date.
    Done,
    /// All outputs are complete and up to date, but these checks failed.
    DoneWithViolations(String),
}

/// An output of a frame when it was written.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutputFile {
    /// Its name, without folder.
    #[serde(with = "path")]
    pub name: PathBuf,
    /// What the file system said about it.
    #[serde(flatten)]
    pub stamp: FileStamp,
    /// The hash of its bytes.
    #[serde(with = "hex")]
    pub hash: u128,
}

/// A frame that was converted.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct DoneRecord {
    /// The path of its outputs in the folder, without extension.
    #[serde(with = "path")]
    pub name: PathBuf,
    /// Its input.
    #[serde(with = "path")]
    pub input: PathBuf,
    /// The hash of the input's bytes.
    #[serde(with = "hex")]
    pub input_hash: u128,
    /// The names and hashes of its obstacle files.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub obstacles: String,
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
    /// When it was written, in milliseconds since 1970.
    pub at_ms: u64,
    /// Its measurements, as in the report. They are not read back.
    #[serde(skip_deserializing, skip_serializing_if = "Value::is_null")]
    pub measured: Value,
}

/// A frame that could not be converted.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct FailureRecord {
    /// The path of its outputs in the folder, without extension.
    #[serde(with = "path")]
    pub name: PathBuf,
    /// Its input.
    #[serde(with = "path")]
    pub input: PathBuf,
    /// Why.
    pub reason: String,
    /// When, in milliseconds since 1970.
    pub at_ms: u64,
}

/// The settings of records, by name.
pub type SettingValues = BTreeMap<String, String>;

/// What the outputs of a frame should be made from.
#[derive(Clone, Debug)]
pub struct Wanted<'a> {
    /// The path of its outputs in the folder, without extension.
    pub name: &'a Path,
    /// The names of its outputs, without folder; `None` if they are not known, and not compared.
    pub outputs: Option<Vec<PathBuf>>,
    /// The hash of the input; `None` if it is not known.
    pub input_hash: Option<u128>,
    /// The names and hashes of its obstacle files; `None` if they are not known.
    pub obstacles: Option<&'a str>,
    /// The id of its settings.
    pub settings_id: &'a str,
    /// Its settings, to tell how recorded ones differ; `None` if they are not known.
    pub settings: Option<&'a SettingValues>,
    /// The cameras that its pictures may have; empty if it has none, or they are not known.
    pub cameras: Vec<String>,
}

/// How outputs are compared with their record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutputComparison {
    /// A file is read only if its stamp differs from the recorded one.
    Stamps,
    /// Every file is read.
    Bytes,
}

/// One line of a file of records.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum RecordLine {
    Settings { id: String, values: SettingValues },
    Done(Arc<DoneRecord>),
    Failed(Arc<FailureRecord>),
}

/// The records of a folder of outputs. Threads of the pipeline share it.
#[derive(Debug)]
pub struct FrameRecords {
    folder: PathBuf,
    content: Mutex<KnownRecords>,
}

#[derive(Debug, Default)]
struct KnownRecords {
    /// The records of each frame, the latest one last; one for each input and settings.
    done: HashMap<PathBuf, Vec<Arc<DoneRecord>>>,
    failed: HashMap<PathBuf, Arc<FailureRecord>>,
    settings: HashMap<String, SettingValues>,
    /// The number of bytes that were read of each file, complete lines only.
    read_bytes: HashMap<PathBuf, u64>,
    /// Files that cannot be read, and why.
    unreadable: BTreeMap<PathBuf, String>,
    /// When the files were read last, and how long that took.
    last_read: Option<(Instant, Duration)>,
    /// The file that this process appends to.
    own: Option<OwnFile>,
}

#[derive(Debug)]
struct OwnFile {
    path: PathBuf,
    file: File,
    /// Locked until it is dropped. It is another file, because Windows lets no process read a locked one.
    _lock: File,
    /// The settings in the file.
    settings: HashSet<String>,
}

impl FrameRecords {
    /// Reads the records in a folder of outputs; a folder without any has no records.
    ///
    /// # Errors
    /// When the system refuses; `InvalidInput` if a link has replaced the folder of the records.
    pub fn open(folder: &Path) -> io::Result<FrameRecords> {
        let records = FrameRecords { folder: folder.to_owned(), content: Mutex::default() };
        records.content().read_news(&records.state_folder())?;
        Ok(records)
    }

    /// Why files of records cannot be read, if there are such files: their frames are converted again.
    pub fn problems(&self) -> Vec<String> {
        let known = self.content();
        known.unreadable.iter().map(|(path, why)| format!("{}: {why}", path.display())).collect()
    }

    /// Opens the file that this process will append to, so that a folder that takes no records is found before
    /// frames are converted.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn prepare(&self) -> io::Result<()> {
        self.content().open_own(&self.state_folder())
    }

    /// The folder of the outputs.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    fn state_folder(&self) -> PathBuf {
        self.folder.join(STATE_FOLDER)
    }

    /// Each change is a single insertion, so records whose lock is poisoned are still consistent.
    fn content(&self) -> MutexGuard<'_, KnownRecords> {
        self.content.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The state of a frame's outputs, and the record that it follows from, with the current stamps of the
    /// outputs if it is done. If it is not done, records that other processes have written meanwhile are read
    /// first.
    pub fn state(
        &self,
        wanted: &Wanted<'_>,
        comparison: OutputComparison,
    ) -> (ResultState, Option<Arc<DoneRecord>>) {
        let first = self.known_state(wanted, comparison);
        if first.0.is_done() || !self.has_news() {
            return first;
        }
        self.known_state(wanted, comparison)
    }

    /// Whether other processes have written records since the last call. An error counts as no news: then the
    /// frame is converted again.
    fn has_news(&self) -> bool {
        self.content().refresh(&self.state_folder()).unwrap_or(false)
    }

    fn known_state(
        &self,
        wanted: &Wanted<'_>,
        comparison: OutputComparison,
    ) -> (ResultState, Option<Arc<DoneRecord>>) {
        let records = self.content().done.get(wanted.name).cloned().unwrap_or_default();
        // The files are read without the lock. If no record holds, the latest one tells why.
        let mut states = records
            .into_iter()
            .rev()
            .map(|record| self.state_of(record, wanted, comparison))
            .map(|(state, record)| (state, Some(record)));
        let latest = states.next();
        let Some(latest) = latest else { return (ResultState::Missing(self.why_missing(wanted.name)), None) };
        if latest.0.is_done() {
            return latest;
        }
        states.find(|(state, _)| state.is_done()).unwrap_or(latest)
    }

    fn why_missing(&self, name: &Path) -> String {
        match self.content().failed.get(name) {
            Some(failure) => format!("it failed: {}", failure.reason),
            None => "there is no record of it".to_owned(),
        }
    }

    fn state_of(
        &self,
        mut record: Arc<DoneRecord>,
        wanted: &Wanted<'_>,
        comparison: OutputComparison,
    ) -> (ResultState, Arc<DoneRecord>) {
        if let Some(difference) = self.difference(&record, wanted) {
            return (ResultState::Stale(difference), record);
        }
        let folder = self.folder.join(&record.name);
        let folder = folder.parent().unwrap_or(&self.folder);
        let is_absent = |file: &&OutputFile| matches!(folder.join(&file.name).try_exists(), Ok(false));
        let absent: Vec<String> =
            record.outputs.iter().filter(is_absent).map(|file| file.name.display().to_string()).collect();
        if !absent.is_empty() {
            return (ResultState::Missing(absent.join(", ")), record);
        }
        let current = record.outputs.iter().map(|file| file.current_stamp(folder, comparison));
        let stamps: Vec<FileStamp> = match current.collect() {
            Ok(stamps) => stamps,
            Err(damage) => return (ResultState::Damaged(damage), record),
        };
        if record.outputs.iter().zip(&stamps).any(|(file, stamp)| file.stamp != *stamp) {
            let outputs = &mut Arc::make_mut(&mut record).outputs;
            outputs.iter_mut().zip(stamps).for_each(|(file, stamp)| file.stamp = stamp);
        }
        let violations = record.violations.clone();
        (violations.map_or(ResultState::Done, ResultState::DoneWithViolations), record)
    }

    /// The first way in which a record is not what is wanted.
    fn difference(&self, record: &DoneRecord, wanted: &Wanted<'_>) -> Option<String> {
        if record.settings != wanted.settings_id {
            let content = self.content();
            let recorded = content.settings.get(&record.settings);
            let changed = recorded.zip(wanted.settings).and_then(|(was, now)| changed_setting(was, now));
            return Some(changed.unwrap_or_else(|| "made with other settings".to_owned()));
        }
        if wanted.input_hash.is_some_and(|hash| hash != record.input_hash) {
            return Some("the input has changed since it was made".to_owned());
        }
        if wanted.obstacles.is_some_and(|obstacles| obstacles != record.obstacles) {
            return Some("the obstacles have changed since it was made".to_owned());
        }
        if !wanted.cameras.is_empty()
            && record.camera.as_ref().is_none_or(|camera| !wanted.cameras.contains(camera))
        {
            return Some("its pictures have another camera".to_owned());
        }
        let outputs = wanted.outputs.as_ref()?;
        let is_recorded = |name: &PathBuf| record.outputs.iter().any(|file| file.name == *name);
        let are_same = outputs.len() == record.outputs.len() && outputs.iter().all(is_recorded);
        (!are_same).then(|| "it has other outputs".to_owned())
    }

    /// Records a frame that was converted with these settings.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub fn record_done(&self, record: DoneRecord, settings: &SettingValues) -> io::Result<()> {
        let mut content = self.content();
        content.settings.insert(record.settings.clone(), settings.clone());
        let record = Arc::new(record);
        content.append(&self.state_folder(), &RecordLine::Done(Arc::clone(&record)))?;
        content.take(RecordLine::Done(record));
        Ok(())
    }

    /// Records a frame that could not be converted.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub fn record_failure(&self, name: &Path, input: &Path, reason: &str) -> io::Result<()> {
        let (name, input) = (name.to_owned(), input.to_owned());
        let record = Arc::new(FailureRecord { name, input, reason: reason.to_owned(), at_ms: now_ms() });
        let mut content = self.content();
        content.append(&self.state_folder(), &RecordLine::Failed(Arc::clone(&record)))?;
        content.take(RecordLine::Failed(record));
        Ok(())
    }

    /// The latest record of every frame that was converted, by name.
    pub fn latest(&self) -> BTreeMap<PathBuf, Arc<DoneRecord>> {
        let content = self.content();
        let latest =
            |records: &Vec<Arc<DoneRecord>>| records.iter().max_by_key(|record| record.at_ms).cloned();
        content.done.iter().filter_map(|(name, records)| Some((name.clone(), latest(records)?))).collect()
    }

    /// The frames that failed and were never converted, by name.
    pub fn failures(&self) -> BTreeMap<PathBuf, Arc<FailureRecord>> {
        let content = self.content();
        let only_failed = content.failed.iter().filter(|(name, _)| !content.done.contains_key(*name));
        only_failed.map(|(name, failure)| (name.clone(), Arc::clone(failure))).collect()
    }

    /// The settings with this id, if they were recorded.
    pub fn settings(&self, id: &str) -> Option<SettingValues> {
        self.content().settings.get(id).cloned()
    }
}

impl ResultState {
    /// Whether the frame need not be converted again.
    pub fn is_done(&self) -> bool {
        matches!(self, ResultState::Done | ResultState::DoneWithViolations(_))
    }

    /// The state in one word, as in reports.
    pub fn word(&self) -> &'static str {
        match self {
            ResultState::Missing(_) => "missing",
            ResultState::Stale(_) => "stale",
            ResultState::Damaged(_) => "damaged",
            ResultState::Done => "done",
            ResultState::DoneWithViolations(_) => "violations",
        }
    }

    /// Why the frame is not done, or which checks failed.
    pub fn reason(&self) -> Option<&str> {
        match self {
            ResultState::Done => None,
            ResultState::Missing(why)
            | ResultState::Stale(why)
            | ResultState::Damaged(why)
            | ResultState::DoneWithViolations(why) => Some(why),
        }
    }
}

impl OutputFile {
    /// The stamp of the file in `folder`, if it has the recorded bytes.
    ///
    /// # Errors
    /// How it differs from its record.
    fn current_stamp(&self, folder: &Path, comparison: OutputComparison) -> Result<FileStamp, String> {
        let (path, name) = (folder.join(&self.name), self.name.display());
        let file = InputFile::open(&path).map_err(|error| format!("{name}: {error}"))?;
        let stamp = file.stamp();
        if comparison == OutputComparison::Stamps && self.stamp.still_holds(&stamp) {
            return Ok(stamp);
        }
        if !file.is_regular() {
            return Err(format!("{name} is no file"));
        }
        let (size, written) = (stamp.size, self.stamp.size);
        if size != written {
            return Err(format!(
                "{name} was changed or replaced: it has {size} bytes, and {written} were written"
            ));
        }
        match file.hash() {
            Ok(hash) if hash == self.hash => Ok(stamp),
            Ok(_) => Err(format!("{name} was changed or replaced: it has other bytes than were written")),
            Err(error) => Err(format!("{name}: {error}")),
        }
    }
}

impl KnownRecords {
    /// Adds a record.
    fn take(&mut self, line: RecordLine) {
        match line {
            RecordLine::Settings { id, values } => {
                self.settings.insert(id, values);
            }
            // Such a record is not one of this program.
            RecordLine::Done(record) if !record.is_plain() => {}
            RecordLine::Done(record) => {
                let records = self.done.entry(record.name.clone()).or_default();
                records.retain(|other| !other.is_replaced_by(&record));
                records.push(record);
                records.sort_by_key(|record| record.at_ms);
            }
            RecordLine::Failed(record) => {
                self.failed.insert(record.name.clone(), record);
            }
        }
    }

    /// Reads what was added to the files since the last call, but not too often. Returns whether anything was.
    fn refresh(&mut self, folder: &Path) -> io::Result<bool> {
        let is_recent = |(at, took): (Instant, Duration)| at.elapsed() < took * PAUSE_PER_READ;
        if self.last_read.is_some_and(is_recent) { Ok(false) } else { self.read_news(folder) }
    }

    /// Reads what was added to the files since the last call. Returns whether anything was.
    fn read_news(&mut self, folder: &Path) -> io::Result<bool> {
        let start = Instant::now();
        let mut has_news = false;
        // If a file has disappeared, another process has moved its lines to a new one.
        for _ in 0..LISTINGS_MAX {
            let mut is_any_gone = false;
            for path in record_files(folder)? {
                let from = self.read_bytes.get(&path).copied().unwrap_or(0);
                match self.read_lines(&path, from) {
                    Ok(end) => {
                        has_news |= end > from;
                        self.unreadable.remove(&path);
                        self.read_bytes.insert(path, end);
                    }
                    Err(error) if error.kind() == io::ErrorKind::NotFound => is_any_gone = true,
                    Err(error) => drop(self.unreadable.insert(path, error.to_string())),
                }
            }
            if !is_any_gone {
                break;
            }
        }
        self.last_read = Some((Instant::now(), start.elapsed()));
        Ok(has_news)
    }

    /// Takes the records in the complete lines of a file from an offset. Returns where the last one ends.
    fn read_lines(&mut self, path: &Path, from: u64) -> io::Result<u64> {
        let mut file = open_own(path, OpenOptions::new().read(true))?;
        let size = file.metadata()?.len();
        // A file that is shorter than before was replaced: all of it is read.
        let from = if size < from { 0 } else { from };
        file.seek(SeekFrom::Start(from))?;
        let (mut reader, mut end, mut line) = (BufReader::new(file), from, Vec::new());
        loop {
            line.clear();
            let count = reader.by_ref().take(LINE_BYTES_MAX).read_until(b'\n', &mut line)? as u64;
            // The writer has not finished the last line.
            if count == 0 || count < LINE_BYTES_MAX && line.last() != Some(&b'\n') {
                return Ok(end);
            }
            end += count;
            // A torn, damaged or foreign line is skipped: its frame is converted again.
            let record = line.strip_suffix(b"\n").and_then(record_of_line);
            if let Some(record) = record.and_then(|json| serde_json::from_slice(json).ok()) {
                self.take(record);
            }
        }
    }

    /// Opens the file that this process appends to, unless it is open and in place.
    fn open_own(&mut self, folder: &Path) -> io::Result<()> {
        // Users remove folders of outputs to start over.
        if self.own.as_ref().is_some_and(|own| is_still_at(&own.path, &own.file)) {
            return Ok(());
        }
        self.own = Some(OwnFile::open(folder)?);
        // Its lines so far are read: those that are appended are known.
        self.read_news(folder).map(drop)
    }

    /// Appends a line, and the settings that it refers to, if the file does not have them.
    fn append(&mut self, folder: &Path, line: &RecordLine) -> io::Result<()> {
        self.open_own(folder)?;
        if let Some(own) = &mut self.own
            && let Ok(end) = own.append(line, &self.settings)
        {
            self.read_bytes.insert(own.path.clone(), end);
            return Ok(());
        }
        // Perhaps only this file cannot be written. A new one begins at a line.
        self.own = None;
        let mut own = OwnFile::create(folder, HashSet::new())?;
        own.append(line, &self.settings)?;
        self.own = Some(own);
        Ok(())
    }
}

impl DoneRecord {
    /// Whether a later record says the same about the same input and settings.
    fn is_replaced_by(&self, other: &DoneRecord) -> bool {
        self.input_hash == other.input_hash
            && self.settings == other.settings
            && self.obstacles == other.obstacles
            && self.camera == other.camera
            && self.outputs.iter().map(|file| file.hash).eq(other.outputs.iter().map(|file| file.hash))
    }

    /// Whether all its names stay within the folder of the outputs.
    fn is_plain(&self) -> bool {
        let is_plain = |path: &Path| path.components().all(|part| matches!(part, Component::Normal(_)));
        let is_name = |file: &OutputFile| is_plain(&file.name) && file.name.components().count() == 1;
        is_plain(&self.name) && !self.outputs.is_empty() && self.outputs.iter().all(is_name)
    }
}

impl OwnFile {
    /// Opens a file that no process writes to, or creates one.
    fn open(folder: &Path) -> io::Result<OwnFile> {
        match fs::create_dir(folder) {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error),
            _ => require_own_folder(&folder.join(FILE_PREFIX))?,
        }
        for path in record_files(folder)? {
            // A file that cannot be continued belongs to another user, or is none of this program.
            if is_of_this_machine(&path)
                && let Ok(Some(lock)) = lock_unused(&path.with_extension(LOCK_EXTENSION))
                && let Ok(own) = OwnFile::adopt(path, lock)
            {
                return Ok(own);
            }
        }
        OwnFile::create(folder, HashSet::new())
    }

    /// Appends a line, and the settings that it refers to, if the file does not have them. Returns the size of the
    /// file.
    fn append(&mut self, line: &RecordLine, known: &HashMap<String, SettingValues>) -> io::Result<u64> {
        let mut bytes = Vec::new();
        if let RecordLine::Done(record) = line
            && !self.settings.contains(&record.settings)
            && let Some(values) = known.get(&record.settings)
        {
            let (id, values) = (record.settings.clone(), values.clone());
            push_line(&mut bytes, &RecordLine::Settings { id: id.clone(), values })?;
            self.settings.insert(id);
        }
        push_line(&mut bytes, line)?;
        self.file.write_all(&bytes)?;
        Ok(self.file.metadata()?.len())
    }

    /// Creates a file that has these settings.
    fn create(folder: &Path, settings: HashSet<String>) -> io::Result<OwnFile> {
        loop {
            let path = folder.join(format!("{}{:016x}", machine_prefix(), random_number()));
            let lock_path = path.with_extension(LOCK_EXTENSION);
            if let Some(lock) = create_locked(&lock_path)? {
                let created = open_own(&path, OpenOptions::new().append(true).create_new(true));
                let file = created.inspect_err(|_| drop(remove_if_exists(&lock_path)))?;
                return Ok(OwnFile { path, file, _lock: lock, settings });
            }
        }
    }

    /// Continues a file of an earlier process. Compacts it if most of its lines are superseded.
    fn adopt(path: PathBuf, lock: File) -> io::Result<OwnFile> {
        let mut file = open_own(&path, OpenOptions::new().read(true).append(true))?;
        if file.metadata()?.len() > CONTINUED_BYTES_MAX {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        let mut settings = HashSet::new();
        let (mut lines, mut last): (usize, HashMap<String, &[u8]>) = (0, HashMap::new());
        for line in bytes.split_inclusive(|byte| *byte == b'\n') {
            lines += 1;
            let json = line.strip_suffix(b"\n").and_then(record_of_line);
            let Some(record) = json.and_then(|json| serde_json::from_slice(json).ok()) else { continue };
            let key = match record {
                RecordLine::Settings { id, .. } => {
                    settings.insert(id.clone());
                    format!("settings {id}")
                }
                RecordLine::Done(done) => {
                    let hashes: Vec<u128> = done.outputs.iter().map(|file| file.hash).collect();
                    let DoneRecord { name, input_hash, obstacles, settings, camera, .. } = &*done;
                    format!("done {name:?} {input_hash:x} {settings} {obstacles} {camera:?} {hashes:x?}")
                }
                RecordLine::Failed(failure) => format!("failed {:?}", failure.name),
            };
            last.insert(key, line);
        }
        if lines >= COMPACTED_LINES_MIN && last.len() * 2 < lines {
            return OwnFile::compact(&path, last.into_values(), settings);
        }
        // Ends a line that was torn, which is then skipped.
        if bytes.last().is_some_and(|byte| *byte != b'\n') {
            file.write_all(b"\n")?;
        }
        Ok(OwnFile { path, file, _lock: lock, settings })
    }

    /// Moves these lines to a new file, and removes the old one. Until then, both are read.
    fn compact<'a>(
        old: &Path,
        lines: impl Iterator<Item = &'a [u8]>,
        settings: HashSet<String>,
    ) -> io::Result<OwnFile> {
        let mut own = OwnFile::create(old.parent().unwrap_or(Path::new("")), settings)?;
        let moved = own
            .file
            .write_all(&lines.collect::<Vec<_>>().concat())
            .and_then(|()| own.file.sync_data())
            .and_then(|()| remove_if_exists(old));
        // Otherwise each start would leave another copy.
        let gone = if moved.is_ok() { old } else { &*own.path };
        let _ = remove_if_exists(&gone.with_extension(LOCK_EXTENSION));
        if moved.is_err() {
            let _ = remove_if_exists(gone);
        }
        moved.map(|()| own)
    }
}

/// The files of records in a folder, in the order of their names; none if the folder does not exist.
fn record_files(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries?,
    };
    let mut files = Vec::new();
    for entry in entries {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let is_records = name.starts_with(FILE_PREFIX) && path.extension().is_none();
        files.extend(is_records.then(|| path.clone()));
    }
    files.sort();
    Ok(files)
}

/// The start of the names of this machine's files.
fn machine_prefix() -> String {
    let hash = twox_hash::XxHash3_64::oneshot(host_name().as_bytes());
    format!("{FILE_PREFIX}{:08x}-", hash as u32)
}

fn is_of_this_machine(path: &Path) -> bool {
    path.file_name().unwrap_or_default().to_string_lossy().starts_with(&machine_prefix())
}

/// Locks a file that no process has locked; `None` if one has, or if the file system has no locks.
fn lock_unused(path: &Path) -> io::Result<Option<File>> {
    let file = open_itself(path, OpenOptions::new().read(true).write(true))?;
    Ok((file.try_lock().is_ok() && is_still_at(path, &file)).then_some(file))
}

/// Identifies settings: a hash of their names and values.
pub fn settings_id(values: &SettingValues) -> String {
    let text: String = values.iter().map(|(name, value)| format!("{name}={value}\n")).collect();
    format!("{:016x}", twox_hash::XxHash3_64::oneshot(text.as_bytes()))
}

/// The first setting that differs, in words.
fn changed_setting(was: &SettingValues, wanted: &SettingValues) -> Option<String> {
    let changed = was.keys().chain(wanted.keys()).filter(|name| was.get(*name) != wanted.get(*name));
    // Other formats may have other settings, so those that both have tell most.
    let is_shared = |name: &str| was.contains_key(name) && wanted.contains_key(name);
    let name = changed.min_by_key(|name| (*name == "formats", !is_shared(name), *name))?;
    Some(match (was.get(name), wanted.get(name)) {
        (Some(was), Some(wanted)) if name == "program" => format!("made by {was}; this is {wanted}"),
        (Some(was), Some(wanted)) => format!("made with {name} {was}; the current setting is {wanted}"),
        (None, Some(wanted)) => format!("made without {name}; the current setting is {wanted}"),
        (was, _) => format!("made with {name} {}, which is no longer set", was.map_or("", String::as_str)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(voxel_size: &str) -> SettingValues {
        [("voxel_size", voxel_size), ("formats", "glb")].map(|(n, v)| (n.to_owned(), v.to_owned())).into()
    }

    /// Writes the outputs of a frame, and records them.
    fn convert(records: &FrameRecords, name: &str, bytes: &str, voxel_size: &str) {
        let path = records.folder().join(format!("{name}.glb"));
        fs::write(&path, bytes).expect("written");
        let file = InputFile::open(&path).expect("opened");
        let output = OutputFile {
            name: format!("{name}.glb").into(),
            stamp: file.stamp(),
            hash: file.hash().expect("read"),
        };
        let settings = values(voxel_size);
        let record = DoneRecord {
            name: name.into(),
            input: "/in/a.ply".into(),
            input_hash: 7,
            obstacles: String::new(),
            settings: settings_id(&settings),
            camera: None,
            outputs: vec![output],
            violations: (bytes == "broken").then(|| "1 hole".to_owned()),
            at_ms: now_ms(),
            measured: Value::Null,
        };
        records.record_done(record, &settings).expect("recorded");
    }

    fn wanted<'a>(
        name: &'a str,
        (id, settings): &'a (String, SettingValues),
        input_hash: u128,
    ) -> Wanted<'a> {
        let name = Path::new(name);
        Wanted {
            name,
            settings_id: id,
            outputs: Some(vec![name.with_added_extension("glb")]),
            input_hash: Some(input_hash),
            obstacles: Some(""),
            settings: Some(settings),
            cameras: Vec::new(),
        }
    }

    fn state(records: &FrameRecords, name: &str, voxel_size: &str, input_hash: u128) -> ResultState {
        let settings = (settings_id(&values(voxel_size)), values(voxel_size));
        records.state(&wanted(name, &settings, input_hash), OutputComparison::Stamps).0
    }

    fn touch(path: &Path) {
        let file = File::options().write(true).open(path).expect("opened");
        file.set_modified(std::time::UNIX_EPOCH).expect("set");
    }

    #[test]
    fn state_follows_from_the_record_and_the_files() {
        let folder = tempfile::tempdir().expect("a folder");
        let records = FrameRecords::open(folder.path()).expect("opened");
        let path = folder.path().join("a.glb");
        assert_eq!(
            state(&records, "a", "0.1", 7),
            ResultState::Missing("there is no record of it".to_owned())
        );
        records.record_failure(Path::new("a"), Path::new("/in/a.ply"), "torn").expect("recorded");
        assert_eq!(state(&records, "a", "0.1", 7), ResultState::Missing("it failed: torn".to_owned()));
        convert(&records, "a", "mesh", "0.1");
        assert_eq!(state(&records, "a", "0.1", 7), ResultState::Done);
        let stale = "made with voxel_size 0.1; the current setting is 0.2";
        assert_eq!(state(&records, "a", "0.2", 7), ResultState::Stale(stale.to_owned()));
        let changed = "the input has changed since it was made";
        assert_eq!(state(&records, "a", "0.1", 8), ResultState::Stale(changed.to_owned()));
        touch(&path);
        assert_eq!(state(&records, "a", "0.1", 7), ResultState::Done, "the same bytes under another time");
        let (_, record) = records
            .state(&wanted("a", &(settings_id(&values("0.1")), values("0.1")), 7), OutputComparison::Stamps);
        let stamp = InputFile::open(&path).expect("opened").stamp();
        assert_eq!(record.expect("a record").outputs[0].stamp, stamp, "the record has the current stamp");
        fs::write(&path, "mEsh").expect("written");
        assert!(matches!(state(&records, "a", "0.1", 7), ResultState::Damaged(_)));
        fs::write(&path, "mes").expect("written");
        assert!(matches!(state(&records, "a", "0.1", 7), ResultState::Damaged(_)));
        fs::remove_file(&path).expect("removed");
        assert_eq!(state(&records, "a", "0.1", 7), ResultState::Missing("a.glb".to_owned()));
        convert(&records, "a", "broken", "0.1");
        assert_eq!(state(&records, "a", "0.1", 7), ResultState::DoneWithViolations("1 hole".to_owned()));
    }

    /// The outputs of an older record are put back, for example from a backup.
    #[test]
    fn any_record_that_holds_counts() {
        let folder = tempfile::tempdir().expect("a folder");
        let records = FrameRecords::open(folder.path()).expect("opened");
        convert(&records, "a", "old", "0.1");
        convert(&records, "a", "new", "0.2");
        assert_eq!(state(&records, "a", "0.2", 7), ResultState::Done);
        assert!(matches!(state(&records, "a", "0.1", 7), ResultState::Damaged(_) | ResultState::Stale(_)));
        fs::write(folder.path().join("a.glb"), "old").expect("written");
        assert_eq!(state(&records, "a", "0.1", 7), ResultState::Done);
        assert!(!state(&records, "a", "0.2", 7).is_done());
    }

    #[test]
    fn processes_that_write_at_the_same_time_see_each_others_records() {
        let folder = tempfile::tempdir().expect("a folder");
        let [one, other] = [(); 2].map(|()| FrameRecords::open(folder.path()).expect("opened"));
        convert(&one, "a", "mesh", "0.1");
        convert(&other, "b", "mesh", "0.1");
        for records in [&one, &other] {
            assert_eq!(state(records, "a", "0.1", 7), ResultState::Done);
            assert_eq!(state(records, "b", "0.1", 7), ResultState::Done);
        }
        let file_count = || record_files(&folder.path().join(STATE_FOLDER)).expect("read").len();
        assert_eq!(file_count(), 2);
        drop((one, other));
        let later = FrameRecords::open(folder.path()).expect("opened");
        convert(&later, "c", "mesh", "0.1");
        assert_eq!(file_count(), 2, "an abandoned file is continued");
        assert_eq!(later.latest().len(), 3);
    }

    #[test]
    fn torn_and_damaged_lines_are_skipped() {
        let folder = tempfile::tempdir().expect("a folder");
        let records = FrameRecords::open(folder.path()).expect("opened");
        convert(&records, "a", "mesh", "0.1");
        convert(&records, "b", "mesh", "0.1");
        drop(records);
        let path = record_files(&folder.path().join(STATE_FOLDER)).expect("read").remove(0);
        let bytes = fs::read(&path).expect("read");
        // Without its line break, the last line is still complete.
        for end in (0..bytes.len() - 1).step_by(7) {
            fs::write(&path, &bytes[..end]).expect("written");
            let records = FrameRecords::open(folder.path()).expect("opened");
            convert(&records, "c", "mesh", "0.1");
            assert!(!state(&records, "b", "0.1", 7).is_done(), "{end}");
            drop(records);
            let records = FrameRecords::open(folder.path()).expect("opened");
            assert_eq!(state(&records, "c", "0.1", 7), ResultState::Done, "{end}");
        }
        for at in (0..bytes.len()).step_by(3) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 1;
            fs::write(&path, &damaged).expect("written");
            let records = FrameRecords::open(folder.path()).expect("opened");
            let states = ["a", "b"].map(|name| state(&records, name, "0.1", 7));
            assert!(
                states.iter().all(|s| matches!(s, ResultState::Done | ResultState::Missing(_))),
                "{at}: {states:?}"
            );
        }
    }

    #[test]
    fn superseded_lines_are_removed() {
        let folder = tempfile::tempdir().expect("a folder");
        let records = FrameRecords::open(folder.path()).expect("opened");
        for _ in 0..COMPACTED_LINES_MIN {
            convert(&records, "a", "mesh", "0.1");
        }
        convert(&records, "b", "mesh", "0.1");
        drop(records);
        let records = FrameRecords::open(folder.path()).expect("opened");
        convert(&records, "c", "mesh", "0.1");
        let files = record_files(&folder.path().join(STATE_FOLDER)).expect("read");
        let [file] = &files[..] else { panic!("{files:?}") };
        assert_eq!(fs::read_to_string(file).expect("text").lines().count(), 4);
        for name in ["a", "b", "c"] {
            assert_eq!(state(&records, name, "0.1", 7), ResultState::Done, "{name}");
        }
    }

    /// A file of another machine, whose locks may not reach this one, and one that cannot be read.
    #[test]
    fn foreign_files_are_left_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        let records = FrameRecords::open(folder.path()).expect("opened");
        convert(&records, "a", "mesh", "0.1");
        drop(records);
        let state_folder = folder.path().join(STATE_FOLDER);
        let own = record_files(&state_folder).expect("read").remove(0);
        let foreign = state_folder.join("frames-00000000-0000000000000000");
        for extension in ["", LOCK_EXTENSION] {
            fs::rename(own.with_extension(extension), foreign.with_extension(extension)).expect("renamed");
        }
        let size = fs::metadata(&foreign).expect("there").len();
        let odd = state_folder.join("frames-00000000-0000000000000001");
        fs::create_dir(&odd).expect("made");
        fs::create_dir(own.with_extension(LOCK_EXTENSION)).expect("made");
        fs::write(&own, "").expect("written");
        let records = FrameRecords::open(folder.path()).expect("opened");
        assert!(records.problems()[0].starts_with(&odd.display().to_string()), "{:?}", records.problems());
        assert_eq!(state(&records, "a", "0.1", 7), ResultState::Done);
        convert(&records, "b", "mesh", "0.1");
        assert_eq!(state(&records, "b", "0.1", 7), ResultState::Done);
        assert_eq!(fs::metadata(&foreign).expect("there").len(), size);
        assert_eq!(fs::metadata(&own).expect("there").len(), 0);
    }

    #[test]
    fn record_that_leads_out_of_the_folder_is_ignored() {
        let folder = tempfile::tempdir().expect("a folder");
        let records = FrameRecords::open(folder.path()).expect("opened");
        convert(&records, "a", "mesh", "0.1");
        let sound = records.latest()[Path::new("a")].clone();
        drop(records);
        let file = |name: &str| OutputFile { name: name.into(), ..sound.outputs[0].clone() };
        for (name, outputs) in [
            ("../b", sound.outputs.clone()),
            ("/b", sound.outputs.clone()),
            ("b", vec![]),
            ("b", vec![file("../a.glb")]),
            ("b", vec![file("/etc/passwd")]),
            ("b", vec![file("x/a.glb")]),
        ] {
            let records = FrameRecords::open(folder.path()).expect("opened");
            let hostile = DoneRecord { name: name.into(), outputs, ..(*sound).clone() };
            records.record_done(hostile, &values("0.1")).expect("written");
            for records in [records, FrameRecords::open(folder.path()).expect("opened")] {
                assert_eq!(records.latest().len(), 1, "{name}");
            }
        }
    }

    #[test]
    fn removed_records_are_begun_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let records = FrameRecords::open(folder.path()).expect("opened");
        convert(&records, "a", "mesh", "0.1");
        fs::remove_dir_all(folder.path().join(STATE_FOLDER)).expect("removed");
        convert(&records, "b", "mesh", "0.1");
        let later = FrameRecords::open(folder.path()).expect("opened");
        assert_eq!(state(&later, "b", "0.1", 7), ResultState::Done);
    }

    #[test]
    #[cfg(unix)]
    fn records_are_not_written_through_a_link() {
        let folders = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
        let [folder, elsewhere] = folders.each_ref().map(tempfile::TempDir::path);
        std::os::unix::fs::symlink(elsewhere, folder.join(STATE_FOLDER)).expect("linked");
        let records = FrameRecords::open(folder).expect("opened");
        let refused = records.record_failure(Path::new("a"), Path::new("/a"), "why").expect_err("refused");
        assert!(refused.to_string().contains(".meniscus is a symbolic link"), "{refused}");
        assert_eq!(fs::read_dir(elsewhere).expect("there").count(), 0);
    }
}
