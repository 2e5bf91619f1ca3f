//! From files to particles: one thread, which asks for the next frame when there is room for one.
//!
//! A file that is large, and of which positions are enough, is gone through batch by batch later; here it is hashed. Any
//! other is read whole. Parsing and planning are work for the pool.

use std::io;
use std::sync::Arc;
use std::time::Instant;

use crossbeam::channel::Sender;
use twox_hash::XxHash3_128;

use crate::pipeline::attributes::Wanted;
use crate::pipeline::frame::{Cause, Frame, FrameError, Outcome, ReadInput, Stage};
use crate::pipeline::frame_particles::{FileParticles, FrameParticles};
use crate::pipeline::inspection::certified_fault;
use crate::pipeline::method::Method;
use crate::pipeline::obstacle_notes::out_of_reach;
use crate::pipeline::obstacles::FoundObstacles;
use crate::pipeline::provenance::is_done;
use crate::pipeline::reading::{InputFile, parse_particles, read_frame_unchanged};
use crate::pipeline::steps::{reading_bytes, step_of};
use crate::surface::options::Settings;

use super::Conduct;
use super::line::{Ended, Known, Label, Line, Noted, Parcel, Read, outcome_of};

impl<'scope, 'env: 'scope, M: Method> Line<'_, 'scope, 'env, M> {
    /// Reads frames until there are none, or nobody listens any more.
    pub(super) fn read<'l, K>(
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
        self.begin(frame, Stage::Read);
        let start = Instant::now();
        let read = FrameError::catch(&frame.input, Stage::Read, || self.particles_of(number, frame));
        let (read, input, noted) = read.map_err(Outcome::Failed).flatten()?;
        // Those that stand still are there for the frames that follow, too. They are named by where they are, which the
        // frames of this line keep as it is; and nobody takes their room between this and the next.
        let standing_bytes = read.obstacles.all_bytes - read.obstacles.own_bytes;
        self.budget.set_aside(Arc::as_ptr(&frame.obstacles).addr(), standing_bytes);
        let given_bytes = read.particles.size_bytes().saturating_add(read.obstacles.own_bytes);
        if let Some(observer) = self.conduct.observer {
            observer.planned(frame, &read.plan, given_bytes);
        }
        memory.resize(given_bytes);
        let read_seconds = start.elapsed().as_secs_f64();
        let obstacles = (read.obstacles.recorded.clone(), read.obstacles.open_edge_count);
        Ok((read, Known { input, read_seconds, noted, obstacles, memory, seat: None }))
    }

    /// The particles of a frame, and the notes on them.
    fn particles_of(&self, number: usize, frame: &Frame) -> Result<(Read, ReadInput, Noted), Outcome> {
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
            self.refuse_done(frame, input, &obstacles)?;
            let streamed = FileParticles::open(&frame.input, file)
                .map_err(|error| Outcome::Failed(FrameError::file(&frame.input, Stage::Read, error)))?;
            if let Some(particles) = streamed {
                let noted = Noted { notes: particles.notes(), unused_velocity: particles.unused_velocity() };
                let particles = FrameParticles::OnDisk(Box::new(particles));
                return self.planned(number, frame, move || Ok((particles, noted)), obstacles, input);
            }
        }
        let unchanged = read_frame_unchanged(&frame.input, self.conduct.steps_found_by).map_err(failed)?;
        let (bytes, stamp) = unchanged.ok_or(Outcome::Changed)?;
        let input = ReadInput { stamp, hash: XxHash3_128::oneshot(&bytes) };
        self.refuse_done(frame, input, &obstacles)?;
        let path = frame.input.clone();
        let parse = move || {
            let read = parse_particles(&path, &bytes, &wanted)?;
            let noted = Noted { notes: read.notes, unused_velocity: read.unused_velocity };
            Ok((FrameParticles::InMemory(read.cloud), noted))
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

    /// Ends a frame that needs not be made again, where such frames are skipped.
    fn refuse_done(
        &self,
        frame: &Frame,
        input: ReadInput,
        obstacles: &FoundObstacles,
    ) -> Result<(), Outcome> {
        let Conduct { skip_done, certificates, .. } = *self.conduct;
        if !skip_done {
            return Ok(());
        }
        let obstacles = obstacles.recorded();
        let fault = match certificates {
            true => certified_fault(frame, input.hash, &obstacles),
            false => is_done(frame, input.hash, &obstacles)
                .then(|| self.conduct.recorded_fault(&frame.output_paths()))
                .flatten(),
        };
        fault.map_or(Ok(()), |fault| Err(Outcome::AlreadyDone { input, fault }))
    }

    /// Has a frame parsed and planned in the pool; waiting for the disk before it is no work for that.
    fn planned(
        &self,
        number: usize,
        frame: &Frame,
        parse: impl FnOnce() -> Result<(FrameParticles, Noted), FrameError> + Send + 'env,
        found: FoundObstacles,
        input: ReadInput,
    ) -> Result<(Read, ReadInput, Noted), Outcome> {
        let (method, frame, allowed_bytes) = (self.method, frame.clone(), self.conduct.memory_bytes);
        let planned = self.crew.run(number, move || {
            let (particles, mut noted) = parse()?;
            let notes = &mut noted.notes;
            let failed = |cause| FrameError::of_stage(&frame, Stage::Read, cause);
            let loaded = frame.obstacles.load(found, &frame.settings, allowed_bytes);
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
            Ok((Read { particles, obstacles, plan }, noted))
        });
        let (read, noted) = planned.map_err(outcome_of)?;
        Ok((read, input, noted))
    }
}

/// Whether a frame needs nothing of its particles but their positions, and these not all at once.
fn needs_positions_only(settings: &Settings) -> bool {
    Wanted::by(settings).is_nothing()
}

/// Memory for reading a file, in sizes of the file: its bytes, and the particles that are parsed from them.
const READING_MEMORY: u64 = 2;

/// Files of this size and more are read batch by batch where their format allows it. Smaller ones are sooner read
/// once than gone through twice.
const STREAMED_FROM_BYTES: u64 = 16 << 20;
