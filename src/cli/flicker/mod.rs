//! `meniscus flicker`: scores how much a sequence of surfaces from any program flickers.
//!
//! ```text
//!   meshes ────┐ matched by number     three consecutive frames ──▶ scores of the middle one
//!   particles ─┘ or time: find()                                      │
//!                                                                     ▼
//!                                                  scores.rs: totals, tables, a picture
//! ```

mod scores;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use meniscus_formats::Format;

use crate::pipeline::{
    AttributeRequest, FrameFile, MeshFile, Sequence, are_same_file, common_step, frame_rate, measure_spacing,
    parse_particles, read_file, shown, spray_beside, step_of,
};
use crate::surface::flicker::{
    CARRY_REACH, Carrier, Distribution, Enclosed, FlickerFrame, MovingParticles, carried_distances, enclosed,
    flicker, lag,
};
use crate::surface::obstacle::MeshDistance;
use crate::surface::options::{ColumnNames, ReadOptions, SpacingOptions};

use super::CommandOutcome;
use super::args::FlickerArgs;
use super::console::Console;
use super::destination::write_file;
use super::frame_selection::FrameSelection;
use super::inputs::{check_output_path, find_inputs, only_sequence, refuse_times, with_files_of_folders};
use super::machine::thread_pool;
use super::render_session::{catch_panic, named_picture};
use super::wording::{pluralize, significant, with_causes};
use scores::{FlickerTotals, FrameScores, ScoredFrame};

/// If more than this share of the points has no particle in range, the mesh and the particles probably do not
/// belong together.
const UNTRACKED_SHARE_MAX: f64 = 0.5;

/// Scores the frames that the arguments name.
///
/// # Errors
/// If no frame can be scored.
pub(super) fn score(args: &FlickerArgs, console: &mut Console) -> Result<CommandOutcome> {
    let frames = find(args, console)?;
    refuse_outputs(args, &frames)?;
    let pool = thread_pool(args.threads)?;
    let spacing = match args.spacing {
        Some(spacing) => spacing,
        None => {
            let (spacing, warnings) = pool.install(|| estimated_spacing(&frames, &reading_of(args)))?;
            warnings.iter().for_each(|warning| console.warning(warning));
            spacing
        }
    };
    console.show_bar(frames.scored.len());
    let mut scoring = Scoring {
        args,
        frames: &frames,
        spacing,
        carrier: None,
        ready: BTreeMap::new(),
        enclosed: BTreeMap::new(),
        failed_count: 0,
        has_warned_of_open_mesh: false,
    };
    let mut totals = FlickerTotals::new(args.picture.is_some());
    for &number in &frames.scored {
        if let Some(scored) = pool.install(|| scoring.score(number, console))? {
            console.print_line(line_of(&scored));
            totals.add(scored);
        }
        console.advance_bar();
    }
    console.hide_bar();
    let Scoring { failed_count, carrier, enclosed, .. } = scoring;
    let summary = totals.summary();
    let (Some(carrier), true) = (carrier, summary.count > 0) else {
        bail!(
            "no frame can be scored: a frame needs a mesh with triangles, particles near it, and readable frames before and \
             after it"
        );
    };
    report(&frames, &totals, &enclosed, &summary, spacing, carrier, console);
    if let Some(path) = &args.csv {
        write_file(path, |out| scores::write_frames(&totals.frames, out))?;
    }
    if let Some(path) = &args.points {
        write_file(path, |out| scores::write_points(&totals.worst_points, out))?;
    }
    if let Some(path) = &args.picture {
        let bytes = pool.install(|| scores::encoded(&frames, &totals, &summary))?;
        write_file(path, |out| out.write_all(&bytes))?;
    }
    Ok(if failed_count > 0 { CommandOutcome::SomeFailed } else { CommandOutcome::Done })
}

/// The state while frames are read and scored in order.
struct Scoring<'a> {
    args: &'a FlickerArgs,
    frames: &'a FlickerFrames,
    spacing: f64,
    /// How points are followed from frame to frame. The first frame with particles determines it.
    carrier: Option<Carrier>,
    /// The frames read so far that may be needed again, by number; `None` for unreadable ones.
    ready: BTreeMap<i64, Option<FlickerFrame>>,
    /// What the surfaces of all frames read so far enclose, by number.
    enclosed: BTreeMap<i64, Enclosed>,
    failed_count: usize,
    /// Whether the first open mesh was reported.
    has_warned_of_open_mesh: bool,
}

impl Scoring<'_> {
    /// The scores of a frame; `None` if its mesh is empty, if it or a neighbour cannot be read, or if no particles
    /// were found yet.
    ///
    /// # Errors
    /// If the particles have neither ids nor velocities, or have only velocities and the time between frames
    /// is unknown.
    fn score(&mut self, number: i64, console: &mut Console) -> Result<Option<ScoredFrame>> {
        let numbers = [number - self.frames.step, number, number + self.frames.step];
        self.ready.retain(|known, _| *known >= numbers[0]);
        for number in numbers {
            if !self.ready.contains_key(&number) {
                let read = self.read(number, console)?;
                let enclosed = read.as_ref().map(|frame| (number, enclosed(frame, self.spacing)));
                self.enclosed.extend(enclosed);
                self.ready.insert(number, read);
            }
        }
        let found = numbers.map(|number| self.ready.get(&number).and_then(Option::as_ref));
        let ([Some(before), Some(middle), Some(after)], Some(carrier), Some(&enclosed)) =
            (found, self.carrier, self.enclosed.get(&number))
        else {
            return Ok(None);
        };
        let name = self.frames.name_of(number);
        if middle.surface().bounds().is_none() {
            console.warning(format_args!("{name}: the mesh is empty, so it has no points to score"));
            return Ok(None);
        }
        let samples = usize::try_from(self.args.samples).unwrap_or(usize::MAX);
        let found = flicker([before, middle, after], carrier, self.spacing, samples);
        if found.untracked_count as f64 > UNTRACKED_SHARE_MAX * samples as f64 {
            console.warning(format_args!(
                "{name}: {} of {samples} points on the surface have no particle within {CARRY_REACH} spacings ({}): check \
                 --spacing, --fps or --dt, and that meshes and particles have the same unit and the same axes",
                found.untracked_count,
                significant(CARRY_REACH * self.spacing)
            ));
        }
        let spacing = self.spacing;
        let distances = |from: &FlickerFrame, to: &FlickerFrame, carrier: Carrier| -> Vec<f64> {
            carried_distances(from, to, carrier, spacing, samples).into_iter().flatten().collect()
        };
        let drifts = [distances(middle, after, carrier), distances(before, after, carrier.over(2))];
        let volume_step = volume_step(&self.enclosed, number, self.frames.step);
        let mut scores = FrameScores { flicker: found, drifts, enclosed, volume_step, lag: None };
        let unaveraged = self.frames.files.get(&number).and_then(|files| files.unaveraged.as_ref());
        if let Some(own) = unaveraged.map(|path| catch_panic(path, || read_surface(path))) {
            match own {
                Ok(own) => scores.lag = lag(middle, after, &own, carrier, spacing, samples),
                Err(error) => {
                    self.failed_count += 1;
                    console.error(with_causes(&error));
                }
            }
        }
        Ok(Some(ScoredFrame::new(number, name, scores)))
    }

    /// Reads a frame. If it cannot be read, prints the error and returns `None`.
    fn read(&mut self, number: i64, console: &mut Console) -> Result<Option<FlickerFrame>> {
        let Some(files) = self.frames.files.get(&number) else { return Ok(None) };
        let (spacing, reading) = (self.spacing, reading_of(self.args));
        let frame = match catch_panic(&files.mesh, || read_frame(files, spacing, &reading)) {
            Ok(frame) => frame,
            Err(error) => {
                self.failed_count += 1;
                console.error(with_causes(&error));
                return Ok(None);
            }
        };
        if frame.surface().open_edge_count() > 0
            && !std::mem::replace(&mut self.has_warned_of_open_mesh, true)
        {
            console.warning(format_args!(
                "{}: the mesh has {}: scores near them are less exact; close the mesh",
                shown(&files.mesh),
                pluralize(frame.surface().open_edge_count(), "open edge")
            ));
        }
        let carrier = match self.carrier {
            Some(carrier) => carrier,
            // A frame without particles does not determine how points are followed.
            None if !frame.has_particles() => return Ok(Some(frame)),
            None => {
                let carrier = self.carrier_of(&frame, &files.particles)?;
                *self.carrier.insert(carrier)
            }
        };
        if frame.has(carrier) {
            return Ok(Some(frame));
        }
        self.failed_count += 1;
        let (lacking, attribute) = match carrier {
            Carrier::Ids => ("most particles lack a unique id", "id"),
            Carrier::Velocities { .. } => ("the particles have no velocities", "velocity"),
        };
        console.error(format_args!(
            "{}: {lacking}, unlike those of the first frame with particles: write `{attribute}` with the particles of every frame",
            shown(&files.particles)
        ));
        Ok(None)
    }

    /// How points are followed: by ids if possible, or else by velocities.
    fn carrier_of(&self, frame: &FlickerFrame, particles: &Path) -> Result<Carrier> {
        // The times of steps are those of their numbers.
        let known_rate = || Some(frame_rate(step_of(particles)?.0)? / self.frames.particle_step as f64);
        let seconds = self.args.dt.or_else(|| self.args.fps.or_else(known_rate).map(f64::recip));
        // A step of the meshes may span several steps of the particles.
        let seconds = seconds.map(|seconds| seconds * self.frames.particle_steps());
        let velocities = Carrier::Velocities { seconds: seconds.unwrap_or(1.0) };
        if frame.has(Carrier::Ids) {
            Ok(Carrier::Ids)
        } else if !frame.has(velocities) {
            bail!(
                "{}: the particles have neither velocities nor unique ids, and one of them is needed to follow their motion: \
                 write `id` or `velocity` with the particles",
                shown(particles)
            )
        } else if seconds.is_none() {
            bail!(
                "{}: the particles have velocities and no ids, so the time between frames is needed: give --fps or --dt",
                shown(particles)
            )
        } else {
            Ok(velocities)
        }
    }
}

/// The change of the volume from a frame to the next, relative to the volume; `None` if either was not read,
/// or encloses nothing because it is open or turned inside out.
fn volume_step(enclosed: &BTreeMap<i64, Enclosed>, number: i64, step: i64) -> Option<f64> {
    let [volume, next] =
        [enclosed.get(&number)?, enclosed.get(&number.checked_add(step)?)?].map(|at| at.volume);
    (volume > 0.0 && next >= 0.0).then(|| next / volume - 1.0)
}

fn line_of(frame: &ScoredFrame) -> String {
    let ScoredFrame { name, summary, drifts, untracked_count, clamped_count, enclosed, .. } = frame;
    if summary.count == 0 {
        return format!(
            "{name}: not scored: no point on the surface can be tracked to both neighbouring frames"
        );
    }
    let mut line = format!("{name}: {}, {}", numbers_of(summary), drifts_of(drifts));
    if *clamped_count > 0 {
        line += &format!(", {clamped_count} of {} points clamped", summary.count);
    }
    if *untracked_count > 0 {
        line += &format!(", {untracked_count} untracked");
    }
    if enclosed.ghost_count > 0 {
        line += &format!(", {}", pluralize(enclosed.ghost_count, "ghost"));
    }
    line
}

fn numbers_of(summary: &Distribution) -> String {
    let Distribution { rms, median, percentile_99, max, .. } = *summary;
    format!("flicker {rms:.4} (median {median:.4}, 99 % {percentile_99:.4}, max {max:.4})")
}

fn drifts_of([first, lag_2]: &[Distribution; 2]) -> String {
    format!("first difference {:.4}, lag 2 {:.4}", first.rms, lag_2.rms)
}

fn report(
    frames: &FlickerFrames,
    totals: &FlickerTotals,
    enclosed: &BTreeMap<i64, Enclosed>,
    summary: &Distribution,
    spacing: f64,
    carrier: Carrier,
    console: &mut Console,
) {
    let count = pluralize(totals.frames.iter().filter(|frame| frame.summary.count > 0).count(), "frame");
    let drifts = drifts_of(&totals.drifts());
    console.print_line(format_args!("{}: {}, {drifts} spacings, {count}", frames.name, numbers_of(summary)));
    let carrier = match carrier {
        Carrier::Ids => "ids".to_owned(),
        Carrier::Velocities { seconds } => format!("velocities, {} s between frames", significant(seconds)),
    };
    console.print_line(format_args!("spacing {}; points are tracked by {carrier}", significant(spacing)));
    let ghost_count: usize = enclosed.values().map(|at| at.ghost_count).sum();
    let volume_steps = enclosed.keys().filter_map(|&number| volume_step(enclosed, number, frames.step));
    let volume_step = volume_steps.map(f64::abs).max_by(f64::total_cmp);
    let scored = totals.frames.iter().filter(|frame| frame.summary.count > 0);
    let lags: Vec<f64> = scored.filter_map(|frame| frame.lag).collect();
    let mut line = pluralize(ghost_count, "ghost");
    if let Some(volume_step) = volume_step {
        line += &format!(", largest volume step {:.2} %", 100.0 * volume_step);
    }
    if !lags.is_empty() {
        line += &format!(", lag {:.4} spacings", lags.iter().sum::<f64>() / lags.len() as f64);
    }
    console.print_line(line);
    if let Some(worst) = totals.worst_points.first() {
        let [x, y, z] = worst.position.map(significant);
        let value = worst.value;
        console.print_line(format_args!(
            "worst point: {value:.4} at ({x}, {y}, {z}) in {}",
            frames.name_of(worst.frame)
        ));
    }
}

/// Refuses output files that cannot be written, or would replace an input or each other.
fn refuse_outputs(args: &FlickerArgs, frames: &FlickerFrames) -> Result<()> {
    let outputs = [("--csv", &args.csv), ("--points", &args.points), ("--picture", &args.picture)];
    let mut paths: Vec<&Path> = Vec::new();
    for (option, path) in outputs {
        let Some(path) = path else { continue };
        if option == "--picture" {
            named_picture(path, &["png"])?;
        }
        check_output_path(option, path)?;
        let of_frame = |files: &'_ FrameFiles| [Some(files.mesh.clone()), files.unaveraged.clone()];
        let meshes: Vec<PathBuf> = frames.files.values().flat_map(of_frame).flatten().collect();
        let mut inputs = meshes.iter().chain(&frames.particles);
        if let Some(input) = inputs.find(|input| are_same_file(input, path)) {
            bail!("{option} {}: would replace the input {}", path.display(), input.display());
        }
        if paths.iter().any(|other| are_same_file(other, path)) {
            bail!("{option} {}: another option names the same file", path.display());
        }
        paths.push(path);
    }
    Ok(())
}

// Matches meshes with particles, and finds the frames that have both neighbours.
//
// ```text
//   meshes      1     3     5  6  7
//   particles   1  2  3  4  5  6  7           the frames with both: 1, 3, 5, 6, 7
//                                             step: the greatest common divisor of their differences, 1
//                                             frame 6 is scored, because 5 and 7 are in the list
// ```
//
// Files with times are matched by their times, and numbered in steps of the median difference.

/// The files of a frame.
#[derive(Clone, Debug)]
struct FrameFiles {
    mesh: PathBuf,
    particles: PathBuf,
    /// The mesh that was not averaged over time, if it is given.
    unaveraged: Option<PathBuf>,
    /// The name of the frame.
    name: String,
}

/// The frames of a sequence.
#[derive(Debug)]
struct FlickerFrames {
    /// The name of the sequence of meshes.
    name: String,
    /// The frames that have both files, by number.
    files: BTreeMap<i64, FrameFiles>,
    /// All particle files in the order of their sequence, with or without meshes.
    particles: Vec<PathBuf>,
    /// The greatest common divisor of the differences between the numbers of `files`.
    step: i64,
    /// The greatest common divisor of the differences between the numbers of all particle files, with or
    /// without meshes.
    particle_step: u64,
    /// The selected frames that have both neighbours.
    scored: Vec<i64>,
}

impl FlickerFrames {
    fn name_of(&self, number: i64) -> String {
        self.files.get(&number).map_or_else(|| number.to_string(), |files| files.name.clone())
    }

    /// The number of particle frames per step.
    fn particle_steps(&self) -> f64 {
        self.step as f64 / self.particle_step as f64
    }
}

/// Maximum number of frames listed in a message.
const NUMBERS_NAMED: usize = 8;

/// Finds the frames that the arguments name.
///
/// # Errors
/// If no three consecutive frames exist.
fn find(args: &FlickerArgs, console: &mut Console) -> Result<FlickerFrames> {
    let formats: Vec<&[&str]> =
        Format::ALL.iter().filter(|format| format.has_mesh()).map(|format| format.extensions()).collect();
    let meshes = with_files_of_folders(&args.meshes, &formats, "meshes")?;
    let mut meshes = one_sequence(&meshes, None, "meshes", console)?;
    let particles = one_sequence(&args.particles, args.columns.as_ref(), "particles", console)?;
    refuse_times(args.frames.as_ref(), [&meshes, &particles])?;
    let name = meshes.name.clone();
    let particle_paths = particles.frames.iter().map(|file| file.path.clone()).collect();
    let times = NumbersOfTimes::of(&particles);
    times.leave_out_other_times(&mut meshes, console);
    let (meshes, mut particles) = (times.sort(meshes)?, times.sort(particles)?);
    let mut unaveraged = match &args.unaveraged[..] {
        [] => BTreeMap::new(),
        given => {
            let given = with_files_of_folders(given, &formats, "meshes")?;
            let mut given = one_sequence(&given, None, "unaveraged meshes", console)?;
            times.leave_out_other_times(&mut given, console);
            times.sort(given)?
        }
    };
    let particle_numbers: Vec<i64> = particles.keys().copied().collect();
    let (mut files, mut alone) = (BTreeMap::new(), Vec::new());
    for (number, mesh) in meshes {
        match particles.remove(&number) {
            Some(particles) => {
                let name = mesh.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
                let unaveraged = unaveraged.remove(&number).map(|file| file.path);
                files.insert(
                    number,
                    FrameFiles { mesh: mesh.path, particles: particles.path, unaveraged, name },
                );
            }
            None => alone.push(number),
        }
    }
    if !alone.is_empty() {
        console.warning(format_args!("{name}: no particles for {}: not used", times.listed(&alone)));
    }
    let numbers: Vec<i64> = files.keys().copied().collect();
    if numbers.len() < 3 {
        bail!(
            "{name}: {} both a mesh and particles, and three frames are needed: check that their numbers or times agree",
            if numbers.len() == 1 {
                "1 frame has".to_owned()
            } else {
                format!("{} frames have", numbers.len())
            }
        );
    }
    let step = i64::try_from(common_step(&numbers)).unwrap_or(i64::MAX);
    let has_neighbors = |number: &i64| {
        let neighbors = number.checked_sub(step).zip(number.checked_add(step));
        neighbors.is_some_and(|(before, after)| files.contains_key(&before) && files.contains_key(&after))
    };
    let inner = &numbers[1..numbers.len() - 1];
    let (with_neighbors, skipped): (Vec<i64>, Vec<i64>) = inner.iter().copied().partition(has_neighbors);
    if with_neighbors.is_empty() {
        bail!(
            "{name}: no three frames follow each other: {} both a mesh and particles",
            times.listed_with(&numbers, ["has", "have"])
        );
    }
    if !skipped.is_empty() {
        console.warning(format_args!(
            "{name}: {} not scored: the mesh or the particles of a neighbour are missing",
            times.listed_with(&skipped, ["is", "are"])
        ));
    }
    let is_selected = |number: &i64| {
        args.frames.as_ref().is_none_or(|selection: &FrameSelection| selection.contains(*number))
    };
    let scored: Vec<i64> = with_neighbors.iter().copied().filter(is_selected).collect();
    if scored.is_empty() {
        bail!(
            "--frames selects none of the frames that have both neighbours: {}",
            times.listed(&with_neighbors)
        );
    }
    if !args.unaveraged.is_empty() {
        let lacks = |number: &i64| files.get(number).is_some_and(|files| files.unaveraged.is_none());
        let lacking: Vec<i64> = scored.iter().copied().filter(lacks).collect();
        if !lacking.is_empty() {
            console.warning(format_args!(
                "--unaveraged: no mesh for {}: the lag is not measured there",
                times.listed(&lacking)
            ));
        }
    }
    let particle_step = common_step(&particle_numbers);
    Ok(FlickerFrames { name, files, particles: particle_paths, step, particle_step, scored })
}

fn one_sequence(
    inputs: &[PathBuf],
    columns: Option<&ColumnNames>,
    what: &str,
    console: &mut Console,
) -> Result<Sequence> {
    let found = find_inputs(inputs, columns)?;
    found.report(console);
    only_sequence(found.files, &format!("the {what} must be of one sequence"))
}

/// The numbers that stand for the times in names of particles; empty if the names have frame numbers.
#[derive(Default)]
struct NumbersOfTimes {
    /// By the bits of the time.
    numbers: HashMap<u64, i64>,
    /// By the number.
    times: BTreeMap<i64, f64>,
}

impl NumbersOfTimes {
    /// Times that are up to 1.5 median differences apart have consecutive numbers. Longer differences, where
    /// frames are missing, are rounded to such steps.
    fn of(particles: &Sequence) -> NumbersOfTimes {
        let with_times = particles.frames.iter().filter(|file| file.has_time());
        let times: Vec<f64> = with_times.filter_map(FrameFile::value).collect();
        let mut differences: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        differences.sort_by(f64::total_cmp);
        let median = differences.get(differences.len() / 2).copied().unwrap_or(1.0);
        let mut of_times = NumbersOfTimes::default();
        let mut number = 1;
        for (index, &time) in times.iter().enumerate() {
            if let Some(before) = index.checked_sub(1) {
                number += ((time - times[before]) / median).round().clamp(1.0, STEPS_MAX) as i64;
            }
            of_times.numbers.insert(time.to_bits(), number);
            of_times.times.insert(number, time);
        }
        of_times
    }

    /// Leaves out the meshes whose times no particles have, with a warning.
    fn leave_out_other_times(&self, meshes: &mut Sequence, console: &mut Console) {
        let count = meshes.frames.len();
        meshes.frames.retain(|file| !file.has_time() || self.number(file).is_some());
        if meshes.frames.len() < count {
            let unmatched = pluralize(count - meshes.frames.len(), "mesh file");
            console.warning(format_args!(
                "{}: no particles have the time of {unmatched}: not used",
                meshes.name
            ));
        }
    }

    fn number(&self, file: &FrameFile) -> Option<i64> {
        if file.has_time() { self.numbers.get(&file.value()?.to_bits()).copied() } else { file.number() }
    }

    /// The frames of a sequence by their numbers.
    fn sort(&self, sequence: Sequence) -> Result<BTreeMap<i64, FrameFile>> {
        let mut files: BTreeMap<i64, FrameFile> = BTreeMap::new();
        for file in sequence.frames {
            let Some(number) = self.number(&file) else {
                bail!("{}: the name has no frame number to match meshes and particles by", shown(&file.path));
            };
            if let Some(other) = files.get(&number) {
                bail!(
                    "{} and {} are both {}: subframes cannot be scored",
                    shown(&other.path),
                    shown(&file.path),
                    self.listed(&[number])
                );
            }
            files.insert(number, file);
        }
        Ok(files)
    }

    /// Frames by their numbers or times.
    fn listed(&self, numbers: &[i64]) -> String {
        let distinct: BTreeSet<i64> = numbers.iter().copied().collect();
        // A frame number has no time, even among times.
        let has_times = numbers.iter().all(|number| self.times.contains_key(number));
        let name = |number: &i64| match self.times.get(number) {
            Some(time) if has_times => time.to_string(),
            _ => number.to_string(),
        };
        let mut names: Vec<String> = distinct.iter().take(NUMBERS_NAMED).map(name).collect();
        if distinct.len() > NUMBERS_NAMED {
            names.push(format!("and {} more", distinct.len() - NUMBERS_NAMED));
        }
        let kind = if has_times { "time" } else { "frame" };
        format!("{kind}{} {}", if distinct.len() == 1 { "" } else { "s" }, names.join(", "))
    }

    /// Frames by their numbers or times, followed by `one` if there is one frame, or else by `several`.
    fn listed_with(&self, numbers: &[i64], [one, several]: [&str; 2]) -> String {
        format!("{} {}", self.listed(numbers), if numbers.len() == 1 { one } else { several })
    }
}

/// The most steps between two times.
const STEPS_MAX: f64 = 1e6;

// Reads a frame from its two files.

fn reading_of(args: &FlickerArgs) -> ReadOptions {
    ReadOptions { columns: args.columns.clone(), filter: args.filter.clone() }
}

/// Reads the mesh of a frame, and the particles that meet the condition.
fn read_frame(files: &FrameFiles, spacing: f64, reading: &ReadOptions) -> Result<FlickerFrame> {
    let surface = read_surface(&files.mesh)?;
    let mut particles = read_moving(&files.particles, reading)?;
    // The points beside a mesh do not move it.
    if let Some(spray) = spray_beside(&files.mesh) {
        particles = particles.without(&read_moving(&spray, &ReadOptions::default())?);
    }
    Ok(FlickerFrame::new(particles, surface, spacing))
}

fn read_surface(path: &Path) -> Result<MeshDistance> {
    let mesh = MeshFile::read(path)?.data;
    Ok(MeshDistance::new(&mesh.positions, &mesh.triangles))
}

/// Measures the particle spacing as `convert` does, on all frames of the particles, and returns warnings
/// about it.
fn estimated_spacing(frames: &FlickerFrames, reading: &ReadOptions) -> Result<(f64, Vec<String>)> {
    let options = SpacingOptions { reading: reading.clone(), ..SpacingOptions::default() };
    let measured = measure_spacing(frames.particles.iter().map(|path| &**path), &options)?;
    Ok((measured.spacing, measured.warnings))
}

fn read_moving(path: &Path, reading: &ReadOptions) -> Result<MovingParticles> {
    let content = read_file(path)?;
    let read = parse_particles(path, content, &AttributeRequest::to_follow(reading))?;
    Ok(MovingParticles::of(read.cloud.positions, &read.cloud.attributes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::sequences;

    fn sequence_of_times() -> Sequence {
        let names = ["p_0.9667.ply", "p_1.0000.ply", "p_1.0333.ply", "p_1.1000.ply"];
        let found = sequences(names.map(|name| FrameFile::new(name.into())).to_vec());
        let [particles] = found.try_into().expect("one sequence");
        particles
    }

    #[test]
    fn times_are_counted_in_steps() {
        let particles = sequence_of_times();
        let numbers = NumbersOfTimes::of(&particles);
        let found: Vec<Option<i64>> = particles.frames.iter().map(|file| numbers.number(file)).collect();
        assert_eq!(found, [Some(1), Some(2), Some(3), Some(5)]);
        // The mesh of a time need not have the same decimals.
        assert_eq!(numbers.number(&FrameFile::new("mesh_1.00.obj".into())), Some(2));
        assert_eq!(numbers.number(&FrameFile::new("mesh_7.5.obj".into())), None);
        assert_eq!(numbers.number(&FrameFile::new("mesh.7.obj".into())), Some(7));
    }

    #[test]
    fn long_lists_are_shortened() {
        let listed = |numbers: &[i64]| NumbersOfTimes::default().listed(numbers);
        assert_eq!(listed(&[7]), "frame 7");
        let with_verb = NumbersOfTimes::default().listed_with(&[7, 9], ["is", "are"]);
        assert_eq!(with_verb, "frames 7, 9 are");
        assert_eq!(NumbersOfTimes::of(&sequence_of_times()).listed(&[1, 5]), "times 0.9667, 1.1");
        assert_eq!(listed(&(1..=10).collect::<Vec<_>>()), "frames 1, 2, 3, 4, 5, 6, 7, 8, and 2 more");
    }
}
