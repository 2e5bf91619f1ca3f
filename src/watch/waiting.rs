//! Which files have not been finished by their writers, for whoever asks.
//!
//! ```text
//!   the folders that are watched ──▶ less what the journal knows as it is ──▶ less what is complete ──▶ less what is no frame
//! ```
//!
//! A journal has what was found complete, and a file that grows would fill it. So this is looked up when it is asked for, by
//! the rules of the loop; a running daemon is not disturbed. What it has seen is not known here: a file that was renamed into
//! place waits for a moment that the daemon does not; and of a file whose age no clock here can tell, as on a network, only
//! that it wants its sentinel or its end is told, for how long it has been left alone the daemon alone knows.
//!
//! A folder may hang, or have more in it than anybody waits for. So it is a thread that looks, for as long as there is
//! time; what it has found by then is told.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

use crate::pipeline::{FileStamp, file_of};

use super::config::{Patience, Watch};
use super::core::completeness::{Candidate, Readiness, Seen, WaitReason};
use super::explain::trust_clock;
use super::io::evidence::readiness_of;
use super::io::scan::scan;
use super::io::selection::{FileFilter, SniffedContent, content};
use super::journal::{JournalState, PlanRecord};

/// Files that wait for their writers.
#[derive(Debug, Default, PartialEq)]
pub struct Waiting {
    /// Each once, and why it is not read yet; in no order.
    pub files: Vec<(PathBuf, WaitReason)>,
    /// Whether there may be more: the time, or the number of files that are looked at, was up.
    pub is_cut_short: bool,
}

/// So long is looked, at most.
const TIME_MAX: Duration = Duration::from_secs(3);

/// So many files that the journal does not know are looked at, at most: each is opened.
const FILES_MAX: usize = 10_000;

/// The files that a daemon with this journal would take for frames, and why it does not read them yet. Folders that cannot
/// be looked into have none.
pub fn waiting(state: &JournalState) -> Waiting {
    let Some(plan) = state.plan.clone() else { return Waiting::default() };
    let known = state.frames.iter();
    let known: JournaledFiles = known
        .map(|(input, frame)| (file_of(input).to_owned(), frame.stamp.without_status_change()))
        .collect();
    let (tell, told) = channel();
    let until = Instant::now() + TIME_MAX;
    // Where a folder hangs, it ends with the program.
    let looking = move || look_for(&plan, &known, (FILES_MAX, &trust_clock), &tell);
    match thread::Builder::new().name("look".into()).spawn(looking) {
        Ok(_) => gathered(&told, until),
        Err(_) => Waiting { is_cut_short: true, ..Waiting::default() },
    }
}

/// Files as the journal knows them, without their status change times.
type JournaledFiles = HashSet<(PathBuf, FileStamp)>;

/// A file that waits; `None` when the search has ended.
type Told = Option<(PathBuf, WaitReason)>;

/// What is told until then.
fn gathered(told: &Receiver<Told>, until: Instant) -> Waiting {
    let mut waiting = Waiting::default();
    loop {
        match told.recv_timeout(until.saturating_duration_since(Instant::now())) {
            Ok(Some(file)) => waiting.files.push(file),
            Ok(None) => break,
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                waiting.is_cut_short = true;
                break;
            }
        }
    }
    waiting
}

/// Looks at so many files that are not known; `trust_clock` says of a path whether its times are by the clock of this machine.
fn look_for(
    plan: &PlanRecord,
    known: &JournaledFiles,
    (mut files_left, trust_clock): (usize, &dyn Fn(&Path) -> bool),
    tell: &Sender<Told>,
) {
    let output_folders: Vec<PathBuf> =
        plan.watches.iter().map(|watch| watch.outputs.folder.clone()).collect();
    // Folders that are watched may have files in common.
    let mut told = HashSet::new();
    for watch in &plan.watches {
        let selection = FileFilter::new(watch.pattern.as_deref(), watch.recursive, output_folders.clone());
        let Ok(selection) = selection else { continue };
        // The clock of the folder is that of all in it, as a rule.
        let is_trusted = trust_clock(&watch.input.join("any"));
        let Ok(found) = scan(&watch.input, &watch.input, &selection, is_trusted) else { continue };
        for (path, seen) in found.files {
            let file = (path, seen.stamp.without_status_change());
            if known.contains(&file) {
                continue;
            }
            let Some(left) = files_left.checked_sub(1) else { return };
            files_left = left;
            let (path, _) = file;
            let Some(why) = why_waiting(&path, &seen, watch, &plan.patience) else { continue };
            // Nobody listens any more once the time is up.
            if told.insert(path.clone()) && tell.send(Some((path, why))).is_err() {
                return;
            }
        }
    }
    // The same of this.
    let _ = tell.send(None);
}

fn why_waiting(path: &Path, seen: &Seen, watch: &Watch, patience: &Patience) -> Option<WaitReason> {
    let now = Instant::now();
    // Without an age it would have changed just now, whenever somebody asks.
    let settle = if seen.age.is_some() { patience.settle } else { Duration::ZERO };
    let patience = Patience { settle, ..*patience };
    let readiness = readiness_of(path, &Candidate::new(now, seen, false), now, watch, &patience);
    let Readiness::Waiting { why, .. } = readiness else { return None };
    let is_told = seen.age.is_some() || matches!(why, WaitReason::Sentinel | WaitReason::Incomplete { .. });
    // What cannot be read may be one: reading it will say why not.
    let is_no_frame =
        || matches!(content(path), Ok(SniffedContent::OwnOutput | SniffedContent::NotParticles));
    (is_told && !is_no_frame()).then_some(why)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    use tempfile::TempDir;

    use crate::pipeline::{OutputFormat, OutputOptions};
    use crate::surface::options::MethodOptions;

    const HEADER: &str =
        "element vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n";

    /// A folder with a frame, one that is not complete, and what is none.
    fn folder() -> TempDir {
        let folder = tempfile::tempdir().expect("a folder");
        let whole = format!("ply\nformat ascii 1.0\n{HEADER}0 0 0\n");
        for (name, text) in [
            ("dam.1.ply", whole.clone()),
            ("dam.2.ply", format!("ply\nformat binary_little_endian 1.0\n{HEADER}0000")),
            ("made.ply", whole.replacen("1.0\n", "1.0\ncomment meniscus_generator: meniscus 0.1.0\n", 1)),
            ("notes.txt", "The dam is 2 m wide.\n".to_owned()),
        ] {
            fs::write(folder.path().join(name), text).expect("written");
        }
        folder
    }

    fn watch(folder: &Path, sentinel: Option<&str>) -> Watch {
        Watch {
            input: folder.to_owned(),
            pattern: None,
            recursive: false,
            sentinel: sentinel.map(str::to_owned),
            outputs: OutputOptions::new(folder, &[OutputFormat::Ply]),
            choices: MethodOptions::default(),
            obstacles: Vec::new(),
        }
    }

    /// The names of the files that wait, in order, and why, in a word; of at most so many that are looked at.
    fn found(watches: Vec<Watch>, limits: (usize, &dyn Fn(&Path) -> bool)) -> (Vec<String>, bool) {
        let hour = Duration::from_secs(3600);
        let patience = Patience { settle: hour, unproven: hour, stalled: hour };
        let (tell, told) = channel();
        look_for(&PlanRecord { watches, patience }, &JournaledFiles::new(), limits, &tell);
        drop(tell);
        let Waiting { files, is_cut_short } = gathered(&told, Instant::now() + hour);
        let mut files: Vec<String> = files
            .into_iter()
            .map(|(path, why)| {
                let name = path.file_name().expect("a name").to_string_lossy().into_owned();
                let why = match why {
                    WaitReason::Sentinel => "sentinel",
                    WaitReason::Changing => "changing",
                    WaitReason::Unproven => "unproven",
                    WaitReason::Incomplete { .. } => "incomplete",
                };
                format!("{name}: {why}")
            })
            .collect();
        files.sort();
        (files, is_cut_short)
    }

    #[test]
    fn only_frames_wait() {
        let folder = folder();
        let of = |sentinel| vec![watch(folder.path(), sentinel)];
        let all = (usize::MAX, &(|_: &Path| true) as &dyn Fn(&Path) -> bool);
        let frames =
            |why: &str| (["dam.1.ply", "dam.2.ply"].map(|name| format!("{name}: {why}")).to_vec(), false);
        assert_eq!(found(of(None), all), frames("changing"));
        assert_eq!(found(of(Some("{stem}.done")), all), frames("sentinel"));
        // Watched twice, it is told once.
        let twice = vec![watch(folder.path(), None), watch(folder.path(), Some("{stem}.done"))];
        assert_eq!(found(twice, all), frames("changing"));
    }

    #[test]
    fn without_a_clock_nothing_has_changed_just_now() {
        let folder = folder();
        let of = |sentinel| vec![watch(folder.path(), sentinel)];
        let all = (usize::MAX, &(|_: &Path| false) as &dyn Fn(&Path) -> bool);
        assert_eq!(found(of(None), all), (vec!["dam.2.ply: incomplete".to_owned()], false));
        assert_eq!(found(of(Some("{stem}.done")), all).0, ["dam.1.ply: sentinel", "dam.2.ply: sentinel"]);
    }

    #[test]
    fn nobody_waits_for_ever() {
        let folder = folder();
        let (files, is_cut_short) = found(vec![watch(folder.path(), None)], (0, &|_| true));
        assert!(files.is_empty() && is_cut_short, "{files:?}");
        // One that was found before a folder hangs.
        let (tell, told) = channel();
        tell.send(Some(("dam.1.ply".into(), WaitReason::Changing))).expect("heard");
        let waiting = gathered(&told, Instant::now() + Duration::from_millis(20));
        assert_eq!((waiting.files.len(), waiting.is_cut_short), (1, true));
    }
}
