//! Frames that are ready, until the pipeline has room for them.
//!
//! ```text
//!   the loop ──push──▶ ▒▒▒▒▒▒▒ ──next──▶ the pipeline's reader
//!                      sorted             blocks while there is nothing, or while paused
//! ```
//!
//! The pipeline asks for a frame only when it can begin it. So the order is decided at the last
//! moment: a frame that arrives late may still be the next.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use crate::pipeline::{Frame, natural_order};

use super::config::Order;
use super::frames::FrameId;

/// Frames that wait for the pipeline.
#[derive(Debug)]
pub(super) struct Queue {
    order: Order,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    waiting: BTreeMap<Rank, (usize, Frame)>,
    is_paused: bool,
    is_closed: bool,
}

/// Where a frame stands among those that wait.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Rank {
    /// Smaller is sooner, before anything else counts.
    urgency: i64,
    path: Arc<Path>,
    root: usize,
}

impl Queue {
    pub(super) fn new(order: Order) -> Queue {
        Queue { order, state: Mutex::default(), changed: Condvar::new() }
    }

    /// Adds a frame whose file was last written at `modified_ns`. Where it is there already, it is
    /// replaced.
    pub(super) fn push(&self, id: &FrameId, frame: Frame, modified_ns: i64) {
        let rank = self.rank(id, modified_ns);
        self.lock().waiting.insert(rank, (id.root, frame));
        self.changed.notify_one();
    }

    /// Takes a frame back; `false` where it does not wait any more.
    pub(super) fn remove(&self, id: &FrameId, modified_ns: i64) -> bool {
        let rank = self.rank(id, modified_ns);
        self.lock().waiting.remove(&rank).is_some()
    }

    /// The next frame and the index of its root, as soon as there is one; `None` once the queue is
    /// closed.
    pub(super) fn next(&self) -> Option<(usize, Frame)> {
        let mut state = self.lock();
        loop {
            if state.is_closed {
                return None;
            }
            if !state.is_paused
                && let Some((_, next)) = state.waiting.pop_first()
            {
                return Some(next);
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Holds the frames back, or lets them go on.
    pub(super) fn pause(&self, is_paused: bool) {
        self.lock().is_paused = is_paused;
        self.changed.notify_one();
    }

    /// No further frame leaves.
    pub(super) fn close(&self) {
        self.lock().is_closed = true;
        self.changed.notify_all();
    }

    /// How many frames wait.
    pub(super) fn len(&self) -> usize {
        self.lock().waiting.len()
    }

    fn rank(&self, id: &FrameId, modified_ns: i64) -> Rank {
        let urgency = match self.order {
            Order::Natural => 0,
            Order::Latest => -modified_ns,
        };
        Rank { urgency, path: Arc::clone(&id.path), root: id.root }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing in here panics half-way.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Ord for Rank {
    fn cmp(&self, other: &Rank) -> Ordering {
        let by_name = || natural_order(&self.path.to_string_lossy(), &other.path.to_string_lossy());
        // Names that are not text may look alike.
        let by_place = || self.path.cmp(&other.path).then_with(|| self.root.cmp(&other.root));
        self.urgency.cmp(&other.urgency).then_with(by_name).then_with(by_place)
    }
}

impl PartialOrd for Rank {
    fn partial_cmp(&self, other: &Rank) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{Job, OutputOptions};
    use crate::surface::options::{Choices, Settings};
    use meniscus_formats::{gltf, vdb};
    use std::path::PathBuf;
    use std::thread;

    fn id(name: &str) -> FrameId {
        FrameId::new(0, Path::new(name))
    }

    fn frame(name: &str) -> Frame {
        let settings = Settings::paper(0.1, &Choices::default()).expect("settings");
        let outputs = OutputOptions {
            folder: PathBuf::new(),
            formats: Vec::new(),
            up: gltf::UpAxis::Y,
            meters_per_unit: 1.0,
            quantize: false,
            vdb_half: false,
            vdb_compression: vdb::Compression::None,
            picture: crate::pipeline::PictureOptions::default(),
        };
        Frame {
            job: Job::default(),
            input: name.into(),
            stem: name.to_owned(),
            settings: Arc::new(settings),
            outputs: Arc::new(outputs),
            number: None,
            obstacles: Arc::default(),
            framing: None,
        }
    }

    /// The order in which frames, given with their times, leave the queue.
    fn order_of(order: Order, frames: &[(&str, i64)]) -> Vec<String> {
        let queue = Queue::new(order);
        for (name, modified_ns) in frames {
            queue.push(&id(name), frame(name), *modified_ns);
        }
        (0..queue.len()).map(|_| queue.next().expect("a frame").1.stem).collect()
    }

    #[test]
    fn frames_leave_by_number_or_the_latest_first() {
        let frames = [("a.10", 5), ("a.9", 7), ("a.2", 6), ("b.1", 7)];
        assert_eq!(order_of(Order::Natural, &frames), ["a.2", "a.9", "a.10", "b.1"]);
        assert_eq!(order_of(Order::Latest, &frames), ["a.9", "b.1", "a.2", "a.10"]);
    }

    #[test]
    fn a_frame_that_comes_late_may_be_the_next() {
        let queue = Queue::new(Order::Natural);
        queue.push(&id("a.2"), frame("a.2"), 0);
        queue.push(&id("a.3"), frame("a.3"), 0);
        assert_eq!(queue.next().map(|(_, frame)| frame.stem).as_deref(), Some("a.2"));
        queue.push(&id("a.1"), frame("a.1"), 0);
        queue.push(&id("a.3"), frame("a.3"), 0);
        assert_eq!(queue.len(), 2);
        assert!(queue.remove(&id("a.3"), 0) && !queue.remove(&id("a.3"), 0));
        assert_eq!(queue.next().map(|(_, frame)| frame.stem).as_deref(), Some("a.1"));
    }

    #[test]
    fn a_paused_queue_gives_nothing_and_a_closed_one_ends() {
        let queue = Queue::new(Order::Natural);
        queue.push(&id("a.1"), frame("a.1"), 0);
        queue.pause(true);
        thread::scope(|scope| {
            let taker =
                scope.spawn(|| [queue.next(), queue.next()].map(|next| next.map(|(_, frame)| frame.stem)));
            assert_eq!(queue.len(), 1);
            queue.pause(false);
            while queue.len() > 0 {
                thread::yield_now();
            }
            queue.close();
            assert_eq!(taker.join().expect("no panic"), [Some("a.1".to_owned()), None]);
        });
        queue.push(&id("a.2"), frame("a.2"), 0);
        assert!(queue.next().is_none());
    }
}
