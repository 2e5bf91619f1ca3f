//! Folders to frames: watches, waits until files are complete, queues, remembers.
//!
//! ```text
//!   core         decides: state and events in, effects out; no files, clocks or threads
//!   event_loop   one thread: hands events to the core, carries out its effects, gives signs of life
//!   io           threads that may block: one for each watched folder and each folder of outputs, and the pipelines
//!   journal      what is known after a restart
//!   status_store what users see: frames, status, counters
//!   explain      why a frame is, or is not, converted       waiting   which files are not complete
//! ```
//!
//! A file system that hangs holds up the frames of its own folder, and nothing else.
//!
//! What is remembered is an append-only journal that may be lost, for the outputs say themselves what
//! they were made from; what is written appears by rename. So a daemon may be killed at any moment.

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
pub use config::{Order, Patience, Poll, Watch, WatchConfig, names_level_sets};
pub use event_loop::run;
pub use io::error::DaemonError;
pub use io::{canonical_path as place, fs_events, lock, mounts, selection};
