//! Reads particles and level sets: one thread, which requests the next frame when there is room for one.
//!
//! A large file of which only positions are needed is streamed in batches later; this thread only hashes it.
//! Other files are read whole. Parsing and planning happen in the pool.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use crossbeam::channel::Sender;
use twox_hash::XxHash3_128;

use crate::pipeline::budget::Reservation;
use crate::pipeline::error::{Cause, Conflict, FrameError, Stage};
use crate::pipeline::files::input_file::{InputFile, read_unchanged};
use crate::pipeline::input::around::{self, FoundFrame, find_around, not_averaged};
use crate::pipeline::input::attributes::AttributeRequest;
use crate::pipeline::input::container::is_container_file;
use crate::pipeline::input::frame::{Frame, InputState, Job, Outcome, Seconds};
use crate::pipeline::input::frame_input::{FileParticles, FrameInput, LevelSetInput, read_level_set};
use crate::pipeline::input::level_set_file::other_grids;
use crate::pipeline::input::obstacles::{FoundObstacles, FrameObstacles};
use crate::pipeline::input::out_of_reach::out_of_reach;
use crate::pipeline::input::position_doubts::position_doubts;
use crate::pipeline::input::reading::{hash_of, parse_particles, read_frame_unchanged};
use crate::pipeline::input::steps::{StampedContent, reading_bytes, step_of};
use crate::pipeline::method;
use crate::pipeline::records::content::irreplaceable_output;
use crate::pipeline::records::provenance::MadeFrom;
use crate::pipeline::warning::Warning;
use crate::surface::attributes::add_computed;
use crate::surface::particles::ParticleCloud;
use crate::surface::reconstruction::MemoryPlan;
use crate::surface::spray::Spray;
use meniscus_formats::{Limits, Loaded};

use super::compute::is_of_content;
use super::history::HistoryNotes;
use super::spray::{SeparatedCloud, with_around};
use super::{
    FinishedFrame, InputInfo, InputNotes, ObstacleSummary, ReadContent, Stages, WorkItem, outcome_of,
};

/// A frame that was read.
struct ReadResult {
    content: ReadContent,
    input: InputState,
    noted: InputNotes,
    around: Vec<FoundFrame>,
}

impl<'scope, 'env: 'scope> Stages<'_, 'scope, 'env> {
    /// Reads frames until `next` returns `None`, or the caller is gone.
    pub(super) fn read<K>(
        &self,
        mut next: impl FnMut() -> Option<(K, Frame)>,
        slots: &Sender<()>,
        to: &Sender<WorkItem<'env, K, ReadContent>>,
        finished: &Sender<FinishedFrame<K>>,
    ) {
        // Sending fails when the caller is gone.
        for order in 0.. {
            if slots.send(()).is_err() {
                return;
            }
            let Some((key, mut frame)) = next() else { return };
            let is_sent = match self.read_one(order, &mut frame) {
                Ok((content, info)) => to.send(WorkItem { order, key, frame, info, content }).is_ok(),
                Err(outcome) => self.shared.finish(order, finished, FinishedFrame { key, frame, outcome }),
            };
            if !is_sent {
                return;
            }
        }
    }

    fn read_one(&self, order: usize, frame: &mut Frame) -> Result<(ReadContent, InputInfo<'env>), Outcome> {
        let shared = self.shared;
        if shared.is_stopped_before(order) {
            return Err(Outcome::NotStarted);
        }
        // This is 0 if the metadata cannot be read: then the file cannot be read later either.
        let file_bytes = reading_bytes(&frame.input, shared.options.index_policy);
        let obstacle_bytes = frame.obstacles.loading_bytes(frame.number);
        let bytes = file_bytes.saturating_mul(reading_memory(frame)).saturating_add(obstacle_bytes);
        let mut memory = shared.budget.reserve_input(bytes);
        shared.begin(frame, Stage::Read);
        let start = Instant::now();
        let read = FrameError::catch(&frame.input.clone(), Stage::Read, || {
            refuse_to_replace(frame).map_err(Outcome::Failed)?;
            match frame.job {
                Job::Surface => self.read_particle_frame(order, frame),
                Job::LevelSet { .. } => self.level_set_of(order, frame),
                Job::Particles => self.content_of(frame),
            }
        });
        let ReadResult { content, input, noted, around } = read.map_err(Outcome::Failed).flatten()?;
        let user = frame.is_averaged().then(|| shared.smoothed.user());
        let seconds = Seconds { read: start.elapsed().as_secs_f64(), ..Seconds::default() };
        let (obstacles, needed_bytes) = match &content {
            ReadContent::Particles(_) => (ObstacleSummary::default(), bytes),
            ReadContent::Surface { input, obstacles, plan } => {
                let spray_bytes = noted.spray.as_ref().map_or(0, Spray::size_bytes) as u64;
                let given_bytes = input.size_bytes().saturating_add(spray_bytes);
                let needed_bytes = self.account_for(frame, given_bytes, obstacles, plan, &mut memory);
                let (recorded, open_edge_count) = (obstacles.recorded.clone(), obstacles.open_edge_count);
                (ObstacleSummary { recorded, open_edge_count }, needed_bytes)
            }
        };
        let computing = None;
        let info =
            InputInfo { input, seconds, noted, obstacles, around, user, computing, needed_bytes, memory };
        Ok((content, info))
    }

    /// Reduces the reservation of a frame that was read to what it holds until it is computed: `given_bytes`, and its own
    /// obstacles. Returns the memory
    /// that all its stages need, in bytes.
    fn account_for(
        &self,
        frame: &Frame,
        given_bytes: u64,
        obstacles: &FrameObstacles,
        plan: &MemoryPlan,
        memory: &mut Reservation<'_>,
    ) -> u64 {
        // Static obstacles are shared with later frames. The address of the `Arc` identifies them; it does
        // not change while this pipeline has frames. Until `resize` below, this frame's reservation still
        // includes their memory, so no other frame can reserve it in between.
        let standing_bytes = obstacles.all_bytes - obstacles.own_bytes;
        self.shared.budget.set_shared(Arc::as_ptr(&frame.obstacles).addr(), standing_bytes);
        let given_bytes = given_bytes.saturating_add(obstacles.own_bytes);
        if let Some(observer) = self.shared.options.observer {
            observer.planned(frame, plan, given_bytes);
        }
        memory.resize(given_bytes);
        plan.memory_bytes.saturating_add(given_bytes)
    }

    /// The content of a frame that is converted to another particle format.
    fn content_of(&self, frame: &Frame) -> Result<ReadResult, Outcome> {
        let (content, input) = self.read_whole(frame)?;
        self.end_if_done(frame, &input, "", &[])?;
        let content = ReadContent::Particles(content);
        Ok(ReadResult { content, input, noted: InputNotes::default(), around: Vec::new() })
    }

    /// Reads the level set of a frame, and gives the frame the voxel size and the origin of its file.
    fn level_set_of(&self, order: usize, frame: &mut Frame) -> Result<ReadResult, Outcome> {
        let memory_bytes = self.shared.options.memory_bytes;
        let file_bytes = frame.input.metadata().map_or(0, |metadata| metadata.len());
        check_file_of_level_set(file_bytes, &frame.job, memory_bytes)
            .map_err(|error| unreadable(frame, error))?;
        let unchanged = read_unchanged(&frame.input).map_err(|error| unreadable(frame, error))?;
        let (bytes, stamp) = unchanged.ok_or(Outcome::Changed)?;
        let input = InputState { stamp, hash: XxHash3_128::oneshot(&bytes), named: None };
        let given = frame.clone();
        let parsed = self.scheduler.run(order, move || {
            let (read, file) = read_level_set(&given, &bytes, memory_bytes)?;
            Ok((read, file, other_grids(&bytes)))
        });
        let (read, mut file, other_grids) = parsed.map_err(outcome_of)?;
        *frame = read;
        self.end_if_done(frame, &input, "", &[])?;
        let warnings = std::mem::take(&mut file.warnings).into_iter().chain(other_grids).collect();
        let given = FrameInput::LevelSet(Box::new(LevelSetInput::new(file, &frame.job)));
        let noted = InputNotes { warnings, ..InputNotes::default() };
        let found = FoundObstacles::default();
        self.parse_and_plan(order, frame, move || Ok((given, noted)), (found, Vec::new()), input)
    }

    /// The content of a frame's file, or of its step.
    fn read_whole(&self, frame: &Frame) -> Result<(Loaded, InputState), Outcome> {
        let unchanged = read_frame_unchanged(&frame.input, self.shared.options.index_policy);
        let unchanged = unchanged.map_err(|error| unreadable(frame, error))?;
        let StampedContent { content, stamp, named } = unchanged.ok_or(Outcome::Changed)?;
        let hash = hash_of(&content);
        Ok((content, InputState { stamp, hash, named }))
    }

    /// Finds the obstacles of a frame of particles and the frames around it, ends it if it is done already, reads
    /// it, and plans its reconstruction.
    fn read_particle_frame(&self, order: usize, frame: &Frame) -> Result<ReadResult, Outcome> {
        let of_obstacle = |error| frame.failed(Stage::Read, Cause::Obstacle(Box::new(error)));
        let found = frame.obstacles.find(frame.number);
        let obstacles = found.map_err(|error| Outcome::Failed(of_obstacle(error)))?;
        let shared = self.shared;
        let (around, left_out_warnings) = find_around(frame, &shared.hashes, shared.options.index_policy);
        let wanted = AttributeRequest::for_frame(frame);
        if let Some(file) = self.worth_streaming(frame).map_err(|error| unreadable(frame, error))? {
            let hash = file.hash().map_err(|error| unreadable(frame, error))?;
            let input = InputState { stamp: file.stamp(), hash, named: None };
            if !file.is_unchanged().map_err(|error| unreadable(frame, error))? {
                return Err(Outcome::Changed);
            }
            self.end_if_done(frame, &input, &obstacles.recorded(), &around)?;
            let streamed =
                FileParticles::open(&frame.input, file).map_err(|error| unreadable(frame, error))?;
            if let Some(particles) = streamed {
                let path = frame.input.clone();
                let choose = move || {
                    let failed = |cause| FrameError { path: path.clone(), during: Stage::Read, cause };
                    let particles = particles.chosen_by(wanted.reading.filter.as_ref()).map_err(failed)?;
                    let warnings = [particles.warnings().map_err(failed)?, left_out_warnings].concat();
                    let unused_velocity = particles.unused_velocity();
                    let noted = InputNotes { warnings, unused_velocity, ..InputNotes::default() };
                    Ok((FrameInput::OnDisk(Box::new(particles)), noted))
                };
                return self.parse_and_plan(order, frame, choose, (obstacles, around), input);
            }
        }
        let (content, input) = self.read_whole(frame)?;
        self.end_if_done(frame, &input, &obstacles.recorded(), &around)?;
        let (given, hash, others) = (frame.clone(), input.hash, around.clone());
        let parse = move || {
            let mut read = parse_particles(&given.input, content, &wanted)?;
            let mut notes = shared.follow_back(&mut read.cloud, (&given, hash), &others);
            shared.complete_velocities(&mut read.cloud, &given, &others, &mut notes);
            let HistoryNotes { warnings: of_history, mut unread, has_computed_velocities } = notes;
            let ParticleCloud { positions, attributes, .. } = &mut read.cloud;
            add_computed(positions, attributes, &given.settings);
            let mut warnings = [read.warnings, left_out_warnings, of_history].concat();
            let sequence = with_around(&given, hash, &others);
            let SeparatedCloud { fluid, spray, lacks_ids, failures } =
                shared.without_spray(read.cloud, &given.settings, &sequence, 0);
            if lacks_ids {
                warnings.push(Warning::new(
                    "the particles have no ids of their own, so each frame alone decides which of them are spray, and pieces \
                     may flicker between the surface and the points",
                ));
            }
            warnings.extend(failures.iter().map(|(_, error)| not_averaged(error)));
            let may_be_read = failures.iter().filter(|(_, error)| !is_of_content(&error.cause, ""));
            unread.extend(may_be_read.map(|(steps, _)| *steps));
            let unused_velocity = read.unused_velocity;
            let noted = InputNotes { warnings, unused_velocity, spray, unread, has_computed_velocities };
            Ok((FrameInput::InMemory(fluid), noted))
        };
        self.parse_and_plan(order, frame, parse, (obstacles, around), input)
    }

    /// Parses and plans a frame in the pool; only the reading before it happens on this thread.
    fn parse_and_plan(
        &self,
        order: usize,
        frame: &Frame,
        parse: impl FnOnce() -> Result<(FrameInput, InputNotes), FrameError> + Send + 'env,
        (found, mut around): (FoundObstacles, Vec<FoundFrame>),
        input: InputState,
    ) -> Result<ReadResult, Outcome> {
        let memory_bytes = self.shared.options.memory_bytes;
        let frame = frame.clone();
        let planned = self.scheduler.run(order, move || {
            let (given, mut noted) = parse()?;
            let warnings = &mut noted.warnings;
            let failed = |cause| frame.failed(Stage::Read, cause);
            warnings.extend(position_doubts(&given, &frame.settings).map_err(failed)?);
            let loaded = frame.obstacles.load(found, &frame.settings, memory_bytes);
            let mut obstacles = loaded.map_err(|error| failed(Cause::Obstacle(Box::new(error))))?;
            warnings.append(&mut obstacles.warnings);
            let members = obstacles.obstacles.members.iter().map(Arc::as_ref);
            let by_path = obstacles.paths.iter().map(PathBuf::as_path).zip(members);
            warnings.extend(out_of_reach(by_path, &given, &frame.settings).map_err(failed)?);
            let limit = (memory_bytes, frame.held_count());
            let plan = method::plan(&given, &obstacles, &frame.settings, &frame.outputs, limit);
            let plan = plan.map_err(failed)?;
            if plan.tile_leaves.is_some() {
                let whole_bytes = plan.in_core_bytes.saturating_add(given.size_bytes());
                let mebibytes = whole_bytes.div_ceil(1 << 20);
                let sentence =
                    format!("processed in tiles, which takes longer: without tiles it needs {mebibytes} MiB");
                warnings.push(Warning::new(sentence).with_remedy("raise the limit with --memory"));
            }
            Ok((ReadContent::Surface { input: Box::new(given), obstacles, plan }, noted))
        });
        let (content, noted) = planned.map_err(outcome_of)?;
        // Otherwise another attempt would end in the same way.
        for found in around.iter_mut().filter(|found| noted.unread.contains(&found.frame.steps)) {
            found.content = None;
        }
        Ok(ReadResult { content, input, noted, around })
    }

    /// The file of a frame that should be streamed in batches instead of being read at once.
    fn worth_streaming(&self, frame: &Frame) -> io::Result<Option<InputFile>> {
        // Only positions can be read in batches.
        if step_of(&frame.input).is_some() || !AttributeRequest::for_frame(frame).is_empty() {
            return Ok(None);
        }
        let file = InputFile::open(&frame.input)?;
        let is_large = file.is_regular() && file.stamp().size >= STREAMED_FROM_BYTES;
        Ok((is_large && !is_container_file(&frame.input)).then_some(file))
    }

    /// Ends a frame that is done already, if such frames are skipped.
    fn end_if_done(
        &self,
        frame: &Frame,
        input: &InputState,
        obstacles: &str,
        around: &[FoundFrame],
    ) -> Result<(), Outcome> {
        if !self.shared.options.skip_done {
            return Ok(());
        }
        let beside = frame.settings.frame_reach().beside;
        let made_from =
            MadeFrom { input_hash: input.hash, obstacles, around: &around::recorded(around, beside) };
        match frame.recorded_state(made_from) {
            Some((state, Some(record))) if state.is_done() => {
                Err(Outcome::AlreadyDone { input: input.clone(), record })
            }
            _ => Ok(()),
        }
    }
}

/// Refuses a frame that would replace data of another program.
fn refuse_to_replace(frame: &Frame) -> Result<(), FrameError> {
    match irreplaceable_output(&frame.stem, &frame.outputs, frame.job) {
        Ok(None) => Ok(()),
        Ok(Some(output)) => {
            let conflict = Box::new(Conflict::ReplacesData { output });
            Err(frame.failed(Stage::Read, Cause::Conflict(conflict)))
        }
        // It cannot be replaced either.
        Err((output, error)) => Err(FrameError::file(&output, Stage::Write, error)),
    }
}

/// The outcome of a frame whose file cannot be read.
fn unreadable(frame: &Frame, error: impl Into<meniscus_formats::Error>) -> Outcome {
    Outcome::Failed(FrameError::file(&frame.input, Stage::Read, error.into()))
}

/// The memory for reading a file, as a multiple of its size: its bytes, and the parsed data.
fn reading_memory(frame: &Frame) -> u64 {
    match frame.job {
        // Both frames beside it are read and parsed, and their particles are found by their ids.
        Job::Surface if frame.settings.computes_velocities() => 12,
        // The parsed data include all attributes, and are divided; or a frame around is read and parsed beside them.
        Job::Surface if frame.settings.spray > 0 || frame.settings.frame_reach().has_history() => 4,
        Job::Surface => 2,
        // The parsed data include all attributes.
        Job::Particles => 3,
        // The values in the file are compressed to about a quarter.
        Job::LevelSet { .. } => 5,
    }
}

/// Refuses the file of a level set that is larger than the memory limit. Its leaves cannot be counted within
/// the limit, so the error has an amount that usually suffices: such a file typically needs 12 times its
/// size, or 27 times if it is smoothed.
fn check_file_of_level_set(
    file_bytes: u64,
    job: &Job,
    memory_bytes: u64,
) -> Result<(), meniscus_formats::Error> {
    if file_bytes <= memory_bytes {
        return Ok(());
    }
    let times = if job.max_deviation_voxels() > 0.0 { 32 } else { 16 };
    let what = format!("the level set in a file of {} MiB", file_bytes.div_ceil(1 << 20));
    Limits::within(memory_bytes).check_memory(file_bytes.saturating_mul(times), &what)
}

/// Files of this size and larger are read in batches if their format allows it. A smaller file is faster to
/// read once than to stream several times.
const STREAMED_FROM_BYTES: u64 = 16 << 20;
