//! Folders to frames: watches, settles, queues, remembers.

mod config;
pub mod mounts;
pub mod readiness;
pub mod scan;
pub mod selection;
pub mod watcher;

pub use config::{Config, Order, Patience, Poll, Watch};
