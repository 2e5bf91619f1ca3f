//! File-system events of watched folders. They say where to look, never what a file contains.
//!
//! ```text
//!   kernel ─▶ its queue ─▶ notify's thread ─▶ our queue ─▶ the receiver
//!             may overflow                    may be full: its last slot is for `Rescan`
//! ```
//!
//! Only scans establish what exists. To miss nothing, first watch a folder and then scan it. The scan finds
//! files that existed before, and files that appear in between are found by the scan and reported by events.
//!
//! **This module never blocks.** The kernel's queue has 16 384 entries and drops events when it is full, so
//! the thread that empties it must not wait for our queue. The last slot of our queue is reserved for
//! `Rescan`, which says that events were lost. Every event that is lost before the receiver takes the
//! `Rescan` precedes the requested scan, so the scan finds the change.
//!
//! The kernel watches folders, not paths. A folder that is reached by two paths is watched once, and its
//! events are reported for the path that was watched last; scans find the changes under the other.
//!
//! Reading a file also causes events. They are dropped; otherwise every inspection would cause the next one.

use std::collections::HashMap;
use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crossbeam::channel::{Receiver, Sender, bounded};
use notify::event::{AccessKind, AccessMode, CreateKind, EventKind, ModifyKind, RemoveKind, RenameMode};
use notify::{ErrorKind, Event, RecommendedWatcher, RecursiveMode, Watcher as _};

use crate::pipeline::FileId;
use crate::watch::core::completeness::FileHint;

/// A change that may have happened.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) enum FsEvent {
    /// A file appeared, changed, or was removed.
    File(PathBuf, FileHint),
    /// A folder appeared, was removed, or was replaced. If it exists, it must be watched, even if it was
    /// watched before.
    Folder(PathBuf),
    /// Events were lost: everything must be scanned.
    Rescan,
}

/// Why a folder cannot be watched.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum WatchError {
    /// The system's limit of watches for this user is reached. The text says what to do.
    TooMany(String),
    /// The folder does not exist.
    Missing,
    /// Any other error.
    Other(String),
}

impl fmt::Display for WatchError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            WatchError::TooMany(message) | WatchError::Other(message) => f.write_str(message),
            WatchError::Missing => f.write_str("the folder does not exist"),
        }
    }
}

impl std::error::Error for WatchError {}

/// Watches folders, each without its sub-folders.
#[derive(Debug)]
pub(crate) struct Watcher {
    notify: RecommendedWatcher,
    folders: WatchedFolders,
}

/// The watched folders, by the paths that lead to them.
type WatchedFolders = Arc<Mutex<HashMap<PathBuf, FileId>>>;

/// The capacity of the queue of events.
const CAPACITY: usize = 4096;

impl Watcher {
    /// Returns a watcher, and the receiver of its events.
    ///
    /// # Errors
    /// When a resource limit of the system is reached.
    pub(crate) fn new() -> Result<(Watcher, Receiver<FsEvent>), WatchError> {
        Watcher::with_capacity(CAPACITY)
    }

    fn with_capacity(capacity: usize) -> Result<(Watcher, Receiver<FsEvent>), WatchError> {
        let (queue, fs_events) = bounded(capacity);
        let folders = WatchedFolders::default();
        let mut handler = EventHandler { queue, capacity, last: None, folders: folders.clone() };
        let notify = notify::recommended_watcher(move |event| handler.receive(event)).map_err(watch_error)?;
        Ok((Watcher { notify, folders }, fs_events))
    }

    /// Watches a folder. Events name its files by the path given here. A folder may be watched again; if
    /// another folder has replaced it, this is necessary.
    ///
    /// # Errors
    /// When the folder does not exist, or the system refuses.
    pub(crate) fn watch(&mut self, folder: &Path) -> Result<(), WatchError> {
        let metadata = fs::metadata(folder).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::NotADirectory => WatchError::Missing,
            _ => WatchError::Other(error.to_string()),
        })?;
        if !metadata.is_dir() {
            return Err(WatchError::Missing);
        }
        let id = FileId::of(folder);
        // The folder that had this path may still exist elsewhere, and its events would carry its old path.
        if lock(&self.folders).get(folder).is_some_and(|known| *known != id) {
            self.unwatch(folder);
        }
        self.notify.watch(folder, RecursiveMode::NonRecursive).map_err(watch_error)?;
        lock(&self.folders).insert(folder.to_owned(), id);
        Ok(())
    }

    /// Stops watching a folder.
    pub(crate) fn unwatch(&mut self, folder: &Path) {
        lock(&self.folders).remove(folder);
        // A removed folder is no longer watched anyway.
        let _ = self.notify.unwatch(folder);
    }
}

/// Each update of the map is complete before the lock is released, so the map is consistent even if the
/// lock is poisoned.
fn lock(folders: &WatchedFolders) -> MutexGuard<'_, HashMap<PathBuf, FileId>> {
    folders.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The callback of notify's thread, and the only sender of events.
struct EventHandler {
    queue: Sender<FsEvent>,
    capacity: usize,
    /// The event that was sent last.
    last: Option<FsEvent>,
    folders: WatchedFolders,
}

impl EventHandler {
    fn receive(&mut self, event: notify::Result<Event>) {
        match event {
            Ok(event) if event.need_rescan() => self.send(FsEvent::Rescan),
            Ok(event) => self.on_event(event),
            Err(error) => {
                tracing::warn!(%error, "the file watcher failed to report an event: scanning its folder again");
                self.send(FsEvent::Rescan);
            }
        }
    }

    fn on_event(&mut self, event: Event) {
        let Some(change) = change_of(event.kind) else { return };
        if event.paths.is_empty() {
            self.send(FsEvent::Rescan);
        }
        for path in event.paths {
            // Links are followed, because a link to a folder counts as a folder. A removed path was a folder
            // if it was watched.
            let is_folder = change != ChangeKind::Removed && path.is_dir();
            let was_folder = lock(&self.folders).contains_key(&path);
            self.send(match change {
                _ if is_folder || was_folder => FsEvent::Folder(path),
                ChangeKind::FolderChanged => FsEvent::Folder(path),
                ChangeKind::File(hint) => FsEvent::File(path, hint),
                ChangeKind::Removed => FsEvent::File(path, FileHint::Changed),
            });
        }
    }

    /// Sends an event or, if only one slot is left, `Rescan`.
    fn send(&mut self, fs_event: FsEvent) {
        // The event that was sent last is the same, and still in the queue.
        if !self.queue.is_empty() && self.last.as_ref() == Some(&fs_event) {
            return;
        }
        let fs_event = if self.queue.len() + 1 < self.capacity { fs_event } else { FsEvent::Rescan };
        // Only `Rescan` takes the last slot: if no slot is left, `Rescan` is the last event in the queue.
        if self.queue.try_send(fs_event.clone()).is_ok() {
            self.last = Some(fs_event);
        }
    }
}

/// The kind of change that an event reports for its path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ChangeKind {
    File(FileHint),
    Removed,
    FolderChanged,
}

/// `None` for events that need no inspection.
fn change_of(kind: EventKind) -> Option<ChangeKind> {
    Some(match kind {
        // The other access events are files opened, or closed after reading, by this process or by others.
        EventKind::Access(AccessKind::Close(AccessMode::Write)) => ChangeKind::File(FileHint::Closed),
        // Only Linux reports that a file is closed.
        EventKind::Modify(ModifyKind::Data(_)) if cfg!(target_os = "linux") => {
            ChangeKind::File(FileHint::Written)
        }
        EventKind::Access(_) => return None,
        EventKind::Create(CreateKind::Folder) | EventKind::Remove(RemoveKind::Folder) => {
            ChangeKind::FolderChanged
        }
        EventKind::Remove(_) | EventKind::Modify(ModifyKind::Name(RenameMode::From)) => ChangeKind::Removed,
        EventKind::Modify(ModifyKind::Name(RenameMode::To)) => ChangeKind::File(FileHint::Renamed),
        // Both sides were reported before, as separate events.
        EventKind::Modify(ModifyKind::Name(RenameMode::Both)) => return None,
        EventKind::Create(_) | EventKind::Modify(_) | EventKind::Any | EventKind::Other => {
            ChangeKind::File(FileHint::Changed)
        }
    })
}

fn watch_error(error: notify::Error) -> WatchError {
    const TOO_MANY_OPEN_FILES: i32 = 24; // EMFILE, on every Unix
    match &error.kind {
        ErrorKind::PathNotFound => WatchError::Missing,
        ErrorKind::MaxFilesWatch => WatchError::TooMany(
            "this user has reached the limit of watched folders: raise fs.inotify.max_user_watches".into(),
        ),
        ErrorKind::Io(source) if source.raw_os_error() == Some(TOO_MANY_OPEN_FILES) => WatchError::TooMany(
            "this user has reached the limit of programs that watch folders, or of open files: \
             raise fs.inotify.max_user_instances, or the limit of open files"
                .into(),
        ),
        ErrorKind::Io(source) if source.kind() == io::ErrorKind::NotFound => WatchError::Missing,
        _ => WatchError::Other(error.to_string()),
    }
}

#[cfg(test)]
#[cfg(target_os = "linux")]
mod tests {
    use super::*;
    use std::fs::File;
    use std::os::unix::fs::symlink;
    use std::time::Duration;

    use tempfile::{TempDir, tempdir};

    /// A watched folder, a sibling folder that is not watched, and the events received.
    struct Bench {
        watcher: Watcher,
        fs_events: Receiver<FsEvent>,
        folder: PathBuf,
        outside: PathBuf,
        marker_count: usize,
        _base: TempDir,
    }

    const MARKER: &str = "marker-";

    fn changed(path: &Path) -> FsEvent {
        FsEvent::File(path.to_owned(), FileHint::Changed)
    }

    fn renamed_to(path: &Path) -> FsEvent {
        FsEvent::File(path.to_owned(), FileHint::Renamed)
    }

    fn written_to(path: &Path) -> FsEvent {
        FsEvent::File(path.to_owned(), FileHint::Written)
    }

    fn closed(path: &Path) -> FsEvent {
        FsEvent::File(path.to_owned(), FileHint::Closed)
    }

    impl Bench {
        fn new(capacity: usize) -> Bench {
            let base = tempdir().expect("a folder");
            let (folder, outside) = (base.path().join("frames"), base.path().join("beside"));
            fs::create_dir(&folder).expect("made");
            fs::create_dir(&outside).expect("made");
            let (mut watcher, fs_events) = Watcher::with_capacity(capacity).expect("a watcher");
            watcher.watch(&folder).expect("watched");
            Bench { watcher, fs_events, folder, outside, marker_count: 0, _base: base }
        }

        fn path(&self, name: &str) -> PathBuf {
            self.folder.join(name)
        }

        /// All events up to the expected one.
        fn until(&self, expected: &FsEvent) -> Vec<FsEvent> {
            let mut received = Vec::new();
            while received.last() != Some(expected) {
                let next = self.fs_events.recv_timeout(Duration::from_secs(300));
                received.push(next.unwrap_or_else(|_| panic!("{expected:?} is missing after {received:?}")));
            }
            received
        }

        /// All events so far, except those of marker files. Creates a marker file, and waits until its event
        /// arrives.
        fn so_far(&mut self) -> Vec<FsEvent> {
            self.marker_count += 1;
            let marker = self.path(&format!("{MARKER}{}", self.marker_count));
            File::create(&marker).expect("made");
            let mut received = self.until(&closed(&marker));
            received.retain(
                |fs_event| !matches!(fs_event, FsEvent::File(path, _) if path.to_string_lossy().contains(MARKER)),
            );
            received
        }
    }

    #[test]
    fn every_way_to_create_a_file_is_reported() {
        let bench = Bench::new(CAPACITY);
        let written = bench.path("written.ply");
        fs::write(&written, b"ply").expect("written");
        let received = bench.until(&closed(&written));
        assert_eq!(received, [changed(&written), written_to(&written), closed(&written)]);

        let renamed = bench.path("renamed.ply");
        fs::rename(&written, &renamed).expect("renamed");
        let received = bench.until(&renamed_to(&renamed));
        assert!(received.contains(&changed(&written)), "the old name is not reported: {received:?}");

        let elsewhere = bench.outside.join("a.ply");
        let moved = bench.path("moved.ply");
        fs::write(&elsewhere, b"ply").expect("written");
        fs::rename(&elsewhere, &moved).expect("renamed");
        bench.until(&renamed_to(&moved));

        let linked = bench.path("linked.ply");
        fs::hard_link(&renamed, &linked).expect("linked");
        fs::remove_file(&renamed).expect("removed");
        bench.until(&changed(&linked));
        bench.until(&changed(&renamed));

        let link = bench.path("link.ply");
        symlink("linked.ply", &link).expect("linked");
        bench.until(&changed(&link));
    }

    #[test]
    fn every_change_of_a_file_is_reported() {
        let mut bench = Bench::new(CAPACITY);
        let path = bench.path("a.ply");
        fs::write(&path, b"ply").expect("written");
        bench.so_far();
        let append = || File::options().append(true).open(&path).expect("a file");
        append().set_len(10).expect("longer");
        assert_eq!(bench.so_far(), [written_to(&path), closed(&path)]);
        append().set_modified(std::time::UNIX_EPOCH).expect("set");
        assert_eq!(bench.so_far().last(), Some(&closed(&path)));
        fs::remove_file(&path).expect("removed");
        assert!(bench.so_far().contains(&changed(&path)));
    }

    /// If reading sent events, every inspection would cause the next one.
    #[test]
    fn reading_a_file_sends_no_event() {
        let mut bench = Bench::new(CAPACITY);
        let path = bench.path("a.ply");
        fs::write(&path, b"ply").expect("written");
        bench.so_far();
        fs::read(&path).expect("read");
        fs::read_dir(&bench.folder).expect("read").for_each(drop);
        assert_eq!(bench.so_far(), []);
    }

    #[test]
    fn changed_folders_are_reported_as_folders() {
        let mut bench = Bench::new(CAPACITY);
        let made = bench.path("made");
        fs::create_dir(&made).expect("made");
        bench.until(&FsEvent::Folder(made.clone()));
        bench.watcher.watch(&made).expect("watched");
        fs::write(made.join("a.ply"), b"ply").expect("written");
        bench.until(&changed(&made.join("a.ply")));

        let (elsewhere, moved) = (bench.outside.join("sub"), bench.path("moved"));
        fs::create_dir(&elsewhere).expect("made");
        fs::rename(&elsewhere, &moved).expect("renamed");
        bench.until(&FsEvent::Folder(moved.clone()));
        bench.watcher.watch(&moved).expect("watched");
        fs::rename(&moved, &elsewhere).expect("renamed");
        bench.until(&FsEvent::Folder(moved));

        let link = bench.path("link");
        symlink(&elsewhere, &link).expect("linked");
        bench.until(&FsEvent::Folder(link.clone()));
        bench.watcher.watch(&link).expect("watched");
        fs::write(elsewhere.join("b.ply"), b"ply").expect("written");
        bench.until(&changed(&link.join("b.ply")));
        fs::remove_file(&link).expect("removed");
        bench.until(&FsEvent::Folder(link));

        fs::remove_dir_all(&made).expect("removed");
        bench.until(&FsEvent::Folder(made));
    }

    #[test]
    fn replaced_root_is_reported_and_can_be_watched_again() {
        let mut bench = Bench::new(CAPACITY);
        let root = bench.folder.clone();
        fs::remove_dir(&root).expect("removed");
        bench.until(&FsEvent::Folder(root.clone()));
        assert_eq!(bench.watcher.watch(&root), Err(WatchError::Missing));
        fs::create_dir(&root).expect("made");
        bench.watcher.watch(&root).expect("watched");
        bench.so_far();

        // Another folder replaces it, while the first one still exists elsewhere.
        let away = bench.outside.join("away");
        fs::rename(&root, &away).expect("renamed");
        bench.until(&FsEvent::Folder(root.clone()));
        fs::create_dir(&root).expect("made");
        bench.watcher.watch(&root).expect("watched");
        fs::write(away.join("a.ply"), b"ply").expect("written");
        let received = bench.so_far();
        assert!(!received.contains(&changed(&root.join("a.ply"))), "{received:?}");
    }

    #[test]
    fn watching_a_file_or_a_missing_folder_fails() {
        let mut bench = Bench::new(CAPACITY);
        fs::write(bench.path("a.ply"), b"ply").expect("written");
        for path in [bench.path("a.ply"), bench.path("gone")] {
            assert_eq!(bench.watcher.watch(&path), Err(WatchError::Missing), "{}", path.display());
        }
    }

    #[test]
    fn overflow_of_the_queue_sends_rescan() {
        let bench = Bench::new(4);
        for index in (0..100_000).take_while(|_| !bench.fs_events.is_full()) {
            fs::write(bench.path(&format!("{index}.ply")), b"ply").expect("written");
        }
        assert_eq!(bench.until(&FsEvent::Rescan).len(), 4);
    }

    /// A queue that is filled with artificial events.
    struct Rig {
        handler: EventHandler,
        fs_events: Receiver<FsEvent>,
    }

    impl Rig {
        fn new(capacity: usize) -> Rig {
            let (queue, fs_events) = bounded(capacity);
            let folders = WatchedFolders::default();
            Rig { handler: EventHandler { queue, capacity, last: None, folders }, fs_events }
        }

        fn handle_event(&mut self, kind: EventKind, name: &str) {
            self.handler.receive(Ok(Event::new(kind).add_path(Path::new("/f").join(name))));
        }

        fn received(&self) -> Vec<FsEvent> {
            self.fs_events.try_iter().collect()
        }
    }

    const CLOSED: EventKind = EventKind::Access(AccessKind::Close(AccessMode::Write));

    fn closed_in_rig(name: &str) -> FsEvent {
        closed(&Path::new("/f").join(name))
    }

    #[test]
    fn last_slot_of_the_queue_is_for_rescan() {
        let mut rig = Rig::new(4);
        let names = ["a", "b", "c", "d", "e", "f"];
        names.iter().for_each(|name| rig.handle_event(CLOSED, name));
        assert_eq!(
            rig.received(),
            [closed_in_rig("a"), closed_in_rig("b"), closed_in_rig("c"), FsEvent::Rescan]
        );
        // Events are lost again while `Rescan` is still in the queue.
        names.iter().for_each(|name| rig.handle_event(CLOSED, name));
        assert_eq!(rig.fs_events.try_recv(), Ok(closed_in_rig("a")));
        names.iter().for_each(|name| rig.handle_event(CLOSED, name));
        assert_eq!(rig.received().last(), Some(&FsEvent::Rescan));
        rig.handle_event(CLOSED, "g");
        assert_eq!(rig.received(), [closed_in_rig("g")]);
    }

    #[test]
    fn repeated_event_is_queued_once() {
        let mut rig = Rig::new(8);
        for _ in 0..3 {
            rig.handle_event(CLOSED, "a");
        }
        assert_eq!(rig.received(), [closed_in_rig("a")]);
        rig.handle_event(CLOSED, "a");
        assert_eq!(rig.received(), [closed_in_rig("a")], "it is queued again once it was taken");
    }

    #[test]
    fn loss_reported_by_the_system_sends_rescan() {
        let mut rig = Rig::new(8);
        rig.handler.receive(Ok(Event::new(EventKind::Other).set_flag(notify::event::Flag::Rescan)));
        assert_eq!(rig.received(), [FsEvent::Rescan]);
        rig.handler.receive(Err(notify::Error::generic("lost")));
        assert_eq!(rig.received(), [FsEvent::Rescan]);
        rig.handler.receive(Ok(Event::new(EventKind::Any)));
        assert_eq!(rig.received(), [FsEvent::Rescan], "an event without a path means anywhere");
    }

    #[test]
    fn limit_errors_name_the_setting_to_raise() {
        let too_many = watch_error(notify::Error::new(ErrorKind::MaxFilesWatch)).to_string();
        assert!(too_many.contains("max_user_watches"), "{too_many}");
        let too_many = watch_error(notify::Error::io(io::Error::from_raw_os_error(24))).to_string();
        assert!(too_many.contains("max_user_instances"), "{too_many}");
    }
}
