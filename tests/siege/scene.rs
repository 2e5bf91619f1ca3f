//! A daemon at work, seen from outside; small frames, and frames that land whole.

use std::collections::BTreeSet;
use std::env;
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

/// What is not heard within this time will not come.
const PATIENCE: Duration = Duration::from_secs(300);

/// Whether the tests have as many frames as were promised.
pub(crate) fn is_long() -> bool {
    env::var_os("MENISCUS_LONG").is_some_and(|value| value == "1")
}

/// Says something even where the test passes, which the macros for it do not.
pub(crate) fn tell(text: &str) {
    writeln!(io::stderr(), "{text}").expect("somebody listens");
}

/// What a daemon says.
enum Heard {
    Line(Value),
    Notice(String),
    /// Its log has ended, and so has it.
    End,
}

/// A daemon at work.
pub(crate) struct Daemon {
    child: Child,
    heard: Receiver<Heard>,
    /// The log until now, a value for each line.
    pub(crate) log: Vec<Value>,
    /// What the service manager was told until now.
    pub(crate) notices: Vec<String>,
    socket_folder: TempDir,
    has_ended: bool,
}

impl Daemon {
    /// Starts `meniscus watch` in `folder`, and does not wait for anything.
    pub(crate) fn start(folder: &Path, arguments: &[&str]) -> Daemon {
        Daemon::start_as(meniscus(folder).arg("watch").args(arguments).args(["--log", "json"]))
    }

    /// The same with a watchdog, which is to hear from it every two seconds.
    pub(crate) fn start_watched(folder: &Path, arguments: &[&str]) -> Daemon {
        Daemon::start_as(meniscus(folder).arg("watch").args(arguments).env("WATCHDOG_USEC", "2000000"))
    }

    fn start_as(command: &mut Command) -> Daemon {
        let socket_folder = tempfile::tempdir().expect("a folder");
        let socket_path = socket_folder.path().join("notify");
        let socket = UnixDatagram::bind(&socket_path).expect("a socket");
        let mut child = command
            .env("NOTIFY_SOCKET", &socket_path)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the daemon starts");
        let (sender, heard) = unbounded();
        let log = child.stderr.take().expect("a pipe");
        thread::spawn({
            let sender = sender.clone();
            move || hear_log(BufReader::new(log), &sender)
        });
        thread::spawn(move || hear_notices(&socket, &sender));
        Daemon { child, heard, log: Vec::new(), notices: Vec::new(), socket_folder, has_ended: false }
    }

    /// The same, until it has looked at everything once.
    pub(crate) fn start_ready(folder: &Path, arguments: &[&str]) -> Daemon {
        let mut daemon = Daemon::start(folder, arguments);
        daemon.until("it is ready", Daemon::is_ready);
        daemon
    }

    pub(crate) fn is_ready(&self) -> bool {
        self.notices.iter().any(|notice| notice.contains("READY=1"))
    }

    /// Listens until this is so.
    pub(crate) fn until(&mut self, what: &str, is_so: impl Fn(&Daemon) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !is_so(self) {
            if self.has_ended || !self.hear_until(deadline) {
                panic!("waited for this in vain: {what}\n{}", self.everything());
            }
        }
    }

    /// Listens until all these frames are converted.
    pub(crate) fn until_converted(&mut self, names: &[String]) {
        for name in names {
            self.until(&format!("{name} is converted"), |daemon| daemon.converted().contains(name));
        }
    }

    /// Listens for so long.
    pub(crate) fn listen_for(&mut self, time: Duration) {
        let deadline = Instant::now() + time;
        while self.hear_until(deadline) {}
        assert!(!self.has_ended, "it ended:\n{}", self.everything());
    }

    /// Hears one thing more, unless it is time or there is no more.
    fn hear_until(&mut self, deadline: Instant) -> bool {
        match self.heard.recv_deadline(deadline) {
            Ok(Heard::Line(line)) => self.log.push(line),
            Ok(Heard::Notice(notice)) => self.notices.push(notice),
            Ok(Heard::End) => self.has_ended = true,
            Err(_) => return false,
        }
        true
    }

    /// How many lines of the log have this in their message.
    pub(crate) fn count_logged(&self, text: &str) -> usize {
        self.log.iter().filter(|line| message(line).contains(text)).count()
    }

    /// The names of the frames that were converted, as often as they were, in that order.
    pub(crate) fn converted(&self) -> Vec<String> {
        self.log.iter().filter(|line| message(line) == "converted").map(frame_name).collect()
    }

    /// Whether the service manager was told this last.
    pub(crate) fn has_status(&self, text: &str) -> bool {
        let mut statuses = self.notices.iter().filter(|notice| notice.contains("STATUS="));
        statuses.next_back().is_some_and(|status| status.contains(text))
    }

    /// How often the watchdog has heard from it.
    pub(crate) fn signs_of_life(&self) -> usize {
        self.notices.iter().filter(|notice| notice.contains("WATCHDOG=1")).count()
    }

    /// Where the status page is, as `host:port`.
    pub(crate) fn window_address(&mut self) -> String {
        self.until("the window is open", |daemon| daemon.count_logged("the window is open") > 0);
        let line = self.log.iter().find(|line| message(line) == "the window is open").expect("logged");
        let address = line["address"].as_str().expect("an address");
        address.trim_start_matches("http://").trim_end_matches('/').to_owned()
    }

    /// Waits until it has ended, in good order or not.
    pub(crate) fn until_ended(&mut self) {
        self.until("it ends", |daemon| daemon.has_ended);
        self.child.wait().expect("it ended");
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Asks it to end, and waits until it has: in good order, and with nothing but information and
    /// warnings in its log.
    pub(crate) fn stop(mut self) {
        self.end();
        assert!(!self.log.iter().any(|line| line["level"] == "ERROR"), "{}", self.everything());
    }

    /// Asks it to end, and waits until it has, in good order; frames may have failed.
    pub(crate) fn end(&mut self) {
        self.signal("TERM");
        self.until("it ends", |daemon| daemon.has_ended);
        let status = self.child.wait().expect("it ended");
        assert!(status.success(), "{status}:\n{}", self.everything());
    }

    /// Sends it a signal of this name.
    pub(crate) fn signal(&self, name: &str) {
        let sent =
            Command::new("kill").args(["-s", name, &self.pid().to_string()]).status().expect("kill runs");
        assert!(sent.success(), "the daemon was there");
    }

    /// Ends it in the midst of whatever it does.
    pub(crate) fn kill(&mut self) {
        self.child.kill().expect("killed");
        self.child.wait().expect("it ended");
    }

    /// Waits until it ends by itself, with everything converted, as long as it has something to say.
    pub(crate) fn until_drained(&mut self) {
        while !self.has_ended {
            let heard = self.hear_until(Instant::now() + PATIENCE);
            assert!(heard, "it says nothing more, and does not end\n{}", self.everything());
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
        // Both fail where it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
        let socket = UnixDatagram::unbound().expect("a socket");
        // Nobody listens where the listener has gone.
        let _ = socket.send_to(LAST_NOTICE, self.socket_folder.path().join("notify"));
    }
}

/// What no daemon says: then nobody need listen any more.
const LAST_NOTICE: &[u8] = b"END";

fn hear_log(log: impl BufRead, sender: &Sender<Heard>) {
    for line in log.lines().map_while(Result::ok) {
        // What is no JSON is told before the log begins, or by a panic: the test will want to see it.
        let line = serde_json::from_str(&line).unwrap_or(Value::String(line));
        // Nobody hears it where the test is over.
        let _ = sender.send(Heard::Line(line));
    }
    let _ = sender.send(Heard::End);
}

fn hear_notices(socket: &UnixDatagram, sender: &Sender<Heard>) {
    let mut bytes = [0; 4096];
    while let Ok(count) = socket.recv(&mut bytes) {
        let text = String::from_utf8_lossy(&bytes[..count]).into_owned();
        if bytes[..count] == *LAST_NOTICE || sender.send(Heard::Notice(text)).is_err() {
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

/// The seconds that a line of the log says its frame took in all stages.
pub(crate) fn stage_seconds(line: &Value) -> f64 {
    let stages = ["read_s", "rasterize_s", "smooth_s", "contour_s", "write_s"];
    stages.iter().map(|stage| line[stage].as_f64().expect("seconds")).sum()
}

/// The command, to be run in this folder.
pub(crate) fn meniscus(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_meniscus"));
    command.current_dir(folder).env_remove("NOTIFY_SOCKET").env_remove("WATCHDOG_USEC");
    command
}

/// What `meniscus status` says of the folder `out`.
pub(crate) fn status(folder: &Path) -> Value {
    let output = meniscus(folder).args(["status", "--out", "out", "--json"]).output().expect("it starts");
    serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|_| panic!("no JSON: {}", String::from_utf8_lossy(&output.stderr)))
}

/// How many frames `meniscus status` says are done, queued, being tried again, and failed.
pub(crate) fn counts(folder: &Path) -> [u64; 4] {
    let status = status(folder);
    ["done", "queued", "retrying", "failed"].map(|count| status["counts"][count].as_u64().expect("a count"))
}

/// Converts `in` into `folder`/`to` by the one-shot command.
pub(crate) fn convert(folder: &Path, to: &str, arguments: &[&str]) {
    let output =
        meniscus(folder).args(["convert", "in", "--out", to]).args(arguments).output().expect("it starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Asserts that two folders of outputs are the same to the last byte, and that nothing else is there.
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
    let entries = fs::read_dir(folder).expect("the folder is there");
    let names = entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned());
    names.filter(|name| name != ".meniscus").collect()
}

/// The names of frames `first..=last` of a sequence.
pub(crate) fn frame_names(first: usize, last: usize) -> Vec<String> {
    (first..=last).map(|number| format!("dam.{number}.ply")).collect()
}

/// Lets frames `first..=last` of a moving block of `edge_count`³ particles land as `dam.N.ply`.
pub(crate) fn land_sequence(folder: &Path, first: usize, last: usize, edge_count: usize) {
    for (name, number) in frame_names(first, last).iter().zip(first..) {
        land(folder, name, &block_ply(edge_count, 0.025 * number as f32));
    }
}

/// A file appears by rename.
pub(crate) fn land(folder: &Path, name: &str, bytes: &[u8]) {
    let part = folder.join(format!(".{name}.part"));
    fs::write(&part, bytes).expect("written");
    fs::rename(&part, folder.join(name)).expect("renamed");
}

/// A block of `edge_count`³ particles, 0.1 apart, moved along x, as binary PLY.
pub(crate) fn block_ply(edge_count: usize, shift: f32) -> Vec<u8> {
    box_ply([edge_count; 3], shift)
}

/// The same of other edges.
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

/// A figure of a process from /proc/PID/status, in bytes.
pub(crate) fn memory_bytes(pid: u32, figure: &str) -> u64 {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).expect("the process is there");
    let line = status.lines().find_map(|line| line.strip_prefix(figure)).expect("the figure is there");
    let kibibytes = line.trim_start_matches(':').trim().trim_end_matches("kB").trim();
    kibibytes.parse::<u64>().expect("a number") * 1024
}
