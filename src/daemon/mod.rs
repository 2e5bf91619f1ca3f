//! Folders to frames: watches, settles, queues, remembers.

mod config;
mod journal;

pub use config::{Config, Order, Patience, Poll, Watch};
pub use journal::{
    DaemonRecord, DaemonState, FrameRecord, Journal, OutputRecord, STATE_FOLDER, SequenceKey, SequenceRecord,
    Standing, State,
};
