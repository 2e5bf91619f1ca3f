//! The particles of a frame: in memory, or in the file that they are read from again and again.

use std::borrow::Cow;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use meniscus_formats::{Limits, ParticleBatch, ParticleBatches, Positions};

use crate::surface::particles::{self, Cloud, ParticleSource, Shapes};

use crate::surface::options::Settings;
use crate::surface::report::Shaping;
use crate::surface::skin::{self, ShapedSource};

use super::frame::Cause;
use super::reading::InputFile;

/// The particles of a frame.
#[derive(Debug)]
pub enum FrameParticles {
    /// All of them.
    InMemory(Cloud),
    /// Those in a file whose records can be read one by one.
    OnDisk(Box<FileParticles>),
}

/// The particles in a file.
#[derive(Debug)]
pub struct FileParticles {
    file: Arc<InputFile>,
    batches: ParticleBatches<Arc<InputFile>>,
}

/// Bytes of a file that are read at a time: some ten thousand particles.
const BATCH_BYTES: usize = 512 << 10;

impl FileParticles {
    /// The particles in an open file; `None` where it has to be read whole.
    ///
    /// # Errors
    /// Those of the format's reader.
    pub(super) fn open(path: &Path, file: InputFile) -> meniscus_formats::Result<Option<FileParticles>> {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let file = Arc::new(file);
        let batches = ParticleBatches::open(Arc::clone(&file), &name, &Limits::default(), BATCH_BYTES)?;
        Ok(batches.map(|batches| FileParticles { file, batches }))
    }

    /// What a user should know of the file.
    pub(super) fn notes(&self) -> Vec<String> {
        self.batches.notes().to_vec()
    }

    /// The name of the velocities, which are not read.
    pub(super) fn unused_velocity(&self) -> Option<String> {
        self.batches.velocity().map(str::to_owned)
    }
}

impl FrameParticles {
    /// The number of particles.
    pub fn len(&self) -> usize {
        match self {
            FrameParticles::InMemory(cloud) => cloud.positions.len(),
            FrameParticles::OnDisk(file) => file.batches.particle_count(),
        }
    }

    /// Whether there is no particle.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Memory that is taken while they wait, in bytes.
    pub(super) fn size_bytes(&self) -> u64 {
        match self {
            FrameParticles::InMemory(cloud) => cloud.size_bytes() as u64,
            FrameParticles::OnDisk(_) => 0,
        }
    }

    /// Bytes of those attributes of a particle that its surface is to have.
    pub(super) fn attribute_bytes(&self, settings: &Settings) -> f64 {
        let (FrameParticles::InMemory(cloud), Some(selection)) = (self, &settings.attributes) else {
            return 0.0;
        };
        let selected = cloud.attributes.iter().filter(|attribute| selection.selects(attribute));
        let bytes: usize = selected.map(|attribute| attribute.values.size_bytes()).sum();
        bytes as f64 / cloud.positions.len().max(1) as f64
    }

    /// The same particles where and as the settings ask for them.
    ///
    /// # Errors
    /// When they are on disk and cannot be read.
    pub fn shaped(self, settings: &Settings) -> Result<(ShapedSource<FrameParticles>, Shaping), Cause> {
        let started = Instant::now();
        let (particles, shaping) = self.shaped_by_attributes(settings);
        let (shaped, mut shaping) = skin::shape_by_neighbors(particles, shaping, settings)?;
        if settings.has_shapes() || settings.uses_neighbors() {
            shaping.seconds = started.elapsed().as_secs_f64();
        }
        Ok((shaped, shaping))
    }

    fn shaped_by_attributes(self, settings: &Settings) -> (FrameParticles, Shaping) {
        match self {
            FrameParticles::InMemory(cloud) => {
                let (cloud, shaping) = skin::shape_by_attributes(cloud, settings);
                (FrameParticles::InMemory(cloud), shaping)
            }
            // What needs attributes is never read in batches.
            FrameParticles::OnDisk(_) => (self, Shaping::default()),
        }
    }

    /// Fails if the file was written meanwhile. To be asked after the last batch.
    ///
    /// # Errors
    /// [`Cause::Changed`], or the system's refusal.
    pub fn check_unchanged(&self) -> Result<(), Cause> {
        match self {
            FrameParticles::InMemory(_) => Ok(()),
            FrameParticles::OnDisk(file) => match file.file.is_unchanged() {
                Ok(true) => Ok(()),
                Ok(false) => Err(Cause::Changed),
                Err(error) => Err(Cause::File(error.into())),
            },
        }
    }
}

impl ParticleSource for FrameParticles {
    type Error = Cause;

    fn batch_count(&self) -> usize {
        match self {
            FrameParticles::InMemory(cloud) => cloud.batch_count(),
            FrameParticles::OnDisk(file) => file.batches.batch_count(),
        }
    }

    fn batch(&self, index: usize) -> Result<particles::Positions<'_>, Cause> {
        match self {
            FrameParticles::InMemory(cloud) => {
                let Ok(positions) = cloud.batch(index);
                Ok(positions)
            }
            FrameParticles::OnDisk(file) => {
                let mut batch = ParticleBatch::default();
                file.batches.read_batch(index, &mut batch).map_err(|error| file.cause(error))?;
                Ok(match batch.positions {
                    Positions::F32(positions) => particles::Positions::F32(Cow::Owned(positions)),
                    Positions::F64(positions) => particles::Positions::F64(Cow::Owned(positions)),
                })
            }
        }
    }

    fn count_of(&self, batch: usize) -> usize {
        match self {
            FrameParticles::InMemory(cloud) => cloud.count_of(batch),
            FrameParticles::OnDisk(file) => file.batches.particles_of(batch).len(),
        }
    }

    fn has_shapes(&self) -> bool {
        match self {
            FrameParticles::InMemory(cloud) => cloud.has_shapes(),
            FrameParticles::OnDisk(_) => false,
        }
    }

    fn shapes_of(&self, batch: usize) -> Shapes {
        match self {
            FrameParticles::InMemory(cloud) => cloud.shapes_of(batch),
            FrameParticles::OnDisk(_) => Shapes::Balls,
        }
    }
}

impl FileParticles {
    /// A file that was whole when it was opened, and cannot be read now, was changed, as a rule.
    fn cause(&self, error: meniscus_formats::Error) -> Cause {
        let is_changed = |unchanged: io::Result<bool>| unchanged.is_ok_and(|unchanged| !unchanged);
        if is_changed(self.file.is_unchanged()) { Cause::Changed } else { Cause::File(error) }
    }
}
