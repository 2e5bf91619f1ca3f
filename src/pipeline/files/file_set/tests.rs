//! Sets of files: their replacement fails or is interrupted at any step.

use super::*;
use std::cell::Cell;
use std::process::Command;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::pipeline::files::atomic_write::{commit, stage};
use crate::pipeline::files::out_folder::recover_out_folder;
use crate::pipeline::files::sweep::sweep_temporaries;

/// The injected faults of this thread.
#[derive(Clone, Copy, Default)]
struct InjectedFault {
    /// Number of changes of the file system that succeed before the fault.
    changes_left: usize,
    /// Number of changes that fail after that; `None` ends the process instead.
    failures: Option<usize>,
    /// Simulates a file system without hard links.
    without_links: bool,
}

/// Held by tests that inject failures: otherwise another thread that retries a removal could use up a
/// failure.
static ALONE: Mutex<()> = Mutex::new(());

thread_local!(static INJECTED_FAULT: Cell<Option<InjectedFault>> = const { Cell::new(None) });

pub(super) fn before_change(is_link: bool) -> io::Result<()> {
    let Some(mut fault) = INJECTED_FAULT.get() else { return Ok(()) };
    if is_link && fault.without_links {
        return Err(io::ErrorKind::Unsupported.into());
    }
    let left = fault.changes_left;
    fault.changes_left = left.saturating_sub(1);
    let fails = left == 0;
    if fails {
        match &mut fault.failures {
            None => std::process::abort(),
            Some(0) => return Ok(()),
            Some(failures) => *failures -= 1,
        }
    }
    INJECTED_FAULT.set(Some(fault));
    if fails { Err(io::Error::other("a failing disk")) } else { Ok(()) }
}

const NAMES: [&str; 3] = ["a.glb", "a.vdb", "a.json"];

/// Creates a folder with the first `count` of the old files.
fn write_old(folder: &Path, count: usize) {
    for name in &NAMES[..count] {
        fs::write(folder.join(name), format!("old {name}")).expect("written");
    }
}

fn publish_new(folder: &Path) -> Result<(), (PathBuf, io::Error)> {
    let staged = NAMES.map(|name| {
        let write = |out: &mut io::BufWriter<&File>| Ok(write!(out, "the new {name}")?);
        stage(&folder.join(name), write).expect("written")
    });
    commit(staged.into()).map(|_| ())
}

/// Recovers as another process would. Other threads of this process may recover at the same time.
fn recover_all(folder: &Path) {
    let is_open = || contents(folder).iter().any(|(name, _)| name.starts_with('.'));
    let start = Instant::now();
    while is_open() {
        assert!(start.elapsed() < Duration::from_secs(60), "{:?}", contents(folder));
        sweep_temporaries(folder).expect("there");
    }
}

/// The files in the folder with their contents, hidden files included.
fn contents(folder: &Path) -> Vec<(String, String)> {
    let entries = fs::read_dir(folder).expect("there").map(|entry| entry.expect("an entry"));
    let mut contents: Vec<_> = entries
        .map(|entry| {
            // Another thread may remove a file meanwhile.
            let text = fs::read_to_string(entry.path()).unwrap_or_default();
            (entry.file_name().into_string().expect("a name"), text)
        })
        .collect();
    contents.sort();
    contents
}

fn expected(old_count: Option<usize>) -> Vec<(String, String)> {
    let count = old_count.unwrap_or(NAMES.len());
    let prefix = if old_count.is_some() { "old" } else { "the new" };
    let mut contents: Vec<_> =
        NAMES[..count].iter().map(|name| ((*name).to_owned(), format!("{prefix} {name}"))).collect();
    contents.sort();
    contents
}

#[test]
fn failure_of_any_change_leaves_all_old_or_all_new_files() {
    let _alone = ALONE.lock();
    for (old_count, without_links) in [(3, false), (3, true), (1, false), (1, true), (0, false)] {
        let mut failed_count = 0;
        for changes_left in 0..20 {
            let folder = tempfile::tempdir().expect("a folder");
            write_old(folder.path(), old_count);
            INJECTED_FAULT.set(Some(InjectedFault { changes_left, failures: Some(1), without_links }));
            let result = publish_new(folder.path());
            INJECTED_FAULT.set(None);
            let wanted = expected(result.as_ref().err().map(|_| old_count));
            assert_eq!(contents(folder.path()), wanted, "{old_count} {without_links} {changes_left}");
            failed_count += usize::from(result.is_err());
        }
        assert!(failed_count >= 3, "{old_count} {without_links}: {failed_count}");
    }
}

#[test]
fn lasting_failure_leaves_all_old_or_all_new_files_after_it_ends() {
    let _alone = ALONE.lock();
    for (old_count, without_links) in [(3, false), (3, true), (1, false), (0, false)] {
        for changes_left in 0..20 {
            let folder = tempfile::tempdir().expect("a folder");
            write_old(folder.path(), old_count);
            INJECTED_FAULT.set(Some(InjectedFault {
                changes_left,
                failures: Some(usize::MAX),
                without_links,
            }));
            let result = publish_new(folder.path());
            INJECTED_FAULT.set(None);
            recover_all(folder.path());
            let found = contents(folder.path());
            // All files are new if the first failure was in the last step.
            let is_good = found == expected(None) || result.is_err() && found == expected(Some(old_count));
            assert!(is_good, "{old_count} {without_links} {changes_left}: {found:?}");
        }
    }
}

/// Set in the child of the test below: the folder, and the fault.
const CHILD: &str = "MENISCUS_TEST_FILE_SET";

#[test]
fn process_killed_before_any_change_leaves_all_old_or_all_new_files() {
    if let Ok(orders) = std::env::var(CHILD) {
        let [changes_left, without_links, folder] = orders.splitn(3, ' ').collect::<Vec<_>>()[..] else {
            panic!("{orders}")
        };
        let changes_left = changes_left.parse().expect("a number");
        INJECTED_FAULT.set(Some(InjectedFault {
            changes_left,
            failures: None,
            without_links: without_links == "true",
        }));
        publish_new(Path::new(folder)).expect("published");
        return;
    }
    for (old_count, without_links) in [(3, false), (3, true), (1, false), (0, false)] {
        let mut killed_count = 0;
        let mut restored_count = 0;
        for changes_left in 0.. {
            let folder = tempfile::tempdir().expect("a folder");
            write_old(folder.path(), old_count);
            let orders = format!("{changes_left} {without_links} {}", folder.path().display());
            let status = Command::new(std::env::current_exe().expect("this test"))
                .args(["process_killed_before_any_change_leaves_all_old_or_all_new_files"])
                .env(CHILD, orders)
                .output()
                .expect("a child")
                .status;
            if !status.success() {
                sweep_temporaries(folder.path()).expect("there");
            }
            let found = contents(folder.path());
            let is_old = found == expected(Some(old_count));
            let is_new = found == expected(None);
            assert!(is_new || is_old && !status.success(), "{old_count} {changes_left}: {found:?}");
            if status.success() {
                break;
            }
            killed_count += 1;
            restored_count += usize::from(is_old);
        }
        // The child was killed before each rename, and before the removal of the record.
        assert!(killed_count >= 4 && restored_count >= 1, "{old_count}: {killed_count}, {restored_count}");
        assert!(restored_count < killed_count, "a started replacement is completed");
    }
}

const fn stamp(size: u64, modified_ns: i64, inode: u64) -> FileStamp {
    FileStamp { size, modified_ns, inode, changed_ns: None }
}

fn example(name: &OsStr, old: Option<FileStamp>) -> Member {
    let temporary = OsStr::new(".a b.tmp-0123456789abcdef").into();
    Member { name: name.into(), temporary, new: stamp(7, -5, 3), old }
}

const OLD: Option<FileStamp> = Some(stamp(12, 1 << 60, 4));

/// The record, the old files and the new files of a set. Another process abandoned the set before these names
/// got their current files.
fn write_abandoned(folder: &Path, names: &[&str]) -> FileSet {
    let members = names.iter().map(|name| example(OsStr::new(name), OLD)).collect();
    let set = FileSet { record_path: folder.join(".meniscus-set-0123456789abcdef"), members };
    fs::write(&set.record_path, record_bytes(&set.members)).expect("written");
    for (index, member) in set.members.iter().enumerate() {
        fs::write(set.old_path(index), "older").expect("written");
        fs::write(set.temporary_path(member), "older").expect("written");
    }
    set
}

#[test]
fn abandoned_set_whose_names_all_have_later_files_is_removed() {
    let folder = tempfile::tempdir().expect("a folder");
    write_old(folder.path(), 3);
    write_abandoned(folder.path(), &NAMES);
    publish_new(folder.path()).expect("published");
    let swept = sweep_temporaries(folder.path()).expect("there");
    assert!(swept.warnings.is_empty(), "{swept:?}");
    assert_eq!(contents(folder.path()), expected(None));
}

#[test]
fn abandoned_set_of_which_some_names_have_later_files_keeps_the_old_files() {
    let folder = tempfile::tempdir().expect("a folder");
    write_old(folder.path(), 3);
    let set = write_abandoned(folder.path(), &[NAMES[0], NAMES[1], NAMES[2], "a.obj"]);
    publish_new(folder.path()).expect("published");
    let swept = sweep_temporaries(folder.path()).expect("there");
    let mut found = contents(folder.path());
    assert!((0..3).all(|index| set.old_path(index).exists()));
    assert!(swept.warnings.len() == 1 && swept.warnings[0].contains("another program"), "{swept:?}");
    // The user removes the record, as the warning advises.
    fs::remove_file(&set.record_path).expect("removed");
    sweep_temporaries(folder.path()).expect("there");
    found.retain(|(name, _)| !name.starts_with('.') && name != "a.obj");
    assert_eq!(found, expected(None));
    assert_eq!(fs::read_to_string(folder.path().join("a.obj")).expect("put back"), "older");
}

#[cfg(unix)]
#[test]
fn file_of_the_same_size_and_time_as_the_new_one_is_distinguished() {
    let folder = tempfile::tempdir().expect("a folder");
    write_old(folder.path(), 1);
    let path = folder.path().join(NAMES[0]);
    let ours = stamp_of(&path).expect("known").expect("there");
    // On a file system with a coarse clock, another program's file can have the same size and time.
    let new = FileStamp { inode: ours.inode + 1, ..ours };
    let members = vec![Member { new, ..example(OsStr::new(NAMES[0]), None) }];
    let record_path = folder.path().join(".meniscus-set-0123456789abcdef");
    fs::write(&record_path, record_bytes(&members)).expect("written");
    sweep_temporaries(folder.path()).expect("there");
    assert_eq!(contents(folder.path()), expected(Some(1)));
}

#[test]
fn set_whose_new_file_is_missing_is_undone() {
    for old_count in [3, 1, 0] {
        let folder = tempfile::tempdir().expect("a folder");
        write_old(folder.path(), old_count);
        let staged = NAMES.map(|name| {
            let write = |out: &mut io::BufWriter<&File>| Ok(write!(out, "the new {name}")?);
            stage(&folder.path().join(name), write).expect("written")
        });
        let members: Vec<Member> = staged.iter().map(|file| member(file).expect("known")).collect();
        let record_path = folder.path().join(".meniscus-set-0123456789abcdef");
        fs::write(&record_path, record_bytes(&members)).expect("written");
        let set = FileSet { record_path, members };
        for (index, file) in staged.iter().enumerate().take(old_count) {
            fs::hard_link(file.path(), set.old_path(index)).expect("linked");
        }
        fs::rename(staged[0].written_path(), staged[0].path()).expect("renamed");
        drop(staged);
        sweep_temporaries(folder.path()).expect("there");
        assert_eq!(contents(folder.path()), expected(Some(old_count)), "{old_count}");
    }
}

#[test]
fn set_of_a_living_process_is_left_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    write_old(folder.path(), 3);
    let record = write_record(folder.path(), &[]).expect("written");
    let set = FileSet { record_path: record.path().to_owned(), members: Vec::new() };
    fs::write(set.old_path(0), "old").expect("written");
    assert_eq!(sweep_temporaries(folder.path()).expect("there").count, 0);
    assert!(record.path().exists() && set.old_path(0).exists());
    drop(record);
    sweep_temporaries(folder.path()).expect("there");
    assert_eq!(contents(folder.path()), expected(Some(3)));
}

#[test]
fn record_round_trips_and_only_a_truncated_one_is_ignored() {
    let mut members = vec![example(OsStr::new("a b.glb"), OLD), example(OsStr::new("ü\n.vdb"), None)];
    #[cfg(unix)]
    members.push(example(std::os::unix::ffi::OsStrExt::from_bytes(b"gr\xfc.vdb"), OLD));
    let bytes = record_bytes(&members);
    assert_eq!(parse_record(&bytes), Parsed::Complete(members));
    for length in 0..bytes.len() {
        assert_eq!(parse_record(&bytes[..length]), Parsed::CutOff, "{length}");
    }
    for other in
        [&b"meniscus set 9\0end\0"[..], b"\0\0\0\0", b"meniscus set 1\0end\0", b"meniscus set 9\0", b"?"]
    {
        assert_eq!(parse_record(other), Parsed::Unknown);
    }
    for name in ["../a.glb", "/etc/passwd", "..", "", "."] {
        let bytes = record_bytes(&[example(OsStr::new(name), None)]);
        assert_eq!(parse_record(&bytes), Parsed::Unknown, "{name}");
    }
    let foreign = Member { temporary: OsStr::new("precious").into(), ..example(OsStr::new("a.glb"), None) };
    assert_eq!(parse_record(&record_bytes(&[foreign])), Parsed::Unknown);
}

/// A folder with one file, one backup, and a record that would remove the file and the backup.
fn plant_record(folder: &Path) -> PathBuf {
    write_old(folder, 1);
    let path = folder.join(NAMES[0]);
    let new = stamp_of(&path).expect("known").expect("there");
    let members = vec![Member { new, ..example(OsStr::new(NAMES[0]), None) }, example(OsStr::new("x"), OLD)];
    let record_path = folder.join(".meniscus-set-0123456789abcdef");
    fs::write(&record_path, record_bytes(&members)).expect("written");
    fs::write(folder.join(".meniscus-set-0123456789abcdef.1"), "kept").expect("written");
    record_path
}

#[track_caller]
fn assert_left_in_place(folder: &Path, words: &str) {
    let before = contents(folder);
    let swept = sweep_temporaries(folder).expect("readable");
    assert_eq!(contents(folder), before);
    assert_eq!(swept.warnings.len(), 1, "{:?}", swept.warnings);
    assert!(swept.warnings[0].contains(words), "{:?}", swept.warnings);
}

#[test]
fn failed_recovery_names_the_record_and_what_to_do() {
    let folder = tempfile::tempdir().expect("a folder");
    let record_path = plant_record(folder.path());
    let _alone = ALONE.lock();
    INJECTED_FAULT.set(Some(InjectedFault { failures: Some(usize::MAX), ..InjectedFault::default() }));
    let result = recover_out_folder(folder.path());
    INJECTED_FAULT.set(None);
    let error = result.expect_err("a failing disk").to_string();
    assert!(error.starts_with(&record_path.display().to_string()), "{error}");
    assert!(error.contains("a failing disk; remove the cause and start again, or remove"), "{error}");
    assert!(record_path.exists());
}

#[cfg(unix)]
#[test]
fn record_with_two_names_is_left_in_place() {
    let folder = tempfile::tempdir().expect("a folder");
    let record_path = plant_record(folder.path());
    fs::hard_link(&record_path, folder.path().join("second")).expect("linked");
    assert_left_in_place(folder.path(), "belongs to another user or has a second hard link");
}

#[cfg(target_os = "linux")]
#[test]
fn record_of_another_user_is_left_in_place() {
    let folder = tempfile::tempdir().expect("a folder");
    let record_path = plant_record(folder.path());
    // Only root can change the owner of a file.
    if std::os::unix::fs::chown(&record_path, Some(12345), None).is_ok() {
        assert_left_in_place(folder.path(), "belongs to another user or has a second hard link");
    }
}

#[test]
fn record_of_another_version_is_left_in_place_with_its_backups() {
    let folder = tempfile::tempdir().expect("a folder");
    let record_path = plant_record(folder.path());
    fs::write(&record_path, "meniscus set 9\0a.glb\0end\0").expect("written");
    assert_left_in_place(folder.path(), "another version");
}
