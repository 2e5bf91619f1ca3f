//! The files that a frame was read from besides its own: members of a list, data files, layers. They may change while
//! the file that names them stays as it is.

use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use twox_hash::xxhash3_128::Hasher;

use super::identity::real_path;
use super::json::hex;
use super::stamp::FileStamp;

/// The files that a frame was read from besides its own, and their state when it was read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NamedFiles {
    /// Relative to the folder of the file that names them, with `/` between the parts; sorted, each once.
    paths: Vec<String>,
    /// As of [`state_of_files`].
    #[serde(with = "hex")]
    state: u128,
}

impl NamedFiles {
    /// From the stamps of files when they were opened; `None` for a file that could not be. `None` without files.
    pub(crate) fn new(mut files: Vec<(String, Option<FileStamp>)>) -> Option<NamedFiles> {
        files.sort_by(|one, other| one.0.cmp(&other.0));
        files.dedup_by(|one, other| one.0 == other.0);
        let state = state_of_files(files.iter().map(|(path, stamp)| (&**path, *stamp)));
        let paths: Vec<String> = files.into_iter().map(|(path, _)| path).collect();
        (!paths.is_empty()).then_some(NamedFiles { paths, state })
    }

    /// Whether they are as they were; `file` is the one that names them.
    pub fn still_hold(&self, file: &Path) -> bool {
        let now = |path: &String| FileStamp::of_path(&file.with_file_name(path)).ok();
        state_of_files(self.paths.iter().map(|path| (&**path, now(path)))) == self.state
    }
}

/// The path of a file that another one, in `folder`, names by a path within this folder.
///
/// # Errors
/// `InvalidInput` if a link leads out of the folder: a file from elsewhere should not make this program open other files.
pub(crate) fn path_of_named(folder: &Path, named: &str) -> io::Result<PathBuf> {
    let path = folder.join(named);
    if real_path(&path).starts_with(real_path(&Path::new(".").join(folder))) {
        return Ok(path);
    }
    let what = "a link leads out of the folder of the file that names it: move the files into one folder";
    Err(io::Error::new(io::ErrorKind::InvalidInput, what))
}

/// A hash of the paths and the stamps of files: `None` for a file that is missing.
pub(crate) fn state_of_files<'a>(files: impl Iterator<Item = (&'a str, Option<FileStamp>)>) -> u128 {
    let mut hasher = Hasher::new();
    for (path, stamp) in files {
        hasher.write(path.as_bytes());
        hasher.write(format!("\0{stamp:?}\0").as_bytes());
    }
    hasher.finish_128()
}
