//! The results folder: created, and checked for write access, before any frame is read.
//!
//! Without this check, every frame would be read and reconstructed, and would fail only when it is written.

use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::temporary::Temporary;

/// Why a folder cannot take results.
#[derive(Debug)]
pub enum OutFolderError {
    /// A file has the path of the folder, or of one of its parent folders.
    File {
        /// The folder.
        folder: PathBuf,
        /// The file.
        file: PathBuf,
    },
    /// The folder cannot be created.
    Make {
        /// The folder.
        folder: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The folder exists, but is not writable.
    Write {
        /// The folder.
        folder: PathBuf,
        /// Why.
        source: io::Error,
    },
}

/// Creates a folder with its parents if they are missing, and checks that files can be written into it. Fails
/// if the disk is too full to create it.
///
/// # Errors
/// When it cannot take results.
pub fn make_out_folder(folder: &Path) -> Result<(), OutFolderError> {
    refuse_file_for_folder(folder)?;
    made(folder, fs::create_dir_all(folder))
}

/// Interprets the result of an attempt to create a folder.
fn made(folder: &Path, result: io::Result<()>) -> Result<(), OutFolderError> {
    match result {
        // Some systems report an existing folder by another error than `AlreadyExists`. So only a missing
        // folder is an error.
        Err(source) if !folder.is_dir() => Err(OutFolderError::Make { folder: folder.to_owned(), source }),
        _ => check_out_folder(folder),
    }
}

/// Refuses a path that cannot become a folder because it or one of its parents is a file. Creates nothing.
///
/// # Errors
/// [`OutFolderError::File`], which names the file, if the path or one of its parents is one.
pub fn refuse_file_for_folder(folder: &Path) -> Result<(), OutFolderError> {
    let file = folder.ancestors().find(|part| part.metadata().is_ok_and(|metadata| !metadata.is_dir()));
    match file {
        Some(file) => Err(OutFolderError::File { folder: folder.to_owned(), file: file.to_owned() }),
        None => Ok(()),
    }
}

/// Checks that files can be written into an existing folder, as [`make_out_folder`] does. A full disk is not
/// an error here: space may become free before the first output is written.
///
/// # Errors
/// When no file can be written, for another reason than a full disk.
pub fn check_out_folder(folder: &Path) -> Result<(), OutFolderError> {
    // Creates a file in the same way as for an output, because permissions alone do not show whether that
    // works.
    match Temporary::create(&folder.join(TRIED)) {
        Err(source) if !is_disk_full(&source) => {
            Err(OutFolderError::Write { folder: folder.to_owned(), source })
        }
        _ => Ok(()),
    }
}

/// [`check_out_folder`] tests a folder with a temporary file whose name is formed from this one. That file is
/// removed and never renamed, so no file ever has exactly this name.
const TRIED: &str = "tried";

/// Whether the disk or a quota is full: the operation can succeed once there is space.
pub fn is_disk_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}

impl fmt::Display for OutFolderError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (OutFolderError::File { folder, .. }
        | OutFolderError::Make { folder, .. }
        | OutFolderError::Write { folder, .. }) = self;
        write!(f, "{}: expected a folder for the results, but ", folder.display())?;
        match self {
            OutFolderError::File { folder, file } if folder == file => f.write_str("this is a file"),
            OutFolderError::File { file, .. } => {
                write!(f, "it cannot be created: {} is a file", file.display())
            }
            OutFolderError::Make { source, .. } => write!(f, "it cannot be created: {source}"),
            OutFolderError::Write { source, .. } => write!(f, "nothing can be written into it: {source}"),
        }
    }
}

impl std::error::Error for OutFolderError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            OutFolderError::File { .. } => None,
            OutFolderError::Make { source, .. } | OutFolderError::Write { source, .. } => Some(source),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unusable_folder_is_an_error_that_says_why() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("file");
        fs::write(&file, "").expect("written");
        make_out_folder(&folder.path().join("a/b")).expect("made");
        check_out_folder(&folder.path().join("a/b")).expect("there");
        for (target, words) in [
            (file.clone(), "file: expected a folder for the results, but this is a file"),
            (file.join("deep"), "deep: expected a folder for the results, but it cannot be created: "),
        ] {
            let error = make_out_folder(&target).expect_err("the path is a file");
            assert!(matches!(&error, OutFolderError::File { file: named, .. } if *named == file), "{error}");
            assert!(error.to_string().contains(words), "{error}");
        }
    }

    #[test]
    fn folder_cannot_be_created_on_a_full_disk() {
        let folder = tempfile::tempdir().expect("a folder");
        let full = || Err(io::ErrorKind::StorageFull.into());
        let error = made(&folder.path().join("deep"), full()).expect_err("it is not there");
        assert!(is_made_of(&error, io::ErrorKind::StorageFull), "{error}");
        made(folder.path(), full()).expect("it is there, and takes files");
    }

    fn is_made_of(error: &OutFolderError, kind: io::ErrorKind) -> bool {
        matches!(error, OutFolderError::Make { source, .. } if source.kind() == kind)
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn folder_without_write_access_is_refused() {
        // No account can create anything in /proc, not even root.
        let error = make_out_folder(Path::new("/proc")).expect_err("no file can be made there");
        assert!(matches!(&error, OutFolderError::Write { .. }), "{error}");
        let error = make_out_folder(Path::new("/proc/deep/down")).expect_err("no folder can be made there");
        assert!(matches!(&error, OutFolderError::Make { .. }), "{error}");
    }
}
