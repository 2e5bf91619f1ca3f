//! The smoothed frames that other frames are averaged with (`--temporal`).
//!
//! ```text
//!   … ──smooth──▶ keep ──▶ gate ──▶ contour: finds the frames around in what is kept, or else computes them
//! ```
//!
//! A frame is kept while others that may need it are in flight, and not for longer than the memory allows. The gate
//! before the contour stage holds a frame while the pipeline computes one of those around it; it never waits for a
//! frame that might itself wait for memory. If a frame around is not in the pipeline, because it is done already or
//! belongs to another shard, the contour stage computes it. What is computed depends on the files that a `SmoothedKey`
//! names, and on nothing else, so all of these ways give the same bytes.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};

use crossbeam::channel::{Receiver, Sender, bounded, select};

use crate::pipeline::input::around::FrameContent;
use crate::surface::options::Settings;
use crate::surface::temporal::TimedFrame;

use super::frame_cache::FrameCache;
use super::{Inlet, lock};

/// The smoothed frames that are kept, and the frames that will be.
pub(super) struct SmoothedFrames {
    state: Mutex<State>,
    /// A token after each change.
    changed: (Sender<()>, Receiver<()>),
}

struct State {
    /// The number of frames in flight that are averaged with others.
    user_count: usize,
    /// The frames that have their memory and are not smoothed yet.
    computing: Vec<PathBuf>,
    kept: FrameCache<SmoothedKey, Arc<TimedFrame>>,
}

/// What a smoothed frame is made from, besides the settings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct SmoothedKey {
    pub(super) content: FrameContent,
    /// The frames around it that say which of its particles are spray: by how many frames each is later, and the hash of
    /// its bytes.
    pub(super) sides: Vec<(i32, u128)>,
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
        let kept = FrameCache::new(limit_bytes, 1, |frame: &Arc<TimedFrame>| frame.size_bytes());
        let state = Mutex::new(State { user_count: 0, computing: Vec::new(), kept });
        SmoothedFrames { state, changed: bounded(1) }
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
        key: SmoothedKey,
        settings: &Arc<Settings>,
        frame: Arc<TimedFrame>,
        count: usize,
    ) {
        self.state().kept.keep(key, settings, frame, count);
    }

    /// The frame that was made from this with these settings, if it is kept.
    pub(super) fn find(&self, key: &SmoothedKey, settings: &Arc<Settings>) -> Option<Arc<TimedFrame>> {
        self.state().kept.find(key, settings).cloned()
    }

    fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
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

#[cfg(test)]
mod tests {
    use super::super::link;
    use super::*;
    use crate::surface::flicker::MovingParticles;
    use crate::surface::grid::Field;
    use crate::surface::level_set::NarrowBand;
    use crate::surface::options::MethodOptions;
    use crate::surface::particles::OwnedPositions;

    fn settings() -> Arc<Settings> {
        Arc::new(Settings::paper(0.1, &MethodOptions::default()).expect("settings"))
    }

    fn key(name: &str) -> SmoothedKey {
        let content = FrameContent { path: name.into(), hash: 1, obstacles: String::new() };
        SmoothedKey { content, sides: vec![(1, 7)] }
    }

    /// A frame with this number of particles.
    fn frame(particle_count: usize) -> Arc<TimedFrame> {
        let positions = OwnedPositions::F32(vec![[0.0; 3]; particle_count]);
        let particles = MovingParticles { positions, ids: None, velocities: None };
        let band = NarrowBand { topology: Arc::default(), phi: Field::default(), half_width: 3.0 };
        Arc::new(TimedFrame::new(Arc::new(band), particles, 1.0))
    }

    #[test]
    fn oldest_frames_give_way_to_later_ones() {
        let (settings, bytes) = (settings(), frame(10).size_bytes());
        for (limit_bytes, count, expected) in [
            (10 * bytes, 2, ["b", "c", "d"].as_slice()),
            (2 * bytes, 9, &["c", "d"]),
            // The latest is kept in any case.
            (1, 9, &["d"]),
        ] {
            let frames = SmoothedFrames::new(limit_bytes);
            let user = frames.user();
            for name in ["a", "b", "c", "d"] {
                frames.keep(key(name), &settings, frame(10), count);
            }
            let mut kept = vec!["a", "b", "c", "d"];
            kept.retain(|name| frames.find(&key(name), &settings).is_some());
            assert_eq!(kept, expected);
            let other_content = FrameContent { hash: 2, ..key("d").content };
            for other in [
                SmoothedKey { content: other_content, ..key("d") },
                SmoothedKey { sides: Vec::new(), ..key("d") },
            ] {
                assert!(frames.find(&other, &settings).is_none());
            }
            drop(user);
            assert!(frames.find(&key("d"), &settings).is_none());
        }
    }

    #[test]
    fn gate_holds_frames_beside_one_that_is_computed() {
        let frames = SmoothedFrames::new(0);
        let user = frames.user();
        let computing = user.begin(Path::new("a"));
        let (outlet, inlet) = link(2);
        outlet.reserve().send("beside a");
        outlet.reserve().send("elsewhere");
        let mut gate = Gate::new(&inlet, &frames);
        let mut receive = || {
            gate.receive(|item| {
                let around = if *item == "beside a" { Path::new("a") } else { Path::new("b") };
                !frames.is_computing([around].into_iter())
            })
        };
        assert_eq!(receive(), Some("elsewhere"));
        drop(computing);
        assert_eq!(receive(), Some("beside a"));
        drop(outlet);
        assert_eq!(receive(), None);
    }
}
