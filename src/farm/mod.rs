//! Frames dealt to machines that share nothing but folders.
//!
//! ```text
//!                         ┌─▶ shard 0   frames 0 1 2   ─┐
//!   inputs ──▶ plan.json ─┼─▶ shard 1   frames 3 4 5   ─┼─▶ one folder ──▶ verify
//!                         └─▶ shard 2   frames 6 7     ─┘
//! ```
//!
//! What all frames of a sequence share (the voxel size, the camera of pictures) is found out once, and stands in the plan:
//! so any number of shards makes the bytes that one process makes. Shards have no journal and no lock in common. What is done is
//! seen from the outputs themselves ([`crate::pipeline::inspect`]); outputs appear by rename, whole; and whoever makes a frame
//! makes the same bytes. So a shard may be killed and run again, or twice at the same time, and a plan may be run by
//! any scheduler that can count.
//!
//! A plan is read as strictly as any file: it names what to read, and its outputs lie in one folder.

mod dealing;
mod plan;
mod plan_file;
mod verdict;

pub use dealing::{SHARDS_MAX, deal};
pub use plan::{PlannedFrame, PlannedSequence, ShardPlan};
pub use plan_file::{PlanError, parse};
pub use verdict::{FrameVerdict, VerdictRecord, Verdicts, verify};
