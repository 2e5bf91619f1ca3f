//! `--print-settings`: what options and presets stand for, as keys of a file.

use anyhow::{Context, Result, bail};
use rayon::ThreadPool;

use crate::pipeline::{Sequence, automatic_voxel_size};
use crate::settings::{Choices, Settings};

use super::Verdict;
use super::args::MethodArgs;
use super::choices::choices;
use super::console::Console;

/// Prints the settings of each sequence; where there is none, those of any, with lengths in units of the voxel size
/// unless that was given.
///
/// # Errors
/// When the options make no sense, or no voxel size can be found.
pub(super) fn print_settings(
    sequences: &[&Sequence],
    args: &MethodArgs,
    pool: &ThreadPool,
    console: &mut Console,
) -> Result<Verdict> {
    let choices = choices(args);
    let given = args.first.voxel_size;
    if sequences.is_empty() {
        let lengths = [choices.radius_min, choices.radius_init, choices.neighbor_radius];
        if given.is_none() && (lengths.iter().any(Option::is_some) || choices.clip.is_some()) {
            bail!(
                "lengths are given, and no --voxel-size to compare them with: give one, or an INPUT to measure it on"
            );
        }
        if given.is_none() {
            console.say(format_args!("# these follow the voxel size, here 1:"));
        }
        print(&Settings::resolve(given.unwrap_or(1.0), &choices)?, given.is_some(), console);
    }
    for sequence in sequences {
        let paths = || sequence.frames.iter().map(|file| &*file.path);
        let voxel_size = match given {
            Some(voxel_size) => voxel_size,
            None => pool.install(|| automatic_voxel_size(paths()))?.voxel_size,
        };
        let settings = Settings::resolve(voxel_size, &choices).with_context(|| sequence.name.clone())?;
        console.say(format_args!("# {}", sequence.name));
        print(&settings, true, console);
    }
    Ok(Verdict::Done)
}

fn print(settings: &Settings, has_voxel_size: bool, console: &mut Console) {
    if has_voxel_size {
        console.say(format_args!("voxel_size = {}", settings.voxel_size));
    }
    let made: Choices = settings.to_choices();
    for (name, value) in made.to_pairs() {
        // Lengths without a voxel size are there to be seen, not to be used.
        let mark = if !has_voxel_size && LENGTHS.contains(&name) { "#" } else { "" };
        match WORDS.contains(&name) {
            true => console.say(format_args!("{mark}{name} = {value:?}")),
            false => console.say(format_args!("{mark}{name} = {value}")),
        }
    }
}

/// The keys whose values are lengths.
const LENGTHS: [&str; 3] = ["radius_min", "radius_init", "neighbor_radius"];

/// The keys whose values are text. The others are numbers and switches.
const WORDS: [&str; 6] = ["radius_attribute", "anisotropy", "attributes", "clip", "contour", "integrator"];
