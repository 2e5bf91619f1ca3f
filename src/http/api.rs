//! The JSON API: frames, settings and the state of the daemon; and whether it is healthy.

use std::num::NonZero;

use axum::Json;
use axum::extract::{Path, Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::watch::status_store::FrameSummary;

use super::{Shared, not_found};

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

/// 200 unless the daemon is stuck.
pub(super) async fn health(State(state): Shared) -> (StatusCode, &'static str) {
    if state.store.is_alive() {
        (StatusCode::OK, "ok\n")
    } else {
        (StatusCode::SERVICE_UNAVAILABLE, "the daemon has not responded for 30 seconds\n")
    }
}

/// 200 if the first scans are complete, and the daemon is neither stopping nor stuck.
pub(super) async fn readiness(State(state): Shared) -> (StatusCode, &'static str) {
    let (status, _) = state.store.status();
    let why_not = if status.stopping {
        "stopping\n"
    } else if !state.store.is_ready() {
        "starting\n"
    } else if !state.store.is_alive() {
        "stuck\n"
    } else {
        return (StatusCode::OK, "ready\n");
    };
    (StatusCode::SERVICE_UNAVAILABLE, why_not)
}
