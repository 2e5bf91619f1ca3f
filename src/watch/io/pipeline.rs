//! The pipeline: threads that convert the frames that the core gives them.

use std::io;
use std::sync::Arc;
use std::thread;

use crossbeam::channel::{Receiver, Sender, bounded};
use rayon::ThreadPoolBuilder;

use crate::pipeline::{
    Frame, IndexPolicy, Observer, OnError, Outcome, PipelineOptions, Stage, default_in_flight,
    named_by_unreadable, stream,
};
use crate::watch::config::WatchConfig;
use crate::watch::core::events::{Event, FrameFinished, FrameToConvert};
use crate::watch::status_store::StatusStore;

use super::file_system::free_bytes;
use super::output_folder::OutputGuard;

/// What the pipeline needs.
#[derive(Clone)]
pub(crate) struct PipelineContext {
    pub(crate) config: Arc<WatchConfig>,
    pub(crate) store: Option<Arc<StatusStore>>,
    /// For each root, the guard of its folder of outputs.
    pub(crate) outputs: Arc<Vec<Arc<OutputGuard>>>,
    pub(crate) events: Sender<Event>,
}

/// Starts the pipeline. It requests frames by [`Event::FrameRequested`], and ends when the returned sender is
/// dropped.
///
/// # Errors
/// When the system refuses to start a thread.
pub(crate) fn start_pipeline(context: PipelineContext) -> io::Result<Sender<FrameToConvert>> {
    let pool = ThreadPoolBuilder::new()
        .num_threads(context.config.threads)
        .thread_name(|index| format!("compute {index}"))
        .build()
        .map_err(io::Error::other)?;
    let (sender, frames) = bounded(1);
    thread::Builder::new().name("pipeline".into()).spawn(move || {
        // However the pipeline ends, the core must be notified.
        let _ended = PipelineEnded(context.events.clone());
        run(&pool, &frames, &context);
    })?;
    Ok(sender)
}

struct PipelineEnded(Sender<Event>);

impl Drop for PipelineEnded {
    fn drop(&mut self) {
        // Fails only if the daemon has already ended.
        let _ = self.0.send(Event::PipelineEnded);
    }
}

fn run(
    pool: &rayon::ThreadPool,
    frames: &Receiver<FrameToConvert>,
    PipelineContext { config, store, outputs, events }: &PipelineContext,
) {
    let options = PipelineOptions {
        pool,
        on_error: OnError::Continue,
        skip_done: true,
        in_flight: default_in_flight(config.threads),
        memory_bytes: config.memory_bytes,
        // A separate thread searches files for steps.
        index_policy: IndexPolicy::External,
        observer: store.as_ref().map(|store| &**store as &dyn Observer),
    };
    let next = || {
        events.send(Event::FrameRequested).ok()?;
        let FrameToConvert { id, mut frame } = frames.recv().ok()?;
        frame.records = Some(Arc::clone(&outputs[id.root].records));
        Some((id, *frame))
    };
    stream(next, &options, |id, _, outcome| {
        let free_bytes = free_bytes(&outputs[id.root].folder).ok();
        let named = match &outcome {
            Outcome::Failed(error) if error.during == Stage::Read => named_by_unreadable(&id.path),
            _ => None,
        };
        // Fails only if the daemon has already ended.
        let _ = events.send(Event::FrameFinished(Box::new(FrameFinished { id, outcome, free_bytes, named })));
    });
}

impl Observer for StatusStore {
    fn began(&self, frame: &Frame, stage: Stage) {
        self.stage_began(&frame.outputs.folder.join(&frame.stem), stage);
    }
}
