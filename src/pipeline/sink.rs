//! Files that appear whole or not at all.
//!
//! ```text
//!   .dam.0012.glb.tmp-4711   written, flushed, on the disk
//!            │ rename
//!            ▼
//!   dam.0012.glb             never seen half written, whatever stops the program
//! ```
//!
//! The temporary file lies in the same folder, so that the rename stays within one file system.
//! Its name begins with a dot: programs that watch for frames do not take it for one.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use meniscus_formats::Result;

/// Large enough that the system call does not matter beside the copy.
const BUFFER_BYTES: usize = 1 << 18;

/// Writes the file at `path`, replacing what is there, once `write` has written all of it.
///
/// # Errors
/// What `write` returns, or what the system refuses. Nothing is left behind then, and a file that
/// was at `path` before is still there, untouched.
pub fn write_whole(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> Result<()>) -> Result<()> {
    let (temporary, file) = Temporary::create(path)?;
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, file);
    write(&mut out)?;
    out.flush()?;
    // Else a crash of the machine could leave the name without the bytes.
    out.get_ref().sync_all()?;
    drop(out);
    temporary.rename_to(path)
}

/// A file that is removed unless it is renamed: also when the writer panics.
struct Temporary {
    path: Option<PathBuf>,
}

impl Temporary {
    fn create(path: &Path) -> io::Result<(Temporary, File)> {
        let name = path.file_name().ok_or(io::ErrorKind::InvalidFilename)?;
        let name = format!(".{}.tmp-{}", name.to_string_lossy(), std::process::id());
        let temporary = path.with_file_name(name);
        // Never through a link that somebody else laid there: only ever a new file.
        let create = || OpenOptions::new().write(true).create_new(true).open(&temporary);
        let file = match create() {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                fs::remove_file(&temporary)?;
                create()?
            }
            other => other?,
        };
        Ok((Temporary { path: Some(temporary) }, file))
    }

    fn rename_to(mut self, path: &Path) -> Result<()> {
        if let Some(temporary) = &self.path {
            fs::rename(temporary, path)?;
            self.path = None;
        }
        Ok(())
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        if let Some(path) = &self.path {
            // The error that led here is the one worth telling.
            let _ = fs::remove_file(path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::panic::{AssertUnwindSafe, catch_unwind};

    fn names_in(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).expect("the folder is there");
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect()
    }

    fn write(path: &Path, text: &str) -> Result<()> {
        write_whole(path, |out| Ok(out.write_all(text.as_bytes())?))
    }

    #[test]
    fn a_file_appears_whole_and_replaces_the_one_before() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        for text in ["first", "second"] {
            write(&path, text).expect("written");
            assert_eq!(fs::read_to_string(&path).expect("readable"), text);
        }
        assert_eq!(names_in(folder.path()), ["a.glb"]);
    }

    #[test]
    fn a_writer_that_fails_leaves_nothing_and_the_old_file_as_it_was() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        write(&path, "old").expect("written");
        let disk_full = |out: &mut BufWriter<File>| {
            out.write_all(&vec![0; 2 * BUFFER_BYTES])?;
            Err(io::Error::from(io::ErrorKind::StorageFull).into())
        };
        assert!(write_whole(&path, disk_full).is_err());
        let panicked = catch_unwind(AssertUnwindSafe(|| write_whole(&path, |_| panic!("a broken writer"))));
        assert!(panicked.is_err());
        assert_eq!(fs::read_to_string(&path).expect("readable"), "old");
        assert_eq!(names_in(folder.path()), ["a.glb"]);
    }

    #[test]
    fn a_folder_in_the_way_leaves_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.glb");
        fs::create_dir(&path).expect("made");
        assert!(write(&path, "text").is_err());
        assert_eq!(names_in(folder.path()), ["a.glb"]);
        assert!(write(&folder.path().join("missing/a.glb"), "text").is_err());
    }

    #[test]
    #[cfg(unix)]
    fn links_are_replaced_and_never_written_through() {
        let folder = tempfile::tempdir().expect("a folder");
        let precious = folder.path().join("precious");
        fs::write(&precious, "precious").expect("written");
        let path = folder.path().join("a.glb");
        let temporary = folder.path().join(format!(".a.glb.tmp-{}", std::process::id()));
        for link in [&path, &temporary] {
            std::os::unix::fs::symlink(&precious, link).expect("linked");
        }
        write(&path, "text").expect("written");
        assert_eq!(fs::read_to_string(&precious).expect("readable"), "precious");
        assert!(!path.is_symlink());
        assert!(!temporary.is_symlink());
    }
}
