//! The thread for slow requests: measuring sequences, and searching files for steps. The threads of the
//! watched folders keep scanning meanwhile.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use crossbeam::channel::{Sender, unbounded};
use glam::DVec3;
use rayon::ThreadPoolBuilder;

use crate::pipeline::{
    Attempt, FileStamp, FrameError, Framed, SequenceCamera, SharedSettings, Stage, frames_in_unless,
    measure_sequence, named_by_unreadable, preset_warning, sequence_bounds,
};
use crate::surface::options::{self, Settings};
use crate::watch::core::events::{Event, FoundSteps, SlowRequest, StepsOrder, UnreadableFrame};
use crate::watch::core::frames::FrameId;
use crate::watch::core::sequences::{MeasureOrder, SpacingResult, requested_camera};

/// Starts the thread; it ends when the returned sender is dropped and `is_over` is set.
///
/// # Errors
/// When the system refuses to start a thread.
pub(super) fn spawn(
    threads: usize,
    is_over: Arc<AtomicBool>,
    events: Sender<Event>,
) -> io::Result<Sender<SlowRequest>> {
    let (sender, requests) = unbounded();
    thread::Builder::new().name("slow".into()).spawn(move || {
        for request in requests {
            if is_over.load(Ordering::Relaxed) {
                return;
            }
            let event = match request {
                SlowRequest::FindSteps(order) => Event::StepsFound(find_steps(order, &is_over)),
                // A separate thread pool: the threads of the pipeline are busy with frames.
                SlowRequest::Measure(order) => match ThreadPoolBuilder::new().num_threads(threads).build() {
                    Ok(pool) => Event::Measured(Box::new(pool.install(|| measure(*order)))),
                    Err(_) => Event::Measured(Box::new(measure(*order))),
                },
            };
            // Fails only if the daemon has already ended.
            let _ = events.send(event);
        }
    })?;
    Ok(sender)
}

/// Searches a file for steps; stops early once the daemon is ending.
fn find_steps(order: StepsOrder, is_over: &AtomicBool) -> FoundSteps {
    let path = &order.id.path;
    let is_same = || FileStamp::of_path(path).is_ok_and(|now| now == order.stamp);
    // The request may have waited behind other files.
    if !is_same() {
        return FoundSteps { order, frames: Ok(None) };
    }
    let read = FrameError::catch(path, Stage::Read, || frames_in_unless(path, is_over));
    let read = read.and_then(|read| read.map_err(|error| FrameError::file(path, Stage::Read, error)));
    let frames = if is_same() { read.map(Some).map_err(unreadable) } else { Ok(None) };
    FoundSteps { order, frames }
}

fn unreadable(error: FrameError) -> UnreadableFrame {
    UnreadableFrame { named: named_by_unreadable(&error.path), error }
}

/// Measures the particle spacing, unless the voxel size is known, and fits the camera of pictures.
fn measure(order: MeasureOrder) -> SpacingResult {
    let mut measured = SpacingResult {
        sequence: order.sequence,
        record: None,
        sparse: Vec::new(),
        unreadable: Vec::new(),
        changed: None,
        warnings: Vec::new(),
    };
    let record = match &order.known {
        Some(record) => Some(record.clone()),
        None => {
            let paths: Vec<&Path> = order.files.iter().map(|(id, _)| &*id.path).collect();
            let note = |path: &Path, attempt: Attempt| note(&mut measured, path, attempt, &order);
            let found = measure_sequence(&paths, &order.options, order.others_may_come, note);
            found.map(|found| {
                let choices = &order.watch.choices;
                let of_spacing = found.warnings.iter().filter(|_| choices.spacing.is_none()).cloned();
                let of_preset =
                    preset_warning(choices, found.irregularity).map(|warning| warning.to_string());
                measured.warnings = of_spacing.chain(of_preset).collect();
                SharedSettings { measured: Some(found), ..SharedSettings::default() }
            })
        }
    };
    let record = match record {
        Some(record) if order.watch.outputs.needs_camera() => with_camera(record, &order, &mut measured),
        record => record,
    };
    measured.record = record.filter(|_| measured.changed.is_none());
    measured
}

/// Notes the result of a frame, unless the frame has changed since it was found complete.
fn note(measured: &mut SpacingResult, path: &Path, attempt: Attempt, order: &MeasureOrder) {
    let found = order.files.iter().find(|(id, _)| &*id.path == path);
    let Some((id, stamp)) = found else { return };
    if FileStamp::of_path(id.file_path()).ok() != Some(*stamp) {
        measured.changed.get_or_insert_with(|| id.clone());
        return;
    }
    match attempt {
        Attempt::Measured => {}
        Attempt::TooFewParticles { .. } => measured.sparse.push((id.clone(), *stamp)),
        Attempt::Unreadable(error) => measured.unreadable.push((id.clone(), *stamp, unreadable(error))),
    }
}

/// The record with the camera fitted to the first frame that was not skipped when the spacing was measured;
/// `None` if there is no such frame.
fn with_camera(
    record: SharedSettings,
    order: &MeasureOrder,
    measured: &mut SpacingResult,
) -> Option<SharedSettings> {
    let outputs = &order.watch.outputs;
    // If the settings are invalid, other code ends the sequence.
    let spacing = record.measured.as_ref().map(options::SequenceSpacing::from);
    let settings = Settings::resolve(&order.watch.choices, spacing);
    let radius = settings.map_or(0.0, |settings| settings.resting_height());
    let measured_on = record.measured.as_ref().map(|measured| &measured.measured_on);
    let measured_here = measured_on.filter(|_| order.known.is_none());
    let is_before = |id: &FrameId| measured_here.is_some_and(|first| *id.path != **first);
    for (id, _) in order.files.iter().skip_while(|(id, _)| is_before(id)) {
        let (attempt, bounds) = match sequence_bounds(&[&*id.path], radius, &order.options.reading) {
            Ok(Some(bounds)) => (Attempt::Measured, Some(bounds)),
            Ok(None) => (Attempt::TooFewParticles { count: 0 }, None),
            Err(error) => (Attempt::Unreadable(error), None),
        };
        note(measured, &id.path, attempt, order);
        if let Some(bounds) = bounds {
            let framed = Framed::around(widened(bounds, outputs.up().direction()), outputs);
            let camera = Some(SequenceCamera { requested: requested_camera(outputs), framed });
            return Some(SharedSettings { camera, ..record });
        }
        if measured.changed.is_some() {
            return None;
        }
    }
    None
}

/// A box with room for the fluid in the given box to spread: wider by half its height on each side.
fn widened([least, greatest]: [DVec3; 2], up: DVec3) -> [DVec3; 2] {
    let lateral = (DVec3::ONE - up) * (0.5 * (greatest - least).dot(up));
    [least - lateral, greatest + lateral]
}
