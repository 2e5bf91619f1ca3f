//! Open containers: files with frames that are not ranges of their bytes, and that may name further files.
//!
//! ```text
//!   run.pvd            opened, and its stamp compared after the read
//!   run/water_0.vtu    named by it: opened when a frame is read, and compared in the same way
//! ```
//!
//! A frame depends on its particles only, so appended frames change no other. Compressed files are
//! decompressed into memory; others may be larger than memory.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::files::named_files::{NamedFiles, path_of_named, state_of_files};
use crate::pipeline::files::open::open_regular;
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::memory::reading_limits;
use meniscus_formats::compression::{decompressed, read_head};
use meniscus_formats::container::{self, ContainerFrames, is_container};
use meniscus_formats::{
    Codec, ContainerFile, Loaded, MeshData, Probe, ProbedKind, ReadAt, Result, Sample, probe,
};

/// Enough bytes to recognize the format.
const HEAD_BYTES: u64 = 8 << 10;

/// Whether a file is a container, by its first bytes; false for a file that cannot be opened, and for a pipe, whose
/// bytes can be read only once.
pub(crate) fn is_container_file(path: &Path) -> bool {
    let is_regular = path.metadata().is_ok_and(|metadata| metadata.is_file());
    let head = || open_regular(path).and_then(|file| read_head(file, HEAD_BYTES));
    is_regular && head().is_ok_and(|head| is_container(probe(&head, &name_of(path)).kind))
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// A frame of a container, and the state of the files that it is read from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ContainerFrame {
    pub(super) sample: Sample,
    /// A hash of the paths and the stamps of the files that it is read from; `None` if it is read from the container.
    pub(super) files: Option<u128>,
    /// Whether it is read from a single file beside the container, which could be given in its place.
    pub(super) is_file_beside: bool,
    /// An estimate of the size of its particles in bytes, rather too large.
    pub(super) size_bytes: u64,
}

/// An open container.
pub(super) struct OpenContainer {
    kind: ProbedKind,
    name: String,
    folder: PathBuf,
    file: Arc<InputFile>,
    /// The content, if the file is compressed.
    unpacked: Option<Arc<[u8]>>,
    /// The files that it names and that a reader wanted: `None` if they could not be opened.
    further: Mutex<Vec<(PathBuf, Option<Arc<InputFile>>)>>,
}

impl OpenContainer {
    /// Opens a file; `None` if it is not a container.
    ///
    /// # Errors
    /// When the file cannot be opened or decompressed.
    pub(super) fn open(path: &Path) -> Result<Option<OpenContainer>> {
        let file = Arc::new(InputFile::open(path)?);
        let name = name_of(path);
        let Probe { kind, .. } = probe(&head_of(&file)?, &name);
        if !file.is_regular() || !is_container(kind) {
            return Ok(None);
        }
        let unpacked = unpacked(&file)?;
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        Ok(Some(OpenContainer { kind, name, folder, file, unpacked, further: Mutex::default() }))
    }

    /// The stamp of the file when it was opened.
    pub(super) fn stamp(&self) -> FileStamp {
        self.file.stamp()
    }

    pub(super) fn kind(&self) -> ProbedKind {
        self.kind
    }

    /// The frames with particles, and their reader, whose own lists of samples and files are empty.
    ///
    /// # Errors
    /// When the structure of the file cannot be read, or it is a file without particles.
    pub(super) fn frames(&self) -> Result<(Vec<ContainerFrame>, ContainerFrames)> {
        let mut found = self.with(|file| container::frames(self.kind, file, &reading_limits()))?;
        let (samples, files) = (std::mem::take(&mut found.samples), found.files.take());
        let own_bytes = self.own_bytes().saturating_mul(SIZE_FACTOR) / samples.len().max(1) as u64;
        let frame = |(index, sample): (usize, Sample)| {
            let paths = files.as_ref().and_then(|files| files.get(index));
            let is_file_beside =
                paths.is_some_and(|paths: &Vec<String>| matches!(&paths[..], [path] if is_beside(path)));
            let files = paths.map(|paths| self.state_of(paths));
            let (files, bytes) = files.map_or((None, own_bytes), |(hash, bytes)| (Some(hash), bytes));
            // A compressed container is in memory whole.
            let unpacked_bytes = self.unpacked.as_ref().map_or(0, |bytes| bytes.len() as u64);
            ContainerFrame { sample, files, is_file_beside, size_bytes: bytes.saturating_add(unpacked_bytes) }
        };
        Ok((samples.into_iter().enumerate().map(frame).collect(), found))
    }

    /// The size of the content, which may be in memory.
    fn own_bytes(&self) -> u64 {
        self.unpacked.as_ref().map_or(self.stamp().size, |bytes| bytes.len() as u64)
    }

    /// A hash of the paths and stamps of files that the container names, and the memory for reading them.
    fn state_of(&self, paths: &[String]) -> (u128, u64) {
        let stamped = |path| (path, FileStamp::of_path(&self.folder.join(path)).ok());
        let files: Vec<(&str, Option<FileStamp>)> = paths.iter().map(|path| stamped(&**path)).collect();
        let sizes = files.iter().map(|(_, stamp)| stamp.map_or(0, |stamp| stamp.size));
        let bytes = sizes.fold(0, u64::saturating_add);
        // A hard link, such as that of a backup, changes no frame.
        let lasting =
            files.into_iter().map(|(path, stamp)| (path, stamp.map(|stamp| stamp.without_status_change())));
        (state_of_files(lasting), bytes.saturating_mul(SIZE_FACTOR))
    }

    /// The particles of a frame; `None` if one of the files was written, replaced or removed meanwhile.
    ///
    /// # Errors
    /// When the frame cannot be read.
    pub(super) fn read(&self, frames: &ContainerFrames, index: usize) -> Result<Option<Loaded>> {
        let read =
            self.with(|file| container::read_sample(self.kind, file, frames, index, &reading_limits()));
        if !self.is_unchanged()? {
            return Ok(None);
        }
        read.map(Some)
    }

    /// The files beside it that its readers wanted so far; `None` if there are none.
    pub(super) fn named_files(&self) -> Option<Arc<NamedFiles>> {
        let relative =
            |path: &Path| path.strip_prefix(&self.folder).unwrap_or(path).to_str().map(str::to_owned);
        let further = self.further_files().into_iter();
        let named = further.filter_map(|(path, stamp)| Some((relative(&path)?, stamp))).collect();
        NamedFiles::new(named).map(Arc::new)
    }

    /// Whether neither the file nor those that were opened since were written, replaced or removed.
    fn is_unchanged(&self) -> Result<bool> {
        for file in self.lock_further().iter().filter_map(|(_, file)| file.as_ref()).chain([&self.file]) {
            if !file.is_unchanged()? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Whether its meshes change with the time; `None` if it is no scene.
    ///
    /// # Errors
    /// When the structure cannot be read, or there are no meshes.
    pub(super) fn are_meshes_animated(&self) -> Result<Option<bool>> {
        self.with(|file| container::are_meshes_animated(self.kind, file, &reading_limits()))
    }

    /// The meshes of a scene in the frame with a number; `None` if one of the files was written meanwhile.
    ///
    /// # Errors
    /// When they cannot be read.
    pub(super) fn meshes(&self, number: Option<i64>) -> Result<Option<MeshData>> {
        let meshes = self.with(|file| container::scene_mesh(self.kind, file, number, &reading_limits()));
        if self.is_unchanged()? { meshes.map(Some) } else { Ok(None) }
    }

    /// The paths of the files beside it that its readers wanted, and the stamps of those that were opened.
    pub(super) fn further_files(&self) -> Vec<(PathBuf, Option<FileStamp>)> {
        let stamped = |(path, file): &(PathBuf, Option<Arc<InputFile>>)| {
            (path.clone(), file.as_ref().map(|file| file.stamp()))
        };
        self.lock_further().iter().map(stamped).collect()
    }

    /// Calls a function of the reader.
    fn with<T>(&self, work: impl FnOnce(&ContainerFile) -> Result<T>) -> Result<T> {
        let in_memory: Option<&dyn ReadAt> = self.unpacked.as_ref().map(|bytes| bytes as &dyn ReadAt);
        let open = |path: &str| self.open_further(path);
        work(&ContainerFile { file: in_memory.unwrap_or(&*self.file), name: &self.name, open: &open })
    }

    /// Opens a file that the container names, by its path relative to the folder.
    fn open_further(&self, path: &str) -> io::Result<Box<dyn ReadAt>> {
        let path = path_of_named(&self.folder, path)?;
        let file = InputFile::open(&path).map(Arc::new);
        self.lock_further().push((path, file.as_ref().ok().map(Arc::clone)));
        let file = file?;
        match unpacked(&file).map_err(io::Error::other)? {
            Some(bytes) => Ok(Box::new(bytes)),
            None => Ok(Box::new(file)),
        }
    }

    fn lock_further(&self) -> std::sync::MutexGuard<'_, Vec<(PathBuf, Option<Arc<InputFile>>)>> {
        self.further.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Whether a file is in the folder of the container that names it by this path.
fn is_beside(path: &str) -> bool {
    !path.contains('/')
}

/// The files beside a container that it joins to frames: they are no frames of their own.
pub fn files_joined_by(path: &Path) -> Vec<PathBuf> {
    let files = OpenContainer::open(path).and_then(|open| {
        let frames = open.map(|open| open.with(|file| container::frames(open.kind, file, &reading_limits())));
        Ok(frames.transpose()?.and_then(|frames| frames.files).unwrap_or_default())
    });
    let beside = files.unwrap_or_default().into_iter().flatten().filter(|path| is_beside(path));
    beside.map(|name| path.with_file_name(name)).collect()
}

/// Bytes of particles as a multiple of the bytes of files: compressed arrays are rarely smaller than a third.
const SIZE_FACTOR: u64 = 3;

fn head_of(file: &InputFile) -> io::Result<Vec<u8>> {
    let head = |bytes: u64| bytes_of(file, file.stamp().size.min(bytes));
    let bytes = head(HEAD_BYTES)?;
    match probe(&bytes, "").codec.map(Codec::first_block_bytes_max) {
        Some(needed) if needed > HEAD_BYTES => head(needed),
        _ => Ok(bytes),
    }
}

fn bytes_of(file: &InputFile, length: u64) -> io::Result<Vec<u8>> {
    let mut bytes = vec![0; usize::try_from(length).map_err(io::Error::other)?];
    file.read_exact_at(&mut bytes, 0)?;
    Ok(bytes)
}

/// The content of a compressed file; `None` for other files.
fn unpacked(file: &InputFile) -> Result<Option<Arc<[u8]>>> {
    if probe(&head_of(file)?, "").codec.is_none() {
        return Ok(None);
    }
    let bytes = bytes_of(file, file.stamp().size)?;
    Ok(Some(decompressed(&bytes, &reading_limits())?.into()))
}
