//! SEAM: `pipeline::default_in_flight` and `pipeline::default_memory_bytes` take the place of this file.
pub(super) fn default_in_flight(threads: usize) -> usize {
    threads.clamp(2, 8)
}
pub(super) fn default_memory_bytes() -> u64 {
    4 << 30
}
