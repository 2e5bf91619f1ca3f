//! Watches folders and converts the frames in them: waits until files are complete, queues them, and records
//! the results.
//!
//! ```text
//!   core         decides: state and events in, effects out; no files, clocks or threads
//!   event_loop   one thread: passes events to the core, carries out its effects, sends heartbeats
//!   io           threads that may block: one per watched folder and per folder of outputs, and the pipeline
//!   journal      the records that survive a restart
//!   reason       why a frame is in its state
//!   status_store what users see: frames, status, counters
//! ```
//!
//! While a file system hangs, frames wait, also those of other folders; the event loop continues.
//!
//! The daemon may be killed at any moment. Its persistent state is an append-only journal. Even the journal
//! may be lost, because each output records what it was made from. Outputs are renamed into place when they
//! are complete.

mod api;
mod config;
mod core;
mod event_loop;
mod io;
pub mod journal;
mod reason;
pub mod status_store;

pub use api::{EndReason, FailedFrame, Notice, WatchSummary};
pub use config::{Order, Poll, Watch, WatchConfig, names_level_sets};
pub use event_loop::{STOP_DEADLINE, run};
pub use io::error::DaemonError;
pub use io::{lock, selection};
pub use reason::Reason;
