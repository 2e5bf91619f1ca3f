//! The folders of the outputs: locked, swept, and each with its journal.

use std::collections::{HashMap, HashSet};
use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::pipeline::sweep_temporaries;

use super::DaemonError;
use super::config::{Config, Patience, Watch};
use super::journal::{Journal, PlanRecord, STATE_FOLDER};
use super::lock::{LockError, OutputLock};
use super::mounts::RootIdentity;

/// A folder of outputs that is this daemon's alone.
#[derive(Debug)]
pub(super) struct Store {
    /// Absolute.
    pub(super) folder: PathBuf,
    pub(super) journal: Journal,
    /// What was to be written last could not be.
    is_journal_stuck: bool,
    locks: Vec<OutputLock>,
    /// Which file system it was on when it was opened.
    identity: RootIdentity,
}

/// Whether a folder of outputs is still the one that was opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Presence {
    /// It is.
    There,
    /// Somebody removed it, and what was in it.
    Removed,
    /// Another file system is in its place: its own is not mounted.
    Elsewhere,
}

/// All folders of outputs, and which watch writes into which.
#[derive(Debug)]
pub(super) struct Stores {
    all: Vec<Store>,
    of_watch: Vec<usize>,
}

impl Stores {
    /// Makes the folders, locks them, reads their journals, and removes what an earlier run that was
    /// killed left half written.
    ///
    /// # Errors
    /// When a folder cannot be made, or another daemon has it.
    pub(super) fn open(config: &Config) -> Result<Stores, DaemonError> {
        let mut stores = Stores { all: Vec::new(), of_watch: Vec::new() };
        for watch in &config.watches {
            let folder = open_folder(&watch.outputs.folder)?;
            let known = stores.all.iter().position(|store| store.folder == folder);
            let index = match known {
                Some(index) => index,
                None => {
                    stores.all.push(Store::open(folder, config.journal.as_deref())?);
                    stores.all.len() - 1
                }
            };
            stores.of_watch.push(index);
        }
        Ok(stores)
    }

    /// Where this watch writes.
    pub(super) fn of_watch(&self, watch: usize) -> &Store {
        &self.all[self.of_watch[watch]]
    }

    /// The same, to be written to.
    pub(super) fn of_watch_mut(&mut self, watch: usize) -> &mut Store {
        &mut self.all[self.of_watch[watch]]
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Store> {
        self.all.iter()
    }

    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut Store> {
        self.all.iter_mut()
    }

    /// Writes down, beside each folder of outputs, which of the `watches` write into it.
    pub(super) fn note_plan(&mut self, watches: &[Watch], patience: Patience) {
        for (index, store) in self.all.iter_mut().enumerate() {
            let of_store = watches.iter().zip(&self.of_watch).filter(|(_, of)| **of == index);
            let watches = of_store.map(|(watch, _)| watch.clone()).collect();
            if let Err(error) = store.journal.note_plan(PlanRecord { watches, patience }) {
                tracing::warn!(folder = %store.folder.display(), "cannot write the journal: {error}");
            }
        }
    }
}

fn open_folder(folder: &Path) -> Result<PathBuf, DaemonError> {
    let make = || {
        fs::create_dir_all(folder)?;
        folder.canonicalize()
    };
    make().map_err(|source| DaemonError::Folder { folder: folder.to_owned(), source })
}

impl Store {
    fn open(folder: PathBuf, journal: Option<&Path>) -> Result<Store, DaemonError> {
        let mut locks = vec![OutputLock::take(&folder).map_err(DaemonError::Locked)?];
        let journal_folder = match journal {
            None => folder.join(STATE_FOLDER),
            Some(elsewhere) => {
                // A journal, too, is written by one daemon only.
                locks.push(OutputLock::take(elsewhere).map_err(DaemonError::Locked)?);
                elsewhere.to_owned()
            }
        };
        let failed = |source| DaemonError::Folder { folder: folder.clone(), source };
        let identity = RootIdentity::of(&folder).map_err(failed)?;
        let journal = Journal::open(&journal_folder).map_err(failed)?;
        match sweep(&folder) {
            Ok(0) => {}
            Ok(count) => tracing::info!(folder = %folder.display(), "removed {count} half-written files"),
            Err(error) => {
                tracing::warn!(folder = %folder.display(), "cannot look for half-written files: {error}");
            }
        }
        Ok(Store { folder, journal, is_journal_stuck: false, locks, identity })
    }

    /// Whether the folder is still there. What was in a folder whose file system was unmounted will come
    /// back with it; what was removed is gone.
    pub(super) fn presence(&self) -> Presence {
        let there = self.folder.ancestors().find_map(|folder| RootIdentity::of(folder).ok());
        match there {
            Some(identity) if identity != self.identity => Presence::Elsewhere,
            _ if self.folder.join(STATE_FOLDER).is_dir() => Presence::There,
            _ => Presence::Removed,
        }
    }

    /// Makes the folder again that somebody removed.
    ///
    /// # Errors
    /// When the system refuses, or somebody else has the folder now.
    pub(super) fn make_again(&mut self) -> Result<(), LockError> {
        self.locks[0] = OutputLock::take(&self.folder)?;
        Ok(())
    }

    /// Writes something down. A journal that cannot be written costs work after a restart and nothing
    /// else; it is told once, not for every line, and once more when it can be written again.
    pub(super) fn write_down(&mut self, write: impl FnOnce(&mut Journal) -> io::Result<()>) {
        let written = write(&mut self.journal);
        let was_stuck = std::mem::replace(&mut self.is_journal_stuck, written.is_err());
        match written {
            Err(error) if !was_stuck => {
                tracing::warn!(folder = %self.folder.display(), "cannot write the journal: {error}");
            }
            Ok(()) if was_stuck => {
                tracing::info!(folder = %self.folder.display(), "the journal is written again")
            }
            _ => {}
        }
    }
}

/// Removes the temporaries of a folder and all below it that nobody is writing.
fn sweep(folder: &Path) -> io::Result<usize> {
    let mut swept = sweep_temporaries(folder)?;
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        // Links are not followed: what they lead to is not ours to sweep.
        if entry.file_type()?.is_dir() && !entry.file_name().as_encoded_bytes().starts_with(b".") {
            swept += sweep(&entry.path())?;
        }
    }
    Ok(swept)
}

/// Whether files are there. During a scan, when thousands of outputs are asked for, each folder is
/// listed once.
#[derive(Debug, Default)]
pub(super) struct Listings {
    names_in: Option<HashMap<PathBuf, HashSet<OsString>>>,
}

impl Listings {
    /// From now on, folders are listed once, and believed.
    pub(super) fn begin(&mut self) {
        self.names_in = Some(HashMap::new());
    }

    /// From now on, the system is asked for each file.
    pub(super) fn end(&mut self) {
        self.names_in = None;
    }

    /// Whether there is such a file.
    pub(super) fn has(&mut self, path: &Path) -> bool {
        let Some(names_in) = &mut self.names_in else { return path.symlink_metadata().is_ok() };
        let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else { return false };
        if let Some(names) = names_in.get(folder) {
            return names.contains(name);
        }
        let names: HashSet<OsString> =
            fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.file_name()).collect();
        let has = names.contains(name);
        names_in.insert(folder.to_owned(), names);
        has
    }
}
