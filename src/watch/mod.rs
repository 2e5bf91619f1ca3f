//! Watches folders and converts the frames in them: waits until files are complete, queues them, and records
//! the results.
//!
//! ```text
//!   core         decides: state and events in, effects out; no files, clocks or threads
//!   event_loop   one thread: passes events to the core, carries out its effects, sends heartbeats
//!   io           threads that may block: one per watched folder and per folder of outputs, and the pipelines
//!   journal      the records that survive a restart
//!   status_store what users see: frames, status, counters
//!   explain      why a frame is, or is not, converted       waiting   which files are not complete
//! ```
//!
//! A file system that hangs delays only the frames of its own folder.
//!
//! The daemon may be killed at any moment. Its persistent state is an append-only journal. Even the journal
//! may be lost, because each output records what it was made from. Outputs are renamed into place when they
//! are complete.

mod api;
mod config;
mod core;
mod event_loop;
pub mod explain;
mod io;
pub mod journal;
pub mod status_store;
pub mod waiting;

pub use self::core::{completeness, decision};
pub use api::{DaemonRequest, EndReason, FailedFrame, Notice, WatchSummary};
pub use config::{Order, Poll, StabilityTimeouts, Watch, WatchConfig, names_level_sets};
pub use event_loop::run;
pub use io::error::DaemonError;
pub use io::{canonical_path, fs_events, lock, mounts, selection};
