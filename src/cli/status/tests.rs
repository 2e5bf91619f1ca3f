use std::sync::Arc;

use super::*;
use crate::pipeline::{DaemonRecord, DoneRecord, Reason, RecordLine, SequenceKey, SharedSettings};
use crate::watch::test_records::{done_record, unfinished_record};

fn daemon(state: DaemonState) -> DaemonRecord {
    DaemonRecord { pid: 12, host: "render-04".into(), started_ms: 1000, state, at_ms: 60_000 }
}

fn done(number: u64) -> DoneRecord {
    let record = done_record(&PathBuf::from(format!("/sim/dam.{number}.ply")), FileStamp::default());
    let mut figures = (*record.figures).clone();
    (figures.particles, figures.seconds.smooth) = (Some(250_000), 2.25);
    DoneRecord { at_ms: 1000 * number, figures: figures.into(), ..(*record).clone() }
}

/// The records of 30 finished frames, 25 failed frames, and others.
fn state() -> LatestRecords {
    let mut state = LatestRecords { daemon: Some(daemon(DaemonState::Running)), ..LatestRecords::default() };
    for number in 1..=30 {
        state.insert(&RecordLine::Done(done(number).into()));
    }
    let mut add = |name: &str, unfinished, reason, (attempts, at_ms)| {
        let record = unfinished_record(&Path::new("/sim").join(name), unfinished);
        let record = UnfinishedRecord { reason, attempts, at_ms, ..record };
        state.insert(&RecordLine::Unfinished(record.into()));
    };
    let error = |what: &str| Some(Reason::Error(what.to_owned()));
    for number in 1..=25 {
        let why = error("PLY, at 12 bytes: no end");
        add(&format!("bad.{number}.ply"), UnfinishedState::Failed, why, (1, 5000));
    }
    add("late.ply", UnfinishedState::Retrying, error("/sim/late.ply: cannot be read: busy"), (3, 9000));
    add("next.ply", UnfinishedState::Queued, None, (0, 9000));
    add("new.ply", UnfinishedState::Waiting, Some(Reason::Changing), (0, 9000));
    let why = error("/sim/cut.ply: PLY, at byte 9: too short");
    add("cut.ply", UnfinishedState::AwaitsRestart, why, (4, 9000));
    state
}

fn record(state: &LatestRecords, holder: Holder) -> StatusRecord {
    StatusRecord::new(Path::new("/out"), state, holder)
}

#[test]
fn frames_are_counted_and_listed_in_order() {
    let record = record(&state(), Holder::Daemon("pid 12 on render-04".into()));
    assert_eq!(record.counts, StatusCounts { done: 30, queued: 1, retrying: 1, waiting: 1, failed: 26 });
    let names = |frames: &[FrameStatus]| -> Vec<String> {
        frames.iter().map(|frame| frame.input.rsplit('/').next().expect("a name").to_owned()).collect()
    };
    assert_eq!(
        names(&record.last_done),
        ["dam.30.ply", "dam.29.ply", "dam.28.ply", "dam.27.ply", "dam.26.ply"]
    );
    assert_eq!(names(&record.failed)[8..10], ["bad.9.ply", "bad.10.ply"]);
}

#[test]
fn spacing_that_was_measured_on_one_frame_is_named_with_the_option_that_fixes_it() {
    let mut state = LatestRecords::default();
    for (choices, spacing, measured_count) in [("1", 0.05, 1), ("2", 0.05, 1), ("3", 0.051, 3)] {
        let key = SequenceKey { folder: "/in".into(), name: "dam.{}.ply".into(), choices: choices.into() };
        let measured = MeasuredSpacing {
            spacing,
            confidence: 1.0,
            irregularity: None,
            radius_median: None,
            measured_on: "/in/dam.1.ply".into(),
            measured_count,
            warnings: Vec::new(),
        };
        let shared = SharedSettings { measured: Some(measured), ..SharedSettings::default() };
        state.insert(&RecordLine::Sequence { key, shared: shared.into() });
    }
    let lines = record(&state, Holder::Unlocked).lines(0);
    let of_one =
        "dam.{}.ply: particle spacing 0.05, measured on 1 frame; --spacing 0.05 makes every run alike";
    assert_eq!(lines[2..], [of_one, "dam.{}.ply: particle spacing 0.051, measured on 3 frames"]);
}

#[test]
fn text_has_the_values_of_the_json() {
    let text = record(&state(), Holder::Daemon("pid 12 on render-04".into())).lines(64_000).join("\n");
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines[0], "/out: running (pid 12 on render-04)");
    assert_eq!(lines[1], "30 done, 1 queued, 1 to retry, 26 failed");
    assert_eq!(lines[3], "  /sim/new.ply: it changed just now (55s ago)");
    assert_eq!(lines[5], "  /sim/bad.1.ply: PLY, at 12 bytes: no end (59s ago)");
    assert_eq!(lines[25], "  and 6 more: --json has them all");
    assert_eq!(lines[27], "  /sim/late.ply: cannot be read: busy (3 attempts, 55s ago)");
    assert_eq!(lines[29], "  /sim/dam.30.ply: 250000 particles, 2.25 s, 34s ago");
    let awaiting_restart = record(&state(), Holder::Unlocked).failed[25].text(64_000);
    assert_eq!(
        awaiting_restart,
        "/sim/cut.ply: PLY, at byte 9: too short (4 attempts, next try when the file changes or the daemon restarts, 55s ago)"
    );
    // Not only all retries: a frame that exceeds the memory limit is not retried at all.
    assert_eq!(UnfinishedState::AwaitsRestart.to_string(), "failed");
    let mut flawed = state();
    let flaws = vec!["1 particle left out".into(), "failed validation".into()];
    flawed.insert(&RecordLine::Done(Arc::new(DoneRecord { flaws, ..done(2) })));
    let text = record(&flawed, Holder::Unlocked).lines(64_000).join("\n");
    let marked = "done, but failed validation or left out particles:\n  /sim/dam.2.ply: 250000 particles, 2.25 s, 1m 2s ago; \
                  1 particle left out; failed validation";
    assert!(text.ends_with(marked), "{text}");
}

#[test]
fn running_state_comes_from_the_lock() {
    let by = || Holder::Daemon("pid 13 on render-05".into());
    let paused = || DaemonState::Paused("the disk is full".into());
    for (state, holder, running, word, text) in [
        (Some(DaemonState::Running), by(), Some(true), "running", "running (pid 13 on render-05)"),
        (Some(DaemonState::Running), Holder::Unlocked, Some(false), "killed", "was killed, or its machine"),
        (
            Some(DaemonState::Running),
            Holder::Unknown,
            None,
            "running",
            "the file system has no locks (pid 12 on render-04)",
        ),
        (Some(paused()), by(), Some(true), "paused", "paused, 5s ago: the disk is full (pid 13"),
        (Some(paused()), Holder::Unlocked, Some(false), "killed", "killed"),
        (Some(DaemonState::Stopped), Holder::Unlocked, Some(false), "stopped", "has ended, 5s ago (pid 12"),
        (Some(DaemonState::Stopped), by(), Some(true), "starting", "starting (pid 13"),
        (None, by(), Some(true), "starting", "starting (pid 13"),
    ] {
        let state = LatestRecords { daemon: state.map(daemon), ..LatestRecords::default() };
        let status = DaemonStatus::new(&state, holder).expect("a daemon");
        assert_eq!((status.running, status.state), (running, word));
        assert!(status.text(65_000).contains(text), "{} does not say {text}", status.text(65_000));
    }
    assert_eq!(DaemonStatus::new(&LatestRecords::default(), Holder::Unlocked), None);
}

#[test]
fn json_has_the_documented_fields() {
    let state = state();
    let record = record(&state, Holder::Daemon("pid 12 on render-04".into()));
    let json = serde_json::to_value(&record).expect("JSON");
    let keys: Vec<&String> = json.as_object().expect("an object").keys().collect();
    assert_eq!(keys.len(), 9);
    let help = <crate::cli::args::Cli as clap::CommandFactory>::command()
        .find_subcommand_mut("status")
        .expect("the command")
        .render_long_help()
        .to_string();
    let lists = ["daemon", "counts"].map(|key| json[key].as_object().expect("an object"));
    let frames = ["failed", "last_done", "waiting"].map(|key| json[key][0].as_object().expect("an object"));
    for key in keys.into_iter().chain(lists.into_iter().chain(frames).flat_map(|object| object.keys())) {
        assert!(help.contains(key.as_str()), "the help does not explain {key}");
    }
    assert_eq!(json["counts"]["failed"], 26);
    assert_eq!(json["waiting"][0]["reason"], "it changed just now");
    assert_eq!(json["failed"].as_array().map(Vec::len), Some(26));
    assert_eq!(json["daemon"]["running"], true);
}
