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
//! journal nor a lock. Instead, a shard inspects the outputs to find out which frames are done
//! ([`crate::pipeline::inspect`]). An output appears complete, by a rename, and every shard writes the same
//! bytes for a frame. So a shard may be killed and run again, or run twice at the same time. A scheduler only
//! has to start one job for each shard number.
//!
//! A plan is not trusted: it names the files to read, so it is parsed as strictly as any input, and all
//! outputs must be in one folder.

mod partition;
mod plan;
mod plan_file;
mod verification;

pub use partition::{SHARDS_MAX, partition};
pub use plan::{PlannedFrame, PlannedSequence, ShardPlan};
pub use plan_file::{PlanError, parse};
pub use verification::{FrameCheck, PlanVerification, VerificationReport, verify};
