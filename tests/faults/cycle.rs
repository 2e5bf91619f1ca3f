//! The commands of a cycle, and the conditions that must hold afterwards.

use std::collections::BTreeSet;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;

use serde_json::Value;

use crate::faults::scene::{
    CHEAP, CONVERT, FORMATS, FRAME_COUNT, FaultKind, Faults, Files, Random, References, RunResult, Scene,
    Version, files_in, print_line, stem,
};

/// Counts of the faults in a cycle.
pub(crate) struct Figures {
    pub(crate) fault_count: u64,
    pub(crate) kill_count: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    Convert,
    Watch,
    Farm,
}

const WATCH: [&str; 9] = ["watch", "in", "--out", "out", "--once", "--settle", "1ms", "--log", "json"];

struct Cycle<'a> {
    seed: u64,
    mode: Mode,
    scene: Scene,
    references: &'a References,
    /// Whether outputs of an earlier version of the frames existed before the runs with faults.
    has_old: bool,
    random: Random,
}

/// Runs one cycle.
pub(crate) fn run(seed: u64, shim: &Path, references: &References) -> Figures {
    let mut random = Random(seed);
    let mode = [Mode::Convert, Mode::Watch, Mode::Farm][usize::try_from(seed % 3).expect("small")];
    let has_old = random.below(3) > 0;
    let mut cycle = Cycle { seed, mode, scene: Scene::new(), references, has_old, random };
    if has_old {
        cycle.scene.put_frames(Version::Old);
        cycle.assert_all_is_made(Version::Old);
    }
    cycle.scene.put_frames(Version::New);
    let mut kill_count = 0;
    for _ in 0..=cycle.random.below(3) {
        let kind = match cycle.random.below(3) {
            0 => FaultKind::Rate([10, 40, 120][usize::try_from(cycle.random.below(3)).expect("small")]),
            1 => FaultKind::Nth(1 + cycle.random.below(150)),
            _ => FaultKind::Kill(1 + cycle.random.below(40)),
        };
        let seed = cycle.random.below(u64::MAX);
        let faults = Faults { shim, seed, kind, no_pause: mode == Mode::Watch };
        kill_count += u64::from(cycle.run_with(&faults));
    }
    cycle.assert_all_is_made(Version::New);
    let log = cycle.scene.fault_log();
    if std::env::var_os("MENISCUS_FAULT_SEED").is_some() {
        print_line(&format!("seed {seed}, {mode:?}:\n{log}"));
    }
    let fault_count = log.lines().filter(|line| !line.starts_with("kill")).count() as u64;
    Figures { fault_count, kill_count }
}

impl Cycle<'_> {
    /// Runs the commands with faults, and checks their files after each. Returns whether the program was
    /// killed.
    fn run_with(&mut self, faults: &Faults<'_>) -> bool {
        let mut was_killed = false;
        for arguments in self.mode.commands() {
            let before = files_in(&self.scene.path("out"));
            let result = self.scene.run(&arguments, Some(faults));
            let is_killed = result.status.signal() == Some(9);
            let about = || {
                let (out, err, log) = (&result.out, &result.err, self.scene.fault_log());
                format!(
                    "seed {} ({:?}, old outputs: {}), {faults:?}, {arguments:?}, {}:\n{out}{err}faults:\n{log}",
                    self.seed, self.mode, self.has_old, result.status
                )
            };
            assert!(
                is_killed || result.status.code().is_some_and(|code| code <= 2 || code == 75),
                "{}",
                about()
            );
            let after = files_in(&self.scene.path("out"));
            self.assert_complete(&after, &about);
            let lost: Vec<&String> = before.keys().filter(|name| is_lost(name, &after)).collect();
            assert!(lost.is_empty(), "{lost:?} are lost: {}", about());
            let current: BTreeSet<usize> =
                (1..=FRAME_COUNT).filter(|n| self.is_current(&after, *n)).collect();
            let done = self.scene.done();
            assert!(done.is_subset(&current), "{done:?} are recorded as done: {}", about());
            let reported = reported_done(&arguments, &result);
            assert!(reported.is_subset(&done), "{reported:?} are said to be done: {}", about());
            if result.status.code() == Some(0) {
                // A shard has only its frames.
                let expected = if arguments.contains(&"--shard") { &reported } else { &current };
                let count = if arguments.contains(&"--shard") { 1 } else { FRAME_COUNT };
                assert!(expected.len() >= count, "exit status 0, but frames are missing: {}", about());
            }
            was_killed |= is_killed;
        }
        was_killed
    }

    /// Asserts that runs without faults make all outputs, and remove all files that failed or killed runs
    /// left.
    fn assert_all_is_made(&self, version: Version) {
        let about = |result: &RunResult| {
            let log = self.scene.fault_log();
            format!(
                "seed {} ({:?}), without faults:\n{}{}faults:\n{log}",
                self.seed, self.mode, result.out, result.err
            )
        };
        let run = |arguments: Vec<&'static str>| {
            let result = self.scene.run(&arguments, None);
            assert_eq!(result.status.code(), Some(0), "{}", about(&result));
            result
        };
        let results: Vec<RunResult> = self.mode.commands().into_iter().map(run).collect();
        let last = results.last().expect("a command");
        let found = files_in(&self.scene.path("out"));
        for (name, bytes) in self.references.of(version) {
            assert!(found.get(name) == Some(bytes), "{name} is not as it should be: {}", about(last));
        }
        let is_more = |name: &&String| !self.references.of(version).contains_key(*name);
        let is_state = |name: &&String| {
            name.starts_with(".meniscus/frames-")
                || self.mode == Mode::Watch && name.starts_with(".meniscus/")
        };
        let more: Vec<&String> = found.keys().filter(is_more).filter(|name| !is_state(name)).collect();
        assert!(more.is_empty(), "{more:?} are left: {}", about(last));
    }

    /// Asserts that every visible file with the name of an output is a complete output.
    fn assert_complete(&self, found: &Files, about: &dyn Fn() -> String) {
        for (name, bytes) in found.iter().filter(|(name, _)| !name.starts_with('.')) {
            let is_known = |version: Version| self.references.of(version).get(name) == Some(bytes);
            let is_old = self.has_old && is_known(Version::Old);
            assert!(is_old || is_known(Version::New), "{name} is half written, or unknown: {}", about());
        }
    }

    /// Whether all outputs of a frame are those of its current version.
    fn is_current(&self, found: &Files, number: usize) -> bool {
        let reference = self.references.of(Version::New);
        let names = FORMATS.map(|format| format!("{}.{format}", stem(number)));
        names.iter().all(|name| found.get(name) == Some(&reference[name]))
    }
}

impl Mode {
    /// The commands that convert all frames. Each skips frames that are done.
    fn commands(self) -> Vec<Vec<&'static str>> {
        let convert = |more: &[&'static str]| [&CONVERT[..], &CHEAP, more].concat();
        match self {
            Mode::Convert => vec![convert(&["--skip-done"])],
            Mode::Watch => vec![[&WATCH[..], &CHEAP].concat()],
            Mode::Farm => vec![
                convert(&["--shard", "1/2"]),
                convert(&["--shard", "2/2"]),
                vec!["verify", "out", "--input", "in"],
            ],
        }
    }
}

/// Whether an output no longer exists.
fn is_lost(name: &str, after: &Files) -> bool {
    !name.starts_with('.') && !after.contains_key(name)
}

/// The numbers of the frames that a command reports as done.
fn reported_done(arguments: &[&str], result: &RunResult) -> BTreeSet<usize> {
    let is_reported = |number: &usize| match arguments[0] {
        "watch" => is_logged_done(&result.err, *number),
        _ => is_printed_done(&result.out, *number),
    };
    (1..=FRAME_COUNT).filter(is_reported).collect()
}

fn is_printed_done(out: &str, number: usize) -> bool {
    let name = format!("{}.ply: ", stem(number));
    let is_done =
        |line: &str| line.contains(&name) && (line.contains(" particles") || line.ends_with("done already"));
    out.lines().any(is_done)
}

fn is_logged_done(log: &str, number: usize) -> bool {
    let name = format!("{}.ply", stem(number));
    let lines = log.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let is_done =
        |line: &Value| matches!(line["message"].as_str(), Some("converted" | "frame was done already"));
    let is_about = |line: &Value| line["frame"].as_str().is_some_and(|frame| frame.ends_with(&name));
    lines.filter(is_about).filter(is_done).count() > 0
}
