//! All code that may block: files, folders, mounts, the journal on disk, and the pipelines.
//!
//! ```text
//!   root         a watched folder: scans, events, inspections     slow         measuring, finding steps
//!   output_dir   a folder of outputs: journal, lock, free space   pipeline     converts frames
//!   worker       the thread of either, and its stall detection
//!   stages       the stages of a folder of outputs
//!   inspect, evidence, writers, scan, selection, fs_events, mounts, lock, canonical_path   what the workers call
//! ```

pub mod canonical_path;
pub(crate) mod error;
pub(crate) mod evidence;
pub mod fs_events;
pub(crate) mod inspect;
pub mod lock;
mod measure;
pub mod mounts;
mod output_dir;
pub(crate) mod pipeline;
mod rescan_backoff;
mod root;
pub(crate) mod scan;
pub mod selection;
mod slow;
mod stages;
pub(crate) mod start;
pub(crate) mod worker;
#[cfg(target_os = "linux")]
mod writers;
