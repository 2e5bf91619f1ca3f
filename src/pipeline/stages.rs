//! The stages of a frame, each on a thread of its own, joined by bounded channels.
//!
//! ```text
//!   read ══▶ rasterize ──▶ smooth ──▶ contour ══▶ write ──▶ the caller, in order
//!        1            0           0           1
//!        waiting      waiting     waiting     waiting
//! ```
//!
//! Several frames are under way at once, and a slow stage holds back the ones before it. The three
//! stages of the method compute in one pool, so a frame that waited between them would cost memory
//! and gain nothing; beside the disk one frame may wait, so that neither waits for the other.
//!
//! A frame that failed travels on as its outcome: the order is kept, and one bad frame costs itself
//! only. Each stage runs under `catch_unwind`, so a broken invariant is such a failure too.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Instant;

use crossbeam::channel::{Receiver, Sender, bounded};
use rayon::ThreadPool;

use crate::particles::Particles;
use crate::settings::Settings;
use crate::skin::{self, Surface};

use super::frame::{Frame, FrameError, FrameReport, Outcome, Stage};
use super::memory::peak_memory_bytes;
use super::outputs::OutputOptions;
use super::provenance::{InputIdentity, is_done};
use super::reading::parse_particles;
use super::writing::write_surface;

/// The three stages of the method. Tests put a quick or a failing one in its place.
pub trait Method: Sync {
    /// What rasterization hands to smoothing.
    type Rasterized: Send;
    /// What smoothing hands to contouring.
    type Smoothed: Send;

    /// The first stage.
    fn rasterize(&self, particles: &Particles, settings: &Settings) -> Self::Rasterized;
    /// The second stage.
    fn smooth(&self, rasterized: Self::Rasterized, settings: &Settings) -> Self::Smoothed;
    /// The third stage.
    fn contour(&self, smoothed: Self::Smoothed, settings: &Settings) -> Surface;
}

/// The method that this program is for.
#[derive(Clone, Copy, Debug)]
pub struct LevelSetSkinning;

impl Method for LevelSetSkinning {
    type Rasterized = skin::Rasterized;
    type Smoothed = skin::Smoothed;

    fn rasterize(&self, particles: &Particles, settings: &Settings) -> skin::Rasterized {
        skin::rasterize(particles, settings)
    }

    fn smooth(&self, rasterized: skin::Rasterized, settings: &Settings) -> skin::Smoothed {
        skin::smooth(rasterized, settings)
    }

    fn contour(&self, smoothed: skin::Smoothed, settings: &Settings) -> Surface {
        skin::contour(smoothed, settings)
    }
}

/// What to do when a frame fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnError {
    /// Write exactly the frames before the one that failed.
    Stop,
    /// Go on with the next frame.
    Continue,
}

/// How frames are converted.
#[derive(Clone, Copy, Debug)]
pub struct Conduct<'a> {
    /// Where all computing happens.
    pub pool: &'a ThreadPool,
    /// What is written, and where.
    pub outputs: &'a OutputOptions,
    /// What to do when a frame fails.
    pub on_error: OnError,
    /// Leave frames alone whose outputs are there, made from the same input by the same settings
    /// and the same version of this program.
    pub skip_done: bool,
}

/// Converts frames; `finished` hears of each, by its index and in order, as soon as it is done.
pub fn run<M: Method>(
    method: &M,
    frames: &[Frame],
    conduct: &Conduct<'_>,
    mut finished: impl FnMut(usize, Outcome),
) {
    let run = &Run { frames, conduct, failed: AtomicBool::new(false) };
    let (to_rasterize, to_rasterize_from) = bounded(1);
    let (to_smooth, to_smooth_from) = bounded(0);
    let (to_contour, to_contour_from) = bounded(0);
    let (to_write, to_write_from) = bounded(1);
    let (to_caller, done) = bounded(1);
    thread::scope(|scope| {
        scope.spawn(move || run.read(&to_rasterize));
        scope.spawn(move || {
            run.compute(Stage::Rasterize, &to_rasterize_from, &to_smooth, |particles, settings| {
                method.rasterize(&particles, settings)
            });
        });
        scope.spawn(move || {
            run.compute(Stage::Smooth, &to_smooth_from, &to_contour, |rasterized, settings| {
                method.smooth(rasterized, settings)
            });
        });
        scope.spawn(move || {
            run.compute(Stage::Contour, &to_contour_from, &to_write, |smoothed, settings| {
                method.contour(smoothed, settings)
            });
        });
        scope.spawn(move || run.write(&to_write_from, &to_caller));
        for (index, outcome) in done {
            finished(index, outcome);
        }
    });
}

/// What all stages share.
struct Run<'a> {
    frames: &'a [Frame],
    conduct: &'a Conduct<'a>,
    /// Some frame failed: with [`OnError::Stop`] no further ones are read.
    failed: AtomicBool,
}

/// A frame on its way: what the next stage needs, or the outcome if it has one already.
struct Parcel<T> {
    index: usize,
    content: Result<(T, Ticket), Outcome>,
}

/// What is known of a frame from reading it, for the end of its way.
struct Ticket {
    input: InputIdentity,
    read_seconds: f64,
    notes: Vec<String>,
}

impl Run<'_> {
    fn read(&self, to: &Sender<Parcel<Particles>>) {
        for (index, frame) in self.frames.iter().enumerate() {
            let content = if self.is_stopped() { Err(Outcome::NotStarted) } else { self.read_one(frame) };
            // Nobody listens only when the caller is gone.
            if to.send(Parcel { index, content }).is_err() {
                return;
            }
        }
    }

    fn read_one(&self, frame: &Frame) -> Result<(Particles, Ticket), Outcome> {
        let start = Instant::now();
        let outputs = self.conduct.outputs;
        let read = FrameError::catch(&frame.input, Stage::Read, || {
            let (bytes, input) = InputIdentity::of_file(&frame.input)?;
            if self.conduct.skip_done && is_done(frame, &input, outputs) {
                return Ok(None);
            }
            // Parsing is work for the pool; waiting for the disk before it is not.
            let parsed = self.conduct.pool.install(|| parse_particles(&frame.input, &bytes))?;
            Ok(Some((parsed, input)))
        });
        match read.flatten() {
            Ok(Some((read, input))) => {
                let read_seconds = start.elapsed().as_secs_f64();
                Ok((read.particles, Ticket { input, read_seconds, notes: read.notes }))
            }
            Ok(None) => Err(Outcome::AlreadyDone),
            Err(error) => Err(self.fail(error)),
        }
    }

    fn compute<A: Send, B: Send>(
        &self,
        stage: Stage,
        from: &Receiver<Parcel<A>>,
        to: &Sender<Parcel<B>>,
        work: impl Fn(A, &Settings) -> B + Sync,
    ) {
        for Parcel { index, content } in from {
            let frame = &self.frames[index];
            let content = content.and_then(|(before, ticket)| {
                let compute = || self.conduct.pool.install(|| work(before, &frame.settings));
                FrameError::catch(&frame.input, stage, compute)
                    .map(|after| (after, ticket))
                    .map_err(|error| self.fail(error))
            });
            if to.send(Parcel { index, content }).is_err() {
                return;
            }
        }
    }

    fn write(&self, from: &Receiver<Parcel<Surface>>, to: &Sender<(usize, Outcome)>) {
        // Here frames arrive in order: what is written before a stop does not depend on timing.
        let mut stopped = false;
        for Parcel { index, content } in from {
            let outcome = match content {
                _ if stopped => Outcome::NotStarted,
                Ok((surface, ticket)) => self.write_one(&self.frames[index], &surface, ticket),
                Err(outcome) => outcome,
            };
            stopped |= matches!(outcome, Outcome::Failed(_)) && self.conduct.on_error == OnError::Stop;
            if to.send((index, outcome)).is_err() {
                return;
            }
        }
    }

    fn write_one(&self, frame: &Frame, surface: &Surface, ticket: Ticket) -> Outcome {
        let start = Instant::now();
        let written = FrameError::catch(&frame.input, Stage::Write, || {
            write_surface(surface, frame, &ticket.input, self.conduct.outputs, self.conduct.pool)
        });
        match written.flatten() {
            Ok(outputs) => Outcome::Converted(Box::new(FrameReport {
                skin: surface.report.clone(),
                read_seconds: ticket.read_seconds,
                write_seconds: start.elapsed().as_secs_f64(),
                peak_memory_bytes: peak_memory_bytes(),
                outputs,
                notes: ticket.notes,
            })),
            Err(error) => self.fail(error),
        }
    }

    fn fail(&self, error: FrameError) -> Outcome {
        self.failed.store(true, Ordering::Relaxed);
        Outcome::Failed(error)
    }

    fn is_stopped(&self) -> bool {
        self.conduct.on_error == OnError::Stop && self.failed.load(Ordering::Relaxed)
    }
}
