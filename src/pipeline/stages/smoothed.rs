//! The smoothed frames that other frames are averaged with (`--temporal`).
//!
//! ```text
//!   … ──smooth──▶ keep ──▶ gate ──▶ contour: finds the frames around in what is kept, or else computes them
//! ```
//!
//! A frame is kept while others that may need it are in flight, and not for longer than the memory allows. The gate
//! before the contour stage holds a frame while the pipeline computes one of those around it; it never waits for a
//! frame that might itself wait for memory. If a frame around is not in the pipeline, because it is done already or
//! belongs to another shard, the contour stage computes it. What is computed depends on the files alone, so all of
//! these ways give the same bytes.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crossbeam::channel::{Receiver, Sender, bounded, select};

use crate::pipeline::input::around::FrameContent;
use crate::surface::options::Settings;
use crate::surface::temporal::TimedFrame;

use super::Inlet;

/// The smoothed frames that are kept, and the frames that will be.
pub(super) struct SmoothedFrames {
    /// The most memory for kept frames, in bytes.
    limit_bytes: u64,
    state: Mutex<State>,
    /// A token after each change.
    changed: (Sender<()>, Receiver<()>),
}

#[derive(Default)]
struct State {
    /// The number of frames in flight that are averaged with others.
    user_count: usize,
    /// The frames that have their memory and are not smoothed yet.
    computing: Vec<PathBuf>,
    /// The latest last.
    kept: VecDeque<Kept>,
}

struct Kept {
    content: FrameContent,
    settings: Arc<Settings>,
    frame: Arc<TimedFrame>,
}

/// A frame in flight that is averaged with others: while there are any, frames are kept.
pub(super) struct User<'a>(&'a SmoothedFrames);

/// A frame that is being computed, until it is smoothed or has failed.
pub(super) struct Computing<'a> {
    frames: &'a SmoothedFrames,
    path: PathBuf,
}

impl SmoothedFrames {
    /// Keeps frames within this memory, in bytes.
    pub(super) fn new(limit_bytes: u64) -> SmoothedFrames {
        SmoothedFrames { limit_bytes, state: Mutex::default(), changed: bounded(1) }
    }

    /// A frame that is averaged with others comes into flight.
    pub(super) fn user(&self) -> User<'_> {
        self.state().user_count += 1;
        User(self)
    }

    /// Whether one of these frames will be kept soon.
    pub(super) fn is_computing<'a>(&self, mut paths: impl Iterator<Item = &'a Path>) -> bool {
        let state = self.state();
        paths.any(|path| state.computing.iter().any(|computing| computing == path))
    }

    /// Keeps a frame, with up to `count` others.
    pub(super) fn keep(
        &self,
        content: FrameContent,
        settings: &Arc<Settings>,
        frame: Arc<TimedFrame>,
        count: usize,
    ) {
        let mut state = self.state();
        // A frame that was smoothed alone may come through the pipeline, too.
        state.kept.retain(|kept| kept.content != content || !Arc::ptr_eq(&kept.settings, settings));
        state.kept.push_back(Kept { content, settings: Arc::clone(settings), frame });
        let mut bytes: u64 = state.kept.iter().map(|kept| kept.frame.size_bytes()).sum();
        while state.kept.len() > count + 1 || state.kept.len() > 1 && bytes > self.limit_bytes {
            bytes -= state.kept.pop_front().map_or(0, |kept| kept.frame.size_bytes());
        }
    }

    /// The frame that was made from this content with these settings, if it is kept.
    pub(super) fn find(&self, content: &FrameContent, settings: &Arc<Settings>) -> Option<Arc<TimedFrame>> {
        let state = self.state();
        let is_same = |kept: &&Kept| kept.content == *content && Arc::ptr_eq(&kept.settings, settings);
        state.kept.iter().find(is_same).map(|kept| Arc::clone(&kept.frame))
    }

    /// Each change is complete before the lock is released, so the state is consistent even if the lock is
    /// poisoned.
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<'a> User<'a> {
    /// The frame has its memory, and will be smoothed.
    pub(super) fn begin(&self, path: &Path) -> Computing<'a> {
        self.0.state().computing.push(path.to_owned());
        Computing { frames: self.0, path: path.to_owned() }
    }
}

impl Drop for User<'_> {
    fn drop(&mut self) {
        let mut state = self.0.state();
        state.user_count -= 1;
        if state.user_count == 0 {
            state.kept.clear();
        }
    }
}

impl Drop for Computing<'_> {
    fn drop(&mut self) {
        let mut state = self.frames.state();
        if let Some(index) = state.computing.iter().position(|path| *path == self.path) {
            state.computing.swap_remove(index);
        }
        drop(state);
        // If the channel is full, the gate will look again anyway.
        let _ = self.frames.changed.0.try_send(());
    }
}

/// Holds items until the frames around them are smoothed.
pub(super) struct Gate<'a, T> {
    from: &'a Inlet<T>,
    frames: &'a SmoothedFrames,
    held: VecDeque<T>,
}

impl<'a, T> Gate<'a, T> {
    pub(super) fn new(from: &'a Inlet<T>, frames: &'a SmoothedFrames) -> Gate<'a, T> {
        Gate { from, frames, held: VecDeque::new() }
    }

    /// Waits for the next item that `is_ready`; `None` once the stage before has ended and nothing is held.
    pub(super) fn receive(&mut self, is_ready: impl Fn(&T) -> bool) -> Option<T> {
        loop {
            if let Some(index) = self.held.iter().position(&is_ready) {
                return self.held.remove(index);
            }
            select! {
                recv(self.from.items()) -> item => match item {
                    Ok((_, item)) => self.held.push_back(item),
                    // The stages before have ended, so nothing is computing.
                    Err(_) => return self.held.pop_front(),
                },
                recv(self.frames.changed.1) -> _ => {}
            }
        }
    }
}
