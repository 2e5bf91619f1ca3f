//! The record of finished frames: files of lines in `.meniscus`, in the folder of the outputs.
//!
//! ```text
//!   OUT/dam.0012.glb, OUT/dam.0012.vdb
//!   OUT/.meniscus/frames-51e07b3a-9f3c02d1a47be658     one file for each process that writes at the same time
//!     41d07e5522a98c3f {"settings":{"id":"7d1c…","values":{"voxel_size":"0.02", … }}}
//!     8f3a09c1d2e4b576 {"done":{"name":"dam.0012","input_hash":"…","settings":"7d1c…","outputs":[ … ], … }}
//!     c2609b1ea0f347d8 {"unfinished":{"name":"dam.0013","state":"failed","reason":{"error":" … "}, … }}
//!     5b0c7711e09d4f2a {"sequence":{"key":{"name":"dam.{}.bgeo", … },"shared":{"measured":{"spacing":"0.02", … }}}}
//! ```
//!
//! `convert`, its shards, `watch`, `status` and `verify` read all these files. A record states that an input became
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
//! **Losing a record only costs time**: its frame is converted again, and its sequence is measured again. So a
//! line is one write without a sync, a torn or damaged line is skipped, and nothing is recorded as done before all
//! outputs of a frame have their names.
//!
//! The daemon also records why a frame is not done, what all frames of a sequence share, and its own state. Of
//! such lines the latest one counts. While the disk is full they are kept in memory, and written later.
//!
//! A process appends to a file of its own, beside which it holds a lock (`frames-….lock`): one that an earlier
//! process of this machine has left, or a new one. So there are as many files as processes that ever wrote at the
//! same time, and no process waits for another one, also on network file systems. Locks do not always reach other
//! machines, so the name of a file contains a hash of the machine's name.

use std::collections::{BTreeMap, HashMap};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::figures::Figures;
use super::frame_warnings::fault;
use super::known_records::KnownRecords;
use super::provenance::{MadeFrom, recorded_settings, valid_cameras};
use super::reason::Reason;
use super::record::certificate;
use super::record_file::OwnFile;
use super::record_line::{
    DaemonRecord, DoneRecord, OutputFile, RecordLine, SequenceKey, SharedSettings, UnfinishedRecord,
    UnfinishedState,
};
use crate::pipeline::files::identity::real_path;
use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::files::named_files::NamedFiles;
use crate::pipeline::files::stamp::{FileStamp, now_ms};
use crate::pipeline::input::around::RecordedAround;
use crate::pipeline::input::frame::{Frame, FrameReport, Job};
use crate::pipeline::input::steps::file_of;

/// The folder for this program's own files, in the folder of outputs.
pub const STATE_FOLDER: &str = ".meniscus";

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
    /// The frames before and after it; `None` if they are not known.
    pub around: Option<&'a [RecordedAround]>,
    /// The id of its settings.
    pub settings_id: &'a str,
    /// Its settings, for messages about recorded ones that differ; `None` if they are not known.
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

/// The records of a folder of outputs. Threads of the pipeline share it.
#[derive(Debug)]
pub struct FrameRecords {
    folder: PathBuf,
    content: Mutex<KnownRecords>,
}

/// The latest records: the last that is known of all frames, of sequences and of the daemon.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LatestRecords {
    /// The frames, by their inputs.
    pub frames: HashMap<PathBuf, RecordedFrame>,
    /// What the frames of each sequence share.
    pub sequences: HashMap<SequenceKey, SharedSettings>,
    /// The daemon that recorded its state last.
    pub daemon: Option<DaemonRecord>,
}

/// The last that is known of a frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecordedFrame {
    /// How it was converted last.
    pub done: Option<Arc<DoneRecord>>,
    /// Why it is not done; `None` if nothing was recorded since it was converted.
    pub unfinished: Option<Arc<UnfinishedRecord>>,
}

impl LatestRecords {
    /// Adds what the latest line says.
    pub fn insert(&mut self, line: &RecordLine) {
        match line {
            RecordLine::Settings { .. } => {}
            RecordLine::Done(record) => {
                let frame = RecordedFrame { done: Some(Arc::clone(record)), unfinished: None };
                self.frames.insert(record.input.clone(), frame);
            }
            RecordLine::Unfinished(record) => {
                self.frames.entry(record.input.clone()).or_default().unfinished = Some(Arc::clone(record));
            }
            RecordLine::Sequence { key, shared } => {
                self.sequences.insert(key.clone(), (**shared).clone());
            }
            RecordLine::Daemon(record) => self.daemon = Some(record.clone()),
        }
    }
}

impl RecordedFrame {
    /// When this was recorded, in milliseconds since 1970.
    pub fn at_ms(&self) -> u64 {
        let done = self.done.as_ref().map_or(0, |record| record.at_ms);
        self.unfinished.as_ref().map_or(done, |record| record.at_ms)
    }

    /// The files that it was read from besides its input, if there are any.
    pub fn named(&self) -> Option<&NamedFiles> {
        match (&self.unfinished, &self.done) {
            (Some(unfinished), _) => unfinished.named.as_deref(),
            (None, done) => done.as_ref()?.named.as_deref(),
        }
    }

    /// The hash of the stamps of its obstacles, if it has any.
    pub fn obstacle_stamp(&self) -> Option<&String> {
        match (&self.unfinished, &self.done) {
            (Some(unfinished), _) => unfinished.obstacle_stamp.as_ref(),
            (None, done) => done.as_ref()?.obstacle_stamp.as_ref(),
        }
    }

    /// Its state, if it is not done.
    pub fn unfinished_state(&self) -> Option<UnfinishedState> {
        self.unfinished.as_ref().map(|record| record.state)
    }

    /// The record of a frame that is done.
    pub fn if_done(&self) -> Option<&Arc<DoneRecord>> {
        self.done.as_ref().filter(|_| self.unfinished.is_none())
    }
}

impl Frame {
    /// The name of the frame in its records: the path of its outputs in the folder, without extension.
    fn recorded_name(&self, records: &FrameRecords) -> PathBuf {
        let (folder, root) = (&self.outputs.folder, records.folder());
        let within = folder.strip_prefix(root).map(Path::to_owned).ok().or_else(|| {
            let [folder, root] = [folder, root].map(real_path);
            folder.strip_prefix(root).map(Path::to_owned).ok()
        });
        within.unwrap_or_default().join(&self.stem)
    }

    /// The recorded state of the frame's outputs, if it has records, made from these files.
    pub(crate) fn recorded_state(
        &self,
        made_from: MadeFrom<'_>,
    ) -> Option<(ResultState, Option<Arc<DoneRecord>>)> {
        let records = self.records.as_ref()?;
        let name = |path: PathBuf| path.file_name().unwrap_or_default().into();
        let settings = self.recorded_settings();
        let wanted = Wanted {
            name: &self.recorded_name(records),
            outputs: Some(self.output_paths().into_iter().map(name).collect()),
            input_hash: Some(made_from.input_hash),
            obstacles: Some(made_from.obstacles),
            around: Some(made_from.around),
            settings_id: &settings_id(&settings),
            settings: Some(&settings),
            cameras: valid_cameras(&self.outputs, self.framing.as_deref()),
        };
        Some(records.state(&wanted, OutputComparison::Stamps))
    }

    fn recorded_settings(&self) -> SettingValues {
        recorded_settings(&self.job, &self.settings, &self.outputs, &self.obstacles)
    }

    /// Records that the frame was converted, if it has records; adds the record to the report.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub(crate) fn record_done(&self, report: FrameReport) -> io::Result<FrameReport> {
        let Some(records) = &self.records else { return Ok(report) };
        let settings = self.recorded_settings();
        let is_surface = self.job != Job::Particles;
        let flaws = report.all_warnings().into_iter().filter(|warning| warning.is_flaw);
        let record = Arc::new(DoneRecord {
            name: self.recorded_name(records),
            input: std::path::absolute(&self.input).unwrap_or_else(|_| self.input.clone()),
            stamp: report.input.stamp,
            input_hash: report.input.hash,
            named: report.input.named.clone(),
            obstacles: report.obstacles.clone(),
            around: report.around.clone(),
            obstacle_stamp: self.obstacle_stamp.clone(),
            settings: settings_id(&settings),
            camera: self.has_pictures().then(|| self.outputs.picture.camera.to_string()),
            outputs: report.files.clone(),
            violations: is_surface.then(|| fault(&report.reconstruction)).flatten(),
            flaws: flaws.map(|warning| warning.to_string()).collect(),
            at_ms: now_ms(),
            figures: Arc::new(Figures::of(&report, self.job)),
            certificate: is_surface.then(|| certificate(&report.reconstruction).to_string().into()),
        });
        let record = records.add_done(record, &settings)?;
        Ok(FrameReport { record: Some(record), ..report })
    }

    /// Records that the frame could not be converted, if it has records.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub fn record_failure(&self, reason: &str) -> io::Result<()> {
        let Some(records) = &self.records else { return Ok(()) };
        let input = std::path::absolute(&self.input).unwrap_or_else(|_| self.input.clone());
        records.add_failure(&self.recorded_name(records), &input, reason)
    }
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

    /// Why files of records, or lines in them, cannot be read, if there are any: their frames are converted
    /// again.
    pub fn problems(&self) -> Vec<String> {
        let known = self.content();
        let unreadable = known.unreadable.iter().map(|(path, why)| format!("{}: {why}", path.display()));
        let damaged =
            known.damaged.iter().map(|(path, count)| format!("{}: damaged lines: {count}", path.display()));
        unreadable.chain(damaged).collect()
    }

    /// Opens the file that this process will append to, so that a folder that takes no records is found before
    /// frames are converted.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn prepare(&self) -> io::Result<()> {
        self.content().open_own_file(&self.state_folder())
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
        // The files are read without the lock.
        let mut states = Vec::new();
        for record in records.into_iter().rev() {
            let (state, record) = self.state_of(record, wanted, comparison);
            if state.is_done() {
                return (state, Some(record));
            }
            states.push((state, record));
        }
        // The reason is that of the record with the wanted settings, unless a later conversion replaced its outputs.
        let is_replaced = |index: usize, record: &DoneRecord| {
            let mut names =
                states[..index].iter().flat_map(|(_, later)| &later.outputs).map(|file| &file.name);
            names.any(|name| record.outputs.iter().any(|file| file.name == *name))
        };
        let telling = states.iter().enumerate().position(|(index, (state, record))| {
            matches!(state, ResultState::Missing(_) | ResultState::Damaged(_)) && !is_replaced(index, record)
        });
        match states.into_iter().nth(telling.unwrap_or(0)) {
            Some((state, record)) => (state, Some(record)),
            None => (ResultState::Missing(self.why_missing(wanted.name)), None),
        }
    }

    fn why_missing(&self, name: &Path) -> String {
        let content = self.content();
        let records = content.unfinished.get(name).into_iter().flatten();
        match records.map(|record| &**record).find(|record| record.state != UnfinishedState::Ignored) {
            Some(UnfinishedRecord { state, reason: Some(reason), .. }) if state.is_failure() => {
                format!("it failed: {reason}")
            }
            Some(UnfinishedRecord { state, reason, .. }) => {
                let reason = reason.as_ref().map(|reason| format!(": {reason}"));
                format!("{state}{}", reason.unwrap_or_default())
            }
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

    /// The first difference between a record and the wanted one.
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
        let is_same = |wanted_around: &RecordedAround, recorded: &RecordedAround| {
            let has_obstacles = wanted.obstacles.is_none() || wanted_around.obstacles == recorded.obstacles;
            let [one, other] =
                [wanted_around, recorded].map(|around| (around.steps, &around.name, around.hash));
            has_obstacles && one == other
        };
        let are_same = |around: &[RecordedAround]| {
            around.len() == record.around.len()
                && around.iter().zip(&record.around).all(|(wanted, recorded)| is_same(wanted, recorded))
        };
        if wanted.around.is_some_and(|around| !are_same(around)) {
            return Some("the frames before or after it have changed since it was made".to_owned());
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

    /// Adds the record of a frame that was converted with these settings. Returns the record, which is not earlier than
    /// other records of the frame.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub fn add_done(
        &self,
        mut record: Arc<DoneRecord>,
        settings: &SettingValues,
    ) -> io::Result<Arc<DoneRecord>> {
        let mut content = self.content();
        content.settings.insert(record.settings.clone(), settings.clone());
        let at_ms = record.at_ms.max(content.latest_ms(&record.name, &record.input));
        Arc::make_mut(&mut record).at_ms = at_ms;
        let line = RecordLine::Done(Arc::clone(&record));
        content.write(&self.state_folder(), Some(&line))?;
        content.insert(line);
        Ok(record)
    }

    /// Adds the record of a frame that could not be converted.
    ///
    /// # Errors
    /// When the record cannot be written.
    pub fn add_failure(&self, name: &Path, input: &Path, reason: &str) -> io::Result<()> {
        let line = RecordLine::Unfinished(Arc::new(UnfinishedRecord {
            name: name.to_owned(),
            input: input.to_owned(),
            state: UnfinishedState::Failed,
            reason: Some(Reason::Error(reason.to_owned())),
            stamp: FileStamp::of_path(file_of(input)).unwrap_or_default(),
            named: None,
            settings: String::new(),
            obstacle_stamp: None,
            attempts: 1,
            at_ms: now_ms(),
        }));
        self.keep(line);
        self.write_kept()
    }

    /// Takes a line into memory, until it is written. A record that is known already is not written again. The
    /// line becomes not earlier than the known ones, so that it counts even if a clock was set back.
    pub fn keep(&self, mut line: RecordLine) {
        let mut content = self.content();
        match &mut line {
            RecordLine::Done(record) => {
                if content.done.get(&record.name).is_some_and(|known| known.contains(record)) {
                    return;
                }
                let at_ms = record.at_ms.max(content.latest_ms(&record.name, &record.input));
                Arc::make_mut(record).at_ms = at_ms;
            }
            RecordLine::Unfinished(record) => {
                let is_done = content.done.get(&record.name).is_some_and(|known| !known.is_empty());
                // Of equal times, the conversion counts.
                let known = content.latest_ms(&record.name, &record.input).saturating_add(is_done.into());
                Arc::make_mut(record).at_ms = record.at_ms.max(known);
            }
            RecordLine::Daemon(record) => {
                record.at_ms = record.at_ms.max(content.daemon.as_ref().map_or(0, |known| known.at_ms));
            }
            RecordLine::Sequence { .. } | RecordLine::Settings { .. } => {}
        }
        content.unwritten.insert(line.key(), line.clone());
        content.insert(line);
    }

    /// Writes the lines that were kept.
    ///
    /// # Errors
    /// When the system refuses. The lines are still kept.
    pub fn write_kept(&self) -> io::Result<()> {
        self.content().write(&self.state_folder(), None)
    }

    /// Writes the lines that were kept, and syncs the file to the disk.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn sync(&self) -> io::Result<()> {
        self.write_kept()?;
        self.content().own.as_ref().map_or(Ok(()), OwnFile::sync)
    }

    /// The latest records of everything. If several inputs became outputs of the same name, only the last one
    /// is done.
    pub fn latest(&self) -> LatestRecords {
        let content = self.content();
        let mut frames: HashMap<PathBuf, RecordedFrame> = HashMap::new();
        for done in content.done.values().filter_map(|records| records.last()) {
            let frame = frames.entry(done.input.clone()).or_default();
            if frame.done.as_ref().is_none_or(|known| known.at_ms <= done.at_ms) {
                frame.done = Some(Arc::clone(done));
            }
        }
        for unfinished in content.unfinished.values().flatten() {
            let frame = frames.entry(unfinished.input.clone()).or_default();
            if *frame == RecordedFrame::default() || frame.at_ms() < unfinished.at_ms {
                frame.unfinished = Some(Arc::clone(unfinished));
            }
        }
        LatestRecords { frames, sequences: content.sequences.clone(), daemon: content.daemon.clone() }
    }

    /// The records of every frame that was converted, by name; at least one for each, the latest one last.
    pub fn done(&self) -> BTreeMap<PathBuf, Vec<Arc<DoneRecord>>> {
        let content = self.content();
        let done = content.done.iter().filter(|(_, records)| !records.is_empty());
        done.map(|(name, records)| (name.clone(), records.clone())).collect()
    }

    /// The frames that were never converted, by name.
    pub fn never_done(&self) -> BTreeMap<PathBuf, Arc<UnfinishedRecord>> {
        let content = self.content();
        let unfinished = content.unfinished.iter().filter(|(name, _)| !content.done.contains_key(*name));
        let frames = unfinished.filter_map(|(name, records)| {
            let is_frame = |record: &&Arc<UnfinishedRecord>| record.state != UnfinishedState::Ignored;
            Some((name.clone(), Arc::clone(records.iter().find(is_frame)?)))
        });
        frames.collect()
    }

    /// The settings with this id, if they were recorded.
    pub fn settings(&self, id: &str) -> Option<SettingValues> {
        self.content().settings.get(id).cloned()
    }

    /// The first frame by name whose latest results are of particles that met another condition (`--where`, or `None` for
    /// all particles), and that condition in words.
    pub fn of_other_particles(
        &self,
        is_asked: impl Fn(&DoneRecord) -> bool,
        condition: Option<&String>,
    ) -> Option<(PathBuf, String)> {
        let content = self.content();
        let others = content.done.values().filter_map(|records| {
            let record = records.last().filter(|record| is_asked(record))?;
            let made = content.settings.get(&*record.settings)?.get("where");
            (made != condition).then(|| {
                let words =
                    made.map_or("without --where".to_owned(), |made| format!("with --where '{made}'"));
                (record.name.clone(), words)
            })
        });
        others.min()
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

/// Identifies settings: a hash of their names and values.
pub fn settings_id(values: &SettingValues) -> String {
    let text: String = values.iter().map(|(name, value)| format!("{name}={value}\n")).collect();
    format!("{:016x}", twox_hash::XxHash3_64::oneshot(text.as_bytes()))
}

/// The first setting that differs, in words.
fn changed_setting(was: &SettingValues, wanted: &SettingValues) -> Option<String> {
    let changed = was.keys().chain(wanted.keys()).filter(|name| was.get(*name) != wanted.get(*name));
    // Many settings follow from the voxel size. Other formats may have settings that the wanted ones lack.
    let name = changed.min_by_key(|name| {
        let is_shared = was.contains_key(*name) && wanted.contains_key(*name);
        (*name != "voxel_size", *name == "formats" || !is_shared, *name != "formats", *name)
    })?;
    Some(match (was.get(name), wanted.get(name)) {
        (Some(was), Some(wanted)) if name == "program" => format!("made by {was}; this is {wanted}"),
        (Some(was), Some(wanted)) => format!("made with {name} {was}; the current setting is {wanted}"),
        (None, Some(wanted)) => format!("made without {name}; the current setting is {wanted}"),
        (was, _) => format!("made with {name} {}, which is no longer set", was.map_or("", String::as_str)),
    })
}

#[cfg(test)]
mod tests;
