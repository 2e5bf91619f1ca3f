//! The commands of a cycle, and the conditions that must hold afterwards.

use std::collections::BTreeSet;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;

use serde_json::Value;

use crate::faults::scene::{
    CHEAP, FORMATS, FRAME_COUNT, FaultKind, Faults, Files, PLAN, Random, References, RunResult, Scene,
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

const CONVERT: [&str; 4] = ["convert", "in", "--out", "out"];
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
        let commands: Vec<Vec<&str>> = match self.mode {
            Mode::Convert => vec![[&CONVERT[..], &CHEAP].concat()],
            Mode::Watch => vec![[&WATCH[..], &CHEAP].concat()],
            Mode::Farm => {
                let shard = |shard: &'static str| vec!["convert", "--plan", "plan.json", "--shard", shard];
                vec![
                    [&PLAN[..], &CHEAP[..10]].concat(),
                    shard("0"),
                    shard("1"),
                    vec!["verify", "out", "--plan", "plan.json"],
                ]
            }
        };
        let mut was_killed = false;
        for arguments in commands {
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
            assert!(is_killed || result.status.code().is_some_and(|code| code <= 2), "{}", about());
            let after = files_in(&self.scene.path("out"));
            self.assert_complete(&after, &about);
            self.assert_nothing_lost(&before, &after, faults, &about);
            if !is_killed {
                self.assert_no_wrong_success(&arguments, &result, &after, &about);
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
        let run = |arguments: &[&str]| {
            let result = self.scene.run(arguments, None);
            assert_eq!(result.status.code(), Some(0), "{}", about(&result));
            result
        };
        let last = match self.mode {
            Mode::Convert => run(&[&CONVERT[..], &CHEAP].concat()),
            Mode::Watch => run(&[&WATCH[..], &CHEAP].concat()),
            Mode::Farm => {
                run(&[&PLAN[..], &CHEAP[..10]].concat());
                run(&["convert", "--plan", "plan.json", "--shard", "0"]);
                run(&["convert", "--plan", "plan.json", "--shard", "1"]);
                run(&["verify", "out", "--plan", "plan.json"])
            }
        };
        let found = files_in(&self.scene.path("out"));
        for (name, bytes) in self.references.of(version) {
            if self.is_made(name) {
                assert!(found.get(name) == Some(bytes), "{name} is not as it should be: {}", about(&last));
            }
        }
        let is_more = |name: &&String| !self.references.of(version).contains_key(*name);
        let is_state = |name: &&String| self.mode == Mode::Watch && name.starts_with(".meniscus/");
        let more: Vec<&String> = found.keys().filter(is_more).filter(|name| !is_state(name)).collect();
        assert!(more.is_empty(), "{more:?} are left: {}", about(&last));
    }

    /// Whether a command makes a file of this name.
    fn is_made(&self, name: &str) -> bool {
        self.mode == Mode::Farm || !name.ends_with(".certificate.json")
    }

    /// Asserts that every visible file with the name of an output is a complete output.
    fn assert_complete(&self, found: &Files, about: &dyn Fn() -> String) {
        for (name, bytes) in found.iter().filter(|(name, _)| !name.starts_with('.')) {
            let is_known = |version: Version| self.references.of(version).get(name) == Some(bytes);
            let is_old = self.has_old && is_known(Version::Old);
            assert!(is_old || is_known(Version::New), "{name} is half written, or unknown: {}", about());
        }
    }

    /// Asserts that a frame that had all its outputs still has them, all of the same version. If the program
    /// was killed, or several operations failed, some outputs may have hidden names; the next run finds them.
    fn assert_nothing_lost(
        &self,
        before: &Files,
        after: &Files,
        faults: &Faults<'_>,
        about: &dyn Fn() -> String,
    ) {
        for number in 1..=FRAME_COUNT {
            let was_complete = !self.complete_sets(before, number).is_empty();
            let is_complete = !self.complete_sets(after, number).is_empty();
            let is_fine = match faults.kind {
                FaultKind::Nth(_) if was_complete => is_complete,
                _ if was_complete || self.has_old => is_complete || self.can_be_completed(after, number),
                _ => true,
            };
            assert!(is_fine, "the outputs of frame {number} are lost: {}", about());
        }
    }

    /// Whether all outputs of one version of a frame exist, under their final or hidden names.
    fn can_be_completed(&self, found: &Files, number: usize) -> bool {
        let exists = |name: &String, version: Version| {
            let wanted = &self.references.of(version)[name];
            let is_hidden = |(other, bytes): (&String, &Vec<u8>)| other.starts_with('.') && bytes == wanted;
            found.get(name) == Some(wanted) || found.iter().any(is_hidden)
        };
        let names = self.names(number);
        [Version::New, Version::Old].iter().any(|&version| names.iter().all(|name| exists(name, version)))
    }

    /// The versions for which all outputs of a frame exist.
    fn complete_sets(&self, found: &Files, number: usize) -> Vec<Version> {
        let versions = [Version::New, Version::Old].into_iter();
        let is_complete = |version: &Version| {
            let reference = self.references.of(*version);
            self.names(number).iter().all(|name| found.get(name) == Some(&reference[name]))
        };
        versions.filter(is_complete).collect()
    }

    fn names(&self, number: usize) -> Vec<String> {
        FORMATS.iter().map(|format| format!("{}.{format}", stem(number))).collect()
    }

    /// Asserts that all frames that the command reports as done are done.
    fn assert_no_wrong_success(
        &self,
        arguments: &[&str],
        result: &RunResult,
        after: &Files,
        about: &dyn Fn() -> String,
    ) {
        let is_current = |number: usize| self.complete_sets(after, number).contains(&Version::New);
        let current: Vec<usize> = (1..=FRAME_COUNT).filter(|&number| is_current(number)).collect();
        let reported: BTreeSet<usize> = match arguments[0] {
            "watch" => (1..=FRAME_COUNT).filter(|&number| is_logged_done(&result.err, number)).collect(),
            _ => (1..=FRAME_COUNT).filter(|&number| is_printed_done(&result.out, number)).collect(),
        };
        for number in &reported {
            assert!(current.contains(number), "frame {number} is said to be done: {}", about());
        }
        if result.status.code() != Some(0) {
            return;
        }
        match arguments {
            ["plan", ..] => {
                let plan = std::fs::read(self.scene.path("plan.json")).expect("a plan that was made");
                let plan: Value = serde_json::from_slice(&plan).expect("JSON");
                let count = plan["frames"].as_array().map_or(0, Vec::len);
                assert_eq!(count, FRAME_COUNT, "frames are missing in the plan: {}", about());
            }
            // A shard has only its frames; those that it reports as done were checked above.
            ["convert", "--plan", ..] => assert!(!reported.is_empty(), "it did nothing: {}", about()),
            _ => assert_eq!(current.len(), FRAME_COUNT, "exit status 0, but frames are missing: {}", about()),
        }
    }
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
