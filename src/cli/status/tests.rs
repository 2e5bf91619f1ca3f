use super::*;
use crate::pipeline::{FileStamp, OutputFormat, OutputOptions};
use crate::surface::options::MethodOptions;
use crate::watch::StabilityTimeouts;
use crate::watch::journal::{DaemonRecord, OutputRecord, PlanRecord};

use std::time::Duration;

fn frame(status: JournaledStatus, at_ms: u64) -> JournaledFrame {
    JournaledFrame {
        status,
        stamp: FileStamp::default(),
        hash: None,
        settings: String::new(),
        outputs: Vec::new(),
        reason: None,
        attempt_count: 1,
        at_ms,
        particle_count: None,
        seconds: None,
        flaws: Vec::new(),
        figures: None,
    }
}

fn daemon(state: DaemonState) -> DaemonRecord {
    DaemonRecord {
        pid: 12,
        host: "render-04".into(),
        started_ms: 1000,
        state,
        at_ms: 60_000,
        refused_reload: None,
    }
}

/// The state of a journal with 30 finished frames, 25 failed frames, and others.
fn state() -> JournalState {
    let mut state = JournalState { daemon: Some(daemon(DaemonState::Running)), ..JournalState::default() };
    let mut add =
        |name: String, record| state.frames.insert(Path::new("/sim").join(name).into(), Arc::new(record));
    for number in 1..=30 {
        let outputs = vec![OutputRecord::new(format!("/out/dam.{number}.glb").into(), 1, None)];
        let (particle_count, seconds) = (Some(250_000), Some(2.25));
        let done = frame(JournaledStatus::Done, 1000 * number);
        add(format!("dam.{number}.ply"), JournaledFrame { outputs, particle_count, seconds, ..done });
    }
    for number in 1..=25 {
        let reason = Some("PLY, at 12 bytes: no end".to_owned());
        add(format!("bad.{number}.ply"), JournaledFrame { reason, ..frame(JournaledStatus::Failed, 5000) });
    }
    let reason = Some("/sim/late.ply: cannot be read: busy".to_owned());
    add(
        "late.ply".into(),
        JournaledFrame { reason, attempt_count: 3, ..frame(JournaledStatus::Retrying, 9000) },
    );
    add("next.ply".into(), frame(JournaledStatus::Queued, 9000));
    let reason = Some("/sim/cut.ply: PLY, at byte 9: too short".to_owned());
    add(
        "cut.ply".into(),
        JournaledFrame { reason, attempt_count: 4, ..frame(JournaledStatus::RetriesExhausted, 9000) },
    );
    state
}

/// The plan of two watched folders: one has every condition, and the other has none.
fn plan() -> PlanRecord {
    let watch = Watch {
        input: "/sim".into(),
        pattern: Some("dam.*".into()),
        recursive: true,
        sentinel: Some("{name}.ok".into()),
        outputs: OutputOptions {
            folder: "/out".into(),
            formats: vec![OutputFormat::Glb, OutputFormat::Vdb],
            up: meniscus_formats::gltf::UpAxis::Y,
            meters_per_unit: 1.0,
            vdb_half: false,
            vdb_compression: meniscus_formats::vdb::Compression::Blosc,
            picture: crate::pipeline::PictureOptions::default(),
            stage: None,
        },
        choices: MethodOptions::default(),
        obstacles: Vec::new(),
    };
    let bare = Watch { pattern: None, recursive: false, sentinel: None, ..watch.clone() };
    let time = Duration::ZERO;
    PlanRecord {
        watches: vec![watch, bare],
        timeouts: StabilityTimeouts { settle: time, unverifiable: time, stalled: time },
    }
}

fn record(state: &JournalState, holder: Holder) -> StatusRecord {
    StatusRecord::new(Path::new("/out"), Path::new("/out/.meniscus"), state, holder)
}

#[test]
fn frames_are_counted_and_listed_in_order() {
    let record = record(&state(), Holder::Daemon("pid 12 on render-04".into()));
    assert_eq!(record.counts, StatusCounts { done: 30, queued: 1, retrying: 1, failed: 26 });
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
fn text_has_the_values_of_the_json() {
    let text = record(&state(), Holder::Daemon("pid 12 on render-04".into())).lines(64_000).join("\n");
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines[0], "/out: running (pid 12 on render-04)");
    assert_eq!(lines[1], "30 done, 1 queued, 1 to retry, 26 failed");
    assert_eq!(lines[3], "  /sim/bad.1.ply: PLY, at 12 bytes: no end (59s ago)");
    assert_eq!(lines[23], "  and 6 more: --json has them all");
    assert_eq!(lines[25], "  /sim/late.ply: cannot be read: busy (3 attempts, 55s ago)");
    assert_eq!(lines[27], "  /sim/dam.30.ply: 250000 particles, 2.25 s, 34s ago");
    let planned =
        record(&JournalState { plan: Some(plan()), ..state() }, Holder::Unlocked).lines(64_000).join("\n");
    let watched: Vec<&str> = planned.lines().skip(2).take(3).collect();
    let all = "  /sim and its sub-folders, only dam.*, each when its {name}.ok exists, as glb, vdb";
    assert_eq!(watched, ["watched:", all, "  /sim, as glb, vdb"]);
    let given_up = record(&state(), Holder::Unlocked).failed[25].text(64_000);
    assert_eq!(
        given_up,
        "/sim/cut.ply: PLY, at byte 9: too short (4 attempts, will be retried when the file changes or the daemon restarts, 55s ago)"
    );
    let mut flawed = state();
    let two = flawed.frames.get_mut(Path::new("/sim/dam.2.ply")).expect("a frame");
    Arc::make_mut(two).flaws = vec!["1 particle left out".into(), "failed validation".into()];
    let text = record(&flawed, Holder::Unlocked).lines(64_000).join("\n");
    let marked = "done, but failed validation or left out particles:\n  /sim/dam.2.ply: 250000 particles, 2.25 s, 1m 2s ago; \
                  1 particle left out; failed validation";
    assert!(text.ends_with(marked), "{text}");
    let cut_short = StatusRecord { waiting_cut_short: true, ..record(&state(), Holder::Unlocked) };
    assert!(cut_short.lines(0).join("\n").contains("more may be incomplete"), "{:?}", cut_short.lines(0));
    let refused_reload =
        Some(RefusedReload { at_ms: 61_000, reason: "m.toml:3: unknown key `a`".to_owned() });
    let refused = DaemonRecord { refused_reload, ..daemon(DaemonState::Running) };
    let refused = JournalState { daemon: Some(refused), ..state() };
    let line = "the configuration was not reloaded, 3s ago: m.toml:3: unknown key `a`; the earlier one still \
                applies";
    let lines = |holder| record(&refused, holder).lines(64_000);
    assert_eq!(lines(Holder::Daemon("pid 12 on render-04".into()))[2], line);
    assert!(!lines(Holder::Unlocked).iter().any(|text| text == line));
    let damaged = JournalState { damaged_line_count: 2, ..state() };
    assert!(
        record(&damaged, Holder::Unlocked).lines(0).join("\n").contains("2 damaged lines in the journal")
    );
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
        let state = JournalState { daemon: state.map(daemon), ..JournalState::default() };
        let status = DaemonStatus::new(&state, holder).expect("a daemon");
        assert_eq!((status.running, status.state), (running, word));
        assert!(status.text(65_000).contains(text), "{} does not say {text}", status.text(65_000));
    }
    assert_eq!(DaemonStatus::new(&JournalState::default(), Holder::Unlocked), None);
}

#[test]
fn json_has_the_documented_fields() {
    let state = JournalState { plan: Some(plan()), ..state() };
    let record = record(&state, Holder::Daemon("pid 12 on render-04".into()));
    let json = serde_json::to_value(&record).expect("JSON");
    let keys: Vec<&String> = json.as_object().expect("an object").keys().collect();
    assert_eq!(keys.len(), 12);
    let help = <crate::cli::args::Cli as clap::CommandFactory>::command()
        .find_subcommand_mut("status")
        .expect("the command")
        .render_long_help()
        .to_string();
    let lists = ["daemon", "counts"].map(|key| json[key].as_object().expect("an object"));
    let frames = ["failed", "last_done", "watches"].map(|key| json[key][0].as_object().expect("an object"));
    for key in keys.into_iter().chain(lists.into_iter().chain(frames).flat_map(|object| object.keys())) {
        assert!(help.contains(key.as_str()), "the help does not explain {key}");
    }
    assert_eq!(json["counts"]["failed"], 26);
    assert_eq!(json["watches"][0]["formats"], serde_json::json!(["glb", "vdb"]));
    assert_eq!(json["watches"][1]["pattern"], serde_json::Value::Null);
    assert_eq!(json["failed"].as_array().map(Vec::len), Some(26));
    assert_eq!(json["daemon"]["running"], true);
}
