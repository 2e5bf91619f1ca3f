//! Determines the settings that all frames of a sequence share, independent of which frames are converted.

use std::fmt;
use std::path::Path;

use anyhow::{Context, Result};

use crate::pipeline::{
    self, EMPTY_BOUNDS, FrameError, FrameFile, MeasuredSpacing, NoSpacing, OutputOptions, Sequence,
    frame_name, frames_in, is_own_output, measure_spacing, sequence_bounds, step_of,
};
use crate::surface::options::{Length, MethodOptions, SequenceSpacing, Settings};

use super::console::Console;
use super::out_folder::folder_of;
use super::wording::{pluralize, significant};

/// The settings for a sequence of particles with this spacing.
///
/// # Errors
/// If the options are invalid.
pub(super) fn settings_of(
    sequence: &Sequence,
    options: &MethodOptions,
    measured: Option<&MeasuredSpacing>,
) -> Result<Settings> {
    Settings::resolve(options, measured.map(SequenceSpacing::from)).with_context(|| sequence.name.clone())
}

/// Prints warnings about settings that the user should check.
pub(super) fn warn_of(sequence: &Sequence, settings: &Settings, console: &Console) {
    for warning in settings.warnings() {
        console.warning(format_args!("{}: {warning}", sequence.name));
    }
}

/// Measures the particle spacing of a sequence if the options need it, and prints warnings about it. `None`
/// if the options do not need it, or if it cannot be measured and is derived from the given voxel size.
///
/// # Errors
/// If it cannot be measured, and no voxel size was given.
pub(super) fn measured_spacing(
    sequence: &Sequence,
    choices: &MethodOptions,
    console: &Console,
) -> Result<Option<MeasuredSpacing>, NoSpacing> {
    if !choices.needs_spacing() {
        return Ok(None);
    }
    let warn = |what: &dyn fmt::Display| console.warning(format_args!("{}: {what}", sequence.name));
    let paths = sequence.frames.iter().map(|file| &*file.path);
    // An invalid radius scale is ignored here: `Settings::resolve` reports it.
    let options = choices.spacing_options().unwrap_or_default();
    match (measure_spacing(paths, &options), choices.voxel_size.and_then(Length::world)) {
        (Ok(measured), _) => {
            measured.warnings.iter().for_each(|warning| warn(warning));
            Ok(Some(measured))
        }
        (Err(none), Some(_)) => {
            // Unreadable frames are reported when they are converted.
            if none.sparse_count > 0 {
                warn(
                    &"the particle spacing cannot be measured and is derived from the voxel size: give --spacing",
                );
            }
            Ok(None)
        }
        (Err(none), None) => Err(none),
    }
}

/// The output options of a sequence. All its pictures have the same camera, whichever frames are converted.
///
/// # Errors
/// If none of the frames that determine the camera can be read.
pub(super) fn outputs_of(
    sequence: &Sequence,
    settings: &Settings,
    outputs: &OutputOptions,
) -> Result<OutputOptions, FrameError> {
    if !outputs.needs_camera() {
        return Ok(outputs.clone());
    }
    let paths: Vec<&Path> = sequence.frames.iter().map(|file| &*file.path).collect();
    let bounds = sequence_bounds(&paths, settings.resting_height(), settings.filter.as_ref())?;
    Ok(outputs.with_camera_around(bounds.unwrap_or(EMPTY_BOUNDS)))
}

/// Warns if the input is a single frame of a longer sequence. The spacing is then measured on this frame
/// only, so frames that are converted one by one have different settings, and the sequence flickers.
pub(super) fn warn_of_siblings(sequence: &Sequence, console: &Console) {
    let [frame] = &sequence.frames[..] else { return };
    if frame.value().is_none() {
        return;
    }
    let count = match step_of(&frame.path) {
        Some((file, _)) => frames_in(file).map_or(1, |steps| steps.len()),
        None => sibling_count(frame),
    };
    if count > 1 {
        console.warning(format_args!(
            "{}: its sequence has {count} frames, and its spacing was measured on this one alone; \
             name the whole sequence and select frames with --frames, or give --spacing",
            frame.name()
        ));
    }
}

/// The number of files in the frame's folder that belong to the same sequence, including the frame itself.
fn sibling_count(frame: &FrameFile) -> usize {
    let folder = folder_of(&frame.path);
    let Ok(entries) = std::fs::read_dir(folder) else { return 0 };
    let files = entries.flatten().map(|entry| FrameFile::new(folder.join(entry.file_name()))).collect();
    let is_ours = |s: &Sequence| s.frames.iter().any(|file| file.name() == frame.name());
    let siblings = pipeline::sequences(files).into_iter().find(is_ours).map_or(Vec::new(), |s| s.frames);
    siblings.iter().filter(|file| !is_own_output(&file.path)).count()
}

/// Prints the settings of a sequence.
pub(super) fn report_settings(
    sequence: &Sequence,
    selected_count: usize,
    settings: &Settings,
    measured: Option<&MeasuredSpacing>,
    console: &mut Console,
) {
    let frames = pluralize(selected_count, "frame");
    let spacing = measured.map(|measured| {
        let MeasuredSpacing { spacing, radius_median, measured_on, measured_count, .. } = measured;
        let radius = radius_median.map_or(String::new(), |radius| {
            format!(", and the median r_min of the particles {}", significant(radius))
        });
        let measured_on = match measured_count {
            1 => frame_name(measured_on),
            count => pluralize(*count, "frame"),
        };
        format!("spacing {}{radius} (measured on {measured_on}), ", significant(*spacing))
    });
    let spacing = spacing.unwrap_or_default();
    let voxel_size = significant(settings.voxel_size);
    let [radius_min, radius_init, radius_max] =
        [settings.radius_min, settings.radius_init, settings.radius_max].map(significant);
    console.print_line(format_args!(
        "{}: {frames}, {spacing}voxel size {voxel_size}, r_min {radius_min}, r_init {radius_init}, r_max {radius_max}, {}",
        sequence.name,
        pluralize(settings.steps as usize, "step")
    ));
}
