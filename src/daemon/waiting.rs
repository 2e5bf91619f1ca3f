//! Which files have not been finished by their writers, for whoever asks.
//!
//! ```text
//!   the folders that are watched ──▶ less what the journal knows as it is ──▶ less what is complete
//! ```
//!
//! A journal has what was found complete, and a file that grows would fill it. So this is looked up when it is asked for, by
//! the rules of the loop; a running daemon is not disturbed. What it knows of renames is not known here: a file that was
//! renamed into place waits for a moment that the daemon does not.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

use crate::pipeline::{FileStamp, file_of};

use super::config::{Patience, Watch};
use super::evidence::{completeness_of, sentinel_of};
use super::explain::trust_clock;
use super::journal::State;
use super::readiness::{Candidate, Readiness, WaitReason};
use super::scan::{Seen, scan};
use super::selection::Selection;

/// The files that a daemon with this journal would take for frames, and why it does not read them yet; in no order. Folders
/// that cannot be looked into have none.
pub fn waiting(state: &State) -> Vec<(PathBuf, WaitReason)> {
    let Some(plan) = &state.plan else { return Vec::new() };
    let output_folders: Vec<PathBuf> =
        plan.watches.iter().map(|watch| watch.outputs.folder.clone()).collect();
    let known: HashSet<(&Path, FileStamp)> =
        state.frames.iter().map(|(input, frame)| (file_of(input), frame.stamp)).collect();
    let mut waiting = Vec::new();
    for watch in &plan.watches {
        let selection = Selection::new(watch.pattern.as_deref(), watch.recursive, output_folders.clone());
        let Ok(selection) = selection else { continue };
        // The clock of the folder is that of all in it, as a rule.
        let is_trusted = trust_clock(&watch.input.join("any"));
        let Ok(found) = scan(&watch.input, &watch.input, &selection, is_trusted) else { continue };
        let unknown = found.files.into_iter().filter(|(path, seen)| !known.contains(&(&**path, seen.stamp)));
        waiting.extend(unknown.filter_map(|(path, seen)| {
            let why = why_waiting(&path, &seen, watch, &plan.patience)?;
            Some((path, why))
        }));
    }
    waiting
}

fn why_waiting(path: &Path, seen: &Seen, watch: &Watch, patience: &Patience) -> Option<WaitReason> {
    let now = Instant::now();
    let sentinel = sentinel_of(watch, path, &seen.stamp);
    match Candidate::new(now, seen, false).readiness(now, patience, sentinel, || completeness_of(path)) {
        Readiness::Ready(_) => None,
        Readiness::Waiting { why, .. } => Some(why),
    }
}
