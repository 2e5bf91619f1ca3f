//! Particles as they are, in another format: what is written of them, and what a user should know of it.

use std::io::Write;

use meniscus_formats::{Error, ParticleFrame, Positions};

use super::outputs::OutputFormat;

/// Writes particles.
///
/// # Errors
/// When the format holds no particles, or the system refuses.
pub(super) fn write_particles(
    particles: &ParticleFrame,
    format: OutputFormat,
    provenance: &[(String, String)],
    out: &mut impl Write,
) -> meniscus_formats::Result<()> {
    match format.particles() {
        Some(writer) => (writer.write)(particles, provenance, out),
        None => Err(Error::unsupported("particles", format!("a .{format} holds no particles"))),
    }
}

/// What a user should know of the file and of what became of it in these formats.
pub(super) fn particle_notes(particles: &ParticleFrame, formats: &[OutputFormat]) -> Vec<String> {
    let of_format = |format: &OutputFormat| {
        format.particles().map(|writer| (writer.notes)(particles)).unwrap_or_default()
    };
    let of_positions = match not_finite_count(&particles.positions) {
        0 => None,
        count => Some(format!("{count} of {} positions are not finite", particles.positions.len())),
    };
    let notes = particles.notes.iter().cloned().chain(of_positions);
    notes.chain(formats.iter().flat_map(of_format)).collect()
}

fn not_finite_count(positions: &Positions) -> usize {
    match positions {
        Positions::F32(positions) => positions.iter().filter(|p| !p.iter().all(|x| x.is_finite())).count(),
        Positions::F64(positions) => positions.iter().filter(|p| !p.iter().all(|x| x.is_finite())).count(),
    }
}
