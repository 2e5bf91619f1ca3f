//! Frames that are averaged with those around them: whatever the order in which they come, and however often the
//! daemon is killed, the results end as those of `convert`.

use std::fs;
use std::thread;
use std::time::Duration;

use crate::daemon::scene::{Scene, await_that, by_length, contents};
use crate::program::scene::shaken_frame;

const OPTIONS: [&str; 6] = ["--format", "obj", "--spacing", "0.1", "--temporal", "1"];

fn frame(number: usize) -> String {
    shaken_frame(number, "id")
}

fn put(scene: &Scene, number: usize) {
    scene.put(&format!("in/dam.{number}.ply"), frame(number));
}

#[test]
fn once_makes_what_convert_makes() {
    let scene = Scene::new();
    (1..=5).for_each(|number| put(&scene, number));
    scene.once(&OPTIONS).assert_status(0);
    scene.assert_as_converted(&OPTIONS);
    let without: Vec<&str> = OPTIONS[..4].to_vec();
    let averaged = contents(&scene.path("out"));
    scene.run(&[&["convert", "in", "--out", "without"][..], &without].concat());
    assert!(contents(&scene.path("without")) != averaged, "averages must change something");
    // A frame that changes, and one that comes, concern those around them.
    scene.put("in/dam.3.ply", frame(30));
    put(&scene, 6);
    let again = scene.once(&OPTIONS);
    assert_eq!(again.converted(), ["dam.2.ply", "dam.3.ply", "dam.4.ply", "dam.5.ply", "dam.6.ply"]);
    scene.assert_as_converted(&OPTIONS);
}

#[test]
fn frame_waits_for_the_next_one_and_is_made_again_when_it_comes_late() {
    let scene = Scene::new();
    put(&scene, 1);
    put(&scene, 2);
    let patient = scene.watch(&[&OPTIONS[..], &["--temporal-wait", "1h"]].concat());
    patient.await_converted("dam.1.ply");
    assert_eq!(patient.converted_count("dam.2.ply"), 0);
    put(&scene, 3);
    patient.await_converted("dam.2.ply");
    patient.finish();
    let hasty = scene.watch(&[&OPTIONS[..], &["--temporal-wait", "50ms"]].concat());
    hasty.await_converted("dam.3.ply");
    scene.assert_as_converted(&OPTIONS);
    for number in [5, 4] {
        put(&scene, number);
        hasty.await_converted(&format!("dam.{number}.ply"));
    }
    scene.run(&[&["convert", "in", "--out", "wanted"][..], &OPTIONS].concat());
    let wanted = contents(&scene.path("wanted"));
    await_that("the results are those of convert", || contents(&scene.path("out")) == wanted);
    hasty.assert_no_complaints();
    hasty.finish();
    scene.assert_as_converted(&OPTIONS);
    scene.assert_no_temporaries();
}

#[test]
fn killed_daemon_ends_with_what_convert_makes() {
    let (frame_count, kill_count) = by_length((12, 8), (60, 60));
    let scene = Scene::new();
    let options = [&OPTIONS[..], &["--settle", "20ms", "--temporal-wait", "30ms"]].concat();
    for kill in 0..kill_count {
        for number in kill * frame_count / kill_count..(kill + 1) * frame_count / kill_count {
            put(&scene, number + 1);
        }
        let daemon = scene.start(&options);
        thread::sleep(Duration::from_millis(40 + (kill as u64 * 37) % 160));
        daemon.kill();
    }
    scene.once(&options).assert_status(0);
    scene.assert_as_converted(&OPTIONS);
}

/// With two frames on each side, frames beside one that cannot be converted are not converted again and again.
#[test]
fn frames_beside_broken_ones_end() {
    let options = ["--format", "obj", "--spacing", "0.1", "--temporal", "2"];
    let scene = Scene::new();
    (1..=6).for_each(|number| put(&scene, number));
    scene.put("in/dam.4.ply", "ply\nformat nonsense 1.0\n");
    let once = scene.once(&options);
    once.assert_status(1);
    assert_eq!(once.converted_in_order().len(), 5);
    scene.assert_as_converted(&options);
    // The frame is mended.
    put(&scene, 4);
    scene.once(&options).assert_status(0);
    scene.assert_as_converted(&options);
    // Frames that become closer together are averaged with others.
    scene.put("in/dam.100.ply", frame(100));
    scene.put("in/dam.102.ply", frame(102));
    scene.once(&options).assert_status(0);
    scene.assert_as_converted(&options);
    // A good frame breaks, and then breaks in another way.
    fs::remove_file(scene.path("out/dam.4.obj")).expect("removed");
    for broken in ["ply\nformat nonsense 1.0\n", "ply\nformat other 1.0\n"] {
        scene.put("in/dam.4.ply", broken);
        scene.once(&options).assert_status(1);
        scene.assert_as_converted(&options);
    }
}

/// A mesh among the particles is between no frames, whenever it comes.
#[test]
fn files_that_are_not_frames_are_not_averaged_with() {
    let scene = Scene::new();
    let mesh = frame(2)
        .replace("end_header", "element face 1\nproperty list uchar int vertex_indices\nend_header")
        + "3 0 1 2\n";
    [1, 3, 5].into_iter().for_each(|number| put(&scene, number));
    scene.put("in/dam.2.ply", mesh);
    scene.once(&OPTIONS).assert_status(0);
    scene.assert_as_converted(&OPTIONS);
    // Now it is a frame, so that others are two steps apart.
    put(&scene, 2);
    scene.once(&OPTIONS).assert_status(0);
    scene.assert_as_converted(&OPTIONS);
}

/// An obstacle that moves, and is missing for one frame.
#[test]
fn missing_obstacle_of_a_frame_concerns_only_this_frame() {
    let options = [&OPTIONS[..], &["--obstacle", "body.{}.obj"]].concat();
    let scene = Scene::new();
    let body = |at: f64| {
        let far = at + 0.2;
        format!("v {at} 0 0\nv {far} 0 0\nv {at} 0.2 0\nv {at} 0 0.2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    };
    for number in 1..=5 {
        put(&scene, number);
        if number != 3 {
            scene.write(&format!("body.{number}.obj"), body(0.1 * number as f64));
        }
    }
    scene.once(&options).assert_status(1);
    scene.assert_as_converted(&options);
    scene.write("body.3.obj", body(0.3));
    scene.once(&options).assert_status(0);
    scene.assert_as_converted(&options);
    // It breaks.
    fs::remove_file(scene.path("out/dam.3.obj")).expect("removed");
    scene.write("body.3.obj", "v 0 0 nonsense\n");
    scene.once(&options).assert_status(1);
    scene.assert_as_converted(&options);
}

/// Rest coordinates need all frames before a frame, and none after it: in whatever order frames come.
#[test]
fn frames_with_rest_coordinates_follow_those_before_them() {
    let options = ["--format", "ply", "--spacing", "0.1", "--rest", "1"];
    let scene = Scene::new();
    put(&scene, 1);
    // None waits for a frame after it.
    let daemon = scene.watch(&[&options[..], &["--temporal-wait", "1h"]].concat());
    daemon.await_converted("dam.1.ply");
    for number in [4, 2, 3] {
        put(&scene, number);
        daemon.await_converted(&format!("dam.{number}.ply"));
    }
    scene.run(&[&["convert", "in", "--out", "wanted"][..], &options].concat());
    let wanted = contents(&scene.path("wanted"));
    await_that("the results are those of convert", || contents(&scene.path("out")) == wanted);
    daemon.assert_no_complaints();
    daemon.finish();
    scene.put("in/dam.2.ply", frame(20));
    let again = scene.once(&options);
    assert_eq!(again.converted(), ["dam.2.ply", "dam.3.ply", "dam.4.ply"]);
    scene.assert_as_converted(&options);
    assert_eq!(scene.once(&options).converted(), [""; 0]);
}
