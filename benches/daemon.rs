//! Measures the latency that the daemon adds to a frame, and how long it takes to start.
//!
//! ```text
//!   rename ─▶ event ─▶ event loop ─▶ queue ─▶ read … write ─▶ outputs exist
//!          └──────────── added ───────────┘└── the log ──┘└─ added ─┘
//!
//!   program starts ─▶ records are read ─▶ 50,000 frames are found done ─▶ /readyz says ready
//!                  └───────────────────────── start ────────────────────┘
//! ```
//!
//! Exits with 1 if a median exceeds the project's target.
//!
//! `cargo bench --bench daemon`

#![expect(clippy::print_stdout, reason = "a benchmark prints its results")]

mod block;

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, ChildStderr, Command, ExitCode, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;

use block::block_ply;

/// The first frames have extra costs: the first one determines the voxel size.
const WARM_UP_COUNT: usize = 3;
const FRAME_COUNT: usize = 60;
/// A block of 3 000 particles.
const BLOCK: [usize; 3] = [20, 15, 10];
const ADDED_MAX: Duration = Duration::from_millis(5);

/// Number of frames that are converted before the start is measured. They have no particles, so that
/// converting all of them takes only a minute or two.
const FINISHED_COUNT: usize = 50_000;
const START_COUNT: usize = 7;
const START_MAX: Duration = Duration::from_secs(1);

fn main() -> ExitCode {
    let added = summarize(
        &format!("added by the daemon to each of {FRAME_COUNT} frames of 3000 particles, in ms"),
        times_added(),
        ADDED_MAX,
    );
    let start = summarize(
        &format!("start with {FINISHED_COUNT} finished frames, {START_COUNT} times, in ms"),
        start_times(),
        START_MAX,
    );
    if added && start { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Prints the distribution; returns whether the median is small enough.
fn summarize(title: &str, mut times: Vec<Duration>, median_max: Duration) -> bool {
    times.sort();
    let median = times[times.len() / 2];
    let [median_ms, most_ms, max_ms] =
        [median, times[times.len() * 9 / 10], times[times.len() - 1]].map(|time| time.as_secs_f64() * 1e3);
    println!("{title}");
    println!("  median    90 %     max");
    println!("{median_ms:8.2}{most_ms:8.2}{max_ms:8.2}");
    let is_kept = median < median_max;
    if !is_kept {
        println!("the median is not under {median_max:?}");
    }
    is_kept
}

fn times_added() -> Vec<Duration> {
    let folder = tempfile::tempdir().expect("a folder");
    fs::create_dir(folder.path().join("in")).expect("made");
    let mut daemon = Daemon::start(folder.path(), &[]);
    (0..WARM_UP_COUNT + FRAME_COUNT)
        .map(|number| daemon.time_added(folder.path(), number))
        .skip(WARM_UP_COUNT)
        .collect()
}

fn start_times() -> Vec<Duration> {
    let folder = tempfile::tempdir().expect("a folder");
    let inside = folder.path().join("in");
    fs::create_dir(&inside).expect("made");
    let empty = block_ply([0; 3], 0.0);
    for number in 0..FINISHED_COUNT {
        fs::write(inside.join(format!("dam.{number}.ply")), &empty).expect("written");
    }
    let settings = ["--format", "ply", "--preset", "paper", "--voxel-size", "0.1", "--settle", "100ms"];
    let once = [&settings[..], &["--once"]].concat();
    let mut daemon = Daemon::start(folder.path(), &once);
    let converted_count = std::iter::from_fn(|| next_line(&mut daemon.log))
        .filter(|line| line["message"] == "converted")
        .count();
    assert_eq!(converted_count, FINISHED_COUNT);
    let listening = [&settings[..], &["--listen", "127.0.0.1:0"]].concat();
    let time_start = |_| {
        let started = Instant::now();
        let mut daemon = Daemon::start(folder.path(), &listening);
        let address = daemon.address();
        while !is_ready(&address) {
            thread::sleep(Duration::from_millis(1));
        }
        started.elapsed()
    };
    (0..START_COUNT).map(time_start).collect()
}

/// Whether the daemon whose status page is at this address reports that it is ready.
fn is_ready(address: &str) -> bool {
    let mut stream = TcpStream::connect(address).expect("connected");
    stream.write_all(b"GET /readyz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").expect("sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    answer.starts_with("HTTP/1.1 200")
}

/// A daemon, and its log. Killed when it is dropped.
struct Daemon {
    _child: Running,
    log: BufReader<ChildStderr>,
}

impl Daemon {
    fn start(folder: &Path, more: &[&str]) -> Daemon {
        let mut child = Command::new(env!("CARGO_BIN_EXE_meniscus"))
            .args(["watch", "in", "--out", "out", "--log", "json"])
            .args(more)
            .current_dir(folder)
            .env_remove("NOTIFY_SOCKET")
            .stdin(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the daemon starts");
        let log = BufReader::new(child.stderr.take().expect("a pipe"));
        Daemon { _child: Running(child), log }
    }

    /// The address of its status page.
    fn address(&mut self) -> String {
        let opened = |line: &Value| line["message"] == "serving the status page";
        let line = std::iter::from_fn(|| next_line(&mut self.log)).find(opened).expect("a status page");
        let address = line["address"].as_str().expect("an address");
        address.trim_start_matches("http://").trim_end_matches('/').to_owned()
    }

    /// Renames a frame into the watched folder. Returns the time until its outputs exist, minus the time of
    /// its stages according to the log.
    fn time_added(&mut self, folder: &Path, number: usize) -> Duration {
        let part = folder.join(format!("in/.{number}.part"));
        fs::write(&part, block_ply(BLOCK, 0.01 * number as f32)).expect("written");
        let outputs = ["glb", "vdb"].map(|format| folder.join(format!("out/dam.{number}.{format}")));
        let landed = Instant::now();
        fs::rename(&part, folder.join(format!("in/dam.{number}.ply"))).expect("renamed");
        while !outputs.iter().all(|output| output.exists()) {
            thread::sleep(POLL_INTERVAL);
        }
        let elapsed = landed.elapsed();
        elapsed.saturating_sub(self.logged_time())
    }

    /// The time that the next frame in the log took in all stages.
    fn logged_time(&mut self) -> Duration {
        let is_converted = |line: &Value| {
            assert!(line["level"] != "ERROR", "{line}");
            line["message"] == "converted"
        };
        let line = std::iter::from_fn(|| next_line(&mut self.log)).find(is_converted);
        let line = line.expect("the daemon runs");
        let stages = ["read_s", "rasterize_s", "smooth_s", "contour_s", "write_s"];
        let seconds = stages.iter().map(|stage| line[stage].as_f64().expect("seconds")).sum();
        Duration::from_secs_f64(seconds)
    }
}

/// The next line of a log; `None` at its end.
fn next_line(log: &mut impl BufRead) -> Option<Value> {
    let mut line = String::new();
    let count = log.read_line(&mut line).expect("a log");
    (count > 0).then(|| serde_json::from_str(&line).expect("JSON"))
}

struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // The daemon has no work left, so killing it loses nothing.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The polling interval: long enough to leave the cores to the daemon.
const POLL_INTERVAL: Duration = Duration::from_micros(200);
