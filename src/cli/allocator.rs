//! Returns freed memory to the system, so that `--memory` means what it says.
//!
//! glibc returns large blocks immediately, but its threshold for "large" grows with the blocks that it sees,
//! up to 32 MiB; smaller blocks stay with the thread that freed them. The fields of a frame are a few MiB
//! each. With 16 threads the process held 344 MiB while frames took 160 MiB; with both thresholds fixed, 196
//! MiB.
//!
//! glibc also creates up to eight arenas per processor, each of which retains some memory: a daemon on two
//! processors grew from 22 to 56 MiB within its first hour. At most one thread per processor runs at once, so
//! one arena per processor is as fast.

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
