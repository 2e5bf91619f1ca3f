//! After SIGKILL at any moment no frame is lost, and no incomplete output is ever visible.

use std::collections::HashMap;
use std::fs;
use std::io::Cursor;
use std::os::unix::fs::DirEntryExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

use meniscus_formats::OutputFormat;
use meniscus_formats::is_complete;

use crate::daemon::scene::{Scene, by_length, moving, ply, text_ply};

const FORMATS: [&str; 2] = ["--format", "glb,vdb,obj,ply"];

/// Kills the daemon and restarts it at once, again and again, while frames are written. The first half of the
/// frames exists from the beginning. In one variant of the test, the daemon measures the voxel size.
#[test]
fn killed_daemon_loses_no_frame_and_shows_no_incomplete_output() {
    let (frame_count, kill_count) = by_length((40, 25), (300, 200));
    let scene = Scene::new();
    let frames: Vec<usize> = (1..=frame_count).collect();
    let (there, coming) = frames.split_at(frame_count / 2);
    scene.put_moving(there.iter().copied());
    let killed_count = AtomicUsize::new(0);
    let is_over = AtomicBool::new(false);
    let out = scene.path("out");
    let seen = thread::scope(|scope| {
        let observer = scope.spawn(|| observe(&out, &is_over));
        // New frames arrive in step with the kills, so that every kill interrupts some work.
        scope.spawn(|| {
            for (index, &number) in coming.iter().enumerate() {
                let kill_index = index * kill_count / coming.len();
                while killed_count.load(Ordering::SeqCst) < kill_index {
                    thread::sleep(Duration::from_millis(1));
                }
                produce(&scene, number);
            }
        });
        let _end = EndOnDrop { killed_count: &killed_count, is_over: &is_over };
        let mut random = Random(7);
        for _ in 0..kill_count {
            let mut daemon = scene.start(&[&["--settle", "20ms"], &FORMATS[..]].concat());
            thread::sleep(Duration::from_micros(random.below(150_000)));
            assert!(daemon.is_alive(), "{}", daemon.log_text());
            daemon.kill();
            killed_count.fetch_add(1, Ordering::SeqCst);
        }
        let last = scene.once(&[&["--settle", "20ms"], &FORMATS[..]].concat());
        is_over.store(true, Ordering::SeqCst);
        last.assert_status(0);
        observer.join().expect("no panic")
    });
    scene.assert_as_converted(&FORMATS);
    scene.assert_no_temporaries();
    assert_eq!(names_seen(&seen), 4 * frame_count);
    for Snapshot { name, bytes } in seen {
        assert!(is_complete(kind(&name), &mut Cursor::new(&bytes)).unwrap_or(false), "{name} was not whole");
        // The same frame gives the same bytes in every conversion.
        assert!(scene.bytes(&format!("out/{name}")) == bytes, "{name} was not what it is now");
    }
}

/// Ends the threads of the observer and the producer, also when an assertion fails, because the scope waits
/// for both.
struct EndOnDrop<'a> {
    killed_count: &'a AtomicUsize,
    is_over: &'a AtomicBool,
}

impl Drop for EndOnDrop<'_> {
    fn drop(&mut self) {
        self.killed_count.store(usize::MAX, Ordering::SeqCst);
        self.is_over.store(true, Ordering::SeqCst);
    }
}

/// Uses each way of writing in turn.
fn produce(scene: &Scene, number: usize) {
    let name = format!("in/dam.{number}.ply");
    match number % 3 {
        0 => scene.put(&name, ply(&moving(number))),
        1 => scene.write(&name, ply(&moving(number))),
        _ => scene.write(&name, text_ply(&moving(number))),
    }
}

/// An output, with its contents when it appeared.
struct Snapshot {
    name: String,
    bytes: Vec<u8>,
}

fn names_seen(seen: &[Snapshot]) -> usize {
    let mut names: Vec<&str> = seen.iter().map(|snapshot| &*snapshot.name).collect();
    names.sort_unstable();
    names.dedup();
    names.len()
}

/// Opens every visible file as soon as it appears, and again whenever another file replaces it.
fn observe(folder: &Path, is_over: &AtomicBool) -> Vec<Snapshot> {
    let mut seen = Vec::new();
    let mut inodes: HashMap<PathBuf, u64> = HashMap::new();
    loop {
        // After the end, the observer reads the final files once more.
        let is_last = is_over.load(Ordering::SeqCst);
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with('.') || inodes.get(&entry.path()) == Some(&entry.ino()) {
                continue;
            }
            let bytes = fs::read(entry.path()).expect("an output is never taken away");
            inodes.insert(entry.path(), entry.ino());
            seen.push(Snapshot { name, bytes });
        }
        if is_last {
            return seen;
        }
        thread::yield_now();
    }
}

fn kind(name: &str) -> OutputFormat {
    match Path::new(name).extension().and_then(|extension| extension.to_str()) {
        Some("glb") => OutputFormat::Glb,
        Some("vdb") => OutputFormat::Vdb,
        Some("obj") => OutputFormat::Obj,
        Some("ply") => OutputFormat::Ply,
        _ => panic!("{name} is not an output"),
    }
}

/// A generator of pseudo-random numbers (SplitMix64), the same in every run.
struct Random(u64);

impl Random {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % end
    }
}

/// A daemon that is killed repeatedly while it converts one frame does not convert the other frames again.
#[test]
fn frames_done_before_a_kill_are_not_converted_again() {
    let scene = Scene::new();
    scene.put_moving(1..=8);
    let daemon = scene.start(&FORMATS);
    daemon.await_lines(8, "all are converted", |line| line.is_converted());
    daemon.kill();
    scene.put_moving([9]);
    let next = scene.once(&FORMATS);
    next.assert_status(0);
    assert_eq!(next.converted(), ["dam.9.ply"]);
    // The daemon does not even read frames that are recorded as done.
    assert!(next.found_done().is_empty());
}
