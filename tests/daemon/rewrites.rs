//! Frames that change before, during or after their conversion.

use std::fs::{self, File, FileTimes, OpenOptions};
use std::io::Write;
use std::thread;
use std::time::{Duration, SystemTime};

use crate::daemon::scene::{
    Line, Scene, Watching, await_that, block, by_length, log_text, moving, ply, text_ply,
};

/// The voxel size is fixed, because these tests change the frames on which it would be measured.
const FORMATS: [&str; 6] = ["--format", "obj,vdb", "--preset", "paper", "--voxel-size", "0.06"];

fn watch(scene: &Scene, more: &[&str]) -> Watching {
    scene.watch(&[&["--settle", "100ms"][..], &FORMATS, more].concat())
}

/// Rewrites a frame by a rename, in place with another length, and in place with the same length.
#[test]
fn rewritten_frame_is_converted_again() {
    let scene = Scene::new();
    scene.put_moving(1..=3);
    let daemon = watch(&scene, &[]);
    daemon.await_lines(3, "all are converted", Line::is_converted);
    let before = scene.bytes("out/dam.1.vdb");
    scene.put("in/dam.1.ply", ply(&block(7, 0.11, 0.3)));
    scene.write("in/dam.2.ply", ply(&block(5, 0.1, 0.3)));
    scene.write("in/dam.3.ply", ply(&block(6, 0.1, 0.7)));
    for name in ["dam.1.ply", "dam.2.ply", "dam.3.ply"] {
        daemon.await_lines(2, "converted again", |line| line.is_converted() && line.is_about(name));
    }
    daemon.assert_no_complaints();
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 6);
    assert_ne!(scene.bytes("out/dam.1.vdb"), before);
    scene.assert_as_converted(&FORMATS);
}

/// A frame gets another modification time, or is replaced by another file; the bytes stay the same.
#[test]
fn touched_frame_is_not_converted_again() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    let daemon = watch(&scene, &[]);
    daemon.await_lines(2, "all are converted", Line::is_converted);
    touch(&scene, "in/dam.1.ply");
    scene.put_moving([2]);
    daemon.await_lines(2, "both are found done", Line::is_found_done);
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 2);
    // The same change while no daemon runs. The next daemon checks the contents only once.
    touch(&scene, "in/dam.1.ply");
    let once = scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    once.assert_status(0);
    assert_eq!((once.converted(), once.found_done()), (vec![], vec!["dam.1.ply".to_owned()]));
    let status = scene.run(&["status", "in/dam.1.ply", "--out", "out"]);
    assert!(status.out.contains("state     done"), "{}{}", status.out, status.err);
    scene.assert_as_converted(&FORMATS);
}

/// Writes a file in place, in the same length, and sets its modification time back, as `rsync --inplace -t`
/// does.
fn rewrite_unseen(scene: &Scene, within: &str, bytes: &[u8]) {
    let path = scene.path(within);
    let before = fs::metadata(&path).expect("there");
    assert_eq!(before.len(), bytes.len() as u64);
    let modified = before.modified().expect("a time");
    let mut file = OpenOptions::new().write(true).open(&path).expect("opened");
    file.write_all(bytes).expect("written");
    file.set_times(FileTimes::new().set_modified(modified)).expect("set");
}

#[test]
fn frame_rewritten_with_its_old_size_time_and_inode_is_converted_again() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    let daemon = watch(&scene, &[]);
    daemon.await_lines(2, "both are converted", Line::is_converted);
    rewrite_unseen(&scene, "in/dam.1.ply", &ply(&block(6, 0.11, 0.4)));
    daemon.await_lines(3, "the first is converted again", Line::is_converted);
    daemon.finish();
    // The same change while no daemon runs.
    rewrite_unseen(&scene, "in/dam.2.ply", &ply(&block(6, 0.1, 0.45)));
    let once = scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.2.ply"]);
    scene.assert_as_converted(&FORMATS);
}

#[test]
fn frame_whose_status_alone_changed_is_found_done_by_its_content() {
    use std::os::unix::fs::PermissionsExt;
    let scene = Scene::new();
    scene.put_moving(1..=2);
    let once = || scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    once().assert_status(0);
    fs::set_permissions(scene.path("in/dam.1.ply"), PermissionsExt::from_mode(0o600)).expect("set");
    fs::hard_link(scene.path("in/dam.2.ply"), scene.path("elsewhere/link.ply")).expect("linked");
    let again = once();
    again.assert_status(0);
    assert_eq!((again.converted().len(), again.found_done().len()), (0, 2));
    // The daemon recorded the result of its check, so it does not read the frame again.
    let again = once();
    assert_eq!((again.converted().len(), again.found_done().len()), (0, 0));
}

/// A writer that has mapped a frame into its memory changes the content after the times: only the event of
/// its close shows that the frame may have changed. Opening a file for writing and closing it sends the same.
#[test]
fn frame_that_is_closed_without_a_change_is_read_again_and_found_done() {
    let scene = Scene::new();
    scene.put_moving([1]);
    let daemon = watch(&scene, &[]);
    daemon.await_converted("dam.1.ply");
    drop(OpenOptions::new().append(true).open(scene.path("in/dam.1.ply")).expect("opened"));
    daemon.await_lines(1, "it is found done", Line::is_found_done);
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 1);
}

#[test]
fn output_with_a_flipped_byte_is_made_again() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    let daemon = scene.watch(&[&["--settle", "10ms", "--poll", "50ms"], &FORMATS[..]].concat());
    daemon.await_lines(2, "both are converted", Line::is_converted);
    flip_byte(&scene, "out/dam.1.vdb");
    daemon.await_lines(3, "the damaged one is made again", |line| line.is_converted());
    touch(&scene, "out/dam.2.obj");
    let is_second = |line: &Line| line.is_found_done() && line.is_about("dam.2.ply");
    daemon.await_lines(1, "the touched one is found done", is_second);
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 3);
    scene.assert_as_converted(&FORMATS);
    flip_byte(&scene, "out/dam.2.obj");
    let once = scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    once.assert_status(0);
    assert_eq!(once.converted(), ["dam.2.ply"]);
    scene.assert_as_converted(&FORMATS);
}

/// Replaces a file by a file that differs in one byte in the middle.
fn flip_byte(scene: &Scene, within: &str) {
    let mut bytes = scene.bytes(within);
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    scene.put(within, bytes);
}

#[test]
fn root_that_is_a_link_to_another_folder_now_is_scanned_again() {
    let scene = Scene::new();
    scene.write("take1/dam.1.ply", ply(&moving(1)));
    scene.write("take2/dam.1.ply", ply(&moving(2)));
    scene.write("take2/dam.2.ply", ply(&moving(3)));
    fs::remove_dir(scene.path("in")).expect("removed");
    let point_to = |take: &str| {
        std::os::unix::fs::symlink(scene.path(take), scene.path("elsewhere/link")).expect("linked");
        fs::rename(scene.path("elsewhere/link"), scene.path("in")).expect("renamed");
    };
    point_to("take1");
    let daemon = watch(&scene, &[]);
    daemon.await_lines(1, "the first take is converted", Line::is_converted);
    point_to("take2");
    daemon.await_lines(3, "the second take is converted", Line::is_converted);
    // The daemon notices changes in the second folder.
    scene.write("take2/dam.3.ply", ply(&moving(4)));
    daemon.await_converted("dam.3.ply");
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

fn touch(scene: &Scene, within: &str) {
    let file = OpenOptions::new().write(true).open(scene.path(within)).expect("opened");
    file.set_times(FileTimes::new().set_modified(SystemTime::now())).expect("touched");
}

/// Overwrites a large frame again and again, in place and in the same length, until the daemon has noticed
/// this a few times while reading. In the end the outputs are those of the final content.
#[test]
fn frame_overwritten_while_it_is_read_is_read_again() {
    let noticed_count = by_length(2, 100);
    let arguments = ["--format", "obj", "--preset", "paper", "--voxel-size", "0.4"];
    let scene = Scene::new();
    let versions = [0.0, 0.25, 0.5].map(|shift| text_ply_of_one_length(&block(30, 0.1, shift)));
    assert!(versions.iter().all(|version| version.len() == versions[0].len()));
    let daemon = scene.watch(&[&["--settle", "1ms"][..], &arguments].concat());
    let is_notice = |line: &Line| line.message.contains("was written while it was read");
    let mut write_count = 0;
    await_that("it is noticed", || {
        overwrite(&scene, "in/dam.1.ply", &versions[write_count % 2]);
        write_count += 1;
        noticed_count <= daemon.lines(is_notice).len()
    });
    overwrite(&scene, "in/dam.1.ply", &versions[2]);
    let _ = fs::remove_dir_all(scene.path("expected"));
    let result = scene.run(&[&["convert", "in", "--out", "expected"], &arguments[..]].concat());
    assert_eq!(result.status, Some(0), "{}", result.err);
    let expected = scene.bytes("expected/dam.1.obj");
    let is_as_expected = || fs::read(scene.path("out/dam.1.obj")).is_ok_and(|bytes| bytes == expected);
    await_that("the last version is converted", is_as_expected);
    let log = daemon.finish();
    assert!(log.iter().all(|line| line.level != "ERROR"), "{}", crate::daemon::scene::log_text(&log));
    // Another run does not change the outputs.
    let once = scene.once(&[&["--settle", "1ms"], &arguments[..]].concat());
    once.assert_status(0);
    assert!(once.converted().is_empty());
    scene.assert_as_converted(&arguments);
}

/// Overwrites a file without truncating it: at every moment it has its full length, with bytes of the old
/// version, the new version, or both.
fn overwrite(scene: &Scene, within: &str, bytes: &[u8]) {
    let options = OpenOptions::new().write(true).create(true).truncate(false).clone();
    let mut file: File = options.open(scene.path(within)).expect("opened");
    for part in bytes.chunks(1 << 15) {
        file.write_all(part).expect("written");
        // The pause makes the daemon read while the file is written, instead of before or after.
        thread::sleep(Duration::from_micros(300));
    }
}

/// All numbers have the same width, so that all versions have the same length.
fn text_ply_of_one_length(particles: &[[f32; 3]]) -> Vec<u8> {
    let header = text_ply(&[]).replace("vertex 0", &format!("vertex {}", particles.len()));
    let rows = particles.iter().map(|[x, y, z]| format!("{x:.4} {y:.4} {z:.4}\n"));
    rows.fold(header, |text, row| text + &row).into_bytes()
}

/// Many frames wait, and most of them are removed before the daemon reads them.
#[test]
fn frames_removed_while_they_wait_do_not_fail() {
    let scene = Scene::new();
    scene.put_moving(1..=200);
    let daemon = watch(&scene, &["--threads", "1"]);
    daemon.await_lines(1, "one is converted", Line::is_converted);
    for number in 20..=200 {
        scene.remove(&format!("in/dam.{number}.ply"));
    }
    for number in 1..20 {
        daemon.await_converted(&format!("dam.{number}.ply"));
    }
    scene.put_moving([300]);
    daemon.await_converted("dam.300.ply");
    assert!(daemon.lines(|line| line.level == "ERROR").is_empty(), "{}", daemon.log_text());
    daemon.finish();
    let once = scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    once.assert_status(0);
    assert!(once.converted().is_empty());
}

/// The only frame is removed before the daemon has read it. The daemon must not wait for this frame, also
/// when it ends.
#[test]
fn unfinished_frame_may_be_removed() {
    let scene = Scene::new();
    let daemon = watch(&scene, &[]);
    scene.write("in/dam.1.ply", &ply(&moving(1))[..1000]);
    scene.write("in/dam.2.ply", ply(&moving(2)));
    scene.remove("in/dam.1.ply");
    daemon.await_converted("dam.2.ply");
    daemon.assert_no_complaints();
    daemon.finish();
    scene.assert_as_converted(&FORMATS);
}

/// The daemon makes an output again that a user removed.
#[test]
fn removed_output_is_made_again() {
    let scene = Scene::new();
    scene.put_moving(1..=3);
    let once = || scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    once().assert_status(0);
    scene.remove("out/dam.2.obj");
    // A truncated output counts as missing.
    let half = scene.bytes("out/dam.3.vdb");
    scene.write("out/dam.3.vdb", &half[..half.len() / 2]);
    let again = once();
    again.assert_status(0);
    assert_eq!(again.converted(), ["dam.2.ply", "dam.3.ply"]);
    scene.assert_as_converted(&FORMATS);
}

/// A box whose top is at this height, below the moving cubes or in them.
fn floor(top: f32) -> String {
    let corners = (0..8).map(|index| {
        let at = |axis: usize, low: f32, high: f32| if index >> axis & 1 == 1 { high } else { low };
        format!("v {} {} {}\n", at(0, -1.0, 2.0), at(1, -1.0, 2.0), at(2, -1.0, top))
    });
    let faces = "f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6\n";
    corners.collect::<String>() + faces
}

/// An obstacle for all frames, and an obstacle that belongs to one frame. Removing or touching an obstacle
/// does not cause a conversion.
#[test]
fn rewritten_obstacle_converts_its_frames_again() {
    let around = ["--obstacle", "floor.obj", "--obstacle", "body.#.obj"];
    let scene = Scene::new();
    scene.put_moving(1..=3);
    scene.write("floor.obj", floor(-0.1));
    (1..=3).for_each(|number| scene.write(&format!("body.{number}.obj"), floor(-0.2)));
    let arguments = [&FORMATS[..], &around].concat();
    let daemon = scene.watch(&[&["--settle", "10ms", "--poll", "50ms"], &arguments[..]].concat());
    daemon.await_lines(3, "all are converted", Line::is_converted);
    let before = scene.bytes("out/dam.2.vdb");
    scene.put("body.2.obj", floor(0.15));
    let is_second = |line: &Line| line.is_converted() && line.is_about("dam.2.ply");
    daemon.await_lines(2, "the one is converted again", is_second);
    assert!(scene.bytes("out/dam.2.vdb") != before);
    assert_eq!(daemon.lines(Line::is_converted).len(), 4);
    scene.put("floor.obj", floor(0.1));
    daemon.await_lines(7, "all are converted again", Line::is_converted);
    scene.assert_as_converted(&arguments);
    scene.remove("body.3.obj");
    touch(&scene, "floor.obj");
    daemon.await_lines(2, "those with obstacles are found done", Line::is_found_done);
    assert!(daemon.lines(|line| line.is_found_done() && line.is_about("dam.3.ply")).is_empty());
    scene.put("body.3.obj", floor(-0.2));
    daemon.await_lines(3, "and so is the third", Line::is_found_done);
    let complaints = daemon.lines(Line::is_complaint);
    assert!(
        complaints.iter().all(|line| line.message.contains("inside obstacles")),
        "{}",
        log_text(&complaints)
    );
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 7);
    let once = scene.once(&[&["--settle", "10ms"], &arguments[..]].concat());
    once.assert_status(0);
    assert!(once.converted().is_empty() && once.found_done().is_empty());
}

/// One obstacle is missing, and another cannot be read.
#[test]
fn frames_are_converted_when_their_obstacle_becomes_valid() {
    let scene = Scene::new();
    scene.put_moving(1..=2);
    scene.write("body.1.obj", "v 1 2\n");
    let arguments = ["--settle", "10ms", "--poll", "50ms", "--obstacle", "body.#.obj"];
    let daemon = scene.watch(&[&arguments[..], &FORMATS].concat());
    let is_wrong = |name: &'static str, what: &'static str| {
        move |line: &Line| line.is_about(name) && line.message.contains(what)
    };
    daemon.await_line("the broken one", is_wrong("dam.1.ply", "obstacle "));
    daemon.await_line("the missing one", is_wrong("dam.2.ply", "body.2.obj: no such file"));
    (1..=2).for_each(|number| scene.put(&format!("body.{number}.obj"), floor(-0.2)));
    daemon.await_lines(2, "both are converted", Line::is_converted);
    daemon.finish();
    scene.assert_as_converted(&[&FORMATS[..], &["--obstacle", "body.#.obj"]].concat());
}

/// A run with `--once` gives up soon. Its log names the obstacle, has the frame only as a field, and promises
/// nothing that happens after its end.
#[test]
fn missing_obstacle_is_explained_at_the_end_of_one_run() {
    let scene = Scene::new();
    scene.put_moving([1]);
    let once = scene.once(&[&FORMATS[..], &["--settle", "10ms", "--obstacle", "none.obj"]].concat());
    once.assert_status(2);
    let is_failure = |line: &&Line| line.is_about("dam.1.ply") && line.message.contains("none.obj");
    let about: Vec<&Line> = once.log.iter().filter(is_failure).collect();
    assert!(about.len() == 4 && about.iter().all(|line| line.message.starts_with("obstacle ")), "{about:?}");
    let end = "none.obj: no such file; gave up: run the command again when the cause is gone";
    assert!(about[3].message.ends_with(end), "{about:?}");
}
