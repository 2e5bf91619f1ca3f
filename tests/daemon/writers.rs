//! The ways in which programs write frames.

use std::fs::{self, File, OpenOptions};
use std::io::{Seek, Write};
use std::os::unix::fs::symlink;
use std::thread;
use std::time::Duration;

use crate::daemon::scene::{Line, Scene, Watching, block, csv, moving, names_in, ply, text_ply};

const FORMATS: [&str; 2] = ["--format", "obj,vdb"];

/// Starts a daemon that reads a frame soon after the last write.
fn watch(scene: &Scene, more: &[&str]) -> Watching {
    scene.watch(&[&["--settle", "100ms"][..], &FORMATS, more].concat())
}

/// The number of particles that were read, according to this line of the log.
fn particle_count(line: &Line) -> u64 {
    line.fields["particles"].as_u64().expect("a number")
}

#[test]
fn frame_renamed_into_place_is_converted_at_once() {
    let scene = Scene::new();
    let daemon = scene.watch(&[&["--settle", "1h"][..], &FORMATS].concat());
    scene.put("in/dam.1.ply", ply(&moving(1)));
    daemon.await_converted("dam.1.ply");
    // A frame that is written next to its final path, under a hidden name.
    scene.write("in/.dam.2.ply.part", text_ply(&moving(2)));
    fs::rename(scene.path("in/.dam.2.ply.part"), scene.path("in/dam.2.ply")).expect("renamed");
    daemon.await_converted("dam.2.ply");
    // A frame that is written next to its final path, under a name that frames cannot have. It is a table,
    // whose format does not show whether it is complete.
    scene.write("in/dam.3.csv.part", csv(&moving(3)));
    fs::rename(scene.path("in/dam.3.csv.part"), scene.path("in/dam.3.csv")).expect("renamed");
    daemon.await_converted("dam.3.csv");
    daemon.assert_no_complaints();
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

/// Some file transfer servers do this: the only event reports a new file.
#[test]
fn hard_linked_frame_is_converted() {
    let scene = Scene::new();
    let daemon = watch(&scene, &[]);
    scene.write("in/.upload", ply(&moving(1)));
    fs::hard_link(scene.path("in/.upload"), scene.path("in/dam.1.ply")).expect("linked");
    scene.remove("in/.upload");
    daemon.await_converted("dam.1.ply");
    daemon.assert_no_complaints();
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

#[test]
fn symbolic_link_to_a_frame_is_a_frame() {
    let scene = Scene::new();
    let daemon = watch(&scene, &[]);
    scene.write("elsewhere/cache", ply(&moving(1)));
    symlink("../elsewhere/cache", scene.path("in/dam.1.ply")).expect("linked");
    daemon.await_converted("dam.1.ply");
    // A link whose target does not exist yet is not a frame, and causes no warning.
    symlink("../elsewhere/late", scene.path("in/dam.2.ply")).expect("linked");
    scene.put_moving([3]);
    daemon.await_converted("dam.3.ply");
    daemon.assert_no_complaints();
    daemon.finish();
    scene.remove("in/dam.2.ply");
    scene.assert_as_converted(&FORMATS);
    assert!(scene.path("in/dam.1.ply").is_symlink());
}

/// Folders contain links to themselves. The daemon finds a frame under every path that does not repeat a
/// folder.
#[test]
fn folder_cycles_end() {
    let scene = Scene::new();
    scene.write("in/a/dam.1.ply", ply(&moving(1)));
    symlink("..", scene.path("in/a/up")).expect("linked");
    symlink("b", scene.path("in/b")).expect("linked");
    symlink(scene.path("out"), scene.path("in/results")).expect("linked");
    let once = scene.once(&[&["--pattern", "**", "--settle", "10ms"], &FORMATS[..]].concat());
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.1.ply"]);
    let daemon = watch(&scene, &["--pattern", "**"]);
    scene.put("in/a/dam.2.ply", ply(&moving(2)));
    daemon.await_converted("dam.2.ply");
    symlink("../..", scene.path("in/a/again")).expect("linked");
    scene.put("in/a/dam.3.ply", ply(&moving(3)));
    daemon.await_converted("dam.3.ply");
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 2);
    assert_eq!(names_in(&scene.path("out")), [".meniscus", "a"]);
    scene.assert_folder_as_converted("in/a", "out/a", &FORMATS);
}

/// Writes a header, then the body in parts. Each part follows after the daemon has found that the file does
/// not change. At every moment, only the number of particles in the header shows that more will follow.
#[test]
fn slow_writer_is_waited_for() {
    let scene = Scene::new();
    let daemon = watch(&scene, &[]);
    let binary = ply(&moving(1));
    let text = text_ply(&moving(2)).into_bytes();
    let files = [("in/dam.1.ply", &binary), ("in/dam.2.ply", &text)]
        .map(|(name, bytes)| (File::create(scene.path(name)).expect("created"), bytes));
    let header_bytes = binary.len() - 12 * 216;
    for part in 0..6 {
        let split = |bytes: &[u8], part: usize| match part {
            0 => 0,
            _ => header_bytes + (bytes.len() - header_bytes) * part / 6,
        };
        for (file, bytes) in &files {
            (&*file).write_all(&bytes[split(bytes, part)..split(bytes, part + 1)]).expect("written");
        }
        for ((_, bytes), name) in files.iter().zip(["dam.1.ply", "dam.2.ply"]) {
            // The header of a text file does not determine its length: mostly, only reading shows whether it
            // is complete.
            if part < 3 || (part < 5 && name == "dam.1.ply") {
                daemon.await_waiting(name, split(bytes, part + 1), "complete");
            }
        }
    }
    drop(files);
    for name in ["dam.1.ply", "dam.2.ply"] {
        assert_eq!(particle_count(&daemon.await_converted(name)), 216);
    }
    daemon.assert_no_complaints();
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 2);
    scene.assert_as_converted(&FORMATS);
}

/// Appends to a file that was closed before.
fn append(scene: &Scene, within: &str, bytes: &[u8]) {
    let mut file = OpenOptions::new().append(true).open(scene.path(within)).expect("opened");
    file.write_all(bytes).expect("written");
}

/// Closing a file does not prove that it is complete: the writer may open it again.
#[test]
fn writer_that_closes_and_reopens_is_waited_for() {
    let scene = Scene::new();
    let daemon = watch(&scene, &[]);
    let binary = ply(&moving(1));
    scene.write("in/dam.1.ply", &binary[..2000]);
    daemon.await_waiting("dam.1.ply", 2000, "not complete");
    append(&scene, "in/dam.1.ply", &binary[2000..]);
    assert_eq!(particle_count(&daemon.await_converted("dam.1.ply")), 216);
    daemon.assert_no_complaints();
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 1);
    scene.assert_as_converted(&FORMATS);
}

/// The format does not show whether a table is complete, but the writer can, by a sentinel.
#[test]
fn table_is_read_when_its_sentinel_exists() {
    let scene = Scene::new();
    let daemon = scene.watch(&[&["--settle", "1h"][..], &FORMATS].concat());
    let table = csv(&moving(2));
    let (rows, more_rows) = table.split_at(table.match_indices('\n').nth(100).expect("rows").0 + 1);
    scene.write("in/dam.2.csv", rows);
    daemon.await_waiting("dam.2.csv", rows.len(), "");
    append(&scene, "in/dam.2.csv", more_rows.as_bytes());
    daemon.await_waiting("dam.2.csv", table.len(), "");
    scene.write("in/dam.2.done", "");
    assert_eq!(particle_count(&daemon.await_converted("dam.2.csv")), 216);
    daemon.assert_no_complaints();
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 1);
    scene.assert_as_converted(&FORMATS);
}

/// A file that is filled through a memory map looks complete from the start, and sends no events: the daemon
/// waits until its writer closes it.
#[test]
fn complete_frame_that_is_open_is_waited_for() {
    let scene = Scene::new();
    let daemon = watch(&scene, &[]);
    let bytes = ply(&moving(1));
    let mut file = File::create(scene.path("in/dam.1.ply")).expect("created");
    file.write_all(&bytes).expect("written");
    daemon.await_waiting("dam.1.ply", bytes.len(), "still has it open");
    drop(file);
    daemon.await_converted("dam.1.ply");
    daemon.assert_no_complaints();
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

/// Opening the file sent no event, because no daemon was running.
#[test]
fn complete_frame_that_was_opened_before_is_waited_for() {
    let scene = Scene::new();
    let path = scene.path("in/dam.1.ply");
    let mut file = File::create(&path).expect("created");
    file.write_all(&ply(&moving(2))).expect("written");
    let writer = thread::spawn(move || {
        // Longer than `--once` waits for an incomplete file.
        thread::sleep(Duration::from_secs(4));
        file.rewind().expect("rewound");
        file.write_all(&ply(&moving(1))).expect("written");
    });
    let once = scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    writer.join().expect("closed");
    once.assert_status(0);
    scene.assert_as_converted(&FORMATS);
}

/// If a table grows after the daemon considered it complete, it is converted again, with the new rows.
#[test]
fn late_rows_are_converted() {
    let scene = Scene::new();
    let daemon = watch(&scene, &["--preset", "paper", "--voxel-size", "0.06"]);
    let table = csv(&moving(2));
    let (rows, more_rows) = table.split_at(table.match_indices('\n').nth(100).expect("rows").0 + 1);
    scene.write("in/dam.2.csv", rows);
    assert_eq!(particle_count(&daemon.await_converted("dam.2.csv")), 100);
    append(&scene, "in/dam.2.csv", more_rows.as_bytes());
    let all = daemon.await_lines(2, "converted again", Line::is_converted);
    assert_eq!(particle_count(&all[1]), 216);
    daemon.finish();
    scene.assert_as_converted(&[&FORMATS[..], &["--preset", "paper", "--voxel-size", "0.06"]].concat());
}

/// A producer dies in the middle of a frame, and another one starts the frame again.
#[test]
fn frame_restarted_by_another_producer_is_converted() {
    let scene = Scene::new();
    let daemon = watch(&scene, &[]);
    let lost = ply(&block(9, 0.1, 0.0));
    scene.write("in/dam.1.ply", &lost[..4000]);
    scene.write("in/dam.2.ply", &lost[..4000]);
    for name in ["dam.1.ply", "dam.2.ply"] {
        daemon.await_waiting(name, 4000, "not complete");
    }
    scene.remove("in/dam.1.ply");
    scene.put_moving([1, 2]);
    for name in ["dam.1.ply", "dam.2.ply"] {
        assert_eq!(particle_count(&daemon.await_converted(name)), 216);
    }
    daemon.assert_no_complaints();
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 2);
    scene.assert_as_converted(&FORMATS);
}

/// The file has its final length from the beginning, and is filled gradually. According to its format it is
/// complete; only the continuing writes show that it is not.
#[test]
fn preallocated_file_is_waited_for() {
    let scene = Scene::new();
    let daemon = scene.watch(&[&["--settle", "1h"][..], &FORMATS].concat());
    let bytes = ply(&moving(1));
    let file = File::create(scene.path("in/dam.1.ply")).expect("created");
    file.set_len(bytes.len() as u64).expect("long enough");
    for part in bytes.chunks(bytes.len().div_ceil(8)) {
        (&file).write_all(part).expect("written");
    }
    drop(file);
    daemon.await_waiting("dam.1.ply", bytes.len(), "");
    assert_eq!(daemon.converted_count("dam.1.ply"), 0);
    scene.write("in/dam.1.done", "");
    daemon.await_converted("dam.1.ply");
    daemon.assert_no_complaints();
    assert_eq!(daemon.converted_count("dam.1.ply"), 1);
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}
