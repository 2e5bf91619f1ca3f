//! `meniscus convert` of level sets in .vdb: contoured as they are, or smoothed within --band-slack.

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};

use crate::pipeline::{BandToSurface, FrameReport, is_level_set, resurface_all};
use crate::surface::options::{Choices, Preset, Settings};
use crate::surface::simd::level_warning;

use super::Verdict;
use super::args::{
    ConvertArgs, FirstArgs, MethodArgs, ObstacleArgs, ParticleArgs, ShotArgs, SolverArgs, SurfaceArgs,
};
use super::choices::{choices, obstacle_files, output_options, warn_of_ignored};
use super::console::Console;
use super::convert::{conduct, thread_pool};
use super::out_folder::OutFolder;
use super::output_records::OutputRecords;
use super::selecting::{Selection, refuse_conflicts};
use super::tally::Tally;
use super::wording::counted;

/// Whether the inputs are level sets, and no particles.
///
/// # Errors
/// When they are both.
pub(super) fn are_level_sets(selection: &Selection, args: &ConvertArgs) -> Result<bool> {
    let mut files = selection.sequences.iter().flat_map(|sequence| &sequence.selected);
    let is_one = files.clone().any(|file| is_level_set(&file.path));
    match files.find(|file| is_level_set(&file.path) != is_one) {
        Some(other) if is_one => {
            bail!(
                "{}: level sets and particles are converted one after the other, not together",
                other.path.display()
            )
        }
        _ if !is_one && args.band_slack.is_some() => bail!("--band-slack is for level sets in .vdb"),
        _ => Ok(is_one),
    }
}

/// Writes the surfaces that the arguments ask for.
///
/// # Errors
/// When nothing can be done at all. A file that fails is no error here: it is told, and counted.
pub(super) fn convert_level_sets(
    args: &ConvertArgs,
    Selection { sequences, found, .. }: &Selection,
    start: Instant,
    console: &mut Console,
) -> Result<Verdict> {
    let slack_voxels = args.band_slack.unwrap_or(0.0);
    refuse_of_particles(args, slack_voxels)?;
    warn_of_ignored(&args.method, args.format.as_deref(), &args.formats, console);
    if let Some(warning) = level_warning() {
        console.warn(format_args!("warning: {warning}"));
    }
    let folder = args.out.clone().context("--out is missing: the folder for the results")?;
    let outputs = output_options(folder, args.format.as_deref(), &args.formats);
    let out_folder = OutFolder::make(&outputs.folder)?;
    refuse_conflicts(sequences, found, &obstacle_files(&args.method)?, &outputs, None)?;
    let (outputs, choices): (Arc<_>, Choices) = (Arc::new(outputs), choices(&args.method));
    // What makes no sense with any voxel is no fault of a file.
    Settings::check(&Choices { preset: Some(Preset::Paper), ..choices.clone() })?;
    let bands: Vec<BandToSurface> = sequences
        .iter()
        .flat_map(|sequence| &sequence.selected)
        .map(|file| BandToSurface {
            input: file.path.clone(),
            stem: file.stem(),
            choices: choices.clone(),
            slack_voxels,
            outputs: Arc::clone(&outputs),
        })
        .collect();
    let pool = thread_pool(args.threads)?;
    let records = OutputRecords::load([outputs.folder.clone()]);
    let conduct = conduct(args, &pool, Some(&records))?;
    out_folder.keep();
    let mut tally = Tally::of_surfaces(args.allow_violations);
    let has_bar = console.show_bar(bands.len());
    let described = |report: &FrameReport| {
        let mesh = &report.skin.mesh;
        let of_mesh =
            format!("{}, {}", counted(mesh.vertex_count, "vertex"), counted(mesh.triangle_count, "triangle"));
        match report.skin.certificate.holds() {
            true => of_mesh,
            false => format!("{of_mesh}; the certificate does not hold: {}", report.skin.certificate.fault()),
        }
    };
    resurface_all(&bands, &conduct, |index, outcome| {
        tally.note(&bands[index].input, &outcome, described, (has_bar, console));
        records.frame_finished();
    });
    console.hide_bar();
    records.save(console);
    Ok(tally.finish(bands.len(), start.elapsed().as_secs_f64(), console))
}

/// Refuses what needs particles, what needs a slack where there is none, and what level sets are not converted to.
fn refuse_of_particles(args: &ConvertArgs, slack_voxels: f64) -> Result<()> {
    let ShotArgs { sequence_glb, sequence_usda, fps } = &args.shot;
    refuse_of_surfaces_of_particles(&args.method)?;
    refuse(
        "it is about frames of particles; what is made is told on the console",
        &[("--report", args.report.is_some())],
    )?;
    refuse("it is about particles", &[("--print-settings", args.print_settings)])?;
    refuse(
        "`meniscus sequence` gathers what is made of it",
        &[
            ("--sequence-glb", sequence_glb.is_some()),
            ("--sequence-usda", sequence_usda.is_some()),
            ("--fps", fps.is_some()),
        ],
    )?;
    refuse("`meniscus render` takes pictures of it", &[("--preview", args.formats.preview.is_some())])?;
    match slack_voxels == 0.0 {
        true => refuse("without --band-slack it is not smoothed", &of_solver(&args.method.solver)),
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
fn refuse(why: &str, options: &[(&str, bool)]) -> Result<()> {
    let given: Vec<&str> =
        options.iter().filter(|(_, is_given)| *is_given).map(|(option, _)| *option).collect();
    match given.is_empty() {
        true => Ok(()),
        false => bail!("{} cannot be given with a level set in .vdb: {why}", given.join(", ")),
    }
}
