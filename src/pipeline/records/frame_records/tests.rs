use std::fs::{self, File};
use std::io::Write as _;
use std::thread;
use std::time::{Duration, Instant};

use glam::DVec3;

use super::super::known_records::DONE_PER_FRAME_MAX;
use super::super::record_file::{LOCK_EXTENSION, record_files};
use super::super::record_line::{DaemonState, SequenceCamera};
use super::*;
use crate::pipeline::files::out_folder::is_disk_full;
use crate::pipeline::{Framed, MeasuredSpacing};

fn values(voxel_size: &str) -> SettingValues {
    [("voxel_size", voxel_size), ("formats", "glb")].map(|(n, v)| (n.to_owned(), v.to_owned())).into()
}

/// Writes the outputs of a frame, and records them.
fn convert(records: &FrameRecords, name: &str, bytes: &str, voxel_size: &str) {
    let path = records.folder().join(format!("{name}.glb"));
    fs::write(&path, bytes).expect("written");
    let file = InputFile::open(&path).expect("opened");
    let output = OutputFile {
        name: format!("{name}.glb").into(),
        stamp: file.stamp(),
        hash: file.hash().expect("read"),
    };
    let settings = values(voxel_size);
    let record = DoneRecord {
        name: name.into(),
        input: format!("/in/{name}.ply").into(),
        stamp: FileStamp::default(),
        input_hash: 7,
        named: None,
        obstacles: String::new(),
        around: Vec::new(),
        obstacle_stamp: None,
        settings: settings_id(&settings),
        camera: None,
        outputs: vec![output],
        violations: (bytes == "broken").then(|| "1 hole".to_owned()),
        flaws: Vec::new(),
        at_ms: now_ms(),
        figures: Arc::default(),
        certificate: None,
    };
    records.add_done(Arc::new(record), &settings).expect("recorded");
}

fn wanted<'a>(name: &'a str, (id, settings): &'a (String, SettingValues), input_hash: u128) -> Wanted<'a> {
    let name = Path::new(name);
    Wanted {
        name,
        settings_id: id,
        outputs: Some(vec![name.with_added_extension("glb")]),
        input_hash: Some(input_hash),
        obstacles: Some(""),
        around: None,
        settings: Some(settings),
        cameras: Vec::new(),
    }
}

fn state(records: &FrameRecords, name: &str, voxel_size: &str, input_hash: u128) -> ResultState {
    let settings = (settings_id(&values(voxel_size)), values(voxel_size));
    records.state(&wanted(name, &settings, input_hash), OutputComparison::Stamps).0
}

fn touch(path: &Path) {
    let file = File::options().write(true).open(path).expect("opened");
    file.set_modified(std::time::UNIX_EPOCH).expect("set");
}

#[test]
fn state_follows_from_the_record_and_the_files() {
    let folder = tempfile::tempdir().expect("a folder");
    let records = FrameRecords::open(folder.path()).expect("opened");
    let path = folder.path().join("a.glb");
    assert_eq!(state(&records, "a", "0.1", 7), ResultState::Missing("there is no record of it".to_owned()));
    records.add_failure(Path::new("a"), Path::new("/in/a.ply"), "torn").expect("recorded");
    assert_eq!(state(&records, "a", "0.1", 7), ResultState::Missing("it failed: torn".to_owned()));
    convert(&records, "a", "mesh", "0.1");
    assert_eq!(state(&records, "a", "0.1", 7), ResultState::Done);
    let stale = "made with voxel_size 0.1; the current setting is 0.2";
    assert_eq!(state(&records, "a", "0.2", 7), ResultState::Stale(stale.to_owned()));
    let changed = "the input has changed since it was made";
    assert_eq!(state(&records, "a", "0.1", 8), ResultState::Stale(changed.to_owned()));
    touch(&path);
    assert_eq!(state(&records, "a", "0.1", 7), ResultState::Done, "the same bytes under another time");
    let (_, record) = records
        .state(&wanted("a", &(settings_id(&values("0.1")), values("0.1")), 7), OutputComparison::Stamps);
    let stamp = InputFile::open(&path).expect("opened").stamp();
    assert_eq!(record.expect("a record").outputs[0].stamp, stamp, "the record has the current stamp");
    fs::write(&path, "mEsh").expect("written");
    assert!(matches!(state(&records, "a", "0.1", 7), ResultState::Damaged(_)));
    fs::write(&path, "mes").expect("written");
    assert!(matches!(state(&records, "a", "0.1", 7), ResultState::Damaged(_)));
    fs::remove_file(&path).expect("removed");
    assert_eq!(state(&records, "a", "0.1", 7), ResultState::Missing("a.glb".to_owned()));
    convert(&records, "a", "broken", "0.1");
    assert_eq!(state(&records, "a", "0.1", 7), ResultState::DoneWithViolations("1 hole".to_owned()));
}

#[test]
fn new_records_count_even_if_the_clock_was_set_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let records = FrameRecords::open(folder.path()).expect("opened");
    convert(&records, "a", "old", "0.1");
    let first = Arc::clone(&records.done()[Path::new("a")][0]);
    for index in 0..DONE_PER_FRAME_MAX as u128 {
        let record = DoneRecord { at_ms: u64::MAX / 2, input_hash: 100 + index, ..(*first).clone() };
        records.keep(RecordLine::Done(Arc::new(record)));
    }
    convert(&records, "a", "new", "0.2");
    assert_eq!(state(&records, "a", "0.2", 7), ResultState::Done);
    let input = Path::new("/in/a.ply");
    records.add_failure(Path::new("a"), input, "torn").expect("recorded");
    for records in [&records, &FrameRecords::open(folder.path()).expect("opened")] {
        assert_eq!(state(records, "a", "0.2", 7), ResultState::Done);
        assert_eq!(records.latest().frames[input].unfinished_state(), Some(UnfinishedState::Failed));
    }
    convert(&records, "a", "newer", "0.2");
    for records in [&records, &FrameRecords::open(folder.path()).expect("opened")] {
        assert_eq!(state(records, "a", "0.2", 7), ResultState::Done);
        assert!(records.latest().frames[input].if_done().is_some());
    }
}

#[test]
fn damaged_lines_are_reported_and_torn_ones_are_not() {
    let folder = tempfile::tempdir().expect("a folder");
    let records = FrameRecords::open(folder.path()).expect("opened");
    convert(&records, "a", "mesh", "0.1");
    let path = records.content().own.as_ref().expect("a file").path.clone();
    drop(records);
    let append = |bytes: &[u8]| {
        File::options().append(true).open(&path).and_then(|mut file| file.write_all(bytes)).expect("written");
    };
    append(b"0123456789abcdef {\"done\":");
    let records = FrameRecords::open(folder.path()).expect("opened");
    convert(&records, "b", "mesh", "0.1");
    drop(records);
    assert!(FrameRecords::open(folder.path()).expect("opened").problems().is_empty(), "a torn line");
    append(b"0123456789abcdef {}\n");
    let records = FrameRecords::open(folder.path()).expect("opened");
    assert_eq!(records.problems(), [format!("{}: damaged lines: 1", path.display())]);
    assert_eq!(state(&records, "b", "0.1", 7), ResultState::Done);
}

/// The outputs of an older record are put back, for example from a backup.
#[test]
fn any_record_that_holds_counts() {
    let folder = tempfile::tempdir().expect("a folder");
    let records = FrameRecords::open(folder.path()).expect("opened");
    convert(&records, "a", "old", "0.1");
    convert(&records, "a", "new", "0.2");
    assert_eq!(state(&records, "a", "0.2", 7), ResultState::Done);
    assert!(matches!(state(&records, "a", "0.1", 7), ResultState::Damaged(_) | ResultState::Stale(_)));
    fs::write(folder.path().join("a.glb"), "old").expect("written");
    assert_eq!(state(&records, "a", "0.1", 7), ResultState::Done);
    assert!(!state(&records, "a", "0.2", 7).is_done());
}

#[test]
fn processes_that_write_at_the_same_time_see_each_others_records() {
    let folder = tempfile::tempdir().expect("a folder");
    let [one, other] = [(); 2].map(|()| FrameRecords::open(folder.path()).expect("opened"));
    convert(&one, "a", "mesh", "0.1");
    convert(&other, "b", "mesh", "0.1");
    assert_eq!(state(&one, "a", "0.1", 7), ResultState::Done);
    assert_eq!(state(&other, "b", "0.1", 7), ResultState::Done);
    for (records, name) in [(&one, "b"), (&other, "a")] {
        // The records of others are read again after a pause, which is long if the last read was slow.
        let start = Instant::now();
        while !state(records, name, "0.1", 7).is_done() && start.elapsed() < Duration::from_secs(60) {
            thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(state(records, name, "0.1", 7), ResultState::Done);
    }
    let file_count = || record_files(&folder.path().join(STATE_FOLDER)).expect("read").len();
    assert_eq!(file_count(), 2);
    drop((one, other));
    let later = FrameRecords::open(folder.path()).expect("opened");
    convert(&later, "c", "mesh", "0.1");
    assert_eq!(file_count(), 2, "an abandoned file is continued");
    assert_eq!(later.done().len(), 3);
}

#[test]
fn torn_and_damaged_lines_are_skipped() {
    let folder = tempfile::tempdir().expect("a folder");
    let records = FrameRecords::open(folder.path()).expect("opened");
    convert(&records, "a", "mesh", "0.1");
    convert(&records, "b", "mesh", "0.1");
    drop(records);
    let path = record_files(&folder.path().join(STATE_FOLDER)).expect("read").remove(0);
    let bytes = fs::read(&path).expect("read");
    // Without its line break, the last line is still complete.
    for end in (0..bytes.len() - 1).step_by(7) {
        fs::write(&path, &bytes[..end]).expect("written");
        let records = FrameRecords::open(folder.path()).expect("opened");
        convert(&records, "c", "mesh", "0.1");
        assert!(!state(&records, "b", "0.1", 7).is_done(), "{end}");
        drop(records);
        let records = FrameRecords::open(folder.path()).expect("opened");
        assert_eq!(state(&records, "c", "0.1", 7), ResultState::Done, "{end}");
    }
    for at in (0..bytes.len()).step_by(3) {
        let mut damaged = bytes.clone();
        damaged[at] ^= 1;
        fs::write(&path, &damaged).expect("written");
        let records = FrameRecords::open(folder.path()).expect("opened");
        let states = ["a", "b"].map(|name| state(&records, name, "0.1", 7));
        assert!(
            states.iter().all(|s| matches!(s, ResultState::Done | ResultState::Missing(_))),
            "{at}: {states:?}"
        );
    }
}

fn unfinished(name: &str, state: UnfinishedState, at_ms: u64) -> RecordLine {
    RecordLine::Unfinished(Arc::new(UnfinishedRecord {
        named: None,
        name: name.into(),
        input: format!("/in/{name}.ply").into(),
        state,
        reason: Some(Reason::Incomplete { expected: u64::MAX, found: 0 }),
        stamp: FileStamp { size: 1, modified_ns: i64::MIN, inode: u64::MAX, changed_ns: Some(-1) },
        settings: "7".to_owned(),
        obstacle_stamp: Some("8".to_owned()),
        attempts: 2,
        at_ms,
    }))
}

fn sequence(name: &str, spacing: f64, at_ms: u64) -> RecordLine {
    let key = SequenceKey { folder: "/in".into(), name: name.to_owned(), choices: "fast".to_owned() };
    let measured = MeasuredSpacing {
        spacing,
        confidence: 0.1,
        radius_median: Some(spacing.next_down()),
        measured_on: "/in/dam.1.ply".into(),
        measured_count: 3,
        irregularity: Some(0.25),
        warnings: Vec::new(),
    };
    let framed = Framed {
        camera: "eye=0.1:2:3,target=0:0:0,view=30,up=y,ground=none".parse().expect("a camera"),
        around: [DVec3::splat(-spacing), DVec3::new(0.1, 1.0 / 3.0, 1e9)],
        earlier: vec!["eye=1:2:3,target=0:0:0".parse().expect("a camera")],
    };
    let camera = SequenceCamera { requested: "1280x720 auto".to_owned(), framed };
    let shared = SharedSettings { measured: Some(measured), camera: Some(camera), at_ms };
    RecordLine::Sequence { key, shared: Box::new(shared) }
}

fn daemon(state: DaemonState, at_ms: u64) -> RecordLine {
    RecordLine::Daemon(DaemonRecord { pid: 1, host: "a".to_owned(), started_ms: 2, state, at_ms })
}

/// The settings of a sequence come back bit for bit, so that all its frames have the same.
#[test]
fn latest_lines_count_and_come_back_as_they_were() {
    let folder = tempfile::tempdir().expect("a folder");
    let open = || FrameRecords::open(folder.path()).expect("opened");
    // Two processes at the same time.
    let [one, other] = [open(), open()];
    let mut expected = LatestRecords::default();
    let spacings = [0.1, 1.0 / 3.0, 1e-300, f64::MIN_POSITIVE / 3.0, f64::MAX, 2.5e-8_f64.next_up()];
    for (index, spacing) in spacings.into_iter().enumerate() {
        let name = format!("dam{index}.{{}}.ply");
        other.keep(sequence(&name, 2.0, 2));
        let line = sequence(&name, spacing, 3);
        expected.insert(&line);
        one.keep(line);
        other.keep(sequence(&name, 1.0, 1));
    }
    let waiting = unfinished("a", UnfinishedState::Waiting, u64::MAX);
    for line in [waiting, daemon(DaemonState::Paused("the disk is full".to_owned()), 5)] {
        expected.insert(&line);
        one.keep(line);
    }
    other.keep(unfinished("a", UnfinishedState::Failed, 4));
    other.keep(daemon(DaemonState::Running, 4));
    for records in [&one, &other] {
        records.write_kept().expect("written");
    }
    assert_eq!(open().latest(), expected);
    drop((one, other));
    assert_eq!(open().latest(), expected);
}

#[test]
fn converted_frame_is_unfinished_only_by_a_later_record() {
    let folder = tempfile::tempdir().expect("a folder");
    let records = FrameRecords::open(folder.path()).expect("opened");
    records.keep(unfinished("a", UnfinishedState::Queued, now_ms()));
    convert(&records, "a", "mesh", "0.1");
    let frame = |records: &FrameRecords| records.latest().frames[Path::new("/in/a.ply")].clone();
    for records in [&records, &FrameRecords::open(folder.path()).expect("opened")] {
        assert!(frame(records).if_done().is_some());
    }
    records.keep(unfinished("a", UnfinishedState::Queued, frame(&records).at_ms() + 1));
    records.write_kept().expect("written");
    for records in [&records, &FrameRecords::open(folder.path()).expect("opened")] {
        assert!(frame(records).if_done().is_none());
        assert_eq!(state(records, "a", "0.1", 7), ResultState::Done, "its outputs are still complete");
    }
}

/// A part of a line was written, and there is no room for the rest.
#[test]
#[cfg(target_os = "linux")]
fn lines_that_cannot_be_written_are_written_later() {
    let folder = tempfile::tempdir().expect("a folder");
    let records = FrameRecords::open(folder.path()).expect("opened");
    convert(&records, "a", "mesh", "0.1");
    let path = records.content().own.as_mut().expect("open").fill_the_disk();
    for (name, at_ms) in [("b", 1), ("c", 2), ("b", 3)] {
        records.keep(unfinished(name, UnfinishedState::Queued, at_ms));
        assert!(is_disk_full(&records.write_kept().expect_err("full")));
    }
    assert_eq!(records.latest().frames.len(), 3);
    assert_eq!(FrameRecords::open(folder.path()).expect("opened").latest().frames.len(), 1);
    records.content().own.as_mut().expect("open").free_space(path);
    records.sync().expect("written");
    let files = record_files(&folder.path().join(STATE_FOLDER)).expect("read");
    let [file] = &files[..] else { panic!("{files:?}") };
    let text = fs::read_to_string(file).expect("text");
    assert_eq!(text.lines().filter(|line| line.contains("unfinished")).count(), 2, "{text}");
    assert_eq!(FrameRecords::open(folder.path()).expect("opened").latest(), records.latest());
}

/// A file of another machine, whose locks may not reach this one, and one that cannot be read.
#[test]
fn foreign_files_are_left_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let records = FrameRecords::open(folder.path()).expect("opened");
    convert(&records, "a", "mesh", "0.1");
    drop(records);
    let state_folder = folder.path().join(STATE_FOLDER);
    let own = record_files(&state_folder).expect("read").remove(0);
    let foreign = state_folder.join("frames-00000000-0000000000000000");
    for extension in ["", LOCK_EXTENSION] {
        fs::rename(own.with_extension(extension), foreign.with_extension(extension)).expect("renamed");
    }
    let size = fs::metadata(&foreign).expect("there").len();
    let odd = state_folder.join("frames-00000000-0000000000000001");
    fs::create_dir(&odd).expect("made");
    fs::create_dir(own.with_extension(LOCK_EXTENSION)).expect("made");
    fs::write(&own, "").expect("written");
    let records = FrameRecords::open(folder.path()).expect("opened");
    assert!(records.problems()[0].starts_with(&odd.display().to_string()), "{:?}", records.problems());
    assert_eq!(state(&records, "a", "0.1", 7), ResultState::Done);
    convert(&records, "b", "mesh", "0.1");
    assert_eq!(state(&records, "b", "0.1", 7), ResultState::Done);
    assert_eq!(fs::metadata(&foreign).expect("there").len(), size);
    assert_eq!(fs::metadata(&own).expect("there").len(), 0);
}

#[test]
fn record_that_leads_out_of_the_folder_is_ignored() {
    let folder = tempfile::tempdir().expect("a folder");
    let records = FrameRecords::open(folder.path()).expect("opened");
    convert(&records, "a", "mesh", "0.1");
    let sound = Arc::clone(&records.done()[Path::new("a")][0]);
    drop(records);
    let file = |name: &str| OutputFile { name: name.into(), ..sound.outputs[0].clone() };
    for (name, outputs) in [
        ("../b", sound.outputs.clone()),
        ("/b", sound.outputs.clone()),
        ("b", vec![]),
        ("b", vec![file("../a.glb")]),
        ("b", vec![file("/etc/passwd")]),
        ("b", vec![file("x/a.glb")]),
    ] {
        let records = FrameRecords::open(folder.path()).expect("opened");
        let hostile = DoneRecord { name: name.into(), outputs, ..(*sound).clone() };
        records.add_done(hostile.into(), &values("0.1")).expect("written");
        for records in [records, FrameRecords::open(folder.path()).expect("opened")] {
            assert_eq!(records.done().len(), 1, "{name}");
        }
    }
}

#[test]
#[cfg_attr(windows, ignore = "a file that is open stays until it is closed")]
fn removed_records_are_begun_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let records = FrameRecords::open(folder.path()).expect("opened");
    convert(&records, "a", "mesh", "0.1");
    fs::remove_dir_all(folder.path().join(STATE_FOLDER)).expect("removed");
    convert(&records, "b", "mesh", "0.1");
    let later = FrameRecords::open(folder.path()).expect("opened");
    assert_eq!(state(&later, "b", "0.1", 7), ResultState::Done);
}
