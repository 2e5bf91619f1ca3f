//! Checks that every visible output is complete.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::ErrorKind;
use std::os::unix::fs::DirEntryExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use meniscus_formats::OutputFormat;
use meniscus_formats::is_complete;

/// Opens every output as soon as it appears, and again whenever another file replaces it; returns their
/// number.
pub(super) fn observe(folder: &Path, is_over: &AtomicBool) -> usize {
    let mut snapshot_count = 0;
    let mut inodes: HashMap<PathBuf, u64> = HashMap::new();
    loop {
        // After the end, the observer reads the final files once more.
        let is_last = is_over.load(Ordering::SeqCst);
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let path = entry.path();
            let Some(kind) = kind(&path) else { continue };
            if inodes.get(&path) == Some(&entry.ino()) {
                continue;
            }
            let mut file = match File::open(&path) {
                Ok(file) => file,
                // The producer deletes outputs, too.
                Err(error) if error.kind() == ErrorKind::NotFound => continue,
                Err(error) => panic!("{}: {error}", path.display()),
            };
            assert!(is_complete(kind, &mut file).unwrap_or(false), "{} was not whole", path.display());
            inodes.insert(path, entry.ino());
            snapshot_count += 1;
        }
        if is_last {
            return snapshot_count;
        }
        thread::sleep(Duration::from_millis(2));
    }
}

/// The format of an output; `None` for hidden files and for the ballast.
fn kind(path: &Path) -> Option<OutputFormat> {
    let name = path.file_name()?.to_str()?;
    match name.rsplit_once('.')? {
        (stem, _) if stem.is_empty() || stem.starts_with('.') => None,
        (_, "glb") => Some(OutputFormat::Glb),
        (_, "vdb") => Some(OutputFormat::Vdb),
        _ => panic!("{name} is not an output"),
    }
}
