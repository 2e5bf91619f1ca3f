//! Tests the journal after crashes, on full disks, and with interference by other programs.

use crate::pipeline::MeasuredSpacing;
use std::io::{Seek, SeekFrom};

use super::*;

impl Journal {
    fn note_sequence(&mut self, key: &SequenceKey, record: JournaledSequence) -> io::Result<()> {
        self.note(Entry::Sequence { key: key.clone(), record: record.into() })
    }

    fn note_daemon(&mut self, record: DaemonRecord) -> io::Result<()> {
        self.note(Entry::Daemon(record))
    }
}

fn frame_entry(input: &Path, record: JournaledFrame) -> Entry {
    Entry::Frame { input: input.into(), record: record.into() }
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a folder")
}

fn open(folder: &Path) -> Journal {
    Journal::open(folder).expect("a journal")
}

fn frame_record(status: JournaledStatus, attempt_count: u32) -> JournaledFrame {
    JournaledFrame {
        status,
        stamp: FileStamp {
            size: 12_345,
            modified_ns: 1_760_000_000_123_456_789,
            inode: 77,
            changed_ns: Some(1_760_000_000_123_456_790),
        },
        hash: Some(u128::MAX / 3),
        settings: "0123456789abcdef0123456789abcdef".to_owned(),
        outputs: vec![OutputRecord::of_size("/out/water/dam.0001.glb".into(), 1_234_567)],
        reason: None,
        attempt_count,
        at_ms: 1_760_000_000_000,
        particle_count: Some(250_000),
        seconds: Some(0.5),
        flaws: Vec::new(),
        figures: None,
    }
}

fn input(number: usize) -> PathBuf {
    format!("/sim/water/dam.{number:04}.bgeo").into()
}

fn sequence() -> (SequenceKey, JournaledSequence) {
    let key =
        SequenceKey { folder: "/sim".into(), name: "dam.{}.bgeo".to_owned(), choices: "fast".to_owned() };
    let record = JournaledSequence {
        measured: Some(MeasuredSpacing {
            spacing: 0.2,
            confidence: 0.9,
            radius_median: None,
            measured_on: "/sim/dam.0001.bgeo".into(),
            measured_count: 0,
            warnings: Vec::new(),
        }),
        camera: None,
    };
    (key, record)
}

fn daemon_record(state: DaemonState) -> DaemonRecord {
    DaemonRecord { pid: 12, host: "render-04".to_owned(), started_ms: 1, state, at_ms: 2 }
}

/// Writes records of all kinds. Returns the states after each record, starting with the empty state.
fn write_some(folder: &Path) -> Vec<JournalState> {
    let mut journal = open(folder);
    let mut states = vec![journal.state().clone()];
    let mut remember = |journal: &Journal| states.push(journal.state().clone());
    journal.note_daemon(daemon_record(DaemonState::Running)).expect("noted");
    remember(&journal);
    let (key, record) = sequence();
    journal.note_sequence(&key, record).expect("noted");
    remember(&journal);
    for number in 0..3 {
        for status in [JournaledStatus::Queued, JournaledStatus::Done] {
            journal.note_frame(&input(number), frame_record(status, 1)).expect("noted");
            remember(&journal);
        }
    }
    states
}

fn bytes(folder: &Path) -> Vec<u8> {
    fs::read(folder.join(FILE_NAME)).expect("a journal")
}

fn line_count(folder: &Path) -> usize {
    bytes(folder).iter().filter(|&&byte| byte == b'\n').count() - 1
}

#[test]
fn reopened_journal_has_all_records() {
    let folder = folder();
    let folder = folder.path().join("not/there/yet");
    assert_eq!(Journal::read(&folder).expect("no journal"), JournalState::default());
    let states = write_some(&folder);
    let last = states.last().expect("states");
    assert_eq!(last.frames.len(), 3);
    assert_eq!(Journal::read(&folder).expect("a journal"), *last);
    assert_eq!(open(&folder).state(), last);
}

#[test]
fn reader_sees_every_record_of_a_running_daemon() {
    let folder = folder();
    let mut journal = open(folder.path());
    for number in 0..4 {
        journal.note_frame(&input(number), frame_record(JournaledStatus::Done, 1)).expect("noted");
        assert_eq!(Journal::read(folder.path()).expect("a journal"), *journal.state());
    }
}

#[test]
fn truncated_journal_equals_an_earlier_state() {
    let whole = folder();
    let states = write_some(whole.path());
    let bytes = bytes(whole.path());
    let cut = folder();
    let path = cut.path().join(FILE_NAME);
    let record = frame_record(JournaledStatus::Failed, 9);
    for size in 0..=bytes.len() {
        // A new file each time, because some file systems sync when a truncated file is written again.
        let _ = fs::remove_file(&path);
        fs::write(&path, &bytes[..size]).expect("written");
        let whole_lines = bytes[..size].iter().filter(|&&byte| byte == b'\n').count();
        let state = &states[whole_lines.saturating_sub(1)];
        assert_eq!(Journal::read(cut.path()).expect("a journal"), *state, "{size} bytes");

        let mut journal = open(cut.path());
        assert_eq!(journal.state(), state, "{size} bytes");
        journal.note_frame(&input(99), record.clone()).expect("noted");
        let read = Journal::read(cut.path()).expect("a journal");
        assert_eq!(read, *journal.state(), "{size} bytes");
        assert_eq!(read.frames.get(&*input(99)).map(|found| &**found), Some(&record), "{size} bytes");
    }
}

#[test]
fn flipped_bit_never_creates_a_new_record() {
    let folder = folder();
    let states = write_some(folder.path());
    let mut bytes = bytes(folder.path());
    let (mut damaged_count, mut set_aside_count) = (0, 0);
    for index in 0..bytes.len() {
        for bit in 0..8 {
            bytes[index] ^= 1 << bit;
            match parse(&*bytes).expect("memory can be read") {
                JournalFile::Journal(loaded) => {
                    check_was_written(&loaded.state, &states);
                    damaged_count += usize::from(loaded.state.damaged_line_count > 0);
                }
                JournalFile::OtherVersion => set_aside_count += 1,
            }
            bytes[index] ^= 1 << bit;
        }
    }
    assert_eq!(set_aside_count, VERSION_LINE.len() * 8);
    assert!(
        damaged_count * 10 > (bytes.len() * 8) * 9,
        "{damaged_count} of {} were noticed",
        bytes.len() * 8
    );
}

fn check_was_written(state: &JournalState, states: &[JournalState]) {
    for (input, record) in &state.frames {
        assert!(states.iter().any(|state| state.frames.get(input) == Some(record)), "{record:?}");
    }
    for (key, record) in &state.sequences {
        assert!(states.iter().any(|state| state.sequences.get(key) == Some(record)), "{record:?}");
    }
    assert!(states.iter().any(|earlier| earlier.daemon == state.daemon), "{:?}", state.daemon);
}

#[test]
fn damaged_lines_are_skipped_and_counted() {
    let folder = folder();
    write_some(folder.path());
    let text = String::from_utf8(bytes(folder.path())).expect("text");
    let mut lines: Vec<&str> = text.lines().collect();
    lines.insert(3, "");
    lines.insert(5, "not a record");
    fs::write(folder.path().join(FILE_NAME), lines.join("\n") + "\n\0\0\0\0").expect("written");
    let journal = open(folder.path());
    assert_eq!(journal.state().damaged_line_count, 2);
    assert_eq!(journal.state().frames.len(), 3);
}

#[test]
fn journal_of_another_version_is_renamed() {
    for other in ["meniscus journal 2\n", "meniscus journal 10\nmore\n", "# something else", "\n", "\0"] {
        let folder = folder();
        fs::write(folder.path().join(FILE_NAME), other).expect("written");
        let error = Journal::read(folder.path()).expect_err("another version");
        assert_eq!(error.kind(), io::ErrorKind::InvalidData);

        let states = write_some(folder.path());
        assert_eq!(Journal::read(folder.path()).expect("a journal"), *states.last().expect("states"));
        let kept = fs::read_to_string(folder.path().join(SET_ASIDE_NAME)).expect("kept");
        assert_eq!(kept, other);
    }
}

/// Simulates a write to a full disk: only a part of the bytes is written.
fn fail_next_write(journal: &mut Journal) {
    let path = journal.path.clone();
    let mut file = OpenOptions::new().append(true).open(&path).expect("the journal");
    file.write_all(b"0123456789abcdef {\"frame\":{\"inp").expect("a torn line");
    let file = File::open(path).expect("a handle that cannot write");
    journal.inode = FileStamp::of(&file.metadata().expect("a file")).inode;
    journal.file = Some(file);
}

#[test]
fn failed_write_is_repeated_with_the_next_record() {
    let folder = folder();
    let mut journal = open(folder.path());
    journal.note_frame(&input(0), frame_record(JournaledStatus::Done, 1)).expect("noted");
    let before = journal.state().clone();

    fail_next_write(&mut journal);
    journal.note_frame(&input(1), frame_record(JournaledStatus::Queued, 1)).expect_err("a full disk");
    assert!(journal.state().frames.contains_key(&*input(1)));
    assert_eq!(Journal::read(folder.path()).expect("a journal"), before);
    fail_next_write(&mut journal);
    journal.note_frame(&input(1), frame_record(JournaledStatus::Done, 1)).expect_err("a full disk");
    journal.note_frame(&input(2), frame_record(JournaledStatus::Done, 1)).expect("there is free space again");

    assert_eq!(journal.state().frames.len(), 3);
    assert_eq!(Journal::read(folder.path()).expect("a journal"), *journal.state());
    assert_eq!(line_count(folder.path()), 3, "no line is torn, and none is written twice");
}

#[test]
fn sync_writes_pending_records() {
    let folder = folder();
    let mut journal = open(folder.path());
    journal.note_frame(&input(0), frame_record(JournaledStatus::Done, 1)).expect("noted");
    fail_next_write(&mut journal);
    journal.note_daemon(daemon_record(DaemonState::Stopped)).expect_err("a full disk");
    journal.sync().expect("there is free space again");
    assert_eq!(Journal::read(folder.path()).expect("a journal"), *journal.state());
}

/// The output disk is not mounted: its mount point stays empty.
#[test]
fn suspended_journal_is_not_written_at_the_end() {
    let parent = folder();
    let folder = parent.path().join(STATE_FOLDER);
    let mut journal = open(&folder);
    fs::remove_dir_all(&folder).expect("removed");
    journal.set_suspended(true);
    journal.note_frame(&input(0), frame_record(JournaledStatus::Done, 1)).expect("kept");
    journal.sync().expect("nothing is written");
    assert!(!folder.exists());
}

#[cfg(target_os = "linux")]
#[test]
fn write_to_a_full_disk_returns_an_error() {
    let folder = folder();
    let mut journal = open(folder.path());
    journal.note_frame(&input(0), frame_record(JournaledStatus::Done, 1)).expect("noted");
    // The journal file stays, but new data goes to a full device.
    journal.file = Some(OpenOptions::new().write(true).open("/dev/full").expect("the full device"));
    let error =
        journal.note_frame(&input(1), frame_record(JournaledStatus::Done, 1)).expect_err("a full disk");
    assert!(is_disk_full(&error), "{error}");
}

#[cfg(unix)]
#[test]
fn removed_journal_is_written_again_completely() {
    let parent = folder();
    let folder = parent.path().join(STATE_FOLDER);
    let mut journal = open(&folder);
    journal.note_frame(&input(0), frame_record(JournaledStatus::Done, 1)).expect("noted");
    fs::remove_dir_all(&folder).expect("removed");
    journal.note_frame(&input(1), frame_record(JournaledStatus::Done, 1)).expect("noted");
    assert_eq!(Journal::read(&folder).expect("a journal"), *journal.state());

    // The result is the same if the journal was truncated while it was closed.
    for rest in ["", "meniscus journal 1\n", "something else"] {
        fail_next_write(&mut journal);
        journal.note_frame(&input(2), frame_record(JournaledStatus::Done, 1)).expect_err("a full disk");
        fs::write(folder.join(FILE_NAME), rest).expect("cut short");
        journal.note_frame(&input(3), frame_record(JournaledStatus::Done, 1)).expect("noted");
        assert_eq!(Journal::read(&folder).expect("a journal"), *journal.state());
    }
}

#[test]
fn superseded_lines_are_compacted() {
    let folder = folder();
    let mut journal = open(folder.path());
    let (key, record) = sequence();
    journal.note_sequence(&key, record).expect("noted");
    for attempt_count in 0..5 * COMPACTED_LINES_MIN as u32 {
        let number = attempt_count as usize % 10;
        journal
            .note_frame(&input(number), frame_record(JournaledStatus::Retrying, attempt_count))
            .expect("noted");
        assert!(journal.line_count <= COMPACTED_LINES_MIN);
    }
    assert!(line_count(folder.path()) <= COMPACTED_LINES_MIN);
    assert_eq!(Journal::read(folder.path()).expect("a journal"), *journal.state());
    assert_eq!(journal.state().frames.len(), 10);
    assert_eq!(fs::read_dir(folder.path()).expect("there").count(), 1);
}

#[test]
fn mostly_superseded_journal_is_compacted_on_open() {
    let folder = folder();
    write_some(folder.path());
    let mut file = OpenOptions::new().append(true).open(folder.path().join(FILE_NAME)).expect("a journal");
    let mut lines = Vec::new();
    for attempt_count in 0..COMPACTED_LINES_MIN as u32 {
        let record = frame_record(JournaledStatus::Done, attempt_count);
        push_line(&mut lines, &frame_entry(&input(0), record.clone())).expect("a line");
    }
    file.write_all(&lines).expect("written");
    let before = Journal::read(folder.path()).expect("a journal");

    let mut journal = open(folder.path());
    assert_eq!(line_count(folder.path()), before.entry_count());
    journal.note_frame(&input(7), frame_record(JournaledStatus::Done, 1)).expect("noted");
    assert_eq!(line_count(folder.path()), before.entry_count() + 1);
    assert_eq!(Journal::read(folder.path()).expect("a journal"), *journal.state());
}

thread_local!(static REWRITE_FAILS: std::cell::Cell<bool> = const { std::cell::Cell::new(false) });

/// Fails if the test requests that writing the compacted file fails.
pub(super) fn before_rewrite() -> io::Result<()> {
    if REWRITE_FAILS.get() { Err(io::Error::other("a failing disk")) } else { Ok(()) }
}

#[test]
#[cfg(unix)]
fn journal_that_is_a_link_is_refused_and_replaced_under_a_running_daemon() {
    use std::os::unix::fs::symlink;
    let folder = folder();
    write_some(folder.path());
    let [path, users_file] = [FILE_NAME, "precious"].map(|name| folder.path().join(name));
    fs::copy(&path, &users_file).expect("copied");
    let bytes = fs::read(&users_file).expect("there");
    let mut journal = open(folder.path());
    fs::remove_file(&path).expect("removed");
    symlink(&users_file, &path).expect("a link");
    let error = Journal::open(folder.path()).expect_err("a link").to_string();
    assert_eq!(error, "not a regular file: a symbolic link");
    assert!(Journal::read(folder.path()).is_err());
    // A running daemon still has the contents in memory.
    journal.note_frame(&input(7), frame_record(JournaledStatus::Done, 1)).expect("noted");
    assert!(!path.is_symlink());
    assert_eq!(Journal::read(folder.path()).expect("a journal"), *journal.state());
    assert!(fs::read(&users_file).expect("there") == bytes);

    // A hard link cannot be refused like a symbolic link. The journal is written to a new file, and the other
    // name keeps the old one.
    drop(journal);
    fs::hard_link(&path, folder.path().join("kept")).expect("a second name");
    let kept = fs::read(&path).expect("there");
    let mut journal = open(folder.path());
    journal.note_frame(&input(8), frame_record(JournaledStatus::Done, 1)).expect("noted");
    assert!(fs::read(folder.path().join("kept")).expect("there") == kept);
    assert_eq!(Journal::read(folder.path()).expect("a journal"), *journal.state());
}

#[test]
fn failed_compaction_keeps_the_journal_usable() {
    let folder = folder();
    let mut journal = open(folder.path());
    REWRITE_FAILS.set(true);
    let count = 3 * COMPACTED_LINES_MIN;
    for attempt_count in 0..count as u32 {
        journal.note_frame(&input(0), frame_record(JournaledStatus::Retrying, attempt_count)).expect("noted");
    }
    assert_eq!(line_count(folder.path()), count);
    assert_eq!(Journal::read(folder.path()).expect("a journal"), *journal.state());

    REWRITE_FAILS.set(false);
    for attempt_count in 0..count as u32 {
        journal.note_frame(&input(0), frame_record(JournaledStatus::Retrying, attempt_count)).expect("noted");
    }
    assert!(line_count(folder.path()) <= 2 * COMPACTED_LINES_MIN);
}

#[test]
fn open_reader_survives_a_compaction() {
    let folder = folder();
    write_some(folder.path());
    let mut reader = File::open(folder.path().join(FILE_NAME)).expect("a journal");
    let mut journal = open(folder.path());
    let before = journal.state().clone();
    journal.rewrite().expect("a fresh file");
    reader.seek(SeekFrom::Start(0)).expect("the beginning");
    let JournalFile::Journal(loaded) = parse(BufReader::new(reader)).expect("the old file") else {
        panic!("of this version")
    };
    assert_eq!(loaded.state, before);
}
