//! The folder of the results: made, and known to take files, before any frame is read.
//!
//! Without it every frame would be read and skinned, and fail when it is written.

use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::sweep::{SweepError, sweep_temporaries};
use super::temporary::Temporary;

/// Why a folder takes no results.
#[derive(Debug)]
pub enum OutFolderError {
    /// A file is in its place, or in that of a folder which it would lie in.
    File {
        /// The folder.
        folder: PathBuf,
        /// The file.
        file: PathBuf,
    },
    /// The system refuses to make it.
    Make {
        /// The folder.
        folder: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// It is there, and the system refuses to write into it.
    Write {
        /// The folder.
        folder: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// What an interrupted process left in it cannot be recovered.
    Recover {
        /// The folder.
        folder: PathBuf,
        /// Why.
        source: SweepError,
    },
}

/// Makes a folder, and those that it lies in, where they are missing, and sees that files can be written into it. A disk
/// that is too full to make it is an error.
///
/// # Errors
/// When it takes no results: what is wrong, and what was expected.
pub fn make_out_folder(folder: &Path) -> Result<(), OutFolderError> {
    refuse_file_for_folder(folder)?;
    made(folder, fs::create_dir_all(folder))
}

/// What comes of a folder that was tried to be made, with this result.
fn made(folder: &Path, result: io::Result<()>) -> Result<(), OutFolderError> {
    match result {
        // Not every system says of one that is there that it is.
        Err(source) if !folder.is_dir() => Err(OutFolderError::Make { folder: folder.to_owned(), source }),
        _ => check_out_folder(folder),
    }
}

/// Refuses what cannot be a folder, for a file is in its place, or in that of one which it would lie in. Nothing is made.
///
/// # Errors
/// Which file.
pub fn refuse_file_for_folder(folder: &Path) -> Result<(), OutFolderError> {
    let file = folder.ancestors().find(|part| part.metadata().is_ok_and(|there| !there.is_dir()));
    match file {
        Some(file) => Err(OutFolderError::File { folder: folder.to_owned(), file: file.to_owned() }),
        None => Ok(()),
    }
}

/// Sees that files can be written into a folder that is there, as [`make_out_folder`] does. A full disk is no error here:
/// there may be room in time.
///
/// # Errors
/// When they cannot.
pub fn check_out_folder(folder: &Path) -> Result<(), OutFolderError> {
    // As outputs are begun: rights alone do not say whether that can be.
    match Temporary::create(&folder.join(TRIED)) {
        Err(source) if !is_disk_full(&source) => {
            Err(OutFolderError::Write { folder: folder.to_owned(), source })
        }
        _ => Ok(()),
    }
}

/// Removes what a killed process left half written in a folder, and puts back the files that it replaced in part. Returns
/// warnings about what it left in place.
///
/// # Errors
/// When they cannot be put back.
pub fn recover_out_folder(folder: &Path) -> Result<Vec<String>, OutFolderError> {
    let shown = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    match sweep_temporaries(shown) {
        // A folder that may be written into and not be listed has nothing that could be found.
        Err(SweepError::Folder(source)) if source.kind() == io::ErrorKind::PermissionDenied => Ok(Vec::new()),
        swept => swept
            .map(|swept| swept.warnings)
            .map_err(|source| OutFolderError::Recover { folder: folder.to_owned(), source }),
    }
}

/// A file that is never there under this name.
const TRIED: &str = "tried";

/// Whether the disk, or what its owner may use of it, is full: it will go better once there is room.
pub fn is_disk_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}

impl fmt::Display for OutFolderError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (OutFolderError::File { folder, .. }
        | OutFolderError::Make { folder, .. }
        | OutFolderError::Write { folder, .. }
        | OutFolderError::Recover { folder, .. }) = self;
        match self {
            OutFolderError::Recover { source: SweepError::Folder(source), .. } => {
                return write!(f, "{}: cannot look for interrupted conversions: {source}", folder.display());
            }
            // It names the record.
            OutFolderError::Recover { source, .. } => return source.fmt(f),
            _ => {}
        }
        write!(f, "{}: expected a folder for the results, and ", folder.display())?;
        match self {
            OutFolderError::File { folder, file } if folder == file => f.write_str("this is a file"),
            OutFolderError::File { file, .. } => write!(f, "it cannot be made: {} is a file", file.display()),
            OutFolderError::Make { source, .. } => write!(f, "it cannot be made: {source}"),
            OutFolderError::Write { source, .. } => write!(f, "nothing can be written into it: {source}"),
            OutFolderError::Recover { source, .. } => source.fmt(f),
        }
    }
}

impl std::error::Error for OutFolderError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            OutFolderError::File { .. } => None,
            OutFolderError::Make { source, .. } | OutFolderError::Write { source, .. } => Some(source),
            OutFolderError::Recover { source, .. } => Some(source),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_takes_no_results_is_told_with_what_was_expected() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("file");
        fs::write(&file, "").expect("written");
        make_out_folder(&folder.path().join("a/b")).expect("made");
        check_out_folder(&folder.path().join("a/b")).expect("there");
        for (place, words) in [
            (file.clone(), "file: expected a folder for the results, and this is a file"),
            (file.join("deep"), "deep: expected a folder for the results, and it cannot be made: "),
        ] {
            let error = make_out_folder(&place).expect_err("a file is in the way");
            assert!(matches!(&error, OutFolderError::File { file: named, .. } if *named == file), "{error}");
            assert!(error.to_string().contains(words), "{error}");
        }
    }

    /// A daemon recovers only after it has locked the folder.
    #[test]
    fn making_a_folder_does_not_recover_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let left = folder.path().join(".a.glb.tmp-0123456789abcdef");
        fs::write(&left, "half a fra").expect("written");
        make_out_folder(folder.path()).expect("there");
        assert!(left.exists());
        // Another thread of this process may be starting a child, which holds the lock for a moment.
        while left.exists() {
            recover_out_folder(folder.path()).expect("readable");
        }
    }

    #[test]
    fn a_folder_that_a_full_disk_has_no_room_for_cannot_be_made() {
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
    fn folders_that_take_no_files_are_told() {
        // Nobody may make anything there, not even root.
        let error = make_out_folder(Path::new("/proc")).expect_err("no file can be made there");
        assert!(matches!(&error, OutFolderError::Write { .. }), "{error}");
        let error = make_out_folder(Path::new("/proc/deep/down")).expect_err("no folder can be made there");
        assert!(matches!(&error, OutFolderError::Make { .. }), "{error}");
    }
}
