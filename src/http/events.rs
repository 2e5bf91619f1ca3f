//! Server-sent events: streams the changes of the status store.
//!
//! The server buffers nothing for a subscriber. Each subscriber has a position in the log of changes of the
//! status store, and receives the changes since then as fast as it reads. A subscriber that falls so far
//! behind that the log no longer holds its next change gets a `resync` event and must reload.
//!
//! All subscribers read the store at the same ticks. Those that keep up are then at the same position, and
//! the event for it is serialized once for all of them.

use std::fmt::Write as _;
use std::io;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use hyper::body::Bytes;
use hyper::{Request, StatusCode};
use serde_json::json;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep_until};

use crate::watch::status_store::{FrameSummary, StatusChanges, StatusStore};

use super::ServerState;
use super::answer::{Answer, ResponseBody, answer, text};
use super::query::value_of;

/// All subscribers.
#[derive(Debug)]
pub(super) struct Subscribers {
    count: AtomicUsize,
    /// The start of the ticks at which subscribers read the store.
    since: Instant,
    last: Mutex<Option<LastEvent>>,
}

/// The event that was serialized last.
#[derive(Clone, Debug)]
struct LastEvent {
    /// The event holds the changes after this version.
    after: u64,
    /// The version of the store when the event was serialized.
    store_version: u64,
    /// The position after this event.
    next: u64,
    text: Bytes,
}

/// Counts as a subscriber until it is dropped.
struct Subscriber(Arc<ServerState>);

/// Maximum number of subscribers; further ones are refused.
const SUBSCRIBERS_MAX: usize = 256;

/// The interval of ticks: the maximum delay of a change.
const EVERY: Duration = Duration::from_millis(100);

/// The interval at which a comment is sent to detect clients that have disconnected.
const HEARTBEAT_EVERY: Duration = Duration::from_secs(15);

/// Maximum number of changes in one event.
const CHANGES_MAX: usize = 256;

/// Streams the changes after the position in the request: `Last-Event-ID`, or `?after=`. Without either,
/// streams changes from now on.
pub(super) fn follow<B>(shared: &Arc<ServerState>, request: &Request<B>) -> Answer {
    let Some(subscriber) = Subscriber::new(shared) else {
        return text(StatusCode::SERVICE_UNAVAILABLE, "too many subscribers");
    };
    let header = request.headers().get("last-event-id").and_then(|id| id.to_str().ok().map(str::to_owned));
    let seen = header.or_else(|| value_of(request.uri().query(), "after"));
    let (sender, chunks) = mpsc::channel(1);
    if request.method() == hyper::Method::GET {
        tokio::spawn(send_events(subscriber, seen, sender));
    }
    answer(StatusCode::OK, "text/event-stream", ResponseBody::chunks(chunks, None))
}

/// Sends events until the client disconnects, or the server stops.
async fn send_events(subscriber: Subscriber, seen: Option<String>, sender: mpsc::Sender<io::Result<Bytes>>) {
    let ServerState { store, closing, subscribers, .. } = &*subscriber.0;
    let mut version = match seen.as_deref() {
        // The `hello` event below contains this version, so a client that loses the connection at once can
        // resume.
        None => store.version(),
        // An id of another run is not a position in this run. It counts as beyond the end of the log: the
        // client gets a `resync` event.
        Some(id) => position(id, store.run()).unwrap_or(u64::MAX),
    };
    let hello = format!("retry: 1000\nid: {}-{version}\nevent: hello\ndata: {{}}\n\n", store.run());
    if version != u64::MAX && sender.send(Ok(hello.into())).await.is_err() {
        return;
    }
    let mut sent_at = Instant::now();
    loop {
        // Before the store is read: a server that closes has published its last status.
        let is_closing = *closing.borrow();
        let text = match version == store.version() {
            true if sent_at.elapsed() < HEARTBEAT_EVERY => Bytes::new(),
            true => Bytes::from_static(b":\n\n"),
            false => {
                let last_event = subscribers.event_after(store, version);
                version = last_event.next;
                last_event.text
            }
        };
        if !text.is_empty() {
            sent_at = Instant::now();
            if sender.send(Ok(text)).await.is_err() {
                return;
            }
        }
        // The body, which holds the receiver, is dropped when the connection ends.
        if sender.is_closed() {
            return;
        }
        if version == store.version() {
            if is_closing {
                return;
            }
            sleep_until(subscribers.next_look()).await;
        }
    }
}

/// Returns the changes after a version as an event, and the version to continue from.
fn event(store: &StatusStore, version: u64) -> (u64, String) {
    let (version, kind, data) = match store.changes_since(version, CHANGES_MAX) {
        StatusChanges::Lost(version) => (version, "resync", json!({})),
        StatusChanges::Known { version, frames, removed, status, settings } => {
            let summaries: Vec<&FrameSummary> = frames.iter().map(|frame| &frame.summary).collect();
            let data = json!({
                "frames": summaries,
                "removed": removed,
                "status": status,
                "settings": settings,
                "counts": store.status().1,
            });
            (version, "change", data)
        }
    };
    let mut text = String::new();
    // Writing to a string cannot fail. A `data` line must not contain line breaks, and this JSON contains
    // none.
    let _ = write!(text, "id: {}-{version}\nevent: {kind}\ndata: {data}\n\n", store.run());
    (version, text)
}

/// The version in an event id, if the id is of this run.
fn position(id: &str, run: u64) -> Option<u64> {
    let (of_run, version) = id.split_once('-')?;
    version.parse().ok().filter(|_| of_run.parse() == Ok(run))
}

impl Default for Subscribers {
    fn default() -> Subscribers {
        Subscribers { count: AtomicUsize::new(0), since: Instant::now(), last: Mutex::new(None) }
    }
}

impl Subscribers {
    /// The next tick.
    fn next_look(&self) -> Instant {
        let looks = self.since.elapsed().as_millis() / EVERY.as_millis() + 1;
        self.since + EVERY.saturating_mul(u32::try_from(looks).unwrap_or(u32::MAX))
    }

    /// The event with the changes after a version. Reuses the last event if it is still current.
    fn event_after(&self, store: &StatusStore, version: u64) -> LastEvent {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        let store_version = store.version();
        if let Some(last_event) = &*last
            && (last_event.after, last_event.store_version) == (version, store_version)
        {
            return last_event.clone();
        }
        let (next, text) = event(store, version);
        let last_event = LastEvent { after: version, store_version, next, text: text.into() };
        last.insert(last_event).clone()
    }
}

impl Subscriber {
    fn new(shared: &Arc<ServerState>) -> Option<Subscriber> {
        let subscribers = &shared.subscribers.count;
        // Dropping it decrements the count, even if the limit was exceeded.
        let subscriber = Subscriber(Arc::clone(shared));
        (subscribers.fetch_add(1, Ordering::Relaxed) < SUBSCRIBERS_MAX).then_some(subscriber)
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        self.0.subscribers.count.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::watch::status_store::LiveStatus;

    #[test]
    fn id_of_another_run_is_not_a_position() {
        assert_eq!(position("7-12", 7), Some(12));
        for wrong in ["8-12", "12", "7-", "7-x", "", "-"] {
            assert_eq!(position(wrong, 7), None, "{wrong}");
        }
    }

    #[test]
    fn subscriber_beyond_the_log_gets_resync() {
        let store = StatusStore::new();
        store.begin(json!({}));
        let (version, text) = event(&store, u64::MAX);
        assert_eq!(version, store.version());
        assert!(text.contains("event: resync\n") && text.ends_with("\n\n"), "{text}");
    }
    #[test]
    fn subscribers_at_the_same_position_share_one_serialized_event() {
        let store = StatusStore::new();
        store.begin(json!({}));
        store.set_status(LiveStatus { stopping: true, ..LiveStatus::default() });
        let subscribers = Subscribers::default();
        let [first, second] = [1, 1].map(|version| subscribers.event_after(&store, version));
        assert_eq!(first.text.as_ptr(), second.text.as_ptr(), "one shared buffer, not two equal ones");
        assert!(first.text.starts_with(b"id: ") && first.next == store.version(), "{first:?}");
        let other = subscribers.event_after(&store, 0);
        assert_ne!(other.text, first.text, "another position");
        store.set_status(LiveStatus::default());
        let later = subscribers.event_after(&store, 1);
        assert_eq!((later.after, later.next), (1, store.version()));
        assert_ne!(later.text, first.text, "there are more changes");
    }
}
