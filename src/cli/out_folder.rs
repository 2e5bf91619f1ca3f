//! The output folder, created if missing.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

use crate::pipeline::{OutFolderError, make_out_folder, sweep_temporaries, write_atomically};

/// The folder that contains a file.
pub(super) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes a file that appears under its name only when it is complete.
///
/// # Errors
/// If it cannot be written.
pub(super) fn write_file(path: &Path, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<()> {
    write_atomically(path, |out| Ok(content(out)?))
        .with_context(|| format!("{}: cannot write", path.display()))
}

/// An existing, writable folder. If [`keep`](OutFolder::keep) is not called, the folders that were created
/// for it are removed again when it is dropped, as far as they are empty.
#[derive(Debug)]
pub(super) struct OutFolder {
    /// The created folders, the innermost first.
    made: Vec<PathBuf>,
}

impl OutFolder {
    /// Creates a folder and its parents, and removes the temporary files of killed processes in it.
    ///
    /// # Errors
    /// If it cannot be created, or is not writable.
    pub(super) fn make(folder: &Path) -> Result<OutFolder, OutFolderError> {
        // An empty path is the current folder.
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let missing = folder
            .ancestors()
            .take_while(|part| !part.as_os_str().is_empty() && part.symlink_metadata().is_err())
            // A path that ends in `..` is another name of a folder further up.
            .filter(|part| part.file_name().is_some());
        let made = OutFolder { made: missing.map(Path::to_owned).collect() };
        make_out_folder(folder)?;
        // If the folder cannot be listed, the temporary files of killed processes stay.
        let _ = sweep_temporaries(folder);
        Ok(made)
    }

    /// Keeps the folder, because results will be written.
    pub(super) fn keep(mut self) {
        self.made.clear();
    }
}

impl Drop for OutFolder {
    fn drop(&mut self) {
        for folder in &self.made {
            // Removing fails if the folder is no longer empty, and then it stays.
            let _ = fs::remove_dir(folder);
        }
    }
}
