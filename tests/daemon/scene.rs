//! A watched folder, the daemon that watches it, and its log.
//!
//! ```text
//!   in/ ──▶ the daemon ──▶ out/          expected/ ◀── `convert` on the same frames
//!               │
//!               └─ its log, line by line: tests wait for what it says, and not for time to pass
//! ```

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, Command, ExitStatus, Stdio};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

/// A time limit that is longer than any wait of the tests, also on a machine with many more jobs than
/// processors.
pub(crate) fn timeout() -> Duration {
    Duration::from_secs(by_length(600, 1800))
}

/// Options for an HTTP server at a free port.
pub(crate) const WINDOW: [&str; 2] = ["--listen", "127.0.0.1:0"];

/// Chooses the first value in the short form of a test, and the second in the long one.
pub(crate) fn by_length<T>(short: T, long: T) -> T {
    if std::env::var_os("MENISCUS_LONG").is_some_and(|value| value == "1") { long } else { short }
}

/// A cube of `edge_count`³ particles at this spacing, moved along x.
pub(crate) fn block(edge_count: usize, spacing: f32, shift: f32) -> Vec<[f32; 3]> {
    let along = |index: usize| index as f32 * spacing;
    (0..edge_count.pow(3))
        .map(|i| {
            let [x, y, z] = [i % edge_count, i / edge_count % edge_count, i / edge_count.pow(2)].map(along);
            [x + shift, y, z]
        })
        .collect()
}

/// The frame of this number in a sequence of small moving cubes. The first frame has a slightly larger
/// spacing, which rounds to that of the others. So the voxel size does not depend on which frames are
/// measured.
pub(crate) fn moving(number: usize) -> Vec<[f32; 3]> {
    block(6, if number == 1 { 0.104 } else { 0.1 }, 0.025 * number as f32)
}

/// Particles as binary PLY.
pub(crate) fn ply(particles: &[[f32; 3]]) -> Vec<u8> {
    let mut bytes = ply_header("binary_little_endian", particles.len()).into_bytes();
    bytes.extend(particles.iter().flatten().flat_map(|value| value.to_le_bytes()));
    bytes
}

/// Particles as PLY in text.
pub(crate) fn text_ply(particles: &[[f32; 3]]) -> String {
    particles.iter().fold(ply_header("ascii", particles.len()), |mut text, [x, y, z]| {
        writeln!(text, "{x} {y} {z}").expect("strings take everything");
        text
    })
}

fn ply_header(encoding: &str, count: usize) -> String {
    format!(
        "ply\nformat {encoding} 1.0\nelement vertex {count}\n\
         property float x\nproperty float y\nproperty float z\nend_header\n"
    )
}

/// Particles as a table.
pub(crate) fn csv(particles: &[[f32; 3]]) -> String {
    particles.iter().fold("x,y,z\n".to_owned(), |mut text, [x, y, z]| {
        writeln!(text, "{x},{y},{z}").expect("strings take everything");
        text
    })
}

/// A folder with the frames in `in` and the outputs in `out`.
pub(crate) struct Scene {
    folder: TempDir,
}

impl Scene {
    pub(crate) fn new() -> Scene {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["in", "elsewhere"] {
            fs::create_dir(folder.path().join(name)).expect("a folder");
        }
        Scene { folder }
    }

    /// A path within the folder: `in/dam.1.ply`.
    pub(crate) fn path(&self, within: &str) -> PathBuf {
        self.folder.path().join(within)
    }

    /// Writes a file in place and creates its folder.
    pub(crate) fn write(&self, within: &str, bytes: impl AsRef<[u8]>) {
        let path = self.path(within);
        fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        fs::write(path, bytes).expect("written");
    }

    /// Writes a file under another name, and renames it.
    pub(crate) fn put(&self, within: &str, bytes: impl AsRef<[u8]>) {
        let elsewhere = format!("elsewhere/{}", within.replace('/', "-"));
        self.write(&elsewhere, bytes);
        fs::rename(self.path(&elsewhere), self.path(within)).expect("renamed");
    }

    /// Puts the frames of these numbers into `in`, as `dam.N.ply`.
    pub(crate) fn put_moving(&self, numbers: impl IntoIterator<Item = usize>) {
        for number in numbers {
            self.put(&format!("in/dam.{number}.ply"), ply(&moving(number)));
        }
    }

    pub(crate) fn remove(&self, within: &str) {
        fs::remove_file(self.path(within)).expect("removed");
    }

    pub(crate) fn bytes(&self, within: &str) -> Vec<u8> {
        fs::read(self.path(within)).unwrap_or_else(|error| panic!("{within}: {error}"))
    }

    /// Runs the program until it ends.
    pub(crate) fn run(&self, arguments: &[&str]) -> RunResult {
        let mut child =
            self.command(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("a start");
        let [out, err] =
            [drain(child.stdout.take().expect("piped")), drain(child.stderr.take().expect("piped"))];
        let status = ends(&mut child, timeout());
        if status.is_none() {
            child.kill().expect("killed");
        }
        let [out, err] = [out, err].map(|reader| reader.join().expect("no panic"));
        let status = status.unwrap_or_else(|| panic!("{arguments:?} does not end:\n{out}\n{err}"));
        assert!(!err.contains("panicked"), "{err}");
        RunResult { status: status.code(), out, err }
    }

    /// Runs `watch --once`, from `in` to `out`.
    pub(crate) fn once(&self, arguments: &[&str]) -> Once {
        let result = self.run(&[&WATCH[..], &["--once"], arguments].concat());
        Once { log: result.err.lines().map(line).collect(), status: result.status }
    }

    /// Starts the daemon from `in` to `out`, and does not wait for its first scan.
    pub(crate) fn start(&self, arguments: &[&str]) -> Watching {
        self.start_as(&[&WATCH[..], arguments].concat())
    }

    /// Starts the daemon, and waits until it has finished its first scan.
    pub(crate) fn watch(&self, arguments: &[&str]) -> Watching {
        let watching = self.start(arguments);
        watching.await_ready();
        watching
    }

    /// Starts the daemon with these arguments.
    pub(crate) fn start_as(&self, arguments: &[&str]) -> Watching {
        let socket_path = self.path("notify");
        // Removes the socket of an earlier daemon.
        let _ = fs::remove_file(&socket_path);
        let socket = UnixDatagram::bind(&socket_path).expect("a socket");
        socket.set_read_timeout(Some(Duration::from_millis(50))).expect("a timeout");
        let mut command = self.command(arguments);
        command.env("NOTIFY_SOCKET", &socket_path);
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("a start");
        let log = Arc::new(Log::default());
        let stderr = child.stderr.take().expect("piped");
        let [log_of_lines, log_of_notices] = [&log, &log].map(Arc::clone);
        let readers = vec![
            thread::spawn(move || log_of_lines.listen(stderr)),
            thread::spawn(move || log_of_notices.listen_for_notices(&socket)),
        ];
        Watching { child, log, readers, socket_path }
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_meniscus"));
        command
            .args(arguments)
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            // Tests wait for decisions of the daemon, so the log has them.
            .env("MENISCUS_LOG", "debug")
            .env_remove("NOTIFY_SOCKET");
        command
    }

    /// Asserts that `out` contains the same files as `convert` makes from `in`, and no other visible file.
    /// The only hidden folder is the daemon's own.
    #[track_caller]
    pub(crate) fn assert_as_converted(&self, arguments: &[&str]) {
        self.assert_folder_as_converted("in", "out", arguments);
    }

    /// Asserts the same for one folder of frames and the folder of its outputs.
    #[track_caller]
    pub(crate) fn assert_folder_as_converted(&self, input: &str, output: &str, arguments: &[&str]) {
        let _ = fs::remove_dir_all(self.path("expected"));
        let result = self.run(&[&["convert", input, "--out", "expected"], arguments].concat());
        assert!(matches!(result.status, Some(0 | 1)), "{}", result.err);
        let [expected, found] = ["expected", output].map(|folder| contents(&self.path(folder)));
        let [expected_names, found_names] = [&expected, &found].map(|files| files.keys().collect::<Vec<_>>());
        assert_eq!(found_names, expected_names);
        for (name, bytes) in &expected {
            assert!(found[name] == *bytes, "{name} is not what convert makes of it");
        }
    }

    /// Asserts that the outputs contain no hidden file except the daemon's own.
    #[track_caller]
    pub(crate) fn assert_no_temporaries(&self) {
        let hidden: Vec<String> =
            names_in(&self.path("out")).into_iter().filter(|name| name.starts_with('.')).collect();
        assert_eq!(hidden, [".meniscus"]);
    }
}

/// Options that start the daemon with a log of one JSON object per line.
const WATCH: [&str; 6] = ["watch", "in", "--out", "out", "--log", "json"];

/// The visible files of a folder, by name, without those of its sub-folders.
pub(crate) fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let names = names_in(folder).into_iter().filter(|name| !name.starts_with('.'));
    let files = names.map(|name| (folder.join(&name), name)).filter(|(path, _)| path.is_file());
    files.map(|(path, name)| (name, fs::read(path).expect("readable"))).collect()
}

/// All names in a folder, sorted; empty if the folder does not exist.
pub(crate) fn names_in(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten();
    let mut names: Vec<String> =
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// Polls until this holds, for conditions that no log line reports.
#[track_caller]
pub(crate) fn await_that(what: &str, mut is_so: impl FnMut() -> bool) {
    let start = Instant::now();
    while !is_so() {
        assert!(start.elapsed() < timeout(), "{what}: not within {:?}", timeout());
        thread::sleep(Duration::from_millis(5));
    }
}

/// The result of a run of the program.
pub(crate) struct RunResult {
    /// The exit status; `None` after a signal.
    pub(crate) status: Option<i32>,
    /// The standard output.
    pub(crate) out: String,
    /// The standard error.
    pub(crate) err: String,
}

/// The result of `watch --once`.
pub(crate) struct Once {
    pub(crate) status: Option<i32>,
    pub(crate) log: Vec<Line>,
}

impl Once {
    /// The names of the converted frames, sorted, because concurrent frames finish in any order.
    pub(crate) fn converted(&self) -> Vec<String> {
        sorted(self.converted_in_order())
    }

    /// The names of the converted frames, in the order of the log.
    pub(crate) fn converted_in_order(&self) -> Vec<String> {
        frames_that(&self.log, Line::is_converted)
    }

    /// The names of the frames that the daemon read and found done, sorted.
    pub(crate) fn found_done(&self) -> Vec<String> {
        sorted(frames_that(&self.log, Line::is_found_done))
    }

    #[track_caller]
    pub(crate) fn assert_status(&self, status: i32) {
        assert_eq!(self.status, Some(status), "{}", log_text(&self.log));
    }
}

fn sorted(mut names: Vec<String>) -> Vec<String> {
    names.sort();
    names
}

fn frames_that(log: &[Line], is_it: impl Fn(&Line) -> bool) -> Vec<String> {
    log.iter().filter(|line| is_it(line)).map(Line::frame_name).collect()
}

/// A line of the log.
#[derive(Clone, Debug)]
pub(crate) struct Line {
    pub(crate) level: String,
    pub(crate) message: String,
    /// The frame that the line is about.
    pub(crate) frame: Option<PathBuf>,
    /// The whole line.
    pub(crate) fields: Value,
}

impl Line {
    pub(crate) fn is_converted(&self) -> bool {
        self.fields["state"] == "converted"
    }

    pub(crate) fn is_found_done(&self) -> bool {
        self.fields["state"] == "already_done"
    }

    /// Whether the line is a warning or an error.
    pub(crate) fn is_complaint(&self) -> bool {
        matches!(&*self.level, "WARN" | "ERROR")
    }

    /// Whether the line is about the frame of this name.
    pub(crate) fn is_about(&self, name: &str) -> bool {
        self.frame.as_ref().is_some_and(|frame| frame.ends_with(name))
    }

    fn frame_name(&self) -> String {
        self.frame.as_deref().and_then(Path::file_name).unwrap_or_default().to_string_lossy().into_owned()
    }
}

fn line(text: &str) -> Line {
    // Before the log starts, messages are plain text.
    let fields: Value = serde_json::from_str(text).unwrap_or_else(|_| Value::String(text.to_owned()));
    let field = |name: &str| fields[name].as_str().map(str::to_owned);
    Line {
        level: field("level").unwrap_or_default(),
        message: field("message").unwrap_or_else(|| text.to_owned()),
        frame: field("frame").map(PathBuf::from),
        fields,
    }
}

/// The log in the form that a failing test prints.
pub(crate) fn log_text(log: &[Line]) -> String {
    log.iter().fold(String::new(), |text, line| text + &line.fields.to_string() + "\n")
}

/// The log so far.
#[derive(Default)]
struct Log {
    state: Mutex<LogState>,
    changed: Condvar,
}

#[derive(Default)]
struct LogState {
    lines: Vec<Line>,
    /// The messages to the service manager so far.
    notices: Vec<String>,
    has_ended: bool,
}

impl Log {
    fn listen(&self, stderr: ChildStderr) {
        for text in BufReader::new(stderr).lines() {
            self.lock().lines.push(line(&text.expect("text")));
            self.changed.notify_all();
        }
        self.lock().has_ended = true;
        self.changed.notify_all();
    }

    /// Reads the daemon's notifications: a service manager that does not read them would block the daemon.
    fn listen_for_notices(&self, socket: &UnixDatagram) {
        let mut buffer = [0; 4096];
        while !self.lock().has_ended {
            // No message yet.
            if let Ok(length) = socket.recv(&mut buffer) {
                let text = String::from_utf8_lossy(&buffer[..length]).into_owned();
                self.lock().notices.extend(text.lines().map(str::to_owned));
                self.changed.notify_all();
            }
        }
    }

    /// Waits until `find` returns something; `None` after the time limit. Every line of the log restarts the
    /// time.
    fn await_found<T>(&self, find: impl Fn(&LogState) -> Option<T>) -> Option<T> {
        let mut state = self.lock();
        let (mut line_count, mut since) = (state.lines.len(), Instant::now());
        loop {
            if let Some(found) = find(&state) {
                return Some(found);
            }
            if line_count < state.lines.len() {
                (line_count, since) = (state.lines.len(), Instant::now());
            }
            let left = timeout().saturating_sub(since.elapsed());
            if left.is_zero() || state.has_ended {
                return None;
            }
            state = self.changed.wait_timeout(state, left).expect("no panic").0;
        }
    }

    fn lock(&self) -> MutexGuard<'_, LogState> {
        self.state.lock().expect("no panic")
    }
}

/// A running daemon. Dropping it kills the process.
pub(crate) struct Watching {
    child: Child,
    log: Arc<Log>,
    readers: Vec<JoinHandle<()>>,
    socket_path: PathBuf,
}

impl Watching {
    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Waits until the first scan is finished.
    #[track_caller]
    pub(crate) fn await_ready(&self) {
        self.await_notice("READY=1");
    }

    /// Waits until the daemon sends this message to the service manager.
    #[track_caller]
    pub(crate) fn await_notice(&self, wanted: &str) {
        let is_found =
            |state: &LogState| state.notices.iter().any(|notice| notice.starts_with(wanted)).then_some(());
        let found = self.log.await_found(is_found);
        assert!(found.is_some(), "no {wanted}:\n{}", self.log_text());
    }

    /// Waits for a line of the log.
    #[track_caller]
    pub(crate) fn await_line(&self, what: &str, is_it: impl Fn(&Line) -> bool) -> Line {
        self.await_lines(1, what, is_it).remove(0)
    }

    /// Waits for this number of lines of the log, including earlier ones.
    #[track_caller]
    pub(crate) fn await_lines(&self, count: usize, what: &str, is_it: impl Fn(&Line) -> bool) -> Vec<Line> {
        let found = self.log.await_found(|state| {
            let found: Vec<&Line> = state.lines.iter().filter(|line| is_it(line)).collect();
            (count <= found.len()).then(|| found.into_iter().cloned().collect())
        });
        found.unwrap_or_else(|| {
            panic!("{what}: {} of {count} lines:\n{}", self.lines(&is_it).len(), self.log_text())
        })
    }

    /// Waits until this frame is converted, and returns the line about it.
    #[track_caller]
    pub(crate) fn await_converted(&self, name: &str) -> Line {
        self.await_line(&format!("{name} is converted"), |line| line.is_converted() && line.is_about(name))
    }

    /// The address of the daemon's HTTP server, as `host:port`.
    #[track_caller]
    pub(crate) fn window_address(&self) -> String {
        let line =
            self.await_line("serving the status page", |line| line.message == "serving the status page");
        let address = line.fields["address"].as_str().expect("an address");
        address.trim_start_matches("http://").trim_end_matches('/').to_owned()
    }

    /// Waits until the daemon has examined this frame at this size, and has decided to wait for a reason that
    /// contains these words.
    #[track_caller]
    pub(crate) fn await_waiting(&self, name: &str, byte_count: usize, why: &str) {
        self.await_line(&format!("{name} is waited for at {byte_count} bytes"), |line| {
            let is_decision = line.message.starts_with("waiting because") && line.message.contains(why);
            is_decision && line.is_about(name) && line.fields["bytes"] == byte_count
        });
    }

    /// The lines of the log so far that match.
    pub(crate) fn lines(&self, is_it: impl Fn(&Line) -> bool) -> Vec<Line> {
        self.log.lock().lines.iter().filter(|line| is_it(line)).cloned().collect()
    }

    /// How often this frame was converted so far.
    pub(crate) fn converted_count(&self, name: &str) -> usize {
        self.lines(|line| line.is_converted() && line.is_about(name)).len()
    }

    /// Asserts that the log has no warning and no error so far.
    #[track_caller]
    pub(crate) fn assert_no_complaints(&self) {
        assert!(self.lines(Line::is_complaint).is_empty(), "{}", self.log_text());
    }

    pub(crate) fn log_text(&self) -> String {
        log_text(&self.log.lock().lines)
    }

    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).expect("the daemon runs");
    }

    /// Whether the daemon runs.
    pub(crate) fn is_alive(&mut self) -> bool {
        self.child.try_wait().expect("a status").is_none()
    }

    /// Kills the daemon, and returns its log.
    pub(crate) fn kill(mut self) -> Vec<Line> {
        self.child.kill().expect("killed");
        self.end(timeout());
        std::mem::take(&mut self.log.lock().lines)
    }

    /// Asks the daemon to end, waits for it, and asserts that it succeeds.
    #[track_caller]
    pub(crate) fn finish(mut self) -> Vec<Line> {
        self.signal(Signal::TERM);
        let status = self.await_end();
        assert_eq!(status.code(), Some(0), "{}", self.log_text());
        std::mem::take(&mut self.log.lock().lines)
    }

    /// Waits until the daemon ends, on its own or after a signal that the test sent.
    #[track_caller]
    pub(crate) fn await_end(&mut self) -> ExitStatus {
        let status = self.end(timeout());
        let status = status.unwrap_or_else(|| panic!("it does not end:\n{}", self.log_text()));
        assert!(!self.log_text().contains("panicked"), "{}", self.log_text());
        status
    }

    fn end(&mut self, timeout: Duration) -> Option<ExitStatus> {
        let status = ends(&mut self.child, timeout)?;
        for reader in self.readers.drain(..) {
            reader.join().expect("no panic");
        }
        Some(status)
    }
}

impl Drop for Watching {
    fn drop(&mut self) {
        // The process may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = fs::remove_file(&self.socket_path);
    }
}

fn drain(mut pipe: impl Read + Send + 'static) -> JoinHandle<String> {
    thread::spawn(move || {
        let mut text = String::new();
        pipe.read_to_string(&mut text).expect("text");
        text
    })
}

/// The status of a child process; `None` if it does not end within this time.
fn ends(child: &mut Child, timeout: Duration) -> Option<ExitStatus> {
    let start = Instant::now();
    loop {
        if let Some(status) = child.try_wait().expect("a status") {
            return Some(status);
        }
        if start.elapsed() > timeout {
            return None;
        }
        thread::sleep(Duration::from_millis(2));
    }
}
