//! Frames that arrive one by one: when the pipeline requests them, which of them run concurrently, and when
//! the pipeline reports them.

use std::collections::HashMap;
use std::fs::{self, File};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, mpsc};
use std::thread;
use std::time::{Duration, SystemTime};

use meniscus::pipeline::{
    Frame, FrameError, Observer, OnError, Outcome, PipelineOptions, Stage, default_in_flight, is_own_output,
    run, stream,
};
use meniscus::surface::options::{MethodOptions, Settings};
use meniscus::surface::reconstruction::MemoryPlan;
use rayon::ThreadPool;
use rayon::prelude::*;

use crate::program::pipeline::{Bench, OnStage, count_of, letters, pipeline_options};
use crate::program::scene::names_in;

/// A signal that threads wait for, with a time limit, so that a test fails instead of hanging.
#[derive(Debug, Default)]
struct Signal {
    is_given: Mutex<bool>,
    changed: Condvar,
}

impl Signal {
    fn give(&self) {
        *self.is_given.lock().expect("not poisoned") = true;
        self.changed.notify_all();
    }

    fn wait(&self) {
        assert!(self.is_given_within(Duration::from_secs(300)), "waited in vain");
    }

    fn is_given_within(&self, limit: Duration) -> bool {
        let given = self.is_given.lock().expect("not poisoned");
        let (given, _) = self.changed.wait_timeout_while(given, limit, |given| !*given).expect("as above");
        *given
    }
}

/// Tries a scene in which stages wait for other frames, up to [`LIMIT`], until it succeeds.
///
/// A try may fail, rarely: a thread that helps with the loop of one frame may start a stage of another inside
/// it, and then these two wait for each other.
fn succeeds(scene: impl Fn() -> bool) {
    assert!((0..5).any(|_| scene()), "no try succeeded");
}

/// How long a stage of such a scene waits.
const LIMIT: Duration = Duration::from_secs(20);

fn pool(threads: usize) -> ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads")
}

/// The frames of a bench by their numbers.
fn numbered(bench: &Bench) -> impl Iterator<Item = (usize, Frame)> + Send + use<> {
    bench.frames.clone().into_iter().enumerate()
}

#[test]
fn source_may_wait_for_results_of_earlier_frames() {
    let bench = Bench::new(&[2, 2, 2, 2]);
    let (finished, notified) = mpsc::channel();
    let mut frames = numbered(&bench);
    let mut outcomes = Vec::new();
    let next = move || {
        let (number, frame) = frames.next()?;
        // All frames that were requested before are finished.
        for _ in 0..number.min(1) {
            notified.recv_timeout(Duration::from_secs(300)).expect("the frame before is finished");
        }
        Some((number, frame))
    };
    stream(next, &pipeline_options(&pool(2)), |number, frame, outcome| {
        assert_eq!(frame.stem, format!("f.{number}"));
        outcomes.push(outcome);
        let _ = finished.send(());
    });
    assert_eq!(letters(&outcomes), "cccc");
    assert_eq!(bench.written(), [0, 1, 2, 3]);
}

#[test]
fn frames_are_requested_only_when_there_is_room() {
    for in_flight in [1, 2, 3, 7] {
        let bench = Bench::new(&[2; 20]);
        let pool = pool(2);
        let (requested, ended) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let full = Signal::default();
        let mut frames = numbered(&bench);
        let mut running_count_max = 0;
        let next = || {
            let running_count = requested.fetch_add(1, Ordering::SeqCst) - ended.load(Ordering::SeqCst);
            assert!(running_count < in_flight, "{running_count} frames are in flight");
            running_count_max = running_count_max.max(running_count + 1);
            if running_count + 1 == in_flight.min(3) {
                full.give();
            }
            frames.next()
        };
        // At least this many frames are requested before one has ended: one for each lane, and one that is
        // read.
        let observer = OnStage(|stage, _| {
            if stage == Stage::Rasterize {
                full.wait()
            }
        });
        let options = PipelineOptions { in_flight, observer: Some(&observer), ..pipeline_options(&pool) };
        let mut count = 0;
        stream(next, &options, |_, _, _| {
            count += 1;
            ended.fetch_add(1, Ordering::SeqCst);
        });
        assert_eq!(count, 20);
        assert!(running_count_max >= in_flight.min(3), "{running_count_max} of {in_flight}");
    }
    assert!(default_in_flight(1) > 1 && default_in_flight(16) > 16);
}

#[test]
fn slow_frame_is_overtaken_and_still_reported_in_order() {
    let bench = Bench::new(&[3, 2, 2]);
    let pool = pool(2);
    succeeds(|| {
        let others_ended = Signal::default();
        let waited = AtomicBool::new(true);
        let observer = OnStage(|stage, count| {
            if stage == Stage::Smooth && count == 27 {
                waited.fetch_and(others_ended.is_given_within(LIMIT), Ordering::SeqCst);
            }
        });
        let options = PipelineOptions { observer: Some(&observer), ..pipeline_options(&pool) };
        let mut frames = numbered(&bench);
        let mut order = Vec::new();
        stream(
            || frames.next(),
            &options,
            |number, _, _| {
                order.push(number);
                if order.len() == 2 {
                    others_ended.give();
                }
            },
        );
        let mut reported = Vec::new();
        run(&bench.frames, &options, |number, _| reported.push(number));
        assert_eq!(reported, [0, 1, 2]);
        waited.load(Ordering::SeqCst) && order.last() == Some(&0)
    });
}

/// Three frames are in three stages at once: each stage waits until all three run.
#[test]
fn stages_of_different_frames_overlap() {
    for on_error in [OnError::Continue, OnError::Stop] {
        succeeds(|| {
            let bench = Bench::new(&[2, 3, 4]);
            let pool = pool(3);
            let together: [Signal; 3] = Default::default();
            let overlap = AtomicBool::new(true);
            let observer = OnStage(|stage, count| {
                let index = [(Stage::Contour, 8), (Stage::Smooth, 27), (Stage::Rasterize, 64)];
                if let Some(index) = index.iter().position(|&index| index == (stage, count)) {
                    together[index].give();
                    let all = together.iter().all(|signal| signal.is_given_within(LIMIT));
                    overlap.fetch_and(all, Ordering::SeqCst);
                }
            });
            let options = PipelineOptions { on_error, observer: Some(&observer), ..pipeline_options(&pool) };
            let mut outcomes = Vec::new();
            run(&bench.frames, &options, |_, outcome| outcomes.push(outcome));
            assert_eq!(letters(&outcomes), "ccc", "{on_error:?}");
            overlap.into_inner()
        });
    }
}

#[test]
fn slow_stage_holds_back_the_stages_before_it() {
    let bench = Bench::new(&[2; 20]);
    let pool = pool(4);
    let (requested, rasterized) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let (all_wait, go_on) = (Signal::default(), Signal::default());
    let observer = OnStage(|stage, _| match stage {
        Stage::Rasterize => {
            rasterized.fetch_add(1, Ordering::SeqCst);
        }
        Stage::Smooth => {
            all_wait.give();
            go_on.wait();
        }
        _ => {}
    });
    let options = PipelineOptions {
        in_flight: 20,
        on_error: OnError::Stop,
        observer: Some(&observer),
        ..pipeline_options(&pool)
    };
    let mut frames = numbered(&bench);
    let next = || {
        requested.fetch_add(1, Ordering::SeqCst);
        frames.next()
    };
    let mut count = 0;
    thread::scope(|scope| {
        scope.spawn(|| {
            all_wait.wait();
            thread::sleep(Duration::from_millis(300));
            // One frame is being smoothed, another waits for smoothing, and a third one has been read and
            // waits for rasterization.
            assert_eq!(rasterized.load(Ordering::SeqCst), 2);
            assert_eq!(requested.load(Ordering::SeqCst), 3);
            go_on.give();
        });
        stream(next, &options, |_, _, _| count += 1);
    });
    assert_eq!(count, 20);
}

/// The frames that compute concurrently, and the memory that they need.
#[derive(Debug, Default)]
struct Together {
    /// The needs of frames, in bytes, by the paths of their inputs.
    planned: Mutex<HashMap<PathBuf, u64>>,
    running: Mutex<Vec<PathBuf>>,
    /// Sums of needs, with the number of frames in each.
    seen: Mutex<Vec<(u64, usize)>>,
    /// Two frames compute.
    two: Signal,
    /// A small frame waits for a second one to compute.
    waits_for_two: bool,
}

impl Observer for Together {
    fn planned(&self, frame: &Frame, plan: &MemoryPlan, given_bytes: u64) {
        let needed_bytes = plan.memory_bytes + given_bytes;
        self.planned.lock().expect("not poisoned").insert(frame.input.clone(), needed_bytes);
    }

    fn began(&self, frame: &Frame, stage: Stage) {
        let mut running = self.running.lock().expect("not poisoned");
        match stage {
            Stage::Rasterize => {
                running.push(frame.input.clone());
                let planned = self.planned.lock().expect("not poisoned");
                let sum = running.iter().map(|input| planned[input]).sum();
                self.seen.lock().expect("not poisoned").push((sum, running.len()));
            }
            Stage::Contour => running.retain(|input| *input != frame.input),
            _ => return,
        }
        let is_concurrent = running.len() > 1;
        drop(running);
        if is_concurrent {
            self.two.give();
        } else if self.waits_for_two && stage == Stage::Rasterize && count_of(frame) == 512 {
            // The second and the third frame fit together.
            self.two.is_given_within(LIMIT);
        }
    }
}

#[test]
fn concurrent_frames_stay_within_the_memory_limit() {
    // Frames of four sizes, in an order in which small frames wait behind large frames.
    let edges = [20, 8, 8, 16, 12, 12, 8, 20, 16, 16, 8, 12, 8, 8, 16, 8, 12, 12, 12, 20];
    let bench = Bench::new(&edges);
    let pool = pool(4);
    let run_within = |memory_bytes: u64, together: &Together| {
        let observer = Some(together as &dyn Observer);
        let options = PipelineOptions { memory_bytes, in_flight: 8, observer, ..pipeline_options(&pool) };
        let mut outcomes = Vec::new();
        run(&bench.frames, &options, |_, outcome| outcomes.push(outcome));
        assert_eq!(letters(&outcomes), "c".repeat(edges.len()));
    };
    let unlimited = Together::default();
    run_within(1 << 40, &unlimited);
    let planned = unlimited.planned.into_inner().expect("not poisoned");
    let least = planned.values().copied().min().expect("planned");
    let most = planned.values().copied().max().expect("planned");
    assert!(2 * least <= most, "{planned:?}");
    // The largest frames fit alone.
    let together = Together { waits_for_two: true, ..Together::default() };
    run_within(most, &together);
    let seen = together.seen.lock().expect("not poisoned");
    for &(sum, count) in &*seen {
        assert!(sum <= most, "{count} frames need {sum} of {most} bytes together: {seen:?}");
    }
    assert!(seen.contains(&(most, 1)), "{seen:?}");
    assert!(seen.iter().any(|&(_, count)| count > 1), "{seen:?}");
}

#[test]
fn file_written_during_reading_is_an_error_and_readable_later() {
    let bench = Bench::new(&[60]);
    // Large voxels, so that only reading takes long.
    let settings = Settings::paper(0.4, &MethodOptions::default()).expect("valid");
    let frame = Frame { settings: Arc::new(settings), ..bench.frames[0].clone() };
    let is_over = AtomicBool::new(false);
    let mut reported = String::new();
    thread::scope(|scope| {
        let writer = scope.spawn(|| {
            let file = File::options().write(true).open(&frame.input).expect("there");
            for second in 0.. {
                let time = SystemTime::UNIX_EPOCH + Duration::from_secs(second);
                file.set_modified(time).expect("set");
                if is_over.load(Ordering::SeqCst) {
                    return;
                }
            }
        });
        let mut writer = Some(writer);
        let mut is_last = false;
        let next = || {
            if is_last {
                return None;
            }
            // After the error, the writer no longer changes the file.
            if is_over.load(Ordering::SeqCst) {
                is_last = true;
                if let Some(writer) = writer.take() {
                    writer.join().expect("the writer ends");
                }
            }
            Some(((), frame.clone()))
        };
        let pool = pool(2);
        let options = PipelineOptions { in_flight: 1, ..pipeline_options(&pool) };
        stream(next, &options, |(), _, outcome| {
            if matches!(outcome, Outcome::Changed) {
                is_over.store(true, Ordering::SeqCst);
            }
            reported += &letters(&[outcome]);
        });
    });
    // On a busy machine, the writer sometimes does not run while the file is read, and the frame is
    // converted.
    assert!(reported.trim_start_matches('c').starts_with("xc"), "{reported}");
}

#[test]
fn nested_loops_of_two_streams_in_one_pool_end() {
    for threads in [1, 2, 3] {
        let pool = pool(threads);
        let benches = [Bench::new(&[2; 40]), Bench::new(&[3; 40])];
        // Each stage runs parallel loops whose tasks start other tasks and wait for them.
        let observer = OnStage(|stage, count| {
            if matches!(stage, Stage::Read | Stage::Write) {
                return;
            }
            let sum: usize = (0..64usize)
                .into_par_iter()
                .map(|i| (0..64usize).into_par_iter().map(|j| (i * j) % count).sum::<usize>())
                .sum();
            assert!(sum > 0);
        });
        thread::scope(|scope| {
            for bench in &benches {
                scope.spawn(|| {
                    let options = PipelineOptions { observer: Some(&observer), ..pipeline_options(&pool) };
                    let mut outcomes = Vec::new();
                    run(&bench.frames, &options, |_, outcome| outcomes.push(outcome));
                    assert_eq!(letters(&outcomes), "c".repeat(40));
                });
            }
        });
    }
}

#[test]
fn panic_of_the_caller_ends_the_stream() {
    let bench = Bench::new(&[2; 20]);
    let pool = pool(2);
    let mut frames = numbered(&bench);
    let ended = catch_unwind(AssertUnwindSafe(|| {
        stream(|| frames.next(), &pipeline_options(&pool), |_, _, _| panic!("a broken caller"));
    }));
    assert!(ended.is_err());
    assert!(names_in(&bench.out()).iter().all(|name| !name.contains("tmp")));
}

#[test]
fn full_disk_is_distinguished_from_other_errors() {
    let error = |during, code| {
        FrameError::file("f.glb".as_ref(), during, std::io::Error::from_raw_os_error(code)).is_disk_full()
    };
    // ENOSPC, EDQUOT; EIO, EACCES.
    let expected = if cfg!(target_os = "linux") { [true, true, false, false] } else { return };
    assert_eq!([28, 122, 5, 13].map(|code| error(Stage::Write, code)), expected);
    assert!(!error(Stage::Read, 28));
}

#[test]
fn outputs_are_recognized_and_frames_are_not() {
    let bench = Bench::new(&[2]);
    run(&bench.frames, &pipeline_options(&pool(1)), |_, _| ());
    let names = names_in(&bench.out());
    assert_eq!(names.len(), 4);
    for name in names {
        let path = bench.out().join(&name);
        assert!(is_own_output(&path), "{name}");
        // A truncated copy is still recognized.
        let bytes = fs::read(&path).expect("readable");
        fs::write(&path, &bytes[..bytes.len() / 2 + 500.min(bytes.len() / 2)]).expect("written");
        assert!(is_own_output(&path), "{name}");
    }
    assert!(!is_own_output(&bench.frames[0].input));
    assert!(!is_own_output(&bench.out().join("missing.ply")));
    assert!(!is_own_output(&bench.out()));
}
