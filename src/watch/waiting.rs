//! Lists the files whose writers have not finished them.
//!
//! ```text
//!   files in the watched folders ──▶ minus those in the journal ──▶ minus complete files
//!                                                               ──▶ minus files that are not frames
//! ```
//!
//! The journal records only complete files, because a growing file would fill it. So this search runs on
//! request, by the rules of the event loop, and does not disturb a running daemon. It does not know what the
//! daemon has seen. A file that was renamed into place therefore counts as waiting for a moment, although the
//! daemon accepts it at once. If this machine's clock does not set the times of a file, as on a network file
//! system, the age of the file is unknown. Then the file is reported only if its sentinel or its end is
//! missing: only the daemon knows how long it has been unchanged.
//!
//! A folder may hang, or hold too many files. So a thread searches within a time limit, and the search
//! returns the files found by then.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

use crate::pipeline::{FileStamp, SniffedContent, content, file_of};

use super::config::{StabilityTimeouts, Watch};
use super::core::completeness::{Candidate, FileHint, Readiness, Seen, WaitReason};
use super::explain::trust_clock;
use super::io::evidence::readiness_of;
use super::io::scan::scan;
use super::io::selection::FileFilter;
use super::journal::{JournalState, PlanRecord};

/// Files that wait for their writers.
#[derive(Debug, Default, PartialEq)]
pub struct Waiting {
    /// Each file once, and why it is not read yet; unordered.
    pub files: Vec<(PathBuf, WaitReason)>,
    /// Whether there may be more files: the search reached the limit of time or of files to inspect.
    pub is_cut_short: bool,
}

/// Time limit of the search.
const TIME_MAX: Duration = Duration::from_secs(3);

/// Maximum number of files outside the journal to inspect: each of them is opened.
const FILES_MAX: usize = 10_000;

/// The files that a daemon with this journal would take for frames but does not read yet, each with the
/// reason. Folders that cannot be read are skipped.
pub fn waiting(state: &JournalState) -> Waiting {
    let Some(plan) = state.plan.clone() else { return Waiting::default() };
    let known = state.frames.iter();
    let known: JournaledFiles = known
        .map(|(input, frame)| (file_of(input).to_owned(), frame.stamp.without_status_change()))
        .collect();
    let (sender, receiver) = channel();
    let until = Instant::now() + TIME_MAX;
    // If a folder hangs, the thread ends with the process.
    let search_all = move || search(&plan, &known, (FILES_MAX, &trust_clock), &sender);
    match thread::Builder::new().name("look".into()).spawn(search_all) {
        Ok(_) => collect(&receiver, until),
        Err(_) => Waiting { is_cut_short: true, ..Waiting::default() },
    }
}

/// Files as recorded in the journal, without their status change times.
type JournaledFiles = HashSet<(PathBuf, FileStamp)>;

/// A file that waits; `None` when the search is finished.
type WaitingFile = Option<(PathBuf, WaitReason)>;

/// Collects the results that arrive before `until`.
fn collect(receiver: &Receiver<WaitingFile>, until: Instant) -> Waiting {
    let mut waiting = Waiting::default();
    loop {
        match receiver.recv_timeout(until.saturating_duration_since(Instant::now())) {
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

/// Inspects up to `files_left` files that are not in the journal. `trust_clock` says whether this
/// machine's clock sets the times of the file at a path.
fn search(
    plan: &PlanRecord,
    known: &JournaledFiles,
    (mut files_left, trust_clock): (usize, &dyn Fn(&Path) -> bool),
    sender: &Sender<WaitingFile>,
) {
    let output_folders: Vec<PathBuf> =
        plan.watches.iter().map(|watch| watch.outputs.folder.clone()).collect();
    // Watched folders may have files in common.
    let mut sent = HashSet::new();
    for watch in &plan.watches {
        let selection = FileFilter::new(watch.pattern.as_deref(), watch.recursive, output_folders.clone());
        let Ok(selection) = selection else { continue };
        // One check per folder suffices: usually the same clock sets the times of all its files.
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
            let Some(why) = why_waiting(&path, &seen, watch, &plan.timeouts) else { continue };
            // The receiver is dropped once the time is up.
            if sent.insert(path.clone()) && sender.send(Some((path, why))).is_err() {
                return;
            }
        }
    }
    // The receiver may have been dropped here, too.
    let _ = sender.send(None);
}

fn why_waiting(path: &Path, seen: &Seen, watch: &Watch, timeouts: &StabilityTimeouts) -> Option<WaitReason> {
    let now = Instant::now();
    // Without an age, the file would count as just changed at every request.
    let settle = if seen.age.is_some() { timeouts.settle } else { Duration::ZERO };
    let timeouts = StabilityTimeouts { settle, ..*timeouts };
    let candidate = Candidate::new(now, seen, FileHint::Changed);
    let readiness = readiness_of(path, &candidate, now, watch, &timeouts);
    let Readiness::Waiting { why, .. } = readiness else { return None };
    let is_certain =
        seen.age.is_some() || matches!(why, WaitReason::Sentinel | WaitReason::Incomplete { .. });
    // A file that cannot be read may be a frame: the attempt to read it reports why it fails.
    let may_be_frame = || content(path).map_or(true, SniffedContent::is_frame);
    (is_certain && may_be_frame()).then_some(why)
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

    /// A folder with a frame, an incomplete frame, and files that are not frames.
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

    /// The names of the files that wait, sorted, each with its reason in one word; inspects files up to the
    /// limit.
    fn found(watches: Vec<Watch>, limits: (usize, &dyn Fn(&Path) -> bool)) -> (Vec<String>, bool) {
        let hour = Duration::from_secs(3600);
        let timeouts = StabilityTimeouts { settle: hour, unverifiable: hour, stalled: hour };
        let (sender, receiver) = channel();
        search(&PlanRecord { watches, timeouts }, &JournaledFiles::new(), limits, &sender);
        drop(sender);
        let Waiting { files, is_cut_short } = collect(&receiver, Instant::now() + hour);
        let mut files: Vec<String> = files
            .into_iter()
            .map(|(path, why)| {
                let name = path.file_name().expect("a name").to_string_lossy().into_owned();
                let why = match why {
                    WaitReason::Sentinel => "sentinel",
                    WaitReason::Changing => "changing",
                    WaitReason::Unverifiable => "unverifiable",
                    WaitReason::Open => "open",
                    WaitReason::Incomplete { .. } => "incomplete",
                };
                format!("{name}: {why}")
            })
            .collect();
        files.sort();
        (files, is_cut_short)
    }

    #[test]
    fn only_incomplete_frames_are_listed() {
        let folder = folder();
        let of = |sentinel| vec![watch(folder.path(), sentinel)];
        let all = (usize::MAX, &(|_: &Path| true) as &dyn Fn(&Path) -> bool);
        let frames =
            |why: &str| (["dam.1.ply", "dam.2.ply"].map(|name| format!("{name}: {why}")).to_vec(), false);
        assert_eq!(found(of(None), all), frames("changing"));
        assert_eq!(found(of(Some("{stem}.done")), all), frames("sentinel"));
        // A folder that is watched twice yields each file once.
        let twice = vec![watch(folder.path(), None), watch(folder.path(), Some("{stem}.done"))];
        assert_eq!(found(twice, all), frames("changing"));
    }

    #[test]
    fn without_a_trusted_clock_no_file_counts_as_just_changed() {
        let folder = folder();
        let of = |sentinel| vec![watch(folder.path(), sentinel)];
        let all = (usize::MAX, &(|_: &Path| false) as &dyn Fn(&Path) -> bool);
        assert_eq!(found(of(None), all), (vec!["dam.2.ply: incomplete".to_owned()], false));
        assert_eq!(found(of(Some("{stem}.done")), all).0, ["dam.1.ply: sentinel", "dam.2.ply: sentinel"]);
    }

    #[test]
    fn search_of_a_hanging_folder_ends_after_the_time_limit() {
        let folder = folder();
        let (files, is_cut_short) = found(vec![watch(folder.path(), None)], (0, &|_| true));
        assert!(files.is_empty() && is_cut_short, "{files:?}");
        // A file that was found before a folder hangs.
        let (sender, receiver) = channel();
        sender.send(Some(("dam.1.ply".into(), WaitReason::Changing))).expect("heard");
        let waiting = collect(&receiver, Instant::now() + Duration::from_millis(20));
        assert_eq!((waiting.files.len(), waiting.is_cut_short), (1, true));
    }
}
