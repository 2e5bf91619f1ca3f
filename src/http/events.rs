//! Server-sent events: streams the changes of the status store.
//!
//! The server buffers nothing for a subscriber. Each subscriber has a position in the log of changes of the
//! status store, and receives the changes since then as fast as it reads. A subscriber that falls so far
//! behind that the log no longer holds its next change gets a `resync` event and must reload.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::{Query, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream::{self, StreamExt};
use serde::{Deserialize, Serialize};
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::sleep;

use crate::watch::status_store::{FrameSummary, LiveStatus, StateCounts, StatusChanges, StatusStore};

use super::{ServerState, Shared};

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn id_of_another_run_is_not_a_position() {
        assert_eq!(position("7-12", 7), Some(12));
        for wrong in ["8-12", "12", "7-", "7-x", "", "-"] {
            assert_eq!(position(wrong, 7), None, "{wrong}");
        }
    }
}
