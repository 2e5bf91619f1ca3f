//! A watched folder: whether it is there, what is in it, and when to look again.
//!
//! Events are hints, scans are truth. A root is scanned at the start, when events were lost, when it
//! comes back, and every so often whatever the system says; on a network file system, which tells nothing,
//! often. A folder that vanishes, or was full and comes up empty, is *unavailable*: a disk that is not
//! mounted is no reason to forget anything.

use std::collections::{BTreeMap, HashSet};
use std::hash::{BuildHasher, RandomState};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::config::{Config, Patience, Poll, Watch};
use super::mounts::network_file_system;
use super::place::known_path;
use super::scan::{FolderIdentity, Scan, scan};
use super::selection::{PatternError, Selection};
use super::watcher::{WatchError, Watcher};

/// A watched folder.
#[derive(Debug)]
pub(super) struct Root<'a> {
    pub(super) watch: &'a Watch,
    /// Absolute.
    pub(super) path: PathBuf,
    pub(super) selection: Selection,
    /// Why it cannot be looked into, while it cannot.
    pub(super) unavailable: Option<String>,
    /// Paths in it that the last scan could not examine, and why.
    pub(super) unreadable: BTreeMap<PathBuf, String>,
    /// The network file system that it is on.
    network: Option<&'static str>,
    /// So often it is looked into; `None`: when the system says so, and every `rescan_every`.
    poll: Option<Duration>,
    rescan_every: Duration,
    /// Folders whose events are heard.
    heard: HashSet<PathBuf>,
    /// When to look again.
    pub(super) next_scan: Instant,
    /// When the loop last compared its identity.
    pub(super) looked_at: Option<Instant>,
    /// It had frames when it was last looked into.
    had_frames: bool,
    /// Which folder it was then: its path may be a link that is pointed elsewhere, or another disk may be mounted there.
    identity: Option<FolderIdentity>,
}

/// On network file systems, unless somebody says how often.
const POLL_DEFAULT: Duration = Duration::from_secs(2);

/// What is known of a file on a network may be a few seconds old: NFS asks its server again after three.
const NETWORK_SETTLE_MIN: Duration = Duration::from_secs(4);

/// How soon a folder that is not there is looked for again.
const UNAVAILABLE_RETRY: Duration = Duration::from_secs(1);

/// Regular scans take at most one part in so many of a core.
const SCAN_SHARE: u32 = 200;

/// The same of scans in place of events, which somebody waits for.
const POLL_SHARE: u32 = 10;

impl<'a> Root<'a> {
    /// A folder that was not looked into yet. It need not be there.
    ///
    /// # Errors
    /// When the pattern is none.
    pub(super) fn new(
        watch: &'a Watch,
        config: &Config,
        excluded: Vec<PathBuf>,
    ) -> Result<Root<'a>, PatternError> {
        let path = known_path(&watch.input).unwrap_or_else(|_| watch.input.clone());
        let poll = match config.poll {
            Poll::Every(interval) => Some(interval),
            Poll::Auto => None,
        };
        Ok(Root {
            watch,
            path,
            selection: Selection::new(watch.pattern.as_deref(), watch.recursive, excluded)?,
            unavailable: None,
            unreadable: BTreeMap::new(),
            network: None,
            poll,
            rescan_every: config.rescan_every,
            heard: HashSet::new(),
            next_scan: Instant::now(),
            looked_at: None,
            had_frames: false,
            identity: None,
        })
    }

    /// Whether the times of its files can be compared with the clock here.
    pub(super) fn trust_clock(&self) -> bool {
        self.network.is_none()
    }

    /// How long its files must be left alone before they are read.
    pub(super) fn patience(&self, config: &Config) -> Patience {
        let Patience { settle, unproven, stalled } = config.patience;
        match self.network {
            None => config.patience,
            Some(_) => Patience {
                settle: settle.max(NETWORK_SETTLE_MIN),
                unproven: unproven.max(2 * NETWORK_SETTLE_MIN),
                stalled: stalled.max(2 * NETWORK_SETTLE_MIN),
            },
        }
    }

    /// Everything in the folder, and from now on its events are heard.
    ///
    /// # Errors
    /// Why the folder is unavailable.
    pub(super) fn scan(&mut self, watcher: &mut Option<Watcher>) -> Result<Scan, String> {
        let identity = FolderIdentity::of(&self.path).ok();
        if self.identity != identity {
            // Events of the folder that was there do not tell of this one, and those of an unmounted one just stop.
            self.stop_hearing(watcher);
            self.identity = identity;
        }
        let found = self.hear_and_scan(&self.path.clone(), watcher);
        let found = found.map_err(|error| error.to_string()).and_then(|found| {
            if self.had_frames && found.files.is_empty() {
                // An empty mount point looks like a folder from which all was deleted; either way
                // there is nothing to do until something comes.
                return Err("it is empty and was not before".to_owned());
            }
            Ok(found)
        });
        match &found {
            Ok(found) => self.had_frames |= !found.files.is_empty(),
            Err(_) => {
                // What was heard was heard of a folder that is gone.
                self.stop_hearing(watcher);
                self.next_scan = Instant::now() + UNAVAILABLE_RETRY;
            }
        }
        found
    }

    /// Whether the path leads to another folder than at the last scan.
    pub(super) fn is_another(&self) -> bool {
        FolderIdentity::of(&self.path).ok() != self.identity
    }

    /// A scan, and all that came of it, has taken this long: when to look again.
    pub(super) fn was_scanned(&mut self, cost: Duration) {
        self.next_scan = Instant::now() + self.interval(cost);
    }

    /// Everything in one folder of it, and from now on its events are heard.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub(super) fn hear_and_scan(&mut self, folder: &Path, watcher: &mut Option<Watcher>) -> io::Result<Scan> {
        if self.heard.is_empty() {
            self.find_out_how_to_watch(folder)?;
        }
        if self.poll.is_some() {
            return scan(folder, &self.path, &self.selection, self.trust_clock());
        }
        self.hear(folder, watcher);
        loop {
            let found = scan(folder, &self.path, &self.selection, self.trust_clock())?;
            // What came into a folder before its events were heard is found by the next scan.
            let unheard: Vec<PathBuf> =
                found.folders.iter().filter(|f| !self.heard.contains(*f)).cloned().collect();
            if unheard.is_empty() || self.poll.is_some() || watcher.is_none() {
                return Ok(found);
            }
            for folder in &unheard {
                self.hear(folder, watcher);
                if self.poll.is_some() {
                    break;
                }
            }
        }
    }

    /// Events were lost, and with them perhaps the word that a folder is another one now: each is asked for
    /// its events once more.
    pub(super) fn hear_again(&mut self) {
        self.heard.clear();
        self.next_scan = Instant::now();
    }

    /// The events of a folder that is gone, or is another one now, are not heard any more.
    pub(super) fn forget_folder(&mut self, folder: &Path, watcher: &mut Option<Watcher>) {
        let gone: Vec<PathBuf> =
            self.heard.iter().filter(|heard| heard.starts_with(folder)).cloned().collect();
        for folder in gone {
            self.heard.remove(&folder);
            if let Some(watcher) = watcher {
                watcher.unwatch(&folder);
            }
        }
    }

    fn stop_hearing(&mut self, watcher: &mut Option<Watcher>) {
        self.forget_folder(&self.path.clone(), watcher);
    }

    fn find_out_how_to_watch(&mut self, folder: &Path) -> io::Result<()> {
        let network = network_file_system(folder)?;
        if let Some(name) = network
            && self.poll.is_none()
        {
            tracing::info!(
                folder = %self.path.display(),
                "is on {name}, which does not tell of changes: it is looked into every {POLL_DEFAULT:?}"
            );
            self.poll = Some(POLL_DEFAULT);
        }
        self.network = network;
        Ok(())
    }

    fn hear(&mut self, folder: &Path, watcher: &mut Option<Watcher>) {
        let Some(heard_by) = watcher else { return };
        match heard_by.watch(folder) {
            // A folder that went again is missed by the next scan.
            Ok(()) | Err(WatchError::Gone) => {
                self.heard.insert(folder.to_owned());
            }
            Err(error) => self.poll_instead(&error),
        }
    }

    /// Events cannot be heard: the folder is looked into by turns.
    pub(super) fn poll_instead(&mut self, error: &WatchError) {
        let interval = *self.poll.get_or_insert(POLL_DEFAULT);
        tracing::warn!(
            folder = %self.path.display(),
            "cannot be watched: {error}; it is looked into every {interval:?} instead"
        );
    }

    /// Until the next regular scan: about as long as was asked for, or longer where scans take long.
    fn interval(&self, cost: Duration) -> Duration {
        match self.poll {
            Some(poll) => poll.max(cost * POLL_SHARE),
            // Between 3/4 and 5/4, so that several daemons on one disk do not scan in step.
            None => {
                let jitter = (RandomState::new().hash_one(()) % 1024) as f64 / 1024.0;
                self.rescan_every.mul_f64(0.75 + 0.5 * jitter).max(cost * SCAN_SHARE)
            }
        }
    }
}
