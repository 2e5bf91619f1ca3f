//! All code that may block: files, folders, the records on disk, and the pipeline.
//!
//! ```text
//!   start          starts the threads
//!   root           a watched folder: scans, events, inspections
//!   output_folder  a folder of outputs: records, lock, free space
//!   worker         the thread of either
//!   usd_stages     the USD stages of a folder of outputs
//!   slow           measuring, finding steps
//!   pipeline       converts frames
//!   writers, scan, selection, fs_events, file_system, lock   what the workers call
//! ```

pub(crate) mod error;
mod file_system;
mod fs_events;
pub mod lock;
mod output_folder;
pub(crate) mod pipeline;
mod root;
mod scan;
pub mod selection;
mod slow;
pub(crate) mod start;
mod usd_stages;
pub(crate) mod worker;
#[cfg(target_os = "linux")]
mod writers;
