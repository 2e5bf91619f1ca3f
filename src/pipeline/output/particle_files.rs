//! Converts particles to another format without a surface, and warns about losses.

use std::io::Write;

use meniscus_formats::{Error, FilePositions, ParticleFrame};

use crate::pipeline::target::outputs::OutputFormat;
use crate::pipeline::warning::{InputWarning, Warning};

/// Writes particles.
///
/// # Errors
/// When the format cannot hold particles, or the system reports an error.
pub(crate) fn write_particles(
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
    let of_format = |format: &OutputFormat| {
        format.particles().map(|writer| (writer.notes)(particles)).unwrap_or_default()
    };
    let particle_count = particles.positions.len();
    let count = not_finite_count(&particles.positions);
    let of_positions =
        (count > 0).then_some(Warning::Input(InputWarning::PositionsNotFinite { count, particle_count }));
    let of_file = particles.notes.iter().cloned().map(Warning::Sentence);
    let of_formats = formats.iter().flat_map(of_format).map(Warning::Sentence);
    of_file.chain(of_positions).chain(of_formats).collect()
}

fn not_finite_count(positions: &FilePositions) -> usize {
    match positions {
        FilePositions::F32(positions) => {
            positions.iter().filter(|p| !p.iter().all(|x| x.is_finite())).count()
        }
        FilePositions::F64(positions) => {
            positions.iter().filter(|p| !p.iter().all(|x| x.is_finite())).count()
        }
    }
}
