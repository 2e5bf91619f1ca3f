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

use std::fmt;
use std::io;
use std::sync::Arc;

use crate::core::batches::{ReadAt, read};
use crate::core::data::{MeshData, ParticleFrame};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::text::excerpt;

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

/// The frames of a container. They are found once.
#[derive(Clone, Debug)]
pub struct ContainerFrames {
    /// The frames with particles, in the order of the file.
    pub samples: Vec<Sample>,
    /// The files that each frame is read from, if these are other files than the container: their paths relative to its
    /// folder, with `/` between their parts. They may name further files themselves.
    pub files: Option<Vec<Vec<String>>>,
    reader: Arc<dyn ReadFrame>,
}

/// Reads the frames of a container, and may keep its structure.
pub(crate) trait ReadFrame: fmt::Debug + Send + Sync {
    /// Reads a frame by its index. The container is the one in which the frames were found, opened again.
    fn read(&self, container: &ContainerFile, index: usize, limits: &Limits) -> Result<ParticleFrame>;
}

/// A reader that knows nothing of the structure.
impl ReadFrame for fn(&ContainerFile, usize, &Limits) -> Result<ParticleFrame> {
    fn read(&self, container: &ContainerFile, index: usize, limits: &Limits) -> Result<ParticleFrame> {
        self(container, index, limits)
    }
}

impl ContainerFrames {
    pub(crate) fn new(samples: Vec<Sample>, reader: impl ReadFrame + 'static) -> ContainerFrames {
        ContainerFrames { samples, files: None, reader: Arc::new(reader) }
    }

    /// Reads a frame by its index in `samples`, from the container in which they were found.
    ///
    /// # Errors
    /// Those of the format's reader.
    pub fn read(&self, container: &ContainerFile, index: usize, limits: &Limits) -> Result<ParticleFrame> {
        self.reader.read(container, index, limits)
    }
}

/// How the frames of a container are read.
pub(crate) struct ContainerReader {
    /// Finds the frames. Reads structure, not particles.
    pub(crate) open: FindFrames,
    /// How the meshes are read, if files of this kind can have meshes, too.
    pub(crate) meshes: Option<SceneMeshReader>,
}

/// Finds the frames of a container.
pub(crate) type FindFrames = fn(&ContainerFile, &Limits) -> Result<ContainerFrames>;

/// How the meshes of a scene are read.
pub(crate) struct SceneMeshReader {
    /// Whether they change with the time.
    pub(crate) are_animated: fn(&ContainerFile, &Limits) -> Result<bool>,
    /// Reads all of them as they are in the frame with a number; the first samples without a number.
    pub(crate) read: fn(&ContainerFile, Option<i64>, &Limits) -> Result<MeshData>,
}

/// The frame with an index, among those of a file.
pub(crate) fn frame_at<'f, T>(format: &'static str, frames: &'f [T], index: usize) -> Result<&'f T> {
    frames.get(index).ok_or_else(|| {
        let what = format!("there is no frame {index}: the file has {}", frames.len());
        Error::invalid(format, Position::File, what)
    })
}

impl ContainerReader {
    pub(crate) const fn new(open: FindFrames) -> ContainerReader {
        ContainerReader { open, meshes: None }
    }

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
        let frames = (self.open)(&container, limits)?;
        let count = frames.samples.len();
        if count > 1 {
            let what = format!("the file has {count} frames, and one was expected");
            return Err(Error::unsupported(format, what));
        }
        frames.read(&container, 0, limits)
    }
}

impl ContainerFile<'_> {
    /// Opens a file that the container names. `path` is one that [`further_path`] returned, and `format` that
    /// of the file that names it.
    ///
    /// # Errors
    /// [`Error::Truncated`], which may be temporary, if there is no such file; [`Error::Io`] for other errors.
    /// All of them name the path.
    pub(crate) fn open_further(&self, format: &'static str, path: &str) -> Result<Box<dyn ReadAt>> {
        (self.open)(path).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => {
                let what = format!("the file {}, which it names, is missing", excerpt(path));
                Error::truncated(format, Position::File, what)
            }
            kind => Error::Io(io::Error::new(kind, format!("{}: {error}", excerpt(path)))),
        })
    }

    /// All bytes of a file that the container names: see [`open_further`](Self::open_further).
    pub(crate) fn read_further(&self, format: &'static str, path: &str) -> Result<Vec<u8>> {
        let file = self.open_further(format, path)?;
        let size = file.size_bytes()?;
        read(&*file, 0..size)
    }
}

/// The path of a file that a file in `folder` names, relative to the folder of the container. `folder` is
/// relative to the same folder, and empty for the container itself. Both `/` and `\` may stand between the
/// parts of `named`.
///
/// # Errors
/// [`Error::Unsupported`] for absolute paths and addresses, and for paths that lead out of the folder of the
/// container: a file from elsewhere should not make this program open other files.
pub(crate) fn further_path(format: &'static str, folder: &str, named: &str) -> Result<String> {
    let refuse = |why: &str| {
        let what = format!("it names the file \"{}\", {why}", excerpt(named));
        Err(Error::unsupported(format, what))
    };
    let is_separator = |letter| matches!(letter, '/' | '\\');
    if named.starts_with(is_separator) || named.contains(':') {
        return refuse("which is not a path relative to its own folder: save it with relative paths");
    }
    let mut parts: Vec<&str> = folder.split('/').filter(|part| !part.is_empty()).collect();
    for part in named.split(is_separator) {
        match part {
            "" | "." => {}
            ".." if parts.pop().is_none() => {
                return refuse("which is outside of its own folder: move the files into one folder");
            }
            ".." => {}
            part => parts.push(part),
        }
    }
    let is_folder = named.rsplit(is_separator).next().is_none_or(|last| ["", ".", ".."].contains(&last));
    if is_folder || named.contains('\0') {
        return refuse("which is not the path of a file");
    }
    Ok(parts.join("/"))
}

/// The folder of a path with `/` between its parts; empty if it has none.
pub(crate) fn folder_of(path: &str) -> &str {
    path.rsplit_once('/').map_or("", |(folder, _)| folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_stay_within_the_folder() {
        for (folder, named, expected) in [
            ("", "a.vtu", Some("a.vtu")),
            ("", "./sub/a.vtu", Some("sub/a.vtu")),
            ("", "sub\\a b.vtu", Some("sub/a b.vtu")),
            ("sub", "a.vtu", Some("sub/a.vtu")),
            ("sub/deep", "../a.vtu", Some("sub/a.vtu")),
            ("sub", "../../a.vtu", None),
            ("", "../a.vtu", None),
            ("", "sub/../../a.vtu", None),
            ("", "/etc/passwd", None),
            ("", "\\\\server\\a.vtu", None),
            ("", "C:\\a.vtu", None),
            ("", "http://a.org/a.vtu", None),
            ("", "", None),
            ("sub", ".", None),
            ("sub", "..", None),
            ("", "sub/", None),
            ("", "a\0.vtu", None),
        ] {
            let found = further_path("test", folder, named).ok();
            assert_eq!(found.as_deref(), expected, "{named} in {folder}");
        }
    }
}
