//! Keeps track of idle connections, and closes the oldest one when a new connection needs its slot.
//!
//! ```text
//!   accepted ──▶ idle ──a whole request head──▶ busy ──answer sent──▶ idle ──▶ …
//!                 │                                                    │
//!                 └──────── full: the one idle for longest closes ─────┘
//! ```
//!
//! A connection whose request head is incomplete counts as idle, so slow senders cannot occupy slots. A
//! connection whose response is in progress, such as a subscriber of events, is never closed for a new one.

use std::collections::BTreeMap;
use std::future::{Future, poll_fn};
use std::pin::pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::Poll;

use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};

/// All open connections.
#[derive(Debug)]
pub(super) struct Connections {
    permits: Arc<Semaphore>,
    connections_max: usize,
    /// When more than this many are busy, only health checks are answered.
    busy_max: usize,
    idle: Mutex<Idle>,
    /// Notified when a connection becomes idle.
    became_idle: Notify,
}

#[derive(Debug, Default)]
struct Idle {
    /// The signals that close the idle connections. Keys ascend in the order in which connections became
    /// idle.
    by_age: BTreeMap<u64, Arc<Notify>>,
    next_key: u64,
    busy_count: usize,
}

/// One connection. Dropping it frees its slot.
#[derive(Debug)]
pub(super) struct Connection {
    all: Arc<Connections>,
    state: Mutex<ConnectionState>,
    closing: Arc<Notify>,
    _permit: OwnedSemaphorePermit,
}

#[derive(Clone, Copy, Debug)]
enum ConnectionState {
    /// Waiting for a request. The number is the connection's key in `Idle::by_age`.
    Idle(u64),
    /// A request is being answered.
    Busy,
    /// The response is complete, but part of it may not be sent yet.
    Flushing,
}

/// A response in progress. When it is dropped, the connection stays busy until the rest of the response is
/// sent.
#[derive(Debug)]
pub(super) struct Answering(Arc<Connection>);

impl Connections {
    pub(super) fn new(connections_max: usize, busy_max: usize) -> Connections {
        Connections {
            permits: Arc::new(Semaphore::new(connections_max)),
            connections_max,
            busy_max,
            idle: Mutex::default(),
            became_idle: Notify::new(),
        }
    }

    /// Returns a slot for a new connection. If all slots are taken, closes the connection that has been idle
    /// for longest; if none is idle, waits for one.
    pub(super) async fn add(self: &Arc<Self>) -> Connection {
        let permit = loop {
            if let Ok(permit) = Arc::clone(&self.permits).try_acquire_owned() {
                break permit;
            }
            let is_closing = self.close_oldest_idle();
            let mut permit = pin!(Arc::clone(&self.permits).acquire_owned());
            let mut became_idle = pin!(self.became_idle.notified());
            let first = poll_fn(|context| match permit.as_mut().poll(context) {
                Poll::Ready(permit) => Poll::Ready(permit.ok()),
                Poll::Pending if is_closing => Poll::Pending,
                Poll::Pending => became_idle.as_mut().poll(context).map(|()| None),
            });
            if let Some(permit) = first.await {
                break permit;
            }
        };
        let closing = Arc::new(Notify::new());
        let key = self.lock().insert(&closing);
        let state = Mutex::new(ConnectionState::Idle(key));
        Connection { all: Arc::clone(self), state, closing, _permit: permit }
    }

    /// Whether so few slots are free that they are reserved for health checks.
    pub(super) fn is_busy(&self) -> bool {
        self.lock().busy_count > self.busy_max
    }

    /// Waits until all connections have ended.
    pub(super) async fn all_ended(&self) {
        let _ = self.permits.acquire_many(u32::try_from(self.connections_max).unwrap_or(u32::MAX)).await;
    }

    /// Requests the connection that has been idle for longest to close, and returns whether there was one.
    fn close_oldest_idle(&self) -> bool {
        let oldest = self.lock().by_age.pop_first();
        if let Some((_, closing)) = &oldest {
            closing.notify_one();
        }
        oldest.is_some()
    }

    /// Each update is complete before the lock is released, so the data is consistent even if the lock is
    /// poisoned.
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
    /// Marks the connection as busy, because a request has arrived.
    pub(super) fn begin(self: &Arc<Self>) -> Answering {
        let mut state = self.state();
        let mut all = self.all.lock();
        // While the previous response is still being sent, the connection already counts as busy.
        if let ConnectionState::Idle(key) = *state {
            all.by_age.remove(&key);
            all.busy_count += 1;
        }
        *state = ConnectionState::Busy;
        Answering(Arc::clone(self))
    }

    /// Records that all data produced so far is handed to the system. If the response is complete, the
    /// connection becomes idle.
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

    /// Waits until this connection must close to free its slot for another.
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
        Arc::new(now(all.add()).expect("a permit"))
    }

    #[test]
    fn new_connection_closes_the_longest_idle_one_when_all_slots_are_taken() {
        let all = Arc::new(Connections::new(3, 2));
        let [first, second, third] = [(); 3].map(|()| add(&all));
        // The first connection is busy; when its response is sent, it is the one that became idle last.
        let answering = first.begin();
        let mut fourth = Box::pin(all.add());
        assert!(now(fourth.as_mut()).is_none(), "no slot is free until another connection has ended");
        assert!(now(second.is_to_close()).is_some());
        drop(second);
        let fourth = now(fourth).expect("the slot of the second");
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
        assert!(now(only.is_to_close()).is_none(), "part of the answer may not be sent yet");
        only.flushed();
        assert!(now(next.as_mut()).is_none());
        assert!(now(only.is_to_close()).is_some());
        drop(only);
        assert!(now(next).is_some());
    }

    #[test]
    fn only_busy_connections_count_as_crowded() {
        let all = Arc::new(Connections::new(4, 2));
        let connections = [(); 4].map(|()| add(&all));
        assert!(!all.is_busy());
        let mut answering: Vec<Answering> = connections[..3].iter().map(Connection::begin).collect();
        assert!(all.is_busy());
        answering.pop();
        assert!(all.is_busy(), "some of the answer may not be sent yet");
        connections[2].flushed();
        assert!(!all.is_busy());
        let again = connections[2].begin();
        assert!(all.is_busy());
        drop((again, answering, connections));
        assert_eq!(all.lock().busy_count, 0, "all connections have ended");
    }
}
