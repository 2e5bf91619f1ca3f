//! Files whose frames are not ranges of bytes: the samples of an animated scene, the groups of a hierarchical
//! data file, and indices that name the files of each time.
//!
//! ```text
//!   scene.usdc ─┬─ sample 0 (time 1)     run.pvd ─┬─ 0.00 s: water_0.vtu, water_1.vtu
//!               ├─ sample 1 (time 2)              ├─ 0.01 s: ..
//!               └─ ..                             └─ ..
//! ```
//!
//! A reader looks at the structure of the file, and then only at the arrays of the sample that is read, so a
//! file can be larger than memory. It may open files beside its own.

use std::io;

use crate::batches::ReadAt;
use crate::data::ParticleFrame;
use crate::error::{Error, Result};
use crate::limits::Limits;

/// A frame of a container, before its particles are read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// The number of the step that the file states or, if it states none, the index of the sample, from 0.
    pub number: i64,
    /// The time in seconds, if the file states one.
    pub time: Option<f64>,
}

/// An open container, and access to the files that it names.
#[derive(Clone, Copy)]
pub struct ContainerFile<'a> {
    /// The bytes of the file, decompressed.
    pub file: &'a dyn ReadAt,
    /// The name of the file, for errors that name one of several files.
    pub name: &'a str,
    /// Opens a file by the path that the container states, relative to its folder.
    pub open: &'a OpenFurther<'a>,
}

/// Opens a file by its path relative to the folder of the file that names it. The path has `/` between its
/// parts. The bytes are decompressed.
pub type OpenFurther<'a> = dyn Fn(&str) -> io::Result<Box<dyn ReadAt>> + 'a;

/// How the frames of a container are read.
pub(crate) struct ContainerReader {
    /// The frames with particles, in the order of the file. Reads structure, not particles.
    pub(crate) samples: fn(&ContainerFile, &Limits) -> Result<Vec<Sample>>,
    /// Reads a frame by its index in `samples`.
    pub(crate) read: fn(&ContainerFile, usize, &Limits) -> Result<ParticleFrame>,
}

impl ContainerReader {
    /// Reads the only frame of a container in memory that names no other file.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if it has several frames or names other files; otherwise those of the reader.
    pub(crate) fn read_alone(
        &self,
        format: &'static str,
        bytes: &[u8],
        limits: &Limits,
    ) -> Result<ParticleFrame> {
        let open: &OpenFurther =
            &|path| Err(io::Error::new(io::ErrorKind::Unsupported, format!("no access to the file {path}")));
        let container = ContainerFile { file: &bytes, name: "", open };
        let count = (self.samples)(&container, limits)?.len();
        if count > 1 {
            let what = format!("the file has {count} frames, and one was expected");
            return Err(Error::unsupported(format, what));
        }
        (self.read)(&container, 0, limits)
    }
}
