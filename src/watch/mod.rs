//! Watches folders and converts the frames in them: waits until files are complete, queues them, and records
//! the results.
//!
//! ```text
//!   core         decides: state and events in, effects out; no files, clocks or threads
//!   event_loop   one thread: passes events to the core, carries out its effects
//!   io           threads that may block: one per watched folder and per folder of outputs, one for slow
//!                requests, and the pipeline
//!   status_store what users see: frames, status, counters
//! ```
//!
//! The daemon may be killed at any moment. What it remembers is in the records of the folder of outputs
//! (`FrameRecords`), which may be lost: then frames are converted again. Outputs are renamed into place when they
//! are complete.

mod api;
mod config;
mod core;
mod event_loop;
mod io;
pub mod status_store;
#[cfg(test)]
pub(crate) mod test_records;

pub use api::{EndReason, FailedFrame, Notice, WatchSummary};
pub use config::{Order, Poll, Watch, WatchConfig, names_level_sets};
pub use event_loop::run;
pub use io::error::DaemonError;
pub use io::{lock, selection};
