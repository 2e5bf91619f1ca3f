//! A folder with good frames, and the command in it.

use std::env;
use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use tempfile::TempDir;

/// Whether the files have their full size.
pub(crate) fn is_long() -> bool {
    env::var_os("MENISCUS_LONG").is_some_and(|value| value == "1")
}

/// Prints a line also if the test passes, which the usual macros do not.
pub(crate) fn print_line(text: &str) {
    writeln!(io::stderr(), "{text}").expect("standard error is open");
}

/// Time limit of a command: one that runs longer hangs.
const TIMEOUT: Duration = Duration::from_secs(300);

/// A temporary folder with `in`.
pub(crate) struct Scene(TempDir);

/// The result of a command.
#[derive(Debug)]
pub(crate) struct RunResult {
    pub(crate) status: Option<i32>,
    pub(crate) out: String,
    pub(crate) err: String,
    /// Its peak memory.
    pub(crate) peak_bytes: u64,
    /// The bytes that it read from all files together.
    pub(crate) read_bytes: u64,
}

impl Scene {
    /// Two frames, `dam.1.ply` and `dam.2.ply`.
    pub(crate) fn new() -> Scene {
        let scene = Scene(tempfile::tempdir().expect("a folder"));
        fs::create_dir(scene.path("in")).expect("made");
        for number in 1..=2 {
            scene.write(format!("in/dam.{number}.ply"), block_ply(number as f32));
        }
        scene
    }

    pub(crate) fn path(&self, within: impl AsRef<Path>) -> PathBuf {
        self.0.path().join(within)
    }

    pub(crate) fn write(&self, within: impl AsRef<Path>, bytes: impl AsRef<[u8]>) {
        fs::write(self.path(within), bytes).expect("written");
    }

    /// A sparse file that begins with these bytes and has this length.
    pub(crate) fn write_with_hole(&self, within: &str, start: &[u8], length: u64) {
        let mut file = File::create(self.path(within)).expect("made");
        file.write_all(start).expect("written");
        file.set_len(length).expect("grown");
    }

    /// Runs the command until it ends.
    pub(crate) fn run<S: AsRef<OsStr>>(&self, arguments: &[S]) -> RunResult {
        let mut command = Command::new(env!("CARGO_BIN_EXE_meniscus"));
        command.args(arguments);
        self.run_command(command)
    }

    pub(crate) fn run_command(&self, mut command: Command) -> RunResult {
        let [out, err] = ["out.txt", "err.txt"].map(|name| self.path(name));
        let file = |path| File::create(path).expect("made");
        command.current_dir(self.0.path()).stdin(Stdio::null()).stdout(file(&out)).stderr(file(&err));
        let (status, peak_bytes, read_bytes) = until_it_ends(command.spawn().expect("it starts"));
        let text = |path| String::from_utf8_lossy(&fs::read(path).expect("readable")).into_owned();
        let result = RunResult { status, out: text(out), err: text(err), peak_bytes, read_bytes };
        assert!(!result.err.contains("panicked"), "{}", result.err);
        result
    }

    /// Converts `in` to .obj files in `out`.
    pub(crate) fn convert(&self) -> RunResult {
        self.run(&["convert", "in", "--out", "out", "--voxel-size", "0.1", "--format", "obj"])
    }

    /// Converts the folder with an unreadable file next to the valid frames. Asserts that one frame failed,
    /// that its message contains these words, and that the peak memory is at most this.
    #[track_caller]
    pub(crate) fn assert_costs_itself_alone(&self, name: &str, words: &str, bytes_max: u64) {
        let result = self.convert();
        assert_eq!(result.status, Some(1), "{name}: {}", result.err);
        assert!(result.err.contains(name) && result.err.contains(words), "{name}, {words}: {}", result.err);
        self.assert_good_frames_are_there();
        print_line(&format!("{name}: {} MiB", result.peak_bytes >> 20));
        assert!(result.peak_bytes <= bytes_max, "{name}: {} of {bytes_max} bytes", result.peak_bytes);
    }

    #[track_caller]
    pub(crate) fn assert_good_frames_are_there(&self) {
        for number in 1..=2 {
            assert!(self.path(format!("out/dam.{number}.obj")).is_file(), "frame {number}");
        }
    }
}

/// The exit status, with the peak memory and the bytes read, sampled shortly before the end.
fn until_it_ends(mut child: Child) -> (Option<i32>, u64, u64) {
    let [status, io] = ["status", "io"].map(|file| PathBuf::from(format!("/proc/{}/{file}", child.id())));
    let deadline = Instant::now() + TIMEOUT;
    let (mut peak_bytes, mut read_bytes) = (0, 0);
    loop {
        peak_bytes = peak_bytes.max(peak_of(&status).unwrap_or(0));
        read_bytes = read_bytes.max(read_by(&io).unwrap_or(0));
        if let Some(status) = child.try_wait().expect("it runs") {
            assert_eq!(status.signal(), None, "it was ended");
            return (status.code(), peak_bytes, read_bytes);
        }
        if Instant::now() > deadline {
            child.kill().expect("it runs");
            panic!("it does not end");
        }
        thread::sleep(Duration::from_millis(5));
    }
}

/// The bytes that a process has read, according to the system.
fn read_by(io: &Path) -> Option<u64> {
    let text = fs::read_to_string(io).ok()?;
    text.lines().find_map(|line| line.strip_prefix("rchar:"))?.trim().parse().ok()
}

fn peak_of(status: &Path) -> Option<u64> {
    let text = fs::read_to_string(status).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().trim_end_matches("kB").trim().parse::<u64>().ok()? << 10)
}

/// A block of 6³ particles, 0.1 apart, moved along x, as binary PLY.
pub(crate) fn block_ply(shift: f32) -> Vec<u8> {
    const EDGE: usize = 6;
    let mut bytes = ply_header(EDGE.pow(3) as u64);
    for index in 0..EDGE.pow(3) {
        let [x, y, z] = [index % EDGE, index / EDGE % EDGE, index / EDGE / EDGE].map(|at| at as f32 * 0.1);
        bytes.extend([x + shift, y, z].iter().flat_map(|number| number.to_le_bytes()));
    }
    bytes
}

/// The header for this number of positions.
pub(crate) fn ply_header(count: u64) -> Vec<u8> {
    format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n\
         property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    .into_bytes()
}
