//! The system's word that something has changed in a folder: hints where to look, never what is there.
//!
//! ```text
//!   kernel ─▶ its queue ─▶ notify's thread ─▶ our queue ─▶ whoever watches
//!             may overflow                    may be full: the last place is for `Rescan`
//! ```
//!
//! Only scans say what is there. To miss nothing, watch a folder first and scan it then: what appears
//! in between is found by both, and what was there before by the scan.
//!
//! **Nothing here waits.** The kernel's queue has 16 384 places, and what comes when it is full is lost;
//! so ours is never waited for. Its last place is kept for the hint that others were lost. As long as
//! that one has not been taken out, whatever is lost was there before the scan that it asks for.
//!
//! **Folders by their true names.** The kernel watches folders, not paths. One that is reached by two
//! paths is watched once, and what happens there is told for both.
//!
//! Reading a file makes events as well. They are dropped, else every look would cause the next.

use std::collections::HashMap;
use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crossbeam::channel::{Receiver, Sender, bounded};
use notify::event::{AccessKind, AccessMode, EventKind, ModifyKind, RenameMode};
use notify::{ErrorKind, Event, RecommendedWatcher, RecursiveMode};

/// What may have changed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Hint {
    /// A file appeared, grew, or went.
    Changed(PathBuf),
    /// A file was renamed to this name, and has all that it had under the other one.
    Renamed(PathBuf),
    /// A folder appeared, went, or is another one now. If it is there, it must be watched, even if it was.
    Folder(PathBuf),
    /// Hints were lost: only looking everywhere tells.
    Rescan,
}

/// Why a folder cannot be watched.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WatchError {
    /// The system has no more room for this user's watches. Says what to do.
    TooMany(String),
    /// There is no such folder.
    Gone,
    /// Anything else.
    Other(String),
}

impl fmt::Display for WatchError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            WatchError::TooMany(what) | WatchError::Other(what) => f.write_str(what),
            WatchError::Gone => f.write_str("there is no such folder"),
        }
    }
}

impl std::error::Error for WatchError {}

/// Watches folders, each without those in it.
#[derive(Debug)]
pub struct Watcher {
    notify: RecommendedWatcher,
    folders: Arc<Mutex<Folders>>,
}

/// Hints that wait to be taken.
const CAPACITY: usize = 4096;

impl Watcher {
    /// A watcher, and what it hears.
    ///
    /// # Errors
    /// When the system has no more of what it takes.
    pub fn new() -> Result<(Watcher, Receiver<Hint>), WatchError> {
        Watcher::with_capacity(CAPACITY)
    }

    fn with_capacity(capacity: usize) -> Result<(Watcher, Receiver<Hint>), WatchError> {
        let (queue, hints) = bounded(capacity);
        let folders = Arc::new(Mutex::new(Folders::default()));
        let mut listener = Listener { queue, capacity, last: None, folders: folders.clone() };
        let notify = notify::recommended_watcher(move |event| listener.hear(event)).map_err(watch_error)?;
        Ok((Watcher { notify, folders }, hints))
    }

    /// Watches a folder. Hints name what is in it by the path that is given here. A folder may be watched
    /// again: it must be if another one has taken its place.
    ///
    /// # Errors
    /// When the folder is not there, or the system refuses.
    pub fn watch(&mut self, folder: &Path) -> Result<(), WatchError> {
        let place = Place::of(folder).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::NotADirectory => WatchError::Gone,
            _ => WatchError::Other(error.to_string()),
        })?;
        // The one that had this path may live on elsewhere, and would be heard under its old name.
        if lock(&self.folders).place_of.get(folder).is_some_and(|known| *known != place) {
            self.unwatch(folder);
        }
        let path = place.path.clone();
        // First, so that the first event is understood.
        lock(&self.folders).add(folder, place);
        self.notify.watch(&path, RecursiveMode::NonRecursive).map_err(|error| {
            lock(&self.folders).remove(folder);
            watch_error(error)
        })
    }

    /// Watches a folder no longer.
    pub fn unwatch(&mut self, folder: &Path) {
        let unused = lock(&self.folders).remove(folder);
        if let Some(path) = unused {
            // One that is gone is not watched any more.
            let _ = self.notify.unwatch(&path);
        }
    }
}

/// The folders that are watched.
#[derive(Debug, Default)]
struct Folders {
    /// Where each path leads.
    place_of: HashMap<PathBuf, Place>,
    /// The paths that lead to each true name.
    paths_to: HashMap<PathBuf, Vec<PathBuf>>,
}

/// A folder, by whatever path it was reached.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Place {
    /// Its true name.
    path: PathBuf,
    /// Which folder that is; 0 where there is no such number.
    inode: u64,
}

impl Place {
    fn of(folder: &Path) -> io::Result<Place> {
        let path = folder.canonicalize()?;
        let metadata = fs::metadata(&path)?;
        match metadata.is_dir() {
            true => Ok(Place { path, inode: crate::pipeline::FileStamp::of(&metadata).inode }),
            false => Err(io::ErrorKind::NotADirectory.into()),
        }
    }
}

impl Folders {
    fn add(&mut self, folder: &Path, place: Place) {
        let paths = self.paths_to.entry(place.path.clone()).or_default();
        if !paths.iter().any(|path| path == folder) {
            paths.push(folder.to_owned());
        }
        self.place_of.insert(folder.to_owned(), place);
    }

    /// Forgets a path; tells the true name if no other leads there.
    fn remove(&mut self, folder: &Path) -> Option<PathBuf> {
        let Place { path, .. } = self.place_of.remove(folder)?;
        let paths = self.paths_to.get_mut(&path)?;
        paths.retain(|path| path != folder);
        if !paths.is_empty() {
            return None;
        }
        self.paths_to.remove(&path);
        Some(path)
    }

    /// What is called `path` by its true name, as it was asked for: as a folder that is watched, and as
    /// something in such folders.
    fn asked_for(&self, path: &Path) -> Vec<PathBuf> {
        let itself = self.paths_to.get(path).into_iter().flatten().cloned();
        let within = path.parent().zip(path.file_name()).and_then(|(folder, name)| {
            Some(self.paths_to.get(folder)?.iter().map(move |folder| folder.join(name)))
        });
        let mut paths: Vec<PathBuf> = itself.chain(within.into_iter().flatten()).collect();
        paths.dedup();
        paths
    }
}

/// A map of paths is in order whatever panicked beside it.
fn lock(folders: &Mutex<Folders>) -> MutexGuard<'_, Folders> {
    folders.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What notify's thread calls. It alone puts hints into the queue.
struct Listener {
    queue: Sender<Hint>,
    capacity: usize,
    /// The hint that was put into the queue last.
    last: Option<Hint>,
    folders: Arc<Mutex<Folders>>,
}

impl Listener {
    fn hear(&mut self, event: notify::Result<Event>) {
        match event {
            Ok(event) if event.need_rescan() => self.tell(Hint::Rescan),
            Ok(event) => self.hear_event(event),
            Err(error) => {
                tracing::warn!(%error, "the system's word on changes was lost");
                self.tell(Hint::Rescan);
            }
        }
    }

    fn hear_event(&mut self, event: Event) {
        let Some(meaning) = meaning(event.kind) else { return };
        if event.paths.is_empty() {
            self.tell(Hint::Rescan);
        }
        for path in event.paths {
            // Followed, as a link to a folder is one. What is gone was one if it was watched.
            let is_there = meaning != Meaning::Went && path.is_dir();
            let hints: Vec<Hint> = {
                let folders = lock(&self.folders);
                let hint = |path: PathBuf| match meaning {
                    _ if is_there || folders.place_of.contains_key(&path) => Hint::Folder(path),
                    Meaning::FolderChanged => Hint::Folder(path),
                    Meaning::Renamed => Hint::Renamed(path),
                    Meaning::Changed | Meaning::Went => Hint::Changed(path),
                };
                folders.asked_for(&path).into_iter().map(hint).collect()
            };
            hints.into_iter().for_each(|hint| self.tell(hint));
        }
    }

    /// Puts a hint into the queue, or, if there is one place left, that hints were lost.
    fn tell(&mut self, hint: Hint) {
        // The same one is there already, and nobody has acted on it.
        if !self.queue.is_empty() && self.last.as_ref() == Some(&hint) {
            return;
        }
        let hint = if self.queue.len() + 1 < self.capacity { hint } else { Hint::Rescan };
        // Only `Rescan` takes the last place: if there is none left, it is the last in the queue.
        if self.queue.try_send(hint.clone()).is_ok() {
            self.last = Some(hint);
        }
    }
}

/// What an event says of its path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Meaning {
    Changed,
    Renamed,
    Went,
    FolderChanged,
}

/// `None` for what need not be looked at.
fn meaning(kind: EventKind) -> Option<Meaning> {
    use notify::event::{CreateKind, RemoveKind};
    Some(match kind {
        // Opened, or closed after reading, by us as by others.
        EventKind::Access(AccessKind::Close(AccessMode::Write)) => Meaning::Changed,
        EventKind::Access(_) => return None,
        EventKind::Create(CreateKind::Folder) | EventKind::Remove(RemoveKind::Folder) => {
            Meaning::FolderChanged
        }
        EventKind::Remove(_) | EventKind::Modify(ModifyKind::Name(RenameMode::From)) => Meaning::Went,
        EventKind::Modify(ModifyKind::Name(RenameMode::To)) => Meaning::Renamed,
        // Both sides were told before, one by one.
        EventKind::Modify(ModifyKind::Name(RenameMode::Both)) => return None,
        EventKind::Create(_) | EventKind::Modify(_) | EventKind::Any | EventKind::Other => Meaning::Changed,
    })
}

fn watch_error(error: notify::Error) -> WatchError {
    const TOO_MANY_OPEN_FILES: i32 = 24; // EMFILE, on every Unix
    match &error.kind {
        ErrorKind::PathNotFound => WatchError::Gone,
        ErrorKind::MaxFilesWatch => WatchError::TooMany(
            "the system watches no more folders for this user: raise fs.inotify.max_user_watches".into(),
        ),
        ErrorKind::Io(source) if source.raw_os_error() == Some(TOO_MANY_OPEN_FILES) => WatchError::TooMany(
            "too many programs of this user watch folders, or too many files are open: \
             raise fs.inotify.max_user_instances, or the limit of open files"
                .into(),
        ),
        ErrorKind::Io(source) if source.kind() == io::ErrorKind::NotFound => WatchError::Gone,
        _ => WatchError::Other(error.to_string()),
    }
}
