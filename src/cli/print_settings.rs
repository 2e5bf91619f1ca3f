//! `--print-settings`: what options and presets stand for, as keys of a file.
//!
//! A `[[watch]]` block with these keys makes the same files. Keys that change nothing are left out: a file with them
//! would be warned of.

use std::path::{PathBuf, absolute};

use anyhow::{Context, Result, bail};
use meniscus_formats::WriteOption;
use rayon::ThreadPool;
use toml::Value;

use crate::pipeline::{OutputFormat, OutputOptions, Sequence};
use crate::surface::options::{
    Length, LengthUnit, Measured, MethodOptions, OptionGroup, Settings, ValueKind,
};

use super::Verdict;
use super::args::{ConvertArgs, MethodArgs};
use super::choices::output_options;
use super::console::Console;
use super::resolving::measured_spacing;

/// Prints the settings of each sequence; where there is none, those of any, with lengths in units of the particle spacing
/// unless that, or a voxel size, was given.
///
/// # Errors
/// When the options make no sense, or no voxel size can be found.
pub(super) fn print_settings(
    sequences: &[&Sequence],
    args: &ConvertArgs,
    pool: &ThreadPool,
    console: &mut Console,
) -> Result<Verdict> {
    let choices = args.method.to_options();
    if sequences.is_empty() {
        // With a voxel size the spacing is the one that has it by default.
        let has_voxel_size = choices.voxel_size.and_then(Length::world).is_some();
        let needs_spacing = choices.needs_spacing() && !has_voxel_size;
        let has_length = choices.has_length_in(LengthUnit::World) || choices.clip.is_some();
        if needs_spacing && has_length {
            bail!(
                "lengths are given, and no --spacing to compare them with: give one, or an INPUT to measure it on"
            );
        }
        if needs_spacing {
            console.say(format_args!("# these follow the particle spacing, here 1:"));
        } else if choices.needs_spacing() {
            console.say(format_args!(
                "# the particle spacing, which would be measured, is taken from the voxel size:"
            ));
        }
        let settings = Settings::resolve(&choices, needs_spacing.then(|| Measured::from(1.0)))?;
        print(&keys(&settings, args, !needs_spacing)?, console);
    }
    for sequence in sequences {
        let measured = pool.install(|| measured_spacing(sequence, &choices, console))?;
        let measured = measured.as_ref().map(Measured::from);
        let settings = Settings::resolve(&choices, measured).with_context(|| sequence.name.clone())?;
        console.say(format_args!("# {}", sequence.name));
        print(&keys(&settings, args, true)?, console);
    }
    Ok(Verdict::Done)
}

/// A key and its value, as they stand in a file.
type Key = (String, String);

fn print(keys: &[Key], console: &mut Console) {
    for (name, value) in keys {
        console.say(format_args!("{name} = {value}"));
    }
}

/// The keys that say what these settings and options are.
fn keys(settings: &Settings, args: &ConvertArgs, has_spacing: bool) -> Result<Vec<Key>> {
    let outputs = output_options(PathBuf::new(), args.format.as_deref(), &args.formats);
    let obstacles = obstacle_paths(&args.method)?;
    let key = |name: &str, value: String| (name.to_owned(), value);
    let formats = outputs.formats.iter().filter(|format| !format.is_picture());
    let formats = formats.map(|format| format.extension().to_owned());
    let mut keys = vec![key("formats", list(formats.collect()))];
    if !has_spacing {
        // By it lengths follow the spacing that will be measured.
        let preset = args.method.to_options().preset.unwrap_or_default();
        keys.push(key("preset", quoted(preset.to_string())));
    }
    if !obstacles.is_empty() {
        keys.push(key("obstacles", list(obstacles.clone())));
    }
    let given = args.method.to_options().to_pairs();
    for (name, value) in settings.to_options().to_pairs() {
        if !is_of_use(name, &outputs.formats, !obstacles.is_empty()) {
            continue;
        }
        let kind = MethodOptions::info(name).map(|info| info.kind);
        let is_length = name == "spacing" || kind == Some(ValueKind::Length);
        let given = given.iter().find(|(given, _)| *given == name && is_length && !has_spacing);
        match given {
            // In spacings or voxels, which fit any spacing.
            Some((_, given)) => keys.push(key(name, quoted(given.clone()))),
            // Other lengths without a spacing are there to be seen, not to be used.
            None if is_length && !has_spacing => keys.push(key(&format!("#{name}"), value)),
            None if kind == Some(ValueKind::Text) => keys.push(key(name, quoted(value))),
            None => keys.push(key(name, value)),
        }
    }
    keys.extend(format_keys(&outputs));
    Ok(keys)
}

/// The obstacles, as they can be found from wherever the file will lie.
fn obstacle_paths(args: &MethodArgs) -> Result<Vec<String>> {
    let paths = args.obstacle.iter().map(|path| {
        let whole = absolute(path).with_context(|| format!("`{}` is no path", path.display()))?;
        let text = whole.to_str().map(str::to_owned);
        text.with_context(|| format!("{}: a file of settings can name only what is Unicode", whole.display()))
    });
    paths.collect()
}

/// How files are written, of those formats that are.
fn format_keys(outputs: &OutputOptions) -> Vec<Key> {
    let is_printed = |option: &WriteOption| match option {
        WriteOption::Quads => false,
        WriteOption::Quantize => outputs.quantize,
        _ => outputs.has_option(*option),
    };
    let mut keys = Vec::new();
    for option in WriteOption::ALL.into_iter().filter(is_printed) {
        if option == WriteOption::Size {
            let preview = outputs.formats.iter().find(|format| format.is_picture());
            keys.extend(preview.map(|format| ("preview".to_owned(), quoted(format.to_string()))));
        }
        let value = outputs.value(option);
        let is_plain =
            matches!(option, WriteOption::MetersPerUnit | WriteOption::Quantize | WriteOption::Half);
        keys.push((option.key().to_owned(), if is_plain { value } else { quoted(value) }));
    }
    keys
}

/// Whether an option can change what is written.
fn is_of_use(name: &str, formats: &[OutputFormat], has_obstacles: bool) -> bool {
    match MethodOptions::info(name).map(|info| info.group) {
        Some(OptionGroup::Obstacles) => has_obstacles,
        Some(OptionGroup::Mesh) if name == "quads" => {
            formats.iter().any(|format| format.has_option(WriteOption::Quads))
        }
        Some(OptionGroup::Mesh) => formats.iter().any(|format| format.is_mesh()),
        _ => true,
    }
}

fn quoted(text: String) -> String {
    Value::String(text).to_string()
}

fn list(texts: Vec<String>) -> String {
    Value::Array(texts.into_iter().map(Value::String).collect()).to_string()
}
