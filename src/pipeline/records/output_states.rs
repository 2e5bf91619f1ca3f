//! Stores the hashes of written outputs, so that later damage is detected.
//!
//! ```text
//!   stamp as recorded            ─▶ unchanged, not read
//!   another stamp, same hash     ─▶ unchanged: touched, copied or restored; the new stamp is recorded
//!   another stamp, another hash  ─▶ damaged: the frame is converted again
//! ```
//!
//! The provenance of an output cannot reveal a flipped byte in its middle; its hash can. Hashes are only
//! computed when an output is written and when its stamp differs from the recorded one.
//!
//! The daemon keeps these records in its journal. `convert --skip-done` keeps them in
//! `.meniscus/outputs.json` in the folder of the outputs, together with failed checks, so that a frame that
//! failed validation still counts as failed when it is skipped. A plain `convert` records the outputs of
//! frames that failed validation, and outputs that have a record already. Without `outputs.json`, hashes are
//! not compared.
//!
//! `watch` and older versions of this program replace outputs and do not update `outputs.json`. So each
//! record has the hash of the output's provenance, which names the input and the settings. A record with
//! another provenance describes an earlier file, and is ignored.

use std::collections::{BTreeMap, HashMap};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use meniscus_formats::read_provenance;
use serde::{Deserialize, Serialize};
use twox_hash::XxHash3_128;

use crate::pipeline::files::atomic_write::replace_own;
use crate::pipeline::files::input_file::{InputFile, read_start_unchanged};
use crate::pipeline::files::json::hex;
use crate::pipeline::files::open::{open_own, open_regular};
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::target::outputs::OutputFormat;

/// The stamp and the content hash of an output.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutputState {
    /// What the file system says about the file.
    #[serde(flatten)]
    pub stamp: FileStamp,
    /// The hash of its bytes.
    #[serde(with = "hex")]
    pub hash: u128,
}

impl OutputState {
    /// Reads the file at `path` and returns its state.
    ///
    /// # Errors
    /// When the system reports an error, or the file is not a regular file or changes during the read.
    pub fn of_path(path: &Path) -> io::Result<OutputState> {
        let file = InputFile::open(path)?;
        let state = OutputState { stamp: file.stamp(), hash: file.hash()? };
        match file.is_unchanged()? {
            true => Ok(state),
            false => Err(io::Error::other("the file changed while it was read")),
        }
    }

    /// The current state of the file at `path`, whose recorded state is `self`. If the stamp of the file is
    /// unchanged, the file is not read, and `self` is returned.
    ///
    /// # Errors
    /// Those of [`of_path`](OutputState::of_path).
    pub fn now(&self, path: &Path) -> io::Result<OutputState> {
        match self.stamp.still_holds(&FileStamp::of_path(path)?) {
            true => Ok(*self),
            false => OutputState::of_path(path),
        }
    }
}

/// The recorded states of outputs, by path. Shared between the threads of the pipeline and its caller.
#[derive(Debug, Default)]
pub struct OutputStates {
    known: Mutex<HashMap<PathBuf, Record>>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Record {
    #[serde(flatten)]
    state: OutputState,
    /// The hash of the output's provenance, in hexadecimal digits; empty if the caller compares the
    /// provenance itself.
    made_from: String,
    /// The failed checks of its frame; `None` if all passed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fault: Option<String>,
    /// Whether the file of records has it, because it was loaded from there or saved there.
    #[serde(skip)]
    is_loaded: bool,
}

/// The file of records.
#[derive(Serialize, Deserialize)]
struct RecordsFile {
    meniscus_outputs: u32,
    outputs: Vec<NamedRecord>,
}

#[derive(Serialize, Deserialize)]
struct NamedRecord {
    /// The name of the output, without folder.
    file: String,
    #[serde(flatten)]
    record: Record,
}

impl OutputStates {
    /// Records the state of an output.
    pub fn put(&self, path: &Path, state: OutputState) {
        self.insert_record(path, state, String::new(), None);
    }

    /// Removes and returns the recorded state of an output.
    pub fn take(&self, path: &Path) -> Option<OutputState> {
        self.known().remove(path).map(|record| record.state)
    }

    /// Whether one of these outputs has a record.
    pub(crate) fn has_any(&self, paths: &[PathBuf]) -> bool {
        let known = self.known();
        paths.iter().any(|path| known.contains_key(path))
    }

    /// Records the states of the outputs of a frame that were just written, and its failed checks. Skips
    /// outputs that cannot be read back.
    pub(crate) fn record(&self, paths: &[PathBuf], fault: Option<&str>) {
        for path in paths {
            match OutputState::of_path(path) {
                Ok(state) => self.insert_record(path, state, made_from(path), fault.map(str::to_owned)),
                Err(_) => drop(self.take(path)),
            }
        }
    }

    /// Compares the outputs of a frame with their records. `None`: the bytes of an output differ from its
    /// record. `Some`: they match; contains the failed checks of the frame, if any. If an output has no
    /// record, or a record with another provenance, records its current state.
    pub(crate) fn recorded_fault(&self, paths: &[PathBuf]) -> Option<Option<String>> {
        let mut faults = Vec::new();
        for path in paths {
            faults.extend(self.recorded_fault_of(path)?);
        }
        Some(faults.into_iter().next())
    }

    fn recorded_fault_of(&self, path: &Path) -> Option<Option<String>> {
        let recorded = self.known().get(path).cloned();
        let now = match &recorded {
            Some(recorded) => recorded.state.now(path),
            None => OutputState::of_path(path),
        }
        .ok()?;
        if let Some(recorded) = &recorded
            && recorded.state == now
        {
            return Some(recorded.fault.clone());
        }
        let made_from = made_from(path);
        let is_of_other =
            |recorded: &Record| !recorded.made_from.is_empty() && recorded.made_from != made_from;
        let fault = match recorded.filter(|recorded| !is_of_other(recorded)) {
            Some(recorded) if recorded.state.hash != now.hash => return None,
            recorded => recorded.and_then(|recorded| recorded.fault),
        };
        self.insert_record(path, now, made_from, fault.clone());
        Some(fault)
    }

    fn insert_record(&self, path: &Path, state: OutputState, made_from: String, fault: Option<String>) {
        self.known().insert(path.to_owned(), Record { state, made_from, fault, is_loaded: false });
    }

    /// Each update is a single insertion or removal, so a map whose lock is poisoned is still consistent.
    fn known(&self) -> MutexGuard<'_, HashMap<PathBuf, Record>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads the records of a folder of outputs. A file that cannot be read counts as missing.
    pub fn load(&self, folder: &Path) {
        let records = read_records(folder).into_iter();
        self.known().extend(records.map(|(file, record)| (folder.join(file), record)));
    }

    /// Writes the records of the outputs in a folder that still exist, atomically. Keeps records that another
    /// process has written since they were loaded, unless this process has written or compared their outputs
    /// since it last saved.
    ///
    /// # Errors
    /// When the system reports an error, or another process keeps the records locked.
    pub fn save(&self, folder: &Path) -> io::Result<()> {
        let is_own =
            |(path, record): &(&PathBuf, &Record)| path.parent() == Some(folder) && !record.is_loaded;
        let own: Vec<(PathBuf, Record)> =
            self.known().iter().filter(is_own).map(|(path, record)| (path.clone(), record.clone())).collect();
        // JSON cannot represent names that are not Unicode, so these have no record.
        let named = |(path, record): &(PathBuf, Record)| {
            Some((path.file_name()?.to_str()?.to_owned(), record.clone()))
        };
        let changed: BTreeMap<String, Record> = own.iter().filter_map(named).collect();
        if changed.is_empty() {
            return Ok(());
        }
        let path = records_path(folder);
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let lock = lock_records(&path)?;
        let mut all = read_records(folder);
        all.extend(changed);
        all.retain(|file, _| folder.join(file).exists());
        let outputs = all.into_iter().map(|(file, record)| NamedRecord { file, record }).collect();
        let file = RecordsFile { meniscus_outputs: VERSION, outputs };
        replace_own(&path, |out| {
            serde_json::to_writer(&mut *out, &file)?;
            out.write_all(b"\n")
        })?;
        drop(lock);
        let mut known = self.known();
        for (path, saved) in own {
            // A record that changed meanwhile is saved next time.
            if let Some(record) = known.get_mut(&path)
                && record.state == saved.state
                && record.fault == saved.fault
            {
                record.is_loaded = true;
            }
        }
        Ok(())
    }
}

/// How many times to try to lock records that another process has locked, and the pause after each attempt.
const LOCK_ATTEMPTS_MAX: usize = 100;
const LOCK_PAUSE: Duration = Duration::from_millis(20);

/// Locks the records of a folder against other processes, until the returned file is dropped. On a file
/// system without locks, returns the file unlocked.
///
/// # Errors
/// When the system reports an error; [`io::ErrorKind::WouldBlock`] if another process has held the lock for
/// seconds.
fn lock_records(records: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    let options = options.read(true).write(true).create(true).truncate(false);
    let file = open_own(&records.with_extension("lock"), options)?;
    for attempt in 1..=LOCK_ATTEMPTS_MAX {
        match file.try_lock() {
            Err(TryLockError::WouldBlock) if attempt < LOCK_ATTEMPTS_MAX => thread::sleep(LOCK_PAUSE),
            Err(TryLockError::WouldBlock) => break,
            Err(TryLockError::Error(error)) if error.kind() != io::ErrorKind::Unsupported => {
                return Err(error);
            }
            _ => return Ok(file),
        }
    }
    Err(io::Error::new(io::ErrorKind::WouldBlock, "another process keeps the records locked"))
}

/// The hash of an output's provenance, in hexadecimal digits; empty if it cannot be read.
fn made_from(path: &Path) -> String {
    let read = || {
        let format = OutputFormat::from_extension(path.extension()?.to_str()?)?;
        read_provenance(format, open_regular(path).ok()?).ok()
    };
    let Some(recorded) = read() else { return String::new() };
    let text: String = recorded.iter().map(|(name, value)| format!("{name}={value}\n")).collect();
    format!("{:032x}", XxHash3_128::oneshot(text.as_bytes()))
}

/// The records in the file of a folder, by the names of the outputs; empty if it cannot be read.
fn read_records(folder: &Path) -> BTreeMap<String, Record> {
    let Ok(Some((bytes, _))) = read_start_unchanged(&records_path(folder), SIZE_MAX_BYTES) else {
        return BTreeMap::new();
    };
    let file = serde_json::from_slice::<RecordsFile>(&bytes).ok();
    let records =
        file.filter(|file| file.meniscus_outputs == VERSION).map_or(Vec::new(), |file| file.outputs);
    // A name with folders in it is not an output of this folder.
    let is_name = |named: &NamedRecord| Path::new(&named.file).file_name() == Some(named.file.as_ref());
    let loaded = records.into_iter().filter(is_name);
    loaded.map(|NamedRecord { file, record }| (file, Record { is_loaded: true, ..record })).collect()
}

/// Maximum size of the file; this program does not write a larger one.
const SIZE_MAX_BYTES: u64 = 1 << 30;

/// The version of the file format. Increase it when the format changes.
const VERSION: u32 = 2;

fn records_path(folder: &Path) -> PathBuf {
    folder.join(".meniscus").join("outputs.json")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const FAULT: &str = "failed validation";

    fn fault_of(states: &OutputStates, path: &Path) -> Option<Option<String>> {
        states.recorded_fault(&[path.to_owned()])
    }

    fn touch_with(path: &Path, bytes: &[u8]) {
        fs::write(path, bytes).expect("written");
        let file = fs::File::options().write(true).open(path).expect("opened");
        file.set_modified(std::time::UNIX_EPOCH + std::time::Duration::from_secs(1)).expect("set");
    }

    #[test]
    fn flipped_byte_is_noticed_and_touched_output_is_not_damage() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        fs::write(&path, "mesh").expect("written");
        let states = OutputStates::default();
        states.record(std::slice::from_ref(&path), None);
        assert_eq!(fault_of(&states, &path), Some(None));
        touch_with(&path, b"mesh");
        assert_eq!(fault_of(&states, &path), Some(None), "the same bytes under another time");
        touch_with(&path, b"mEsh");
        assert_eq!(fault_of(&states, &path), None, "other bytes");
        fs::remove_file(&path).expect("removed");
        assert_eq!(fault_of(&states, &path), None, "missing");
    }

    #[test]
    fn records_of_a_folder_are_saved_and_loaded() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        fs::write(&path, "mesh").expect("written");
        let states = OutputStates::default();
        states.record(std::slice::from_ref(&path), None);
        states.save(folder.path()).expect("saved");
        let loaded = OutputStates::default();
        loaded.load(folder.path());
        assert_eq!(loaded.take(&path), states.take(&path));
        // A damaged file of records counts as none.
        fs::write(records_path(folder.path()), "{").expect("written");
        loaded.load(folder.path());
        assert_eq!(loaded.take(&path), None);
    }

    /// A mesh with provenance.
    fn write_output(path: &Path, input_hash: &str, end: &str) {
        let text = format!("# meniscus 0.1.0\n# meniscus_input_hash: {input_hash}\n{end}\n");
        fs::write(path, text).expect("written");
    }

    #[test]
    fn record_of_an_earlier_file_is_ignored_and_one_of_the_same_provenance_is_not() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.obj");
        write_output(&path, "1", "v 0 0 0");
        let known = made_from(&path);
        let earlier = OutputStates::default();
        earlier.record(std::slice::from_ref(&path), Some(FAULT));
        earlier.save(folder.path()).expect("saved");
        // Another run of the program wrote the file again, and recorded nothing.
        write_output(&path, "22", "v 1 1 1");
        assert_ne!(made_from(&path), known, "another provenance");
        let loaded = OutputStates::default();
        loaded.load(folder.path());
        assert_eq!(fault_of(&loaded, &path), Some(None), "its own provenance decides");
        write_output(&path, "1", "v 1 1 11");
        let loaded = OutputStates::default();
        loaded.load(folder.path());
        assert_eq!(fault_of(&loaded, &path), None, "other bytes of the same provenance");
    }

    #[test]
    fn fault_of_a_frame_is_returned_also_after_its_outputs_are_copied() {
        let folder = tempfile::tempdir().expect("a folder");
        let paths = ["a.glb", "a.obj"].map(|name| folder.path().join(name));
        paths.iter().for_each(|path| write_output(path, "1", "v 0 0 0"));
        let states = OutputStates::default();
        states.record(&paths, Some(FAULT));
        states.save(folder.path()).expect("saved");
        for round in 0..2 {
            let loaded = OutputStates::default();
            loaded.load(folder.path());
            assert!(loaded.has_any(&paths));
            assert_eq!(loaded.recorded_fault(&paths), Some(Some(FAULT.to_owned())), "round {round}");
            fs::copy(&paths[1], folder.path().join("copy")).expect("copied");
            fs::rename(folder.path().join("copy"), &paths[1]).expect("renamed");
            assert_eq!(loaded.recorded_fault(&paths), Some(Some(FAULT.to_owned())), "round {round}");
            loaded.save(folder.path()).expect("saved");
        }
        // Records of older versions have no field `fault`.
        let records = fs::read_to_string(records_path(folder.path())).expect("records");
        let old = records.replace(&format!(",\"fault\":\"{FAULT}\""), "");
        assert_ne!(old, records);
        fs::write(records_path(folder.path()), old).expect("written");
        let loaded = OutputStates::default();
        loaded.load(folder.path());
        assert_eq!(loaded.recorded_fault(&paths), Some(None));
    }

    #[test]
    fn saved_record_does_not_replace_a_later_one_of_another_process() {
        let folder = tempfile::tempdir().expect("a folder");
        let paths = ["a.obj", "b.obj"].map(|name| folder.path().join(name));
        paths.iter().for_each(|path| write_output(path, "1", "v 0 0 0"));
        let [one, other] = [OutputStates::default(), OutputStates::default()];
        one.record(&paths[..1], None);
        one.save(folder.path()).expect("saved");
        other.record(&paths[..1], Some(FAULT));
        other.save(folder.path()).expect("saved");
        one.record(&paths[1..], None);
        one.save(folder.path()).expect("saved");
        let loaded = OutputStates::default();
        loaded.load(folder.path());
        assert_eq!(fault_of(&loaded, &paths[0]), Some(Some(FAULT.to_owned())));
        assert_eq!(fault_of(&loaded, &paths[1]), Some(None));
    }

    #[test]
    #[cfg(unix)]
    fn records_are_not_written_through_a_link() {
        let folders = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
        let [folder, elsewhere] = folders.each_ref().map(tempfile::TempDir::path);
        let path = folder.join("a.obj");
        write_output(&path, "1", "v 0 0 0");
        std::os::unix::fs::symlink(elsewhere, folder.join(".meniscus")).expect("linked");
        let states = OutputStates::default();
        states.record(&[path], None);
        let refused = states.save(folder).expect_err("refused").to_string();
        assert!(refused.contains(".meniscus is a symbolic link"), "{refused}");
        assert_eq!(fs::read_dir(elsewhere).expect("there").count(), 0);
    }

    #[test]
    fn saved_records_are_merged_with_those_of_another_process() {
        let folder = tempfile::tempdir().expect("a folder");
        let paths = ["a.obj", "b.obj"].map(|name| folder.path().join(name));
        paths.iter().for_each(|path| write_output(path, "1", "v 0 0 0"));
        let [one, other] = [OutputStates::default(), OutputStates::default()];
        one.record(&paths[..1], None);
        other.record(&paths[1..], None);
        one.save(folder.path()).expect("saved");
        other.save(folder.path()).expect("saved");
        let loaded = OutputStates::default();
        loaded.load(folder.path());
        assert_eq!(loaded.take(&paths[0]), one.take(&paths[0]));
        assert_eq!(loaded.take(&paths[1]), other.take(&paths[1]));
    }
}
