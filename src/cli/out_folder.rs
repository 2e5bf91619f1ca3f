//! The folder of the results, made where it is missing.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

use crate::pipeline::{OutFolderError, make_out_folder, recover_out_folder, write_whole};

use super::console::print_error;

/// The folder that a file lies in, where it is made or found.
pub(super) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes a file that appears under its name when it is whole.
///
/// # Errors
/// When it cannot be written.
pub(super) fn write_file(path: &Path, content: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<()> {
    write_whole(path, |out| Ok(content(out)?)).with_context(|| format!("{}: cannot write", path.display()))
}

/// A folder that exists, and takes files. Whatever had to be made for it is removed again unless it is kept.
#[derive(Debug)]
pub(super) struct OutFolder {
    /// The innermost first.
    made: Vec<PathBuf>,
}

impl OutFolder {
    /// Makes a folder, and those that it lies in, and recovers what an interrupted command left in it.
    ///
    /// # Errors
    /// When it cannot be made, nothing can be written into it, or files cannot be put back.
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
        recover(folder)?;
        Ok(made)
    }

    /// Results will be written.
    pub(super) fn keep(mut self) {
        self.made.clear();
    }
}

/// Puts back what an interrupted command replaced in part, and prints a warning about each record that is left in place.
///
/// # Errors
/// When files cannot be put back.
pub(super) fn recover(folder: &Path) -> Result<(), OutFolderError> {
    for warning in recover_out_folder(folder)? {
        print_error(None, format_args!("warning: {warning}"));
    }
    Ok(())
}

impl Drop for OutFolder {
    fn drop(&mut self) {
        for folder in &self.made {
            // One that is no longer empty stays, rightly.
            let _ = fs::remove_dir(folder);
        }
    }
}
