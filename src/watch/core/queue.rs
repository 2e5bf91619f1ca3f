//! The queue of frames that are ready for the pipeline.
//!
//! The pipeline asks for a frame only when it can start one. So the order is decided at the last moment, and
//! a frame that arrives late may still be the next.

use std::cmp::Ordering;
use std::collections::BTreeMap;

use crate::pipeline::{Frame, natural_order};
use crate::watch::config::Order;

use super::frames::FrameId;

/// Frames that wait for the pipeline, in the order of conversion.
#[derive(Debug)]
pub(crate) struct Queue {
    order: Order,
    waiting: BTreeMap<QueueRank, Box<Frame>>,
}

/// The position of a frame in the order.
#[derive(Debug, PartialEq, Eq)]
struct QueueRank {
    /// Compared before the name and the path. The frame with the smallest value leaves the queue first.
    urgency: i64,
    id: FrameId,
}

impl Queue {
    pub(crate) fn new(order: Order) -> Queue {
        Queue { order, waiting: BTreeMap::new() }
    }

    /// Adds a frame whose file was last written at `modified_ns`; replaces a frame with the same id and time.
    /// With [`Order::Latest`] a frame with the same id and another time would stay in the queue as well, so
    /// the caller must remove it first. [`Order::Natural`] ignores the time.
    pub(crate) fn push(&mut self, id: &FrameId, frame: Box<Frame>, modified_ns: i64) {
        self.waiting.insert(self.rank(id, modified_ns), frame);
    }

    /// Removes a frame that was pushed with this `modified_ns`; `false` if it is not in the queue.
    pub(crate) fn remove(&mut self, id: &FrameId, modified_ns: i64) -> bool {
        self.waiting.remove(&self.rank(id, modified_ns)).is_some()
    }

    /// Removes and returns the first frame.
    pub(crate) fn pop(&mut self) -> Option<(FrameId, Box<Frame>)> {
        self.waiting.pop_first().map(|(rank, frame)| (rank.id, frame))
    }

    /// The number of frames in the queue.
    pub(crate) fn len(&self) -> usize {
        self.waiting.len()
    }

    fn rank(&self, id: &FrameId, modified_ns: i64) -> QueueRank {
        let urgency = match self.order {
            Order::Natural => 0,
            Order::Latest => -modified_ns,
        };
        QueueRank { urgency, id: id.clone() }
    }
}

impl Ord for QueueRank {
    fn cmp(&self, other: &QueueRank) -> Ordering {
        let (one, two) = (&self.id, &other.id);
        let by_name = || natural_order(&one.path.to_string_lossy(), &two.path.to_string_lossy());
        // Names that are not valid UTF-8 may look equal.
        let by_path = || one.path.cmp(&two.path).then_with(|| one.root.cmp(&two.root));
        self.urgency.cmp(&other.urgency).then_with(by_name).then_with(by_path)
    }
}

impl PartialOrd for QueueRank {
    fn partial_cmp(&self, other: &QueueRank) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{FrameFile, OutputOptions};
    use crate::surface::options::{MethodOptions, Settings};
    use std::path::Path;
    use std::sync::Arc;

    fn id(name: &str) -> FrameId {
        FrameId::new(0, Path::new(name))
    }

    fn frame(name: &str) -> Box<Frame> {
        let settings = Settings::paper(0.1, &MethodOptions::default()).expect("settings");
        let outputs = OutputOptions::new("", &[]);
        let file = FrameFile::new(name.into());
        Box::new(Frame {
            stem: name.to_owned(),
            ..Frame::new(&file, &Arc::new(settings), &Arc::new(outputs))
        })
    }

    /// The stems of the frames, in the order in which they leave the queue.
    fn order_of(order: Order, frames: &[(&str, i64)]) -> Vec<String> {
        let mut queue = Queue::new(order);
        for (name, modified_ns) in frames {
            queue.push(&id(name), frame(name), *modified_ns);
        }
        std::iter::from_fn(|| queue.pop()).map(|(_, frame)| frame.stem).collect()
    }

    #[test]
    fn frames_leave_in_natural_order_or_latest_first() {
        let frames = [("a.10", 5), ("a.9", 7), ("a.2", 6), ("b.1", 7)];
        assert_eq!(order_of(Order::Natural, &frames), ["a.2", "a.9", "a.10", "b.1"]);
        assert_eq!(order_of(Order::Latest, &frames), ["a.9", "b.1", "a.2", "a.10"]);
    }

    #[test]
    fn frame_that_arrives_late_may_be_the_next() {
        let mut queue = Queue::new(Order::Natural);
        queue.push(&id("a.2"), frame("a.2"), 0);
        queue.push(&id("a.3"), frame("a.3"), 0);
        let next = |queue: &mut Queue| queue.pop().map(|(_, frame)| frame.stem);
        assert_eq!(next(&mut queue).as_deref(), Some("a.2"));
        queue.push(&id("a.1"), frame("a.1"), 0);
        queue.push(&id("a.3"), frame("a.3"), 0);
        assert_eq!(queue.len(), 2);
        assert!(queue.remove(&id("a.3"), 0) && !queue.remove(&id("a.3"), 0));
        assert_eq!(next(&mut queue).as_deref(), Some("a.1"));
        assert_eq!(next(&mut queue), None);
    }
}
