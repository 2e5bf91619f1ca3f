//! A running daemon and its log; small frames, and frames that appear complete.

use std::collections::BTreeSet;
use std::env;
use std::fmt::Debug;
use std::fs;
use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, unbounded};
use serde_json::Value;
use tempfile::TempDir;

/// Time limit of a wait: an event that has not happened by then will not happen.
const TIMEOUT: Duration = Duration::from_secs(300);

/// Whether the tests use the full number of frames.
pub(crate) fn is_long() -> bool {
    env::var_os("MENISCUS_LONG").is_some_and(|value| value == "1")
}

/// Prints a line also if the test passes, which the usual macros do not.
pub(crate) fn print_line(text: &str) {
    writeln!(io::stderr(), "{text}").expect("standard error is open");
}

/// A message from a daemon.
enum DaemonOutput {
    Line(Value),
    Notice(String),
    /// Its log has ended, and so has the process.
    End,
}

/// A running daemon.
pub(crate) struct Daemon {
    child: Child,
    output: Receiver<DaemonOutput>,
    /// The log so far, one value per line.
    pub(crate) log: Vec<Value>,
    /// The messages to the service manager so far.
    pub(crate) notices: Vec<String>,
    socket_folder: TempDir,
    has_ended: bool,
}

impl Daemon {
    /// Starts `meniscus watch` in `folder`, and does not wait.
    pub(crate) fn start(folder: &Path, arguments: &[&str]) -> Daemon {
        let socket_folder = tempfile::tempdir().expect("a folder");
        let socket_path = socket_folder.path().join("notify");
        let socket = UnixDatagram::bind(&socket_path).expect("a socket");
        let mut child = meniscus(folder)
            .arg("watch")
            .args(arguments)
            .args(["--log", "json"])
            .env("NOTIFY_SOCKET", &socket_path)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the daemon starts");
        let (sender, output) = unbounded();
        let log = child.stderr.take().expect("a pipe");
        thread::spawn({
            let sender = sender.clone();
            move || read_log(BufReader::new(log), &sender)
        });
        thread::spawn(move || read_notices(&socket, &sender));
        Daemon { child, output, log: Vec::new(), notices: Vec::new(), socket_folder, has_ended: false }
    }

    /// Starts `meniscus watch`, and waits until the first scan is finished.
    pub(crate) fn start_ready(folder: &Path, arguments: &[&str]) -> Daemon {
        let mut daemon = Daemon::start(folder, arguments);
        daemon.until("it is ready", Daemon::is_ready);
        daemon
    }

    pub(crate) fn is_ready(&self) -> bool {
        self.notices.iter().any(|notice| notice.contains("READY=1"))
    }

    /// Reads messages until this holds.
    pub(crate) fn until(&mut self, what: &str, is_so: impl Fn(&Daemon) -> bool) {
        let deadline = Instant::now() + TIMEOUT;
        while !is_so(self) {
            if self.has_ended || !self.receive_until(deadline) {
                panic!("waited for this in vain: {what}\n{}", self.everything());
            }
        }
    }

    /// Reads messages until all these frames are converted.
    pub(crate) fn until_converted(&mut self, names: &[String]) {
        for name in names {
            self.until(&format!("{name} is converted"), |daemon| daemon.converted().contains(name));
        }
    }

    /// Reads messages for this time.
    pub(crate) fn listen_for(&mut self, time: Duration) {
        let deadline = Instant::now() + time;
        while self.receive_until(deadline) {}
        assert!(!self.has_ended, "it ended:\n{}", self.everything());
    }

    /// Reads one more message, unless the time is over or the daemon has ended.
    fn receive_until(&mut self, deadline: Instant) -> bool {
        match self.output.recv_deadline(deadline) {
            Ok(DaemonOutput::Line(line)) => self.log.push(line),
            Ok(DaemonOutput::Notice(notice)) => self.notices.push(notice),
            Ok(DaemonOutput::End) => self.has_ended = true,
            Err(_) => return false,
        }
        true
    }

    /// The number of lines of the log whose message contains this.
    pub(crate) fn count_logged(&self, text: &str) -> usize {
        self.log.iter().filter(|line| message(line).contains(text)).count()
    }

    /// The names of the converted frames in order, repeated for repeated conversions.
    pub(crate) fn converted(&self) -> Vec<String> {
        self.log.iter().filter(|line| message(line) == "converted").map(frame_name).collect()
    }

    /// Whether the last status message to the service manager contains this text.
    pub(crate) fn has_status(&self, text: &str) -> bool {
        let mut statuses = self.notices.iter().filter(|notice| notice.contains("STATUS="));
        statuses.next_back().is_some_and(|status| status.contains(text))
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Ends the daemon, and asserts success and a log without errors.
    pub(crate) fn stop(mut self) {
        self.end();
        assert!(!self.log.iter().any(|line| line["level"] == "ERROR"), "{}", self.everything());
    }

    /// Ends the daemon, and asserts that it ends normally; frames may have failed.
    pub(crate) fn end(&mut self) {
        self.signal("TERM");
        self.until("it ends", |daemon| daemon.has_ended);
        let status = self.child.wait().expect("it ended");
        assert!(status.success(), "{status}:\n{}", self.everything());
    }

    /// Sends the daemon a signal of this name.
    pub(crate) fn signal(&self, name: &str) {
        let sent =
            Command::new("kill").args(["-s", name, &self.pid().to_string()]).status().expect("kill runs");
        assert!(sent.success(), "the daemon was running");
    }

    /// Kills the daemon, whatever it does at that moment.
    pub(crate) fn kill(&mut self) {
        self.child.kill().expect("killed");
        self.child.wait().expect("it ended");
    }

    /// Waits until the daemon ends on its own with all frames converted, as long as it sends messages.
    pub(crate) fn until_drained(&mut self) {
        while !self.has_ended {
            let output = self.receive_until(Instant::now() + TIMEOUT);
            assert!(output, "it says nothing more, and does not end\n{}", self.everything());
        }
        let status = self.child.wait().expect("it ended");
        assert!(status.success(), "{status}:\n{}", self.everything());
    }

    fn everything(&self) -> String {
        let log: String = self.log.iter().map(|line| format!("{line}\n")).collect();
        format!("log:\n{log}notices: {:#?}", self.notices)
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // Both fail if the process has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
        let socket = UnixDatagram::unbound().expect("a socket");
        // The other side may be closed already.
        let _ = socket.send_to(LAST_NOTICE, self.socket_folder.path().join("notify"));
    }
}

/// A message that no daemon sends: it ends the thread that listens.
const LAST_NOTICE: &[u8] = b"END";

fn read_log(log: impl BufRead, sender: &Sender<DaemonOutput>) {
    for line in log.lines().map_while(Result::ok) {
        // Lines that are not JSON come from before the log starts, or from a panic: the test prints them.
        let line = serde_json::from_str(&line).unwrap_or(Value::String(line));
        // The receiver is closed when the test is over.
        let _ = sender.send(DaemonOutput::Line(line));
    }
    let _ = sender.send(DaemonOutput::End);
}

fn read_notices(socket: &UnixDatagram, sender: &Sender<DaemonOutput>) {
    let mut bytes = [0; 4096];
    while let Ok(count) = socket.recv(&mut bytes) {
        let text = String::from_utf8_lossy(&bytes[..count]).into_owned();
        if bytes[..count] == *LAST_NOTICE || sender.send(DaemonOutput::Notice(text)).is_err() {
            return;
        }
    }
}

/// The message of a line of the log.
pub(crate) fn message(line: &Value) -> &str {
    line["message"].as_str().unwrap_or_default()
}

/// The name of the frame that a line of the log is about.
pub(crate) fn frame_name(line: &Value) -> String {
    let path = Path::new(line["frame"].as_str().unwrap_or_default());
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The seconds that a frame took in all stages, from a line of the log.
pub(crate) fn stage_seconds(line: &Value) -> f64 {
    let stages = ["read_s", "rasterize_s", "smooth_s", "contour_s", "write_s"];
    stages.iter().map(|stage| line[stage].as_f64().expect("seconds")).sum()
}

/// The command, set up to run in this folder.
pub(crate) fn meniscus(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_meniscus"));
    command.current_dir(folder).env_remove("NOTIFY_SOCKET");
    command
}

/// The output of `meniscus status` for the folder `out`.
pub(crate) fn status(folder: &Path) -> Value {
    let output = meniscus(folder).args(["status", "--out", "out", "--json"]).output().expect("it starts");
    serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|_| panic!("no JSON: {}", String::from_utf8_lossy(&output.stderr)))
}

/// Waits until `read` returns `expected` for the output of `meniscus status`. It may not do so at once,
/// because the command reads the records, and the daemon writes some of them a moment after the log.
pub(crate) fn assert_status<T: PartialEq + Debug>(folder: &Path, expected: &T, read: impl Fn(&Value) -> T) {
    let deadline = Instant::now() + Duration::from_secs(10);
    let mut found = read(&status(folder));
    while found != *expected && Instant::now() < deadline {
        thread::sleep(Duration::from_millis(50));
        found = read(&status(folder));
    }
    assert_eq!(found, *expected);
}

/// Asserts the state of the daemon according to `meniscus status`.
pub(crate) fn assert_state(folder: &Path, expected: &str) {
    assert_status(folder, &Some(expected.to_owned()), |status| {
        status["daemon"]["state"].as_str().map(str::to_owned)
    });
}

/// Asserts the numbers of done, queued, retried and failed frames according to `meniscus status`.
pub(crate) fn assert_counts(folder: &Path, expected: [u64; 4]) {
    assert_status(folder, &expected, |status| {
        ["done", "queued", "retrying", "failed"]
            .map(|count| status["counts"][count].as_u64().expect("a count"))
    });
}

/// Converts `in` into `folder`/`to` by the one-shot command.
pub(crate) fn convert(folder: &Path, to: &str, arguments: &[&str]) {
    let output =
        meniscus(folder).args(["convert", "in", "--out", to]).args(arguments).output().expect("it starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Asserts that two folders of outputs have the same files with the same bytes.
pub(crate) fn assert_same_outputs(left: &Path, right: &Path) {
    assert_eq!(names_in(left), names_in(right));
    for name in names_in(left) {
        assert_same_output(&left.join(&name), &right.join(&name));
    }
}

/// Asserts that two files are the same to the last byte.
pub(crate) fn assert_same_output(left: &Path, right: &Path) {
    let [left_bytes, right_bytes] = [left, right].map(|path| fs::read(path).expect("readable"));
    assert!(left_bytes == right_bytes, "{} is not {}", left.display(), right.display());
}

/// The names in a folder, without the daemon's own state.
pub(crate) fn names_in(folder: &Path) -> BTreeSet<String> {
    let entries = fs::read_dir(folder).expect("the folder exists");
    let names = entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned());
    names.filter(|name| name != ".meniscus").collect()
}

/// The size of the files of records in the folder `out`.
pub(crate) fn records_bytes(folder: &Path) -> u64 {
    let files = fs::read_dir(folder.join("out/.meniscus")).into_iter().flatten();
    files.filter_map(|file| file.ok()?.metadata().ok()).map(|file| file.len()).sum()
}

/// The names of frames `first..=last` of a sequence.
pub(crate) fn frame_names(first: usize, last: usize) -> Vec<String> {
    (first..=last).map(|number| format!("dam.{number}.ply")).collect()
}

/// Writes frames `first..=last` of a moving block of `edge_count`³ particles as `dam.N.ply`, each by a
/// rename.
pub(crate) fn land_sequence(folder: &Path, first: usize, last: usize, edge_count: usize) {
    for (name, number) in frame_names(first, last).iter().zip(first..) {
        land(folder, name, &block_ply(edge_count, 0.025 * number as f32));
    }
}

/// Puts a file into a folder by a rename.
pub(crate) fn land(folder: &Path, name: &str, bytes: &[u8]) {
    let part = folder.join(format!(".{name}.part"));
    fs::write(&part, bytes).expect("written");
    fs::rename(&part, folder.join(name)).expect("renamed");
}

/// A block of `edge_count`³ particles, 0.1 apart, moved along x, as binary PLY.
pub(crate) fn block_ply(edge_count: usize, shift: f32) -> Vec<u8> {
    box_ply([edge_count; 3], shift)
}

/// A box of particles with a different number along each axis, 0.1 apart, moved along x, as binary PLY.
pub(crate) fn box_ply([x_count, y_count, z_count]: [usize; 3], shift: f32) -> Vec<u8> {
    let count = x_count * y_count * z_count;
    let header = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n\
         property float x\nproperty float y\nproperty float z\nend_header\n"
    );
    let mut bytes = header.into_bytes();
    for index in 0..count {
        let [x, y, z] = [index % x_count, index / x_count % y_count, index / (x_count * y_count)];
        for (along, shift) in [(x, shift), (y, 0.0), (z, 0.0)] {
            bytes.extend((along as f32 * 0.1 + shift).to_le_bytes());
        }
    }
    bytes
}

/// A value from /proc/PID/status, in bytes.
pub(crate) fn memory_bytes(pid: u32, figure: &str) -> u64 {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).expect("the process runs");
    let line = status.lines().find_map(|line| line.strip_prefix(figure)).expect("the file has the figure");
    let kibibytes = line.trim_start_matches(':').trim().trim_end_matches("kB").trim();
    kibibytes.parse::<u64>().expect("a number") * 1024
}
