//! Server-sent events: changes as they come.
//!
//! Nothing is kept for a subscriber. Each has a position in the log of changes of the status store, and gets what has
//! changed since, as fast as it takes it. A subscriber that falls behind the end of the log gets a `resync` event and must
//! reload.
//!
//! All subscribers read the store at the same moments. Those that keep up are then at the same position, and the event
//! after it is serialized once for all of them.

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
    /// From here on the moments are counted at which they read the store.
    since: Instant,
    last: Mutex<Option<LastEvent>>,
}

/// The event that was sent last.
#[derive(Clone, Debug)]
struct LastEvent {
    /// What has happened after this version.
    after: u64,
    /// That of the store when the event was serialized.
    store_version: u64,
    /// What happens after this version is not in it.
    next: u64,
    text: Bytes,
}

/// A subscriber, until it is dropped.
struct Subscriber(Arc<ServerState>);

/// More than this are refused.
const SUBSCRIBERS_MAX: usize = 256;

/// How soon a change is sent.
const EVERY: Duration = Duration::from_millis(100);

/// A comment is sent so often, to find out which clients are gone.
const PULSE: Duration = Duration::from_secs(15);

/// As many changes are in one event.
const CHANGES_MAX: usize = 256;

/// The changes after those that the request has seen, by `Last-Event-ID` or `?after=`; without either, those from now
/// on.
pub(super) fn follow<B>(shared: &Arc<ServerState>, request: &Request<B>) -> Answer {
    let Some(subscriber) = Subscriber::new(shared) else {
        return text(StatusCode::SERVICE_UNAVAILABLE, "too many follow already");
    };
    let header = request.headers().get("last-event-id").and_then(|id| id.to_str().ok().map(str::to_owned));
    let seen = header.or_else(|| value_of(request.uri().query(), "after"));
    let (sender, pieces) = mpsc::channel(1);
    if request.method() == hyper::Method::GET {
        tokio::spawn(send_events(subscriber, seen, sender));
    }
    answer(StatusCode::OK, "text/event-stream", ResponseBody::pieces(pieces, None))
}

/// Sends events until the client is gone, or the server stops.
async fn send_events(subscriber: Subscriber, seen: Option<String>, sender: mpsc::Sender<io::Result<Bytes>>) {
    let ServerState { store, closing, subscribers, .. } = &*subscriber.0;
    let mut version = match seen.as_deref() {
        // So that whoever loses the connection at once has something to go on from.
        None => store.version(),
        // An id of another run is no place in this one: it is beyond the end.
        Some(id) => place(id, store.run()).unwrap_or(u64::MAX),
    };
    let hello = format!("retry: 1000\nid: {}-{version}\nevent: hello\ndata: {{}}\n\n", store.run());
    if version != u64::MAX && sender.send(Ok(hello.into())).await.is_err() {
        return;
    }
    let mut told_at = Instant::now();
    while !*closing.borrow() {
        let text = match version == store.version() {
            true if told_at.elapsed() < PULSE => Bytes::new(),
            true => Bytes::from_static(b":\n\n"),
            false => {
                let told = subscribers.event_after(store, version);
                version = told.next;
                told.text
            }
        };
        if !text.is_empty() {
            told_at = Instant::now();
            if sender.send(Ok(text)).await.is_err() {
                return;
            }
        }
        // A client that is gone is noticed at the next event.
        if sender.is_closed() {
            return;
        }
        if version == store.version() {
            sleep_until(subscribers.next_look()).await;
        }
    }
}

/// What happened after a version, and the version after that.
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
    // Strings take everything; JSON has no line breaks.
    let _ = write!(text, "id: {}-{version}\nevent: {kind}\ndata: {data}\n\n", store.run());
    (version, text)
}

/// The version in an id of this run.
fn place(id: &str, run: u64) -> Option<u64> {
    let (of_run, version) = id.split_once('-')?;
    version.parse().ok().filter(|_| of_run.parse() == Ok(run))
}

impl Default for Subscribers {
    fn default() -> Subscribers {
        Subscribers { count: AtomicUsize::new(0), since: Instant::now(), last: Mutex::new(None) }
    }
}

impl Subscribers {
    /// When all read the store again.
    fn next_look(&self) -> Instant {
        let looks = self.since.elapsed().as_millis() / EVERY.as_millis() + 1;
        self.since + EVERY.saturating_mul(u32::try_from(looks).unwrap_or(u32::MAX))
    }

    /// What happened after a version; in the words of the last who asked, where these are still true.
    fn event_after(&self, store: &StatusStore, version: u64) -> LastEvent {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        let store_version = store.version();
        if let Some(told) = &*last
            && (told.after, told.store_version) == (version, store_version)
        {
            return told.clone();
        }
        let (next, text) = event(store, version);
        let told = LastEvent { after: version, store_version, next, text: text.into() };
        last.insert(told).clone()
    }
}

impl Subscriber {
    fn new(shared: &Arc<ServerState>) -> Option<Subscriber> {
        let subscribers = &shared.subscribers.count;
        // Dropping it takes it back, also where it is one too many.
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
    fn places_are_of_one_run() {
        assert_eq!(place("7-12", 7), Some(12));
        for wrong in ["8-12", "12", "7-", "7-x", "", "-"] {
            assert_eq!(place(wrong, 7), None, "{wrong}");
        }
    }

    #[test]
    fn who_is_too_late_is_told_to_look_again() {
        let store = StatusStore::new();
        store.begin(json!({}));
        let (version, text) = event(&store, u64::MAX);
        assert_eq!(version, store.version());
        assert!(text.contains("event: resync\n") && text.ends_with("\n\n"), "{text}");
    }
    #[test]
    fn those_at_the_same_place_are_told_the_same_words() {
        let store = StatusStore::new();
        store.begin(json!({}));
        store.set_status(LiveStatus { stopping: true, ..LiveStatus::default() });
        let subscribers = Subscribers::default();
        let [first, second] = [1, 1].map(|version| subscribers.event_after(&store, version));
        assert_eq!(first.text.as_ptr(), second.text.as_ptr(), "the same bytes, and not equal ones");
        assert!(first.text.starts_with(b"id: ") && first.next == store.version(), "{first:?}");
        let other = subscribers.event_after(&store, 0);
        assert_ne!(other.text, first.text, "that is another place");
        store.set_status(LiveStatus::default());
        let later = subscribers.event_after(&store, 1);
        assert_eq!((later.after, later.next), (1, store.version()));
        assert_ne!(later.text, first.text, "more has happened");
    }
}
