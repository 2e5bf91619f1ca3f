//! Tests the core alone: a test sends events and checks the effects, with a simulated clock.

use std::collections::{HashMap, HashSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use meniscus_formats::Error;

use crate::pipeline::{
    ChangedOutput, DaemonRecord, DaemonState, DoneRecord, FileStamp, Frame, FrameError, FrameReport,
    InputState, LatestRecords, MeasuredSpacing, Outcome, OutputFormat, OutputOptions, Reason, RecordLine,
    SharedSettings, Stage, UnfinishedRecord, UnfinishedState,
};
use crate::surface::options::{MethodOptions, Preset};
use crate::watch::api::EndReason;
use crate::watch::config::{Order, Poll, Watch, WatchConfig};
use crate::watch::test_records::done_record;

use super::completeness::{FileHint, Proof, Seen};
use super::events::{
    Complete, Effect, Event, FileContents, FrameFinished, FrameToConvert, Inspect, Inspected,
    InspectionExtent, InspectionResult, Now, OutputFolderState, OutputRequest, RootRequest, Scan,
    SlowRequest,
};
use super::frames::FrameId;
use super::sequences::{MeasureOrder, SpacingResult};
use super::state::Core;

const GIB: u64 = 1 << 30;

/// A core, the files that it can see, and the effects that it requests.
struct Rig {
    core: Core,
    now: Now,
    /// Files by path; an incomplete file has a reason to wait.
    files: HashMap<PathBuf, (FileStamp, Option<Reason>)>,
    /// Outputs that exist.
    outputs: HashSet<PathBuf>,
    /// Outputs that would replace a user's file.
    conflicts: HashMap<PathBuf, String>,
    /// Whether inspections are answered only when a test requests it.
    holds_inspections: bool,
    inspections: Vec<Inspect>,
    started: Vec<(FrameId, Box<Frame>)>,
    orders: Vec<MeasureOrder>,
    records: Vec<RecordLine>,
}

/// Options for which no particles must be measured.
fn measured() -> MethodOptions {
    MethodOptions { preset: Some(Preset::Fluid), spacing: Some(0.1), ..MethodOptions::default() }
}

fn config(root_count: usize, choices: &MethodOptions) -> WatchConfig {
    let watch = |root: usize| Watch {
        input: format!("/in{root}").into(),
        pattern: None,
        has_level_sets: false,
        sentinel: None,
        outputs: OutputOptions::new(format!("/out{root}"), &[OutputFormat::Glb]),
        choices: choices.clone(),
        obstacles: Vec::new(),
    };
    WatchConfig {
        watches: (0..root_count).map(watch).collect(),
        once: false,
        order: Order::Natural,
        threads: 1,
        memory_bytes: GIB,
        disk_floor_bytes: GIB,
        settle: Duration::from_millis(500),
        temporal_wait: Duration::from_secs(30),
        poll: Poll::Auto,
    }
}

impl Rig {
    /// Roots `/in0` and so on with outputs in `/out0` and so on, with known settings, and one pipeline.
    fn new(root_count: usize) -> Rig {
        Rig::with(config(root_count, &measured()), LatestRecords::default())
    }

    fn with(config: WatchConfig, latest: LatestRecords) -> Rig {
        let now = Now { at: Instant::now(), unix_ms: 1000 };
        let count = config.watches.len();
        let identity = DaemonRecord {
            pid: 1,
            host: "a".to_owned(),
            started_ms: 0,
            state: DaemonState::Running,
            at_ms: 0,
        };
        let roots = (0..count).map(|root| (format!("/in{root}").into(), Arc::default())).collect();
        let mut folders: Vec<PathBuf> = Vec::new();
        let mut output_folder_of = Vec::new();
        for watch in &config.watches {
            let folder = &watch.outputs.folder;
            if !folders.contains(folder) {
                folders.push(folder.clone());
            }
            output_folder_of.extend(folders.iter().position(|known| known == folder));
        }
        let outputs = folders.into_iter().map(|folder| (folder, latest.clone(), None)).collect();
        let mut core = Core::new(Arc::new(config), identity, roots, outputs, output_folder_of, now);
        core.claim_recorded(|root, path| path.starts_with(format!("/in{root}")));
        core.start();
        let mut rig = Rig {
            core,
            now,
            files: HashMap::new(),
            outputs: HashSet::new(),
            conflicts: HashMap::new(),
            holds_inspections: false,
            inspections: Vec::new(),
            started: Vec::new(),
            orders: Vec::new(),
            records: Vec::new(),
        };
        rig.follow_up();
        rig
    }

    /// Sends an event to the core, and answers the resulting requests.
    fn event(&mut self, event: Event) {
        self.core.handle(event, self.now);
        self.follow_up();
    }

    fn follow_up(&mut self) {
        loop {
            self.core.follow_up(self.now);
            let effects = self.core.take_effects();
            if effects.is_empty() && (self.holds_inspections || self.inspections.is_empty()) {
                return;
            }
            for effect in effects {
                match effect {
                    Effect::Root(_, RootRequest::Inspect(inspect)) => self.inspections.push(*inspect),
                    Effect::Slow(SlowRequest::Measure(order)) => self.orders.push(*order),
                    Effect::Output(_, OutputRequest::Record(line, _)) => self.records.push(line),
                    Effect::Convert(FrameToConvert { id, frame, .. }) => self.started.push((id, frame)),
                    Effect::Root(..) | Effect::Slow(..) | Effect::Output(..) | Effect::Log(_) => {}
                }
            }
            if !self.holds_inspections {
                for inspect in std::mem::take(&mut self.inspections) {
                    let answer = self.answer(&inspect);
                    self.core.handle(answer, self.now);
                }
            }
        }
    }

    /// The answer of a worker.
    fn answer(&self, inspect: &Inspect) -> Event {
        let found = match self.files.get(&*inspect.id.path) {
            None => InspectionResult::Missing,
            Some((stamp, _)) if *stamp != inspect.stamp => {
                InspectionResult::Changed(seen(*stamp), self.now.at)
            }
            Some(_) if inspect.extent == InspectionExtent::Stamp => InspectionResult::Same,
            Some((_, waits)) => self.found(inspect, waits.clone()),
        };
        let (id, number) = (inspect.id.clone(), inspect.number);
        Event::Inspected(Box::new(Inspected { id, number, found, obstacles: None }))
    }

    fn found(&self, inspect: &Inspect, waits: Option<Reason>) -> InspectionResult {
        let mut changed_output = None;
        if let Some(check) = &inspect.record_check {
            let folder = &self.core.output_folder(inspect.id.root).folder;
            let outputs = check.record.if_done().into_iter().flat_map(|done| done.output_paths(folder));
            match outputs.into_iter().find(|path| !self.outputs.contains(path)) {
                None => return InspectionResult::AsRecorded,
                Some(path) => changed_output = Some(ChangedOutput { path, is_missing: true }),
            }
        }
        if let Some(why) = waits.filter(|_| inspect.candidate.is_some()) {
            return InspectionResult::Waiting { until: Some(self.now.at + Duration::from_secs(1)), why };
        }
        let conflict = inspect.outputs.iter().find_map(|output| self.conflicts.get(output)).cloned();
        let proof = inspect.candidate.map(|_| Proof::Format);
        InspectionResult::Complete(Complete {
            proof,
            changed_output,
            has_changed_files: false,
            contents: FileContents::Frame,
            conflict,
        })
    }

    fn pass(&mut self, time: Duration) {
        self.now.at += time;
        self.now.unix_ms += u64::try_from(time.as_millis()).expect("soon");
        self.follow_up();
    }

    /// Writes a file, and sends an event for it.
    fn put(&mut self, path: &str, version: u64) {
        self.files.insert(path.into(), (stamp(version), None));
        self.send_event(path);
    }

    /// Sends an event with the current state of a file.
    fn send_event(&mut self, path: &str) {
        self.send(path, FileHint::Changed);
    }

    fn send(&mut self, path: &str, hint: FileHint) {
        let (id, at) = (id(path), self.now.at);
        let event = match self.files.get(Path::new(path)) {
            Some((stamp, _)) => Event::FileSeen { id, seen: seen(*stamp), at, hint },
            None => Event::FileRemoved(id),
        };
        self.event(event);
    }

    fn scan(&mut self, root: usize) {
        let folder = format!("/in{root}");
        let files = self.files.iter().filter(|(path, _)| path.starts_with(&folder));
        let files = files.map(|(path, (stamp, _))| (path.clone(), seen(*stamp))).collect();
        let found = Ok(Scan { files, ..Scan::default() });
        self.event(Event::RootScanned { root, found, at: self.now.at });
    }

    fn want(&mut self) {
        self.event(Event::FrameRequested);
    }

    /// The names of the frames that were started since the last call.
    fn started(&mut self) -> Vec<String> {
        self.started.drain(..).map(|(id, _)| name(&id)).collect()
    }

    fn finish(&mut self, path: &str, outcome: Outcome) {
        if let Outcome::Converted(report) = &outcome
            && let Some(record) = &report.record
        {
            self.outputs.extend(record.output_paths(&self.core.output_folder(id(path).root).folder));
        }
        let free_bytes = self.core.output_folders[0].free_bytes;
        let finished = FrameFinished { id: id(path), outcome, free_bytes, named: None };
        self.event(Event::FrameFinished(Box::new(finished)));
    }

    fn convert(&mut self, path: &str) {
        let stamp = self.files.get(Path::new(path)).expect("there").0;
        self.convert_from(path, stamp);
    }

    /// The pipeline has converted the frame from a file with this stamp.
    fn convert_from(&mut self, path: &str, stamp: FileStamp) {
        let id = id(path);
        let sequence = self.core.frames.get(&id).expect("known").sequence;
        let settings = self.core.sequences.get(sequence).settings_id().unwrap_or_default().to_owned();
        let at_ms = self.now.unix_ms;
        let record = DoneRecord { settings, at_ms, ..(*done_record(&id.path, stamp)).clone() };
        let (input, record) = (InputState { stamp, hash: 7, named: None }, Some(Arc::new(record)));
        self.finish(
            path,
            Outcome::Converted(Box::new(FrameReport { input, record, ..FrameReport::default() })),
        );
    }

    fn fail(&mut self, path: &str, during: Stage, kind: io::ErrorKind) {
        let of_file = if during == Stage::Write { "/out0/a.1.glb" } else { path };
        let error = FrameError::file(Path::new(of_file), during, Error::Io(kind.into()));
        self.finish(path, Outcome::Failed(error));
    }

    fn set_free_bytes(&mut self, free_bytes: u64) {
        let found =
            OutputFolderState { output: 0, was_removed: false, lost: None, free_bytes: Some(free_bytes) };
        self.event(Event::OutputFolderChecked(found));
    }

    /// The recorded states of a frame, in order; `None` when it was done.
    fn states(&self, path: &str) -> Vec<Option<UnfinishedState>> {
        let of_frame = |line: &RecordLine| match line {
            RecordLine::Done(record) if record.input == *path => Some(None),
            RecordLine::Unfinished(record) if record.input == *path => Some(Some(record.state)),
            _ => None,
        };
        self.records.iter().filter_map(of_frame).collect()
    }

    fn status(&self) -> String {
        self.core.status_line()
    }
}

fn id(path: &str) -> FrameId {
    let root = path["/in".len()..].split('/').next().expect("a root").parse().expect("a number");
    FrameId::new(root, Path::new(path))
}

fn name(id: &FrameId) -> String {
    id.path.file_name().expect("a name").to_string_lossy().into_owned()
}

fn stamp(version: u64) -> FileStamp {
    FileStamp { size: 100, modified_ns: version as i64, inode: version, changed_ns: None }
}

fn seen(stamp: FileStamp) -> Seen {
    Seen { stamp, age: Some(Duration::from_secs(60)) }
}

const SECOND: Duration = Duration::from_secs(1);

#[test]
fn complete_frame_goes_to_the_pipeline_that_asked_for_one() {
    let mut rig = Rig::new(1);
    rig.put("/in0/a.2.ply", 1);
    rig.put("/in0/a.10.ply", 1);
    rig.put("/in0/a.1.ply", 1);
    assert!(rig.started().is_empty(), "no pipeline has asked for a frame");
    rig.want();
    rig.want();
    assert_eq!(rig.started(), ["a.1.ply", "a.2.ply"]);
    rig.convert("/in0/a.1.ply");
    assert_eq!(rig.status(), "1 done, 2 queued");
    assert_eq!(rig.states("/in0/a.1.ply"), [Some(UnfinishedState::Queued), None]);
}

#[test]
fn lost_doubled_or_late_events_change_nothing() {
    let mut rig = Rig::new(1);
    rig.want();
    for _ in 0..3 {
        rig.put("/in0/a.1.ply", 1);
    }
    assert_eq!(rig.started(), ["a.1.ply"]);
    rig.convert("/in0/a.1.ply");
    rig.want();
    // A repeated event: the frame is done already.
    rig.send_event("/in0/a.1.ply");
    assert!(rig.started().is_empty());
    // A lost event: only a scan reports this file.
    rig.files.insert("/in0/a.2.ply".into(), (stamp(1), None));
    rig.scan(0);
    assert_eq!(rig.started(), ["a.2.ply"]);
    rig.convert("/in0/a.2.ply");
    // A late event: it is about a version of the file that was replaced meanwhile.
    rig.want();
    rig.files.insert("/in0/a.1.ply".into(), (stamp(3), None));
    let (id, at) = (id("/in0/a.1.ply"), rig.now.at);
    rig.event(Event::FileSeen { id, seen: seen(stamp(2)), at, hint: FileHint::Changed });
    assert_eq!(rig.started(), ["a.1.ply"]);
    rig.convert("/in0/a.1.ply");
    assert_eq!(rig.status(), "2 done, 0 queued");
    // Events about a removed file, and about a file that never existed.
    rig.files.clear();
    rig.send_event("/in0/a.1.ply");
    rig.send_event("/in0/never.ply");
    assert_eq!(rig.status(), "1 done, 0 queued");
}

#[test]
fn result_of_an_earlier_inspection_is_disregarded() {
    let mut rig = Rig::new(1);
    rig.want();
    rig.holds_inspections = true;
    rig.put("/in0/a.1.ply", 1);
    let early = rig.answer(&rig.inspections[0]);
    rig.files.insert("/in0/a.1.ply".into(), (stamp(2), Some(Reason::Changing)));
    rig.send_event("/in0/a.1.ply");
    assert_eq!(rig.inspections.len(), 2);
    rig.event(early);
    assert!(rig.started().is_empty(), "the file is being written again");
    rig.holds_inspections = false;
    rig.follow_up();
    assert!(rig.started().is_empty());
    rig.files.insert("/in0/a.1.ply".into(), (stamp(2), None));
    rig.pass(SECOND);
    assert_eq!(rig.started(), ["a.1.ply"]);
}

#[test]
fn file_that_changes_while_it_is_converted_is_converted_again() {
    let mut rig = Rig::new(1);
    rig.want();
    rig.put("/in0/a.1.ply", 1);
    assert_eq!(rig.started(), ["a.1.ply"]);
    rig.put("/in0/a.1.ply", 2);
    rig.want();
    assert!(rig.started().is_empty(), "it is in progress");
    rig.convert_from("/in0/a.1.ply", stamp(1));
    assert_eq!(rig.started(), ["a.1.ply"]);
    rig.finish("/in0/a.1.ply", Outcome::Changed);
    rig.want();
    rig.pass(SECOND);
    assert_eq!(rig.started(), ["a.1.ply"]);
}

/// A memory map changes the content of a file, and not its stamp.
#[test]
fn file_that_is_closed_with_the_same_stamp_is_read_again() {
    let mut rig = Rig::new(1);
    rig.want();
    rig.put("/in0/a.1.ply", 1);
    assert_eq!(rig.started(), ["a.1.ply"]);
    rig.want();
    rig.send("/in0/a.1.ply", FileHint::Closed);
    assert!(rig.started().is_empty(), "it is in progress");
    rig.convert("/in0/a.1.ply");
    assert_eq!(rig.started(), ["a.1.ply"]);
    rig.want();
    rig.convert("/in0/a.1.ply");
    assert!(rig.started().is_empty(), "it was read after its writer closed it");
    rig.send("/in0/a.1.ply", FileHint::Closed);
    assert_eq!(rig.started(), ["a.1.ply"]);
    let error = FrameError::file(Path::new("/in0/a.1.ply"), Stage::Read, Error::unsupported("PLY", "no"));
    rig.finish("/in0/a.1.ply", Outcome::Failed(error));
    assert_eq!(rig.status(), "0 done, 0 queued, 1 failed");
    rig.want();
    rig.send("/in0/a.1.ply", FileHint::Closed);
    assert_eq!(rig.started(), ["a.1.ply"]);
}

#[test]
fn closed_file_is_read_again_although_a_scan_finds_it_unchanged_meanwhile() {
    let mut rig = Rig::new(1);
    rig.want();
    rig.put("/in0/a.1.ply", 1);
    rig.convert("/in0/a.1.ply");
    assert_eq!(rig.started(), ["a.1.ply"]);
    rig.want();
    rig.holds_inspections = true;
    rig.send("/in0/a.1.ply", FileHint::Closed);
    rig.scan(0);
    rig.holds_inspections = false;
    rig.follow_up();
    assert_eq!(rig.started(), ["a.1.ply"]);
}

#[test]
fn failures_are_retried_with_growing_waits_up_to_a_limit() {
    let mut rig = Rig::new(1);
    rig.put("/in0/a.1.ply", 1);
    let mut waits = Vec::new();
    for _ in 0..12 {
        rig.want();
        let mut waited = 0.0;
        while rig.started().is_empty() {
            assert!(waited < 100.0, "after {waits:?}");
            rig.pass(Duration::from_millis(250));
            waited += 0.25;
        }
        waits.push(waited);
        rig.fail("/in0/a.1.ply", Stage::Read, io::ErrorKind::PermissionDenied);
    }
    assert_eq!(waits[..6], [0.0, 0.5, 1.0, 2.0, 4.0, 8.0]);
    assert_eq!(rig.states("/in0/a.1.ply").last(), Some(&Some(UnfinishedState::AwaitsRestart)));
    rig.want();
    rig.pass(Duration::from_secs(3600));
    assert!(rig.started().is_empty());
    // A changed frame is tried again.
    rig.put("/in0/a.1.ply", 2);
    assert_eq!(rig.started(), ["a.1.ply"]);
    // A file that is removed before it is read is not a failure.
    rig.files.clear();
    rig.fail("/in0/a.1.ply", Stage::Read, io::ErrorKind::NotFound);
    assert_eq!(rig.status(), "0 done, 0 queued");
}

#[test]
fn low_disk_space_pauses_until_there_is_more() {
    let mut rig = Rig::new(1);
    rig.set_free_bytes(GIB - 1);
    rig.put("/in0/a.1.ply", 1);
    rig.want();
    assert!(rig.started().is_empty());
    assert!(rig.status().contains("paused: /out0 has"), "{}", rig.status());
    rig.set_free_bytes(GIB);
    assert_eq!(rig.started(), ["a.1.ply"]);

    // After a full disk, the frame is tried again when space was freed, or after a while.
    rig.fail("/in0/a.1.ply", Stage::Write, io::ErrorKind::StorageFull);
    rig.want();
    rig.set_free_bytes(GIB - 1);
    rig.pass(4 * SECOND);
    assert!(rig.started().is_empty());
    assert_eq!(rig.states("/in0/a.1.ply").last(), Some(&Some(UnfinishedState::Queued)));
    rig.set_free_bytes(2 * GIB);
    assert_eq!(rig.started(), ["a.1.ply"]);
}

#[test]
fn removed_outputs_are_made_again() {
    let mut rig = Rig::new(1);
    rig.want();
    rig.put("/in0/a.1.ply", 1);
    rig.convert("/in0/a.1.ply");
    rig.started();
    rig.want();
    rig.outputs.clear();
    let found = OutputFolderState { output: 0, was_removed: true, lost: None, free_bytes: Some(2 * GIB) };
    rig.event(Event::OutputFolderChecked(found));
    rig.scan(0);
    assert_eq!(rig.started(), ["a.1.ply"]);
}

#[test]
fn unmounted_root_keeps_its_state() {
    let mut rig = Rig::new(1);
    rig.want();
    rig.put("/in0/a.1.ply", 1);
    rig.convert("/in0/a.1.ply");
    rig.started();
    for _ in 0..2 {
        let found = Err("it is empty but had files before (is it mounted?)".to_owned());
        rig.event(Event::RootScanned { root: 0, found, at: rig.now.at });
    }
    assert_eq!(rig.status(), "1 done, 0 queued; /in0 is unavailable");
    rig.files.insert("/in0/a.2.ply".into(), (stamp(1), None));
    rig.want();
    rig.scan(0);
    assert_eq!(rig.started(), ["a.2.ply"]);
    assert_eq!(rig.status(), "1 done, 1 queued");
}

#[test]
fn output_that_is_removed_is_made_again() {
    let mut rig = Rig::new(1);
    rig.want();
    rig.put("/in0/a.1.ply", 1);
    rig.convert("/in0/a.1.ply");
    rig.want();
    rig.started();
    rig.outputs.clear();
    rig.scan(0);
    assert_eq!(rig.started(), ["a.1.ply"]);
}

#[test]
fn outputs_claimed_twice_belong_to_the_first_frame_until_it_is_removed() {
    let mut rig = Rig::new(1);
    rig.want();
    rig.want();
    rig.put("/in0/a.1.ply", 1);
    rig.put("/in0/a.1.csv", 1);
    assert_eq!(rig.started(), ["a.1.ply"]);
    assert_eq!(rig.states("/in0/a.1.csv"), [Some(UnfinishedState::Refused)]);
    rig.convert("/in0/a.1.ply");
    rig.files.remove(Path::new("/in0/a.1.ply"));
    rig.send_event("/in0/a.1.ply");
    assert_eq!(rig.started(), ["a.1.csv"]);
    let refused = rig.core.summary(EndReason::Finish).failed;
    assert!(refused.is_empty(), "{refused:?}");
}

/// Two folders with the same outputs: the frame that was converted keeps them after a restart.
#[test]
fn recorded_owner_keeps_its_outputs_whichever_folder_is_scanned_first() {
    let mut config = config(2, &measured());
    config.watches[1].outputs.folder = "/out0".into();
    let mut before = Rig::with(config.clone(), LatestRecords::default());
    before.want();
    before.put("/in1/a.1.ply", 1);
    before.convert("/in1/a.1.ply");
    let mut latest = LatestRecords::default();
    before.records.iter().for_each(|line| latest.insert(line));

    let restart = |files: &[&str]| {
        let mut rig = Rig::with(config.clone(), latest.clone());
        rig.outputs.clone_from(&before.outputs);
        rig.files.extend(files.iter().map(|file| (PathBuf::from(file), (stamp(1), None))));
        rig.want();
        rig.scan(0);
        assert!(rig.started().is_empty(), "the folder of the owner is not scanned yet");
        rig.scan(1);
        rig
    };
    let mut rig = restart(&["/in0/a.1.ply", "/in1/a.1.ply"]);
    assert!(rig.started().is_empty());
    assert_eq!(rig.status(), "1 done, 0 queued, 1 failed");
    assert_eq!(rig.states("/in0/a.1.ply"), [Some(UnfinishedState::Refused)]);
    let mut rig = restart(&["/in0/a.1.ply"]);
    assert_eq!(rig.started(), ["a.1.ply"], "the owner is gone");
}

#[test]
fn frame_whose_output_would_replace_a_users_file_is_refused() {
    let mut rig = Rig::new(1);
    rig.want();
    rig.conflicts.insert("/out0/a.1.glb".into(), "its output would replace a particle file".to_owned());
    rig.put("/in0/a.1.ply", 1);
    assert!(rig.started().is_empty());
    assert_eq!(rig.states("/in0/a.1.ply"), [Some(UnfinishedState::Refused)]);
}

#[test]
fn refused_frame_is_checked_at_each_scan() {
    let mut rig = Rig::new(1);
    rig.want();
    let output = PathBuf::from("/out0/a.1.glb");
    rig.conflicts.insert(output.clone(), "its output would replace a particle file".to_owned());
    rig.put("/in0/a.1.ply", 1);
    // The same conflict is reported once.
    rig.scan(0);
    rig.scan(0);
    assert!(rig.started().is_empty());
    assert_eq!(rig.states("/in0/a.1.ply"), [Some(UnfinishedState::Refused)]);
    rig.conflicts.insert(output, "its output would replace an obstacle".to_owned());
    rig.scan(0);
    assert_eq!(rig.states("/in0/a.1.ply"), [Some(UnfinishedState::Refused); 2]);
    rig.conflicts.clear();
    rig.scan(0);
    assert_eq!(rig.started(), ["a.1.ply"]);
    rig.convert("/in0/a.1.ply");
    let refused = rig.core.summary(EndReason::Finish).failed;
    assert!(refused.is_empty(), "{refused:?}");
}

/// The records of one frame that was converted, and then was in this state.
fn latest_records(state: Option<UnfinishedState>) -> LatestRecords {
    let mut rig = Rig::new(1);
    rig.want();
    rig.put("/in0/a.1.ply", 1);
    rig.convert("/in0/a.1.ply");
    let mut latest = LatestRecords::default();
    rig.records.iter().for_each(|line| latest.insert(line));
    let queued = rig.records.iter().find_map(|line| match line {
        RecordLine::Unfinished(record) => Some(UnfinishedRecord::clone(record)),
        _ => None,
    });
    if let Some(state) = state {
        let record = UnfinishedRecord { state, ..queued.expect("it was queued") };
        latest.insert(&RecordLine::Unfinished(record.into()));
    }
    latest
}

#[test]
fn after_a_restart_only_unfinished_frames_are_converted() {
    for (state, has_output, expected) in [
        (None, true, 0),
        (None, false, 1),
        (Some(UnfinishedState::Failed), true, 0),
        (Some(UnfinishedState::Queued), true, 1),
        (Some(UnfinishedState::Retrying), true, 1),
        (Some(UnfinishedState::AwaitsRestart), true, 1),
        (Some(UnfinishedState::Refused), true, 1),
    ] {
        let mut rig = Rig::with(config(1, &measured()), latest_records(state));
        rig.want();
        rig.files.insert("/in0/a.1.ply".into(), (stamp(1), None));
        if has_output {
            rig.outputs.insert("/out0/a.1.glb".into());
        }
        rig.scan(0);
        assert!(rig.core.is_ready());
        assert_eq!(rig.started().len(), expected, "{state:?}");
    }
    // With other settings, the frame is converted again.
    let other = MethodOptions { spacing: Some(0.2), ..MethodOptions::default() };
    let mut rig = Rig::with(config(1, &other), latest_records(None));
    rig.outputs.insert("/out0/a.1.glb".into());
    rig.want();
    rig.put("/in0/a.1.ply", 1);
    assert_eq!(rig.started(), ["a.1.ply"]);
}

#[test]
fn run_with_once_is_drained_only_when_all_frames_are_done() {
    let mut rig = Rig::with(WatchConfig { once: true, ..config(1, &measured()) }, LatestRecords::default());
    assert!(!rig.core.is_drained(), "nothing was scanned yet");
    rig.files.insert("/in0/a.1.ply".into(), (stamp(1), None));
    rig.holds_inspections = true;
    rig.scan(0);
    assert!(!rig.core.is_ready() && !rig.core.is_drained());
    rig.holds_inspections = false;
    rig.follow_up();
    assert!(rig.core.is_ready() && !rig.core.is_drained(), "one is queued");
    rig.want();
    assert!(!rig.core.is_drained(), "one is in progress");
    rig.convert("/in0/a.1.ply");
    assert!(rig.core.is_drained());
}

#[test]
fn stop_starts_no_further_frame() {
    let mut rig = Rig::new(1);
    rig.want();
    rig.put("/in0/a.1.ply", 1);
    rig.put("/in0/a.2.ply", 1);
    assert_eq!(rig.started(), ["a.1.ply"]);
    rig.core.stop();
    rig.want();
    rig.convert("/in0/a.1.ply");
    assert!(rig.started().is_empty());
    let summary = rig.core.summary(EndReason::Finish);
    assert_eq!((summary.done_count, summary.left_count), (1, 1));
}

/// The recorded reasons of a frame, in order.
#[test]
fn reasons_are_recorded() {
    let mut rig = Rig::new(1);
    let path = "/in0/a.1.ply";
    let half = |found| Reason::Incomplete { expected: 100, found };
    for (version, why) in [(1, Reason::Changing), (2, half(40)), (3, half(50))] {
        rig.files.insert(path.into(), (stamp(version), Some(why)));
        rig.send_event(path);
    }
    rig.put(path, 4);
    rig.want();
    rig.convert(path);
    rig.put(path, 5);
    rig.want();
    rig.fail(path, Stage::Read, io::ErrorKind::PermissionDenied);
    let reasons: Vec<Option<Reason>> = rig
        .records
        .iter()
        .filter_map(|line| match line {
            RecordLine::Unfinished(record) => Some(record.reason.clone()),
            RecordLine::Done(_) => Some(None),
            _ => None,
        })
        .collect();
    let [changing, incomplete, new, done, again, Some(Reason::Error(error))] = &reasons[..] else {
        panic!("{reasons:?}")
    };
    assert_eq!([changing, incomplete], [&Some(Reason::Changing), &Some(half(40))]);
    assert_eq!([new, done, again], [&Some(Reason::New), &None, &Some(Reason::Touched)]);
    assert!(error.starts_with("/in0/a.1.ply"), "{error}");
    let failed = rig.core.record_of(&id(path)).expect("recorded");
    let state = failed.unfinished.as_ref().map(|record| record.state);
    assert_eq!((state, failed.done.is_some()), (Some(UnfinishedState::Retrying), true));
}

/// A waiting file that turns out to be no frame must not stay listed as waiting.
#[test]
fn waiting_file_that_is_no_frame_is_recorded_as_ignored() {
    let mut rig = Rig::new(1);
    let path = "/in0/notes.txt";
    rig.files.insert(path.into(), (stamp(1), Some(Reason::Changing)));
    rig.send_event(path);
    rig.files.insert(path.into(), (stamp(1), None));
    rig.holds_inspections = true;
    rig.send_event(path);
    let inspect = rig.inspections.pop().expect("an inspection");
    let complete = Complete {
        proof: Some(Proof::Format),
        changed_output: None,
        has_changed_files: false,
        contents: FileContents::NotParticles,
        conflict: None,
    };
    rig.event(Event::Inspected(Box::new(Inspected {
        id: id(path),
        number: inspect.number,
        found: InspectionResult::Complete(complete),
        obstacles: None,
    })));
    assert_eq!(rig.states(path), [UnfinishedState::Waiting, UnfinishedState::Ignored].map(Some));
}

#[test]
fn sequence_is_measured_when_all_its_frames_were_inspected() {
    let mut rig = Rig::with(config(1, &MethodOptions::default()), LatestRecords::default());
    rig.want();
    rig.files.extend((1..=3).map(|number| (format!("/in0/a.{number}.ply").into(), (stamp(1), None))));
    rig.holds_inspections = true;
    rig.scan(0);
    let inspections = std::mem::take(&mut rig.inspections);
    for (index, inspect) in inspections.iter().enumerate() {
        assert!(rig.orders.is_empty(), "measured after {index} frames");
        let answer = rig.answer(inspect);
        rig.event(answer);
    }
    rig.holds_inspections = false;
    let order = rig.orders.pop().expect("an order");
    assert_eq!(
        order.files.iter().map(|(id, _)| name(id)).collect::<Vec<_>>(),
        ["a.1.ply", "a.2.ply", "a.3.ply"]
    );
    assert!(rig.started().is_empty());
    let measured = MeasuredSpacing {
        spacing: 0.1,
        confidence: 1.0,
        irregularity: None,
        radius_median: None,
        measured_on: "/in0/a.1.ply".into(),
        measured_count: 1,
        warnings: Vec::new(),
    };
    rig.event(Event::Measured(Box::new(SpacingResult {
        sequence: order.sequence,
        record: Some(SharedSettings { measured: Some(measured), ..SharedSettings::default() }),
        sparse: Vec::new(),
        unreadable: Vec::new(),
        changed: None,
        warnings: Vec::new(),
    })));
    assert_eq!(rig.started(), ["a.1.ply"]);
    assert_eq!(rig.status(), "0 done, 3 queued");
}
