//! Counters since the start of the process, which never decrease.

use crate::pipeline::Figures;

/// The names of the stages, in the order of [`Stage`](crate::pipeline::Stage).
pub const STAGES: [&str; 6] = ["read", "rasterize", "smooth", "contour", "write", "preview"];

/// Counters since the start of the daemon.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Counters {
    /// Frames that were converted.
    pub converted: u64,
    /// Frames that were already done when they were read.
    pub found_done: u64,
    /// Failures that are not retried before a restart.
    pub failures: u64,
    /// Failures that are retried. A failure counts when it happens, and not when the retry begins.
    pub retries: u64,
    /// Full scans of a folder, including `rescans` and those that failed.
    pub scans: u64,
    /// Full scans because events were lost.
    pub rescans: u64,
    /// Bytes of converted input files.
    pub input_bytes: u64,
    /// Bytes of written outputs.
    pub output_bytes: u64,
    /// Seconds that converted frames spent in each stage.
    pub stages: [Histogram; STAGES.len()],
}

/// The upper bounds of the buckets, in seconds; the last bucket is unbounded.
pub const BUCKETS_S: [f64; 11] = [0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0];

/// A histogram of values.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Histogram {
    /// The number of values in each bucket: those above the previous bound, up to its own.
    pub counts: [u64; BUCKETS_S.len() + 1],
    /// The sum of all values.
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
    /// Counts a converted frame.
    pub fn add_converted(&mut self, figures: &Figures, input_bytes: u64, output_bytes: u64) {
        self.converted += 1;
        self.input_bytes += input_bytes;
        self.output_bytes += output_bytes;
        for (histogram, seconds) in self.stages.iter_mut().zip(figures.seconds.by_stage()) {
            histogram.add(seconds);
        }
    }
}
