//! Explains why a frame was converted, or was not: repeats all checks of the event loop once, on request.
//!
//! ```text
//!   the file ──▶ its name ──▶ the journal ──▶ complete? ──▶ its content ──▶ a verdict
//! ```
//!
//! The loop makes these checks in this order and stops at the first that fails. Here all checks are made, so
//! that all results can be shown. Nothing is written, and a running daemon is not disturbed.

use std::ffi::OsStr;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Instant;

use twox_hash::XxHash3_128;

use crate::pipeline::{
    FrameFile, ObstacleFiles, SniffedContent, content, file_of, is_missing_step, output_path,
    outputs_made_from, read_file,
};

use super::config::{StabilityTimeouts, Watch};
use super::core::completeness::{Candidate, FileHint, Readiness, Seen, WaitReason};
use super::core::decision::{ConvertReason, Decision, SkipReason, decide};
use super::core::sequences::{SequenceSettings, choices_fingerprint, fingerprint_with};
use super::io::evidence::readiness_of;
use super::io::inspect::{replacement, replaces_data};
use super::io::mounts::network_file_system;
use super::io::scan::file_state;
use super::io::selection::FileFilter;
use super::journal::{JournalState, JournaledFrame, SequenceKey};

/// A frame, and the inputs of the loop's checks.
#[derive(Clone, Copy, Debug)]
pub struct Question<'a> {
    /// The absolute path of the file, or of a step of one.
    pub frame: &'a Path,
    /// The configuration of its watched folder.
    pub watch: &'a Watch,
    /// The folders of all outputs.
    pub output_folders: &'a [PathBuf],
    /// How long it must be unchanged.
    pub timeouts: &'a StabilityTimeouts,
    /// Its record in the journal.
    pub record: Option<&'a JournaledFrame>,
    /// The [fingerprint](remembered_fingerprint) of its current settings. If it is unknown, the settings
    /// count as unchanged.
    pub settings: Option<&'a str>,
    /// Whether a daemon writes into the folder of its outputs, or may do so.
    pub has_daemon: bool,
}

/// The results of all checks.
#[derive(Clone, Debug)]
pub struct Explanation {
    /// Whether its path selects it as a frame.
    pub is_selected: bool,
    /// The file; `None` if it is missing.
    pub file: Option<FileFacts>,
    /// Whether its settings are those in the record; `None` if either is unknown.
    pub settings_hold: Option<bool>,
    /// The first recorded output that is missing or damaged.
    pub output_missing: Option<PathBuf>,
    /// The conclusion.
    pub verdict: FrameExplanation,
}

/// The facts about a file.
#[derive(Clone, Debug)]
pub struct FileFacts {
    /// Its kind, by its first bytes.
    pub content: SniffedContent,
    /// Whether it may be read.
    pub readiness: Readiness,
    /// How it differs from the recorded file; `None` without a record.
    pub change: Option<FileChange>,
}

/// How a file differs from the recorded one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileChange {
    /// It is unchanged.
    Unchanged,
    /// It was touched, moved or rewritten; its content is the same.
    Touched,
    /// Its content is different.
    Rewritten,
}

/// Whether the frame is converted, and why. Displays as a sentence without its subject and full stop.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum FrameExplanation {
    /// The file, or the step in it, does not exist.
    Missing,
    /// Its path is not selected as a frame.
    NotSelected,
    /// The journal decides that it stays as it is.
    Skipped(SkipReason),
    /// It is incomplete.
    Waits(WaitReason),
    /// It is complete but contains no particles.
    NotAFrame(SniffedContent),
    /// The journal has no record of it, and these outputs say that they were made from the current file.
    Found(Vec<PathBuf>),
    /// A running daemon has queued it, is converting it, or holds it for this reason.
    Pending(Option<String>),
    /// It will be converted: it was refused because of another file, which is gone.
    Unblocked,
    /// It will be converted, for this reason.
    Converted(Decision),
}

/// The fingerprint of the settings that this frame would be converted with now; `None` if the particle
/// spacing is needed, and is neither given nor in the journal.
pub fn remembered_fingerprint(watch: &Watch, frame: &Path, state: &JournalState) -> Option<String> {
    let file = FrameFile::new(frame.to_owned()).in_watched_folder(&watch.input);
    let (folder, name) = file.sequence();
    let key = SequenceKey { folder, name, choices: choices_fingerprint(watch) };
    match SequenceSettings::new(watch, state.sequences.get(&key)) {
        SequenceSettings::Fixed(settings, fingerprint) => {
            let obstacles = ObstacleFiles::new(watch.obstacles.clone());
            let stamps = (!obstacles.is_empty()).then(|| obstacles.stamps(file.number()));
            Some(fingerprint_with(&settings, &fingerprint, stamps.as_ref()))
        }
        _ => None,
    }
}

/// Checks a frame as the loop would.
///
/// # Errors
/// When the file or its folder cannot be inspected, or the pattern of the watch is invalid.
pub fn explain(question: &Question<'_>) -> io::Result<Explanation> {
    let Question { frame, watch, record, .. } = *question;
    let selection =
        FileFilter::new(watch.pattern.as_deref(), watch.recursive, question.output_folders.to_vec())
            .map_err(|error| io::Error::new(io::ErrorKind::InvalidInput, error))?;
    let is_selected = selection.takes(&watch.input, file_of(frame));
    let settings_hold = record.zip(question.settings).map(|(record, settings)| record.settings == settings);
    let output_missing = record.and_then(first_missing_output);
    let seen = file_state(frame, trust_clock(frame))?;
    // A file that cannot be searched for steps may contain this step; reading the file reports why the search
    // fails.
    let seen = seen.filter(|_| !is_missing_step(frame).unwrap_or(false));
    let (file, verdict) = match seen {
        None => (None, FrameExplanation::Missing),
        Some(seen) => {
            let (file, decision) = facts(question, &seen, output_missing.as_deref())?;
            let verdict = match is_selected {
                true => verdict(question, &file, decision),
                false => FrameExplanation::NotSelected,
            };
            (Some(file), unblocked(question, found_done(question, verdict)?))
        }
    };
    Ok(Explanation { is_selected, file, settings_hold, output_missing, verdict })
}

/// Combines the checks in the order of the loop: first the record, then whether the file is complete, then
/// its kind.
fn verdict(question: &Question<'_>, file: &FileFacts, decision: Decision) -> FrameExplanation {
    match (decision, file.readiness, file.content) {
        (Decision::Skip(reason), _, _) => FrameExplanation::Skipped(reason),
        (_, Readiness::Waiting { why, .. }, _) => FrameExplanation::Waits(why),
        (_, _, other) if !other.is_frame() => FrameExplanation::NotAFrame(other),
        // The journal has the same status for a frame of a running daemon and for one that an earlier daemon
        // did not finish.
        (Decision::Convert(ConvertReason::WasInterrupted), ..) if question.has_daemon => {
            FrameExplanation::Pending(question.record.and_then(|record| record.reason.clone()))
        }
        (decision, ..) => FrameExplanation::Converted(decision),
    }
}

/// Returns the verdict unchanged, unless the frame would be converted although its outputs were already made
/// by `convert`, or by a daemon whose journal was lost.
fn found_done(question: &Question<'_>, verdict: FrameExplanation) -> io::Result<FrameExplanation> {
    let Question { frame, watch, .. } = *question;
    if verdict != FrameExplanation::Converted(Decision::Convert(ConvertReason::New)) {
        return Ok(verdict);
    }
    let (folder, stem) = names_of_outputs(frame, watch);
    let found = outputs_made_from(&folder, &stem, || hash_of(frame))?;
    Ok(if found.is_empty() { verdict } else { FrameExplanation::Found(found) })
}

/// Returns the verdict unchanged, unless the frame was refused because of a file in the place of an output,
/// and that file is gone.
fn unblocked(question: &Question<'_>, verdict: FrameExplanation) -> FrameExplanation {
    let Question { frame, watch, .. } = *question;
    let reason = question.record.and_then(|record| record.reason.as_deref());
    let (folder, stem) = names_of_outputs(frame, watch);
    let outputs = watch.outputs.formats.iter().map(|&format| output_path(&folder, &stem, format));
    let outputs: Vec<PathBuf> = outputs.collect();
    let is_reason = |output: &PathBuf| reason == Some(&*replacement(output));
    let is_gone = outputs.iter().any(is_reason) && !outputs.iter().any(|output| replaces_data(output));
    match verdict {
        FrameExplanation::Converted(Decision::Convert(ConvertReason::WasRefused)) if is_gone => {
            FrameExplanation::Unblocked
        }
        verdict => verdict,
    }
}

/// The folder and the stem of a frame's outputs.
fn names_of_outputs(frame: &Path, watch: &Watch) -> (PathBuf, String) {
    let within = file_of(frame).parent().and_then(|folder| folder.strip_prefix(&watch.input).ok());
    let folder = watch.outputs.folder.join(within.unwrap_or(Path::new("")));
    (folder, FrameFile::new(frame.to_owned()).stem())
}

fn facts(
    question: &Question<'_>,
    seen: &Seen,
    output_missing: Option<&Path>,
) -> io::Result<(FileFacts, Decision)> {
    let Question { frame, watch, timeouts, record, .. } = *question;
    let now = Instant::now();
    let candidate = Candidate::new(now, seen, FileHint::Changed);
    let readiness = readiness_of(file_of(frame), &candidate, now, watch, timeouts);
    let is_same = |record: &JournaledFrame| record.stamp.still_holds(&seen.stamp);
    // Only a file with the same size and another stamp must be read to compare its content.
    let is_to_read = |record: &&JournaledFrame| {
        record.hash.is_some() && record.stamp.size == seen.stamp.size && !is_same(record)
    };
    let hash = record.filter(is_to_read).map(|_| hash_of(frame)).transpose()?;
    let settings = question.settings.or(record.map(|record| &*record.settings)).unwrap_or_default();
    let decision = decide(record, &seen.stamp, settings, output_missing, hash);
    let change = record.map(|record| match hash {
        _ if is_same(record) => FileChange::Unchanged,
        Some(hash) if record.hash == Some(hash) => FileChange::Touched,
        _ => FileChange::Rewritten,
    });
    Ok((FileFacts { content: content(file_of(frame))?, readiness, change }, decision))
}

/// Whether this machine's clock sets the file's times; not on a network file system.
pub(super) fn trust_clock(path: &Path) -> bool {
    let folder = file_of(path).parent().unwrap_or(path);
    network_file_system(folder).is_ok_and(|network| network.is_none())
}

fn hash_of(path: &Path) -> io::Result<u128> {
    let bytes = read_file(path).map_err(|error| io::Error::other(error.to_string()))?;
    Ok(XxHash3_128::oneshot(&bytes))
}

fn first_missing_output(record: &JournaledFrame) -> Option<PathBuf> {
    let missing = record.outputs.iter().find(|output| !output.has_recorded_bytes());
    missing.map(|output| output.path.clone())
}

impl fmt::Display for FrameExplanation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            FrameExplanation::Missing => f.write_str("is not converted because there is no such frame"),
            FrameExplanation::NotSelected => {
                f.write_str("is not converted because its path is not selected: a frame must be in a watched folder, must not be hidden, and must match --pattern (by default: be a particle file)")
            }
            FrameExplanation::Skipped(reason @ SkipReason::Done) => {
                write!(f, "is not converted again because {reason}")
            }
            FrameExplanation::Skipped(reason) => write!(f, "is not converted because {reason}"),
            FrameExplanation::Waits(why) => write!(f, "is not converted yet because {why}"),
            FrameExplanation::NotAFrame(SniffedContent::OwnOutput) => {
                f.write_str("is not converted because it is an output of this program")
            }
            FrameExplanation::NotAFrame(SniffedContent::Neighbor(neighbor)) => {
                let [one, _] = neighbor.words();
                write!(f, "is not converted because it is {one}")
            }
            FrameExplanation::NotAFrame(_) => {
                f.write_str("is not converted because it is not a particle file")
            }
            FrameExplanation::Found(outputs) => {
                let names: Vec<_> =
                    outputs.iter().filter_map(|path| path.file_name()).map(OsStr::to_string_lossy).collect();
                let were = if names.len() == 1 { "was" } else { "were" };
                write!(
                    f,
                    "is converted already: it is not in the journal, but {} {were} made from its current content; a daemon \
                     converts it again only if its settings or formats have changed",
                    names.join(", ")
                )
            }
            FrameExplanation::Pending(None) => f.write_str("is queued or in flight"),
            FrameExplanation::Pending(Some(reason)) => write!(f, "is not converted yet: {reason}"),
            FrameExplanation::Unblocked => {
                f.write_str("will be converted because the other file, which is the reason in the journal, is gone: a daemon checks that at each scan (--rescan), and when it starts")
            }
            // The record has the reason.
            FrameExplanation::Converted(Decision::Convert(ConvertReason::WasRefused)) => {
                f.write_str("will be converted when the reason in the journal no longer holds: a daemon checks that at each scan (--rescan), and when it starts")
            }
            FrameExplanation::Converted(decision) => write!(f, "will be converted because {decision}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::FileStamp;
    use std::fs;
    use std::fs::File;
    use std::time::{Duration, SystemTime};

    use tempfile::TempDir;

    use crate::pipeline::{OutputFormat, OutputOptions};
    use crate::surface::options::MethodOptions;
    use crate::watch::core::completeness::Proof;
    use crate::watch::journal::{JournaledStatus, OutputRecord};

    const FRAME: &[u8] = b"ply\nformat ascii 1.0\nelement vertex 1\n\
        property float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n";

    /// A watched folder with one frame, which has been unchanged for a minute, and one output.
    struct Bench {
        _folder: TempDir,
        frame: PathBuf,
        output: PathBuf,
        watch: Watch,
        has_daemon: bool,
    }

    impl Bench {
        fn new() -> Bench {
            let folder = tempfile::tempdir().expect("a folder");
            let input = folder.path().join("in");
            let out = folder.path().join("out");
            fs::create_dir(&input).expect("made");
            fs::create_dir(&out).expect("made");
            let frame = input.join("dam.1.ply");
            let output = out.join("dam.1.glb");
            fs::write(&output, "mesh").expect("written");
            let watch = Watch {
                input,
                pattern: None,
                recursive: false,
                sentinel: None,
                outputs: OutputOptions {
                    folder: out,
                    formats: vec![OutputFormat::Glb],
                    up: meniscus_formats::gltf::UpAxis::Y,
                    meters_per_unit: 1.0,
                    vdb_half: false,
                    vdb_compression: meniscus_formats::vdb::Compression::None,
                    picture: crate::pipeline::PictureOptions::default(),
                    stage: None,
                },
                choices: MethodOptions::default(),
                obstacles: Vec::new(),
            };
            let bench = Bench { _folder: folder, frame, output, watch, has_daemon: false };
            bench.write(FRAME);
            bench
        }

        fn write(&self, bytes: &[u8]) {
            fs::write(&self.frame, bytes).expect("written");
        }

        /// The record of the frame in its current state with this status.
        fn record(&self, status: JournaledStatus) -> JournaledFrame {
            JournaledFrame {
                status,
                stamp: FileStamp::of_path(&self.frame).expect("there"),
                hash: Some(XxHash3_128::oneshot(FRAME)),
                settings: "s".into(),
                outputs: vec![OutputRecord::new(self.output.clone(), 4, None)],
                reason: None,
                attempt_count: 1,
                at_ms: 0,
                particle_count: None,
                seconds: None,
                flaws: Vec::new(),
                figures: None,
            }
        }

        fn explain(
            &self,
            record: Option<&JournaledFrame>,
            settings: Option<&str>,
            settle: u64,
        ) -> Explanation {
            let settle = Duration::from_secs(settle);
            explain(&Question {
                frame: &self.frame,
                watch: &self.watch,
                output_folders: std::slice::from_ref(&self.watch.outputs.folder),
                timeouts: &StabilityTimeouts { settle, unverifiable: settle, stalled: settle },
                record,
                settings,
                has_daemon: self.has_daemon,
            })
            .expect("an explanation")
        }

        fn verdict(&self, record: Option<&JournaledFrame>) -> FrameExplanation {
            self.explain(record, None, 0).verdict
        }
    }

    #[test]
    fn new_frame_is_converted_when_it_is_complete() {
        let bench = Bench::new();
        let explanation = bench.explain(None, None, 0);
        assert_eq!(explanation.verdict, FrameExplanation::Converted(Decision::Convert(ConvertReason::New)));
        let file = explanation.file.expect("there");
        assert_eq!((file.content, file.change), (SniffedContent::Particles, None));
        assert_eq!(file.readiness, Readiness::Ready(Proof::Format));
        let waits = |explanation: Explanation, expected| {
            assert_eq!(explanation.verdict, FrameExplanation::Waits(expected))
        };
        waits(bench.explain(None, None, 3600), WaitReason::Changing);
        let mut bench = bench;
        bench.watch.sentinel = Some("{name}.ok".into());
        waits(bench.explain(None, None, 0), WaitReason::Sentinel);
        fs::write(bench.frame.with_file_name("dam.1.ply.ok"), "").expect("written");
        assert_eq!(
            bench.explain(None, None, 3600).file.expect("there").readiness,
            Readiness::Ready(Proof::Sentinel)
        );
    }

    #[test]
    fn done_frame_is_skipped_while_nothing_has_changed() {
        let bench = Bench::new();
        let record = bench.record(JournaledStatus::Done);
        let explanation = bench.explain(Some(&record), Some("s"), 3600);
        assert_eq!(explanation.verdict, FrameExplanation::Skipped(SkipReason::Done));
        assert_eq!((explanation.settings_hold, explanation.output_missing), (Some(true), None));
        assert_eq!(explanation.file.expect("there").change, Some(FileChange::Unchanged));

        let explanation = bench.explain(Some(&record), Some("others"), 0);
        assert_eq!(
            explanation.verdict,
            FrameExplanation::Converted(Decision::Convert(ConvertReason::SettingsChanged))
        );
        assert_eq!(explanation.settings_hold, Some(false));
        assert_eq!(bench.explain(Some(&record), None, 0).settings_hold, None);

        fs::remove_file(&bench.output).expect("removed");
        let missing = ConvertReason::OutputMissing(bench.output.clone());
        assert_eq!(bench.verdict(Some(&record)), FrameExplanation::Converted(Decision::Convert(missing)));
        let failed = bench.record(JournaledStatus::Failed);
        assert_eq!(bench.verdict(Some(&failed)), FrameExplanation::Skipped(SkipReason::FailedUnchanged));
        let refused = bench.record(JournaledStatus::Refused);
        let explanation = bench.verdict(Some(&refused)).to_string();
        assert!(explanation.starts_with("will be converted when the reason in the journal"), "{explanation}");
        // A particle file was in the place of the output.
        let reason = Some(replacement(&bench.output));
        let refused = JournaledFrame { reason, ..refused };
        assert_eq!(bench.verdict(Some(&refused)), FrameExplanation::Unblocked);
        fs::write(&bench.output, FRAME).expect("written");
        assert_eq!(bench.verdict(Some(&refused)).to_string(), explanation);
    }

    #[test]
    fn unfinished_frame_is_pending_while_a_daemon_runs() {
        let mut bench = Bench::new();
        let queued = bench.record(JournaledStatus::Queued);
        let interrupted = FrameExplanation::Converted(Decision::Convert(ConvertReason::WasInterrupted));
        assert_eq!(bench.verdict(Some(&queued)), interrupted);
        bench.has_daemon = true;
        let verdict = bench.verdict(Some(&queued));
        assert_eq!(verdict, FrameExplanation::Pending(None));
        assert_eq!(verdict.to_string(), "is queued or in flight");
        let held = JournaledFrame { reason: Some("too few particles".to_owned()), ..queued };
        assert_eq!(bench.verdict(Some(&held)).to_string(), "is not converted yet: too few particles");
        let retrying = bench.record(JournaledStatus::Retrying);
        let retry = FrameExplanation::Converted(Decision::Convert(ConvertReason::Retry));
        assert_eq!(bench.verdict(Some(&retrying)), retry);
    }

    #[test]
    fn touched_file_is_recognized_by_its_content() {
        let bench = Bench::new();
        let record = bench.record(JournaledStatus::Done);
        let touch = |bytes: &[u8], seconds| {
            bench.write(bytes);
            let time = SystemTime::UNIX_EPOCH + Duration::from_secs(seconds);
            File::options()
                .append(true)
                .open(&bench.frame)
                .and_then(|file| file.set_modified(time))
                .expect("set");
        };
        let change = || bench.explain(Some(&record), None, 0).file.expect("there").change;
        touch(FRAME, 1);
        assert_eq!(change(), Some(FileChange::Touched));
        assert_eq!(bench.verdict(Some(&record)), FrameExplanation::Skipped(SkipReason::Done));
        let rewritten = FrameExplanation::Converted(Decision::Convert(ConvertReason::InputChanged));
        let other: Vec<u8> = FRAME.iter().map(|&byte| if byte == b'0' { b'7' } else { byte }).collect();
        for bytes in [&other[..], &[FRAME, b"\n"].concat()] {
            touch(bytes, 2);
            assert_eq!(change(), Some(FileChange::Rewritten));
            assert_eq!(bench.verdict(Some(&record)), rewritten);
        }
    }

    #[test]
    fn file_that_is_not_a_frame_is_explained() {
        let mut bench = Bench::new();
        bench.watch.pattern = Some("spray*".into());
        let explanation = bench.explain(None, None, 0);
        assert_eq!((explanation.is_selected, explanation.verdict), (false, FrameExplanation::NotSelected));
        bench.watch.pattern = Some("[".into());
        let question = Question {
            frame: &bench.frame,
            watch: &bench.watch,
            output_folders: &[],
            timeouts: &StabilityTimeouts {
                settle: Duration::ZERO,
                unverifiable: Duration::ZERO,
                stalled: Duration::ZERO,
            },
            record: None,
            settings: None,
            has_daemon: false,
        };
        assert!(explain(&question).is_err_and(|error| error.kind() == io::ErrorKind::InvalidInput));

        bench.watch.pattern = Some("*.txt".into());
        bench.frame = bench.frame.with_file_name("notes.txt");
        assert_eq!(bench.verdict(None), FrameExplanation::Missing);
        bench.write(b"Nothing to see here, just words.\n");
        assert_eq!(bench.verdict(None), FrameExplanation::NotAFrame(SniffedContent::NotParticles));
    }
}
