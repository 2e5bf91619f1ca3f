//! From what was typed, or stands in a file, to the types of the layers below.

use std::path::PathBuf;

use meniscus_formats::{gltf, vdb};

use crate::pipeline::{OutputFormat, OutputOptions};
use crate::settings::{Choices, Contouring, Integrator};

use super::args::{
    CompressionChoice, ContourChoice, Format, FormatArgs, IntegratorChoice, SolverArgs, SurfaceArgs, UpChoice,
};

/// The choices of the method.
pub(super) fn choices(surface: &SurfaceArgs, solver: &SolverArgs) -> Choices {
    Choices {
        radius_min: surface.radius_min,
        radius_ratio: surface.radius_ratio,
        radius_init: surface.radius_init,
        integrator: solver.integrator.map(|integrator| match integrator {
            IntegratorChoice::Fast => Integrator::Fast,
            IntegratorChoice::Implicit => Integrator::Implicit,
            IntegratorChoice::Explicit => Integrator::Explicit,
        }),
        laplacian_steps: solver.laplacian_steps,
        steps: solver.steps,
        step_size: solver.step_size,
        redistance_every: solver.redistance_every,
        cg_tolerance: solver.cg_tolerance,
        contouring: surface.contour.map(|contour| match contour {
            ContourChoice::Dual => Contouring::Dual,
            ContourChoice::Tetrahedra => Contouring::Tetrahedra,
        }),
    }
}

/// What was typed and changes nothing, a sentence each.
pub(super) fn ignored(solver: &SolverArgs) -> Option<&'static str> {
    let is_used = solver.integrator == Some(IntegratorChoice::Implicit);
    (solver.cg_tolerance.is_some() && !is_used)
        .then_some("--cg-tolerance is ignored: it is for --integrator implicit only")
}

/// What is written, to `folder`: .glb and .vdb by default.
pub(super) fn output_options(
    folder: PathBuf,
    formats: Option<&[Format]>,
    args: &FormatArgs,
) -> OutputOptions {
    let mut distinct = Vec::new();
    for &format in formats.unwrap_or(&[Format::Glb, Format::Vdb]) {
        let format = match format {
            Format::Glb => OutputFormat::Glb,
            Format::Gltf => OutputFormat::Gltf,
            Format::Vdb => OutputFormat::Vdb,
            Format::Obj => OutputFormat::Obj,
            Format::Ply => OutputFormat::Ply,
        };
        if !distinct.contains(&format) {
            distinct.push(format);
        }
    }
    OutputOptions {
        folder,
        formats: distinct,
        up: match args.up.unwrap_or(UpChoice::Y) {
            UpChoice::Y => gltf::UpAxis::Y,
            UpChoice::Z => gltf::UpAxis::Z,
        },
        vdb_half: args.vdb_half,
        vdb_compression: match args.vdb_compression.unwrap_or(CompressionChoice::Blosc) {
            CompressionChoice::None => vdb::Compression::None,
            CompressionChoice::Active => vdb::Compression::ActiveMask,
            CompressionChoice::Blosc => vdb::Compression::Blosc,
        },
    }
}
