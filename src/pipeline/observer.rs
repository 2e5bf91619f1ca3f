//! Notifications on frames that are under way, for progress: the stages themselves know neither clocks nor terminals.

use std::fmt;

use crate::surface::skin::MemoryPlan;

use crate::pipeline::error::Stage;
use crate::pipeline::input::frame::Frame;

/// Is notified of how frames advance, on the threads of the stages: it must be quick.
pub trait Observer: fmt::Debug + Sync {
    /// A frame was read, and this is how it will be computed. Its particles take `given_bytes` beside the plan.
    fn planned(&self, frame: &Frame, plan: &MemoryPlan, given_bytes: u64) {
        let _ = (frame, plan, given_bytes);
    }
    /// A stage of a frame begins.
    fn began(&self, frame: &Frame, stage: Stage);
    /// So much of a stage is done, from 0 to 1. Not every stage reports this.
    fn advanced(&self, frame: &Frame, stage: Stage, fraction: f64) {
        let _ = (frame, stage, fraction);
    }
}
