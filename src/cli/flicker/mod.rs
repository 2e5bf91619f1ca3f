//! `meniscus flicker`: scores how much a sequence of surfaces from any program flickers.
//!
//! ```text
//!   frames    matches meshes with particles, and finds the frames that have both neighbours
//!   reading   reads a frame from its two files
//!   tally     collects the scores of all frames, and the worst frames and points
//!   tables    writes the scores and the worst points as CSV
//!   picture   plots the scores over the frames, and shows the worst frames
//! ```

mod frames;
mod picture;
mod reading;
mod tables;
mod totals;

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Result, bail};

use crate::pipeline::{are_same_file, shown};
use crate::surface::flicker::{CARRY_REACH, Carrier, Distribution, FlickerFrame, flicker};

use super::CommandOutcome;
use super::args::FlickerArgs;
use super::console::Console;
use super::machine::thread_pool;
use super::out_folder::write_file;
use super::render_session::{catch_panic, named_picture};
use super::select::check_output_path;
use super::wording::{pluralize, significant, with_causes};

use frames::FlickerFrames;
use totals::{FlickerTotals, ScoredFrame};

/// If more than this share of the points has no particle in range, the mesh and the particles probably do not
/// belong together.
const UNTRACKED_SHARE_MAX: f64 = 0.5;

/// Scores the frames that the arguments name.
///
/// # Errors
/// If no frame can be scored.
pub(super) fn score(args: &FlickerArgs, console: &mut Console) -> Result<CommandOutcome> {
    let frames = frames::find(args, console)?;
    refuse_outputs(args, &frames)?;
    let pool = thread_pool(args.threads)?;
    let spacing = match args.spacing {
        Some(spacing) => spacing,
        None => {
            let (spacing, warnings) =
                pool.install(|| reading::estimated_spacing(&frames, args.filter.as_ref()))?;
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
    let (failed_count, carrier) = (scoring.failed_count, scoring.carrier);
    let summary = totals.summary();
    let (Some(carrier), true) = (carrier, summary.count > 0) else {
        bail!(
            "no frame can be scored: a frame needs a mesh with triangles, particles near it, and readable frames before and \
             after it"
        );
    };
    report(&frames, &totals, &summary, spacing, carrier, console);
    if let Some(path) = &args.csv {
        write_file(path, |out| tables::write_frames(&totals.frames, out))?;
    }
    if let Some(path) = &args.points {
        write_file(path, |out| tables::write_points(&totals.worst_points, out))?;
    }
    if let Some(path) = &args.picture {
        let bytes = pool.install(|| picture::encoded(&frames, &totals, &summary))?;
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
    failed_count: usize,
    /// Whether the first open mesh was reported.
    has_warned_of_open_mesh: bool,
}

impl Scoring<'_> {
    /// The scores of a frame; `None` if its mesh is empty, or if it or a neighbour cannot be read.
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
                self.ready.insert(number, read);
            }
        }
        let found = numbers.map(|number| self.ready.get(&number).and_then(Option::as_ref));
        let ([Some(before), Some(middle), Some(after)], Some(carrier)) = (found, self.carrier) else {
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
        Ok(Some(ScoredFrame::new(number, name, found)))
    }

    /// Reads a frame. If it cannot be read, prints the error and returns `None`.
    fn read(&mut self, number: i64, console: &mut Console) -> Result<Option<FlickerFrame>> {
        let Some(files) = self.frames.files.get(&number) else { return Ok(None) };
        let (spacing, filter) = (self.spacing, self.args.filter.as_ref());
        let frame = match catch_panic(&files.mesh, || reading::read_frame(files, spacing, filter)) {
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
            "{}: {lacking}, unlike those of the first frame: write `{attribute}` with the particles of every frame",
            shown(&files.particles)
        ));
        Ok(None)
    }

    /// How points are followed: by ids if possible, or else by velocities.
    fn carrier_of(&self, frame: &FlickerFrame, particles: &Path) -> Result<Carrier> {
        let seconds = self.args.dt.or_else(|| self.args.fps.map(f64::recip));
        // A step of the meshes may span several steps of the particles.
        let seconds = seconds.map(|seconds| seconds * self.frames.particle_steps());
        let velocities = Carrier::Velocities { seconds: seconds.unwrap_or(1.0) };
        if frame.has(Carrier::Ids) {
            Ok(Carrier::Ids)
        } else if !frame.has(velocities) {
            bail!(
                "{}: the particles have neither velocities nor ids of their own, and one of them is needed to follow their motion: \
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

fn line_of(frame: &ScoredFrame) -> String {
    let ScoredFrame { name, summary, untracked_count, clamped_count, .. } = frame;
    if summary.count == 0 {
        return format!(
            "{name}: not scored: no point on the surface can be tracked to both neighbouring frames"
        );
    }
    let mut line = format!("{name}: {}", numbers_of(summary));
    if *clamped_count > 0 {
        line += &format!(", {clamped_count} of {} points clamped", summary.count);
    }
    if *untracked_count > 0 {
        line += &format!(", {untracked_count} untracked");
    }
    line
}

fn numbers_of(summary: &Distribution) -> String {
    let Distribution { rms, median, percentile_99, max, .. } = *summary;
    format!("flicker {rms:.4} (median {median:.4}, 99 % {percentile_99:.4}, max {max:.4})")
}

fn report(
    frames: &FlickerFrames,
    totals: &FlickerTotals,
    summary: &Distribution,
    spacing: f64,
    carrier: Carrier,
    console: &mut Console,
) {
    let count = pluralize(totals.frames.iter().filter(|frame| frame.summary.count > 0).count(), "frame");
    console.print_line(format_args!("{}: {} spacings, {count}", frames.name, numbers_of(summary)));
    let carrier = match carrier {
        Carrier::Ids => "ids".to_owned(),
        Carrier::Velocities { seconds } => format!("velocities, {} s between frames", significant(seconds)),
    };
    console.print_line(format_args!("spacing {}; points are tracked by {carrier}", significant(spacing)));
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
        let mut inputs = frames.files.values().map(|files| &files.mesh).chain(&frames.particles);
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
