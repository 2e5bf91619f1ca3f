//! What all frames of a sequence share: found out once, told, and the same whichever of them are converted.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result};
use rayon::ThreadPool;

use crate::pipeline::{
    self, AutomaticVoxelSize, FrameError, FrameFile, NOTHING, OutputOptions, Sequence, automatic_voxel_size,
    frame_name, frames_in, is_own_output, sequence_bounds, step_of,
};
use crate::settings::Settings;

use super::args::MethodArgs;
use super::choices::choices;
use super::console::Console;
use super::selecting::SelectedSequence;
use super::wording::{counted, significant};

/// The settings of a sequence, or why it has none. Settings that make no sense end everything.
///
/// # Errors
/// When they make none.
pub(super) fn resolve_settings(
    SelectedSequence { sequence, selected }: &SelectedSequence,
    method: &MethodArgs,
    outputs: &OutputOptions,
    pool: &ThreadPool,
    console: &mut Console,
) -> Result<Result<Resolved, String>> {
    let choices = choices(method);
    let automatic = match method.first.voxel_size {
        Some(_) => None,
        None => {
            let paths = || sequence.frames.iter().map(|file| &*file.path);
            let own_radii = choices.own_radii()?;
            match pool.install(|| automatic_voxel_size(paths(), own_radii.as_ref())) {
                Ok(automatic) => Some(automatic),
                Err(error) => return Ok(Err(error.to_string())),
            }
        }
    };
    let given = method.first.voxel_size;
    let voxel_size = given.or(automatic.as_ref().map(|automatic| automatic.voxel_size));
    let settings =
        Settings::resolve(voxel_size.unwrap_or(f64::NAN), &choices).with_context(|| sequence.name.clone())?;
    say_settings(sequence, selected.len(), &settings, automatic.as_ref(), console);
    if automatic.is_some() {
        warn_of_siblings(sequence, console);
    }
    for warning in settings.warnings() {
        console.warn(format_args!("warning: {}: {warning}", sequence.name));
    }
    let outputs = match pool.install(|| outputs_of(sequence, &settings, outputs)) {
        Ok(outputs) => Arc::new(outputs),
        Err(error) => return Ok(Err(error.to_string())),
    };
    Ok(Ok(Resolved { settings: Arc::new(settings), automatic, outputs }))
}

/// What all frames of a sequence are converted with.
pub(super) struct Resolved {
    pub(super) settings: Arc<Settings>,
    /// Where the voxel size is from, unless it was given.
    pub(super) automatic: Option<AutomaticVoxelSize>,
    /// The camera of pictures is fixed.
    pub(super) outputs: Arc<OutputOptions>,
}

/// What is written of the frames of a sequence: all its pictures have the same camera, whichever are converted.
fn outputs_of(
    sequence: &Sequence,
    settings: &Settings,
    outputs: &OutputOptions,
) -> Result<OutputOptions, FrameError> {
    if !outputs.needs_camera() {
        return Ok(outputs.clone());
    }
    let paths: Vec<&Path> = sequence.frames.iter().map(|file| &*file.path).collect();
    let bounds = sequence_bounds(&paths, settings.radius_min)?;
    Ok(outputs.with_camera_around(bounds.unwrap_or(NOTHING)))
}

/// A frame converted without the rest of its sequence is measured by itself: other frames converted
/// so get other settings, and the sequence flickers.
fn warn_of_siblings(sequence: &Sequence, console: &Console) {
    let [frame] = &sequence.frames[..] else { return };
    if frame.number().is_none() {
        return;
    }
    if let Some((file, _)) = step_of(&frame.path) {
        return say_siblings(frame, frames_in(file).map_or(1, |steps| steps.len()), console);
    }
    let folder =
        frame.path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    let files = entries.flatten().map(|entry| FrameFile::new(folder.join(entry.file_name()))).collect();
    let is_ours = |s: &Sequence| s.frames.iter().any(|file| file.name() == frame.name());
    let siblings = pipeline::sequences(files).into_iter().find(is_ours).map_or(Vec::new(), |s| s.frames);
    let count = siblings.iter().filter(|file| !is_own_output(&file.path)).count();
    say_siblings(frame, count, console);
}

fn say_siblings(frame: &FrameFile, count: usize, console: &Console) {
    if count > 1 {
        console.warn(format_args!(
            "warning: {}: its sequence has {count} frames, and its voxel size was measured on this one alone; \
             name the whole sequence and pick with --frames, or give --voxel-size",
            frame.name()
        ));
    }
}

fn say_settings(
    sequence: &Sequence,
    selected_count: usize,
    settings: &Settings,
    automatic: Option<&AutomaticVoxelSize>,
    console: &mut Console,
) {
    let frames = counted(selected_count, "frame");
    let voxel_size = match automatic {
        None => settings.voxel_size.to_string(),
        Some(AutomaticVoxelSize { voxel_size, spacing, radius_median, measured_on }) => format!(
            "{} ({}, measured on {})",
            significant(*voxel_size),
            match radius_median {
                Some(radius) => format!("1/√3 of the particles' median r_min {}", significant(*radius)),
                None => format!("half the particle spacing {}", significant(*spacing)),
            },
            frame_name(measured_on)
        ),
    };
    let [radius_min, radius_init, radius_max] =
        [settings.radius_min, settings.radius_init, settings.radius_max].map(significant);
    console.say(format_args!(
        "{}: {frames}, voxel size {voxel_size}, radii {radius_min} / {radius_init} / {radius_max}, {}",
        sequence.name,
        counted(settings.steps as usize, "step")
    ));
}
