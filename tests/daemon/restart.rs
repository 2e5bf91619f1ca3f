//! Done, failed and pinned state survives a restart, also without the journal.

use std::fs;
use std::os::unix::fs::MetadataExt;

use crate::daemon::scene::{Once, Scene, moving, names_in, ply};

const FORMATS: [&str; 2] = ["--format", "obj,vdb"];

fn once(scene: &Scene) -> Once {
    let once = scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    once.assert_status(0);
    once
}

/// The inode numbers of the outputs: a file that was written again has another number.
fn inodes(scene: &Scene) -> Vec<u64> {
    let names = names_in(&scene.path("out")).into_iter().filter(|name| !name.starts_with('.'));
    names.map(|name| scene.path("out").join(name).metadata().expect("there").ino()).collect()
}

/// A scene of this many frames, all converted.
fn all_done(frame_count: usize) -> Scene {
    let scene = Scene::new();
    scene.put_moving(1..=frame_count);
    assert_eq!(once(&scene).converted().len(), frame_count);
    scene
}

const JOURNAL: &str = "out/.meniscus/journal";

#[test]
fn outputs_are_recognized_as_done_without_the_journal() {
    let scene = all_done(5);
    let before = inodes(&scene);
    scene.remove(JOURNAL);
    let again = once(&scene);
    assert_eq!((again.converted().len(), again.found_done().len()), (0, 5));
    assert_eq!(inodes(&scene), before);
    // Without the records, they are made again.
    fs::remove_dir_all(scene.path("out/.meniscus")).expect("removed");
    assert_eq!(once(&scene).converted().len(), 5);
}

/// Such as after a copy to another disk.
#[test]
fn outputs_with_other_stamps_are_compared_once() {
    let scene = all_done(2);
    for name in ["out/dam.1.obj", "out/dam.2.vdb"] {
        scene.put(name, scene.bytes(name));
    }
    let again = once(&scene);
    assert_eq!((again.converted().len(), again.found_done().len()), (0, 2));
    assert!(once(&scene).found_done().is_empty());
}

/// Any damage to the journal costs at most some work, and never a frame.
#[test]
fn damaged_journal_loses_no_frame() {
    let scene = all_done(5);
    let before = inodes(&scene);
    let journal = scene.bytes(JOURNAL);
    let mut flipped = journal.clone();
    // Flip a bit in the last third of the journal, where the records are, not in the header line.
    let index = flipped.len() * 2 / 3;
    flipped[index] ^= 0x20;
    let damages: [(&str, Vec<u8>); 6] = [
        ("empty", Vec::new()),
        ("torn", journal[..journal.len() - 10].to_vec()),
        ("half", journal[..journal.len() / 2].to_vec()),
        ("a bit", flipped),
        ("zeros behind", [&journal[..], &[0; 512]].concat()),
        ("nonsense", b"\xff\xfe nonsense\n\n\n".repeat(50)),
    ];
    for (damage, bytes) in damages {
        scene.write(JOURNAL, bytes);
        let again = once(&scene);
        assert!(again.converted().is_empty(), "{damage}: {:?}", again.converted());
        assert_eq!(inodes(&scene), before, "{damage}");
        // The daemon has recorded again which frames are done.
        let then = once(&scene);
        assert!(then.converted().is_empty() && then.found_done().is_empty(), "{damage}");
    }
    scene.assert_as_converted(&FORMATS);
}

/// If the journal is removed while the daemon runs, the daemon writes it again.
#[test]
fn journal_removed_while_the_daemon_runs_is_written_again() {
    let scene = Scene::new();
    scene.put_moving(1..=3);
    let daemon = scene.watch(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    daemon.await_lines(3, "all are converted", |line| line.is_converted());
    scene.remove(JOURNAL);
    scene.put_moving([4]);
    daemon.await_converted("dam.4.ply");
    daemon.finish();
    let again = once(&scene);
    assert!(again.converted().is_empty() && again.found_done().is_empty(), "{:?}", again.found_done());
}

/// With `--journal`, the journal is at another path, and the lock and the records stay in the output folder.
#[test]
fn journal_folder_is_separate_with_the_option() {
    let scene = Scene::new();
    scene.put_moving(1..=3);
    let arguments = [&["--settle", "10ms", "--journal", "memory"], &FORMATS[..]].concat();
    scene.once(&arguments).assert_status(0);
    assert!(scene.path("memory/journal").is_file() && !scene.path(JOURNAL).exists());
    let again = scene.once(&arguments);
    assert!(again.converted().is_empty() && again.found_done().is_empty());
    let status = scene.run(&["status", "--out", "out", "--journal", "memory", "--json"]);
    assert!(status.out.contains("\"done\""), "{}{}", status.out, status.err);
    assert_eq!(status.status, Some(0));
}

/// The daemon accepts outputs of `convert` as done if the settings are the same as its own, and only then.
#[test]
fn frames_converted_by_convert_are_done() {
    let scene = Scene::new();
    scene.put_moving(1..=3);
    let result = scene.run(&[&["convert", "in", "--out", "out"], &FORMATS[..]].concat());
    assert_eq!(result.status, Some(0), "{}", result.err);
    scene.put("in/dam.3.ply", ply(&moving(4)));
    let next = once(&scene);
    assert_eq!(next.converted(), ["dam.3.ply"]);
    assert_eq!(next.found_done(), ["dam.1.ply", "dam.2.ply"]);
}

/// A frame of one particle has no spacing. It waits for a frame with more particles, also after restarts.
#[test]
fn single_particle_frame_waits_for_the_spacing_of_another_over_restarts() {
    let scene = Scene::new();
    scene.write("in/dam.1.ply", ply(&moving(1)[..1]));
    let once = scene.once(&["--settle", "10ms"]);
    once.assert_status(2);
    assert!(once.log.iter().any(|line| line.message.contains("--spacing")));
    scene.put_moving([2]);
    let once = scene.once(&["--settle", "10ms"]);
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.1.ply", "dam.2.ply"]);
}

/// A frame that was refused because of another file is converted when that file is removed.
#[test]
fn refused_frame_is_converted_when_the_conflict_is_gone() {
    let scene = Scene::new();
    scene.put_moving([1]);
    scene.once(&["--settle", "10ms"]).assert_status(0);
    scene.write("in/dam.1.csv", crate::daemon::scene::csv(&moving(3)));
    let arguments = ["--settle", "10ms", "--settle-unverifiable", "20ms"];
    scene.once(&arguments).assert_status(1);
    scene.remove("in/dam.1.ply");
    let once = scene.once(&arguments);
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.1.csv"]);
}

/// A frame that does not fit into the memory limit of one run may fit into that of the next run.
#[test]
fn frame_that_was_too_large_is_retried_after_a_restart() {
    let scene = Scene::new();
    scene.put_moving([1]);
    let arguments = ["--settle", "10ms", "--format", "obj,vdb", "--preset", "paper", "--voxel-size", "0.05"];
    let small = [&arguments[..], &["--memory", "1MiB"]].concat();
    for _ in 0..2 {
        let once = scene.once(&small);
        once.assert_status(2);
        let complaints = once.log.iter().filter(|line| line.message.contains("the frame needs"));
        assert!(complaints.count() > 0, "it was not tried");
    }
    for command in [&["status", "--out", "out"][..], &["why", "in/dam.1.ply", "--out", "out"]] {
        let result = scene.run(command);
        assert!(result.out.contains("dam.1.ply") && result.out.contains("the frame needs"), "{}", result.out);
    }
    let once = scene.once(&arguments);
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.1.ply"]);
}

/// A missing folder ends the run, also while the daemon converts frames of another folder.
#[test]
fn missing_folder_ends_the_run() {
    let scene = Scene::new();
    scene.put_moving(1..=12);
    let arguments =
        ["watch", "in", "nowhere", "--out", "out", "--once", "--in-flight", "1", "--settle", "1ms"];
    let result = scene.run(&arguments);
    assert_eq!(result.status, Some(2), "{}", result.err);
    assert!(result.err.contains("nowhere"), "{}", result.err);
}

/// A path through other folders or through links refers to the same frames.
#[test]
fn frame_is_recognized_by_any_of_its_paths() {
    let scene = Scene::new();
    scene.put_moving([1]);
    scene.once(&["--settle", "10ms"]).assert_status(0);
    std::os::unix::fs::symlink(".", scene.path("here")).expect("linked");
    for input in ["in/../in", "here/in", "./here/here/in"] {
        let result = scene.run(&["watch", input, "--out", "out", "--once", "--log", "json"]);
        assert_eq!(result.status, Some(0), "{}", result.err);
        assert!(
            !result.err.contains("\"converted\"") && !result.err.contains("done already"),
            "{}",
            result.err
        );
        let why = scene.run(&["why", &format!("{input}/dam.1.ply"), "--out", "out"]);
        assert!(why.out.contains("as recorded"), "{}", why.out);
    }
}
