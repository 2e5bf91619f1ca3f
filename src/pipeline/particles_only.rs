//! Particles from one format to another: read, and written as they are, without a surface.
//!
//! ```text
//!   file ──read──▶ particles, with all that is known of them ──write──▶ .ply .vtp
//! ```
//!
//! Files are read, told apart and written as those of the stages are: a file that is written meanwhile is no frame, an output
//! appears whole or not at all, and says what it was made from. Nothing is resolved for a sequence, so frames know
//! nothing of each other.

use std::fs;
use std::path::PathBuf;

use meniscus_formats::{Error, Limits, ParticleFrame, Positions, read_particles};
use rayon::prelude::*;
use twox_hash::XxHash3_128;

use super::frame::{FrameError, FrameReport, Outcome, ReadInput, Stage};
use super::outputs::{OutputFormat, output_path};
use super::provenance::{particles_provenance, records};
use super::reading::read_frame_unchanged;
use super::sink::{Unseen, publish, write_unseen};
use super::stages::{Conduct, OnError};
use super::steps::{StepsFoundBy, by_lines_of_file, file_of, reading_bytes};

/// A frame of which the particles are to be written.
#[derive(Clone, Debug)]
pub struct ParticlesToWrite {
    /// The file of particles, or the step of one.
    pub input: PathBuf,
    /// What the outputs are called, without folder and extension.
    pub stem: String,
    /// Where they go.
    pub folder: PathBuf,
    /// One file for each; formats that hold particles.
    pub formats: Vec<OutputFormat>,
}

/// Writes the particles of the frames of a list; `finished` hears of each, by its index and in order. As many frames are
/// under way as there are threads and memory for; where the first that fails is to be the end, one after the other.
pub fn write_particles_of(
    frames: &[ParticlesToWrite],
    conduct: &Conduct<'_>,
    mut finished: impl FnMut(usize, Outcome),
) {
    let mut is_stopped = false;
    let mut next = 0;
    while next < frames.len() {
        let group = &frames[next..next + group_size(&frames[next..], conduct)];
        let outcomes: Vec<Outcome> = match is_stopped {
            true => group.iter().map(|_| Outcome::NotStarted).collect(),
            false => conduct.pool.install(|| group.par_iter().map(|frame| outcome(frame, conduct)).collect()),
        };
        for outcome in outcomes {
            let is_failure = matches!(outcome, Outcome::Failed(_) | Outcome::Changed);
            is_stopped |= is_failure && conduct.on_error == OnError::Stop;
            finished(next, outcome);
            next += 1;
        }
    }
}

/// Memory for a frame, in sizes of its file: its bytes, and what is parsed from them.
const FRAME_MEMORY: u64 = 3;

/// How many of the next frames are under way together; at least one.
fn group_size(frames: &[ParticlesToWrite], conduct: &Conduct<'_>) -> usize {
    if conduct.on_error == OnError::Stop {
        return 1;
    }
    let mut left = conduct.memory_bytes;
    let fits = |frame: &&ParticlesToWrite| {
        let bytes = reading_bytes(&frame.input, StepsFoundBy::Reader).saturating_mul(FRAME_MEMORY);
        let fits = bytes <= left;
        left = left.saturating_sub(bytes);
        fits
    };
    frames.iter().take(conduct.pool.current_num_threads()).take_while(fits).count().max(1)
}

fn outcome(frame: &ParticlesToWrite, conduct: &Conduct<'_>) -> Outcome {
    let made = FrameError::catch(&frame.input, Stage::Read, || made(frame, conduct));
    made.map_err(Outcome::Failed).flatten().unwrap_or_else(|outcome| outcome)
}

fn made(frame: &ParticlesToWrite, conduct: &Conduct<'_>) -> Result<Outcome, Outcome> {
    let failed = |error| Outcome::Failed(FrameError::file(&frame.input, Stage::Read, error));
    let unchanged = read_frame_unchanged(&frame.input, StepsFoundBy::Reader).map_err(failed)?;
    let (bytes, stamp) = unchanged.ok_or(Outcome::Changed)?;
    let input = ReadInput { stamp, hash: XxHash3_128::oneshot(&bytes) };
    let provenance = particles_provenance(&frame.input, input.hash);
    if conduct.skip_done
        && is_done(frame, &provenance)
        && let Some(fault) = conduct.recorded_fault(&output_paths(frame))
    {
        return Err(Outcome::AlreadyDone { input, fault });
    }
    let name = file_of(&frame.input).file_name().unwrap_or_default().to_string_lossy();
    let particles = read_particles(&bytes, &name, &Limits::default())
        .map_err(|error| failed(by_lines_of_file(&frame.input, error)))?;
    drop(bytes);
    let (outputs, output_bytes) = written(frame, &particles, &provenance).map_err(Outcome::Failed)?;
    conduct.record(&outputs, None);
    let mut report = FrameReport { input, outputs, output_bytes, ..FrameReport::default() };
    report.skin.particle_count = particles.positions.len();
    report.notes = notes(frame, &particles);
    Ok(Outcome::Converted(Box::new(report)))
}

fn output_paths(frame: &ParticlesToWrite) -> Vec<PathBuf> {
    frame.formats.iter().map(|format| output_path(&frame.folder, &frame.stem, *format)).collect()
}

fn is_done(frame: &ParticlesToWrite, provenance: &[(String, String)]) -> bool {
    frame.formats.iter().all(|&format| {
        let path = output_path(&frame.folder, &frame.stem, format);
        records(&path, format, provenance).unwrap_or(false)
    })
}

fn written(
    frame: &ParticlesToWrite,
    particles: &ParticleFrame,
    provenance: &[(String, String)],
) -> Result<(Vec<PathBuf>, Vec<u64>), FrameError> {
    let fail = |path: &std::path::Path, error| FrameError::file(path, Stage::Write, error);
    fs::create_dir_all(&frame.folder).map_err(|error| fail(&frame.folder, error.into()))?;
    let write_one = |&format: &OutputFormat| {
        let path = output_path(&frame.folder, &frame.stem, format);
        let written = write_unseen(&path, |out| match format.particles() {
            Some(writer) => (writer.write)(particles, provenance, out),
            None => Err(Error::unsupported("particles", format!("a .{format} holds no particles"))),
        });
        written.map_err(|error| fail(&path, error))
    };
    let unseen: Vec<Unseen> = frame.formats.iter().map(write_one).collect::<Result<_, _>>()?;
    let sizes_bytes = unseen.iter().map(Unseen::size_bytes).collect();
    let paths = publish(unseen).map_err(|(path, error)| fail(&path, error.into()))?;
    Ok((paths, sizes_bytes))
}

/// What a user should know of the file and of what became of it.
fn notes(frame: &ParticlesToWrite, particles: &ParticleFrame) -> Vec<String> {
    let of_format = |format: &OutputFormat| {
        format.particles().map(|writer| (writer.notes)(particles)).unwrap_or_default()
    };
    let of_positions = match not_finite_count(&particles.positions) {
        0 => None,
        count => Some(format!("{count} of {} positions are not finite", particles.positions.len())),
    };
    let notes = particles.notes.iter().cloned().chain(of_positions);
    notes.chain(frame.formats.iter().flat_map(of_format)).collect()
}

fn not_finite_count(positions: &Positions) -> usize {
    match positions {
        Positions::F32(positions) => positions.iter().filter(|p| !p.iter().all(|x| x.is_finite())).count(),
        Positions::F64(positions) => positions.iter().filter(|p| !p.iter().all(|x| x.is_finite())).count(),
    }
}
