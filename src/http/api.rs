//! The API: frames, settings, status and health as JSON, a stream of changes, and metrics.

use std::fmt::{Display, Write as _};
use std::num::NonZero;
use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::{Path, Query, State};
use axum::http::header::{CONTENT_TYPE, HeaderName};
use axum::http::{HeaderMap, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream::{self, StreamExt};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::sleep;

use crate::watch::status_store::{
    BUCKETS_S, FrameSummary, Histogram, LiveStatus, STAGES, StateCounts, StatusChanges, StatusStore,
};

use super::{ServerState, Shared, not_found};

/// Default number of frames in a page, and the maximum.
const LIMIT: usize = 500;
const LIMIT_MAX: usize = 2000;

#[derive(Deserialize)]
pub(super) struct PageQuery {
    after: Option<String>,
    limit: Option<NonZero<usize>>,
}

#[derive(Serialize)]
struct FramesPage<'a> {
    /// The position in the log of changes from which `/events` continues.
    at: String,
    total: usize,
    frames: Vec<&'a FrameSummary>,
    /// The value of `after` for the next page; null at the end.
    next: Option<&'a str>,
}

/// A page of frames, in natural order: `?after=NAME&limit=N`.
pub(super) async fn frames(State(state): Shared, Query(query): Query<PageQuery>) -> Response {
    let limit = query.limit.map_or(LIMIT, NonZero::get).min(LIMIT_MAX);
    let page = state.store.page(query.after.as_deref(), limit);
    let last = page.frames.last().filter(|_| page.has_more);
    let page = FramesPage {
        at: format!("{}-{}", state.store.run(), page.version),
        total: page.total,
        frames: page.frames.iter().map(|frame| &frame.summary).collect(),
        next: last.map(|frame| &*frame.summary.name),
    };
    Json(page).into_response()
}

/// All details of a frame.
pub(super) async fn frame(State(state): Shared, Path(name): Path<String>) -> Response {
    state.store.frame(&name).map_or_else(not_found, |frame| Json(&*frame).into_response())
}

/// The configuration of the daemon, and the settings of each sequence.
pub(super) async fn settings(State(state): Shared) -> Json<Value> {
    let (daemon, sequences) = state.store.settings();
    Json(json!({ "daemon": *daemon, "sequences": sequences }))
}

/// The current state of the daemon, and its samples of the last quarter of an hour.
pub(super) async fn status(State(state): Shared) -> Json<Value> {
    let store = &state.store;
    let (status, counts) = store.status();
    let counters = store.counters();
    Json(json!({
        "run": store.run(),
        "ready": store.is_ready(),
        "status": status,
        "frames": counts,
        "forecast": store.forecast(),
        "converted": counters.converted,
        "found_done": counters.found_done,
        "failures": counters.failures,
        "retries": counters.retries,
        "scans": counters.scans,
        "rescans": counters.rescans,
        "samples": store.samples(),
    }))
}

/// 200: the daemon runs.
pub(super) async fn health() -> &'static str {
    "ok\n"
}

/// 200 if the first scans are complete, and the daemon is not stopping.
pub(super) async fn readiness(State(state): Shared) -> (StatusCode, &'static str) {
    let (status, _) = state.store.status();
    let why_not = if status.stopping {
        "stopping\n"
    } else if !state.store.is_ready() {
        "starting\n"
    } else {
        return (StatusCode::OK, "ready\n");
    };
    (StatusCode::SERVICE_UNAVAILABLE, why_not)
}

// Server-sent events: streams the changes of the status store.
//
// The server buffers nothing for a subscriber. Each subscriber has a position in the log of changes of the
// status store, and receives the changes since then as fast as it reads. A subscriber that falls so far
// behind that the log no longer holds its next change gets a `resync` event and must reload.

/// The interval at which a subscriber reads the store: the maximum delay of a change.
const EVERY: Duration = Duration::from_millis(100);

/// How long a browser waits before it reconnects.
const RETRY_AFTER: Duration = Duration::from_secs(1);

/// Maximum number of changes in one event.
const CHANGES_MAX: usize = 256;

#[derive(Deserialize)]
pub(super) struct EventsQuery {
    after: Option<String>,
}

struct Subscriber {
    state: Arc<ServerState>,
    /// The position in the log of changes.
    version: u64,
    /// Whether it had all changes when it last read the store.
    is_current: bool,
    _permit: OwnedSemaphorePermit,
}

/// Streams the changes after the position in the request: `Last-Event-ID`, or `?after=`. Without either,
/// streams changes from now on.
pub(super) async fn follow(
    State(state): Shared,
    Query(query): Query<EventsQuery>,
    headers: HeaderMap,
) -> Response {
    let Ok(permit) = Arc::clone(&state.subscribers).try_acquire_owned() else {
        return (StatusCode::SERVICE_UNAVAILABLE, "too many subscribers\n").into_response();
    };
    let (run, now) = (state.store.run(), state.store.version());
    let header = headers.get("last-event-id").and_then(|id| id.to_str().ok());
    let seen = header.or(query.after.as_deref());
    // An id of another run is not a position in this run. It counts as beyond the end of the log: the client
    // gets a `resync` event.
    let version = seen.map_or(Some(now), |id| position(id, run));
    // It contains the position, so a client that loses the connection at once can resume.
    let hello = version.map(|version| {
        Event::default().retry(RETRY_AFTER).id(format!("{run}-{version}")).event("hello").data("{}")
    });
    let subscriber =
        Subscriber { state, version: version.unwrap_or(u64::MAX), is_current: false, _permit: permit };
    let changes = stream::unfold(subscriber, |mut subscriber| async move {
        let event = subscriber.next().await?;
        Some((event, subscriber))
    });
    // A comment every 15 seconds detects clients that have disconnected.
    Sse::new(stream::iter(hello.map(Ok)).chain(changes)).keep_alive(KeepAlive::default()).into_response()
}

impl Subscriber {
    /// Waits for the next change; returns `None` when the server closes.
    async fn next(&mut self) -> Option<Result<Event, axum::Error>> {
        let ServerState { store, closing, .. } = &*self.state;
        loop {
            if self.is_current {
                sleep(EVERY).await;
            }
            // Before the store is read: a server that closes has published its last status.
            let is_closing = *closing.borrow();
            if self.version != store.version() {
                let (version, event) = event_after(store, self.version);
                self.version = version;
                self.is_current = version == store.version();
                return Some(event);
            }
            if is_closing {
                return None;
            }
            self.is_current = true;
        }
    }
}

/// The data of a `change` event.
#[derive(Serialize)]
struct ChangeData<'a> {
    frames: Vec<&'a FrameSummary>,
    removed: Vec<Arc<str>>,
    status: Option<Arc<LiveStatus>>,
    settings: bool,
    counts: StateCounts,
}

/// The event with the changes after a version, and the version to continue from.
fn event_after(store: &StatusStore, version: u64) -> (u64, Result<Event, axum::Error>) {
    let event = |version| Event::default().id(format!("{}-{version}", store.run()));
    match store.changes_since(version, CHANGES_MAX) {
        StatusChanges::Lost(version) => (version, Ok(event(version).event("resync").data("{}"))),
        StatusChanges::Known { version, frames, removed, status, settings } => {
            let frames = frames.iter().map(|frame| &frame.summary).collect();
            let data = ChangeData { frames, removed, status, settings, counts: store.status().1 };
            (version, event(version).event("change").json_data(data))
        }
    }
}

/// The version in an event id, if the id is of this run.
fn position(id: &str, run: u64) -> Option<u64> {
    let (of_run, version) = id.split_once('-')?;
    version.parse().ok().filter(|_| of_run.parse() == Ok(run))
}

// Exports metrics in the Prometheus text format.
//
// The format is written by hand: a dozen metrics do not need a registry.

/// The response with all metrics.
pub(super) async fn metrics(State(state): Shared) -> ([(HeaderName, &'static str); 1], String) {
    ([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], exposition(&state.store))
}

fn exposition(store: &StatusStore) -> String {
    let (status, counts) = store.status();
    let counters = store.counters();
    let mut text = MetricsText(String::new());
    let version = concat!("version=\"", env!("CARGO_PKG_VERSION"), "\"");
    text.head("meniscus_build_info", "gauge", "Build information: the version is a label, the value is 1.");
    text.value("meniscus_build_info", version, 1);
    text.frames(&counts);
    let unavailable_count = status.unavailable.len() as u64;
    for (name, help, value) in [
        ("meniscus_queue_depth", "Frames in the queue.", Some(counts.queued as u64)),
        (
            "meniscus_paused",
            "1 while the daemon is paused: an output disk is full or refuses writes.",
            Some(u64::from(status.paused.is_some())),
        ),
        ("meniscus_unavailable_folders", "Watched folders that are unavailable.", Some(unavailable_count)),
        (
            "meniscus_disk_free_bytes",
            "The least free space of all file systems of outputs.",
            status.disk_free_bytes,
        ),
        ("meniscus_resident_memory_bytes", "Resident memory of the process.", status.memory_bytes),
        ("meniscus_frames_converted_total", "Frames that were converted.", Some(counters.converted)),
        (
            "meniscus_frames_found_done_total",
            "Frames that were done when they were read.",
            Some(counters.found_done),
        ),
        ("meniscus_failures_total", "Failures that are not retried.", Some(counters.failures)),
        ("meniscus_retries_total", "Failures that are retried.", Some(counters.retries)),
        ("meniscus_scans_total", "Full scans of a watched folder.", Some(counters.scans)),
        ("meniscus_rescans_total", "Full scans because events were lost.", Some(counters.rescans)),
        ("meniscus_input_bytes_total", "Bytes of converted input files.", Some(counters.input_bytes)),
        ("meniscus_output_bytes_total", "Bytes of written outputs.", Some(counters.output_bytes)),
    ] {
        if let Some(value) = value {
            text.head(name, if name.ends_with("_total") { "counter" } else { "gauge" }, help);
            text.value(name, "", value);
        }
    }
    text.stages(&counters.stages);
    text.0
}

struct MetricsText(String);

impl MetricsText {
    fn head(&mut self, name: &str, kind: &str, help: &str) {
        // Writing to a string cannot fail.
        let _ = write!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}\n");
    }

    fn value(&mut self, name: &str, labels: &str, value: impl Display) {
        let _ = match labels {
            "" => writeln!(self.0, "{name} {value}"),
            labels => writeln!(self.0, "{name}{{{labels}}} {value}"),
        };
    }

    fn frames(&mut self, counts: &StateCounts) {
        self.head("meniscus_frames", "gauge", "Frames by state.");
        let StateCounts { waiting, queued, working, retrying, done, failed } = *counts;
        for (state, count) in [
            ("waiting", waiting),
            ("queued", queued),
            ("working", working),
            ("retrying", retrying),
            ("done", done),
            ("failed", failed),
        ] {
            self.value("meniscus_frames", &format!("state=\"{state}\""), count);
        }
    }

    fn stages(&mut self, stages: &[Histogram]) {
        const NAME: &str = "meniscus_stage_duration_seconds";
        self.head(NAME, "histogram", "Seconds that each converted frame spent in a stage.");
        for (stage, histogram) in STAGES.iter().zip(stages) {
            let mut count = 0;
            let ends = BUCKETS_S.iter().map(f64::to_string).chain(["+Inf".to_owned()]);
            for (end, in_bucket) in ends.zip(histogram.counts) {
                count += in_bucket;
                self.value(&format!("{NAME}_bucket"), &format!("stage=\"{stage}\",le=\"{end}\""), count);
            }
            self.value(&format!("{NAME}_sum"), &format!("stage=\"{stage}\""), histogram.sum);
            self.value(&format!("{NAME}_count"), &format!("stage=\"{stage}\""), count);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::watch::status_store::{Counters, Figures};

    #[test]
    fn id_of_another_run_is_not_a_position() {
        assert_eq!(position("7-12", 7), Some(12));
        for wrong in ["8-12", "12", "7-", "7-x", "", "-"] {
            assert_eq!(position(wrong, 7), None, "{wrong}");
        }
    }

    #[test]
    fn buckets_are_cumulative() {
        let store = StatusStore::new();
        let mut figures = Figures::default();
        let mut counters = Counters::default();
        for seconds in [0.002, 2.0, 500.0] {
            figures.seconds.smooth = seconds;
            counters.add_converted(&figures, 10, 20);
        }
        store.set_counters(counters);
        let text = exposition(&store);
        for line in [
            "meniscus_frames{state=\"done\"} 0",
            "meniscus_frames_converted_total 3",
            "meniscus_output_bytes_total 60",
            "meniscus_stage_duration_seconds_bucket{stage=\"smooth\",le=\"0.003\"} 1",
            "meniscus_stage_duration_seconds_bucket{stage=\"smooth\",le=\"3\"} 2",
            "meniscus_stage_duration_seconds_bucket{stage=\"smooth\",le=\"+Inf\"} 3",
            "meniscus_stage_duration_seconds_sum{stage=\"smooth\"} 502.002",
            "meniscus_stage_duration_seconds_count{stage=\"read\"} 3",
        ] {
            assert!(text.lines().any(|other| other == line), "no {line} in\n{text}");
        }
    }

    #[test]
    fn every_metric_is_preceded_by_its_help_and_type() {
        let text = exposition(&StatusStore::new());
        let mut known = Vec::new();
        for line in text.lines() {
            match line.strip_prefix("# TYPE ") {
                Some(head) => known.push(head.split(' ').next().unwrap_or_default().to_owned()),
                None if line.starts_with("# HELP ") => {}
                None => {
                    let name = line.split(['{', ' ']).next().unwrap_or_default();
                    assert!(known.last().is_some_and(|head| name.starts_with(&**head)), "{line}");
                }
            }
        }
        assert!(text.ends_with('\n') && known.len() > 10);
    }
}
