//! Remembers which bytes outputs were written with, so that later damage is noticed.
//!
//! ```text
//!   stamp as recorded            ─▶ unchanged, not read
//!   another stamp, same hash     ─▶ unchanged: touched, copied or restored; the new stamp is recorded
//!   another stamp, another hash  ─▶ damaged: the frame is converted again
//! ```
//!
//! What an output says about its origin cannot reveal a flipped byte in its middle; its hash can. Hashes are only
//! computed when an output is written and when its stamp differs from the recorded one.
//!
//! The daemon keeps these records in its journal. `convert --skip-done` keeps them in `.meniscus/outputs.json` in the
//! folder of the outputs; losing that file costs nothing but this check.

use std::collections::HashMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};

use super::reading::{InputFile, read_start_unchanged};
use super::sink::write_whole;
use super::stamp::FileStamp;

/// The stamp and the content hash of an output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutputState {
    /// What the file system says about the file.
    pub stamp: FileStamp,
    /// The hash of its bytes.
    pub hash: u128,
}

impl OutputState {
    /// The state of the file at `path`; its bytes are read.
    ///
    /// # Errors
    /// When the system refuses, or the file is not a regular file or changes meanwhile.
    pub fn of_path(path: &Path) -> io::Result<OutputState> {
        // Opening a pipe would wait for its other end.
        if !path.metadata()?.is_file() {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "not a regular file"));
        }
        let file = InputFile::open(path)?;
        let state = OutputState { stamp: file.stamp(), hash: file.hash()? };
        match file.is_unchanged()? {
            true => Ok(state),
            false => Err(io::Error::other("the file changed while it was read")),
        }
    }

    /// Whether the file at `path` has the recorded stamp, so that its bytes need not be read.
    pub fn has_stamp_of(&self, path: &Path) -> bool {
        FileStamp::of_path(path).is_ok_and(|now| self.stamp.still_holds(&now))
    }
}

/// The recorded states of outputs, by path. Shared between the threads of the pipeline and its caller.
#[derive(Debug, Default)]
pub struct OutputStates {
    known: Mutex<HashMap<PathBuf, OutputState>>,
}

impl OutputStates {
    /// Records the state of an output.
    pub fn put(&self, path: &Path, state: OutputState) {
        self.known().insert(path.to_owned(), state);
    }

    /// Removes and returns the recorded state of an output.
    pub fn take(&self, path: &Path) -> Option<OutputState> {
        self.known().remove(path)
    }

    /// Records the states of outputs that were just written. One that cannot be read back is left unrecorded.
    pub(super) fn record(&self, paths: &[PathBuf]) {
        for path in paths {
            match OutputState::of_path(path) {
                Ok(state) => self.put(path, state),
                Err(_) => drop(self.take(path)),
            }
        }
    }

    /// Whether each of these outputs has the bytes that were recorded. Of an output without a record, the present
    /// state is recorded.
    pub(super) fn are_as_recorded<'a>(&self, paths: impl IntoIterator<Item = &'a Path>) -> bool {
        paths.into_iter().all(|path| {
            let recorded = self.known().get(path).copied();
            if recorded.is_some_and(|recorded| recorded.has_stamp_of(path)) {
                return true;
            }
            let Ok(now) = OutputState::of_path(path) else { return false };
            let is_same = recorded.is_none_or(|recorded| recorded.hash == now.hash);
            if is_same {
                self.put(path, now);
            }
            is_same
        })
    }

    /// Each update is a single insertion or removal, so a map whose lock is poisoned is still consistent.
    fn known(&self) -> MutexGuard<'_, HashMap<PathBuf, OutputState>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads the records of a folder of outputs. A file that cannot be read counts as missing.
    pub fn load(&self, folder: &Path) {
        let Ok(Some((bytes, _))) = read_start_unchanged(&records_path(folder), SIZE_MAX_BYTES) else {
            return;
        };
        let Ok(file) = serde_json::from_slice::<RecordsFile>(&bytes) else { return };
        if file.meniscus_outputs != VERSION {
            return;
        }
        for record in file.outputs {
            let Ok(hash) = u128::from_str_radix(&record.hash, 16) else { continue };
            // A name with folders in it is not an output of this folder.
            if Path::new(&record.file).file_name() != Some(record.file.as_ref()) {
                continue;
            }
            let RecordWire { file, size_bytes: size, modified_ns, inode, changed_ns, .. } = record;
            let stamp = FileStamp { size, modified_ns, inode, changed_ns };
            self.put(&folder.join(file), OutputState { stamp, hash });
        }
    }

    /// Writes the records of the outputs in a folder that still exist, whole or not at all.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn save(&self, folder: &Path) -> meniscus_formats::Result<()> {
        let mut outputs: Vec<RecordWire> = self
            .known()
            .iter()
            .filter(|(path, _)| path.parent() == Some(folder) && path.exists())
            .filter_map(|(path, &OutputState { stamp, hash })| {
                // JSON has no form for names that are not text: those go without a record.
                let file = path.file_name()?.to_str()?.to_owned();
                let FileStamp { size: size_bytes, modified_ns, inode, changed_ns } = stamp;
                let hash = format!("{hash:032x}");
                Some(RecordWire { file, size_bytes, modified_ns, inode, changed_ns, hash })
            })
            .collect();
        if outputs.is_empty() {
            return Ok(());
        }
        outputs.sort_by(|one, other| one.file.cmp(&other.file));
        let path = records_path(folder);
        if let Some(folder) = path.parent() {
            // A link would lead the records elsewhere.
            if folder.is_symlink() {
                return Err(io::Error::other(format!("{} is a symbolic link", folder.display())).into());
            }
            std::fs::create_dir_all(folder)?;
        }
        let file = RecordsFile { meniscus_outputs: VERSION, outputs };
        write_whole(&path, |out| {
            serde_json::to_writer(&mut *out, &file).map_err(io::Error::from)?;
            Ok(out.write_all(b"\n")?)
        })
    }
}

/// A larger file is not one of ours.
const SIZE_MAX_BYTES: u64 = 1 << 30;

/// A change of the file's format needs another number.
const VERSION: u32 = 1;

#[derive(Serialize, Deserialize)]
struct RecordsFile {
    meniscus_outputs: u32,
    outputs: Vec<RecordWire>,
}

#[derive(Serialize, Deserialize)]
struct RecordWire {
    file: String,
    size_bytes: u64,
    modified_ns: i64,
    inode: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    changed_ns: Option<i64>,
    hash: String,
}

fn records_path(folder: &Path) -> PathBuf {
    folder.join(".meniscus").join("outputs.json")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

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
        states.record(std::slice::from_ref(&path));
        assert!(states.are_as_recorded([&*path]));
        touch_with(&path, b"mesh");
        assert!(states.are_as_recorded([&*path]), "the same bytes under another time");
        touch_with(&path, b"mEsh");
        assert!(!states.are_as_recorded([&*path]), "other bytes");
        fs::remove_file(&path).expect("removed");
        assert!(!states.are_as_recorded([&*path]), "missing");
    }

    #[test]
    fn records_of_a_folder_are_saved_and_loaded() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        fs::write(&path, "mesh").expect("written");
        let states = OutputStates::default();
        states.record(std::slice::from_ref(&path));
        states.save(folder.path()).expect("saved");
        let loaded = OutputStates::default();
        loaded.load(folder.path());
        assert_eq!(loaded.take(&path), states.take(&path));
        // A damaged file of records counts as none.
        fs::write(records_path(folder.path()), "{").expect("written");
        loaded.load(folder.path());
        assert_eq!(loaded.take(&path), None);
    }
}
