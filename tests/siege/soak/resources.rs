//! The daemon's memory, handles and threads, measured while it is idle.

use std::fs;
use std::path::Path;

use crate::scene::memory_bytes;

/// The resources of one process at one moment.
#[derive(Clone, Debug)]
pub(super) struct Vitals {
    minute: f64,
    life: usize,
    pub(super) resident_bytes: u64,
    pub(super) handle_count: usize,
    pub(super) thread_count: usize,
    journal_bytes: u64,
}

impl Vitals {
    /// The names of the columns of [`Vitals::line`].
    pub(super) const HEADER: &str = "minute,life,resident_bytes,handles,threads,journal_bytes,converted";

    pub(super) fn of(pid: u32, folder: &Path, minute: f64, life: usize) -> Vitals {
        let count = |what: &str| fs::read_dir(format!("/proc/{pid}/{what}")).expect("it lives").count();
        Vitals {
            minute,
            life,
            resident_bytes: memory_bytes(pid, "VmRSS"),
            handle_count: count("fd"),
            thread_count: count("task"),
            journal_bytes: fs::metadata(folder.join("out/.meniscus/journal")).map_or(0, |file| file.len()),
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
            self.journal_bytes
        )
    }
}

/// Asserts that the daemon uses no more resources in the last third of a life than in the first third. For
/// memory, it compares the medians, with an allowance for the allocator.
pub(super) fn assert_flat(vitals: &[Vitals]) {
    let third = vitals.len().div_ceil(3);
    let (first, last) = (&vitals[..third], &vitals[vitals.len() - third..]);
    let most = |vitals: &[Vitals], figure: fn(&Vitals) -> usize| vitals.iter().map(figure).max().unwrap_or(0);
    for figure in [|vitals: &Vitals| vitals.handle_count, |vitals: &Vitals| vitals.thread_count] {
        // An HTTP client may be connected at that moment.
        assert!(most(last, figure) <= most(first, figure) + 2, "{vitals:#?}");
    }
    let [before, after] = [first, last].map(median_bytes);
    assert!(after <= before + before / 10 + (4 << 20), "{before} became {after} bytes: {vitals:#?}");
    assert!(most(last, |vitals| vitals.journal_bytes as usize) < 1 << 20, "{vitals:#?}");
}

fn median_bytes(vitals: &[Vitals]) -> u64 {
    let mut sizes: Vec<u64> = vitals.iter().map(|vitals| vitals.resident_bytes).collect();
    sizes.sort_unstable();
    sizes.get(sizes.len() / 2).copied().unwrap_or(0)
}

/// The growth of memory in bytes per hour: the slope of a line through the last two thirds of a life.
pub(super) fn hourly_growth(vitals: &[Vitals]) -> f64 {
    let later = &vitals[vitals.len() / 3..];
    let count = later.len() as f64;
    let mean = |figure: fn(&Vitals) -> f64| later.iter().map(figure).sum::<f64>() / count;
    let (minute, bytes) = (mean(|vitals| vitals.minute), mean(|vitals| vitals.resident_bytes as f64));
    let mut sums = (0.0, 0.0);
    for vitals in later {
        let [run, rise] = [vitals.minute - minute, vitals.resident_bytes as f64 - bytes];
        sums = (sums.0 + run * rise, sums.1 + run * run);
    }
    if sums.1 > 0.0 { 60.0 * sums.0 / sums.1 } else { 0.0 }
}
