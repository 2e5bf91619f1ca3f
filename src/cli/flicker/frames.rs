//! Matches meshes with particles, and finds the frames that have both neighbours.
//!
//! ```text
//!   meshes      1     3     5  6              7
//!   particles   1  2  3  4  5     6  7        the frames with both: 1, 3, 5, 6, 7
//!                                             step: the greatest common divisor of their differences, 1
//!                                             frame 6 is scored, because 5 and 7 are in the list
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use anyhow::{Result, bail};
use meniscus_formats::Format;

use crate::cli::args::FlickerArgs;
use crate::cli::console::Console;
use crate::cli::frame_selection::FrameSelection;
use crate::cli::inputs::{find_inputs, with_files_of_folders};
use crate::cli::select::only_sequence;
use crate::pipeline::{FrameFile, Sequence, common_step, shown};

/// The files of a frame.
#[derive(Clone, Debug)]
pub(super) struct FrameFiles {
    pub(super) mesh: PathBuf,
    pub(super) particles: PathBuf,
    /// The name of the frame.
    name: String,
}

/// The frames of a sequence.
#[derive(Debug)]
pub(super) struct FlickerFrames {
    /// The name of the sequence of meshes.
    pub(super) name: String,
    /// The frames that have both files, by number.
    pub(super) files: BTreeMap<u64, FrameFiles>,
    /// All particle files in the order of their sequence, with or without meshes.
    pub(super) particles: Vec<PathBuf>,
    /// The greatest common divisor of the differences between the numbers of `files`.
    pub(super) step: u64,
    /// The greatest common divisor of the differences between the numbers of all particle files, with or
    /// without meshes.
    particle_step: u64,
    /// The selected frames that have both neighbours.
    pub(super) scored: Vec<u64>,
}

impl FlickerFrames {
    pub(super) fn name_of(&self, number: u64) -> String {
        self.files.get(&number).map_or_else(|| number.to_string(), |files| files.name.clone())
    }

    /// The number of particle frames per step.
    pub(super) fn particle_steps(&self) -> f64 {
        self.step as f64 / self.particle_step as f64
    }
}

/// Maximum number of frames listed in a message.
const NUMBERS_NAMED: usize = 8;

/// Finds the frames that the arguments name.
///
/// # Errors
/// If no three consecutive frames exist.
pub(super) fn find(args: &FlickerArgs, console: &mut Console) -> Result<FlickerFrames> {
    let formats: Vec<&[&str]> =
        Format::ALL.iter().filter(|format| format.has_mesh()).map(|format| format.extensions()).collect();
    let meshes = with_files_of_folders(&args.meshes, &formats, "meshes")?;
    let meshes = one_sequence(&meshes, "meshes", console)?;
    let particles = one_sequence(&args.particles, "particles", console)?;
    let name = meshes.name.clone();
    let particle_paths = particles.frames.iter().map(|file| file.path.clone()).collect();
    let (meshes, mut particles) = (by_number(meshes)?, by_number(particles)?);
    let particle_numbers: Vec<u64> = particles.keys().copied().collect();
    let (mut files, mut alone) = (BTreeMap::new(), Vec::new());
    for (number, mesh) in meshes {
        match particles.remove(&number) {
            Some(particles) => {
                let name = mesh.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
                files.insert(number, FrameFiles { mesh: mesh.path, particles: particles.path, name });
            }
            None => alone.push(number),
        }
    }
    if !alone.is_empty() {
        console.warning(format_args!("{name}: no particles for {}: not used", listed(&alone)));
    }
    let numbers: Vec<u64> = files.keys().copied().collect();
    if numbers.len() < 3 {
        bail!(
            "{name}: {} both a mesh and particles, matched by their frame numbers, and three frames are needed",
            if numbers.len() == 1 {
                "1 frame has".to_owned()
            } else {
                format!("{} frames have", numbers.len())
            }
        );
    }
    let step = common_step(&numbers);
    let has_both = |number: &u64| {
        let neighbors = number.checked_sub(step).zip(number.checked_add(step));
        neighbors.is_some_and(|(before, after)| files.contains_key(&before) && files.contains_key(&after))
    };
    let inner = &numbers[1..numbers.len() - 1];
    let (scored, skipped): (Vec<u64>, Vec<u64>) = inner.iter().copied().partition(has_both);
    if scored.is_empty() {
        bail!(
            "{name}: no three frames follow each other: {} both a mesh and particles",
            listed_with(&numbers, ["has", "have"])
        );
    }
    if !skipped.is_empty() {
        console.warning(format_args!(
            "{name}: {} not scored: the mesh or the particles of a neighbour are missing",
            listed_with(&skipped, ["is", "are"])
        ));
    }
    let is_selected = |number: &u64| {
        args.frames.as_ref().is_none_or(|selection: &FrameSelection| selection.contains(*number))
    };
    let scored: Vec<u64> = scored.into_iter().filter(is_selected).collect();
    if scored.is_empty() {
        bail!("--frames selects none of the frames that have both neighbours");
    }
    let particle_step = common_step(&particle_numbers);
    Ok(FlickerFrames { name, files, particles: particle_paths, step, particle_step, scored })
}

fn one_sequence(inputs: &[PathBuf], what: &str, console: &mut Console) -> Result<Sequence> {
    let found = find_inputs(inputs)?;
    found.report(console);
    only_sequence(found.files, &format!("the {what} must be of one sequence"))
}

fn by_number(sequence: Sequence) -> Result<BTreeMap<u64, FrameFile>> {
    let mut files: BTreeMap<u64, FrameFile> = BTreeMap::new();
    for file in sequence.frames {
        let Some(number) = file.number() else {
            bail!("{}: the name has no frame number to match meshes and particles by", shown(&file.path));
        };
        if let Some(other) = files.get(&number) {
            bail!(
                "{} and {} are both frame {number}: subframes cannot be scored",
                shown(&other.path),
                shown(&file.path)
            );
        }
        files.insert(number, file);
    }
    Ok(files)
}

fn listed(numbers: &[u64]) -> String {
    let distinct: BTreeSet<u64> = numbers.iter().copied().collect();
    let mut names: Vec<String> = distinct.iter().take(NUMBERS_NAMED).map(u64::to_string).collect();
    if distinct.len() > NUMBERS_NAMED {
        names.push(format!("and {} more", distinct.len() - NUMBERS_NAMED));
    }
    format!("{} {}", if distinct.len() == 1 { "frame" } else { "frames" }, names.join(", "))
}

/// The numbers of frames as text, followed by `one` if there is one frame, or else by `several`.
fn listed_with(numbers: &[u64], [one, several]: [&str; 2]) -> String {
    format!("{} {}", listed(numbers), if numbers.len() == 1 { one } else { several })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lists_are_shortened() {
        assert_eq!(listed(&[7]), "frame 7");
        assert_eq!(listed_with(&[7, 9], ["is", "are"]), "frames 7, 9 are");
        assert_eq!(listed(&(1..=10).collect::<Vec<_>>()), "frames 1, 2, 3, 4, 5, 6, 7, 8, and 2 more");
    }
}
