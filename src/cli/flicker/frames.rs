//! Matches meshes with particles, and finds the frames that have both neighbours.
//!
//! ```text
//!   meshes      1     3     5  6              7
//!   particles   1  2  3  4  5     6  7        the frames with both: 1, 3, 5, 6, 7
//!                                             step: the greatest common divisor of their differences, 1
//!                                             frame 6 is scored, because 5 and 7 are in the list
//! ```
//!
//! Names with times are matched by their times, and counted in steps of the median difference.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::PathBuf;

use anyhow::{Result, bail};
use meniscus_formats::Format;

use crate::cli::args::FlickerArgs;
use crate::cli::console::Console;
use crate::cli::frame_selection::FrameSelection;
use crate::cli::inputs::{find_inputs, with_files_of_folders};
use crate::cli::select::{only_sequence, refuse_times};
use crate::cli::wording::pluralize;
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
    pub(super) files: BTreeMap<i64, FrameFiles>,
    /// All particle files in the order of their sequence, with or without meshes.
    pub(super) particles: Vec<PathBuf>,
    /// The greatest common divisor of the differences between the numbers of `files`.
    pub(super) step: i64,
    /// The greatest common divisor of the differences between the numbers of all particle files, with or
    /// without meshes.
    particle_step: u64,
    /// The selected frames that have both neighbours.
    pub(super) scored: Vec<i64>,
}

impl FlickerFrames {
    pub(super) fn name_of(&self, number: i64) -> String {
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
    let mut meshes = one_sequence(&meshes, "meshes", console)?;
    let particles = one_sequence(&args.particles, "particles", console)?;
    refuse_times(args.frames.as_ref(), [&meshes, &particles])?;
    let name = meshes.name.clone();
    let particle_paths = particles.frames.iter().map(|file| file.path.clone()).collect();
    let numbers = NumbersOfTimes::of(&particles);
    let mesh_count = meshes.frames.len();
    meshes.frames.retain(|file| !file.has_time() || numbers.number(file).is_some());
    if meshes.frames.len() < mesh_count {
        let unmatched = pluralize(mesh_count - meshes.frames.len(), "mesh file");
        console.warning(format_args!("{name}: no particles have the time of {unmatched}: not used"));
    }
    let (meshes, mut particles) = (numbers.sort(meshes)?, numbers.sort(particles)?);
    let particle_numbers: Vec<i64> = particles.keys().copied().collect();
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
    let numbers: Vec<i64> = files.keys().copied().collect();
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
    let step = i64::try_from(common_step(&numbers)).unwrap_or(i64::MAX);
    let has_both = |number: &i64| {
        let neighbors = number.checked_sub(step).zip(number.checked_add(step));
        neighbors.is_some_and(|(before, after)| files.contains_key(&before) && files.contains_key(&after))
    };
    let inner = &numbers[1..numbers.len() - 1];
    let (scored, skipped): (Vec<i64>, Vec<i64>) = inner.iter().copied().partition(has_both);
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
    let is_selected = |number: &i64| {
        args.frames.as_ref().is_none_or(|selection: &FrameSelection| selection.contains(*number))
    };
    let scored: Vec<i64> = scored.into_iter().filter(is_selected).collect();
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

/// The numbers that stand for the times in names of particles; empty if the names have frame numbers.
struct NumbersOfTimes {
    /// By the bits of the time.
    numbers: HashMap<u64, i64>,
}

impl NumbersOfTimes {
    /// Times that are a median difference apart, or less, have consecutive numbers. Longer differences, where
    /// frames are missing, are rounded to such steps.
    fn of(particles: &Sequence) -> NumbersOfTimes {
        let with_times = particles.frames.iter().filter(|file| file.has_time());
        let times: Vec<f64> = with_times.filter_map(FrameFile::value).collect();
        let mut differences: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        differences.sort_by(f64::total_cmp);
        let median = differences.get(differences.len() / 2).copied().unwrap_or(1.0);
        let mut number = 1;
        let mut numbers: HashMap<u64, i64> =
            times.first().map(|time| (time.to_bits(), 1)).into_iter().collect();
        for pair in times.windows(2) {
            number += ((pair[1] - pair[0]) / median).round().clamp(1.0, STEPS_MAX) as i64;
            numbers.insert(pair[1].to_bits(), number);
        }
        NumbersOfTimes { numbers }
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
                    "{} and {} are both frame {number}: subframes cannot be scored",
                    shown(&other.path),
                    shown(&file.path)
                );
            }
            files.insert(number, file);
        }
        Ok(files)
    }
}

/// The most steps between two times.
const STEPS_MAX: f64 = 1e6;

fn listed(numbers: &[i64]) -> String {
    let distinct: BTreeSet<i64> = numbers.iter().copied().collect();
    let mut names: Vec<String> = distinct.iter().take(NUMBERS_NAMED).map(i64::to_string).collect();
    if distinct.len() > NUMBERS_NAMED {
        names.push(format!("and {} more", distinct.len() - NUMBERS_NAMED));
    }
    format!("{} {}", if distinct.len() == 1 { "frame" } else { "frames" }, names.join(", "))
}

/// The numbers of frames as text, followed by `one` if there is one frame, or else by `several`.
fn listed_with(numbers: &[i64], [one, several]: [&str; 2]) -> String {
    format!("{} {}", listed(numbers), if numbers.len() == 1 { one } else { several })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::sequences;

    #[test]
    fn times_are_counted_in_steps() {
        let names = ["p_0.9667.ply", "p_1.0000.ply", "p_1.0333.ply", "p_1.1000.ply"];
        let [particles] = &sequences(names.map(|name| FrameFile::new(name.into())).to_vec())[..] else {
            panic!("one sequence")
        };
        let numbers = NumbersOfTimes::of(particles);
        let found: Vec<Option<i64>> = particles.frames.iter().map(|file| numbers.number(file)).collect();
        assert_eq!(found, [Some(1), Some(2), Some(3), Some(5)]);
        // The mesh of a time need not have the same decimals.
        assert_eq!(numbers.number(&FrameFile::new("mesh_1.00.obj".into())), Some(2));
        assert_eq!(numbers.number(&FrameFile::new("mesh_7.5.obj".into())), None);
        assert_eq!(numbers.number(&FrameFile::new("mesh.7.obj".into())), Some(7));
    }

    #[test]
    fn long_lists_are_shortened() {
        assert_eq!(listed(&[7]), "frame 7");
        assert_eq!(listed_with(&[7, 9], ["is", "are"]), "frames 7, 9 are");
        assert_eq!(listed(&(1..=10).collect::<Vec<_>>()), "frames 1, 2, 3, 4, 5, 6, 7, 8, and 2 more");
    }
}
