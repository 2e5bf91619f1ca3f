//! The folders of the outputs: locked, swept, and each with its journal.

use std::collections::{HashMap, HashSet};
use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::pipeline::{make_out_folder, sweep_temporaries};

use super::DaemonError;
use super::config::{Config, Patience, Watch};
use super::journal::{FILE_NAME as JOURNAL_FILE_NAME, Journal, PlanRecord, STATE_FOLDER};
use super::lock::{FILE_NAME as LOCK_FILE_NAME, LockError, OutputLock};
use super::mounts::RootIdentity;

/// A folder of outputs that is this daemon's alone.
#[derive(Debug)]
pub(super) struct Store {
    /// Absolute.
    pub(super) folder: PathBuf,
    pub(super) journal: Journal,
    /// When the journal could not be written, if it could not the last time.
    journal_stuck_at: Option<Instant>,
    /// Nothing is written into what is in its place.
    is_there: bool,
    lock: OutputLock,
    /// That of a journal that lies elsewhere: it, too, is written by one daemon only.
    _journal_lock: Option<OutputLock>,
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
            store.write_down(|journal| journal.note_plan(PlanRecord { watches, patience }));
        }
    }
}

fn open_folder(folder: &Path) -> Result<PathBuf, DaemonError> {
    make_out_folder(folder).map_err(DaemonError::Out)?;
    folder.canonicalize().map_err(|source| DaemonError::Folder { folder: folder.to_owned(), source })
}

impl Store {
    fn open(folder: PathBuf, journal: Option<&Path>) -> Result<Store, DaemonError> {
        let lock = OutputLock::take(&folder).map_err(DaemonError::Locked)?;
        // What was asked for may be a link, and what has a name of ours may not.
        let asked = journal.map(|asked| asked.canonicalize().unwrap_or_else(|_| asked.to_owned()));
        let journal_folder = asked.unwrap_or_else(|| folder.join(STATE_FOLDER));
        let is_elsewhere = journal_folder.canonicalize().is_ok_and(|journal| !journal.starts_with(&folder));
        let journal_lock = match is_elsewhere || !journal_folder.exists() {
            true => Some(OutputLock::take(&journal_folder).map_err(DaemonError::Locked)?),
            false => None,
        };
        let failed = |source| DaemonError::Folder { folder: folder.clone(), source };
        let identity = RootIdentity::of(&folder).map_err(failed)?;
        let journal = Journal::open(&journal_folder).map_err(|source| DaemonError::Folder {
            folder: journal_folder.join(JOURNAL_FILE_NAME),
            source,
        })?;
        match sweep(&folder) + sweep_one(&journal_folder) {
            0 => {}
            count => tracing::info!(folder = %folder.display(), "removed {count} half-written files"),
        }
        Ok(Store {
            folder,
            journal,
            journal_stuck_at: None,
            is_there: true,
            lock,
            _journal_lock: journal_lock,
            identity,
        })
    }

    /// Whether the folder is still there. What was in a folder whose file system was unmounted will come
    /// back with it; what was removed is gone.
    pub(super) fn presence(&self) -> Presence {
        if self.lock.is_in_place(&self.folder) {
            return Presence::There;
        }
        let nearest = self.folder.ancestors().find_map(|folder| RootIdentity::of(folder).ok());
        // `convert --skip-done` makes a folder of this name as well; these files are the daemon's alone.
        let state = self.folder.join(STATE_FOLDER);
        let is_back = [LOCK_FILE_NAME, JOURNAL_FILE_NAME].iter().any(|name| state.join(name).is_file());
        match nearest == Some(self.identity) || is_back {
            true => Presence::Removed,
            false => Presence::Elsewhere,
        }
    }

    /// Makes the folder ours again that somebody removed, or that came back.
    ///
    /// # Errors
    /// When the system refuses, or somebody else has the folder now.
    pub(super) fn make_again(&mut self) -> Result<(), LockError> {
        self.lock = OutputLock::take(&self.folder)?;
        if let Ok(identity) = RootIdentity::of(&self.folder) {
            self.identity = identity;
        }
        Ok(())
    }

    /// Whether anything may be written into it.
    pub(super) fn set_there(&mut self, is_there: bool) {
        self.is_there = is_there;
    }

    /// Writes something down. A journal that cannot be written costs work after a restart and nothing
    /// else; it is told once, not for every line, and once more when it can be written again.
    pub(super) fn write_down(&mut self, write: impl FnOnce(&mut Journal) -> io::Result<()>) {
        let is_too_soon = self.journal_stuck_at.is_some_and(|at| at.elapsed() < JOURNAL_RETRY);
        self.journal.hold(!self.is_there || is_too_soon);
        let written = write(&mut self.journal);
        if !self.is_there || is_too_soon {
            return;
        }
        match (written, self.journal_stuck_at) {
            (Ok(()), None) => {}
            (Ok(()), Some(_)) => {
                tracing::info!(folder = %self.folder.display(), "the journal is written again");
                self.journal_stuck_at = None;
            }
            (Err(error), stuck_at) => {
                if stuck_at.is_none() {
                    tracing::warn!(folder = %self.folder.display(), "cannot write the journal: {error}");
                }
                self.journal_stuck_at = Some(Instant::now());
            }
        }
    }
}

/// How soon a journal that could not be written is tried again.
const JOURNAL_RETRY: Duration = Duration::from_secs(1);

/// Removes the temporaries of a folder and all below it that nobody is writing; how many there were. A
/// folder that cannot be looked into keeps its own.
fn sweep(folder: &Path) -> usize {
    let mut count = sweep_one(folder);
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    // Links are not followed: what they lead to is not ours to sweep.
    let folders = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
    for inner in folders.filter(|entry| !entry.file_name().as_encoded_bytes().starts_with(b".")) {
        count += sweep(&inner.path());
    }
    count
}

/// The same of a folder without those below it.
fn sweep_one(folder: &Path) -> usize {
    let cannot = |error| {
        tracing::warn!(folder = %folder.display(), "cannot look for half-written files: {error}");
    };
    let swept = sweep_temporaries(folder).map_err(cannot).unwrap_or_default();
    for warning in swept.warnings {
        tracing::warn!("{warning}");
    }
    swept.count
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
