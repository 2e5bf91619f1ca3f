//! Progress notifications for frames in flight: the stages themselves use neither clocks nor terminals.

use std::fmt;

use crate::surface::reconstruction::MemoryPlan;

use crate::pipeline::error::Stage;
use crate::pipeline::input::frame::Frame;

/// Receives the progress of frames. The calls come from the threads of the stages, so they must return
/// quickly.
pub trait Observer: fmt::Debug + Sync {
    /// A frame was read, and `plan` is its memory plan. Its input takes `given_bytes` in addition.
    fn planned(&self, frame: &Frame, plan: &MemoryPlan, given_bytes: u64) {
        let _ = (frame, plan, given_bytes);
    }
    /// A stage of a frame begins.
    fn began(&self, frame: &Frame, stage: Stage);
    /// The progress of a stage, from 0 to 1. Not every stage reports it.
    fn advanced(&self, frame: &Frame, stage: Stage, fraction: f64) {
        let _ = (frame, stage, fraction);
    }
}
