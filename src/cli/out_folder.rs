//! The folder of the results, made where it is missing.

use std::fs;
use std::path::{Path, PathBuf};

use crate::pipeline::{OutFolderError, make_out_folder};

/// A folder that exists, and takes files. Whatever had to be made for it is removed again unless it is kept.
#[derive(Debug)]
pub(super) struct OutFolder {
    /// The innermost first.
    made: Vec<PathBuf>,
}

impl OutFolder {
    /// Makes a folder, and those that it lies in.
    ///
    /// # Errors
    /// When it cannot be made, or nothing can be written into it.
    pub(super) fn make(folder: &Path) -> Result<OutFolder, OutFolderError> {
        // No name at all is where one is.
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let missing = folder
            .ancestors()
            .take_while(|part| !part.as_os_str().is_empty() && part.symlink_metadata().is_err())
            // What ends in `..` is there already, by another name.
            .filter(|part| part.file_name().is_some());
        let made = OutFolder { made: missing.map(Path::to_owned).collect() };
        make_out_folder(folder)?;
        Ok(made)
    }

    /// Results will be written.
    pub(super) fn keep(mut self) {
        self.made.clear();
    }
}

impl Drop for OutFolder {
    fn drop(&mut self) {
        for folder in &self.made {
            // One that is no longer empty stays, rightly.
            let _ = fs::remove_dir(folder);
        }
    }
}
