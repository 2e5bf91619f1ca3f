//! Bursts of files that overflow the event queue, and folders that arrive with files in them.

use std::fs;
use std::thread;

use rustix::process::Signal;

use crate::daemon::scene::{Line, Scene, Watching, by_length, csv, names_in, ply};

/// Settings with which a frame of few particles takes little time. Only `watch` has the last two options.
const CHEAP: [&str; 12] = [
    "--preset",
    "paper",
    "--voxel-size",
    "0.1",
    "--laplacian-steps",
    "0",
    "--steps",
    "0",
    "--format",
    "obj",
    "--settle",
    "50ms",
];

/// Few particles, at different positions for each number.
fn few(number: usize) -> Vec<[f32; 3]> {
    vec![[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.001 * (number % 64) as f32]]
}

/// The kernel queues this many events for a process that does not read them, and drops the rest.
fn events_kept_max() -> usize {
    let text = fs::read_to_string("/proc/sys/fs/inotify/max_queued_events").expect("Linux");
    text.trim().parse().expect("a number")
}

/// The test stops the daemon until the kernel drops events. All frames arrive after that, so no event reports
/// them.
#[test]
fn frames_whose_events_were_lost_are_found() {
    let frame_count = by_length(600, 5000);
    let scene = Scene::new();
    let daemon = scene.watch(&CHEAP);
    daemon.signal(Signal::STOP);
    // Each rename produces two events: one for the old name and one for the new name.
    let [here, there] = ["in/here", "in/there"].map(|name| scene.path(name));
    scene.write("in/here", "");
    for _ in 0..=events_kept_max() / 4 {
        fs::rename(&here, &there).expect("renamed");
        fs::rename(&there, &here).expect("renamed");
    }
    for number in 1..=frame_count {
        scene.write(&format!("in/dam.{number}.ply"), ply(&few(number)));
    }
    daemon.signal(Signal::CONT);
    daemon.await_line("lost events are logged", |line| line.message.contains("events were lost"));
    daemon.await_lines(frame_count, "all are converted", Line::is_converted);
    daemon.finish();
    assert_eq!(outputs(&scene, "out").len(), frame_count);
    scene.assert_as_converted(&CHEAP[..10]);
}

/// Four threads write in every way of writing, faster than the daemon can follow.
#[test]
fn frames_written_by_four_threads_are_all_converted() {
    let frame_count = by_length(400, 5000);
    let scene = Scene::new();
    let daemon = scene.watch(&CHEAP);
    thread::scope(|scope| {
        for writer in 0..4 {
            let scene = &scene;
            scope.spawn(move || {
                for number in (1..=frame_count).filter(|number| number % 4 == writer) {
                    let name = format!("in/dam.{number}.ply");
                    match number % 8 {
                        0..4 => scene.write(&name, ply(&few(number))),
                        _ => scene.put(&name, ply(&few(number))),
                    }
                }
            });
        }
    });
    daemon.await_lines(frame_count, "all are converted", Line::is_converted);
    daemon.assert_no_complaints();
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), frame_count);
    scene.assert_as_converted(&CHEAP[..10]);
}

/// The names of the meshes in a folder.
fn outputs(scene: &Scene, folder: &str) -> Vec<String> {
    names_in(&scene.path(folder)).into_iter().filter(|name| name.ends_with(".obj")).collect()
}

fn watch_recursively(scene: &Scene) -> Watching {
    scene.watch(&[&CHEAP[..], &["--pattern", "**"]].concat())
}

/// Fills a folder before the daemon can watch it. The test repeats this, because it depends on a race.
#[test]
fn new_folders_with_files_in_them_lose_no_frame() {
    let folder_count = by_length(60, 600);
    let scene = Scene::new();
    let daemon = watch_recursively(&scene);
    let folder = |index: usize| match index % 3 {
        0 => format!("shot{index}"),
        1 => format!("shot{index}/a"),
        _ => format!("shot{index}/a/b/c"),
    };
    for index in 0..folder_count {
        for number in 1..=3 {
            scene.write(&format!("in/{}/dam.{number}.ply", folder(index)), ply(&few(index + number)));
        }
    }
    daemon.await_lines(3 * folder_count, "all are converted", Line::is_converted);
    daemon.assert_no_complaints();
    daemon.finish();
    for index in 0..folder_count {
        let names = outputs(&scene, &format!("out/{}", folder(index)));
        assert_eq!(names, ["dam.1.obj", "dam.2.obj", "dam.3.obj"], "{}", folder(index));
    }
    for index in 0..3 {
        let folder = folder(index);
        scene.assert_folder_as_converted(&format!("in/{folder}"), &format!("out/{folder}"), &CHEAP[..10]);
    }
}

/// When a tree of folders arrives by one rename, the kernel reports only its topmost folder. Frames that
/// arrive in the tree later are converted, too, also after a second rename.
#[test]
fn tree_renamed_into_place_is_converted_and_watched() {
    let scene = Scene::new();
    let daemon = watch_recursively(&scene);
    for name in ["take/dam.1.ply", "take/deep/er/dam.2.ply"] {
        scene.write(&format!("elsewhere/{name}"), ply(&few(1)));
    }
    fs::rename(scene.path("elsewhere/take"), scene.path("in/take")).expect("renamed");
    daemon.await_lines(2, "its frames are converted", Line::is_converted);
    scene.write("in/take/deep/er/dam.3.ply", ply(&few(3)));
    daemon.await_converted("take/deep/er/dam.3.ply");

    fs::rename(scene.path("in/take"), scene.path("in/retake")).expect("renamed");
    daemon.await_converted("retake/deep/er/dam.3.ply");
    scene.write("in/retake/deep/dam.4.ply", ply(&few(4)));
    daemon.await_converted("retake/deep/dam.4.ply");
    // After the rename, the daemon also watches another folder that gets the old name.
    scene.write("in/take/dam.5.ply", ply(&few(5)));
    daemon.await_converted("take/dam.5.ply");
    daemon.assert_no_complaints();
    daemon.finish();
    assert_eq!(outputs(&scene, "out/retake/deep/er"), ["dam.2.obj", "dam.3.obj"]);
    assert_eq!(outputs(&scene, "out/retake/deep"), ["dam.4.obj"]);
    // The outputs of removed frames stay.
    assert_eq!(outputs(&scene, "out/take"), ["dam.1.obj", "dam.5.obj"]);
}

/// A folder that is removed and created again is a different folder with the same name.
#[test]
fn folder_removed_and_created_again_is_watched() {
    let scene = Scene::new();
    // Apart from this frame and the subfolder, nothing in the folder changes.
    scene.put("in/dam.0.ply", ply(&few(0)));
    let daemon = watch_recursively(&scene);
    for number in 1..=by_length(5, 50) {
        let name = format!("in/cache/dam.{number}.ply");
        scene.write(&name, ply(&few(number)));
        daemon.await_converted(&format!("cache/dam.{number}.ply"));
        fs::remove_dir_all(scene.path("in/cache")).expect("removed");
    }
    daemon.assert_no_complaints();
    daemon.finish();
}

/// Without `--pattern '**'`, the daemon does not search sub-folders.
#[test]
fn subfolders_are_ignored_without_a_pattern() {
    let scene = Scene::new();
    let daemon = scene.watch(&CHEAP);
    scene.write("in/sub/dam.1.ply", ply(&few(1)));
    scene.write("in/table.2.csv", csv(&few(2)));
    scene.put("in/dam.3.ply", ply(&few(3)));
    daemon.await_converted("dam.3.ply");
    daemon.await_converted("table.2.csv");
    daemon.finish();
    scene.once(&CHEAP).assert_status(0);
    assert_eq!(outputs(&scene, "out"), ["dam.3.obj", "table.2.obj"]);
    assert_eq!(names_in(&scene.path("out")).len(), 3);
}
