//! Waits until every possible conversion is done.
//!
//! The daemon's own count is not sufficient, because it does not include files that were written a moment
//! ago. A frame counts as done if its outputs were made from the bytes that it has now.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use meniscus_formats::{Limits, read_particles};
use meniscus_formats::{OutputFormat, read_provenance};
use twox_hash::XxHash3_128;

use crate::siege::scene::{Daemon, meniscus, status};

/// Time limit of a wait: an event that has not happened by then will not happen.
const TIMEOUT: Duration = Duration::from_secs(180);

/// Waits until every frame that can be read is done, or has failed for another reason.
pub(super) fn await_idle(folder: &Path, daemon: &mut Daemon) {
    let start = Instant::now();
    loop {
        daemon.listen_for(Duration::from_millis(250));
        let pending = pending_frames(folder);
        if pending.is_empty() {
            return;
        }
        if start.elapsed() > TIMEOUT {
            panic!(
                "these do not come: {pending:?}\n{}\n{:#}",
                status_of(folder, &pending[0]),
                status(folder)
            );
        }
    }
}

/// The readable frames whose outputs were made from other bytes.
fn pending_frames(folder: &Path) -> Vec<PathBuf> {
    let undone: Vec<PathBuf> = frames(folder).into_iter().filter(|path| !is_done(folder, path)).collect();
    if undone.is_empty() {
        return undone;
    }
    let status = status(folder);
    let failed = status["failed"].as_array().into_iter().flatten();
    let failed: Vec<&str> = failed.filter_map(|frame| frame["input"].as_str()).collect();
    let has_failed = |path: &PathBuf| failed.iter().any(|failed| Path::new(failed).ends_with(name(path)));
    undone.into_iter().filter(|path| !has_failed(path)).collect()
}

/// The files in the folder of frames that can be read as particles.
fn frames(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder.join("in")).expect("the folder exists").flatten();
    let files =
        entries.map(|entry| entry.path()).filter(|path| path.is_file() && !name(path).starts_with('.'));
    files.filter(|path| is_readable(path)).collect()
}

fn is_readable(path: &Path) -> bool {
    let bytes = fs::read(path).expect("readable");
    read_particles(&bytes, &name(path), &Limits::default()).is_ok()
}

/// Whether both outputs were made from the bytes that the frame has now.
fn is_done(folder: &Path, frame: &Path) -> bool {
    let hash = format!("{:032x}", XxHash3_128::oneshot(&fs::read(frame).expect("readable")));
    [("glb", OutputFormat::Glb), ("vdb", OutputFormat::Vdb)].iter().all(|&(extension, kind)| {
        let output = folder.join("out").join(Path::new(&name(frame)).with_extension(extension));
        let Ok(file) = File::open(output) else { return false };
        let pairs = read_provenance(kind, file).unwrap_or_default();
        pairs.iter().any(|(name, value)| name == "input_hash" && value.ends_with(&hash))
    })
}

fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// What is recorded of a frame.
fn status_of(folder: &Path, frame: &Path) -> String {
    let output =
        meniscus(folder).arg("status").arg(frame).args(["--out", "out"]).output().expect("it starts");
    String::from_utf8_lossy(&output.stdout).into_owned()
}
