//! The resources that a command may use: threads and memory.

use std::thread::available_parallelism;

use anyhow::{Context, Result, bail};
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::pipeline::default_memory_bytes;

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

/// The memory limit for frames in bytes: as given, or half of the machine's memory.
///
/// # Errors
/// If it is too small for any frame.
pub(super) fn memory_bytes(given: Option<u64>) -> Result<u64> {
    match given {
        Some(bytes) if bytes < MEMORY_MIN_BYTES => {
            bail!(
                "a memory limit of {bytes} bytes is too small for any frame: give at least 1MiB, for example 8GiB"
            )
        }
        Some(bytes) => Ok(bytes),
        None => Ok(default_memory_bytes()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_of_5_bytes_is_refused() {
        assert!(memory_bytes(Some(5)).is_err_and(|why| why.to_string().contains("memory limit of 5 bytes")));
        assert_eq!(memory_bytes(Some(1 << 20)).ok(), Some(1 << 20));
    }
}
