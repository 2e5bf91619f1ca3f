//! Stages grow with the frames, and survive restarts.

use std::ffi::OsStr;
use std::fs;
use std::io::Write;
use std::os::unix::ffi::OsStrExt;

use flate2::Compression;
use flate2::write::GzEncoder;

use crate::daemon::scene::{Scene, await_that, block, log_text, moving, ply};

const FORMATS: [&str; 4] = ["--format", "usdc,vdb", "--stage", "dam.usda"];

/// The text of the stage; empty while it is missing.
fn stage(scene: &Scene) -> String {
    fs::read_to_string(scene.path("dam.usda")).unwrap_or_default()
}

/// Waits until the stage plays exactly these frames.
#[track_caller]
fn await_frames(scene: &Scene, numbers: &[usize]) {
    let paths: Vec<String> = numbers.iter().map(|number| format!("@./out/dam.{number}.usdc@")).collect();
    let list = format!("asset[] assetPaths = [{}]\n", paths.join(", "));
    await_that(&list, || stage(scene).contains(&list));
}

/// Asserts that `convert` makes the same stage of the frames.
#[track_caller]
fn assert_as_converted(scene: &Scene) {
    let result = scene.run(&[
        "convert",
        "in",
        "--out",
        "out",
        "--skip-done",
        "--format",
        "usdc,vdb",
        "--stage",
        "c.usda",
    ]);
    assert_eq!(result.status, Some(0), "{}", result.err);
    let converted = String::from_utf8(scene.bytes("c.usda")).expect("text");
    // Each is its own manifest.
    assert!(converted.contains("manifestAssetPath = @./c.usda@"), "{converted}");
    assert_eq!(stage(scene), converted.replace("@./c.usda@", "@./dam.usda@"));
}

#[test]
fn stage_grows_with_the_frames_and_is_rebuilt_after_a_restart() {
    let scene = Scene::new();
    scene.put_moving([1, 2]);
    let daemon = scene.watch(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    await_frames(&scene, &[1, 2]);
    scene.put_moving([5]);
    await_frames(&scene, &[1, 2, 5]);
    assert!(
        stage(&scene).contains("double2[] active = [(1, 0), (1.984375, 0), (2, 1), (4.984375, 1), (5, 2)]")
    );
    daemon.assert_no_complaints();
    daemon.kill();

    // The records have the frames, also one whose input is gone. A file that was removed is not in the stage.
    scene.remove("dam.usda");
    scene.remove("in/dam.1.ply");
    let daemon = scene.watch(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    await_frames(&scene, &[1, 2, 5]);
    scene.put_moving([3]);
    await_frames(&scene, &[1, 2, 3, 5]);
    daemon.assert_no_complaints();
    daemon.finish();
    scene.assert_no_temporaries();
    scene.remove("out/dam.1.usdc");
    scene.remove("out/dam.1.vdb");
    let once = scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    once.assert_status(0);
    assert!(once.converted().is_empty());
    assert_as_converted(&scene);
}

#[test]
fn stage_of_a_finished_run_is_that_of_convert() {
    let scene = Scene::new();
    scene.put_moving(1..=3);
    // `--once` ends before the pause between two updates is over.
    scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat()).assert_status(0);
    await_frames(&scene, &[1, 2, 3]);
    assert_as_converted(&scene);
    // Without the records, frames are converted again, and the stage is the same.
    fs::remove_dir_all(scene.path("out/.meniscus")).expect("removed");
    scene.remove("dam.usda");
    scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat()).assert_status(0);
    assert_as_converted(&scene);
}

#[test]
fn file_that_is_not_a_stage_is_not_replaced() {
    let scene = Scene::new();
    scene.put_moving([1]);
    scene.write("dam.usda", "#usda 1.0\n");
    let daemon = scene.watch(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    daemon.await_line("the error", |line| {
        line.level == "ERROR" && line.message.contains("dam.usda: exists, and is not a stage of meniscus")
    });
    daemon.await_converted("dam.1.ply");
    assert_eq!(stage(&scene), "#usda 1.0\n");
    daemon.finish();
    // The frame is done, and the stage is not.
    scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat()).assert_status(1);
    scene.remove("dam.usda");
    scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat()).assert_status(0);
}

#[test]
fn frame_that_usd_cannot_name_is_left_out_with_a_warning() {
    let scene = Scene::new();
    scene.put_moving([1, 2]);
    scene.put("in/we\u{1}t.3.ply", ply(&moving(3)));
    let not_unicode = scene.path("in").join(OsStr::from_bytes(b"gr\xfcn.3.ply"));
    let has_both = fs::copy(scene.path("in/dam.1.ply"), not_unicode);
    let options = [&["--settle", "10ms"], &FORMATS[..]].concat();
    let once = scene.once(&options);
    once.assert_status(0);
    await_frames(&scene, &[1, 2]);
    assert!(once.log.iter().all(|line| line.level != "ERROR"), "{}", log_text(&once.log));
    let warnings = once.log.iter().filter(|line| line.message.contains("is left out of the stage"));
    // Some file systems take Unicode only.
    assert_eq!(warnings.count(), if has_both.is_ok() { 2 } else { 1 }, "{}", log_text(&once.log));
}

#[test]
fn frames_whose_inputs_were_replaced_are_listed_once() {
    let scene = Scene::new();
    scene.put_moving([1, 2]);
    let daemon = scene.watch(&[&["--settle", "10ms"], &FORMATS[..]].concat());
    await_frames(&scene, &[1, 2]);
    let outputs = || [1, 2].map(|number| scene.bytes(&format!("out/dam.{number}.usdc")));
    let [first, second] = outputs();
    // The compressed files contain other particles, so that their results can be told from the old ones.
    for (number, content) in [(1, 7), (2, 8)] {
        scene.put_moving([content]);
        let bytes = scene.bytes(&format!("in/dam.{content}.ply"));
        let mut packed = GzEncoder::new(Vec::new(), Compression::fast());
        packed.write_all(&bytes).expect("compressed");
        scene.remove(&format!("in/dam.{number}.ply"));
        scene.put(&format!("in/dam.{number}.ply.gz"), packed.finish().expect("compressed"));
    }
    await_that("the new inputs are converted", || {
        let [new_first, new_second] = outputs();
        new_first != first && new_second != second
    });
    daemon.finish();
    await_frames(&scene, &[1, 2, 7, 8]);
}

/// A dump with these steps.
fn dump(numbers: &[usize]) -> String {
    let mut text = String::new();
    for number in numbers {
        let particles = block(6, 0.1, 0.001 * *number as f32);
        text += &format!("ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n{}\n", particles.len());
        text += "ITEM: BOX BOUNDS pp pp pp\n0 1\n0 1\n0 1\nITEM: ATOMS id x y z\n";
        for (id, [x, y, z]) in particles.iter().enumerate() {
            text += &format!("{id} {x} {y} {z}\n");
        }
    }
    text
}

#[test]
fn steps_have_their_own_numbers_and_the_prim_that_convert_gives_them() {
    let scene = Scene::new();
    scene.put("in/run.0002.lammpstrj", dump(&[0, 100, 200]));
    scene.once(&[&["--settle", "10ms"], &FORMATS[..]].concat()).assert_status(0);
    let text = stage(&scene);
    for part in [
        "    def Xform \"run_0002\" (",
        "@./out/run.0002.200.usdc@",
        "active = [(0, 0), (99.984375, 0), (100, 1), (199.984375, 1), (200, 2)]",
    ] {
        assert!(text.contains(part), "{part} is not in {text}");
    }
    assert_as_converted(&scene);
}

#[test]
fn prims_of_sub_folders_keep_their_names_when_others_arrive() {
    let scene = Scene::new();
    let options = [&["--settle", "10ms", "--pattern", "**"], &FORMATS[..]].concat();
    let clip = |folder: &str| format!("asset[] assetPaths = [@./out/{folder}/dam.1.usdc@]");
    // The clips of the prim with this name.
    let clips_of = |name: &str| {
        let text = stage(&scene);
        let (_, prim) = text.split_once(&format!("    def Xform \"{name}\" (")).expect(name);
        prim.lines().find(|line| line.contains("assetPaths")).expect("clips").trim().to_owned()
    };
    scene.write("in/b/dam.1.ply", ply(&moving(2)));
    scene.once(&options).assert_status(0);
    assert_eq!(clips_of("b_dam"), clip("b"));
    scene.write("in/a/dam.1.ply", ply(&moving(3)));
    scene.once(&options).assert_status(0);
    assert_eq!((clips_of("a_dam"), clips_of("b_dam")), (clip("a"), clip("b")));
}

#[test]
fn old_file_of_a_failed_frame_stays_in_the_stage() {
    let scene = Scene::new();
    scene.put_moving([1, 2]);
    let options = [&["--settle", "10ms"], &FORMATS[..]].concat();
    scene.once(&options).assert_status(0);
    let mut corrupt = ply(&moving(2));
    corrupt[20..30].copy_from_slice(b"nonsense..");
    scene.put("in/dam.2.ply", &corrupt);
    scene.remove("dam.usda");
    scene.once(&options).assert_status(1);
    await_frames(&scene, &[1, 2]);
}

#[test]
fn other_block_of_the_same_folder_is_not_in_the_stage() {
    let scene = Scene::new();
    scene.put_moving([1, 2]);
    scene.put("in/spray.1.ply", ply(&moving(2)));
    let block = |pattern: &str, more: &str| {
        format!(
            "[[watch]]\ninput = \"in\"\noutput = \"out\"\npattern = \"{pattern}\"\nformats = [\"usdc\"]\n{more}"
        )
    };
    scene.write(
        "meniscus.toml",
        block("dam.*.ply", "stage = \"dam.usda\"\nfps = 25\n") + &block("spray.*.ply", ""),
    );
    let result = scene.run(&["watch", "--config", "meniscus.toml", "--once", "--settle", "10ms"]);
    assert_eq!(result.status, Some(0), "{}", result.err);
    assert!(scene.path("out/spray.1.usdc").exists());
    await_frames(&scene, &[1, 2]);
    assert!(!stage(&scene).contains("spray"), "{}", stage(&scene));
}

#[test]
fn frame_that_would_replace_the_stage_is_refused() {
    let scene = Scene::new();
    scene.put_moving([1, 2]);
    let once = scene.once(&["--settle", "10ms", "--format", "usda", "--stage", "out/dam.1.usda"]);
    once.assert_status(1);
    assert!(
        once.log.iter().any(|line| line.message.contains("dam.1.usda would replace the stage")),
        "{}",
        log_text(&once.log)
    );
    let text = String::from_utf8(scene.bytes("out/dam.1.usda")).expect("text");
    assert!(text.contains("stage_frames") && text.contains("@./dam.2.usda@"), "{text}");

    // The refused frame does not prevent the stage from growing.
    scene.put_moving([3]);
    let again = scene.once(&["--settle", "10ms", "--format", "usda", "--stage", "out/dam.1.usda"]);
    assert!(!log_text(&again.log).contains("cannot write the stage"), "{}", log_text(&again.log));
    let text = String::from_utf8(scene.bytes("out/dam.1.usda")).expect("text");
    assert!(text.contains("@./dam.2.usda@") && text.contains("@./dam.3.usda@"), "{text}");
}
