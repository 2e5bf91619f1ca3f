//! Level sets in .vdb as inputs: contoured as they are, or smoothed within --band-slack.

use std::sync::Arc;

use anyhow::{Result, bail};
use rayon::ThreadPool;

use crate::pipeline::{Job, OutputOptions, is_level_set};
use crate::surface::options::{Choices, Settings};

use super::args::{FirstArgs, MethodArgs, ObstacleArgs, ParticleArgs, SolverArgs, SurfaceArgs};
use super::choices::choices;
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
        Job::LevelSet { .. } => Settings::of_level_sets(&choices(method))?,
        Job::Particles => Settings::of_level_sets(&Choices::default())?,
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
        true => refuse("without --band-slack it is not smoothed", &of_solver(&method.solver)),
        false => Ok(()),
    }
}

/// Refuses what says how pictures of particles are made, where there is a level set.
///
/// # Errors
/// Which of the options.
pub(super) fn refuse_method(method: &MethodArgs) -> Result<()> {
    refuse_of_surfaces_of_particles(method)?;
    let of_surface = [("--offset", method.surface.offset.is_some())];
    refuse("a picture is of the file as it is", &[&of_surface[..], &of_solver(&method.solver)].concat())
}

/// Refuses what is about particles, and surfaces that are made of them.
fn refuse_of_surfaces_of_particles(method: &MethodArgs) -> Result<()> {
    let MethodArgs { first, surface, particles, obstacles, mesh: _, solver: _ } = method;
    let FirstArgs { preset, spacing, voxel_size } = first;
    refuse(
        "the file has its voxels",
        &[
            ("--voxel-size", voxel_size.is_some()),
            ("--spacing", spacing.spacing.is_some()),
            ("--particle-radius", spacing.particle_radius.is_some()),
            ("--preset", preset.is_some()),
        ],
    )?;
    let SurfaceArgs { radius_min, radius_ratio, radius_init, offset: _, drop_islands, fill_cavities, clip } =
        surface;
    let of_surface = [
        ("--radius-min", radius_min.is_some()),
        ("--radius-ratio", radius_ratio.is_some()),
        ("--radius-init", radius_init.is_some()),
        ("--drop-islands", drop_islands.is_some()),
        ("--fill-cavities", fill_cavities.is_some()),
        ("--clip", clip.is_some()),
    ];
    refuse("that is for surfaces of particles, and it has none", &of_surface)?;
    let ParticleArgs {
        radius_attribute,
        radius_scale,
        anisotropy,
        max_stretch,
        thin_radius,
        lone_radius,
        neighbor_radius,
        position_smoothing,
        velocity_gain,
        attributes,
    } = particles;
    let of_particles = [
        ("--radius-attribute", radius_attribute.is_some()),
        ("--radius-scale", radius_scale.is_some()),
        ("--anisotropy", anisotropy.is_some()),
        ("--max-stretch", max_stretch.is_some()),
        ("--thin-radius", thin_radius.is_some()),
        ("--lone-radius", lone_radius.is_some()),
        ("--neighbor-radius", neighbor_radius.is_some()),
        ("--position-smoothing", position_smoothing.is_some()),
        ("--velocity-gain", velocity_gain.is_some()),
        ("--attributes", attributes.is_some()),
    ];
    refuse("that is for particles, and it has none", &of_particles)?;
    let ObstacleArgs { obstacle, void_threshold } = obstacles;
    refuse(
        "obstacles are for particles",
        &[("--obstacle", !obstacle.is_empty()), ("--void-threshold", void_threshold.is_some())],
    )
}

fn of_solver(solver: &SolverArgs) -> [(&'static str, bool); 6] {
    let SolverArgs { integrator, laplacian_steps, steps, step_size, redistance_every, cg_tolerance } = solver;
    [
        ("--integrator", integrator.is_some()),
        ("--laplacian-steps", laplacian_steps.is_some()),
        ("--steps", steps.is_some()),
        ("--step-size", step_size.is_some()),
        ("--redistance-every", redistance_every.is_some()),
        ("--cg-tolerance", cg_tolerance.is_some()),
    ]
}

/// Refuses those of the options that are given, by name.
///
/// # Errors
/// Which.
pub(super) fn refuse(why: &str, options: &[(&str, bool)]) -> Result<()> {
    let given: Vec<&str> =
        options.iter().filter(|(_, is_given)| *is_given).map(|(option, _)| *option).collect();
    match given.is_empty() {
        true => Ok(()),
        false => bail!("{} cannot be given with a level set in .vdb: {why}", given.join(", ")),
    }
}
