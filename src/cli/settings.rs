//! From options to settings: those that all frames of a sequence share, whichever of them are converted; options
//! that have no effect or do not apply; and `--print-settings`.

use std::fmt;
use std::io;
use std::path::{Path, absolute};

use anyhow::{Context, Result, anyhow, bail};
use meniscus_formats::compression::read_head;
use meniscus_formats::{WriteOption, check_obstacle, listed};
use rayon::ThreadPool;
use toml::Value;

use crate::pipeline::{
    self, EMPTY_BOUNDS, FrameError, FrameFile, Job, MeasuredSpacing, NoSpacing, ObstacleFiles, OutputFormat,
    OutputOptions, PointFormat, Sequence, UsdStageOptions, frame_name, frames_in, is_level_set,
    is_own_output, measure_spacing, measured_by, open_regular, preset_warning, sequence_bounds, step_of,
};
use crate::surface::options::{
    Length, LengthUnit, MethodOptions, OptionGroup, SequenceSpacing, Settings, Start, ValueKind,
};

use super::args::{FormatArgs, MethodArgs, OptionSet};
use super::console::Console;
use super::destination::folder_of;
use super::inputs::{InputSelection, SelectedSequence, selected_files};
use super::wording::{option_name, option_names, pluralize, significant};

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

/// Measures the particles of a sequence if the options need it, and prints warnings about their spacing and
/// the preset. `None` if the options do not need it, or if nothing can be measured and the spacing is given or
/// is derived from the given voxel size.
///
/// # Errors
/// If nothing can be measured, and neither spacing nor voxel size was given.
pub(super) fn measure_if_needed(
    sequence: &Sequence,
    choices: &MethodOptions,
    console: &Console,
) -> Result<Option<MeasuredSpacing>, NoSpacing> {
    if !choices.needs_measuring() {
        return Ok(None);
    }
    let needs_spacing = choices.spacing.is_none();
    let warn = |what: &dyn fmt::Display| console.warning(format_args!("{}: {what}", sequence.name));
    let paths = sequence.frames.iter().map(|file| &*file.path);
    // An invalid radius scale is ignored here: `Settings::resolve` reports it.
    let options = choices.spacing_options().unwrap_or_default();
    let given = choices.spacing.or(choices.voxel_size.and_then(Length::world));
    let measured = match (measure_spacing(paths, &options), given) {
        (Ok(measured), _) => {
            measured.warnings.iter().filter(|_| needs_spacing).for_each(|warning| warn(warning));
            Some(measured)
        }
        (Err(none), Some(_)) => {
            // Unreadable frames are reported when they are converted.
            if none.sparse_count > 0 && needs_spacing {
                warn(
                    &"the particle spacing cannot be measured and is derived from the voxel size: give --spacing",
                );
            }
            None
        }
        (Err(none), None) => return Err(none),
    };
    if let Some(warning) =
        preset_warning(choices, measured.as_ref().and_then(|measured| measured.irregularity))
    {
        warn(&warning);
    }
    Ok(measured)
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
    let bounds = sequence_bounds(&paths, settings.resting_height(), &settings.reading)?;
    Ok(outputs.with_camera_around(bounds.unwrap_or(EMPTY_BOUNDS)))
}

/// Warns if the input is a single frame of a longer sequence. The particles are then measured on this frame
/// only, so frames that are converted one by one have different settings, and the sequence flickers.
pub(super) fn warn_of_siblings(sequence: &Sequence, choices: &MethodOptions, console: &Console) {
    let [frame] = &sequence.frames[..] else { return };
    if frame.value().is_none() {
        return;
    }
    let count = match step_of(&frame.path) {
        Some((file, _)) => frames_in(file).map_or(1, |steps| steps.len()),
        None => sibling_count(frame),
    };
    if count > 1 {
        let (what, remedy) = measured_by(choices);
        console.warning(format_args!(
            "{}: its sequence has {count} frames, but only this one is measured for the {what}; \
             name the whole sequence and select frames with --frames, or give {remedy}",
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
    choices: &MethodOptions,
    settings: &Settings,
    measured: Option<&MeasuredSpacing>,
    console: &mut Console,
) {
    let frames = pluralize(selected_count, "frame");
    let preset = if choices.is_auto() { format!("preset {}, ", settings.preset) } else { String::new() };
    let spacing = measured.filter(|_| choices.spacing.is_none()).map(|measured| {
        let MeasuredSpacing { spacing, radius_median, measured_on, measured_count, .. } = measured;
        let radius = radius_median.map_or(String::new(), |radius| {
            format!(", and the median radius of the particles {}", significant(radius))
        });
        let measured_on = match measured_count {
            1 => frame_name(measured_on),
            count => pluralize(*count, "frame"),
        };
        format!("spacing {}{radius} (measured on {measured_on}), ", significant(*spacing))
    });
    let spacing = spacing.unwrap_or_default();
    let voxel_size = significant(settings.voxel_size);
    let [least, init, most] =
        [settings.radius_min, settings.radius_init, settings.radius_max].map(significant);
    let lengths = match settings.start {
        Start::Spheres => format!("r_min {least}, r_init {init}, r_max {most}"),
        Start::Kernels => format!("blend {most}"),
    };
    console.print_line(format_args!(
        "{}: {frames}, {spacing}{preset}voxel size {voxel_size}, {lengths}, {}",
        sequence.name,
        pluralize(settings.smoothing.steps as usize, "step")
    ));
}

// Detects options without effect, and finds the obstacles.

/// Warns about options that have no effect. Skipped if the options are invalid: that error is reported later.
pub(super) fn warn_of_ignored(method: &MethodArgs, formats: &FormatArgs, console: &Console) {
    if Settings::check(&method.to_options()).is_ok() {
        for warning in ignored(method, formats, &formats.written()) {
            console.warning(warning);
        }
    }
}

/// The obstacle files that the options name.
///
/// # Errors
/// If a file is missing, or is neither a mesh nor a level set.
pub(super) fn obstacle_files(method: &MethodArgs) -> Result<ObstacleFiles> {
    let obstacles = ObstacleFiles::new(method.obstacle.clone());
    refuse_other_kinds(&obstacles)?;
    if let Some((path, error)) = obstacles.unreadable().next() {
        let name = path.display();
        match error.kind() {
            io::ErrorKind::NotFound => bail!("{name}: obstacle not found"),
            _ => bail!("obstacle {name}: {error}"),
        }
    }
    for path in method.obstacle.iter().filter(|path| path.is_file()) {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let head = open_regular(path).and_then(|file| read_head(file, HEAD_BYTES));
        // An error of reading is reported for each frame, because it may be temporary.
        if let Ok(head) = head {
            check_obstacle(&head, &name).map_err(|error| anyhow!("obstacle {}: {error}", path.display()))?;
        }
    }
    Ok(obstacles)
}

/// Refuses obstacles that exist and are no files, but folders or devices.
///
/// # Errors
/// What it is instead.
pub(super) fn refuse_other_kinds(obstacles: &ObstacleFiles) -> Result<()> {
    for (path, error) in obstacles.unreadable() {
        let name = path.display();
        match error.kind() {
            io::ErrorKind::IsADirectory => bail!(
                "{name}: this is a folder, not an obstacle: give a file, or a pattern such as body.####.obj"
            ),
            io::ErrorKind::InvalidInput => bail!("obstacle {name}: {error}"),
            _ => {}
        }
    }
    Ok(())
}

/// More bytes than are needed to recognise a mesh.
const HEAD_BYTES: u64 = 64 << 10;

/// Warnings about given options that have no effect, one sentence each.
pub(super) fn ignored(method: &MethodArgs, formats: &FormatArgs, written: &[OutputFormat]) -> Vec<String> {
    let options = method.to_options();
    let mut warnings = Vec::new();
    for (name, needed) in options.ineffective(!method.obstacle.is_empty()) {
        let needed = listed(needed.iter().map(|option| option.flag()).collect(), "and");
        warnings.push(format!("{} is ignored: it is for {needed} only", option_name(name)));
    }
    if formats.spray_format.is_some() && !options.has_spray() {
        warnings.push("--spray-format is ignored: it is for --spray only".to_owned());
    }
    // A stage records the axis and the unit.
    let of_stage = [WriteOption::Up, WriteOption::MetersPerUnit].map(WriteOption::key);
    for name in method.given().into_iter().chain(formats.given()) {
        let Some(changed) = formats_changed_by(name) else { continue };
        let is_in_stage = formats.stage.is_some() && of_stage.contains(&name);
        let points = formats.spray_format.iter().flatten().filter(|_| options.has_spray());
        let is_beside =
            |points: &PointFormat| changed.iter().any(|format| PointFormat::beside(*format) == Some(*points));
        let is_in_points = of_stage.contains(&name) && points.into_iter().any(is_beside);
        if !is_in_stage && !is_in_points && !written.iter().any(|format| changed.contains(format)) {
            warnings.push(format!("{} is ignored: it affects {} only", option_name(name), kinds(&changed)));
        }
    }
    let has_unit = |format: &OutputFormat| format.has_option(WriteOption::MetersPerUnit);
    let in_metres = written.iter().find(|format| matches!(format, OutputFormat::Glb | OutputFormat::Gltf));
    if formats.meters_per_unit.is_some_and(|meters| meters != 1.0)
        && written.iter().any(has_unit)
        && let Some(format) = in_metres
    {
        warnings.push(format!(
            "--meters-per-unit does not scale .{format}, whose unit is the metre: its mesh keeps world units"
        ));
    }
    warnings
}

/// The formats whose files an option affects, by its name as an option or in records; `None` for an option
/// that affects the surface, and thus all formats.
fn formats_changed_by(name: &str) -> Option<Vec<OutputFormat>> {
    let write_option =
        WriteOption::SETTINGS.into_iter().find(|option| [option.key(), option.name()].contains(&name));
    let is_of_mesh = MethodOptions::info(name).is_some_and(|info| info.group == OptionGroup::Mesh);
    let is_changed = |format: &OutputFormat| match write_option {
        Some(option) => format.has_option(option),
        None => format.is_mesh(),
    };
    (write_option.is_some() || is_of_mesh).then(|| OutputFormat::ALL.into_iter().filter(is_changed).collect())
}

/// The name for these formats in the message about an option that affects only them.
fn kinds(formats: &[OutputFormat]) -> String {
    let (pictures, files): (Vec<_>, Vec<_>) = formats.iter().partition(|format| format.is_picture());
    let has_all_meshes = OutputFormat::ALL.iter().all(|format| !format.is_mesh() || files.contains(format));
    match (files.as_slice(), pictures.as_slice()) {
        ([], _) => "--preview".to_owned(),
        (_, []) if has_all_meshes => "meshes".to_owned(),
        (files, pictures) => {
            let names = files.iter().map(|format| format!(".{format}"));
            let pictures = (!pictures.is_empty()).then(|| "pictures".to_owned());
            listed(names.chain(pictures).collect(), "and")
        }
    }
}

// .vdb level sets as inputs: contoured unchanged, or smoothed within --max-deviation.

/// How the selected files become surfaces: all are level sets, or all are particles.
///
/// # Errors
/// If both are selected, --max-deviation is given for particles, or options do not apply to level sets.
pub(super) fn surface_job(
    selection: &InputSelection,
    max_deviation: Option<f64>,
    method: &MethodArgs,
) -> Result<Job> {
    let mut files = selected_files(&selection.sequences);
    let is_one = files.clone().any(|file| is_level_set(&file.path));
    match files.find(|file| is_level_set(&file.path) != is_one) {
        Some(other) if is_one => {
            bail!(
                "{}: one command cannot convert both level sets and particles: run a command for each",
                other.path.display()
            )
        }
        _ if is_one => {
            let max_deviation_voxels = max_deviation.unwrap_or(0.0);
            refuse_options(method, if max_deviation_voxels == 0.0 { Use::AsItIs } else { Use::Smoothed })?;
            Ok(Job::level_set(max_deviation_voxels))
        }
        _ if max_deviation.is_some() => bail!("--max-deviation is for level sets in .vdb"),
        _ => Ok(Job::Surface),
    }
}

/// The purpose of a level set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Use {
    /// A surface, contoured unchanged.
    AsItIs,
    /// A surface, smoothed first.
    Smoothed,
    /// A picture.
    Picture,
}

/// Refuses options that do not apply to a level set.
///
/// # Errors
/// If such an option is given. The message names it, and states why it does not apply.
pub(super) fn refuse_options(method: &MethodArgs, reason: Use) -> Result<()> {
    let solver_has_no_use = match reason {
        Use::Picture => "a picture shows the surface of the file unchanged",
        Use::AsItIs | Use::Smoothed => "without --max-deviation it is not smoothed",
    };
    // Offsets in voxels or spacings cannot be resolved: the voxel size of a level set is known only when it
    // is read, and a level set has no particle spacing.
    if method.options.0.offset.is_some_and(|offset| offset.unit != LengthUnit::World) {
        bail!("--offset must be in world units for a level set in .vdb, such as --offset 0.01");
    }
    for (group, why) in [
        (OptionGroup::General, "the voxel size is that of the file, and presets are for particles"),
        (OptionGroup::Surface, "this option is for particles, and a surface has none"),
        (OptionGroup::Particles, "this option is for particles, and a surface has none"),
        (OptionGroup::Obstacles, "obstacles are for particles"),
        (OptionGroup::Solver, solver_has_no_use),
    ] {
        let mut given = method.given();
        given.retain(|name| group_of(name, reason) == Some(group));
        if !given.is_empty() && (group != OptionGroup::Solver || reason != Use::Smoothed) {
            let what = if reason == Use::Picture { "a level set or a mesh" } else { "a level set in .vdb" };
            bail!("{} cannot be given with {what}: {why}", option_names(&given));
        }
    }
    Ok(())
}

/// The group of an option with respect to level sets. `--offset` is allowed (`None`), except for pictures,
/// which show the level set unchanged.
fn group_of(name: &str, reason: Use) -> Option<OptionGroup> {
    match name {
        "obstacle" => Some(OptionGroup::Obstacles),
        "offset" => (reason == Use::Picture).then_some(OptionGroup::Solver),
        _ => MethodOptions::info(name).map(|info| info.group),
    }
}

// `--print-settings`: prints the settings that options and presets result in, as keys of a configuration
// file.
//
// A `[[watch]]` block with these keys produces the same files. Keys without effect are left out, because a
// file with them would cause warnings.

/// Prints the settings without any frames. Lengths are in units of the particle spacing unless the spacing or
/// a voxel size is given.
///
/// # Errors
/// If the options are invalid, or lengths in world units are given and the spacing is unknown.
pub(super) fn print_settings_of_any(
    method: &MethodArgs,
    outputs: &OutputOptions,
    console: &mut Console,
) -> Result<()> {
    let options = method.to_options();
    // A given voxel size implies the spacing for which it is the default.
    let has_voxel_size = options.voxel_size.and_then(Length::world).is_some();
    let is_unknown = options.needs_measuring() && options.spacing.is_none();
    let needs_spacing = is_unknown && !has_voxel_size;
    let has_length = options.has_length_in(LengthUnit::World) || options.clip.is_some();
    if needs_spacing && has_length {
        bail!(
            "lengths in world units cannot be compared with the particle spacing, which is unknown: give --spacing, or an INPUT to measure it on"
        );
    }
    if needs_spacing {
        console
            .print_line("# the particle spacing is unknown; the lengths in comments are for a spacing of 1:");
    } else if is_unknown {
        console.print_line("# the particle spacing is derived from the voxel size, because no INPUT was given to measure it on:");
    }
    let settings = Settings::resolve(&options, needs_spacing.then(|| SequenceSpacing::from(1.0)))?;
    if options.is_auto() {
        let preset = settings.preset;
        console.print_line(format_args!(
            "# no INPUT was given to choose the preset by; the values in comments are those of {preset}:"
        ));
    }
    let known = Known { preset: !options.is_auto(), spacing: !needs_spacing };
    console.print_lines(keys(&settings, method, outputs, Job::Surface, known)?);
    Ok(())
}

/// Prints the settings of each sequence.
///
/// # Errors
/// If the options are invalid, or no voxel size can be found.
pub(super) fn print_settings(
    sequences: &[SelectedSequence],
    job: Job,
    method: &MethodArgs,
    outputs: &OutputOptions,
    pool: &ThreadPool,
    console: &mut Console,
) -> Result<()> {
    let options = method.to_options();
    for SelectedSequence { sequence, .. } in sequences {
        let settings = match job {
            Job::LevelSet { .. } => Settings::for_level_sets(&options)?,
            Job::Surface | Job::Particles => {
                let measured = pool.install(|| measure_if_needed(sequence, &options, console))?;
                settings_of(sequence, &options, measured.as_ref())?
            }
        };
        console.print_line(format_args!("# {}", sequence.name));
        let known = Known { preset: true, spacing: true };
        console.print_lines(keys(&settings, method, outputs, job, known)?);
    }
    Ok(())
}

/// What the values of settings follow from, if it is known.
#[derive(Clone, Copy)]
struct Known {
    preset: bool,
    spacing: bool,
}

/// The keys and values for these settings and options.
fn keys(
    settings: &Settings,
    method: &MethodArgs,
    outputs: &OutputOptions,
    job: Job,
    known: Known,
) -> Result<Vec<String>> {
    let options = method.to_options();
    let obstacles = obstacle_paths(method)?;
    let formats = outputs.formats.iter().filter(|format| !format.is_picture());
    let mut keys = vec![list("formats", formats.map(|format| format.extension().to_owned()).collect())];
    if let Job::LevelSet { max_deviation_voxels, .. } = job {
        keys.push(entry("pattern", "*.vdb"));
        if max_deviation_voxels > 0.0 {
            keys.push(format!(
                "# a configuration file has no key for --max-deviation {max_deviation_voxels}: the daemon does not smooth level sets"
            ));
        }
    }
    if !obstacles.is_empty() {
        keys.push(list("obstacles", obstacles.clone()));
    }
    let given = options.to_pairs();
    for (name, value) in settings.to_options().to_pairs() {
        let Some(is_key) = use_of(name, job, outputs, !obstacles.is_empty()) else { continue };
        let kind = MethodOptions::info(name).map(|info| info.kind);
        let is_length = name == "spacing" || kind == Some(ValueKind::Length);
        let is_open = !known.preset || is_length && !known.spacing;
        let given = given.iter().find(|(given, _)| *given == name && is_open);
        keys.push(match given {
            // Given values fit any preset, and lengths in spacings or voxels any spacing.
            Some((_, given)) => entry(name, given),
            // Other values that are not known, and options that are not keys, are only shown as comments.
            None if !is_key || is_open => format!("#{name} = {value}"),
            None => entry(name, &value),
        });
    }
    keys.extend(format_keys(outputs));
    if let Some(UsdStageOptions { path, fps }) = &outputs.stage {
        keys.extend([entry("stage", &absolute_text(path)?), entry("fps", &fps.to_string())]);
    }
    Ok(keys)
}

/// The obstacles as absolute paths, which are valid wherever the file is.
fn obstacle_paths(args: &MethodArgs) -> Result<Vec<String>> {
    args.obstacle.iter().map(|path| absolute_text(path)).collect()
}

fn absolute_text(path: &Path) -> Result<String> {
    let whole = absolute(path).with_context(|| format!("`{}` is not a valid path", path.display()))?;
    let text = whole.to_str().map(str::to_owned);
    text.with_context(|| format!("{}: a configuration file can name only paths in Unicode", whole.display()))
}

/// The output options for the written formats.
fn format_keys(outputs: &OutputOptions) -> Vec<String> {
    let mut keys = Vec::new();
    for option in WriteOption::SETTINGS {
        if option == WriteOption::Quads || !outputs.has_option(option) {
            continue;
        }
        if option == WriteOption::Size {
            let preview = outputs.formats.iter().find(|format| format.is_picture());
            keys.extend(preview.map(|format| entry("preview", format.extension())));
        }
        keys.push(entry(option.key(), &outputs.value(option)));
    }
    keys
}

/// Whether an option can be a key of the file; `None` if it has no effect on the written files.
fn use_of(name: &str, job: Job, outputs: &OutputOptions, has_obstacles: bool) -> Option<bool> {
    let group = MethodOptions::info(name)?.group;
    let changes_files = formats_changed_by(name)
        .is_none_or(|changed| outputs.formats.iter().any(|format| changed.contains(format)));
    let (changes_surface, is_key) = match (job, group) {
        (Job::LevelSet { max_deviation_voxels, .. }, OptionGroup::Solver) => {
            (max_deviation_voxels > 0.0, false)
        }
        (Job::LevelSet { .. }, OptionGroup::Mesh) => (true, true),
        (Job::LevelSet { .. }, _) => (name == "offset", true),
        (_, OptionGroup::Obstacles) => (has_obstacles, true),
        _ => (true, true),
    };
    (changes_files && changes_surface).then_some(is_key)
}

/// A line of the file: numbers and switches as they are, anything else in quotes.
fn entry(key: &str, value: &str) -> String {
    if value.parse::<f64>().is_ok() || value.parse::<bool>().is_ok() {
        return format!("{key} = {value}");
    }
    format!("{key} = {}", Value::String(value.to_owned()))
}

fn list(key: &str, texts: Vec<String>) -> String {
    format!("{key} = {}", Value::Array(texts.into_iter().map(Value::String).collect()))
}
