//! Opens the folders, and starts the workers.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::time::Instant;

use crossbeam::channel::Sender;

use crate::pipeline::{DaemonRecord, DaemonState, ObstacleFiles, canonical_path, host_name, now_ms};
use crate::watch::config::WatchConfig;
use crate::watch::core::events::{Event, Now, OutputRequest, RootRequest, SlowRequest, Worker};
use crate::watch::core::state::Core;
use crate::watch::status_store::StatusStore;

use super::error::DaemonError;
use super::output_folder::{OutputGuard, open_outputs};
use super::pipeline::PipelineContext;
use super::root::Root;
use super::selection::FileFilter;
use super::slow;
use super::worker::{Heartbeat, StallMonitor, spawn};

/// The threads that do I/O. They end when `Workers` is dropped. A thread that hangs ends as soon as its file
/// system answers.
pub(crate) struct Workers {
    pub(crate) roots: Vec<Sender<RootRequest>>,
    pub(crate) slow: Sender<SlowRequest>,
    pub(crate) outputs: Vec<Sender<OutputRequest>>,
    pub(crate) monitors: Vec<StallMonitor>,
    /// The guards that the workers hold; all gone once the workers have ended.
    pub(crate) guards: Vec<Weak<OutputGuard>>,
    pub(crate) is_over: Arc<AtomicBool>,
}

impl Drop for Workers {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
    }
}

/// Opens all folders of outputs, and starts all workers. Also returns the core, which starts with the records,
/// and the context of the pipeline.
///
/// # Errors
/// When a folder of outputs cannot be opened, a pattern is invalid, or the system refuses to start a thread.
pub(crate) fn start(
    config: &Arc<WatchConfig>,
    store: Option<Arc<StatusStore>>,
    events: &Sender<Event>,
) -> Result<(Core, Workers, PipelineContext), DaemonError> {
    let (outputs, output_folder_of) = open_outputs(config)?;
    let guards: Vec<Arc<OutputGuard>> = outputs.iter().map(|output| Arc::clone(output.guard())).collect();
    let folders: Vec<_> = guards.iter().map(|guard| guard.folder.clone()).collect();
    let obstacles = config.watches.iter().map(|watch| ObstacleFiles::new(watch.obstacles.clone()));
    let obstacles: Vec<Arc<ObstacleFiles>> = obstacles.map(Arc::new).collect();
    let mut paths = Vec::new();
    for watch in &config.watches {
        let path = canonical_path(&watch.input);
        let selection = FileFilter::new(watch.pattern.as_deref(), folders.clone());
        paths.push((path, selection.map_err(DaemonError::Pattern)?));
    }
    let recorded = guards.iter().map(|guard| (guard.folder.clone(), guard.records.recorded()));
    let roots =
        paths.iter().zip(&obstacles).map(|((path, _), obstacles)| (path.clone(), Arc::clone(obstacles)));
    let mut core = Core::new(
        Arc::clone(config),
        identity(),
        roots.collect(),
        recorded.collect(),
        output_folder_of.clone(),
        now(),
    );
    core.claim_recorded(|root, file| {
        let (folder, selection) = &paths[root];
        selection.takes(folder, file)
    });
    let output_folders_of_roots =
        output_folder_of.iter().map(|&output| (output, Arc::clone(&guards[output]))).collect();
    let context = PipelineContext {
        config: Arc::clone(config),
        store,
        outputs: Arc::new(output_folders_of_roots),
        events: events.clone(),
    };
    let failed = |error: std::io::Error| DaemonError::Threads(error.to_string());
    let is_over = Arc::<AtomicBool>::default();
    let slow = slow::spawn(config.threads, Arc::clone(&is_over), events.clone()).map_err(failed)?;
    let mut workers = Workers {
        roots: Vec::new(),
        slow,
        outputs: Vec::new(),
        monitors: Vec::new(),
        guards: guards.iter().map(Arc::downgrade).collect(),
        is_over,
    };
    for (index, output) in outputs.into_iter().enumerate() {
        let heartbeat = workers.monitor(Worker::Output(index));
        let sender = spawn(&format!("output {index}"), output, None, heartbeat, events.clone());
        workers.outputs.push(sender.map_err(failed)?);
    }
    for (index, (path, selection)) in paths.into_iter().enumerate() {
        let heartbeat = workers.monitor(Worker::Root(index));
        let guard = Arc::clone(&guards[output_folder_of[index]]);
        let (obstacles, beats) = (obstacles.clone(), heartbeat.clone());
        let (root, fs_events) = Root::new(index, path, selection, config, obstacles, guard, beats);
        let sender = spawn(&format!("root {index}"), root, fs_events, heartbeat, events.clone());
        workers.roots.push(sender.map_err(failed)?);
    }
    Ok((core, workers, context))
}

impl Workers {
    /// The heartbeat of a worker, which is monitored from now on.
    pub(crate) fn monitor(&mut self, worker: Worker) -> Heartbeat {
        let heartbeat = Heartbeat::default();
        self.monitors.push(StallMonitor::new(worker, heartbeat.clone(), Instant::now()));
        heartbeat
    }
}

/// Identifies this daemon.
fn identity() -> DaemonRecord {
    DaemonRecord {
        pid: std::process::id(),
        host: host_name(),
        started_ms: now_ms(),
        state: DaemonState::Running,
        at_ms: now_ms(),
    }
}

/// The current time.
pub(crate) fn now() -> Now {
    Now { at: Instant::now(), unix_ms: now_ms() }
}
