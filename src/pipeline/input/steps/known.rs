//! What is remembered of files with several steps: whoever asks for one step asks for the next.
//!
//! Of several who ask for a file at once, one goes through it, and the others wait for what that finds.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, LazyLock, Mutex, PoisonError};

use meniscus_formats::Result;

use crate::pipeline::files::stamp::FileStamp;

use super::contents::{StepContents, look_through};

/// The files that were asked for last.
static KNOWN: LazyLock<Mutex<StepIndex>> = LazyLock::new(Mutex::default);

/// No more steps are remembered, but for those of one file: some 40 MB.
const KNOWN_STEPS_MAX: usize = 1 << 18;

/// Nor more files.
const KNOWN_FILES_MAX: usize = 1 << 10;

/// What a file holds, as it is now.
///
/// # Errors
/// When it cannot be gone through, or `is_over`.
pub(super) fn contents_unless(file: &Path, is_over: &AtomicBool) -> Result<Arc<StepContents>> {
    let metadata = file.metadata()?;
    let stamp = FileStamp::of(&metadata);
    // A pipe can be read once, and not only for what it is.
    if !metadata.is_file() {
        return Ok(Arc::new(StepContents::none(stamp)));
    }
    let (pass, before) = with_known(|known| known.pass(file, stamp));
    // A panic leaves nothing half done behind these locks.
    let mut found = pass.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(contents) = &*found {
        return Ok(Arc::clone(contents));
    }
    let looked = look_through(file, before.as_deref(), is_over).map(Arc::new);
    with_known(|known| known.note(file, stamp, looked.as_ref().ok()));
    // It may be of a later file than was asked for: whoever reads it compares.
    let contents = looked?;
    *found = Some(Arc::clone(&contents));
    Ok(contents)
}

/// The same, but for a file that was gone through and written again since: that is `None`, and does not wait for anybody.
///
/// # Errors
/// When it cannot be gone through.
pub(super) fn contents_unless_changed(file: &Path) -> Result<Option<Arc<StepContents>>> {
    let stamp = FileStamp::of_path(file)?;
    match with_known(|known| known.contents_of(file)) {
        Some(contents) if contents.stamp == stamp => Ok(Some(contents)),
        Some(_) => Ok(None),
        None => contents_unless(file, &AtomicBool::new(false)).map(Some),
    }
}

/// What a file held when it was gone through last.
pub(super) fn contents_known(file: &Path) -> Option<Arc<StepContents>> {
    with_known(|known| known.contents_of(file))
}

fn with_known<T>(work: impl FnOnce(&mut StepIndex) -> T) -> T {
    work(&mut KNOWN.lock().unwrap_or_else(PoisonError::into_inner))
}

/// What is remembered of files.
#[derive(Debug, Default)]
struct StepIndex {
    files: HashMap<PathBuf, KnownFile>,
    /// How often something was asked for.
    asked_count: u64,
}

/// A file that is known, or being gone through.
#[derive(Debug)]
struct KnownFile {
    stamp: FileStamp,
    pass: Pass,
    /// What it held when it was gone through last.
    contents: Option<Arc<StepContents>>,
    /// The count of what was asked for when it was asked for last.
    asked_at: u64,
}

/// What a file with one stamp holds; locked by whoever goes through it.
type Pass = Arc<Mutex<Option<Arc<StepContents>>>>;

impl StepIndex {
    /// Where that is, or will be, which a file with this stamp holds; and what it held before.
    fn pass(&mut self, file: &Path, stamp: FileStamp) -> (Pass, Option<Arc<StepContents>>) {
        self.asked_count += 1;
        let new = || KnownFile { stamp, pass: Arc::default(), contents: None, asked_at: 0 };
        let known = self.files.entry(file.to_owned()).or_insert_with(new);
        known.asked_at = self.asked_count;
        if known.stamp != stamp {
            (known.stamp, known.pass) = (stamp, Arc::default());
        }
        (Arc::clone(&known.pass), known.contents.clone())
    }

    fn contents_of(&mut self, file: &Path) -> Option<Arc<StepContents>> {
        self.asked_count += 1;
        let known = self.files.get_mut(file)?;
        known.asked_at = self.asked_count;
        known.contents.clone()
    }

    /// A file was gone through, with that stamp if it could be. What has no steps is not remembered: its head tells that.
    fn note(&mut self, file: &Path, asked: FileStamp, found: Option<&Arc<StepContents>>) {
        let Some(known) = self.files.get_mut(file).filter(|known| known.stamp == asked) else { return };
        match found.filter(|contents| !contents.steps.is_empty()) {
            None => drop(self.files.remove(file)),
            Some(contents) => {
                known.stamp = contents.stamp;
                known.contents = Some(Arc::clone(contents));
                self.make_room(file);
            }
        }
    }

    /// Forgets what was not asked for longest, but not this file. Files with one step give way to those with several, which
    /// are asked for again and again, and take no room from their steps.
    fn make_room(&mut self, kept: &Path) {
        let step_count =
            |known: &KnownFile| known.contents.as_ref().map_or(0, |contents| contents.steps.len());
        let has_several = |known: &KnownFile| step_count(known) > 1;
        let is_for_several = self.files.get(kept).is_some_and(has_several);
        let mut total: usize = self.files.values().map(step_count).sum();
        while self.files.len() > KNOWN_FILES_MAX || (is_for_several && total > KNOWN_STEPS_MAX) {
            let others = self.files.iter().filter(|(path, known)| *path != kept && known.contents.is_some());
            let key = |known: &KnownFile| (has_several(known), known.asked_at);
            let Some(oldest) = others.min_by_key(|(_, known)| key(known)) else { return };
            let oldest = oldest.0.clone();
            total -= self.files.remove(&oldest).map_or(0, |known| step_count(&known));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::input::steps::contents::of_count;
    use std::fs;
    use std::thread;

    #[test]
    fn those_who_ask_at_once_have_it_gone_through_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("d.dump");
        let step =
            |number| format!("ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n0\nITEM: ATOMS x y z\n");
        fs::write(&file, (0..2000).map(step).collect::<String>()).expect("written");
        let ask = || contents_unless(&file, &AtomicBool::new(false)).expect("steps");
        let all: Vec<Arc<StepContents>> = thread::scope(|scope| {
            let asking: Vec<_> = (0..8).map(|_| scope.spawn(ask)).collect();
            asking.into_iter().map(|asked| asked.join().expect("no panic")).collect()
        });
        assert!(all.iter().all(|contents| Arc::ptr_eq(contents, &all[0])));
        assert_eq!(all[0].step("1999").expect("a step").lines_before, 1999 * 5);
    }

    #[test]
    fn what_was_not_asked_for_longest_is_forgotten() {
        let mut known = StepIndex::default();
        let stamp = FileStamp::default();
        let ask = |known: &mut StepIndex, name: &str, count: usize| {
            known.pass(Path::new(name), stamp);
            known.note(Path::new(name), stamp, Some(&Arc::new(of_count(stamp, count))));
        };
        let has = |known: &StepIndex, name: &str| known.files.contains_key(Path::new(name));
        let some = KNOWN_STEPS_MAX / 4;
        for name in ["a", "b", "c", "d"] {
            ask(&mut known, name, some);
        }
        known.contents_of(Path::new("a"));
        ask(&mut known, "e", some);
        assert!(has(&known, "a") && !has(&known, "b") && has(&known, "c") && has(&known, "e"));
        // The one that is asked for stays, whatever it has.
        ask(&mut known, "large", KNOWN_STEPS_MAX + 1);
        assert_eq!(known.files.len(), 1);
        ask(&mut known, "none", 0);
        assert!(has(&known, "large") && !has(&known, "none"));
        // Nor do many files with one step put it out: some of those are remembered beside it.
        (0..2 * KNOWN_FILES_MAX).for_each(|number| ask(&mut known, &format!("single {number}"), 1));
        let last = format!("single {}", 2 * KNOWN_FILES_MAX - 1);
        assert!(has(&known, "large") && has(&known, &last) && !has(&known, "single 0"));
        assert_eq!(known.files.len(), KNOWN_FILES_MAX);
        (0..2 * KNOWN_FILES_MAX).for_each(|number| ask(&mut known, &number.to_string(), 2));
        assert!(!has(&known, "large") && !has(&known, &last));
        assert_eq!(known.files.len(), KNOWN_FILES_MAX);
    }
}
