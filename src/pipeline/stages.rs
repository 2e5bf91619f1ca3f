//! The stages of a frame, joined by bounded channels.
//!
//! ```text
//!   next ──▶ read ──▶ rasterize ──▶ smooth ──▶ contour ══▶ write ──▶ finished
//!    ▲      1 thread     └── a lane for each core ──┘     some threads   │
//!    └────────────── as many frames as may be in flight ─────────────────┘
//! ```
//!
//! Several frames are under way at once, and a slow stage holds back the ones before it. The next frame is
//! asked for only when there is room for one, so that whoever is asked can decide late which it is.
//!
//! The three stages of the method compute in one pool of threads, a frame in each of as many *seats* as the
//! pool has threads. When several frames are there, each thread has one of its own and none waits for
//! another; when there is one, the others have nothing better to do than to take their share of it. A frame
//! keeps its seat from rasterizing to the end of contouring: nothing half computed waits and costs memory.
//! What the frames take together is bounded by a [budget](super::budget), too.
//!
//! Each stage runs under `catch_unwind`: a broken invariant costs its own frame only. A frame that failed,
//! or was done already, leaves at once and overtakes others; [`run`] puts outcomes back in order.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::io::BufWriter;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Instant;

use crossbeam::channel::{Receiver, Sender, bounded};
use rayon::ThreadPool;
use twox_hash::XxHash3_128;

use crate::settings::{Anisotropy, Settings};
use crate::skin::{Plan, Surface};

use super::attributes::Wanted;
use super::budget::{Budget, Reservation};
use super::crew::{Crew, Tasks};
use super::frame::{Cause, Frame, FrameError, FrameReport, Outcome, ReadInput, Stage};
use super::frame_particles::{FileParticles, FrameParticles};
use super::inspection::is_certified;
use super::memory::{default_memory_bytes, peak_memory_bytes};
use super::method::Method;
use super::obstacle_notes::out_of_reach;
use super::obstacles::{FoundObstacles, FrameObstacles};
use super::provenance::is_done;
use super::reading::{InputFile, parse_particles, read_frame_unchanged};
use super::seats::{Seat, Seats};
use super::steps::{StepsFoundBy, reading_bytes, step_of};
use super::writing::{Written, surface_notes, write_files, write_surface};

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
    /// What to do when a frame fails, or changes while it is read. To stop, frames keep their order
    /// on the whole way: one at a time in each stage.
    pub on_error: OnError,
    /// Leave frames alone whose outputs are there, made from the same input by the same settings
    /// and the same version of this program.
    pub skip_done: bool,
    /// Write the certificate of each frame beside its outputs, with their hashes. Then a frame is not done without it,
    /// nor with other bytes than those it was written for.
    pub certificates: bool,
    /// As many frames, at most, have been asked for and are not finished; at least one.
    pub in_flight: usize,
    /// As many bytes, about, the frames under way may take together. A frame that needs more by itself is
    /// skinned in tiles that wait on disk; one that cannot be fails, and says what it needs.
    pub memory_bytes: u64,
    /// Who goes through a file with several frames that was written again. Where it is another, reading never waits for that.
    pub steps_found_by: StepsFoundBy,
}

impl<'a> Conduct<'a> {
    /// On these threads, as `meniscus convert` does it where nobody asks for anything: it goes on when a frame fails,
    /// makes again what is done, writes no certificates, and has [so many](default_in_flight) frames under way and
    /// [so much](default_memory_bytes) memory.
    pub fn new(pool: &'a ThreadPool) -> Conduct<'a> {
        Conduct {
            pool,
            on_error: OnError::Continue,
            skip_done: false,
            certificates: false,
            in_flight: default_in_flight(pool.current_num_threads()),
            memory_bytes: default_memory_bytes(),
            steps_found_by: StepsFoundBy::Reader,
        }
    }
}

/// How many frames it takes to keep so many threads busy: one for each, and some that are read or written.
pub fn default_in_flight(threads: usize) -> usize {
    threads + writer_count(threads) + 1
}

/// Encoding takes a small part of the time of computing; waiting for the disk need not be waited for.
fn writer_count(lane_count: usize) -> usize {
    lane_count / 2 + 1
}

/// Converts the frames of a list; `finished` hears of each, by its index and in order, as soon as all
/// before it are finished.
pub fn run<M: Method>(
    method: &M,
    frames: &[Frame],
    conduct: &Conduct<'_>,
    mut finished: impl FnMut(usize, Outcome),
) {
    let mut frames = frames.iter().cloned().enumerate();
    let mut early = BTreeMap::new();
    let mut is_stopped = false;
    let mut told_count = 0;
    stream(
        method,
        || frames.next(),
        conduct,
        |index, _, outcome| {
            early.insert(index, outcome);
            while let Some(outcome) = early.remove(&told_count) {
                // A frame after the one that failed may have failed before it.
                let outcome = if is_stopped { Outcome::NotStarted } else { outcome };
                is_stopped |= conduct.on_error == OnError::Stop && is_failure(&outcome);
                finished(told_count, outcome);
                told_count += 1;
            }
        },
    );
}

/// Converts the frames that `next` returns, until it returns `None`. It is asked when there is room for one
/// frame more, and may block. `K` is the caller's own word for the frame. `finished` hears of each frame as
/// soon as it is known what came of it, in whatever order, on the thread of the caller.
pub fn stream<M: Method, K: Send>(
    method: &M,
    next: impl FnMut() -> Option<(K, Frame)> + Send,
    conduct: &Conduct<'_>,
    finished: impl FnMut(K, Frame, Outcome),
) {
    stream_seen(method, &|_, _| {}, next, conduct, finished);
}

/// The same; `began` hears of each stage that a frame begins, on the thread of the stage: it must be quick.
pub fn stream_seen<M: Method, K: Send>(
    method: &M,
    began: &(dyn Fn(&Frame, Stage) + Sync),
    next: impl FnMut() -> Option<(K, Frame)> + Send,
    conduct: &Conduct<'_>,
    finished: impl FnMut(K, Frame, Outcome),
) {
    let lane_count = match conduct.on_error {
        OnError::Stop => 1,
        OnError::Continue => conduct.pool.current_num_threads().min(conduct.in_flight).max(1),
    };
    let tasks = Tasks::default();
    conduct.pool.in_place_scope(|scope| {
        let line = Line::new(method, began, conduct, Crew::new(scope, &tasks), lane_count);
        drive(&line, lane_count, next, finished);
    });
}

/// Starts the threads of the stages, and tells what they make of the frames.
fn drive<M: Method, K: Send>(
    line: &Line<'_, '_, '_, M>,
    lane_count: usize,
    next: impl FnMut() -> Option<(K, Frame)> + Send,
    mut finished: impl FnMut(K, Frame, Outcome),
) {
    let (room, no_room) = bounded(line.conduct.in_flight.max(1));
    let (done, outcomes) = bounded(1);
    let (to_rasterize, to_rasterize_from) = bounded(0);
    let (to_smooth, to_smooth_from) = bounded(0);
    let (to_contour, to_contour_from) = bounded(0);
    let (to_write, to_write_from) = bounded(1);
    thread::scope(move |scope| {
        for _ in 0..lane_count {
            let (from, to, ended) = (to_rasterize_from.clone(), to_smooth.clone(), done.clone());
            scope.spawn(move || line.rasterize(&from, &to, &ended));
            let (from, to, ended) = (to_smooth_from.clone(), to_contour.clone(), done.clone());
            scope.spawn(move || line.smooth(&from, &to, &ended));
            let (from, to, ended) = (to_contour_from.clone(), to_write.clone(), done.clone());
            scope.spawn(move || line.contour(&from, &to, &ended));
        }
        for _ in 0..writer_count(lane_count) {
            let (from, ended) = (to_write_from.clone(), done.clone());
            scope.spawn(move || line.write(&from, &ended));
        }
        scope.spawn(move || line.read(next, &room, &to_rasterize, &done));
        // The stages end when the one before has: this thread's own ends of the channels must not keep them.
        drop((to_smooth, to_contour, to_write));
        drop((to_rasterize_from, to_smooth_from, to_contour_from, to_write_from));
        for Ended { key, frame, outcome } in outcomes {
            finished(key, frame, outcome);
            // There is a token in it for each frame that is not finished.
            let _ = no_room.try_recv();
        }
    });
}

/// What all stages share.
struct Line<'a, 'scope, 'env, M> {
    method: &'env M,
    /// Hears of each stage that a frame begins.
    began: &'env (dyn Fn(&Frame, Stage) + Sync + 'env),
    conduct: &'env Conduct<'env>,
    crew: Crew<'a, 'scope, 'env>,
    budget: Budget,
    seats: Seats,
    /// Whoever holds it is the one that waits for a frame, a seat and memory.
    door: Mutex<()>,
    /// The number of the first frame that failed.
    failed_first: AtomicUsize,
}

/// A frame between two stages.
struct Parcel<'a, K, T> {
    label: Label<K>,
    known: Known<'a>,
    /// What the last stage made of it.
    content: T,
}

/// Which frame it is.
struct Label<K> {
    /// Frames are counted as they are asked for.
    number: usize,
    key: K,
    frame: Frame,
}

/// What is known of a frame since it was read.
struct Known<'a> {
    input: ReadInput,
    read_seconds: f64,
    notes: Vec<String>,
    /// What is recorded of its obstacles, and at how many edges they are open.
    obstacles: (String, usize),
    memory: Reservation<'a>,
    /// While it computes.
    seat: Option<Seat<'a>>,
}

/// What reading hands to rasterization.
struct Read {
    particles: FrameParticles,
    obstacles: FrameObstacles,
    /// How it will be computed.
    plan: Plan,
}

/// A frame of which it is known what came of it.
struct Ended<K> {
    key: K,
    frame: Frame,
    outcome: Outcome,
}

impl<'a, 'scope, 'env: 'scope, M: Method> Line<'a, 'scope, 'env, M> {
    fn new(
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

    fn read<'l, K>(
        &'l self,
        mut next: impl FnMut() -> Option<(K, Frame)>,
        room: &Sender<()>,
        to: &Sender<Parcel<'l, K, Read>>,
        ended: &Sender<Ended<K>>,
    ) {
        // Sending fails when the caller is gone.
        for number in 0.. {
            if room.send(()).is_err() {
                return;
            }
            let Some((key, frame)) = next() else { return };
            let label = Label { number, key, frame };
            let is_sent = match self.read_one(number, &label.frame) {
                Ok((content, known)) => to.send(Parcel { label, known, content }).is_ok(),
                Err(outcome) => ended.send(self.end(label, outcome)).is_ok(),
            };
            if !is_sent {
                return;
            }
        }
    }

    fn read_one(&self, number: usize, frame: &Frame) -> Result<(Read, Known<'_>), Outcome> {
        if self.is_stopped_before(number) {
            return Err(Outcome::NotStarted);
        }
        // A file that cannot be looked at will not be read either.
        let file_bytes = reading_bytes(&frame.input, self.conduct.steps_found_by);
        let obstacle_bytes = frame.obstacles.loading_bytes(frame.number);
        let bytes = file_bytes.saturating_mul(READING_MEMORY).saturating_add(obstacle_bytes);
        let mut memory = self.budget.hold(bytes);
        (self.began)(frame, Stage::Read);
        let start = Instant::now();
        let read = FrameError::catch(&frame.input, Stage::Read, || self.particles_of(number, frame));
        let (read, input, notes) = read.map_err(Outcome::Failed).flatten()?;
        // Those that stand still are there for the frames that follow, too. They are named by where they are, which the
        // frames of this line keep as it is; and nobody takes their room between this and the next.
        let standing_bytes = read.obstacles.all_bytes - read.obstacles.own_bytes;
        self.budget.set_aside(Arc::as_ptr(&frame.obstacles).addr(), standing_bytes);
        memory.resize(read.particles.size_bytes().saturating_add(read.obstacles.own_bytes));
        let read_seconds = start.elapsed().as_secs_f64();
        let obstacles = (read.obstacles.recorded.clone(), read.obstacles.open_edge_count);
        Ok((read, Known { input, read_seconds, notes, obstacles, memory, seat: None }))
    }

    /// The particles of a frame, and the notes on them.
    fn particles_of(&self, number: usize, frame: &Frame) -> Result<(Read, ReadInput, Vec<String>), Outcome> {
        let failed = |error| Outcome::Failed(FrameError::file(&frame.input, Stage::Read, error));
        let of_obstacle = |error| FrameError::of_stage(frame, Stage::Read, Cause::Obstacle(Box::new(error)));
        let found = frame.obstacles.find(frame.number);
        let obstacles = found.map_err(|error| Outcome::Failed(of_obstacle(error)))?;
        let wanted = Wanted::by(&frame.settings);
        if let Some(file) = self.worth_streaming(frame).map_err(|error| failed(error.into()))? {
            let failed = |error: io::Error| failed(error.into());
            let input = ReadInput { stamp: file.stamp(), hash: file.hash().map_err(failed)? };
            if !file.is_unchanged().map_err(failed)? {
                return Err(Outcome::Changed);
            }
            if self.conduct.skip_done && self.is_done(frame, input.hash, &obstacles.recorded()) {
                return Err(Outcome::AlreadyDone(input));
            }
            let streamed = FileParticles::open(&frame.input, file)
                .map_err(|error| Outcome::Failed(FrameError::file(&frame.input, Stage::Read, error)))?;
            if let Some(particles) = streamed {
                let notes = particles.notes();
                let particles = FrameParticles::OnDisk(Box::new(particles));
                return self.planned(number, frame, move || Ok((particles, notes)), obstacles, input);
            }
        }
        let unchanged = read_frame_unchanged(&frame.input, self.conduct.steps_found_by).map_err(failed)?;
        let (bytes, stamp) = unchanged.ok_or(Outcome::Changed)?;
        let input = ReadInput { stamp, hash: XxHash3_128::oneshot(&bytes) };
        if self.conduct.skip_done && self.is_done(frame, input.hash, &obstacles.recorded()) {
            return Err(Outcome::AlreadyDone(input));
        }
        let path = frame.input.clone();
        let parse = move || {
            let read = parse_particles(&path, &bytes, &wanted)?;
            Ok((FrameParticles::InMemory(read.cloud), read.notes))
        };
        self.planned(number, frame, parse, obstacles, input)
    }

    /// The file of a frame that is better gone through twice, batch by batch, than read once.
    fn worth_streaming(&self, frame: &Frame) -> io::Result<Option<InputFile>> {
        if step_of(&frame.input).is_some() || !needs_positions_only(&frame.settings) {
            return Ok(None);
        }
        let file = InputFile::open(&frame.input)?;
        Ok((file.is_regular() && file.stamp().size >= STREAMED_FROM_BYTES).then_some(file))
    }

    /// Whether a frame needs not be made again.
    fn is_done(&self, frame: &Frame, hash: u128, obstacles: &str) -> bool {
        match self.conduct.certificates {
            true => is_certified(frame, hash, obstacles),
            false => is_done(frame, hash, obstacles),
        }
    }

    /// Has a frame parsed and planned in the pool; waiting for the disk before it is no work for that.
    fn planned(
        &self,
        number: usize,
        frame: &Frame,
        parse: impl FnOnce() -> Result<(FrameParticles, Vec<String>), FrameError> + Send + 'env,
        found: FoundObstacles,
        input: ReadInput,
    ) -> Result<(Read, ReadInput, Vec<String>), Outcome> {
        let (method, frame, allowed_bytes) = (self.method, frame.clone(), self.conduct.memory_bytes);
        let planned = self.crew.run(number, move || {
            let (particles, mut notes) = parse()?;
            let kept_bytes_max = allowed_bytes / OBSTACLE_SHARE;
            let failed = |cause| FrameError::of_stage(&frame, Stage::Read, cause);
            let loaded = frame.obstacles.load(found, &frame.settings, kept_bytes_max);
            let mut obstacles = loaded.map_err(|error| failed(Cause::Obstacle(Box::new(error))))?;
            notes.append(&mut obstacles.notes);
            notes.extend(out_of_reach(&obstacles, &particles, &frame.settings).map_err(failed)?);
            let plan = method.plan(&particles, &obstacles, &frame.settings, allowed_bytes).map_err(failed)?;
            if plan.tile_leaves.is_some() {
                let mebibytes = plan.whole_bytes.saturating_add(particles.size_bytes()).div_ceil(1 << 20);
                notes.push(format!(
                    "skinned in tiles, which takes longer: whole it needs {mebibytes} MiB (--memory)"
                ));
            }
            Ok((Read { particles, obstacles, plan }, notes))
        });
        let (read, notes) = planned.map_err(outcome_of)?;
        Ok((read, input, notes))
    }

    fn rasterize<'l, K>(
        &'l self,
        from: &Receiver<Parcel<'l, K, Read>>,
        to: &Sender<Parcel<'l, K, M::Rasterized>>,
        ended: &Sender<Ended<K>>,
    ) {
        let method = self.method;
        while let Some(Parcel { label, known, content }) = self.admit(from) {
            let scratch = label.frame.outputs.folder.clone();
            let work = move |Read { particles, obstacles, plan }: Read, settings: &Settings| {
                method.rasterize(particles, obstacles, settings, &plan, &scratch)
            };
            let computed = self.compute(Stage::Rasterize, &label, content, work);
            if !self.pass(label, known, computed, to, ended) {
                return;
            }
        }
    }

    /// The next frame, once there is a seat and memory for it. It is the one that was read first: nobody
    /// else waits here.
    fn admit<'l, K>(&'l self, from: &Receiver<Parcel<'l, K, Read>>) -> Option<Parcel<'l, K, Read>> {
        let _door = self.door.lock().unwrap_or_else(PoisonError::into_inner);
        let seat = self.seats.take();
        let mut parcel = from.recv().ok()?;
        let Read { particles, obstacles, plan } = &parcel.content;
        let given_bytes = particles.size_bytes().saturating_add(obstacles.own_bytes);
        parcel.known.memory.admit(plan.memory_bytes.saturating_add(given_bytes));
        parcel.known.seat = Some(seat);
        Some(parcel)
    }

    fn smooth<'l, K>(
        &self,
        from: &Receiver<Parcel<'l, K, M::Rasterized>>,
        to: &Sender<Parcel<'l, K, M::Smoothed>>,
        ended: &Sender<Ended<K>>,
    ) {
        let method = self.method;
        let work = move |rasterized, settings: &Settings| method.smooth(rasterized, settings);
        for Parcel { label, known, content } in from {
            let computed = self.compute(Stage::Smooth, &label, content, work);
            if !self.pass(label, known, computed, to, ended) {
                return;
            }
        }
    }

    fn contour<'l, K>(
        &self,
        from: &Receiver<Parcel<'l, K, M::Smoothed>>,
        to: &Sender<Parcel<'l, K, Surface>>,
        ended: &Sender<Ended<K>>,
    ) {
        let method = self.method;
        for Parcel { label, mut known, content } in from {
            let outputs = Arc::clone(&label.frame.outputs);
            let work = move |smoothed, settings: &Settings| method.contour(smoothed, settings, &outputs);
            let computed = self.compute(Stage::Contour, &label, content, work);
            if let Ok(surface) = &computed {
                known.seat = None;
                let packing_bytes = surface.attributes.packing_bytes() as u64;
                let surface_bytes = surface.size_bytes().saturating_mul(WRITING_MEMORY);
                known.memory.resize(surface_bytes.saturating_add(packing_bytes));
            }
            if !self.pass(label, known, computed, to, ended) {
                return;
            }
        }
    }

    /// A stage of the method.
    fn compute<K, A: Send + 'env, B: Send + 'env>(
        &self,
        stage: Stage,
        label: &Label<K>,
        content: A,
        work: impl FnOnce(A, &Settings) -> Result<B, Cause> + Send + 'env,
    ) -> Result<B, FrameError> {
        let settings = Arc::clone(&label.frame.settings);
        (self.began)(&label.frame, stage);
        let computed = FrameError::catch(&label.frame.input, stage, || {
            self.crew.run(label.number, move || work(content, &settings))
        });
        computed?.map_err(|cause| FrameError::of_stage(&label.frame, stage, cause))
    }

    /// Sends a frame to the next stage, or its end if this was it. Returns whether anybody listens.
    fn pass<'l, K, B>(
        &self,
        label: Label<K>,
        known: Known<'l>,
        computed: Result<B, FrameError>,
        to: &Sender<Parcel<'l, K, B>>,
        ended: &Sender<Ended<K>>,
    ) -> bool {
        match computed {
            Ok(content) => to.send(Parcel { label, known, content }).is_ok(),
            Err(error) => ended.send(self.end(label, outcome_of(error))).is_ok(),
        }
    }

    fn write<'l, K>(&self, from: &Receiver<Parcel<'l, K, Surface>>, ended: &Sender<Ended<K>>) {
        for Parcel { label, known, content } in from {
            // Where frames keep their order, those before this one are past all other stages: what is
            // written before a stop does not depend on timing.
            let outcome = if self.is_stopped_before(label.number) {
                Outcome::NotStarted
            } else {
                self.write_one(&label, known, content)
            };
            if ended.send(self.end(label, outcome)).is_err() {
                return;
            }
        }
    }

    fn write_one<K>(&self, label: &Label<K>, known: Known<'_>, surface: Surface) -> Outcome {
        let start = Instant::now();
        let frame = &label.frame;
        (self.began)(frame, Stage::Write);
        let made_from = (known.input.hash, known.obstacles.0.as_str());
        let surface = Arc::new(surface);
        let write = |format, out: &mut BufWriter<&File>| {
            write_surface(&surface, (label.number, frame), made_from, format, &self.crew, out)
        };
        let written = FrameError::catch(&frame.input, Stage::Write, || {
            let certify = self.conduct.certificates.then_some((known.input.hash, &surface.report));
            write_files(frame, write, certify)
        });
        match written.flatten() {
            Ok(Written { paths, sizes_bytes }) => Outcome::Converted(Box::new(FrameReport {
                input: known.input,
                skin: surface.report.clone(),
                obstacles: known.obstacles.0.clone(),
                obstacle_open_edge_count: known.obstacles.1,
                read_seconds: known.read_seconds,
                write_seconds: start.elapsed().as_secs_f64(),
                peak_memory_bytes: peak_memory_bytes(),
                outputs: paths,
                output_bytes: sizes_bytes,
                notes: [known.notes, surface_notes(&surface, &frame.outputs, &frame.settings)].concat(),
            })),
            Err(error) => Outcome::Failed(error),
        }
    }

    fn end<K>(&self, Label { number, key, frame }: Label<K>, outcome: Outcome) -> Ended<K> {
        if is_failure(&outcome) {
            self.failed_first.fetch_min(number, Ordering::Relaxed);
        }
        Ended { key, frame, outcome }
    }

    /// Whether a frame before this one failed, and that was to be the end.
    fn is_stopped_before(&self, number: usize) -> bool {
        self.conduct.on_error == OnError::Stop && self.failed_first.load(Ordering::Relaxed) < number
    }
}

/// Whether a frame needs nothing of its particles but their positions, and these not all at once.
fn needs_positions_only(settings: &Settings) -> bool {
    Wanted::by(settings).is_nothing() && settings.anisotropy == Anisotropy::None
}

/// What became of a frame with this error.
fn outcome_of(error: FrameError) -> Outcome {
    if matches!(error.cause, Cause::Changed) { Outcome::Changed } else { Outcome::Failed(error) }
}

fn is_failure(outcome: &Outcome) -> bool {
    matches!(outcome, Outcome::Failed(_) | Outcome::Changed)
}

/// Memory for reading a file, in sizes of the file: its bytes, and the particles that are parsed from them.
const READING_MEMORY: u64 = 2;

/// What leaves of obstacles are kept may take one part in so many of the memory that a frame may take.
const OBSTACLE_SHARE: u64 = 16;

/// Files of this size and more are read batch by batch where their format allows it. Smaller ones are sooner read
/// once than gone through twice.
const STREAMED_FROM_BYTES: u64 = 16 << 20;

/// Memory for writing a surface, in sizes of the surface: itself, and its level set as it is packed, or not.
const WRITING_MEMORY: u64 = 2;
