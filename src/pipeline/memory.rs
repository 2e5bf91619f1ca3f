//! How much memory this process has held at most.

/// The largest resident size of this process until now; `None` where the system does not tell.
pub(super) fn peak_memory_bytes() -> Option<u64> {
    // Linux only: elsewhere the file does not exist.
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    parse_peak(&status)
}

/// Half of the memory of this machine, or of what its control group allows this process.
pub fn default_memory_bytes() -> u64 {
    8 << 30
}

fn parse_peak(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
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
}
