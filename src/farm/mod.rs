//! Distributes frames over machines that share only folders.
//!
//! ```text
//!                         ┌─▶ shard 0   frames 0 1 2   ─┐
//!   inputs ──▶ plan.json ─┼─▶ shard 1   frames 3 4 5   ─┼─▶ one folder ──▶ verify
//!                         └─▶ shard 2   frames 6 7     ─┘
//! ```
//!
//! The plan contains all values that are computed once for a sequence (the voxel size, the camera of
//! pictures), so any number of shards writes the same bytes as a single process. Shards share neither a
//! journal nor a lock. A shard finds out from the outputs themselves which frames are done
//! ([`crate::pipeline::inspect`]): outputs appear by rename, complete, and every shard writes the same bytes
//! for a frame. So a shard may be killed and run again, or run twice at the same time, and any scheduler that
//! can count can run a plan.
//!
//! Plans are parsed as strictly as any input: a plan names the files to read, and all outputs are in one
//! folder.

mod partition;
mod plan;
mod plan_file;
mod verification;

pub use partition::{SHARDS_MAX, partition};
pub use plan::{PlannedFrame, PlannedSequence, ShardPlan};
pub use plan_file::{PlanError, parse};
pub use verification::{FrameCheck, PlanVerification, VerificationReport, verify};
