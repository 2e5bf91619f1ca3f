//! Converts particles to another format without a surface, and warns about losses.

use std::io::Write;

use meniscus_formats::{Error, FilePositions, ParticleFrame};

use crate::pipeline::target::outputs::OutputFormat;
use crate::pipeline::warning::Warning;

/// Writes particles.
///
/// # Errors
/// When the format cannot hold particles, or the system reports an error.
pub(crate) fn write_particles_as(
    particles: &ParticleFrame,
    format: OutputFormat,
    provenance: &[(String, String)],
    out: &mut impl Write,
) -> meniscus_formats::Result<()> {
    match format.particles() {
        Some(writer) => (writer.write)(particles, provenance, out),
        None => Err(Error::unsupported("particles", format!("a .{format} cannot hold particles"))),
    }
}

/// Warnings about the file, and about its conversion to these formats.
pub(crate) fn particle_warnings(particles: &ParticleFrame, formats: &[OutputFormat]) -> Vec<Warning> {
    let mut warnings: Vec<Warning> = particles.notes.iter().cloned().map(Warning::new).collect();
    let is_finite = |index: &usize| match &particles.positions {
        FilePositions::F32(positions) => positions[*index].iter().all(|x| x.is_finite()),
        FilePositions::F64(positions) => positions[*index].iter().all(|x| x.is_finite()),
    };
    let particle_count = particles.positions.len();
    let count = particle_count - (0..particle_count).filter(is_finite).count();
    if count > 0 {
        warnings.push(Warning::new(format!("{count} of {particle_count} positions are not finite")));
    }
    for writer in formats.iter().filter_map(|format| format.particles()) {
        warnings.extend((writer.notes)(particles).into_iter().map(Warning::new));
    }
    warnings
}
