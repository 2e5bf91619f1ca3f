//! Opens the folders, and starts the workers.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::time::Instant;

use crossbeam::channel::Sender;

use crate::pipeline::{DaemonRecord, DaemonState, ObstacleFiles, canonical_path, host_name, now_ms};
use crate::watch::config::WatchConfig;
use crate::watch::core::events::{Event, Now, OutputRequest, RootRequest, SlowRequest};
use crate::watch::core::state::Core;
use crate::watch::status_store::StatusStore;

use super::error::DaemonError;
use super::file_system::free_bytes;
use super::output_folder::{OutputGuard, open_outputs};
use super::pipeline::PipelineContext;
use super::root::Root;
use super::selection::FileFilter;
use super::slow;
use super::worker::spawn;

/// The threads that do I/O. They end when `Workers` is dropped.
pub(crate) struct Workers {
    pub(crate) roots: Vec<Sender<RootRequest>>,
    pub(crate) slow: Sender<SlowRequest>,
    pub(crate) outputs: Vec<Sender<OutputRequest>>,
    /// The guards that the workers hold; all gone once the workers have ended.
    pub(crate) guards: Vec<Weak<OutputGuard>>,
    /// Stops the slow thread, also within a file.
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
pub(crate) fn start_workers(
    config: &Arc<WatchConfig>,
    store: Option<Arc<StatusStore>>,
    events: &Sender<Event>,
) -> Result<(Core, Workers, PipelineContext), DaemonError> {
    let (output_workers, output_folder_of) = open_outputs(config)?;
    let guards: Vec<Arc<OutputGuard>> =
        output_workers.iter().map(|output| Arc::clone(output.guard())).collect();
    let output_folders: Vec<_> = guards.iter().map(|guard| guard.folder.clone()).collect();
    let obstacles = config.watches.iter().map(|watch| ObstacleFiles::new(watch.obstacles.clone()));
    let obstacles: Vec<Arc<ObstacleFiles>> = obstacles.map(Arc::new).collect();
    let mut inputs = Vec::new();
    for watch in &config.watches {
        let path = canonical_path(&watch.input);
        let filter = FileFilter::new(watch.pattern.as_deref(), output_folders.clone());
        inputs.push((path, filter.map_err(DaemonError::Pattern)?));
    }
    let records = guards
        .iter()
        .map(|guard| (guard.folder.clone(), guard.records.latest(), free_bytes(&guard.folder).ok()));
    let roots =
        inputs.iter().zip(&obstacles).map(|((path, _), obstacles)| (path.clone(), Arc::clone(obstacles)));
    let mut core = Core::new(
        Arc::clone(config),
        identity(),
        roots.collect(),
        records.collect(),
        output_folder_of.clone(),
        now(),
    );
    core.claim_recorded(|root, file| {
        let (folder, filter) = &inputs[root];
        filter.takes(folder, file)
    });
    let guards_of_roots = output_folder_of.iter().map(|&output| Arc::clone(&guards[output])).collect();
    let context = PipelineContext {
        config: Arc::clone(config),
        store,
        outputs: Arc::new(guards_of_roots),
        events: events.clone(),
    };
    let is_over = Arc::<AtomicBool>::default();
    let slow =
        slow::spawn(config.threads, Arc::clone(&is_over), events.clone()).map_err(DaemonError::Threads)?;
    let mut workers = Workers {
        roots: Vec::new(),
        slow,
        outputs: Vec::new(),
        guards: guards.iter().map(Arc::downgrade).collect(),
        is_over,
    };
    for (index, output) in output_workers.into_iter().enumerate() {
        let sender = spawn(&format!("output {index}"), output, None, events.clone());
        workers.outputs.push(sender.map_err(DaemonError::Threads)?);
    }
    for (index, (path, filter)) in inputs.into_iter().enumerate() {
        let guard = Arc::clone(&guards[output_folder_of[index]]);
        // Of all roots: an output must not replace an obstacle of another one.
        let (root, fs_events) = Root::new(index, path, filter, config, obstacles.clone(), guard);
        let sender = spawn(&format!("root {index}"), root, fs_events, events.clone());
        workers.roots.push(sender.map_err(DaemonError::Threads)?);
    }
    Ok((core, workers, context))
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
