//! Makes file operations of the program fail, and kills it: it must not report a false success or lose a
//! result.
//!
//! ```text
//!   shim.c, loaded into the program ──▶ ENOSPC, EIO, ESTALE, EACCES, short reads and writes, SIGKILL
//!
//!   a cycle:  [good outputs of earlier frames] ─▶ one to three runs with faults ─▶ one without
//!                                                   └ checked after each            └ all outputs exist
//!
//! After each run, an output that was there is still there, complete, in its old or new version; and only frames
//! whose files are all of the current version are recorded as done.
//! ```
//!
//! The number of a cycle is its seed. `MENISCUS_FAULT_CYCLES=2000` runs more cycles than the usual 200, and
//! `MENISCUS_FAULT_SEED=123` repeats a single one, with a log of its faults.

#![cfg(target_os = "linux")]

mod cycle; // the commands of a cycle, and the conditions that must hold afterwards
mod scene; // frames, their expected outputs, and the program with faults

use std::env;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;

use scene::{References, build_shim, print_line};

/// Cycles mostly wait, for a second attempt or for a disk, so several run at once.
const THREADS: usize = 6;

fn of_environment(name: &str) -> Option<u64> {
    let text = env::var(name).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{name} is {text}, and should be a number")))
}

#[test]
fn faults_cause_no_wrong_success_no_lost_result_and_no_half_written_file() {
    let Some(shim) = build_shim() else {
        return print_line("the fault injector is SKIPPED: it needs a C compiler called `cc`");
    };
    let references = References::new();
    let cycle_count = of_environment("MENISCUS_FAULT_CYCLES").unwrap_or(200);
    let only = of_environment("MENISCUS_FAULT_SEED");
    let (first, end) = only.map_or((0, cycle_count), |seed| (seed, seed + 1));
    let (next, failures) = (AtomicU64::new(first), Mutex::new(Vec::new()));
    let (fault_count, kill_count) = (AtomicU64::new(0), AtomicU64::new(0));
    thread::scope(|scope| {
        for _ in 0..THREADS {
            scope.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, Ordering::SeqCst);
                    if seed >= end {
                        return;
                    }
                    let run = || cycle::run(seed, &shim, &references);
                    match catch_unwind(AssertUnwindSafe(run)) {
                        Ok(figures) => {
                            fault_count.fetch_add(figures.fault_count, Ordering::SeqCst);
                            kill_count.fetch_add(figures.kill_count, Ordering::SeqCst);
                        }
                        Err(_) => failures.lock().expect("no panic").push(seed),
                    }
                }
            });
        }
    });
    let mut failures = failures.into_inner().expect("no panic");
    failures.sort_unstable();
    assert!(failures.is_empty(), "MENISCUS_FAULT_SEED=N repeats one of these: {failures:?}");
    print_line(&format!("{} cycles: {fault_count:?} faults, {kill_count:?} kills", end - first));
    if only.is_none() {
        assert!(fault_count.into_inner() > cycle_count, "the shim injects too few faults");
        assert!(kill_count.into_inner() >= cycle_count / 10, "the shim kills the program too rarely");
    }
}
