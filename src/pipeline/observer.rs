//! Progress notifications for frames in flight: the stages themselves know neither clocks nor terminals.

use std::fmt;

use crate::surface::reconstruction::MemoryPlan;

use crate::pipeline::error::Stage;
use crate::pipeline::input::frame::Frame;

/// Receives the progress of frames, on the threads of the stages: it must return quickly.
pub trait Observer: fmt::Debug + Sync {
    /// A frame was read, and has this plan. Its particles take `given_bytes` in addition.
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
