//! The input of a frame: particles in memory, particles in a file that is read repeatedly, or a level set.

use std::borrow::Cow;
use std::io;
use std::path::Path;
use std::sync::Arc;

use glam::{DVec3, IVec3};
use meniscus_formats::vdb;
use meniscus_formats::{Error, FilePositions, Limits, ParticleBatch, ParticleBatches, ParticleFrame};
use rayon::prelude::*;

use crate::surface::grid::Leaf;
use crate::surface::level_set::NarrowBand;
use crate::surface::particles::{self, ParticleCloud, ParticleFilter, ParticleSource, Shapes};

use crate::surface::options::Settings;
use crate::surface::reconstruction::smooth_level_set_bytes_max;

use super::filter::{keep_chosen, none_chosen, several_kinds, various_sizes};
use super::frame::{Frame, Job};
use super::level_set_file::{LevelSetFile, is_leaf_origin, voxel_size};
use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::memory::reading_limits;
use crate::pipeline::target::outputs::OutputFormat;
use crate::pipeline::warning::Warning;

/// The input of a frame.
#[derive(Debug)]
pub(crate) enum FrameInput {
    /// All particles of the frame.
    InMemory(ParticleCloud),
    /// The particles in a file whose records can be read one by one.
    OnDisk(Box<FileParticles>),
    /// A level set instead of particles.
    LevelSet(Box<LevelSetInput>),
}

/// A level set that was read.
#[derive(Debug)]
pub(crate) struct LevelSetInput {
    pub(crate) band: NarrowBand,
    /// The position of its voxel (0, 0, 0), world units.
    pub(crate) origin: DVec3,
    /// By how much smoothing may move its surface, in voxels.
    pub(crate) max_deviation_voxels: f32,
}

impl LevelSetInput {
    pub(crate) fn new(file: LevelSetFile, job: &Job) -> LevelSetInput {
        LevelSetInput {
            origin: file.origin(),
            max_deviation_voxels: job.max_deviation_voxels() as f32,
            band: file.into_band(),
        }
    }
}

/// Reads the level set in the bytes of a frame's file, within a memory limit. Returns the level set, and the
/// frame with the voxel size and the origin of the file.
///
/// # Errors
/// When the file has no readable level set, or its surface cannot be made with the settings or written in a
/// format of the frame.
pub(crate) fn read_level_set(
    frame: &Frame,
    bytes: &[u8],
    memory_bytes: u64,
) -> Result<(Frame, LevelSetFile), FrameError> {
    let file =
        LevelSetFile::of_bytes(&frame.input, bytes, false, memory_bytes).map_err(|error| {
            match error.cause {
                Cause::File(Error::MemoryLimit { .. }) => {
                    too_large(frame, bytes, memory_bytes).unwrap_or(error)
                }
                _ => error,
            }
        })?;
    let refused =
        |what: String| FrameError::file(&frame.input, Stage::Read, Error::unsupported("OpenVDB", what));
    file.require_level_set().map_err(refused)?;
    let settings = frame.settings.with_voxel_size(file.voxel_size()).map_err(|error| FrameError {
        path: frame.input.clone(),
        during: Stage::Read,
        cause: Cause::Settings(error),
    })?;
    if frame.outputs.formats.contains(&OutputFormat::Vdb) && file.origin() != DVec3::ZERO {
        let [x, y, z] = file.origin().to_array();
        return Err(refused(format!(
            "its grid transform has the translation ({x}, {y}, {z}), which meniscus cannot write to .vdb: leave vdb out of --format"
        )));
    }
    let job = Job::LevelSet { max_deviation_voxels: frame.job.max_deviation_voxels(), origin: file.origin() };
    Ok((Frame { settings: settings.into(), job, ..frame.clone() }, file))
}

/// The error of a level set that exceeds the memory limit, with the memory for all stages and not only for
/// reading it: the user should have to raise the limit only once. `None` for other level sets.
fn too_large(frame: &Frame, bytes: &[u8], memory_bytes: u64) -> Option<FrameError> {
    let limits = Limits::within(memory_bytes);
    let outline = vdb::level_set_outline(bytes, None, &limits).ok()?;
    let voxel_size = voxel_size(&outline.transform)?;
    let settings = frame.settings.with_voxel_size(voxel_size).ok()?;
    let half_width = (f64::from(outline.background) / voxel_size) as f32;
    let origins: Vec<IVec3> = outline.origins.iter().copied().map(IVec3::from).collect();
    if !origins.iter().all(is_leaf_origin) {
        return None;
    }
    let deviation = frame.job.max_deviation_voxels() as f32;
    let needed_bytes = smooth_level_set_bytes_max(&origins, half_width, deviation, &settings);
    let error = outline.check_memory(bytes.len() as u64, needed_bytes, &limits).err()?;
    Some(FrameError::file(&frame.input, Stage::Read, error))
}

/// The particles in a file.
#[derive(Debug)]
pub(crate) struct FileParticles {
    file: Arc<InputFile>,
    batches: ParticleBatches<Arc<InputFile>>,
    /// The condition that particles must meet, and how many particles of each batch do.
    chosen: Option<(ParticleFilter, Vec<usize>)>,
}

/// The number of bytes per batch: some ten thousand particles.
const BATCH_BYTES: usize = 512 << 10;

/// Kinds and radii of particles are looked for in this many batches at most.
const SAMPLED_BATCHES: usize = 16;

impl FileParticles {
    /// The particles in an open file; `None` if the file has to be read whole.
    ///
    /// # Errors
    /// Those of the format's reader.
    pub(crate) fn open(path: &Path, file: InputFile) -> meniscus_formats::Result<Option<FileParticles>> {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let file = Arc::new(file);
        let batches = ParticleBatches::open(Arc::clone(&file), &name, &reading_limits(), BATCH_BYTES)?;
        Ok(batches.map(|batches| FileParticles { file, batches, chosen: None }))
    }

    /// Those of the particles that meet the condition. Reads the file once.
    ///
    /// # Errors
    /// When the file cannot be read, or the condition does not suit its attributes.
    pub(crate) fn chosen_by(self, filter: Option<&ParticleFilter>) -> Result<FileParticles, Cause> {
        let Some(filter) = filter else { return Ok(self) };
        let count = |index: usize| Ok(self.chosen_of(index, filter)?.len());
        // The batch after the last one is empty: it has the errors of the condition also if there are none.
        let counts: Result<Vec<usize>, Cause> =
            (0..=self.batches.batch_count()).into_par_iter().map(count).collect();
        Ok(FileParticles { chosen: Some((filter.clone(), counts?)), ..self })
    }

    /// The particles of a batch that meet the condition.
    fn chosen_of(&self, index: usize, filter: &ParticleFilter) -> Result<FilePositions, Cause> {
        let mut frame = self.batches.read_frame(index).map_err(|error| self.cause(error))?;
        keep_chosen(&mut frame, Some(filter)).map_err(Cause::Missing)?;
        Ok(frame.positions)
    }

    /// The number of particles.
    fn len(&self) -> usize {
        match &self.chosen {
            Some((_, counts)) => counts.iter().sum(),
            None => self.batches.particle_count(),
        }
    }

    fn batch_len(&self, index: usize) -> usize {
        match &self.chosen {
            Some((_, counts)) => counts.get(index).copied().unwrap_or_default(),
            None => self.batches.particle_range(index).len(),
        }
    }

    fn batch(&self, index: usize) -> Result<FilePositions, Cause> {
        let Some((filter, counts)) = &self.chosen else {
            let mut batch = ParticleBatch::default();
            self.batches.read_batch(index, &mut batch).map_err(|error| self.cause(error))?;
            return Ok(batch.positions);
        };
        let positions = self.chosen_of(index, filter)?;
        // The callers rely on the number.
        if counts.get(index) == Some(&positions.len()) { Ok(positions) } else { Err(Cause::Changed) }
    }

    /// Warnings about the file.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub(crate) fn warnings(&self) -> Result<Vec<Warning>, Cause> {
        let parts = self.sampled()?;
        let attributes = || parts.iter().map(|part| &part.attributes[..]);
        let about_kinds = match &self.chosen {
            Some((filter, _)) => none_chosen(filter, self.batches.particle_count(), self.len()),
            None => several_kinds(attributes()),
        };
        let of_file = self.batches.notes().iter().cloned().map(Warning::new);
        let about_sizes = if self.chosen.is_none() { various_sizes(attributes()) } else { None };
        Ok(of_file.chain(about_kinds).chain(about_sizes).collect())
    }

    /// Some batches, evenly distributed.
    fn sampled(&self) -> Result<Vec<ParticleFrame>, Cause> {
        let batch_count = self.batches.batch_count();
        let sampled = (0..batch_count).step_by(batch_count.div_ceil(SAMPLED_BATCHES).max(1));
        sampled.map(|index| self.batches.read_frame(index).map_err(|error| self.cause(error))).collect()
    }

    /// The name of the velocities, which are not read.
    pub(crate) fn unused_velocity(&self) -> Option<String> {
        self.batches.velocity().map(str::to_owned)
    }
}

impl FrameInput {
    /// The number of particles.
    pub(crate) fn len(&self) -> usize {
        match self {
            FrameInput::InMemory(cloud) => cloud.positions.len(),
            FrameInput::OnDisk(file) => file.len(),
            FrameInput::LevelSet(_) => 0,
        }
    }

    /// Whether there are no particles.
    pub(crate) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The memory that the input takes while the frame waits for its next stage, in bytes.
    pub(crate) fn size_bytes(&self) -> u64 {
        match self {
            FrameInput::InMemory(cloud) => cloud.size_bytes() as u64,
            FrameInput::OnDisk(_) => 0,
            FrameInput::LevelSet(level_set) => (level_set.band.phi.leaves.len() * size_of::<Leaf>()) as u64,
        }
    }

    /// The size of the selected attributes, in bytes per particle.
    pub(crate) fn attribute_bytes(&self, settings: &Settings) -> f64 {
        let FrameInput::InMemory(cloud) = self else { return 0.0 };
        let selected = cloud.attributes.iter().filter(|attribute| settings.selects(attribute));
        let bytes: usize = selected.map(|attribute| attribute.values.size_bytes()).sum();
        bytes as f64 / cloud.positions.len().max(1) as f64
    }

    /// The file, if the particles are read from it in batches.
    pub(crate) fn file(&self) -> Option<Arc<InputFile>> {
        match self {
            FrameInput::InMemory(_) | FrameInput::LevelSet(_) => None,
            FrameInput::OnDisk(particles) => Some(Arc::clone(&particles.file)),
        }
    }
}

impl ParticleSource for FrameInput {
    type Error = Cause;

    fn batch_count(&self) -> usize {
        match self {
            FrameInput::InMemory(cloud) => cloud.batch_count(),
            FrameInput::OnDisk(file) => file.batches.batch_count(),
            FrameInput::LevelSet(_) => 0,
        }
    }

    fn batch(&self, index: usize) -> Result<particles::Positions<'_>, Cause> {
        match self {
            FrameInput::InMemory(cloud) => {
                let Ok(positions) = cloud.batch(index);
                Ok(positions)
            }
            FrameInput::OnDisk(file) => Ok(match file.batch(index)? {
                FilePositions::F32(positions) => particles::Positions::F32(Cow::Owned(positions)),
                FilePositions::F64(positions) => particles::Positions::F64(Cow::Owned(positions)),
            }),
            FrameInput::LevelSet(_) => Ok(particles::Positions::F32(Cow::Borrowed(&[]))),
        }
    }

    fn batch_len(&self, batch: usize) -> usize {
        match self {
            FrameInput::InMemory(cloud) => cloud.batch_len(batch),
            FrameInput::OnDisk(file) => file.batch_len(batch),
            FrameInput::LevelSet(_) => 0,
        }
    }

    fn has_shapes(&self) -> bool {
        match self {
            FrameInput::InMemory(cloud) => cloud.has_shapes(),
            FrameInput::OnDisk(_) | FrameInput::LevelSet(_) => false,
        }
    }

    fn batch_shapes(&self, batch: usize) -> Shapes {
        match self {
            FrameInput::InMemory(cloud) => cloud.batch_shapes(batch),
            FrameInput::OnDisk(_) | FrameInput::LevelSet(_) => Shapes::Uniform,
        }
    }
}

impl FileParticles {
    /// The cause of a read error. A file that was complete when it was opened and cannot be read now has
    /// usually changed.
    fn cause(&self, error: meniscus_formats::Error) -> Cause {
        let is_changed = |unchanged: io::Result<bool>| unchanged.is_ok_and(|unchanged| !unchanged);
        if is_changed(self.file.is_unchanged()) { Cause::Changed } else { Cause::File(error) }
    }
}
