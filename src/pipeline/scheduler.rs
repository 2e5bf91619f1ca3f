//! Schedules the tasks of frames on the threads of a pool: the earliest frame comes first.
//!
//! Each stage of each frame is a task. An idle thread of the pool takes the waiting task of the earliest
//! frame; only if none waits, it helps with the loops of running tasks. So with many frames each thread has a
//! separate frame, and with one frame all threads share it.
//!
//! ```text
//!   queue        8 smooth   9 parse              waiting, earliest frame first
//!                   ▼
//!   threads      7 smooth   6 contour   6 ┄┄     running; the third helps the second
//! ```
//!
//! `ThreadPool::install` for each stage would not be enough. While a thread waits for a part of its loop that
//! another thread has stolen, rayon makes it run other jobs. The thread would start a stage of another frame
//! on top of its own stack, and within that stage yet another. That way, the first of 10 frames on 2 threads
//! sometimes finished last. Here, a thread within a task takes no second task.

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

/// Assigns tasks to the threads of a pool.
#[derive(Clone, Copy)]
pub(super) struct Scheduler<'a, 'scope, 'env> {
    scope: &'a Scope<'scope>,
    tasks: &'scope TaskQueue<'env>,
}

struct Task<'env> {
    order: usize,
    work: Box<dyn FnOnce() + Send + 'env>,
}

impl<'a, 'scope, 'env: 'scope> Scheduler<'a, 'scope, 'env> {
    /// A scheduler that runs the tasks of this queue on the threads of the scope's pool.
    pub(super) fn new(
        scope: &'a Scope<'scope>,
        tasks: &'scope TaskQueue<'env>,
    ) -> Scheduler<'a, 'scope, 'env> {
        Scheduler { scope, tasks }
    }

    /// Queues a frame's work for one of the threads. The work must not panic.
    pub(super) fn spawn(&self, order: usize, work: impl FnOnce() + Send + 'env) {
        self.tasks.waiting().push(Task { order, work: Box::new(work) });
        call(self.scope, self.tasks);
    }

    /// Runs a frame's work on one of the threads, and waits for it. Propagates a panic.
    pub(super) fn run<R: Send + 'env>(&self, order: usize, work: impl FnOnce() -> R + Send + 'env) -> R {
        let (done, result) = bounded(1);
        self.spawn(order, move || {
            // The receiver waits below.
            let _ = done.send(catch_unwind(AssertUnwindSafe(work)));
        });
        match result.recv().expect("each task is run") {
            Ok(result) => result,
            Err(payload) => resume_unwind(payload),
        }
    }
}

/// Makes every thread of the pool check the queue as soon as the thread is idle.
fn call<'scope, 'env: 'scope>(scope: &Scope<'scope>, tasks: &'scope TaskQueue<'env>) {
    scope.spawn_broadcast(|scope, _| run_next(scope, tasks));
}

thread_local! {
    /// The address of the task queue whose task this thread is running; zero if it is running none.
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
    // Threads that were woken within a task did not check the queue. This thread must not run a second task
    // here: it may have interrupted a part of another frame's loop to run this task, and that frame waits for
    // the part.
    if !tasks.waiting().is_empty() {
        call(scope, tasks);
    }
}

impl<'env> TaskQueue<'env> {
    /// Each update is a single push or pop, so a heap whose lock is poisoned is still consistent.
    fn waiting(&self) -> MutexGuard<'_, BinaryHeap<Task<'env>>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The greatest task is the next one: that of the earliest frame.
impl Ord for Task<'_> {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        Reverse(self.order).cmp(&Reverse(other.order))
    }
}

impl PartialOrd for Task<'_> {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Task<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.order == other.order
    }
}

impl Eq for Task<'_> {}
