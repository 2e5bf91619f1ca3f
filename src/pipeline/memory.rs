//! Measures the memory of this process, and its limits.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::sync::atomic::{AtomicU64, Ordering};

use meniscus_formats::Limits;

/// The memory for one file that is read, in bytes; 0 for the default. A process runs one command.
static READING_BYTES: AtomicU64 = AtomicU64::new(0);

static DEFAULT_READING_BYTES: LazyLock<u64> = LazyLock::new(default_memory_bytes);

/// Limits the memory for each file that this process reads from now on.
pub fn limit_reading(bytes: u64) {
    READING_BYTES.store(bytes, Ordering::Relaxed);
}

/// The limits of readers.
pub(crate) fn reading_limits() -> Limits {
    match READING_BYTES.load(Ordering::Relaxed) {
        0 => Limits::within(*DEFAULT_READING_BYTES),
        bytes => Limits::within(bytes),
    }
}

/// The peak resident set size of this process, in bytes; `None` if the system does not report it.
pub(super) fn peak_memory_bytes() -> Option<u64> {
    // Only Linux has this file.
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    parse_peak(&status)
}

/// The resident set size of this process, in bytes; `None` if the system does not report it.
#[cfg(target_os = "linux")]
pub fn resident_memory_bytes() -> Option<u64> {
    parse_kibibytes(&std::fs::read_to_string("/proc/self/status").ok()?, "VmRSS:")
}

/// The resident set size of this process, in bytes; `None` if the system does not report it.
#[cfg(not(target_os = "linux"))]
pub fn resident_memory_bytes() -> Option<u64> {
    use sysinfo::{ProcessRefreshKind, ProcessesToUpdate, System, get_current_pid};
    let id = get_current_pid().ok()?;
    let mut system = System::new();
    let memory = ProcessRefreshKind::nothing().with_memory();
    system.refresh_processes_specifics(ProcessesToUpdate::Some(&[id]), false, memory);
    Some(system.process(id)?.memory())
}

/// The default memory for frames in flight, in bytes: half of the memory of this machine or of the smallest
/// limit of this process's control groups, whichever is less. 4 GiB if the system reports neither.
pub fn default_memory_bytes() -> u64 {
    let read = |path: &Path| std::fs::read_to_string(path).ok();
    let machine = machine_memory_bytes();
    // Only Linux has control groups.
    let groups = read(Path::new("/proc/self/cgroup")).unwrap_or_default();
    let allowed = limit_files(&groups).iter().filter_map(|path| parse_limit(&read(path)?)).min();
    machine.into_iter().chain(allowed).min().unwrap_or(UNKNOWN_BYTES) / 2
}

#[cfg(target_os = "linux")]
fn machine_memory_bytes() -> Option<u64> {
    parse_total(&std::fs::read_to_string("/proc/meminfo").ok()?)
}

#[cfg(not(target_os = "linux"))]
fn machine_memory_bytes() -> Option<u64> {
    let mut system = sysinfo::System::new();
    system.refresh_memory();
    Some(system.total_memory()).filter(|&bytes| bytes > 0)
}

/// The assumed memory of a machine that does not report it.
const UNKNOWN_BYTES: u64 = 8 << 30;

#[cfg(any(test, target_os = "linux"))]
fn parse_total(meminfo: &str) -> Option<u64> {
    parse_kibibytes(meminfo, "MemTotal:")
}

/// The files that may contain the memory limits of a process's control groups, according to its
/// `/proc/self/cgroup`. Includes the files of all parents: their limits apply to a group as well, and in a
/// container the path of a group may be its path outside of the container.
fn limit_files(groups: &str) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for line in groups.lines() {
        let mut fields = line.splitn(3, ':').skip(1);
        let (Some(controllers), Some(group)) = (fields.next(), fields.next()) else { continue };
        let (root, name) = if controllers.is_empty() {
            ("/sys/fs/cgroup", "memory.max")
        } else if controllers.split(',').any(|controller| controller == "memory") {
            ("/sys/fs/cgroup/memory", "memory.limit_in_bytes")
        } else {
            continue;
        };
        let within = Path::new(group.trim_start_matches('/'));
        files.extend(within.ancestors().map(|group| Path::new(root).join(group).join(name)));
    }
    files
}

/// A limit in bytes; `None` for `max`, or for a number that exceeds the memory of any machine.
fn parse_limit(text: &str) -> Option<u64> {
    text.trim().parse().ok().filter(|&bytes: &u64| bytes < 1 << 60)
}

fn parse_peak(status: &str) -> Option<u64> {
    parse_kibibytes(status, "VmHWM:")
}

/// The number of bytes in the line of a system file that begins with `name`.
fn parse_kibibytes(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(name))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim_end().parse().ok()?;
    kibibytes.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn peak_is_read_from_the_status() {
        assert_eq!(parse_peak("VmPeak:\t  9 kB\nVmHWM:\t  123 kB\nVmRSS: 7 kB\n"), Some(123 * 1024));
        assert_eq!(parse_peak("VmRSS: 7 kB\n"), None);
        assert_eq!(parse_peak("VmHWM: many kB\n"), None);
    }

    #[test]
    fn limits_of_parent_groups_apply() {
        let groups = "8:cpu,cpuacct:/a\n4:memory:/b/c\n0::/d\n";
        let files = limit_files(groups);
        let expected = [
            "/sys/fs/cgroup/memory/b/c/memory.limit_in_bytes",
            "/sys/fs/cgroup/memory/b/memory.limit_in_bytes",
            "/sys/fs/cgroup/memory/memory.limit_in_bytes",
            "/sys/fs/cgroup/d/memory.max",
            "/sys/fs/cgroup/memory.max",
        ];
        assert_eq!(files, expected.map(PathBuf::from));
        assert_eq!(parse_limit("1073741824\n"), Some(1 << 30));
        assert_eq!(parse_limit("max\n"), None);
        assert_eq!(parse_limit("9223372036854771712\n"), None);
        assert_eq!(parse_total("MemTotal:       24567 kB\nMemFree: 1 kB\n"), Some(24567 << 10));
    }

    #[test]
    fn default_memory_is_plausible() {
        let bytes = default_memory_bytes();
        assert!(bytes >= 64 << 20, "{bytes} bytes");
    }
}
