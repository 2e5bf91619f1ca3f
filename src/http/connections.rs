//! Which connections are idle, and which of them is closed when there is no room for a new one.
//!
//! ```text
//!   accepted ──▶ idle ──a whole request head──▶ busy ──answer sent──▶ idle ──▶ …
//!                 │                                                    │
//!                 └──────── full: the one idle for longest closes ─────┘
//! ```
//!
//! A connection whose request head is incomplete counts as idle, so that slow senders cannot keep their places. A
//! connection with an answer under way, such as a subscriber of events, is never closed for others.

use std::collections::BTreeMap;
use std::future::{Future, poll_fn};
use std::pin::pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::Poll;

use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};

/// All open connections.
#[derive(Debug)]
pub(super) struct Connections {
    room: Arc<Semaphore>,
    places_max: usize,
    /// When more than this many are busy, only health checks are answered.
    busy_max: usize,
    idle: Mutex<Idle>,
    /// Some connection has become idle.
    became_idle: Notify,
}

#[derive(Debug, Default)]
struct Idle {
    /// What closes each idle connection; the key grows with the time at which it became idle.
    by_age: BTreeMap<u64, Arc<Notify>>,
    next_key: u64,
    busy_count: usize,
}

/// One of them. Its place is free again when it is dropped.
#[derive(Debug)]
pub(super) struct Connection {
    all: Arc<Connections>,
    state: Mutex<ConnectionState>,
    closing: Arc<Notify>,
    _place: OwnedSemaphorePermit,
}

#[derive(Clone, Copy, Debug)]
enum ConnectionState {
    /// Waits for a request, under this key.
    Idle(u64),
    /// A request is answered.
    Busy,
    /// All of an answer was produced, and some of it may not be sent yet.
    Flushing,
}

/// An answer under way. When it is dropped, its connection is busy until the rest of the answer is sent.
#[derive(Debug)]
pub(super) struct Answering(Arc<Connection>);

impl Connections {
    pub(super) fn new(places_max: usize, busy_max: usize) -> Connections {
        Connections {
            room: Arc::new(Semaphore::new(places_max)),
            places_max,
            busy_max,
            idle: Mutex::default(),
            became_idle: Notify::new(),
        }
    }

    /// A place for a new connection. Where all are taken, the connection that is idle for longest is closed for it;
    /// where none is idle, this waits for one.
    pub(super) async fn add(self: &Arc<Self>) -> Connection {
        let place = loop {
            if let Ok(place) = Arc::clone(&self.room).try_acquire_owned() {
                break place;
            }
            let is_closing = self.close_oldest_idle();
            let mut place = pin!(Arc::clone(&self.room).acquire_owned());
            let mut became_idle = pin!(self.became_idle.notified());
            let first = poll_fn(|context| match place.as_mut().poll(context) {
                Poll::Ready(place) => Poll::Ready(place.ok()),
                Poll::Pending if is_closing => Poll::Pending,
                Poll::Pending => became_idle.as_mut().poll(context).map(|()| None),
            });
            if let Some(place) = first.await {
                break place;
            }
        };
        let closing = Arc::new(Notify::new());
        let key = self.lock().insert(&closing);
        let state = Mutex::new(ConnectionState::Idle(key));
        Connection { all: Arc::clone(self), state, closing, _place: place }
    }

    /// Whether so many are busy that the places left are for health checks.
    pub(super) fn is_crowded(&self) -> bool {
        self.lock().busy_count > self.busy_max
    }

    /// Waits until all connections have ended.
    pub(super) async fn all_ended(&self) {
        let _ = self.room.acquire_many(u32::try_from(self.places_max).unwrap_or(u32::MAX)).await;
    }

    /// Returns whether there was one.
    fn close_oldest_idle(&self) -> bool {
        let oldest = self.lock().by_age.pop_first();
        if let Some((_, closing)) = &oldest {
            closing.notify_one();
        }
        oldest.is_some()
    }

    /// Each update is complete before the lock is released, so a poisoned one is still consistent.
    fn lock(&self) -> MutexGuard<'_, Idle> {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Idle {
    fn insert(&mut self, closing: &Arc<Notify>) -> u64 {
        self.next_key += 1;
        self.by_age.insert(self.next_key, Arc::clone(closing));
        self.next_key
    }
}

impl Connection {
    /// A request has arrived.
    pub(super) fn begin(self: &Arc<Self>) -> Answering {
        let mut state = self.state();
        let mut all = self.all.lock();
        // While the answer before this one is being sent, it counts as busy already.
        if let ConnectionState::Idle(key) = *state {
            all.by_age.remove(&key);
            all.busy_count += 1;
        }
        *state = ConnectionState::Busy;
        Answering(Arc::clone(self))
    }

    /// All that was produced so far is with the system.
    pub(super) fn flushed(&self) {
        let mut state = self.state();
        if matches!(*state, ConnectionState::Flushing) {
            let mut all = self.all.lock();
            all.busy_count -= 1;
            *state = ConnectionState::Idle(all.insert(&self.closing));
            drop(all);
            self.all.became_idle.notify_one();
        }
    }

    /// Waits until the connection is to make room for another.
    pub(super) async fn is_to_close(&self) {
        self.closing.notified().await;
    }

    fn state(&self) -> MutexGuard<'_, ConnectionState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        let state = *self.state();
        let mut all = self.all.lock();
        match state {
            ConnectionState::Idle(key) => drop(all.by_age.remove(&key)),
            ConnectionState::Busy | ConnectionState::Flushing => all.busy_count -= 1,
        }
    }
}

impl Drop for Answering {
    fn drop(&mut self) {
        *self.0.state() = ConnectionState::Flushing;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::task::{Context, Waker};

    /// Polls once.
    fn now<T>(future: impl Future<Output = T>) -> Option<T> {
        match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(value) => Some(value),
            Poll::Pending => None,
        }
    }

    fn add(all: &Arc<Connections>) -> Arc<Connection> {
        Arc::new(now(all.add()).expect("a place"))
    }

    #[test]
    fn full_house_closes_the_connection_that_is_idle_for_longest() {
        let all = Arc::new(Connections::new(3, 2));
        let [first, second, third] = [(); 3].map(|()| add(&all));
        // The first is busy, and when its answer is sent the youngest of the idle ones.
        let answering = first.begin();
        let mut fourth = Box::pin(all.add());
        assert!(now(fourth.as_mut()).is_none(), "there is no place before another has ended");
        assert!(now(second.is_to_close()).is_some());
        drop(second);
        let fourth = now(fourth).expect("the place of the second");
        drop(answering);
        first.flushed();
        let mut fifth = Box::pin(all.add());
        assert!(now(fifth.as_mut()).is_none());
        assert!(now(third.is_to_close()).is_some());
        assert!(now(first.is_to_close()).is_none());
        drop((third, fourth));
        assert!(now(fifth).is_some());
    }

    #[test]
    fn busy_connection_is_closed_for_another_only_after_its_answer_is_sent() {
        let all = Arc::new(Connections::new(1, 1));
        let only = add(&all);
        let answering = only.begin();
        let mut next = Box::pin(all.add());
        assert!(now(next.as_mut()).is_none());
        drop(answering);
        assert!(now(next.as_mut()).is_none());
        assert!(now(only.is_to_close()).is_none(), "the answer may still be on its way");
        only.flushed();
        assert!(now(next.as_mut()).is_none());
        assert!(now(only.is_to_close()).is_some());
        drop(only);
        assert!(now(next).is_some());
    }

    #[test]
    fn only_busy_connections_make_a_crowd() {
        let all = Arc::new(Connections::new(4, 2));
        let connections = [(); 4].map(|()| add(&all));
        assert!(!all.is_crowded());
        let mut answering: Vec<Answering> = connections[..3].iter().map(Connection::begin).collect();
        assert!(all.is_crowded());
        answering.pop();
        assert!(all.is_crowded(), "some of the answer may not be sent yet");
        connections[2].flushed();
        assert!(!all.is_crowded());
        let again = connections[2].begin();
        assert!(all.is_crowded());
        drop((again, answering, connections));
        assert_eq!(all.lock().busy_count, 0, "all connections have ended");
    }
}
