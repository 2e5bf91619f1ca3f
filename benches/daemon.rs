//! Measures the latency that the daemon adds to a frame: the time from its rename into the watched folder
//! until all outputs exist, minus the seconds for reading, reconstruction and writing that the log reports.
//!
//! ```text
//!   rename ─▶ event ─▶ event loop ─▶ queue ─▶ read … write ─▶ outputs exist
//!          └──────────── added ───────────┘└── the log ──┘└─ added ─┘
//! ```
//!
//! Exits with 1 if the median exceeds the project's target.
//!
//! `cargo bench --bench daemon`

#![expect(clippy::print_stdout, reason = "a benchmark prints its results")]

mod block;

use std::fs;
use std::io::{BufRead, BufReader};
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

const MEDIAN_MAX: Duration = Duration::from_millis(50);

fn main() -> ExitCode {
    let folder = tempfile::tempdir().expect("a folder");
    let inside = folder.path().join("in");
    fs::create_dir(&inside).expect("made");
    let mut daemon = Daemon::start(folder.path());
    let mut added: Vec<Duration> = (0..WARM_UP_COUNT + FRAME_COUNT)
        .map(|number| daemon.added_latency(folder.path(), number))
        .skip(WARM_UP_COUNT)
        .collect();
    added.sort();
    let median = added[added.len() / 2];
    println!("added by the daemon to each of {FRAME_COUNT} frames of 3000 particles, in ms");
    println!("  median    90 %     max");
    let [median_ms, most_ms, max_ms] =
        [median, added[added.len() * 9 / 10], added[added.len() - 1]].map(|time| time.as_secs_f64() * 1e3);
    println!("{median_ms:8.2}{most_ms:8.2}{max_ms:8.2}");
    if median < MEDIAN_MAX {
        return ExitCode::SUCCESS;
    }
    println!("the median is not under {MEDIAN_MAX:?}");
    ExitCode::FAILURE
}

/// A daemon process and its log.
struct Daemon {
    child: Child,
    log: BufReader<ChildStderr>,
}

impl Daemon {
    fn start(folder: &Path) -> Daemon {
        let mut child = Command::new(env!("CARGO_BIN_EXE_meniscus"))
            .args(["watch", "in", "--out", "out", "--log", "json"])
            .current_dir(folder)
            .env_remove("NOTIFY_SOCKET")
            .stdin(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the daemon starts");
        let log = BufReader::new(child.stderr.take().expect("a pipe"));
        Daemon { child, log }
    }

    /// Lets a frame arrive. Returns the time that the daemon adds to its reconstruction.
    fn added_latency(&mut self, folder: &Path, number: usize) -> Duration {
        let part = folder.join(format!("in/.{number}.part"));
        fs::write(&part, block_ply(BLOCK, 0.01 * number as f32)).expect("written");
        let outputs = ["glb", "vdb"].map(|format| folder.join(format!("out/dam.{number}.{format}")));
        let landed = Instant::now();
        fs::rename(&part, folder.join(format!("in/dam.{number}.ply"))).expect("renamed");
        while !outputs.iter().all(|output| output.exists()) {
            thread::sleep(POLL_INTERVAL);
        }
        let taken = landed.elapsed();
        taken.saturating_sub(self.logged_time())
    }

    /// The time that the next frame in the log took in all stages.
    fn logged_time(&mut self) -> Duration {
        loop {
            let mut line = String::new();
            let count = self.log.read_line(&mut line).expect("a log");
            assert!(count > 0, "the daemon has ended");
            let line: Value = serde_json::from_str(&line).expect("JSON");
            if line["message"] == "converted" {
                let stages = ["read_s", "rasterize_s", "smooth_s", "contour_s", "write_s"];
                let seconds = stages.iter().map(|stage| line[stage].as_f64().expect("seconds")).sum();
                return Duration::from_secs_f64(seconds);
            }
            assert!(line["level"] != "ERROR", "{line}");
        }
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // It has no work left.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The polling interval: long enough to leave the cores to the daemon.
const POLL_INTERVAL: Duration = Duration::from_micros(200);
