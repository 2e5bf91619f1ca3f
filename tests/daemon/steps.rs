//! Files with several frames: dumps to which a simulation appends steps.

use std::fmt::Write as _;
use std::fs::{File, OpenOptions};
use std::io::Write;

use crate::daemon::scene::{Line, Scene, await_that, moving, names_in, ply};

const ARGUMENTS: [&str; 8] =
    ["--format", "obj", "--settle", "100ms", "--preset", "paper", "--voxel-size", "0.06"];
const CONVERT: [&str; 6] = ["--format", "obj", "--preset", "paper", "--voxel-size", "0.06"];

/// Steps of a dump.
fn steps(numbers: impl IntoIterator<Item = usize>) -> String {
    numbers.into_iter().fold(String::new(), |mut text, number| {
        let particles = moving(number);
        let count = particles.len();
        write!(text, "ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n{count}\nITEM: ATOMS x y z\n")
            .expect("strings take everything");
        for [x, y, z] in particles {
            writeln!(text, "{x} {y} {z}").expect("strings take everything");
        }
        text
    })
}

fn append(scene: &Scene, text: &str) {
    let file = OpenOptions::new().append(true).open(scene.path("in/d.dump"));
    file.and_then(|mut file| file.write_all(text.as_bytes())).expect("appended");
}

#[test]
fn appended_steps_are_converted() {
    let scene = Scene::new();
    scene.write("in/d.dump", steps([1, 2]));
    let daemon = scene.watch(&ARGUMENTS);
    daemon.await_converted("d.dump/step=2");
    daemon.await_converted("d.dump/step=1");
    append(&scene, &steps([30]));
    daemon.await_converted("d.dump/step=30");
    // The last of the earlier steps might have been incomplete, so it is read again, and found done. The step
    // before it is not read.
    daemon.await_line("step=2 is found done", |line| line.is_found_done() && line.is_about("d.dump/step=2"));
    // A truncated step fails, and is converted when the rest of it arrives.
    let cut = steps([40]);
    let (start, rest) = cut.split_at(cut.len() / 2);
    append(&scene, start);
    daemon.await_line("it is cut off", |line| line.is_complaint() && line.is_about("d.dump/step=40"));
    append(&scene, rest);
    daemon.await_converted("d.dump/step=40");
    let log = daemon.finish();
    assert_eq!(log.iter().filter(|line| line.is_converted()).count(), 4);
    scene.assert_as_converted(&CONVERT);

    // The next run finds the steps done that the daemon had not read again before it ended. The run after
    // that reads the file only to list its steps.
    let once = scene.once(&ARGUMENTS);
    once.assert_status(0);
    assert_eq!(once.converted(), [""; 0]);
    let once = scene.once(&ARGUMENTS);
    assert_eq!((once.converted(), once.found_done()), (vec![], vec![]));
    // The daemon makes removed outputs again.
    scene.remove("out/d.30.obj");
    let once = scene.once(&ARGUMENTS);
    assert_eq!(once.converted(), ["step=30"]);
    scene.assert_as_converted(&CONVERT);

    let frame = |path: &str| scene.run(&["status", path, "--out", "out"]);
    let done = frame("in/d.dump/step=30");
    assert!(done.out.contains("step=30") && done.out.contains("state     done"), "{}{}", done.out, done.err);
    let unknown = frame("in/d.dump/step=999");
    assert_eq!(unknown.status, Some(2), "{}", unknown.out);
    assert!(unknown.err.contains("d.dump/step=999: nothing is recorded of it"), "{}", unknown.err);
    let file = frame("in/d.dump");
    assert!(file.err.contains("several frames") && file.err.contains("d.dump/step=40"), "{}", file.err);
    let status = scene.run(&["status", "--out", "out"]);
    assert_eq!(status.status, Some(0), "{}", status.err);
    assert!(status.out.contains("4 done"), "{}", status.out);
}

/// A simulation keeps its dump open while it runs.
#[test]
fn steps_of_a_file_that_stays_open_are_converted() {
    let scene = Scene::new();
    let daemon = scene.watch(&ARGUMENTS);
    let mut dump = File::create(scene.path("in/d.dump")).expect("created");
    for (written, converted) in [(vec![1, 2], 1), (vec![3], 2), (vec![4], 3)] {
        dump.write_all(steps(written).as_bytes()).expect("written");
        daemon.await_converted(&format!("d.dump/step={converted}"));
    }
    drop(dump);
    daemon.finish();
    scene.assert_as_converted(&CONVERT);
}

/// A writer that has mapped the file into its memory may have changed any step without a trace.
#[test]
fn steps_of_a_file_that_is_closed_without_a_change_are_read_again() {
    let scene = Scene::new();
    scene.write("in/d.dump", steps([1, 2]));
    let daemon = scene.watch(&ARGUMENTS);
    daemon.await_converted("d.dump/step=1");
    daemon.await_converted("d.dump/step=2");
    append(&scene, "");
    daemon.await_lines(2, "they are found done", Line::is_found_done);
    assert_eq!(daemon.finish().iter().filter(|line| line.is_converted()).count(), 2);
}

#[test]
fn status_lists_failed_steps() {
    let scene = Scene::new();
    let bad = steps([2]).replacen('.', "?", 1);
    let line = steps([1]).lines().count() + 6;
    let cut = steps([4]);
    scene.write("in/d.dump", [&steps([1]), &*bad, &steps([3]), &cut[..cut.len() / 2]].concat());
    scene.once(&ARGUMENTS).assert_status(1);
    let status = scene.run(&["status", "--out", "out"]);
    assert_eq!(status.status, Some(1), "{}", status.err);
    assert!(status.out.contains("2 done, 0 queued, 0 to retry, 2 failed"), "{}", status.out);
    let lines: Vec<&str> = status.out.lines().filter(|line| line.contains("d.dump/step=")).collect();
    let is_listed =
        |step: &str, words: &str| lines.iter().any(|line| line.contains(step) && line.contains(words));
    assert!(is_listed("step=2: ", &format!("LAMMPS dump, at line {line}: ")), "{}", status.out);
    assert!(is_listed("step=4: ", "next try when the file changes or the daemon restarts"), "{}", status.out);
    let json = scene.run(&["status", "--out", "out", "--json"]);
    let json: serde_json::Value = serde_json::from_str(&json.out).expect("JSON");
    assert_eq!((&json["counts"]["failed"], &json["counts"]["retrying"]), (&2.into(), &0.into()));
    // The daemon will not convert a step that was removed from the file.
    scene.put("in/d.dump", steps([1, 3]));
    let status = scene.run(&["status", "--out", "out"]);
    assert!(status.out.contains("2 done, 0 queued, 0 to retry, 0 failed"), "{}", status.out);
    // The same holds if the file is larger now, whether or not the daemon has examined it since.
    let bad = steps([9]).replacen('.', "?", 1);
    scene.put("in/d.dump", [&steps([1]), &*bad].concat());
    scene.once(&ARGUMENTS).assert_status(1);
    scene.put("in/d.dump", steps([1, 3, 5]));
    let is_done = |expected: &str| {
        let status = scene.run(&["status", "--out", "out"]);
        assert_eq!(status.status, Some(0), "{}{}", status.out, status.err);
        assert!(status.out.contains(expected), "{expected}: {}", status.out);
    };
    is_done("2 done, 0 queued, 0 to retry, 0 failed");
    scene.once(&ARGUMENTS).assert_status(0);
    is_done("3 done, 0 queued, 0 to retry, 0 failed");
}

/// A file of one step is a frame with the name of the file.
#[test]
fn failed_step_becomes_the_file_when_it_is_the_only_one() {
    let scene = Scene::new();
    scene.write("in/d.dump", [steps([1]), steps([9]).replacen('.', "?", 1)].concat());
    scene.once(&ARGUMENTS).assert_status(1);
    scene.put("in/d.dump", steps([9]));
    scene.once(&ARGUMENTS).assert_status(0);
    let status = scene.run(&["status", "--out", "out"]);
    assert_eq!(status.status, Some(0), "{}{}", status.out, status.err);
    assert!(status.out.contains("2 done, 0 queued, 0 to retry, 0 failed"), "{}", status.out);
}

/// The daemon cannot know whether the last step is complete: it logs this, and converts the step again when
/// the file grows.
#[test]
fn step_without_a_final_newline_is_converted_with_a_message_and_again_when_the_file_grows() {
    let scene = Scene::new();
    let text = steps([1, 2]);
    let (start, rest) = text.split_at(text.len() - 3);
    scene.write("in/d.dump", start);
    let daemon = scene.watch(&ARGUMENTS);
    daemon.await_line("it is logged", |line| {
        line.is_about("d.dump/step=2") && line.fields.to_string().contains("without a line end")
    });
    daemon.await_converted("d.dump/step=2");
    daemon.await_converted("d.dump/step=1");
    append(&scene, rest);
    daemon.await_lines(2, "converted anew", |line| line.is_converted() && line.is_about("d.dump/step=2"));
    daemon.finish();
    scene.assert_as_converted(&CONVERT);
}

#[test]
fn rewritten_dump_replaces_its_steps() {
    let scene = Scene::new();
    scene.write("in/d.dump", steps([1, 2, 3]));
    let daemon = scene.watch(&ARGUMENTS);
    daemon.await_lines(3, "all are converted", Line::is_converted);
    scene.put("in/d.dump", steps([2, 7]));
    daemon.await_converted("d.dump/step=7");
    daemon.await_line("the other is found done", Line::is_found_done);
    // A dump of one step is a frame with the name of the file.
    scene.put("in/d.dump", steps([9]));
    daemon.await_converted("d.dump");
    await_that("its output exists", || names_in(&scene.path("out")).contains(&"d.obj".to_owned()));
    daemon.assert_no_complaints();
    assert_eq!(done_count(&daemon.finish()), 1, "the steps are not frames any more");
}

/// The number of frames that were done when the daemon ended.
fn done_count(log: &[Line]) -> u64 {
    let ended = log.iter().find(|line| line.message.starts_with("ended")).expect("it has ended");
    ended.fields["done"].as_u64().expect("a count")
}

#[test]
fn dump_overwritten_with_another_format_has_no_steps() {
    let scene = Scene::new();
    scene.write("in/d.dump", steps([1, 2]));
    let daemon = scene.watch(&ARGUMENTS);
    daemon.await_lines(2, "all are converted", Line::is_converted);
    // The daemon's own output is not a frame, whatever its name.
    scene.put("in/d.dump", scene.bytes("out/d.2.obj"));
    scene.put("in/e.ply", ply(&moving(3)));
    daemon.await_converted("e.ply");
    assert_eq!(done_count(&daemon.finish()), 1);
}

#[test]
fn queued_steps_are_converted_with_appended_ones() {
    let scene = Scene::new();
    scene.write("in/d.dump", steps(0..12));
    let daemon = scene.watch(&ARGUMENTS);
    daemon.await_converted("d.dump/step=0");
    for number in 12..15 {
        append(&scene, &steps([number]));
        daemon.await_converted(&format!("d.dump/step={number}"));
    }
    daemon.await_lines(15, "all are converted", Line::is_converted);
    daemon.assert_no_complaints();
    assert_eq!(done_count(&daemon.finish()), 15);
    scene.assert_as_converted(&CONVERT);
}
