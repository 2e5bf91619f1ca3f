//! Which task a thread of the pool does next: that of the earliest frame.
//!
//! Each stage of each frame is a task. A thread of the pool that has nothing to do takes the waiting task of
//! the earliest frame; only when none waits does it help with the loops of those that are running. So with
//! many frames each thread has its own, and with one frame they share it.
//!
//! ```text
//!   queue        8 smooth   9 parse              waiting, the earliest frame first
//!                   ▼
//!   threads      7 smooth   6 contour   6 ┄┄     at work; the third helps the second
//! ```
//!
//! `ThreadPool::install` for each stage would not do. A thread that waits for a piece of its
//! frame's loop, which another has taken, looks for something else meanwhile, and would begin with another
//! frame's stage on top of its own; in that, with yet another. Of 10 frames on 2 threads the first was so
//! finished last, now and then. Here a thread that is within a task takes no second one.

use std::cell::Cell;
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Mutex, MutexGuard, PoisonError};

use crossbeam::channel::bounded;
use rayon::Scope;

/// The tasks that wait for a thread.
#[derive(Default)]
pub(super) struct TaskQueue<'env> {
    waiting: Mutex<BinaryHeap<Task<'env>>>,
}

/// Gives tasks to the threads of a pool.
#[derive(Clone, Copy)]
pub(super) struct Scheduler<'a, 'scope, 'env> {
    scope: &'a Scope<'scope>,
    tasks: &'scope TaskQueue<'env>,
}

struct Task<'env> {
    frame_number: usize,
    work: Box<dyn FnOnce() + Send + 'env>,
}

impl<'a, 'scope, 'env: 'scope> Scheduler<'a, 'scope, 'env> {
    /// The threads of the scope's pool.
    pub(super) fn new(
        scope: &'a Scope<'scope>,
        tasks: &'scope TaskQueue<'env>,
    ) -> Scheduler<'a, 'scope, 'env> {
        Scheduler { scope, tasks }
    }

    /// Queues a frame's work for one of the threads. The work must not panic.
    pub(super) fn spawn(&self, frame_number: usize, work: impl FnOnce() + Send + 'env) {
        self.tasks.waiting().push(Task { frame_number, work: Box::new(work) });
        call(self.scope, self.tasks);
    }

    /// Does a frame's work on one of the threads, and waits for it. A panic comes back as one.
    pub(super) fn run<R: Send + 'env>(
        &self,
        frame_number: usize,
        work: impl FnOnce() -> R + Send + 'env,
    ) -> R {
        let (done, result) = bounded(1);
        self.spawn(frame_number, move || {
            // It waits below.
            let _ = done.send(catch_unwind(AssertUnwindSafe(work)));
        });
        match result.recv().expect("each task is run") {
            Ok(result) => result,
            Err(payload) => resume_unwind(payload),
        }
    }
}

/// Lets every thread have a look at the tasks as soon as it has nothing else to do.
fn call<'scope, 'env: 'scope>(scope: &Scope<'scope>, tasks: &'scope TaskQueue<'env>) {
    scope.spawn_broadcast(|scope, _| run_next(scope, tasks));
}

thread_local! {
    /// Which tasks this thread is within one of: their address, or zero.
    static WITHIN: Cell<usize> = const { Cell::new(0) };
}

fn run_next<'scope, 'env: 'scope>(scope: &Scope<'scope>, tasks: &'scope TaskQueue<'env>) {
    let own = std::ptr::from_ref(tasks).addr();
    if WITHIN.get() == own {
        return;
    }
    let Some(task) = tasks.waiting().pop() else { return };
    let outer = WITHIN.replace(own);
    (task.work)();
    WITHIN.set(outer);
    // Those that were called while they were within a task have not looked. And not a second one here: this
    // may be a thread that only helps a frame, which waits for it.
    if !tasks.waiting().is_empty() {
        call(scope, tasks);
    }
}

impl<'env> TaskQueue<'env> {
    /// A heap is in order whatever panicked beside it.
    fn waiting(&self) -> MutexGuard<'_, BinaryHeap<Task<'env>>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The greatest task is the one to do next: that of the earliest frame.
impl Ord for Task<'_> {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        Reverse(self.frame_number).cmp(&Reverse(other.frame_number))
    }
}

impl PartialOrd for Task<'_> {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Task<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.frame_number == other.frame_number
    }
}

impl Eq for Task<'_> {}
