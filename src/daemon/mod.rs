//! Folders to frames: watches, settles, queues, remembers.

mod config;
mod decision;
mod journal;
mod lock;

pub use config::{Config, Order, Patience, Poll, Watch};
pub use decision::{ConvertReason, Decision, SkipReason, decide, decide_by_content};
pub use journal::{
    DaemonRecord, DaemonState, FrameRecord, Journal, OutputRecord, STATE_FOLDER, SequenceKey, SequenceRecord,
    Standing, State,
};
pub use lock::{LockError, OutputLock, host_name};
