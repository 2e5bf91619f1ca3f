//! The threads, the memory and the temporary files of the process.

use std::fs;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::thread::available_parallelism;

use anyhow::{Context, Result, bail};
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::pipeline::{default_memory_bytes, limit_reading};

use super::stop_requests::on_stop_requests;

/// No frame needs less memory than this, in bytes: a smaller limit probably lacks its unit.
const MEMORY_MIN_BYTES: u64 = 1 << 20;

/// The number of computing threads: as given, or one per core.
pub(super) fn thread_count(given: Option<u16>) -> usize {
    given.map_or_else(|| available_parallelism().map_or(1, usize::from), usize::from)
}

/// The thread pool: as many threads as given, or one per core.
///
/// # Errors
/// If the system cannot start the threads.
pub(super) fn thread_pool(given: Option<u16>) -> Result<ThreadPool> {
    let pool = ThreadPoolBuilder::new().num_threads(thread_count(given));
    pool.thread_name(|index| format!("compute {index}")).build().context("cannot start the threads")
}

/// The memory limit for frames in bytes: as given, or half of the machine's memory. No file that is read from now on may
/// take more.
///
/// # Errors
/// If it is too small for any frame.
pub(super) fn memory_bytes(given: Option<u64>) -> Result<u64> {
    let bytes = given.unwrap_or_else(default_memory_bytes);
    if bytes < MEMORY_MIN_BYTES {
        bail!(
            "a memory limit of {bytes} bytes is too small for any frame: give at least 1MiB, for example 8GiB"
        );
    }
    limit_reading(bytes);
    Ok(bytes)
}

// Removes temporary files on a request to stop, such as Ctrl-C, so that no partial output remains.
//
// The frames in flight are discarded; finished ones remain, and `--skip-done` continues from there.

type LastAct = Box<dyn FnOnce() + Send>;

/// What an interrupted process does before it exits.
static LAST_ACTS: Mutex<Vec<LastAct>> = Mutex::new(Vec::new());

/// Registers what the process does if it is interrupted; see [`clean_up_when_interrupted`].
pub(super) fn when_interrupted(act: impl FnOnce() + Send + 'static) {
    LAST_ACTS.lock().unwrap_or_else(PoisonError::into_inner).push(Box::new(act));
}

/// Registers a folder to be removed when the process is interrupted.
pub(super) fn remove_when_interrupted(folder: PathBuf) {
    // The process exits, so a failure cannot be retried.
    when_interrupted(move || drop(fs::remove_dir_all(folder)));
}

/// From now on, an interrupted process removes its temporary files before it exits.
pub(super) fn clean_up_when_interrupted() {
    // Without the handler, everything but the cleanup works.
    let _ = on_stop_requests(|request| {
        for act in LAST_ACTS.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
            act();
        }
        crate::pipeline::stop_writing();
        std::process::exit(request.status);
    });
}

// Returns freed memory to the system, so that `--memory` means what it says.
//
// glibc returns large blocks immediately, but its threshold for "large" grows with the blocks that it sees,
// up to 32 MiB; smaller blocks stay with the thread that freed them. The fields of a frame are a few MiB
// each. With 16 threads the process held 344 MiB while frames took 160 MiB; with both thresholds fixed, 196
// MiB.
//
// glibc also creates up to eight arenas per processor, each of which retains some memory: a daemon on two
// processors grew from 22 to 56 MiB within its first hour. At most one thread per processor runs at once, so
// one arena per processor is as fast.

/// Makes the allocator retain little memory. Call it before the process starts threads.
///
/// Does nothing if the environment sets the allocator's options (`MALLOC_…`, `GLIBC_TUNABLES`), or if the C
/// library is not glibc.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub fn give_memory_back() {
    use std::env;
    use std::ffi::c_int;
    use std::thread::available_parallelism;

    let is_chosen = |name: &&str| env::var_os(name).is_some();
    if CHOSEN_BY.iter().any(is_chosen) {
        return;
    }
    let arenas = available_parallelism().map_or(1, usize::from);
    let parameters = [
        (libc::M_ARENA_MAX, c_int::try_from(arenas).unwrap_or(c_int::MAX)),
        (libc::M_MMAP_THRESHOLD, MMAP_THRESHOLD),
        (libc::M_TRIM_THRESHOLD, TRIM_THRESHOLD),
    ];
    for (parameter, value) in parameters {
        // If glibc refuses a parameter, the process only retains more memory.
        #[expect(unsafe_code, reason = "std has no safe call for it")]
        // SAFETY: mallopt takes two integers, no pointers; it locks the allocator's state, and refuses
        // unknown parameters and values.
        let _accepted = unsafe { libc::mallopt(parameter, value) };
    }
}

/// Other systems have another allocator, so this does nothing.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn give_memory_back() {}

/// Environment variables that configure the allocator; if one is set, the allocator is left as it is.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const CHOSEN_BY: [&str; 4] =
    ["MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_", "MALLOC_ARENA_MAX", "GLIBC_TUNABLES"];

/// Blocks of 1 MiB or more are returned immediately.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const MMAP_THRESHOLD: std::ffi::c_int = 1 << 20;

/// Free memory at the end of an arena is returned once it reaches 4 MiB.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const TRIM_THRESHOLD: std::ffi::c_int = 4 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_of_5_bytes_is_refused() {
        assert!(memory_bytes(Some(5)).is_err_and(|why| why.to_string().contains("memory limit of 5 bytes")));
        assert_eq!(memory_bytes(Some(1 << 20)).ok(), Some(1 << 20));
    }
}
