//! The JSON API: frames, settings and the state of the daemon.

use hyper::StatusCode;
use serde::Serialize;
use serde_json::json;

use crate::watch::status_store::{FrameSummary, StatusStore};

use super::answer::{Answer, json, not_found, text};
use super::query::value_of;

/// Default number of frames in a page, and the maximum.
const LIMIT: usize = 500;
const LIMIT_MAX: usize = 2000;

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
pub(super) fn frames(store: &StatusStore, query: Option<&str>) -> Answer {
    let after = value_of(query, "after");
    let limit = match value_of(query, "limit").map(|limit| limit.parse::<usize>()) {
        None => LIMIT,
        Some(Ok(limit @ 1..)) => limit.min(LIMIT_MAX),
        Some(_) => return text(StatusCode::BAD_REQUEST, "limit must be a whole number of at least 1"),
    };
    let page = store.page(after.as_deref(), limit);
    let last = page.frames.last().filter(|_| page.has_more);
    json(&FramesPage {
        at: format!("{}-{}", store.run(), page.version),
        total: page.total,
        frames: page.frames.iter().map(|frame| &frame.summary).collect(),
        next: last.map(|frame| &*frame.summary.name),
    })
}

/// All details of a frame.
pub(super) fn frame(store: &StatusStore, name: &str) -> Answer {
    store.frame(name).map_or_else(not_found, |frame| json(&*frame))
}

/// The configuration of the daemon, and the settings of each sequence.
pub(super) fn settings(store: &StatusStore) -> Answer {
    let (daemon, sequences) = store.settings();
    json(&json!({ "daemon": *daemon, "sequences": sequences }))
}

/// The current state of the daemon, and its samples of the last quarter of an hour.
pub(super) fn status(store: &StatusStore) -> Answer {
    let (status, counts) = store.status();
    let counters = store.counters();
    json(&json!({
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

/// 200 unless the daemon is stuck.
pub(super) fn health(store: &StatusStore) -> Answer {
    match store.is_alive() {
        true => text(StatusCode::OK, "ok"),
        false => text(StatusCode::SERVICE_UNAVAILABLE, "the daemon has not responded for 30 seconds"),
    }
}

/// 200 if the first scans are complete, and the daemon is neither stopping nor stuck.
pub(super) fn readiness(store: &StatusStore) -> Answer {
    let (status, _) = store.status();
    match (store.is_ready(), status.stopping, store.is_alive()) {
        (true, false, true) => text(StatusCode::OK, "ready"),
        (_, true, _) => text(StatusCode::SERVICE_UNAVAILABLE, "stopping"),
        (false, ..) => text(StatusCode::SERVICE_UNAVAILABLE, "starting"),
        (_, _, false) => text(StatusCode::SERVICE_UNAVAILABLE, "stuck"),
    }
}
