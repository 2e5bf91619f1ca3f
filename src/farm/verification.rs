//! Verifies the outputs of a plan.

use std::path::Path;
use std::sync::Arc;

use rayon::prelude::*;
use serde::Serialize;

use crate::pipeline::files::json::write_json;
use crate::pipeline::{InspectedState, Inspection, ObstacleFiles, inspect, write_atomically};

use super::plan::ShardPlan;

/// The verdict on each frame of a plan.
#[derive(Clone, Debug)]
pub struct PlanVerification {
    /// In the order of the plan.
    pub frames: Vec<FrameCheck>,
}

/// The verdict on a frame.
#[derive(Clone, Debug)]
pub struct FrameCheck {
    /// The shard of the frame.
    pub shard: usize,
    /// The state of its outputs.
    pub state: InspectedState,
    /// Whether its input exists. Only then was it compared with the provenance of the outputs.
    pub input_exists: bool,
    /// Whether all its obstacles exist.
    pub obstacles_exist: bool,
}

/// Checks all bytes of every output of a plan, and the inputs that exist. Writes nothing.
pub fn verify(plan: &ShardPlan) -> PlanVerification {
    let obstacles = Arc::new(ObstacleFiles::new(plan.obstacles.clone()));
    let shards = plan.shards.par_iter().enumerate();
    let verdicts = shards.flat_map(|(shard, frames)| {
        let obstacles = Arc::clone(&obstacles);
        plan.frames[frames.clone()].par_iter().map(move |planned| {
            let Inspection { state, input_exists, obstacles_exist } =
                inspect(&plan.frame(planned, &obstacles));
            FrameCheck { shard, state, input_exists, obstacles_exist }
        })
    });
    PlanVerification { frames: verdicts.collect() }
}

impl FrameCheck {
    /// The state in one word.
    pub fn status(&self) -> &'static str {
        match self.state {
            InspectedState::Done => "done",
            InspectedState::Missing { .. } => "missing",
            InspectedState::Damaged(_) => "damaged",
            InspectedState::Stale(_) => "stale",
            InspectedState::Uncertified(_) => "uncertified",
        }
    }

    /// Why the frame is not done; `None` if it is.
    pub fn why(&self) -> Option<&str> {
        match &self.state {
            InspectedState::Done => None,
            InspectedState::Missing { why, .. }
            | InspectedState::Damaged(why)
            | InspectedState::Stale(why)
            | InspectedState::Uncertified(why) => Some(why),
        }
    }

    /// Whether its shard would convert it again.
    pub fn needs_conversion(&self) -> bool {
        !matches!(self.state, InspectedState::Done | InspectedState::Uncertified(_))
    }
}

/// All values of [`FrameCheck::status`].
const STATUSES: [&str; 5] = ["done", "missing", "damaged", "stale", "uncertified"];

impl PlanVerification {
    /// The number of frames with each status, in a fixed order.
    pub fn counts(&self) -> [(&'static str, usize); 5] {
        let count = |status| self.frames.iter().filter(|frame| frame.status() == status).count();
        STATUSES.map(|status| (status, count(status)))
    }

    /// The number of frames that are done.
    pub fn done_count(&self) -> usize {
        self.frames.iter().filter(|frame| frame.state == InspectedState::Done).count()
    }

    /// The shards that have frames to convert, in order.
    pub fn shards_to_run(&self) -> Vec<usize> {
        let open = self.frames.iter().filter(|frame| frame.needs_conversion());
        let mut shards: Vec<usize> = open.map(|frame| frame.shard).collect();
        shards.dedup();
        shards
    }

    /// The number of frames whose input is missing.
    pub fn input_missing_count(&self) -> usize {
        self.frames.iter().filter(|frame| !frame.input_exists).count()
    }

    /// The number of frames with a missing obstacle.
    pub fn obstacle_missing_count(&self) -> usize {
        self.frames.iter().filter(|frame| !frame.obstacles_exist).count()
    }
}

/// The verdicts as a JSON file.
#[derive(Debug, Serialize)]
pub struct VerificationReport<'a> {
    version: &'static str,
    plan: String,
    folder: String,
    summary: VerifySummary,
    shards_to_run: Vec<usize>,
    frames: Vec<VerifiedFrame<'a>>,
}

#[derive(Debug, Serialize)]
struct VerifySummary {
    frames: usize,
    done: usize,
    missing: usize,
    damaged: usize,
    stale: usize,
    uncertified: usize,
    inputs_missing: usize,
    obstacles_missing: usize,
}

#[derive(Debug, Serialize)]
struct VerifiedFrame<'a> {
    input: String,
    stem: &'a str,
    shard: usize,
    status: &'static str,
    why: Option<&'a str>,
    #[serde(rename = "input_is_there")]
    input_exists: bool,
    #[serde(rename = "obstacles_are_there")]
    obstacles_exist: bool,
}

impl<'a> VerificationReport<'a> {
    /// The verdicts on the plan in the file at `path`, for the outputs in `folder`.
    pub fn new(
        plan: &'a ShardPlan,
        verdicts: &'a PlanVerification,
        path: &Path,
        folder: &Path,
    ) -> VerificationReport<'a> {
        let [done, missing, damaged, stale, uncertified] = verdicts.counts().map(|(_, count)| count);
        let frames = plan.frames.iter().zip(&verdicts.frames).map(|(planned, verdict)| VerifiedFrame {
            input: planned.input.to_string_lossy().into_owned(),
            stem: &planned.stem,
            shard: verdict.shard,
            status: verdict.status(),
            why: verdict.why(),
            input_exists: verdict.input_exists,
            obstacles_exist: verdict.obstacles_exist,
        });
        VerificationReport {
            version: env!("CARGO_PKG_VERSION"),
            plan: path.to_string_lossy().into_owned(),
            folder: folder.to_string_lossy().into_owned(),
            summary: VerifySummary {
                frames: plan.frames.len(),
                done,
                missing,
                damaged,
                stale,
                uncertified,
                inputs_missing: verdicts.input_missing_count(),
                obstacles_missing: verdicts.obstacle_missing_count(),
            },
            shards_to_run: verdicts.shards_to_run(),
            frames: frames.collect(),
        }
    }

    /// Writes the file atomically.
    ///
    /// # Errors
    /// When the system reports an error.
    pub fn write(&self, path: &Path) -> meniscus_formats::Result<()> {
        write_atomically(path, |out| Ok(write_json(out, self)?))
    }
}
