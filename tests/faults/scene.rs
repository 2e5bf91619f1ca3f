//! Frames, their expected outputs, and the program with faults.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::{TempDir, tempdir};

/// The number of frames.
pub(crate) const FRAME_COUNT: usize = 3;

/// The output formats of each frame.
pub(crate) const FORMATS: [&str; 2] = ["obj", "vdb"];

/// Settings with which a frame takes little time.
pub(crate) const CHEAP: [&str; 12] = [
    "--format",
    "obj,vdb",
    "--preset",
    "paper",
    "--voxel-size",
    "0.1",
    "--steps",
    "0",
    "--laplacian-steps",
    "0",
    "--threads",
    "2",
];

/// Time limit of a run: a run that takes longer hangs.
const TIMEOUT: Duration = Duration::from_secs(300);

/// Prints a line, also if the test passes.
pub(crate) fn print_line(text: &str) {
    writeln!(io::stderr(), "{text}").expect("standard error is open");
}

/// Builds the shared library; `None` without a C compiler.
pub(crate) fn build_shim() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("faults");
    fs::create_dir_all(&folder).expect("a folder");
    let shim = folder.join("shim.so");
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/faults/shim.c");
    let arguments = ["-O1", "-Wall", "-Werror", "-shared", "-fPIC", source, "-ldl", "-o"];
    let built = match Command::new("cc").args(arguments).arg(&shim).output() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return None,
        built => built.expect("cc runs"),
    };
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    Some(shim)
}

/// A generator of pseudo-random numbers (SplitMix64), the same in every run.
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % end
    }
}

/// A version of all frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Version {
    Old,
    New,
}

/// A small cube of particles, as binary PLY.
fn frame(version: Version, number: usize) -> Vec<u8> {
    const EDGE: usize = 4;
    let shift = 0.03 * number as f32 + if version == Version::Old { 0.0 } else { 0.5 };
    let header = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\n\
         property float x\nproperty float y\nproperty float z\nend_header\n",
        EDGE.pow(3)
    );
    let mut bytes = header.into_bytes();
    for index in 0..EDGE.pow(3) {
        let [x, y, z] = [index % EDGE, index / EDGE % EDGE, index / EDGE.pow(2)].map(|at| at as f32 * 0.1);
        bytes.extend([x + shift, y, z].iter().flat_map(|value| value.to_le_bytes()));
    }
    bytes
}

pub(crate) fn stem(number: usize) -> String {
    format!("dam.{number}")
}

/// Files by their names.
pub(crate) type Files = BTreeMap<String, Vec<u8>>;

/// The files in a folder, and those in sub-folders as `folder/name`; empty if the folder does not exist.
pub(crate) fn files_in(folder: &Path) -> Files {
    let mut files = Files::new();
    for entry in fs::read_dir(folder).into_iter().flatten().map(|entry| entry.expect("an entry")) {
        let name = entry.file_name().into_string().expect("text");
        if entry.file_type().expect("a type").is_dir() {
            let inside = files_in(&entry.path()).into_iter();
            files.extend(inside.map(|(within, bytes)| (format!("{name}/{within}"), bytes)));
        } else {
            files.insert(name, fs::read(entry.path()).expect("readable"));
        }
    }
    files
}

/// The expected outputs of each version of the frames.
pub(crate) struct References {
    old: Files,
    new: Files,
}

impl References {
    pub(crate) fn new() -> References {
        let of_version = |version: Version| {
            let scene = Scene::new();
            scene.put_frames(version);
            let result = scene.run(&[&CONVERT[..], &CHEAP].concat(), None);
            assert_eq!(result.status.code(), Some(0), "{}", result.err);
            let mut files = files_in(&scene.path("out"));
            files.retain(|name, _| !name.starts_with('.'));
            assert_eq!(files.len(), FRAME_COUNT * FORMATS.len(), "{:?}", files.keys());
            files
        };
        References { old: of_version(Version::Old), new: of_version(Version::New) }
    }

    pub(crate) fn of(&self, version: Version) -> &Files {
        match version {
            Version::Old => &self.old,
            Version::New => &self.new,
        }
    }
}

/// The faults of a run.
#[derive(Clone, Debug)]
pub(crate) struct Faults<'a> {
    pub(crate) shim: &'a Path,
    pub(crate) seed: u64,
    pub(crate) kind: FaultKind,
    /// Excludes errors for which the daemon pauses for seconds.
    pub(crate) no_pause: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FaultKind {
    /// Of 1000 calls, this number fails on average.
    Rate(u64),
    /// Only the call with this number fails.
    Nth(u64),
    /// The program kills itself at the change of the file system with this number.
    Kill(u64),
}

/// The result of a run.
pub(crate) struct RunResult {
    pub(crate) status: ExitStatus,
    pub(crate) out: String,
    pub(crate) err: String,
}

/// The arguments that convert all frames.
pub(crate) const CONVERT: [&str; 4] = ["convert", "in", "--out", "out"];

/// A folder with frames in `in`, and outputs in `out`.
pub(crate) struct Scene {
    folder: TempDir,
}

impl Scene {
    pub(crate) fn new() -> Scene {
        let folder = tempdir().expect("a folder");
        ["in", "out"].iter().for_each(|name| fs::create_dir(folder.path().join(name)).expect("made"));
        Scene { folder }
    }

    pub(crate) fn path(&self, within: &str) -> PathBuf {
        self.folder.path().join(within)
    }

    /// Puts all frames into `in`, each by a rename.
    pub(crate) fn put_frames(&self, version: Version) {
        for number in 1..=FRAME_COUNT {
            let part = self.path("part");
            fs::write(&part, frame(version, number)).expect("written");
            fs::rename(&part, self.path(&format!("in/{}.ply", stem(number)))).expect("renamed");
        }
    }

    /// The numbers of the frames that are done according to their records and the bytes of their files.
    pub(crate) fn done(&self) -> BTreeSet<usize> {
        let report = self.path("verified.json");
        let result = self.run(&["verify", "out", "--report", "verified.json"], None);
        let Ok(bytes) = fs::read(&report) else {
            assert!(result.err.contains("there are no records"), "{}", result.err);
            return BTreeSet::new();
        };
        fs::remove_file(report).expect("removed");
        let report: Value = serde_json::from_slice(&bytes).expect("JSON");
        let is_done = |number: &usize| {
            let mut frames = report["frames"].as_array().expect("frames").iter();
            frames.any(|frame| frame["name"] == *stem(*number) && frame["state"] == "done")
        };
        (1..=FRAME_COUNT).filter(is_done).collect()
    }

    /// The faults so far, one per line.
    pub(crate) fn fault_log(&self) -> String {
        fs::read_to_string(self.log_path()).unwrap_or_default()
    }

    /// The path of the log: outside the folder of the scene, so that the faults do not affect it.
    fn log_path(&self) -> PathBuf {
        self.folder.path().with_extension("faults")
    }

    /// Runs the program until it ends.
    pub(crate) fn run(&self, arguments: &[&str], faults: Option<&Faults<'_>>) -> RunResult {
        let [out, err] = ["out", "err"].map(|name| self.folder.path().with_extension(name));
        let file = |path: &Path| fs::File::create(path).expect("created");
        let mut command = Command::new(env!("CARGO_BIN_EXE_meniscus"));
        command.args(arguments).current_dir(self.folder.path()).env_remove("NOTIFY_SOCKET");
        command.stdin(Stdio::null()).stdout(file(&out)).stderr(file(&err));
        if let Some(faults) = faults {
            let (name, value) = match faults.kind {
                FaultKind::Rate(rate) => ("FAULTS_RATE", rate),
                FaultKind::Nth(nth) => ("FAULTS_NTH", nth),
                FaultKind::Kill(at) => ("FAULTS_KILL", at),
            };
            command
                .env("LD_PRELOAD", faults.shim)
                .env("FAULTS_UNDER", self.folder.path())
                .env("FAULTS_SEED", faults.seed.to_string())
                .env("FAULTS_LOG", self.log_path())
                .env(name, value.to_string());
            if faults.no_pause {
                command.env("FAULTS_NO_PAUSE", "1");
            }
        }
        let mut child = command.spawn().expect("a start");
        let status = await_end(&mut child);
        let [out, err] = [out, err].map(|path| {
            let text = fs::read_to_string(&path).expect("text");
            fs::remove_file(path).expect("removed");
            text
        });
        let status = status.unwrap_or_else(|| panic!("{arguments:?} does not end:\n{out}\n{err}"));
        assert!(!err.contains("panicked"), "{err}");
        RunResult { status, out, err }
    }
}

impl Drop for Scene {
    fn drop(&mut self) {
        // Without faults, the log does not exist.
        let _ = fs::remove_file(self.log_path());
    }
}

fn await_end(child: &mut Child) -> Option<ExitStatus> {
    let start = Instant::now();
    while start.elapsed() < TIMEOUT {
        if let Some(status) = child.try_wait().expect("a status") {
            return Some(status);
        }
        thread::sleep(Duration::from_millis(2));
    }
    child.kill().expect("killed");
    child.wait().expect("it ends");
    None
}
