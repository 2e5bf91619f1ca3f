//! What is counted while the daemon runs: only ever upwards.

use super::figures::Figures;

/// The names of the stages, in the order of [`Stage`](crate::pipeline::Stage).
pub const STAGES: [&str; 6] = ["read", "rasterize", "smooth", "contour", "write", "preview"];

/// What was counted since the daemon began.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Counters {
    /// Frames that were converted.
    pub converted: u64,
    /// Frames that were read and found done.
    pub found_done: u64,
    /// How often a frame failed for good, or until a restart.
    pub failures: u64,
    /// How often a frame failed and was to be tried again.
    pub retries: u64,
    /// How often a folder was looked at as a whole.
    pub scans: u64,
    /// How often that was because events were lost.
    pub rescans: u64,
    /// Bytes of the files that were converted.
    pub input_bytes: u64,
    /// Bytes that were written.
    pub output_bytes: u64,
    /// Seconds in each stage, of the frames that were converted.
    pub stages: [Histogram; STAGES.len()],
}

/// The upper ends of the buckets, in seconds; the last bucket has none.
pub const BUCKETS_S: [f64; 11] = [0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0];

/// How many values were how large.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Histogram {
    /// How many were at most as large as each end, and larger than the one before.
    pub counts: [u64; BUCKETS_S.len() + 1],
    /// All values together.
    pub sum: f64,
}

impl Histogram {
    /// Adds a value.
    pub fn add(&mut self, value: f64) {
        let bucket = BUCKETS_S.iter().position(|&end| value <= end).unwrap_or(BUCKETS_S.len());
        self.counts[bucket] += 1;
        self.sum += value;
    }
}

impl Counters {
    /// A frame was converted.
    pub fn add_converted(&mut self, figures: &Figures, input_bytes: u64, output_bytes: u64) {
        self.converted += 1;
        self.input_bytes += input_bytes;
        self.output_bytes += output_bytes;
        for (histogram, seconds) in self.stages.iter_mut().zip(figures.seconds.by_stage()) {
            histogram.add(seconds);
        }
    }
}
