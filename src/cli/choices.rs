//! From what was typed, or stands in a file, to the types of the layers below.

use std::io;
use std::path::PathBuf;

use anyhow::{Result, bail};
use meniscus_formats::{UpAxis, WriteOption, listed, vdb};

use crate::pipeline::{ObstacleFiles, OutputFormat, OutputOptions, PictureOptions};
use crate::surface::options::{AnisotropyKind, Choices, Contouring, Integrator, Preset, Settings};

use super::args::{
    AnisotropyChoice, CompressionChoice, ContourChoice, FirstArgs, Format, FormatArgs, IntegratorChoice,
    MeshArgs, MethodArgs, ObstacleArgs, ParticleArgs, PresetChoice, SolverArgs, SurfaceArgs, UpChoice,
};
use super::console::Console;

/// The choices of the method.
pub(super) fn choices(args: &MethodArgs) -> Choices {
    let MethodArgs { first, surface, particles, obstacles, mesh, solver } = args.clone();
    let FirstArgs { preset, spacing, voxel_size } = first;
    let SurfaceArgs { radius_min, radius_ratio, radius_init, offset, drop_islands, fill_cavities, clip } =
        surface;
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
    let ObstacleArgs { obstacle: _, void_threshold } = obstacles;
    let MeshArgs { contour, decimate, smooth_normals, quads } = mesh;
    let SolverArgs { integrator, laplacian_steps, steps, step_size, redistance_every, cg_tolerance } = solver;
    Choices {
        preset: preset.map(preset_of),
        spacing: spacing.spacing(),
        voxel_size,
        radius_min,
        radius_ratio,
        radius_init,
        offset,
        radius_attribute,
        radius_scale,
        anisotropy: anisotropy.map(anisotropy_of),
        max_stretch,
        thin_radius,
        lone_radius,
        neighbor_radius,
        position_smoothing,
        velocity_gain,
        void_threshold,
        attributes,
        drop_islands,
        fill_cavities,
        clip,
        contouring: contour.map(contouring_of),
        decimate,
        smooth_normals,
        quads: quads.then_some(true),
        integrator: integrator.map(integrator_of),
        laplacian_steps,
        steps,
        step_size,
        redistance_every,
        cg_tolerance,
    }
}

fn preset_of(preset: PresetChoice) -> Preset {
    match preset {
        PresetChoice::Fluid => Preset::Fluid,
        PresetChoice::Noisy => Preset::Noisy,
        PresetChoice::Splash => Preset::Splash,
        PresetChoice::Granular => Preset::Granular,
        PresetChoice::Preview => Preset::Preview,
        PresetChoice::Paper => Preset::Paper,
        PresetChoice::Water => Preset::Water,
        PresetChoice::Faithful => Preset::Faithful,
        PresetChoice::Smooth => Preset::Smooth,
    }
}

fn anisotropy_of(anisotropy: AnisotropyChoice) -> AnisotropyKind {
    match anisotropy {
        AnisotropyChoice::None => AnisotropyKind::None,
        AnisotropyChoice::Neighbors => AnisotropyKind::Neighbors,
        AnisotropyChoice::Velocity => AnisotropyKind::Velocity,
    }
}

fn integrator_of(integrator: IntegratorChoice) -> Integrator {
    match integrator {
        IntegratorChoice::Fast => Integrator::Fast,
        IntegratorChoice::Implicit => Integrator::Implicit,
        IntegratorChoice::Explicit => Integrator::Explicit,
        IntegratorChoice::Adaptive => Integrator::Adaptive,
    }
}

fn contouring_of(contour: ContourChoice) -> Contouring {
    match contour {
        ContourChoice::Dual => Contouring::Dual,
        ContourChoice::Tetrahedra => Contouring::Tetrahedra,
    }
}

/// Tells of options that change nothing. One may be wrong and without effect: that it is wrong is told, and later.
pub(super) fn warn_of_ignored(
    method: &MethodArgs,
    formats: Option<&[Format]>,
    format_args: &FormatArgs,
    console: &Console,
) {
    let choices = choices(method);
    if Settings::check(&choices).is_ok() {
        for warning in ignored(method, &written_formats(formats, format_args), format_args) {
            console.warn(format_args!("warning: {warning}"));
        }
    }
}

/// The obstacles that were named.
///
/// # Errors
/// When there is no such file.
pub(super) fn obstacle_files(method: &MethodArgs) -> Result<ObstacleFiles> {
    let obstacles = ObstacleFiles::new(method.obstacles.obstacle.clone());
    if let Some(missing) = obstacles.missing() {
        let name = missing.display();
        match missing.metadata() {
            Ok(there) if there.is_dir() => {
                bail!("{name}: a folder is no obstacle: give a file, or a pattern such as body.####.obj")
            }
            Err(error) if error.kind() != io::ErrorKind::NotFound => bail!("obstacle {name}: {error}"),
            Ok(_) => bail!("{name}: an obstacle has to be a regular file"),
            Err(_) => bail!("{name}: there is no such obstacle"),
        }
    }
    Ok(obstacles)
}

/// What was typed and changes nothing, a sentence each.
pub(super) fn ignored(args: &MethodArgs, written: &[OutputFormat], format_args: &FormatArgs) -> Vec<String> {
    let ignored = without_use(args).into_iter();
    let ignored = ignored.map(|(option, with)| format!("{option} is ignored: it is for {with} only"));
    let idle = without_file(args, written, format_args).into_iter();
    let idle = idle.map(|(option, kind)| format!("{option} changes no file: it is for {kind} only"));
    let preset = args.first.preset.map(preset_of);
    let deprecated = preset.and_then(|preset| Some((preset.name(), preset.successor()?.name())));
    let deprecated = deprecated
        .map(|(name, successor)| format!("the preset `{name}` is deprecated: use --preset {successor}"));
    deprecated.into_iter().chain(ignored).chain(idle).collect()
}

/// Options that are without effect, and what they are for.
fn without_use(args: &MethodArgs) -> Vec<(&'static str, &'static str)> {
    let choices = choices(args);
    let ParticleArgs { radius_scale, max_stretch, thin_radius, lone_radius, .. } = &args.particles;
    let ParticleArgs { neighbor_radius, velocity_gain, .. } = &args.particles;
    let anisotropy = choices.anisotropy_kind();
    let by_neighbors = choices.uses_neighbors();
    let is_flattened = anisotropy == AnisotropyKind::Neighbors;
    let is_implicit = choices.integrator == Some(Integrator::Implicit);
    let cases = [
        ("--cg-tolerance", args.solver.cg_tolerance.is_some(), is_implicit, "--integrator implicit"),
        ("--radius-scale", radius_scale.is_some(), choices.radius_attribute.is_some(), "--radius-attribute"),
        ("--max-stretch", max_stretch.is_some(), anisotropy != AnisotropyKind::None, "--anisotropy"),
        ("--thin-radius", thin_radius.is_some(), is_flattened, "--anisotropy neighbors"),
        ("--lone-radius", lone_radius.is_some(), is_flattened, "--anisotropy neighbors"),
        (
            "--neighbor-radius",
            neighbor_radius.is_some(),
            by_neighbors,
            "--anisotropy neighbors and --position-smoothing",
        ),
        (
            "--velocity-gain",
            velocity_gain.is_some(),
            anisotropy == AnisotropyKind::Velocity,
            "--anisotropy velocity",
        ),
        (
            "--void-threshold",
            args.obstacles.void_threshold.is_some(),
            !args.obstacles.obstacle.is_empty(),
            "--obstacle",
        ),
    ];
    let ignored = cases.into_iter().filter(|(_, is_given, is_used, _)| *is_given && !is_used);
    ignored.map(|(option, _, _, with)| (option, with)).collect()
}

/// Options for files of a kind that is not written, and which that is.
fn without_file(
    args: &MethodArgs,
    written: &[OutputFormat],
    format_args: &FormatArgs,
) -> Vec<(&'static str, String)> {
    let MeshArgs { contour, decimate, smooth_normals, quads } = &args.mesh;
    let meshes = || OutputFormat::ALL.into_iter().filter(|format| format.is_mesh()).collect();
    let of = |option: WriteOption| {
        OutputFormat::ALL.into_iter().filter(|format| format.has_option(option)).collect::<Vec<_>>()
    };
    let cases: [(&str, bool, Vec<OutputFormat>); 10] = [
        ("--contour", contour.is_some(), meshes()),
        ("--decimate", decimate.is_some(), meshes()),
        ("--smooth-normals", smooth_normals.is_some(), meshes()),
        ("--quads", *quads, of(WriteOption::Quads)),
        ("--up", format_args.up.is_some(), of(WriteOption::Up)),
        ("--meters-per-unit", format_args.meters_per_unit.is_some(), of(WriteOption::MetersPerUnit)),
        ("--preview-size", format_args.preview_size.is_some(), of(WriteOption::Size)),
        ("--camera", format_args.camera.is_some(), of(WriteOption::Camera)),
        ("--vdb-half", format_args.vdb_half, of(WriteOption::Half)),
        ("--vdb-compression", format_args.vdb_compression.is_some(), of(WriteOption::Compression)),
    ];
    let is_idle = |(_, is_given, formats): &(&str, bool, Vec<OutputFormat>)| {
        *is_given && !formats.iter().any(|format| written.contains(format))
    };
    let idle = cases.into_iter().filter(is_idle);
    idle.map(|(option, _, formats)| (option, kinds(&formats))).collect()
}

/// What these formats are called where an option is for them only.
fn kinds(formats: &[OutputFormat]) -> String {
    let (pictures, files): (Vec<_>, Vec<_>) = formats.iter().partition(|format| format.is_picture());
    let has_all_meshes = OutputFormat::ALL.iter().all(|format| !format.is_mesh() || files.contains(format));
    match (files.as_slice(), pictures.as_slice()) {
        ([], _) => "--preview".to_owned(),
        (_, []) if has_all_meshes => "meshes".to_owned(),
        (files, []) => listed(files.iter().map(|format| format!(".{format}")).collect(), "and"),
        (files, _) => {
            let files = files.iter().map(|format| format!(".{format}"));
            listed(files.chain(["pictures".to_owned()]).collect(), "and")
        }
    }
}

/// Refuses a number that was to be the value of --smooth-normals and is taken for an input, since that has its value
/// after a =.
///
/// # Errors
/// What to write instead.
pub(super) fn refuse_stray_rounds(args: &MethodArgs, inputs: &[PathBuf]) -> Result<()> {
    let is_stray = |input: &&PathBuf| {
        input.to_str().is_some_and(|text| text.parse::<u32>().is_ok()) && input.symlink_metadata().is_err()
    };
    if args.mesh.smooth_normals.is_some()
        && let Some(input) = inputs.iter().find(is_stray)
    {
        let number = input.display();
        bail!("{number}: no such file or folder; for {number} rounds, write --smooth-normals={number}");
    }
    Ok(())
}

/// Refuses to quantize where no .glb is written: whoever asks for it counts on small files.
///
/// # Errors
/// What to do instead.
pub(super) fn refuse_idle_quantize(formats: Option<&[Format]>, args: &FormatArgs) -> Result<()> {
    let written = written_formats(formats, args);
    if args.quantize && !written.iter().any(|format| format.has_option(WriteOption::Quantize)) {
        bail!("--quantize is for .glb only, and none is written: leave it out, or add glb to --format");
    }
    Ok(())
}

/// What is written, to `folder`: .glb and .vdb by default.
pub(super) fn output_options(
    folder: PathBuf,
    formats: Option<&[Format]>,
    args: &FormatArgs,
) -> OutputOptions {
    OutputOptions {
        folder,
        formats: written_formats(formats, args),
        up: match args.up.unwrap_or(UpChoice::Y) {
            UpChoice::Y => UpAxis::Y,
            UpChoice::Z => UpAxis::Z,
        },
        meters_per_unit: args.meters_per_unit.unwrap_or(1.0),
        quantize: args.quantize,
        vdb_half: args.vdb_half,
        vdb_compression: match args.vdb_compression.unwrap_or(CompressionChoice::Blosc) {
            CompressionChoice::None => vdb::Compression::None,
            CompressionChoice::Active => vdb::Compression::ActiveMask,
            CompressionChoice::Blosc => vdb::Compression::Blosc,
        },
        picture: picture_options(args),
    }
}

/// How pictures are taken.
fn picture_options(args: &FormatArgs) -> PictureOptions {
    let default = PictureOptions::default();
    PictureOptions {
        size: args.preview_size.map_or(default.size, |size| size.map(usize::from)),
        camera: args.camera.unwrap_or(default.camera),
    }
}

/// The formats to write, each once: .glb and .vdb by default; and a picture if that was asked for.
pub(super) fn written_formats(formats: Option<&[Format]>, args: &FormatArgs) -> Vec<OutputFormat> {
    let mut written = Vec::new();
    let formats = formats.unwrap_or(&DEFAULT_FORMATS).iter().map(|format| format.0);
    for format in formats.chain(args.preview.map(|preview| preview.0)) {
        if !written.contains(&format) {
            written.push(format);
        }
    }
    written
}

const DEFAULT_FORMATS: [Format; 2] = [Format(OutputFormat::Glb), Format(OutputFormat::Vdb)];
