//! Memory that is freed goes back to the system, so that `--memory` means what it says.
//!
//! The allocator of glibc gives large blocks back at once, but what "large" is grows with what it sees, up to
//! 32 MiB; below that each thread keeps what it freed for itself. A frame's fields are of a few MiB. On 16
//! threads the process so held 344 MiB where frames took 160; with both thresholds fixed, 196.
//!
//! And there are up to eight parts for each processor, each of which keeps something of its own: a daemon grew from 22
//! to 56 MiB within its first hour, on two processors. No more threads run at once than there are processors, and
//! with one part for each of those it is as fast.
//!
//! All this can be fixed only before the process begins, or by a call that Rust cannot check. So it begins anew.

/// Starts this program once more in its place, with the allocator told to keep little.
///
/// Where that is not possible, or whoever started it has chosen otherwise, it simply goes on.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub fn give_memory_back() {
    use std::env;
    use std::os::unix::process::CommandExt;
    use std::process::Command;
    use std::thread::available_parallelism;

    if SETTINGS.iter().any(|(name, _)| env::var_os(name).is_some()) || env::var_os(PARTS).is_some() {
        return;
    }
    let part_count = available_parallelism().map_or(1, usize::from);
    let mut arguments = env::args_os();
    let (Some(name), Ok(program)) = (arguments.next(), env::current_exe()) else { return };
    // It returns only when it fails; then more memory is kept, and all else is as it was.
    let _failed = Command::new(program)
        .arg0(name)
        .args(arguments)
        .envs(SETTINGS)
        .env(PARTS, part_count.to_string())
        .exec();
}

/// How many threads may allocate at once; the others wait for them.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const PARTS: &str = "MALLOC_ARENA_MAX";

/// Blocks from 1 MiB on are given back at once; and so is what is free at the end of a thread's own part,
/// from 4 MiB on.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const SETTINGS: [(&str, &str); 3] = [
    ("MALLOC_MMAP_THRESHOLD_", "1048576"),
    ("MALLOC_TRIM_THRESHOLD_", "4194304"),
    // Pages of 2 MiB where the system has them: fields are streamed over and over, and a tenth of the time of
    // smoothing goes into finding out where their pages are.
    ("GLIBC_TUNABLES", "glibc.malloc.hugetlb=1"),
];

/// Elsewhere the allocator is another.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn give_memory_back() {}
