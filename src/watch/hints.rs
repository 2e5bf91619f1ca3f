//! What was heard, and what scans say.
//!
//! A hint names a file or folder that may have changed; whatever it was, the file is looked at, and what is
//! seen decides. A scan looks at everything in a root, and is the only one to say that something is not there.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};
use std::time::Instant;

use crate::pipeline::step_of;

use super::evidence::{may_be_sentinel, path_of_sentinel};
use super::frames::{FrameId, FrameState, Phase};
use super::journal::Standing;
use super::root::Root;
use super::rounds::Daemon;
use super::scan::{Scan, Seen};
use super::showing::count;
use super::watcher::Hint;

/// So many hints are taken in one turn: equal ones are looked at once.
const HINTS_PER_TURN: usize = 4096;

impl Daemon<'_> {
    /// Takes this hint and those that wait behind it.
    pub(super) fn take_hints(&mut self, first: Hint) {
        let mut seen = HashSet::new();
        let rest: Vec<Hint> = self.hints.try_iter().take(HINTS_PER_TURN).collect();
        for hint in std::iter::once(first).chain(rest) {
            if seen.insert(hint.clone()) {
                self.take_hint(&hint);
            }
        }
    }

    fn take_hint(&mut self, hint: &Hint) {
        match hint {
            Hint::Rescan => self.rescans.ask(Instant::now()),
            Hint::Changed(path) => self.take_file_hint(path, false),
            Hint::Renamed(path) => self.take_file_hint(path, true),
            Hint::Folder(path) => self.take_folder_hint(path),
        }
    }

    fn take_file_hint(&mut self, path: &Path, renamed: bool) {
        for root in 0..self.roots.len() {
            let Root { path: root_path, selection, .. } = &self.roots[root];
            if !path.starts_with(root_path) {
                continue;
            }
            if path == root_path {
                self.scan_root(root);
                continue;
            }
            if selection.takes(root_path, path) {
                self.look_at(&FrameId::new(root, path), renamed);
            }
            self.take_sentinel_hint(root, path);
        }
    }

    /// A file may be what some frame waits for.
    fn take_sentinel_hint(&mut self, root: usize, path: &Path) {
        if !may_be_sentinel(&self.config.watches[root], path) {
            return;
        }
        let is_waiting = |id: &FrameId, frame: &FrameState| {
            matches!(frame.phase, Phase::Settling(_))
                && id.root == root
                && id.path.parent() == path.parent()
                && path_of_sentinel(&self.config.watches[root], &id.path) == path
        };
        let waiting: Vec<FrameId> = self
            .frames
            .iter()
            .filter(|(id, frame)| is_waiting(id, frame))
            .map(|(id, _)| id.clone())
            .collect();
        for id in waiting {
            self.advance(&id);
        }
    }

    fn take_folder_hint(&mut self, folder: &Path) {
        for index in 0..self.roots.len() {
            let root = &mut self.roots[index];
            if root.path.starts_with(folder) {
                root.next_scan = Instant::now();
            } else if folder.starts_with(&root.path) && root.selection.enters(&root.path, folder) {
                // What was heard before was another folder of that name.
                root.forget_folder(folder, &mut self.watcher);
                match root.hear_and_scan(folder, &mut self.watcher) {
                    Ok(found) => self.sight_all(index, found.files),
                    // Gone, or moved elsewhere: the scan finds out what is left.
                    Err(_) => self.roots[index].next_scan = Instant::now(),
                }
            }
        }
    }

    /// Looks at everything in a root, and forgets what is not there any more.
    pub(super) fn scan_root(&mut self, index: usize) {
        let started = Instant::now();
        self.scan_count += 1;
        count(self.board, |counters| counters.scans += 1);
        let found = match self.roots[index].scan(&mut self.watcher) {
            Ok(found) => found,
            Err(why) => return self.lose_root(index, why),
        };
        if self.roots[index].unavailable.take().is_some() {
            tracing::info!(folder = %self.roots[index].path.display(), "is there again");
        }
        self.note_unreadable(index, &found);
        self.sight_all(index, found.files);
        self.warn_of_single_frames();
        self.look_at_obstacles(index);
        let count = self.scan_count;
        // Nothing is known of what lies where the scan could not look.
        let is_hidden = |id: &FrameId| found.problems.iter().any(|(path, _)| id.path.starts_with(path));
        let is_gone = |id: &FrameId, frame: &FrameState| {
            // A step goes with its file.
            let is_file = step_of(&id.path).is_none();
            id.root == index && is_file && frame.scan_count != count && !is_hidden(id)
        };
        let gone: Vec<FrameId> =
            self.frames.iter().filter(|(id, frame)| is_gone(id, frame)).map(|(id, _)| id.clone()).collect();
        for id in gone {
            self.forget(&id);
        }
        self.roots[index].was_scanned(started.elapsed());
    }

    /// Notes the paths that a scan could not examine; each is logged when it is new, and fails the run if it is still so at
    /// its end. A link without a target waits for it, unless nothing is waited for.
    fn note_unreadable(&mut self, index: usize, found: &Scan) {
        let problems = found.problems.iter().map(|(path, error)| (path.clone(), error.to_string()));
        let dangling = found.dangling.iter().filter(|_| self.config.once);
        let dangling = dangling.map(|path| (path.clone(), "the target of this link is missing".to_owned()));
        let unreadable: BTreeMap<PathBuf, String> = problems.chain(dangling).collect();
        let known = &mut self.roots[index].unreadable;
        for (path, why) in unreadable.iter().filter(|(path, why)| known.get(*path) != Some(why)) {
            tracing::error!(path = %path.display(), "cannot be read: {why}");
        }
        *known = unreadable;
    }

    /// Takes in what a scan found.
    fn sight_all(&mut self, root: usize, mut files: Vec<(PathBuf, Seen)>) {
        let frames = &self.stores.of_watch(root).journal.state().frames;
        let is_done = |path: &Path| frames.get(path).is_some_and(|record| record.standing == Standing::Done);
        // What has its outputs keeps them, whatever else would like to have them.
        files.sort_by_cached_key(|(path, _)| (!is_done(path), path.clone()));
        self.listings.begin();
        for (path, seen) in &files {
            self.sight(&FrameId::new(root, path), seen, false);
            self.pulse();
        }
        self.listings.end();
    }

    /// A root that is gone, or came up empty: nothing is forgotten, and it is waited for.
    fn lose_root(&mut self, index: usize, why: String) {
        let root = &mut self.roots[index];
        if root.unavailable.as_ref() != Some(&why) {
            if !self.config.once {
                tracing::warn!(folder = %root.path.display(), "unavailable: {why}; waiting for it");
            }
            root.unavailable = Some(why);
        }
    }
}
