//! All faults together, for a long time: a producer writes, rewrites, deletes and corrupts frames at random,
//! while the daemon is killed and stopped, and its disk fills up.
//!
//! ```text
//!   a round    some dozen acts of the producer ─▶ one fault ─▶ sometimes a calm: wait until all is done
//!
//!   first two fifths of the time   in some rounds, the daemon is killed or ended, and restarted (a new life)
//!   the rest                       one life: memory, handles and threads, measured at calms, must not grow
//! ```
//!
//! In the end the outputs equal those of the one-shot command for the final frames, to the last byte; and
//! every output that was visible in between was complete. `MENISCUS_SOAK_MINUTES` sets the duration, and
//! without it the soak does not run. `MENISCUS_SOAK_SEED` sets the seed of the random numbers, and
//! `MENISCUS_SOAK_LOG` names a file that receives a line for each calm.

mod faults; // faults of the daemon's surroundings
mod idle; // waits until every possible conversion is done
mod observer; // every visible output is complete
mod producer; // writes and damages frames
mod random; // numbers that look random
mod resources; // the daemon's memory, handles and threads

use std::collections::BTreeSet;
use std::env;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use tempfile::{TempDir, tempdir};

use crate::siege::mounts::{mount_tmpfs, with_own_mounts};
use crate::siege::scene::{Daemon, assert_same_output, meniscus, message, names_in, print_line, status};

use faults::{Fault, write_config};
use producer::Producer;
use random::Random;
use resources::{ResourceUsage, assert_flat, hourly_growth};

/// Size of the disk: space for all outputs, and little more.
const DISK_BYTES: u64 = 64 << 20;

/// The fraction of the total time in which the daemon may be killed.
const KILL_SHARE: f64 = 0.4;

/// The minimum time from one calm to the next.
const BETWEEN_IDLE_CHECKS: Duration = Duration::from_secs(15);

/// Longer than the time between two full scans.
const AFTER_THE_LAST: Duration = Duration::from_secs(80);

#[test]
#[ignore = "slow: `.ci/full soak` runs it, for MENISCUS_SOAK_MINUTES"]
fn random_faults_lose_no_frame_and_leak_no_resources() {
    let Some(minutes) = of_environment::<f64>("MENISCUS_SOAK_MINUTES") else {
        return print_line("the soak is SKIPPED: MENISCUS_SOAK_MINUTES says for how long it is to be");
    };
    with_own_mounts("soak::random_faults_lose_no_frame_and_leak_no_resources", || {
        let seed: u64 = of_environment("MENISCUS_SOAK_SEED").unwrap_or(7);
        let soak = Soak::new(Duration::from_secs_f64(60.0 * minutes), seed);
        let (out, is_over) = (soak.path().join("out"), AtomicBool::new(false));
        thread::scope(|scope| {
            let observer = scope.spawn(|| observer::observe(&out, &is_over));
            let over = Over(&is_over);
            let summary = soak.run();
            drop(over);
            let snapshot_count = observer.join().expect("no panic");
            print_line(&format!(
                "soak of {minutes} minutes, seed {seed}: {summary}; {snapshot_count} outputs seen, all whole"
            ));
        });
    });
}

/// A number from an environment variable.
fn of_environment<T: FromStr>(name: &str) -> Option<T> {
    let text = env::var_os(name)?;
    let value = text.to_str().and_then(|text| text.parse().ok());
    Some(value.unwrap_or_else(|| panic!("{name} is {}, and should be a number", text.display())))
}

/// Ends the observer, also after a panic.
struct Over<'a>(&'a AtomicBool);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

/// Frames and their producer, the daemon, and counts of its work.
struct Soak {
    folder: TempDir,
    time: Duration,
    start: Instant,
    random: Random,
    producer: Producer,
    daemon: Daemon,
    life_count: usize,
    fault_count: usize,
    converted_count: usize,
    /// The address of the daemon's HTTP server.
    http_address: Option<String>,
    /// The measurements of the daemon's current life.
    usages: Vec<ResourceUsage>,
    log: Option<File>,
}

impl Soak {
    fn new(time: Duration, seed: u64) -> Soak {
        let folder = tempdir().expect("a folder");
        for name in ["in", "out"] {
            fs::create_dir(folder.path().join(name)).expect("made");
        }
        mount_tmpfs(&folder.path().join("out"), DISK_BYTES);
        write_config(folder.path());
        let producer = Producer::new(folder.path(), Random(seed));
        producer.clutter();
        let log = env::var_os("MENISCUS_SOAK_LOG").map(|path| {
            let mut log = File::create(path).expect("made");
            writeln!(log, "{}", ResourceUsage::HEADER).expect("written");
            log
        });
        Soak {
            daemon: live(folder.path()),
            folder,
            time,
            start: Instant::now(),
            random: Random(!seed),
            producer,
            life_count: 1,
            fault_count: 0,
            converted_count: 0,
            http_address: None,
            usages: Vec::new(),
            log,
        }
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Runs the soak, and returns the summary.
    fn run(mut self) -> String {
        self.rounds_until(self.time.mul_f64(KILL_SHARE), &Fault::ALL);
        self.kill();
        self.rounds_until(self.time, &Fault::OF_ONE_LIFE);
        self.producer.repair_most();
        self.wait_until_idle();
        // A frame that failed before the producer repaired it counts as done until the daemon examines it
        // again.
        self.daemon.listen_for(AFTER_THE_LAST);
        self.wait_until_idle();
        let figures = self.figures();
        self.count_log();
        self.daemon.end();
        assert_as_converted(self.folder.path());
        assert_flat(&self.usages);
        figures
    }

    fn figures(&self) -> String {
        let last = self.usages.last().expect("there was a calm");
        format!(
            "{} acts, {} troubles, {} lives, {} conversions; the last life took {:.1} MiB ({:+.2} MiB an hour), {} handles, {} threads",
            self.producer.act_count(),
            self.fault_count,
            self.life_count,
            self.converted_count,
            last.resident_bytes as f64 / f64::from(1 << 20),
            hourly_growth(&self.usages) / f64::from(1 << 20),
            last.handle_count,
            last.thread_count,
        )
    }

    fn rounds_until(&mut self, end: Duration, faults: &[Fault]) {
        let mut last_idle_at = Instant::now();
        while self.start.elapsed() < end {
            for _ in 0..10 + self.random.below(40) {
                self.producer.act();
                thread::sleep(Duration::from_millis(self.random.below(120)));
            }
            let fault = faults[self.random.index(faults.len())];
            self.inject(fault);
            if last_idle_at.elapsed() > BETWEEN_IDLE_CHECKS {
                self.wait_until_idle();
                last_idle_at = Instant::now();
            }
        }
    }

    fn inject(&mut self, fault: Fault) {
        self.fault_count += 1;
        match fault {
            Fault::Kill => self.kill(),
            Fault::End => {
                self.count_log();
                self.daemon.end();
                self.begin_life();
            }
            _ => {
                self.count_log();
                let http_address = self.http_address.as_deref();
                fault.inject(self.folder.path(), http_address, &mut self.producer);
            }
        }
    }

    fn kill(&mut self) {
        self.count_log();
        self.daemon.kill();
        self.begin_life();
    }

    fn begin_life(&mut self) {
        thread::sleep(Duration::from_millis(self.random.below(300)));
        self.daemon = live(self.folder.path());
        self.life_count += 1;
        self.usages.clear();
    }

    /// Waits until every possible conversion is done, and measures the daemon's resources.
    fn wait_until_idle(&mut self) {
        idle::await_idle(self.folder.path(), &mut self.daemon);
        self.count_log();
        let minute = self.start.elapsed().as_secs_f64() / 60.0;
        let usages = ResourceUsage::of(self.daemon.pid(), self.folder.path(), minute, self.life_count);
        if let Some(log) = &mut self.log {
            writeln!(log, "{}", usages.line(self.converted_count)).expect("written");
        }
        self.usages.push(usages);
    }

    /// Counts the conversions, asserts that no line of the log reports a panic, and clears the log.
    fn count_log(&mut self) {
        self.daemon.listen_for(Duration::ZERO);
        self.converted_count += self.daemon.converted().len();
        for line in self.daemon.log.drain(..) {
            if message(&line) == "serving the status page" {
                self.http_address =
                    line["address"].as_str().map(|url| url.replace("http://", "").replace('/', ""));
            }
            assert!(line.is_object() && !line.to_string().contains("panic"), "{line}");
        }
        self.daemon.notices.clear();
    }
}

/// Starts a daemon, and does not wait for its first scan.
fn live(folder: &Path) -> Daemon {
    Daemon::start(folder, &["--config", "soak.toml"])
}

/// Asserts that the outputs are those of the one-shot command. Additional outputs of frames that were deleted
/// or damaged later must be complete.
fn assert_as_converted(folder: &Path) {
    let output = meniscus(folder)
        .args(["convert", "in", "--out", "wanted", "--preset", "paper", "--voxel-size", "0.05"])
        .output()
        .expect("it starts");
    assert!(matches!(output.status.code(), Some(0 | 1)), "{}", String::from_utf8_lossy(&output.stderr));
    let [out, wanted] = ["out", "wanted"].map(|name| folder.join(name));
    for name in names_in(&wanted) {
        assert_same_output(&out.join(&name), &wanted.join(&name));
    }
    let hidden: Vec<String> = names_in(&out).into_iter().filter(|name| name.starts_with('.')).collect();
    assert!(hidden.is_empty(), "left behind: {hidden:?}");
    let done: BTreeSet<PathBuf> =
        names_in(&wanted).iter().map(|name| Path::new(name).with_extension("")).collect();
    let counts = &status(folder)["counts"];
    assert_eq!(counts["queued"], 0, "{counts}");
    assert!(counts["done"].as_u64() >= Some(done.len() as u64), "{counts}, and {} are done", done.len());
}
