//! A cache of step indices: a caller that reads one step usually reads the next.
//!
//! If several threads request one file at once, one of them indexes it, and the others wait for the result.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, LazyLock, Mutex, PoisonError};

use meniscus_formats::Result;

use crate::pipeline::files::stamp::FileStamp;

use super::index::{StepIndex, index_steps};

/// The indices of the most recently used files.
static CACHE: LazyLock<Mutex<StepIndexCache>> = LazyLock::new(Mutex::default);

/// Upper limit of the number of steps in the cache, about 40 MB. The file that was indexed last stays in the
/// cache even if it has more steps.
const CACHED_STEPS_MAX: usize = 1 << 18;

/// Upper limit of the number of files in the cache.
const CACHED_FILES_MAX: usize = 1 << 10;

/// The index of a file in its current state. Setting `is_over` cancels the pass over the file.
///
/// # Errors
/// When the file cannot be indexed, or the pass was cancelled.
pub(super) fn index_unless(file: &Path, is_over: &AtomicBool) -> Result<Arc<StepIndex>> {
    let metadata = file.metadata()?;
    let stamp = FileStamp::of(&metadata);
    // A pipe can be read only once, so it cannot be probed.
    if !metadata.is_file() {
        return Ok(Arc::new(StepIndex::none(stamp)));
    }
    let (pass, before) = with_cache(|known| known.pass(file, stamp));
    // A poisoned lock is used like any other: a panic leaves no partial change in what these locks protect.
    let mut found = pass.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(contents) = &*found {
        return Ok(Arc::clone(contents));
    }
    let indexed = index_steps(file, before.as_deref(), is_over).map(Arc::new);
    with_cache(|known| known.note(file, stamp, indexed.as_ref().ok()));
    // The file may have changed since the request. Readers detect that: they compare the stamp.
    let contents = indexed?;
    *found = Some(Arc::clone(&contents));
    Ok(contents)
}

/// Like [`index_unless`], but if the file has changed since it was indexed, returns `None` instead of
/// indexing it again.
///
/// # Errors
/// When the file cannot be indexed.
pub(super) fn index_unless_changed(file: &Path) -> Result<Option<Arc<StepIndex>>> {
    let stamp = FileStamp::of_path(file)?;
    match with_cache(|known| known.contents_of(file)) {
        Some(contents) if contents.stamp == stamp => Ok(Some(contents)),
        Some(_) => Ok(None),
        None => index_unless(file, &AtomicBool::new(false)).map(Some),
    }
}

/// The index from the last pass over a file, even if the file has changed since.
pub(super) fn cached_index(file: &Path) -> Option<Arc<StepIndex>> {
    with_cache(|known| known.contents_of(file))
}

fn with_cache<T>(work: impl FnOnce(&mut StepIndexCache) -> T) -> T {
    work(&mut CACHE.lock().unwrap_or_else(PoisonError::into_inner))
}

/// The cached indices.
#[derive(Debug, Default)]
struct StepIndexCache {
    files: HashMap<PathBuf, CachedFile>,
    /// The number of requests so far.
    use_count: u64,
}

/// A file that is indexed, or being indexed.
#[derive(Debug)]
struct CachedFile {
    stamp: FileStamp,
    pass: Pass,
    /// The index from the last pass over the file, perhaps with an older stamp.
    index: Option<Arc<StepIndex>>,
    /// The value of the request counter at the last request for this file.
    used_at: u64,
}

/// The index of a file with one stamp; the thread that indexes the file holds the lock.
type Pass = Arc<Mutex<Option<Arc<StepIndex>>>>;

impl StepIndexCache {
    /// The slot for the index of the file with this stamp, and the earlier index.
    fn pass(&mut self, file: &Path, stamp: FileStamp) -> (Pass, Option<Arc<StepIndex>>) {
        self.use_count += 1;
        let new = || CachedFile { stamp, pass: Arc::default(), index: None, used_at: 0 };
        let known = self.files.entry(file.to_owned()).or_insert_with(new);
        known.used_at = self.use_count;
        if known.stamp != stamp {
            (known.stamp, known.pass) = (stamp, Arc::default());
        }
        (Arc::clone(&known.pass), known.index.clone())
    }

    fn contents_of(&mut self, file: &Path) -> Option<Arc<StepIndex>> {
        self.use_count += 1;
        let known = self.files.get_mut(file)?;
        known.used_at = self.use_count;
        known.index.clone()
    }

    /// Stores the result of a pass, under the stamp that the pass found. Removes the file from the cache if
    /// the pass failed, or if the file has no steps: then reading its head again is enough.
    fn note(&mut self, file: &Path, requested_stamp: FileStamp, found: Option<&Arc<StepIndex>>) {
        let Some(known) = self.files.get_mut(file).filter(|known| known.stamp == requested_stamp) else {
            return;
        };
        match found.filter(|contents| !contents.steps.is_empty()) {
            None => drop(self.files.remove(file)),
            Some(contents) => {
                known.stamp = contents.stamp;
                known.index = Some(Arc::clone(contents));
                self.evict(file);
            }
        }
    }

    /// Evicts the least recently used files, but not the file `kept`. Files with one step are evicted first:
    /// they must not displace files with several steps, which are requested repeatedly.
    fn evict(&mut self, kept: &Path) {
        let step_count = |known: &CachedFile| known.index.as_ref().map_or(0, |contents| contents.steps.len());
        let has_several = |known: &CachedFile| step_count(known) > 1;
        let is_for_several = self.files.get(kept).is_some_and(has_several);
        let mut total: usize = self.files.values().map(step_count).sum();
        while self.files.len() > CACHED_FILES_MAX || (is_for_several && total > CACHED_STEPS_MAX) {
            let others = self.files.iter().filter(|(path, known)| *path != kept && known.index.is_some());
            let key = |known: &CachedFile| (has_several(known), known.used_at);
            let Some(oldest) = others.min_by_key(|(_, known)| key(known)) else { return };
            let oldest = oldest.0.clone();
            total -= self.files.remove(&oldest).map_or(0, |known| step_count(&known));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::input::steps::index::of_count;
    use std::fs;
    use std::thread;

    #[test]
    fn concurrent_requests_index_a_file_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("d.dump");
        let step =
            |number| format!("ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n0\nITEM: ATOMS x y z\n");
        fs::write(&file, (0..2000).map(step).collect::<String>()).expect("written");
        let request = || index_unless(&file, &AtomicBool::new(false)).expect("steps");
        let all: Vec<Arc<StepIndex>> = thread::scope(|scope| {
            let requests: Vec<_> = (0..8).map(|_| scope.spawn(request)).collect();
            requests.into_iter().map(|request| request.join().expect("no panic")).collect()
        });
        assert!(all.iter().all(|contents| Arc::ptr_eq(contents, &all[0])));
        assert_eq!(all[0].step("1999").expect("a step").lines_before, 1999 * 5);
    }

    #[test]
    fn least_recently_used_file_is_evicted() {
        let mut known = StepIndexCache::default();
        let stamp = FileStamp::default();
        let request = |known: &mut StepIndexCache, name: &str, count: usize| {
            known.pass(Path::new(name), stamp);
            known.note(Path::new(name), stamp, Some(&Arc::new(of_count(stamp, count))));
        };
        let has = |known: &StepIndexCache, name: &str| known.files.contains_key(Path::new(name));
        let some = CACHED_STEPS_MAX / 4;
        for name in ["a", "b", "c", "d"] {
            request(&mut known, name, some);
        }
        known.contents_of(Path::new("a"));
        request(&mut known, "e", some);
        assert!(has(&known, "a") && !has(&known, "b") && has(&known, "c") && has(&known, "e"));
        // The requested file stays, whatever its size.
        request(&mut known, "large", CACHED_STEPS_MAX + 1);
        assert_eq!(known.files.len(), 1);
        request(&mut known, "none", 0);
        assert!(has(&known, "large") && !has(&known, "none"));
        // Many files with one step do not evict the large file either: only the newest of them stay beside
        // it.
        (0..2 * CACHED_FILES_MAX).for_each(|number| request(&mut known, &format!("single {number}"), 1));
        let last = format!("single {}", 2 * CACHED_FILES_MAX - 1);
        assert!(has(&known, "large") && has(&known, &last) && !has(&known, "single 0"));
        assert_eq!(known.files.len(), CACHED_FILES_MAX);
        (0..2 * CACHED_FILES_MAX).for_each(|number| request(&mut known, &number.to_string(), 2));
        assert!(!has(&known, "large") && !has(&known, &last));
        assert_eq!(known.files.len(), CACHED_FILES_MAX);
    }
}
