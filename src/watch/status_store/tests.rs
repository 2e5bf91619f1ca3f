use super::*;

fn view(name: &str, state: FrameProgress) -> FrameView {
    let output = |extension: &str| OutputView {
        name: format!("{name}.{extension}"),
        size_bytes: 1,
        path: format!("/out/{name}.{extension}").into(),
    };
    FrameView {
        summary: FrameSummary {
            name: name.into(),
            state,
            stage: None,
            reason: None,
            since_ms: 0,
            particles: None,
            seconds: None,
            surface: None,
            picture: None,
        },
        attempts: 0,
        input_bytes: 0,
        outputs: if state == FrameProgress::Done { vec![output("glb"), output("vdb")] } else { Vec::new() },
        figures: None,
        stem: format!("/out/{name}").into(),
    }
}

fn names(frames: &[Arc<FrameView>]) -> Vec<&str> {
    frames.iter().map(|frame| &*frame.summary.name).collect()
}

/// The names of changed frames, and of removed ones.
fn news(store: &StatusStore, version: u64) -> Option<(u64, Vec<String>, Vec<String>)> {
    match store.changes_since(version, 100) {
        StatusChanges::Lost(_) => None,
        StatusChanges::Known { version, frames, removed, .. } => {
            let frames = names(&frames).into_iter().map(str::to_owned).collect();
            Some((version, frames, removed.iter().map(|name| (**name).to_owned()).collect()))
        }
    }
}

#[test]
fn pages_are_in_natural_order() {
    let store = StatusStore::new();
    for number in [10, 9, 1, 100, 2] {
        store.update(view(&format!("a.{number}"), FrameProgress::Queued));
    }
    let page = store.page(None, 3);
    assert_eq!((names(&page.frames), page.total, page.has_more), (vec!["a.1", "a.2", "a.9"], 5, true));
    let page = store.page(Some("a.9"), 3);
    assert_eq!((names(&page.frames), page.has_more), (vec!["a.10", "a.100"], false));
    assert_eq!(names(&store.page(Some("a.5"), 1).frames), ["a.9"]);
    assert!(store.page(Some("b"), 3).frames.is_empty());
}

#[test]
fn frame_with_several_changes_is_returned_once_in_its_current_state() {
    let store = StatusStore::new();
    store.update(view("a", FrameProgress::Waiting));
    store.update(view("b", FrameProgress::Waiting));
    store.update(view("a", FrameProgress::Queued));
    store.stage_began(Path::new("/out/a"), Stage::Smooth);
    store.remove("b");
    let (version, frames, removed) = news(&store, 0).expect("known");
    assert_eq!((version, frames, removed), (store.version(), vec!["a".to_owned()], vec!["b".to_owned()]));
    let frame = store.frame("a").expect("shown");
    assert_eq!((frame.summary.state, frame.summary.stage), (FrameProgress::Working, Some("smooth")));
    assert_eq!(store.status().1, StateCounts { working: 1, ..StateCounts::default() });
    assert_eq!(news(&store, version).expect("known").1, [""; 0]);
}

#[test]
fn update_without_a_difference_is_not_a_change() {
    let store = StatusStore::new();
    store.update(FrameView { figures: Some(Arc::default()), ..view("a", FrameProgress::Done) });
    let version = store.version();
    store.update(view("a", FrameProgress::Done));
    assert_eq!(store.version(), version);
    assert!(store.frame("a").expect("shown").figures.is_some());
    store.update(view("a", FrameProgress::Queued));
    assert!(store.frame("a").expect("shown").figures.is_none());
}

#[test]
fn version_beyond_the_log_returns_lost() {
    let store = StatusStore::new();
    for number in 0..=CHANGES_MAX {
        store.update(view(&number.to_string(), FrameProgress::Queued));
    }
    assert!(news(&store, 0).is_none());
    assert_eq!(news(&store, 1).expect("known").0, 101);
    assert!(news(&store, store.version() + 1).is_none(), "a version of another run");
    let version = store.version();
    store.begin(Value::Null);
    assert!(news(&store, version).is_none());
    assert_eq!(store.page(None, 1).total, 0);
}

#[test]
fn file_finds_only_outputs_of_frames() {
    let store = StatusStore::new();
    store.update(view("a", FrameProgress::Done));
    assert_eq!(store.file("a.glb"), Some("/out/a.glb".into()));
    for name in ["/out/a.glb", "a", "../a.glb", "a.glb/", ""] {
        assert_eq!(store.file(name), None, "{name}");
    }
    store.update(view("a", FrameProgress::Queued));
    assert_eq!(store.file("a.glb"), None);
}

#[test]
fn value_is_counted_in_the_first_bucket_that_contains_it() {
    let mut histogram = Histogram::default();
    for value in [0.0, 0.003, 0.004, 1e9] {
        histogram.add(value);
    }
    assert_eq!((histogram.counts[0], histogram.counts[1], histogram.counts[11]), (2, 1, 1));
}

#[test]
fn forecast_ignores_idle_time() {
    let counts = StateCounts { queued: 6, working: 2, done: 10, failed: 3, ..StateCounts::default() };
    let sample = |at_s: u64, converted: u64, queued: usize| StatusSample {
        at_ms: at_s * 1000,
        waiting: 0,
        queued,
        working: 0,
        failed: 0,
        converted,
        memory_bytes: None,
    };
    // An hour without work, then two frames in ten seconds.
    let samples = [sample(0, 0, 0), sample(3600, 0, 5), sample(3605, 1, 5), sample(3610, 2, 5)];
    let forecast = Forecast::new(&counts, samples.iter());
    assert_eq!(forecast, Forecast { expected_count: 18, seconds_left: Some(40.0) });
    let unknown = Forecast { expected_count: 18, seconds_left: None };
    assert_eq!(Forecast::new(&counts, samples[..2].iter()), unknown);
    let over = StateCounts { done: 10, ..StateCounts::default() };
    let expected = Forecast { expected_count: 10, seconds_left: None };
    assert_eq!(Forecast::new(&over, samples.iter()), expected);
}
