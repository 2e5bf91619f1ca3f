//! The daemon's memory, handles and threads, measured while it is idle.

use std::fs;
use std::path::Path;

use crate::siege::scene::{memory_bytes, records_bytes};

/// The resources of one process at one moment.
#[derive(Clone, Debug)]
pub(super) struct ResourceUsage {
    minute: f64,
    life: usize,
    pub(super) resident_bytes: u64,
    pub(super) handle_count: usize,
    pub(super) thread_count: usize,
    records_bytes: u64,
}

impl ResourceUsage {
    /// The names of the columns of [`Vitals::line`].
    pub(super) const HEADER: &str = "minute,life,resident_bytes,handles,threads,records_bytes,converted";

    pub(super) fn of(pid: u32, folder: &Path, minute: f64, life: usize) -> ResourceUsage {
        let count = |what: &str| fs::read_dir(format!("/proc/{pid}/{what}")).expect("it lives").count();
        ResourceUsage {
            minute,
            life,
            resident_bytes: memory_bytes(pid, "VmRSS"),
            handle_count: count("fd"),
            thread_count: count("task"),
            records_bytes: records_bytes(folder),
        }
    }

    pub(super) fn line(&self, converted_count: usize) -> String {
        format!(
            "{:.2},{},{},{},{},{},{converted_count}",
            self.minute,
            self.life,
            self.resident_bytes,
            self.handle_count,
            self.thread_count,
            self.records_bytes
        )
    }
}

/// Asserts that the daemon uses no more resources in the last third of a life than in the first third. For
/// memory, it compares the medians, with an allowance for the allocator.
pub(super) fn assert_flat(usages: &[ResourceUsage]) {
    let third = usages.len().div_ceil(3);
    let (first, last) = (&usages[..third], &usages[usages.len() - third..]);
    let most = |usages: &[ResourceUsage], figure: fn(&ResourceUsage) -> usize| {
        usages.iter().map(figure).max().unwrap_or(0)
    };
    for figure in [|usages: &ResourceUsage| usages.handle_count, |usages: &ResourceUsage| usages.thread_count]
    {
        // An HTTP client may be connected at that moment.
        assert!(most(last, figure) <= most(first, figure) + 2, "{usages:#?}");
    }
    let [before, after] = [first, last].map(median_bytes);
    assert!(after <= before + before / 10 + (4 << 20), "{before} became {after} bytes: {usages:#?}");
    assert!(most(last, |usages| usages.records_bytes as usize) < 4 << 20, "{usages:#?}");
}

fn median_bytes(usages: &[ResourceUsage]) -> u64 {
    let mut sizes: Vec<u64> = usages.iter().map(|usages| usages.resident_bytes).collect();
    sizes.sort_unstable();
    sizes.get(sizes.len() / 2).copied().unwrap_or(0)
}

/// The growth of memory in bytes per hour: the slope of a line through the last two thirds of a life.
pub(super) fn hourly_growth(usages: &[ResourceUsage]) -> f64 {
    let later = &usages[usages.len() / 3..];
    let count = later.len() as f64;
    let mean = |figure: fn(&ResourceUsage) -> f64| later.iter().map(figure).sum::<f64>() / count;
    let (minute, bytes) = (mean(|usages| usages.minute), mean(|usages| usages.resident_bytes as f64));
    let mut sums = (0.0, 0.0);
    for usages in later {
        let [run, rise] = [usages.minute - minute, usages.resident_bytes as f64 - bytes];
        sums = (sums.0 + run * rise, sums.1 + run * run);
    }
    if sums.1 > 0.0 { 60.0 * sums.0 / sums.1 } else { 0.0 }
}
