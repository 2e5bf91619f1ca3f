//! `--print-settings`: prints the settings that options and presets result in, as keys of a configuration
//! file.
//!
//! A `[[watch]]` block with these keys produces the same files. Keys without effect are left out, because a
//! file with them would cause warnings.

use std::path::{Path, absolute};

use anyhow::{Context, Result, bail};
use meniscus_formats::WriteOption;
use rayon::ThreadPool;
use toml::Value;

use crate::pipeline::{Job, OutputOptions, StageOptions};
use crate::surface::options::{
    Length, LengthUnit, MethodOptions, OptionGroup, SequenceSpacing, Settings, ValueKind,
};

use super::args::MethodArgs;
use super::choices::formats_changed_by;
use super::console::Console;
use super::resolve::{measured_spacing, settings_of};
use super::select::SelectedSequence;

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
    let needs_spacing = options.needs_spacing() && !has_voxel_size;
    let has_length = options.has_length_in(LengthUnit::World) || options.clip.is_some();
    if needs_spacing && has_length {
        bail!(
            "lengths in world units cannot be compared with the particle spacing, which is unknown: give --spacing, or an INPUT to measure it on"
        );
    }
    if needs_spacing {
        console
            .print_line("# the particle spacing is unknown; the lengths in comments are for a spacing of 1:");
    } else if options.needs_spacing() {
        console.print_line("# the particle spacing is derived from the voxel size, because no INPUT was given to measure it on:");
    }
    let settings = Settings::resolve(&options, needs_spacing.then(|| SequenceSpacing::from(1.0)))?;
    console.print_lines(keys(&settings, method, outputs, Job::Surface, !needs_spacing)?);
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
                let measured = pool.install(|| measured_spacing(sequence, &options, console))?;
                settings_of(sequence, &options, measured.as_ref())?
            }
        };
        console.print_line(format_args!("# {}", sequence.name));
        console.print_lines(keys(&settings, method, outputs, job, true)?);
    }
    Ok(())
}

/// The keys and values for these settings and options.
fn keys(
    settings: &Settings,
    method: &MethodArgs,
    outputs: &OutputOptions,
    job: Job,
    has_spacing: bool,
) -> Result<Vec<String>> {
    let options = method.to_options();
    let obstacles = obstacle_paths(method)?;
    let formats = outputs.formats.iter().filter(|format| !format.is_picture());
    let formats = formats.map(|format| format.extension().to_owned());
    let mut keys = vec![format!("formats = {}", list(formats.collect()))];
    if let Job::LevelSet { max_deviation_voxels, .. } = job {
        keys.push(format!("pattern = {}", quoted("*.vdb")));
        if max_deviation_voxels > 0.0 {
            keys.push(format!(
                "# a configuration file has no key for --max-deviation {max_deviation_voxels}: the daemon does not smooth level sets"
            ));
        }
    }
    if !has_spacing {
        // With the preset, lengths follow the spacing that the daemon will measure.
        keys.push(format!("preset = {}", quoted(&options.preset.unwrap_or_default().to_string())));
    }
    if !obstacles.is_empty() {
        keys.push(format!("obstacles = {}", list(obstacles.clone())));
    }
    let given = options.to_pairs();
    for (name, value) in settings.to_options().to_pairs() {
        let Some(is_key) = use_of(name, job, outputs, !obstacles.is_empty()) else { continue };
        let kind = MethodOptions::info(name).map(|info| info.kind);
        let is_length = name == "spacing" || kind == Some(ValueKind::Length);
        let given = given.iter().find(|(given, _)| *given == name && is_length && !has_spacing);
        keys.push(match given {
            // Lengths in spacings or voxels fit any spacing.
            Some((_, given)) => format!("{name} = {}", quoted(given)),
            // Other lengths without a spacing, and options that are not keys, are only shown as comments.
            None if !is_key || is_length && !has_spacing => format!("#{name} = {value}"),
            None if kind == Some(ValueKind::Text) => format!("{name} = {}", quoted(&value)),
            None => format!("{name} = {value}"),
        });
    }
    keys.extend(format_keys(outputs));
    if let Some(StageOptions { path, fps }) = &outputs.stage {
        keys.push(format!("stage = {}", quoted(&absolute_text(path)?)));
        keys.push(format!("fps = {fps}"));
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
    let is_printed = |option: &WriteOption| match option {
        WriteOption::Quads => false,
        _ => outputs.has_option(*option),
    };
    let mut keys = Vec::new();
    for option in WriteOption::ALL.into_iter().filter(is_printed) {
        if option == WriteOption::Size {
            let preview = outputs.formats.iter().find(|format| format.is_picture());
            keys.extend(preview.map(|format| format!("preview = {}", quoted(format.extension()))));
        }
        let value = outputs.value(option);
        let is_plain = option == WriteOption::MetersPerUnit;
        keys.push(format!("{} = {}", option.key(), if is_plain { value } else { quoted(&value) }));
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

fn quoted(text: &str) -> String {
    Value::String(text.to_owned()).to_string()
}

fn list(texts: Vec<String>) -> String {
    Value::Array(texts.into_iter().map(Value::String).collect()).to_string()
}
