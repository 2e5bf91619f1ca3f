//! Shards of a conversion, and their verification: the same bytes as one process, also after kills,
//! repetitions and damage.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::{TempDir, tempdir};

use crate::program::scene::{RunResult, block, command, meniscus, names_in, write_ply, write_sequence};

fn shard(folder: &Path, shard: &str) -> RunResult {
    meniscus(folder, &["convert", "in", "--out", "out", "--shard", shard])
}

fn verify(folder: &Path) -> RunResult {
    meniscus(folder, &["verify", "out", "--input", "in"])
}

fn succeeded(result: &RunResult) {
    assert_eq!(result.status, 0, "{}{}", result.out, result.err);
}

/// A folder with `in/dam.1.ply` to `in/dam.N.ply`, and an empty folder `out`.
fn prepared(frame_count: usize) -> TempDir {
    let folder = tempdir().expect("a folder");
    for name in ["in", "out"] {
        fs::create_dir(folder.path().join(name)).expect("made");
    }
    write_sequence(&folder.path().join("in"), 1, frame_count);
    folder
}

/// The names and bytes of the outputs in a folder.
fn outputs(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let names = names_in(folder).into_iter().filter(|name| !name.starts_with('.'));
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
    names_in(folder).into_iter().filter(|name| !name.starts_with('.')).map(identity).collect()
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
    fs::create_dir(folder.join("out")).expect("made");
    // The last shard first, with different numbers of threads, and one shard twice at the same time.
    let mut running: Vec<_> = [("3/3", "1"), ("2/3", "3"), ("2/3", "2"), ("1/3", "2")]
        .into_iter()
        .map(|(shard, threads)| {
            let arguments = ["convert", "--out=out", "--shard", shard, "--threads", threads];
            command(folder, &[&arguments[..], &options].concat())
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
    let verified = meniscus(folder, &["verify", "out", "--input", "in/*/*.ply"]);
    succeeded(&verified);
    assert!(verified.out.starts_with("8 frames: 8 done, in "), "{}", verified.out);
    // A plain conversion counts as well, and a changed obstacle makes frames stale.
    let again = |out| meniscus(folder, &[&["convert", "--skip-done", "--out", out][..], &options].concat());
    for out in ["one", "out"] {
        assert_eq!(again(out).out.matches("done already").count(), 8);
    }
    fs::copy(folder.join("body.1.obj"), folder.join("body.3.obj")).expect("changed");
    assert_eq!(again("out").out.matches("done already").count(), 6);
}

/// If the output folder is not mounted, a shard does not create it on another disk.
#[test]
fn shard_does_not_create_the_output_folder() {
    let folder = prepared(2);
    let folder = folder.path();
    fs::remove_dir(folder.join("out")).expect("removed");
    let result = shard(folder, "1/1");
    assert_eq!(result.status, 75);
    assert!(result.err.contains("is it mounted?"), "{}", result.err);
    assert!(!folder.join("out").exists());
    // Nor does another run help if the frames are not there.
    fs::create_dir(folder.join("out")).expect("made");
    fs::create_dir(folder.join("empty")).expect("made");
    for (input, status) in [("gone/*.ply", 75), ("gone", 75), ("empty", 75), ("in/gone.ply", 2)] {
        let result = meniscus(folder, &["convert", input, "--out", "out", "--shard", "1/1"]);
        assert_eq!(result.status, status, "{}", result.err);
    }
}

#[test]
fn report_does_not_replace_an_input_or_a_result() {
    let folder = prepared(2);
    let folder = folder.path();
    succeeded(&shard(folder, "1/1"));
    for path in ["in/dam.2.ply", "out/dam.1.glb", "out/../out/dam.2.vdb"] {
        let before = fs::read(folder.join(path)).expect("there");
        let result = meniscus(folder, &["verify", "out", "--report", path]);
        assert_eq!(result.status, 2, "{path}");
        assert!(result.err.contains("would replace an input or a result"), "{}", result.err);
        assert!(fs::read(folder.join(path)).expect("there") == before, "{path}");
    }
}

#[test]
fn failed_shard_repeats_no_finished_frame() {
    let folder = prepared(5);
    let folder = folder.path();
    let broken = folder.join("in/dam.2.ply");
    let sound = fs::read(&broken).expect("readable");
    fs::write(&broken, "ply\nformat nonsense 1.0\n").expect("written");
    assert_eq!(shard(folder, "1/2").status, 1);
    succeeded(&shard(folder, "2/2"));
    let verified = verify(folder);
    assert_eq!(verified.status, 1);
    assert!(verified.out.contains("5 frames: 4 done, 1 missing, in "), "{}", verified.out);
    assert!(verified.err.starts_with("dam.2: missing: it failed: in/dam.2.ply: "), "{}", verified.err);

    fs::write(&broken, sound).expect("written");
    #[cfg(unix)]
    let before = identities(&folder.join("out"));
    let result = shard(folder, "1/2");
    succeeded(&result);
    assert_eq!(result.out.matches("done already").count(), 2, "{}", result.out);
    #[cfg(unix)]
    {
        let after = identities(&folder.join("out"));
        assert!(before.iter().all(|file| after.contains(file)), "{before:?} {after:?}");
        assert_eq!(after.len(), before.len() + 2);
    }
    succeeded(&verify(folder));
}

#[test]
fn killed_shard_continues_with_the_unfinished_frames() {
    let folder = prepared(24);
    let folder = folder.path();
    let arguments = ["convert", "in", "--out", "out", "--shard", "1/1", "--threads", "1"];
    let mut process = command(folder, &arguments).stdout(Stdio::null()).spawn().expect("the command starts");
    let done = || meniscus::pipeline::FrameRecords::open(&folder.join("out")).expect("readable").done().len();
    let deadline = Instant::now() + Duration::from_secs(300);
    while done() < 2 {
        assert!(Instant::now() < deadline, "no frame was converted");
        std::thread::sleep(Duration::from_millis(2));
    }
    process.kill().expect("it runs");
    process.wait().expect("it ends");
    let done_count = done();
    let result = shard(folder, "1/1");
    succeeded(&result);
    assert_eq!(result.out.matches("done already").count(), done_count, "{}", result.out);
    succeeded(&verify(folder));
    succeeded(&meniscus(folder, &["convert", "in", "--out", "one"]));
    assert!(outputs(&folder.join("out")) == outputs(&folder.join("one")));
    assert!(names_in(&folder.join("out")).iter().all(|name| !name.contains(".tmp-")));
}

/// A missing input may have been removed on purpose, so `verify` accepts the outputs. If an input exists but
/// cannot be read, the outputs cannot be compared with it.
#[cfg(unix)]
#[test]
fn verify_fails_for_an_input_that_exists_and_cannot_be_read() {
    let folder = prepared(2);
    let folder = folder.path();
    succeeded(&shard(folder, "1/1"));
    fs::remove_file(folder.join("in/dam.1.ply")).expect("removed");
    let verified = meniscus(folder, &["verify", "out"]);
    succeeded(&verified);
    assert!(verified.err.contains("1 frame with a missing input"), "{}", verified.err);
    fs::remove_file(folder.join("in/dam.2.ply")).expect("removed");
    // A link that leads to itself: not even root can read it.
    std::os::unix::fs::symlink("dam.2.ply", folder.join("in/dam.2.ply")).expect("linked");
    let verified = meniscus(folder, &["verify", "out"]);
    assert_eq!(verified.status, 1, "{}{}", verified.out, verified.err);
    assert!(verified.err.contains("cannot be compared with their input"), "{}", verified.err);
}

#[test]
fn shards_without_frames_succeed() {
    let folder = prepared(2);
    let folder = folder.path();
    for number in 1..=5 {
        let result = shard(folder, &format!("{number}/5"));
        succeeded(&result);
        let count = if number <= 2 { "1 frame" } else { "0 frames" };
        assert!(result.out.starts_with(&format!("shard {number}/5: {count} of 2\n")), "{}", result.out);
    }
    succeeded(&verify(folder));
}

#[test]
fn invalid_shards_are_refused() {
    let folder = prepared(2);
    for text in ["0/2", "3/2", "1", "/2", "1/", "1/2/3", "a/b", "1/99999999999999999999999"] {
        let result = shard(folder.path(), text);
        assert!(
            result.status == 2 && result.err.contains("K/N, with K from 1 to N"),
            "{text}: {}",
            result.err
        );
    }
    for (more, why) in [
        (&["--out=a.glb", "--shard=1/1"][..], "name a folder with --out"),
        (&["--out=out", "--shard=1/1", "--sequence=s.glb"], "meniscus sequence"),
    ] {
        let result = meniscus(folder.path(), &[&["convert", "in/dam.1.ply"], more].concat());
        assert!(result.status == 2 && result.err.contains(why), "{}", result.err);
    }
    assert!(names_in(&folder.path().join("out")).is_empty());
}

/// Slurm sets the number of the shard; if it does not, the error says so.
#[test]
fn slurm_task_id_selects_the_shard() {
    let folder = prepared(2);
    let folder = folder.path();
    let run = |task: Option<&str>| {
        let mut command = command(folder, &["convert", "in", "--out", "out", "--shard", "slurm"]);
        command.env("SLURM_ARRAY_TASK_MIN", "5").env("SLURM_ARRAY_TASK_MAX", "8");
        command.env("SLURM_ARRAY_TASK_STEP", "3");
        match task {
            Some(task) => command.env("SLURM_ARRAY_TASK_ID", task),
            None => command.env_remove("SLURM_ARRAY_TASK_ID"),
        };
        let output = command.output().expect("the command starts");
        (output.status.code(), String::from_utf8(output.stderr).expect("text"))
    };
    assert_eq!(run(Some("8")), (Some(0), String::new()));
    assert!(outputs(&folder.join("out")).iter().all(|(name, _)| name.starts_with("dam.2.")));
    for (task, why) in [
        (None, "SLURM_ARRAY_TASK_ID is not set"),
        (Some("9"), "task 9 is not in the array 5-8:3"),
        (Some("6"), "task 6 is not in the array 5-8:3"),
        (Some("-1"), "SLURM_ARRAY_TASK_ID is `-1`"),
        (Some(""), "SLURM_ARRAY_TASK_ID is ``"),
    ] {
        let (status, message) = run(task);
        assert!(status == Some(2) && message.contains(why), "{task:?}: {message}");
    }
}

/// The shards of the missing tasks would never be converted.
#[test]
fn job_array_with_gaps_is_refused() {
    let folder = prepared(2);
    let run = |[id, min, max, count]: [&str; 4]| {
        let mut command = command(folder.path(), &["convert", "in", "--out", "out", "--shard", "slurm"]);
        let values = [("ID", id), ("MIN", min), ("MAX", max), ("COUNT", count)];
        command.envs(values.map(|(name, value)| (format!("SLURM_ARRAY_TASK_{name}"), value)));
        let output = command.output().expect("the command starts");
        (output.status.code(), String::from_utf8(output.stderr).expect("text"))
    };
    let (status, message) = run(["2", "1", "7", "3"]);
    assert!(status == Some(2) && message.contains("the array 1-7:1 has gaps"), "{message}");
    let (status, message) = run(["0", "0", "18446744073709551615", "1"]);
    assert!(status == Some(2) && message.contains("the array is too large"), "{message}");
    assert_eq!(run(["2", "1", "2", "2"]), (Some(0), String::new()));
}

/// A state, the damage to the results of a frame that causes it, and the expected message.
type Case = (&'static str, fn(&Path), &'static str);

fn edit(path: PathBuf, change: impl FnOnce(&mut Vec<u8>)) {
    let mut bytes = fs::read(&path).expect("readable");
    change(&mut bytes);
    fs::write(path, bytes).expect("written");
}

const CASES: [Case; 7] = [
    ("missing", |f| fs::remove_file(f.join("out/dam.1.vdb")).expect("there"), "dam.1.vdb"),
    ("missing", |f| fs::remove_dir_all(f.join("out/.meniscus")).expect("there"), "there is no record of it"),
    (
        "damaged",
        |f| edit(f.join("out/dam.1.glb"), |bytes| bytes.truncate(bytes.len() - 9)),
        "dam.1.glb was changed or replaced: it has ",
    ),
    (
        "damaged",
        |f| edit(f.join("out/dam.1.vdb"), |bytes| *bytes.last_mut().expect("bytes") ^= 1),
        "dam.1.vdb was changed or replaced: it has other bytes than were written",
    ),
    ("damaged", |f| edit(f.join("out/dam.1.glb"), Vec::clear), "dam.1.glb was changed or replaced"),
    (
        "stale",
        |f| write_ply(&f.join("in/dam.1.ply"), &block(5, 0.0)),
        "the input has changed since it was made",
    ),
    // The settings of the sequence are those of most frames.
    (
        "stale",
        |f| {
            let other = ["convert", "in", "--frames=1", "--out=out", "--steps=3"];
            succeeded(&meniscus(f, &other));
        },
        "made with steps 3",
    ),
];

/// `convert` leaves out an input whose results would have the names of those of another.
#[test]
fn input_with_the_name_of_another_is_missing() {
    let folder = prepared(2);
    let folder = folder.path();
    fs::write(folder.join("in/dam.2.csv"), "x,y,z\n0,0,0\n0.1,0,0\n0,0.1,0\n").expect("written");
    assert_eq!(meniscus(folder, &["convert", "in", "--out", "out"]).status, 1);
    let result = verify(folder);
    assert_eq!(result.status, 1, "{}{}", result.out, result.err);
    assert!(result.err.contains("dam.2.") && result.err.contains(": missing: "), "{}", result.err);
    assert!(result.out.starts_with("3 frames: 2 done, 1 missing"), "{}", result.out);
}

#[test]
fn verify_reports_every_kind_of_damage() {
    for (state, meddle, why) in CASES {
        let folder = prepared(2);
        let folder = folder.path();
        succeeded(&shard(folder, "1/2"));
        succeeded(&shard(folder, "2/2"));
        succeeded(&verify(folder));
        meddle(folder);
        let result = meniscus(folder, &["verify", "out", "--input", "in", "--report=v.json"]);
        assert_ne!(result.status, 0, "{state}: {}", result.out);
        assert!(result.err.starts_with(&format!("dam.1: {state}: ")), "{}", result.err);
        assert!(result.err.contains(why), "{}", result.err);
        let report: Value =
            serde_json::from_slice(&fs::read(folder.join("v.json")).expect("there")).expect("JSON");
        assert_eq!(report["frames"][0]["state"], state);
        let summary = &report["summary"];
        assert!(summary[state] != 0 && summary["violations"] == 0, "{summary}");
        // The shards repair it.
        for number in ["1/2", "2/2"] {
            succeeded(&shard(folder, number));
        }
        succeeded(&verify(folder));
    }
}

/// A frame may also be converted for a trial: its other outputs are still checked.
#[test]
fn verify_checks_the_settings_of_most_frames() {
    let folder = prepared(3);
    let folder = folder.path();
    let convert = |options: &[&str]| {
        succeeded(&meniscus(folder, &[&["convert", "in", "--out=out", "--frames=2"], options].concat()));
    };
    succeeded(&shard(folder, "1/1"));
    for trial in [&["--format=obj"][..], &["--format=obj", "--steps=3"], &["--preview=png", "--format=obj"]] {
        convert(trial);
        succeeded(&verify(folder));
    }
    fs::remove_file(folder.join("out/dam.2.glb")).expect("removed");
    let missing = verify(folder);
    assert!(missing.status == 1 && missing.err.contains("dam.2: missing: dam.2.glb"), "{}", missing.err);
    succeeded(&shard(folder, "1/1"));
    convert(&["--format=obj"]);
    fs::write(folder.join("out/dam.2.glb"), "").expect("written");
    let damaged = verify(folder);
    assert!(damaged.status == 1 && damaged.err.contains("dam.2: damaged: dam.2.glb"), "{}", damaged.err);
    succeeded(&shard(folder, "1/1"));
    succeeded(&verify(folder));
    convert(&["--steps=3"]);
    let stale = verify(folder);
    assert!(stale.status == 1 && stale.err.starts_with("dam.2: stale: made with steps 3"), "{}", stale.err);
    // The last complete conversion counts.
    succeeded(&meniscus(folder, &["convert", "in", "--out=out", "--steps=3"]));
    succeeded(&verify(folder));
    // One of the machines lacks an option.
    succeeded(&meniscus(folder, &["convert", "in", "--out=new", "--frames=1-2", "--format=glb"]));
    succeeded(&meniscus(folder, &["convert", "in", "--out=new", "--frames=3", "--format=obj"]));
    let other = meniscus(folder, &["verify", "new"]);
    assert!(other.status == 1 && other.err.contains("dam.3: stale: made with formats obj"), "{}", other.err);
}

#[test]
fn results_are_verified_in_another_folder() {
    let folder = prepared(2);
    let folder = folder.path();
    succeeded(&shard(folder, "1/1"));
    fs::rename(folder.join("out"), folder.join("elsewhere")).expect("renamed");
    fs::rename(folder.join("in"), folder.join("moved")).expect("renamed");
    let result = meniscus(folder, &["verify", "elsewhere"]);
    succeeded(&result);
    assert!(result.err.contains("2 frames with a missing input"), "{}", result.err);
    let result = meniscus(folder, &["verify", "elsewhere", "--input", "moved"]);
    succeeded(&result);
    assert!(!result.err.contains("missing input"), "{}", result.err);
    fs::create_dir(folder.join("out")).expect("made");
    let nothing = meniscus(folder, &["verify", "out"]);
    assert!(nothing.status == 2 && nothing.err.contains("there are no records"), "{}", nothing.err);
    let nothing = meniscus(folder, &["verify", "out", "--input", "moved"]);
    assert!(nothing.status == 2 && nothing.err.contains("dam.1: missing: "), "{}", nothing.err);
    assert_eq!(meniscus(folder, &["verify", "nowhere"]).status, 2);
}
