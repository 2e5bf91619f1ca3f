//! Level sets in .vdb as inputs: contoured as they are, or smoothed within --band-slack.

use std::sync::Arc;

use anyhow::{Result, bail};
use rayon::ThreadPool;

use crate::pipeline::{Job, OutputOptions, is_level_set};
use crate::surface::options::{LengthUnit, MethodOptions, OptionGroup, Settings};

use super::args::{MethodArgs, typed};
use super::console::Console;
use super::resolving::{Resolved, outputs_of, resolve_settings};
use super::selecting::{SelectedSequence, Selection};

/// How the selected files become surfaces, which are level sets or particles.
///
/// # Errors
/// When they are both, or there is a slack for particles.
pub(super) fn surface_job(selection: &Selection, band_slack: Option<f64>) -> Result<Job> {
    let mut files = selection.sequences.iter().flat_map(|sequence| &sequence.selected);
    let is_one = files.clone().any(|file| is_level_set(&file.path));
    match files.find(|file| is_level_set(&file.path) != is_one) {
        Some(other) if is_one => {
            bail!(
                "{}: level sets and particles are converted one after the other, not together",
                other.path.display()
            )
        }
        _ if is_one => Ok(Job::level_set(band_slack.unwrap_or(0.0))),
        _ if band_slack.is_some() => bail!("--band-slack is for level sets in .vdb"),
        _ => Ok(Job::Surface),
    }
}

/// What the frames of a sequence share, or why they cannot be converted.
///
/// # Errors
/// When the options make no sense for any frame.
pub(super) fn resolve_job(
    sequence: &SelectedSequence,
    job: Job,
    method: &MethodArgs,
    outputs: &OutputOptions,
    pool: &ThreadPool,
    console: &mut Console,
) -> Result<Result<Resolved, String>> {
    let settings = match job {
        Job::Surface => return resolve_settings(sequence, method, outputs, pool, console),
        Job::LevelSet { .. } => Settings::of_level_sets(&method.to_options())?,
        Job::Particles => Settings::of_level_sets(&MethodOptions::default())?,
    };
    let outputs = pool.install(|| outputs_of(&sequence.sequence, &settings, outputs));
    let resolved = outputs.map(|outputs| Resolved {
        settings: Arc::new(settings),
        measured: None,
        outputs: Arc::new(outputs),
    });
    Ok(resolved.map_err(|error| error.to_string()))
}

/// Refuses what needs particles, and what needs a slack where there is none.
///
/// # Errors
/// Which of the options.
pub(super) fn refuse_of_particles(method: &MethodArgs, slack_voxels: f64) -> Result<()> {
    refuse_of_surfaces_of_particles(method)?;
    match slack_voxels == 0.0 {
        true => refuse("without --band-slack it is not smoothed", &given_of(method, OptionGroup::Solver)),
        false => Ok(()),
    }
}

/// Refuses what says how pictures of particles are made, where there is a level set.
///
/// # Errors
/// Which of the options.
pub(super) fn refuse_method(method: &MethodArgs) -> Result<()> {
    refuse_of_surfaces_of_particles(method)?;
    let mut given = given_of(method, OptionGroup::Solver);
    if method.options.offset.is_some() {
        given.insert(0, typed("offset"));
    }
    refuse("a picture is of the file as it is", &given)
}

/// Refuses what is about particles, and surfaces that are made of them.
fn refuse_of_surfaces_of_particles(method: &MethodArgs) -> Result<()> {
    let mut general = given_of(method, OptionGroup::General);
    general.extend(method.particle_radius.map(|_| typed("particle_radius")));
    refuse("the file has its voxels", &general)?;
    // Its voxel size is known when it is read, and its particle spacing never.
    if method.options.offset.is_some_and(|offset| offset.unit != LengthUnit::World) {
        bail!("--offset must be in world units for a level set in .vdb, such as --offset 0.01");
    }
    let mut of_surface = given_of(method, OptionGroup::Surface);
    of_surface.retain(|option| option != "--offset");
    refuse("that is for surfaces of particles, and it has none", &of_surface)?;
    let of_particles = given_of(method, OptionGroup::Particles);
    refuse("that is for particles, and it has none", &of_particles)?;
    let mut of_obstacles: Vec<String> =
        method.obstacle.first().map(|_| typed("obstacle")).into_iter().collect();
    of_obstacles.extend(given_of(method, OptionGroup::Obstacles));
    refuse("obstacles are for particles", &of_obstacles)
}

/// The options of a group that are given, as they are typed.
fn given_of(method: &MethodArgs, group: OptionGroup) -> Vec<String> {
    let given = method.options.to_pairs().into_iter();
    let is_one = |name: &str| MethodOptions::info(name).is_some_and(|info| info.group == group);
    given.filter(|(name, _)| is_one(name)).map(|(name, _)| typed(name)).collect()
}

/// Refuses these options, which are given.
///
/// # Errors
/// Which, if there are any.
pub(super) fn refuse(why: &str, given: &[String]) -> Result<()> {
    match given.is_empty() {
        true => Ok(()),
        false => bail!("{} cannot be given with a level set in .vdb: {why}", given.join(", ")),
    }
}
