//! Files that are whole and on the disk, and do not have their names yet.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use super::stamp::FileStamp;
use super::temporary::Temporary;

/// Large enough that the system call does not matter beside the copy.
pub(crate) const BUFFER_BYTES: usize = 1 << 18;

/// Writes a temporary file beside `path`, until all of it is on the disk. Returns what `write` returns, too.
///
/// # Errors
/// What `write` returns, or what the system refuses. Nothing is left behind then.
pub(crate) fn write_temporary<T, E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&File>) -> Result<T, E>,
) -> Result<(Temporary, T), E> {
    let temporary = Temporary::create(path)?;
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, temporary.file());
    let written = write(&mut out)?;
    out.flush()?;
    drop(out);
    // Else a crash of the machine could leave the name without the bytes.
    temporary.file().sync_all()?;
    Ok((temporary, written))
}

/// A file that is whole and on the disk, and not yet to be seen under its name. It is removed unless it is
/// published.
pub(crate) struct StagedFile {
    temporary: Temporary,
    path: PathBuf,
    stamp: FileStamp,
}

impl StagedFile {
    /// Writes what is to appear at `path`.
    ///
    /// # Errors
    /// What `write` returns, or what the system refuses. Nothing is left behind then.
    pub(crate) fn write<E: From<io::Error>>(
        path: &Path,
        write: impl FnOnce(&mut BufWriter<&File>) -> Result<(), E>,
    ) -> Result<StagedFile, E> {
        let (temporary, ()) = write_temporary(path, write)?;
        let stamp = FileStamp::of(&temporary.file().metadata()?);
        Ok(StagedFile { temporary, path: path.to_owned(), stamp })
    }

    /// The size of the file.
    pub(crate) fn size_bytes(&self) -> u64 {
        self.stamp.size
    }

    /// What the file system says of the file.
    pub(crate) fn stamp(&self) -> FileStamp {
        self.stamp
    }

    /// Where it is to appear.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Where it is until then.
    pub(crate) fn written_path(&self) -> &Path {
        self.temporary.path()
    }
}

/// Puts the names in a folder on the disk, where the system can do such a thing. Where it cannot, or
/// fails, a crash of the machine may cost names that are there already; it never shows half a file.
pub(crate) fn sync_folder(folder: &Path) {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let _ = File::open(folder).and_then(|folder| folder.sync_all());
}
