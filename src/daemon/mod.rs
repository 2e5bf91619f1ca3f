//! Folders to frames: watches, settles, queues, remembers.

mod config;

pub use config::{Config, Order, Patience, Poll, Watch};
