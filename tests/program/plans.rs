//! Plans and their shards: the same bytes as one process, also after kills, repetitions and damage; and the
//! messages about them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, block, command, meniscus, names_in, write_ply, write_sequence};

fn shard(folder: &Path, number: usize) -> RunResult {
    meniscus(folder, &["convert", "--plan", "plan.json", "--shard", &number.to_string()])
}

fn verify(folder: &Path) -> RunResult {
    meniscus(folder, &["verify", "out", "--plan", "plan.json"])
}

fn succeeded(result: &RunResult) {
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
}

/// A folder with `in/dam.1.ply` to `in/dam.N.ply`, and a plan that divides them into `shard_count` shards.
fn planned(frame_count: usize, shard_count: usize) -> TempDir {
    let folder = tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("made");
    write_sequence(&folder.path().join("in"), 1, frame_count);
    plan_again(folder.path(), shard_count);
    folder
}

fn plan_again(folder: &Path, shard_count: usize) {
    let count = shard_count.to_string();
    succeeded(&meniscus(folder, &["plan", "in", "--out", "out", "--shards", &count, "-o", "plan.json"]));
}

/// The names and bytes of the outputs in a folder, without the files that only a farm needs.
fn outputs(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let names = names_in(folder).into_iter().filter(|name| !name.ends_with(".certificate.json"));
    names.map(|name| (name.clone(), fs::read(folder.join(&name)).expect("readable"))).collect()
}

/// Identifiers that change when a file is written again.
#[cfg(unix)]
fn identities(folder: &Path) -> Vec<(String, u64, i64)> {
    use std::os::unix::fs::MetadataExt;
    let identity = |name: String| {
        let metadata = fs::metadata(folder.join(&name)).expect("there");
        (name, metadata.ino(), metadata.mtime_nsec())
    };
    names_in(folder).into_iter().map(identity).collect()
}

/// Two sequences with different spacings in separate folders, a moving obstacle, and a fixed obstacle.
fn write_scene(folder: &Path) {
    for (name, scale) in [("dam", 1.0), ("foam", 0.5)] {
        let frames = folder.join("in").join(name);
        fs::create_dir_all(&frames).expect("made");
        for number in 1..=4 {
            let particles: Vec<[f64; 3]> =
                block(5, 0.02 * f64::from(number)).iter().map(|p| p.map(|x| x * scale)).collect();
            write_ply(&frames.join(format!("{name}.{number}.ply")), &particles);
        }
    }
    let tetrahedron = |at: f64| {
        let far = at + 0.2;
        format!("v {at} 0 0\nv {far} 0 0\nv {at} 0.2 0\nv {at} 0 0.2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    };
    for number in 1..=4 {
        let text = tetrahedron(0.05 * f64::from(number));
        fs::write(folder.join(format!("body.{number}.obj")), text).expect("written");
    }
    fs::write(folder.join("still.obj"), tetrahedron(-0.1)).expect("written");
}

#[test]
fn shards_make_the_same_bytes_as_one_process() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    write_scene(folder);
    let options = [
        "in/*/*.ply",
        "--obstacle=body.{}.obj",
        "--obstacle=still.obj",
        "--preview=png",
        "--preview-size=64x48",
        "--format=glb,obj,ply,vdb",
    ];
    succeeded(&meniscus(folder, &[&["convert", "--out=one"][..], &options].concat()));
    succeeded(&meniscus(
        folder,
        &[&["plan", "--out=out", "--shards=3", "-o=plan.json"][..], &options].concat(),
    ));
    assert!(names_in(&folder.join("out")).is_empty(), "created, because shards require it");
    // Run the last shard first, from another folder, with different numbers of threads, and one shard twice
    // at the same time.
    let elsewhere = tempdir().expect("a folder");
    let plan = folder.join("plan.json").display().to_string();
    let mut running: Vec<_> = [(2, "1"), (1, "3"), (1, "2"), (0, "2")]
        .into_iter()
        .map(|(number, threads)| {
            let number = number.to_string();
            let arguments = ["convert", "--plan", &plan, "--shard", &number, "--threads", threads];
            command(elsewhere.path(), &arguments)
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn()
                .expect("the command starts")
        })
        .collect();
    for process in &mut running {
        assert!(process.wait().expect("it ends").success());
    }
    let (one, out) = (outputs(&folder.join("one")), outputs(&folder.join("out")));
    assert_eq!(one.len(), 8 * 5);
    let names =
        |outputs: &[(String, Vec<u8>)]| outputs.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
    assert_eq!(names(&one), names(&out));
    for ((name, one), (_, other)) in one.iter().zip(&out) {
        assert!(one == other, "{name}");
    }
    let verified = verify(folder);
    succeeded(&verified);
    assert!(verified.out.starts_with("8 frames: 8 done, in "), "{}", verified.out);
    fs::remove_file(folder.join("body.3.obj")).expect("removed");
    let verified = verify(folder);
    succeeded(&verified);
    assert!(verified.err.contains("2 frames with a missing obstacle"), "{}", verified.err);
}

/// If the output folder is not mounted, a shard does not create it on another disk.
#[test]
fn shard_does_not_create_the_output_folder() {
    let folder = planned(2, 1);
    let folder = folder.path();
    fs::remove_dir(folder.join("out")).expect("removed");
    let result = shard(folder, 0);
    assert_eq!(result.status, 2);
    assert!(result.err.contains("is it mounted?"), "{}", result.err);
    assert!(!folder.join("out").exists());
}

#[test]
fn done_frames_do_not_need_their_inputs() {
    let folder = planned(3, 1);
    let folder = folder.path();
    succeeded(&shard(folder, 0));
    fs::remove_file(folder.join("in/dam.2.ply")).expect("removed");
    let result = shard(folder, 0);
    succeeded(&result);
    assert!(result.out.contains("dam.2: done already"), "{}", result.out);
    // A frame that is done keeps its entry in the report, even if its input is missing.
    let plan = ["convert", "--plan=plan.json", "--shard=0", "--report=r.json"];
    let result = meniscus(folder, &plan);
    succeeded(&result);
    assert!(result.out.contains("3 frames: 3 done"), "{}", result.out);
    let report: Value =
        serde_json::from_slice(&fs::read(folder.join("r.json")).expect("there")).expect("JSON");
    let frames = report["frames"].as_array().expect("frames");
    let statuses = frames.iter().map(|frame| (frame["input"].as_str().expect("text"), &frame["status"]));
    for (number, (input, status)) in (1..).zip(statuses) {
        assert!(input.ends_with(&format!("dam.{number}.ply")) && status == "already_done", "{report}");
    }
    assert_eq!((frames.len(), &report["summary"]["already_done"]), (3, &3.into()));
    fs::remove_file(folder.join("out/dam.2.glb")).expect("removed");
    assert_eq!(shard(folder, 0).status, 1, "it cannot be made again");
}

#[test]
fn report_does_not_replace_files_of_the_plan() {
    let folder = planned(2, 1);
    let folder = folder.path();
    succeeded(&shard(folder, 0));
    let refused = |path: &str, why: &str| {
        for command in
            [&["verify", "out", "--plan=plan.json"][..], &["convert", "--plan=plan.json", "--shard=0"]]
        {
            let before = fs::read(folder.join(path)).expect("there");
            let result = meniscus(folder, &[command, &["--report", path]].concat());
            assert_eq!(result.status, 2, "{path}");
            assert!(result.err.contains(why), "{}", result.err);
            assert!(fs::read(folder.join(path)).expect("there") == before, "{path}");
        }
    };
    refused("plan.json", "the report would replace the plan");
    for path in ["in/dam.2.ply", "out/dam.1.glb", "out/../out/dam.2.vdb", "out/dam.1.certificate.json"] {
        refused(path, "the report would replace a file of the plan");
    }
}

/// In an edited plan, outputs may have the paths of inputs.
#[test]
fn plan_whose_outputs_replace_inputs_is_refused() {
    let folder = planned(2, 2);
    let path = folder.path().join("plan.json");
    let mut plan: Value = serde_json::from_slice(&fs::read(&path).expect("there")).expect("JSON");
    plan["out"] = json!(folder.path().join("in"));
    plan["outputs"]["formats"] = json!(["ply"]);
    fs::write(&path, plan.to_string()).expect("written");
    let result = shard(folder.path(), 1);
    assert_eq!(result.status, 2);
    assert!(result.err.contains("/frames/0/input: an output of the plan would overwrite"), "{}", result.err);
}

#[test]
fn failed_shard_repeats_no_finished_frame() {
    let folder = planned(5, 2);
    let folder = folder.path();
    let broken = folder.join("in/dam.2.ply");
    let sound = fs::read(&broken).expect("readable");
    fs::write(&broken, "ply\nformat nonsense 1.0\n").expect("written");
    let result = shard(folder, 0);
    assert_eq!(result.status, 1, "{}", result.err);
    assert!(result.err.contains("dam.2.ply: changed since the plan was made ("), "{}", result.err);
    succeeded(&shard(folder, 1));
    let verified = verify(folder);
    assert_eq!(verified.status, 1);
    assert!(verified.out.contains("5 frames: 4 done, 1 missing, in "), "{}", verified.out);
    assert!(verified.out.contains("run again: shard 0\n"), "{}", verified.out);
    assert!(verified.err.starts_with("dam.2 (shard 0): missing: dam.2.glb, dam.2.vdb, "), "{}", verified.err);

    fs::write(&broken, sound).expect("written");
    #[cfg(unix)]
    let before = identities(&folder.join("out"));
    let result = shard(folder, 0);
    succeeded(&result);
    assert_eq!(result.out.matches("done already").count(), 2, "{}", result.out);
    #[cfg(unix)]
    {
        let after = identities(&folder.join("out"));
        assert!(before.iter().all(|file| after.contains(file)), "{before:?} {after:?}");
        assert_eq!(after.len(), before.len() + 3);
    }
    succeeded(&verify(folder));
}

#[test]
fn killed_shard_continues_with_the_unfinished_frames() {
    let folder = planned(24, 1);
    let folder = folder.path();
    let arguments = ["convert", "--plan", "plan.json", "--shard", "0", "--threads", "1"];
    let mut process = command(folder, &arguments).stdout(Stdio::null()).spawn().expect("the command starts");
    let certified = || {
        let names = if folder.join("out").exists() { names_in(&folder.join("out")) } else { Vec::new() };
        names.iter().filter(|name| name.ends_with(".certificate.json")).count()
    };
    let deadline = Instant::now() + Duration::from_secs(300);
    while certified() < 2 {
        assert!(Instant::now() < deadline, "no frame was converted");
        std::thread::sleep(Duration::from_millis(2));
    }
    process.kill().expect("it runs");
    process.wait().expect("it ends");
    let done = certified();
    #[cfg(unix)]
    let before = identities(&folder.join("out"));
    let result = shard(folder, 0);
    succeeded(&result);
    assert_eq!(result.out.matches("done already").count(), done, "{}", result.out);
    #[cfg(unix)]
    {
        let after = identities(&folder.join("out"));
        // A frame is made again if only some of its files exist.
        let is_complete = |name: &str| {
            let stem = name.split('.').take(2).collect::<Vec<_>>().join(".");
            before.iter().any(|(other, ..)| *other == format!("{stem}.certificate.json"))
        };
        assert!(before.iter().filter(|(name, ..)| is_complete(name)).all(|file| after.contains(file)));
    }
    succeeded(&verify(folder));
    succeeded(&meniscus(folder, &["convert", "in", "--out", "one"]));
    let out = outputs(&folder.join("out")).into_iter().filter(|(name, _)| !name.starts_with('.'));
    assert!(out.eq(outputs(&folder.join("one"))));
}

/// A missing input may have been removed on purpose, so `verify` accepts the outputs. If an input exists but
/// cannot be read, the outputs cannot be compared with it.
#[cfg(unix)]
#[test]
fn verify_fails_for_an_input_that_exists_and_cannot_be_read() {
    let folder = planned(2, 1);
    let folder = folder.path();
    succeeded(&shard(folder, 0));
    succeeded(&verify(folder));
    fs::remove_file(folder.join("in/dam.1.ply")).expect("removed");
    succeeded(&verify(folder));
    std::os::unix::fs::symlink("dam.2.ply", folder.join("in/dam.2.link")).expect("linked");
    fs::remove_file(folder.join("in/dam.2.ply")).expect("removed");
    // A link that leads to itself: not even root can read it.
    fs::rename(folder.join("in/dam.2.link"), folder.join("in/dam.2.ply")).expect("renamed");
    let verified = verify(folder);
    assert_eq!(verified.status, 1, "{}{}", verified.out, verified.err);
    assert!(verified.err.contains("cannot be compared with their input"), "{}", verified.err);
}

/// The same holds for obstacles: `verify` skips only removed obstacles.
#[cfg(unix)]
#[test]
fn obstacle_that_exists_and_cannot_be_read_fails_verify_and_shard() {
    let folder = tempdir().expect("a folder");
    let folder = folder.path();
    fs::create_dir(folder.join("in")).expect("made");
    write_sequence(&folder.join("in"), 1, 1);
    let obstacle = folder.join("still.obj");
    fs::write(&obstacle, "v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nv 0 0 0.2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
        .expect("written");
    succeeded(&meniscus(
        folder,
        &["plan", "in", "--out", "out", "--shards", "1", "-o", "plan.json", "--obstacle", "still.obj"],
    ));
    succeeded(&shard(folder, 0));
    succeeded(&verify(folder));
    fs::remove_file(&obstacle).expect("removed");
    succeeded(&verify(folder));
    succeeded(&shard(folder, 0));
    // A link that leads to itself cannot be read, not even by root.
    std::os::unix::fs::symlink("still.obj", &obstacle).expect("linked");
    let verified = verify(folder);
    // This is the only frame, so none is done.
    assert_eq!(verified.status, 2, "{}{}", verified.out, verified.err);
    assert!(verified.err.contains("cannot be compared with their obstacle"), "{}", verified.err);
    let converted = shard(folder, 0);
    assert_eq!(converted.status, 2, "{}{}", converted.out, converted.err);
    assert!(converted.err.contains("still.obj"), "{}", converted.err);
}

#[test]
fn shards_without_frames_succeed() {
    let folder = planned(2, 5);
    let folder = folder.path();
    for number in 0..5 {
        let result = shard(folder, number);
        succeeded(&result);
        let count = if number < 2 { "1 frame" } else { "0 frames" };
        assert!(result.out.starts_with(&format!("shard {number} (of 0 to 4): {count}\n")), "{}", result.out);
    }
    succeeded(&verify(folder));
    let result = shard(folder, 5);
    assert_eq!(result.status, 2);
    assert!(result.err.contains("--shard is 5, but the plan has shards 0 to 4"), "{}", result.err);
}

/// Slurm sets the number of the shard; if it does not, the error says so.
#[test]
fn slurm_task_id_selects_the_shard() {
    let folder = planned(2, 2);
    let folder = folder.path();
    let run = |task: Option<&str>| {
        let mut command = command(folder, &["convert", "--plan", "plan.json", "--shard", "slurm"]);
        match task {
            Some(task) => command.env("SLURM_ARRAY_TASK_ID", task),
            None => command.env_remove("SLURM_ARRAY_TASK_ID"),
        };
        let output = command.output().expect("the command starts");
        (output.status.code(), String::from_utf8(output.stderr).expect("text"))
    };
    assert_eq!(run(Some("1")), (Some(0), String::new()));
    assert!(names_in(&folder.join("out")).iter().all(|name| name.starts_with("dam.2.")));
    for (task, why) in [
        (None, "SLURM_ARRAY_TASK_ID is not set"),
        (Some("2"), "SLURM_ARRAY_TASK_ID is 2, but the plan has shards 0 to 1"),
        (Some("-1"), "SLURM_ARRAY_TASK_ID is `-1`"),
        (Some(""), "SLURM_ARRAY_TASK_ID is ``"),
    ] {
        let (status, message) = run(task);
        assert!(status == Some(2) && message.contains(why), "{task:?}: {message}");
    }
}

#[test]
fn options_that_the_plan_decides_are_refused() {
    let folder = planned(2, 1);
    let folder = folder.path();
    for more in [
        &["in"][..],
        &["--out=x"],
        &["--steps=3"],
        &["--vdb-half"],
        &["--frames=1"],
        &["--skip-done"],
        &["--print-settings"],
    ] {
        let result = meniscus(folder, &[&["convert", "--plan=plan.json", "--shard=0"][..], more].concat());
        assert_eq!(result.status, 2, "{more:?}");
        assert!(result.err.contains("the plan determines frames, settings and outputs"), "{}", result.err);
    }
    assert!(names_in(&folder.join("out")).is_empty());
    for alone in [["convert", "--plan=plan.json"], ["convert", "--shard=0"]] {
        assert_eq!(meniscus(folder, &alone).status, 2);
    }
    let allowed = ["--threads=1", "--memory=1GiB", "--report=r.json", "--on-error=stop"];
    succeeded(&meniscus(folder, &[&["convert", "--plan=plan.json", "--shard=0"][..], &allowed].concat()));
    let report: Value =
        serde_json::from_slice(&fs::read(folder.join("r.json")).expect("there")).expect("JSON");
    assert_eq!(report["summary"]["converted"], 2);
    assert!(report["settings"][0]["spacing"].is_f64(), "{report}");
}

/// A status, the damage to the outputs of a frame that causes it, and the expected message.
type Case = (&'static str, fn(&Path), &'static str);

fn edit(path: PathBuf, change: impl FnOnce(&mut Vec<u8>)) {
    let mut bytes = fs::read(&path).expect("readable");
    change(&mut bytes);
    fs::write(path, bytes).expect("written");
}

/// Edits the certificate of the first frame.
fn in_certificate(folder: &Path, was: &str, becomes: &str) {
    edit(folder.join("out/dam.1.certificate.json"), |bytes| {
        let text = String::from_utf8(bytes.clone()).expect("text");
        assert!(text.contains(was), "{text}");
        *bytes = text.replace(was, becomes).into_bytes();
    });
}

const CASES: [Case; 14] = [
    ("missing", |f| fs::remove_file(f.join("out/dam.1.vdb")).expect("there"), "missing: dam.1.vdb"),
    (
        "missing",
        |f| fs::remove_file(f.join("out/dam.1.certificate.json")).expect("there"),
        "missing: dam.1.certificate.json",
    ),
    (
        "damaged",
        |f| edit(f.join("out/dam.1.glb"), |bytes| bytes.truncate(bytes.len() - 9)),
        "dam.1.glb was changed or replaced: it has ",
    ),
    // Damage to the provenance of a file is damage, and not another setting.
    (
        "damaged",
        |f| {
            edit(f.join("out/dam.1.glb"), |bytes| {
                let name = b"step_size";
                let at = bytes.windows(name.len()).position(|part| part == name).expect("a setting");
                bytes[at] ^= 1;
            });
        },
        "dam.1.glb was changed or replaced: its hash differs from that in the certificate",
    ),
    (
        "damaged",
        |f| in_certificate(f, "\"input_hash\": \"xxh3-128:", "\"input_hash\": \"xxh3-128:0"),
        "dam.1.glb: the certificate names another input than the file",
    ),
    (
        "damaged",
        |f| edit(f.join("out/dam.1.vdb"), |bytes| *bytes.last_mut().expect("bytes") ^= 1),
        "dam.1.vdb was changed or replaced: its hash differs from that in the certificate",
    ),
    ("damaged", |f| edit(f.join("out/dam.1.glb"), Vec::clear), "dam.1.glb was changed or replaced"),
    (
        "damaged",
        |f| fs::write(f.join("out/dam.1.certificate.json"), "{}").expect("written"),
        "dam.1.certificate.json: missing field",
    ),
    (
        "damaged",
        |f| in_certificate(f, "\"closed_manifold\": true", "\"closed_manifold\": false"),
        "dam.1.certificate.json: it contradicts itself: holds is true, but: the mesh is not a closed 2-manifold",
    ),
    (
        "damaged",
        |f| in_certificate(f, "\"count\": 0", "\"count\": 7"),
        "it contradicts itself: holds is true, but: 7 particles outside",
    ),
    (
        "damaged",
        |f| in_certificate(f, "\"holds\": true", "\"holds\": true,\n    \"trust_me\": true"),
        "unknown field `trust_me`",
    ),
    // Another run replaced a file, and wrote no certificate.
    (
        "damaged",
        |f| {
            let arguments = ["convert", "in/dam.1.ply", "--out=out", "--voxel-size=0.07", "--format=glb"];
            succeeded(&meniscus(f, &arguments));
        },
        "dam.1.glb was changed or replaced",
    ),
    (
        "stale",
        |f| write_ply(&f.join("in/dam.1.ply"), &block(5, 0.0)),
        "the input has changed since it was made",
    ),
    (
        "uncertified",
        |f| {
            edit(f.join("out/dam.1.certificate.json"), |bytes| {
                let text = String::from_utf8(bytes.clone()).expect("text");
                let text = text.replace("\"holds\": true", "\"holds\": false");
                *bytes = text.replace("\"count\": 0", "\"count\": 3").into_bytes();
            });
        },
        "failed validation: 3 particles outside",
    ),
];

#[test]
fn verify_reports_every_kind_of_damage() {
    let folder = planned(2, 2);
    let folder = folder.path();
    for (status, meddle, why) in CASES {
        succeeded(&shard(folder, 0));
        succeeded(&shard(folder, 1));
        meddle(folder);
        let result = meniscus(folder, &["verify", "out", "--plan=plan.json", "--report=v.json"]);
        assert_eq!(result.status, 1, "{status}: {}", result.out);
        let state = if status == "uncertified" { "failed validation" } else { status };
        assert!(result.err.starts_with(&format!("dam.1 (shard 0): {state}: ")), "{}", result.err);
        assert!(result.err.contains(why), "{}", result.err);
        let report: Value =
            serde_json::from_slice(&fs::read(folder.join("v.json")).expect("there")).expect("JSON");
        assert_eq!(report["summary"][status], 1, "{report}");
        assert_eq!(report["summary"]["done"], 1, "{report}");
        assert_eq!(report["frames"][0]["status"], status);
        let is_made_again = status != "uncertified";
        assert_eq!(report["shards_to_run"], if is_made_again { json!([0]) } else { json!([]) });
        // The shard with this frame repairs it, and converts no other frame.
        let result = shard(folder, 0);
        assert_eq!(result.status, i32::from(!is_made_again), "{}", result.err);
        assert_eq!(result.out.contains("done already"), !is_made_again, "{status}: {}", result.out);
        assert_eq!(verify(folder).status, i32::from(!is_made_again));
    }
}

#[test]
fn gaps_and_shards_that_never_ran_are_one_line_each() {
    let folder = tempdir().expect("a folder");
    let path = folder.path();
    for number in [1, 2, 5, 6] {
        write_sequence(path, number, number);
    }
    let result = meniscus(path, &["plan", "dam.#.ply", "--out", "out", "--shards", "2", "-o", "plan.json"]);
    assert_eq!(result.status, 0, "{}", result.err);
    assert!(result.err.contains("dam.{}.ply: 3-4: 2 frames are missing"), "{}", result.err);
    let verified = verify(path);
    let lines: Vec<&str> = verified.err.lines().collect();
    let expected = [
        "shard 0: missing: all of its 2 frames, dam.1 to dam.2",
        "shard 1: missing: all of its 2 frames, dam.5 to dam.6",
    ];
    assert_eq!(lines, expected);

    // One existing file shows that the shard was started, so `verify` prints a line for each of its frames.
    assert_eq!(shard(path, 1).status, 0);
    let out = path.join("out");
    for stem in ["dam.5.", "dam.6."] {
        let name = names_in(&out).into_iter().find(|name| name.starts_with(stem)).expect("a file of it");
        fs::remove_file(out.join(name)).expect("removed");
    }
    let lines = verify(path).err;
    assert!(
        lines.contains("dam.5 (shard 1): missing: ") && lines.contains("dam.6 (shard 1): missing: "),
        "{lines}"
    );
    assert!(
        lines.contains("shard 0: missing: all of its 2 frames") && !lines.contains("shard 1: missing"),
        "{lines}"
    );
}

#[test]
fn outputs_are_verified_in_another_folder() {
    let folder = planned(2, 1);
    let folder = folder.path();
    succeeded(&shard(folder, 0));
    fs::rename(folder.join("out"), folder.join("elsewhere")).expect("renamed");
    fs::remove_dir_all(folder.join("in")).expect("removed");
    let result = meniscus(folder, &["verify", "elsewhere", "--plan=plan.json"]);
    succeeded(&result);
    assert!(result.err.contains("2 frames with a missing input"), "{}", result.err);
    let elsewhere = "checked elsewhere, but the plan writes to ";
    assert!(!result.err.contains(elsewhere), "{}", result.err);
    fs::create_dir(folder.join("out")).expect("made");
    let nothing = verify(folder);
    assert_eq!(nothing.status, 2, "the folder is empty");
    assert!(!nothing.err.contains("but the plan writes to"), "{}", nothing.err);
    fs::remove_file(folder.join("elsewhere/dam.2.glb")).expect("removed");
    let result = meniscus(folder, &["verify", "elsewhere", "--plan=plan.json"]);
    assert_eq!(result.status, 1, "{}", result.err);
    assert!(result.err.contains(elsewhere), "{}", result.err);
    #[cfg(unix)]
    {
        // The link leads to the output folder of the plan.
        std::os::unix::fs::symlink("out", folder.join("link")).expect("linked");
        let result = meniscus(folder, &["verify", "link", "--plan=plan.json"]);
        assert_eq!(result.status, 2, "{}", result.err);
        assert!(!result.err.contains("but the plan writes to"), "{}", result.err);
    }
    assert_eq!(meniscus(folder, &["verify", "nowhere", "--plan=plan.json"]).status, 2);
}

/// Edits of a valid plan, by JSON pointer, and the expected messages.
fn edits() -> Vec<(&'static str, Value, &'static str)> {
    vec![
        ("/meniscus_plan", json!(2), "/meniscus_plan: plan version 2 is not supported"),
        ("/meniscus_plan", json!("1"), "expected a whole number from 0, but found string \"1\""),
        ("/generator", json!("meniscus 0.0.1"), "/generator: the plan was made by `meniscus 0.0.1`"),
        ("/out", json!("out"), "/out: `out` is not an absolute path"),
        ("/out", Value::Null, "expected a string, but found null"),
        ("/out", json!(1), ": expected a string, but found integer `1`"),
        ("/outputs/formats", json!(["glb", "exe"]), "unknown format `exe`"),
        ("/outputs/formats", json!([]), "/outputs/formats: must not be empty"),
        ("/outputs/up", json!("x"), "unknown value `x`"),
        ("/outputs/picture_size", json!([1, 99999999]), "/outputs/picture_size: each must be 16 to 8192"),
        ("/sequences", json!([]), "/sequences: must not be empty"),
        (
            "/sequences/0/settings/voxel_size",
            json!("wide"),
            "/sequences/0/settings/voxel_size: invalid value `wide`",
        ),
        ("/sequences/0/settings/voxel_size", json!("-1"), "/sequences/0/settings: the voxel size is -1"),
        ("/sequences/0/settings/steps", json!("1e99"), "/sequences/0/settings/steps: invalid value `1e99`"),
        ("/sequences/0/settings", json!({"drop_size": "1"}), "/0/settings/drop_size: unknown setting"),
        ("/sequences/0/settings/step_size", json!("-1"), "/sequences/0/settings: step_size is -1"),
        ("/sequences/0/settings", json!({}), "/sequences/0/settings: the particle spacing is unknown"),
        ("/sequences/0/camera", json!("auto"), "/sequences/0/camera: not allowed, because no format"),
        ("/shards", json!([]), "/shards: there are 0"),
        ("/shards/1/first", json!(0), "/shards/1: "),
        ("/shards/1/count", json!(u64::MAX), "/shards/1: "),
        ("/shards/1/count", json!(0), "/shards: the shards cover only 2 of the 4 frames"),
        ("/shards/1/count", json!(-1), "expected a whole number from 0, but found integer `-1`"),
        ("/frames", json!([]), "`first` + `count` at most 0, the number of frames"),
        ("/frames/0/stem", json!("../dam"), "/frames/0/stem: `../dam` is not a plain file name"),
        ("/frames/0/stem", json!("/tmp/dam"), "/frames/0/stem: `/tmp/dam` is not a plain file name"),
        ("/frames/1/stem", json!("dam.1"), "/frames/1/stem: `dam.1` is already the stem of frame 0"),
        ("/frames/1/sequence", json!(7), "/frames/1/sequence: there is no sequence 7"),
        ("/frames/1/input", json!("in/dam.2.ply"), "/frames/1/input: `in/dam.2.ply` is not an absolute path"),
        (
            "/frames/1/size_bytes",
            json!(1.5),
            "expected a whole number from 0, but found floating point `1.5`",
        ),
    ]
}

#[test]
fn edited_plan_is_refused() {
    let folder = planned(4, 2);
    let folder = folder.path();
    let text = fs::read_to_string(folder.join("plan.json")).expect("there");
    let refused = |text: &[u8], why: &str| {
        fs::write(folder.join("plan.json"), text).expect("written");
        for result in [shard(folder, 0), verify_anywhere(folder)] {
            assert_eq!(result.status, 2, "{why}: {}", result.out);
            assert!(
                result.err.starts_with("error: plan.json: ") && result.err.contains(why),
                "{why}: {}",
                result.err
            );
        }
    };
    for (pointer, value, why) in edits() {
        let mut plan: Value = serde_json::from_str(&text).expect("JSON");
        *plan.pointer_mut(pointer).expect(pointer) = value;
        refused(&serde_json::to_vec_pretty(&plan).expect("JSON"), why);
    }
    let mut plan: Value = serde_json::from_str(&text).expect("JSON");
    plan["voxel_size"] = json!("1");
    refused(&serde_json::to_vec(&plan).expect("JSON"), "unknown key `voxel_size`");
    let mut plan: Value = serde_json::from_str(&text).expect("JSON");
    plan["sequences"][0]["settings"]["cg_tolerance"] = json!("0.1");
    refused(&serde_json::to_vec(&plan).expect("JSON"), "/sequences/0/settings/cg_tolerance: not allowed");
    for end in [1, text.len() / 2, text.len() - 3] {
        refused(&text.as_bytes()[..end], "the file ends before the plan does");
    }
    for other in [&b""[..], b"[]", b"ply\nformat ascii 1.0\n"] {
        refused(other, "this is not a meniscus plan");
    }
    refused(b"{}", "/meniscus_plan: missing");
    refused(&[br#"{"a":"#.to_vec(), b"[".repeat(100_000)].concat(), "line 1");
    assert!(names_in(&folder.join("out")).is_empty(), "nothing is written");
    // The original plan is valid, and a missing input makes only its own frame fail.
    fs::write(folder.join("plan.json"), &text).expect("written");
    fs::remove_file(folder.join("in/dam.1.ply")).expect("there");
    let result = shard(folder, 0);
    assert_eq!(result.status, 1);
    assert!(result.err.contains("in/dam.1.ply: "), "{}", result.err);
    assert_eq!(meniscus(folder, &["convert", "--plan=none.json", "--shard=0"]).status, 2);
    assert_eq!(meniscus(folder, &["convert", "--plan=in", "--shard=0"]).status, 2);
}

fn verify_anywhere(folder: &Path) -> RunResult {
    meniscus(folder, &["verify", ".", "--plan", "plan.json"])
}

#[test]
fn invalid_arguments_of_plan_are_refused() {
    let folder = planned(2, 1);
    let folder = folder.path();
    let refused = |arguments: &[&str], why: &str| {
        let result = meniscus(folder, &[&["plan", "-o", "other.json"][..], arguments].concat());
        assert_eq!(result.status, 2, "{arguments:?}");
        assert!(result.err.contains(why), "{}", result.err);
        assert!(!folder.join("other.json").exists());
    };
    refused(&["in", "--out=out", "--shards=0"], "1 to 100000");
    refused(&["in", "--out=out", "--shards=100001"], "1 to 100000");
    refused(&["nowhere", "--out=out", "--shards=2"], "no such file or folder");
    refused(&["in", "--out=in", "--shards=2", "--format=ply"], "would replace the input");
    refused(&["in", "--out=out", "--shards=2", "--obstacle=none.obj"], "obstacle not found");
    refused(&["in", "--out=out", "--shards=2", "--steps=-1"], "--steps");
    fs::write(folder.join("in/dam.1.ply"), "ply\nformat nonsense 1.0\n").expect("written");
    fs::write(folder.join("in/dam.2.ply"), "ply\nformat nonsense 1.0\n").expect("written");
    refused(&["in", "--out=out", "--shards=2"], "dam.{}.ply: ");
}
