//! Cleans up after killed processes: removes their temporary files.

use std::fs;
use std::io;
use std::path::Path;

use super::temporary::{
    is_temporary_name, left_behind_count, lock_abandoned, record_left_behind, remove_if_exists,
    take_left_behind, temporary_name,
};

/// Retries the removal of files that could not be removed before. Returns the number of remaining files.
pub fn remove_left_behind() -> usize {
    // The list is not locked meanwhile, because the disk may be slow.
    for path in take_left_behind() {
        if remove_if_exists(&path).is_err() {
            record_left_behind(path);
        }
    }
    left_behind_count()
}

/// Removes the abandoned temporary files in a folder, whichever process or machine created them. On a file
/// system without locks, a file counts as abandoned if it was not written for a day. Leaves files that it may
/// not remove. Returns the number of removed files.
///
/// # Errors
/// When the folder cannot be read.
pub fn sweep_temporaries(folder: &Path) -> io::Result<usize> {
    sweep_names(folder, is_temporary_name)
}

/// Removes the abandoned temporary files of one file. Its folder may be one that only holds this file of the
/// program, so nothing else in it is touched. Returns their number.
///
/// # Errors
/// When the folder cannot be read.
pub fn sweep_temporaries_of(path: &Path) -> io::Result<usize> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let start = temporary_name(&path.file_name().unwrap_or_default().to_string_lossy(), 0);
    let start = start.trim_end_matches('0');
    sweep_names(folder, |name| is_temporary_name(name) && name.starts_with(start))
}

fn sweep_names(folder: &Path, is_swept: impl Fn(&str) -> bool) -> io::Result<usize> {
    let mut count = 0;
    // An entry that cannot be read has disappeared.
    for entry in fs::read_dir(folder)?.flatten() {
        let is_file = || entry.file_type().is_ok_and(|kind| kind.is_file());
        if is_swept(&entry.file_name().to_string_lossy()) && is_file() {
            count += usize::from(sweep(&entry.path()).unwrap_or(false));
        }
    }
    Ok(count)
}

/// Removes an abandoned temporary file.
fn sweep(path: &Path) -> io::Result<bool> {
    let Some(_locked) = lock_abandoned(path)? else { return Ok(false) };
    // The lock is held until the file is removed, so that a process that has just created the file cannot
    // lock it, and uses another name.
    fs::remove_file(path)?;
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::files::atomic_write::StagedFile;
    use crate::pipeline::files::temporary::Temporary;
    use std::time::Duration;
    use tempfile::tempdir;

    #[test]
    #[cfg_attr(windows, ignore = "Wine cannot release this lock before the file is closed")]
    fn only_abandoned_files_are_swept() {
        let folder = tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        let written = Temporary::create(&path).expect("created");
        let left = folder.path().join(temporary_name("a.glb", 7));
        fs::write(&left, "half a fra").expect("written");
        let others = [
            "a.glb.tmp-0123456789abcdef",
            ".a.tmp-0123456789abcdeg",
            ".a.tmp-012",
            ".tmp",
            ".a.glb",
            "a.glb",
        ];
        for name in others {
            fs::write(folder.path().join(name), "of another writer").expect("written");
        }
        fs::create_dir(folder.path().join(temporary_name("folder", 7))).expect("made");
        assert_eq!(sweep_temporaries(folder.path()).expect("readable"), 1);
        assert!(!left.exists() && written.path().exists());
        assert_eq!(fs::read_dir(folder.path()).expect("there").count(), others.len() + 2);
        // As if the process had been killed: the file stays and the lock is released.
        let killed = written.path().to_owned();
        written.file().unlock().expect("unlocked");
        assert_eq!(sweep_temporaries(folder.path()).expect("readable"), 1);
        assert!(!killed.exists());
        assert!(sweep_temporaries(&folder.path().join("missing")).is_err());
    }

    #[test]
    fn only_temporary_files_of_one_file_are_swept() {
        let folder = tempdir().expect("a folder");
        let path = folder.path().join("shot.usda");
        let left = [temporary_name("shot.usda", 7), temporary_name("shot.usda", 0)];
        let others =
            [temporary_name("dam.usda", 7), temporary_name("shot.usda.b", 7), "shot.usda".to_owned()];
        for name in left.iter().chain(&others) {
            fs::write(folder.path().join(name), "half a sta").expect("written");
        }
        assert_eq!(sweep_temporaries_of(&path).expect("readable"), 2);
        assert!(others.iter().all(|name| folder.path().join(name).exists()));
        assert_eq!(fs::read_dir(folder.path()).expect("there").count(), others.len());
        assert!(sweep_temporaries_of(&folder.path().join("missing/shot.usda")).is_err());
    }

    #[test]
    #[cfg(unix)]
    fn a_link_is_not_followed_and_not_swept() {
        let folder = tempdir().expect("a folder");
        let users_file = folder.path().join("precious");
        fs::write(&users_file, "precious").expect("written");
        let link = folder.path().join(temporary_name("a.glb", 7));
        std::os::unix::fs::symlink(&users_file, &link).expect("linked");
        assert_eq!(sweep_temporaries(folder.path()).expect("readable"), 0);
        assert!(link.is_symlink() && users_file.exists());
    }

    /// The folder is replaced by a file, so nothing in it can be removed.
    #[test]
    #[cfg(unix)]
    fn file_that_cannot_be_removed_is_removed_later() {
        let folder = tempdir().expect("a folder");
        let [inner, away] = ["inner", "away"].map(|name| folder.path().join(name));
        fs::create_dir(&inner).expect("made");
        let temporary = Temporary::create(&inner.join("a.glb")).expect("created");
        let name = temporary.path().file_name().expect("a name").to_owned();
        fs::rename(&inner, &away).expect("renamed");
        fs::write(&inner, "in the way").expect("written");
        drop(temporary);
        assert!(away.join(&name).exists() && remove_left_behind() > 0);
        fs::remove_file(&inner).expect("removed");
        fs::rename(&away, &inner).expect("renamed");
        // Other writers of this process may retry the removal as well.
        let start = std::time::Instant::now();
        while inner.join(&name).exists() {
            assert!(start.elapsed() < Duration::from_secs(60), "it is left");
            drop(StagedFile::write(&folder.path().join("b.glb"), |_| Ok(())).expect("created"));
        }
    }
}
