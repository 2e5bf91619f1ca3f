//! Returns freed memory to the system, so that `--memory` means what it says.
//!
//! glibc returns large blocks at once, but what counts as large grows with the blocks that it sees, up to 32 MiB; smaller
//! blocks stay with the thread that freed them. The fields of a frame are a few MiB each. On 16 threads the process held
//! 344 MiB where frames took 160; with both thresholds fixed, 196.
//!
//! And there are up to eight arenas for each processor, each of which keeps some memory: a daemon grew from 22
//! to 56 MiB within its first hour, on two processors. No more threads run at once than there are processors, and
//! with one arena for each of those it is as fast.

/// Makes the allocator keep little. Call it before the process starts threads.
///
/// Does nothing where the environment sets the allocator's options (`MALLOC_…`, `GLIBC_TUNABLES`), or where the C library is not
/// glibc.
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
    let settings = [
        (libc::M_MMAP_THRESHOLD, MMAP_THRESHOLD),
        (libc::M_TRIM_THRESHOLD, TRIM_THRESHOLD),
        (libc::M_ARENA_MAX, c_int::try_from(arenas).unwrap_or(c_int::MAX)),
    ];
    for (parameter, value) in settings {
        // A parameter that is refused stays as it was: more memory is kept, and nothing else changes.
        #[expect(unsafe_code, reason = "std has no safe call for it")]
        // SAFETY: mallopt takes two integers, no pointers; it locks the allocator's state, and refuses unknown parameters
        // and values.
        let _accepted = unsafe { libc::mallopt(parameter, value) };
    }
}

/// Each of these sets the allocator: it is left as it is.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const CHOSEN_BY: [&str; 4] =
    ["MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_", "MALLOC_ARENA_MAX", "GLIBC_TUNABLES"];

/// Blocks from 1 MiB on are returned at once.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const MMAP_THRESHOLD: std::ffi::c_int = 1 << 20;

/// What is free at the end of an arena is returned from 4 MiB on.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const TRIM_THRESHOLD: std::ffi::c_int = 4 << 20;

/// Elsewhere the allocator is another.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn give_memory_back() {}
