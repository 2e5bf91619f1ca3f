//! What the stages share, and what goes from one to the next.
//!
//! ```text
//!   Parcel   Label     which frame: its number, the caller's word for it
//!            Known     what is known since it was read; its memory, and its seat while it computes
//!            content   what the last stage made of it
//! ```
//!
//! A parcel goes on, or its frame has [ended](Ended) and whoever has the line hears what came of it.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::pipeline::budget::{Budget, Reservation};
use crate::pipeline::crew::Crew;
use crate::pipeline::frame::{Cause, Frame, FrameError, Outcome, ReadInput, Stage};
use crate::pipeline::frame_particles::FrameParticles;
use crate::pipeline::obstacles::FrameObstacles;
use crate::pipeline::seats::{Seat, Seats};
use crate::surface::skin::Plan;

use super::{Conduct, OnError};

/// What all stages share.
pub(super) struct Line<'a, 'scope, 'env, M> {
    pub(super) method: &'env M,
    /// Hears of each stage that a frame begins.
    pub(super) began: &'env (dyn Fn(&Frame, Stage) + Sync + 'env),
    pub(super) conduct: &'env Conduct<'env>,
    pub(super) crew: Crew<'a, 'scope, 'env>,
    pub(super) budget: Budget,
    pub(super) seats: Seats,
    /// Whoever holds it is the one that waits for a frame, a seat and memory.
    pub(super) door: Mutex<()>,
    /// The number of the first frame that failed.
    failed_first: AtomicUsize,
}

/// A frame between two stages.
pub(super) struct Parcel<'a, K, T> {
    pub(super) label: Label<K>,
    pub(super) known: Known<'a>,
    /// What the last stage made of it.
    pub(super) content: T,
}

/// Which frame it is.
pub(super) struct Label<K> {
    /// Frames are counted as they are asked for.
    pub(super) number: usize,
    pub(super) key: K,
    pub(super) frame: Frame,
}

/// What is known of a frame since it was read.
pub(super) struct Known<'a> {
    pub(super) input: ReadInput,
    pub(super) read_seconds: f64,
    pub(super) noted: Noted,
    /// What is recorded of its obstacles, and at how many edges they are open.
    pub(super) obstacles: (String, usize),
    pub(super) memory: Reservation<'a>,
    /// While it computes.
    pub(super) seat: Option<Seat<'a>>,
}

/// What a user should know of what was read.
pub(super) struct Noted {
    pub(super) notes: Vec<String>,
    /// The name of velocities that are not wanted.
    pub(super) unused_velocity: Option<String>,
}

/// What reading hands to rasterization.
pub(super) struct Read {
    pub(super) particles: FrameParticles,
    pub(super) obstacles: FrameObstacles,
    /// How it will be computed.
    pub(super) plan: Plan,
}

/// A frame of which it is known what came of it.
pub(super) struct Ended<K> {
    pub(super) key: K,
    pub(super) frame: Frame,
    pub(super) outcome: Outcome,
}

impl<'a, 'scope, 'env: 'scope, M> Line<'a, 'scope, 'env, M> {
    /// A line on which there is nothing yet, with seats for so many frames.
    pub(super) fn new(
        method: &'env M,
        began: &'env (dyn Fn(&Frame, Stage) + Sync + 'env),
        conduct: &'env Conduct<'env>,
        crew: Crew<'a, 'scope, 'env>,
        lane_count: usize,
    ) -> Line<'a, 'scope, 'env, M> {
        Line {
            method,
            began,
            conduct,
            crew,
            budget: Budget::new(conduct.memory_bytes),
            seats: Seats::new(lane_count),
            door: Mutex::new(()),
            failed_first: AtomicUsize::new(usize::MAX),
        }
    }

    /// A frame begins a stage.
    pub(super) fn begin(&self, frame: &Frame, stage: Stage) {
        (self.began)(frame, stage);
        if let Some(observer) = self.conduct.observer {
            observer.began(frame, stage);
        }
    }

    /// What came of a frame is known.
    pub(super) fn end<K>(&self, Label { number, key, frame }: Label<K>, outcome: Outcome) -> Ended<K> {
        if is_failure(&outcome) {
            self.failed_first.fetch_min(number, Ordering::Relaxed);
        }
        Ended { key, frame, outcome }
    }

    /// Whether a frame before this one failed, and that was to be the end.
    pub(super) fn is_stopped_before(&self, number: usize) -> bool {
        self.conduct.on_error == OnError::Stop && self.failed_first.load(Ordering::Relaxed) < number
    }
}

/// What became of a frame with this error.
pub(super) fn outcome_of(error: FrameError) -> Outcome {
    if matches!(error.cause, Cause::Changed) { Outcome::Changed } else { Outcome::Failed(error) }
}

/// Whether there are no outputs of a frame that was attempted.
pub(super) fn is_failure(outcome: &Outcome) -> bool {
    matches!(outcome, Outcome::Failed(_) | Outcome::Changed)
}
