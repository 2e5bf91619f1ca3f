//! Reads a frame from its two files.

use anyhow::{Context, Result, anyhow};
use meniscus_formats::{AttributeRole, FileAttribute, Limits, ParticleFrame, Values, read_particles};
use std::path::Path;

use crate::pipeline::{MeshFile, file_of, keep_chosen, measure_spacing, particles, read_file, shown};
use crate::surface::flicker::{FlickerFrame, MovingParticles};
use crate::surface::obstacle::MeshDistance;
use crate::surface::options::SpacingOptions;
use crate::surface::particles::ParticleFilter;

use super::frames::{FlickerFrames, FrameFiles};

/// Reads the mesh of a frame, and the particles that meet the condition.
pub(super) fn read_frame(
    files: &FrameFiles,
    spacing: f64,
    filter: Option<&ParticleFilter>,
) -> Result<FlickerFrame> {
    let mesh = MeshFile::read(&files.mesh)?.data;
    let surface = MeshDistance::new(&mesh.positions, &mesh.triangles);
    Ok(FlickerFrame::new(read_moving(&files.particles, filter)?, surface, spacing))
}

/// Measures the particle spacing as `convert` does, on all frames of the particles, and returns warnings
/// about it.
pub(super) fn estimated_spacing(
    frames: &FlickerFrames,
    filter: Option<&ParticleFilter>,
) -> Result<(f64, Vec<String>)> {
    let options = SpacingOptions { filter: filter.cloned(), ..SpacingOptions::default() };
    let measured = measure_spacing(frames.particles.iter().map(|path| &**path), &options)?;
    Ok((measured.spacing, measured.warnings))
}

fn read_moving(path: &Path, filter: Option<&ParticleFilter>) -> Result<MovingParticles> {
    let bytes = read_file(path)?;
    let name = file_of(path).file_name().unwrap_or_default().to_string_lossy();
    let mut frame =
        read_particles(&bytes, &name, &Limits::default()).with_context(|| shown(path).to_string())?;
    keep_chosen(&mut frame, filter).map_err(|why| anyhow!("{}: {why}", shown(path)))?;
    let ParticleFrame { positions, attributes, .. } = frame;
    let of_role = |role: AttributeRole, arity: usize| {
        attributes.iter().find(move |attribute| attribute.role == Some(role) && attribute.arity == arity)
    };
    let ids = of_role(AttributeRole::Id, 1).and_then(integers);
    let velocities = of_role(AttributeRole::Velocity, 3).and_then(vectors);
    Ok(MovingParticles { positions: particles(positions), ids, velocities })
}

/// The values of an attribute as integers. Floats are converted if all of them are integers up to ±2⁵³.
fn integers(attribute: &FileAttribute) -> Option<Vec<i64>> {
    const EXACT: f64 = 9_007_199_254_740_992.0; // 2⁵³
    let whole = |value: f64| (value.fract() == 0.0 && value.abs() <= EXACT).then_some(value as i64);
    match &attribute.values {
        Values::U8(values) => Some(values.iter().map(|&value| value.into()).collect()),
        Values::I32(values) => Some(values.iter().map(|&value| value.into()).collect()),
        Values::I64(values) => Some(values.clone()),
        Values::F32(values) => values.iter().map(|&value| whole(value.into())).collect(),
        Values::F64(values) => values.iter().map(|&value| whole(value)).collect(),
        Values::Strings { .. } => None,
    }
}

fn vectors(attribute: &FileAttribute) -> Option<Vec<[f32; 3]>> {
    let numbers: Vec<f32> = match &attribute.values {
        Values::F32(values) => values.clone(),
        Values::F64(values) => values.iter().map(|&value| value as f32).collect(),
        Values::U8(values) => values.iter().map(|&value| value.into()).collect(),
        Values::I32(values) => values.iter().map(|&value| value as f32).collect(),
        Values::I64(values) => values.iter().map(|&value| value as f32).collect(),
        Values::Strings { .. } => return None,
    };
    Some(numbers.as_chunks::<3>().0.to_vec())
}
