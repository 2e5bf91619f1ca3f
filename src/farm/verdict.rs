//! Verifies the outputs of a plan.

use std::path::Path;
use std::sync::Arc;

use rayon::prelude::*;
use serde::Serialize;

use crate::pipeline::files::json::write_json;
use crate::pipeline::{InspectedState, Inspection, ObstacleFiles, inspect, write_whole};

use super::plan::ShardPlan;

/// The verdict on each frame of a plan.
#[derive(Clone, Debug)]
pub struct Verdicts {
    /// In the order of the plan.
    pub frames: Vec<FrameVerdict>,
}

/// The verdict on a frame.
#[derive(Clone, Debug)]
pub struct FrameVerdict {
    /// The shard of the frame.
    pub shard: usize,
    /// The state of its outputs.
    pub state: InspectedState,
    /// Whether its input exists, and so was compared with the provenance of the outputs.
    pub input_is_there: bool,
    /// Whether all its obstacles exist.
    pub obstacles_are_there: bool,
}

/// Checks all bytes of every output of a plan, and the inputs that exist. Writes nothing.
pub fn verify(plan: &ShardPlan) -> Verdicts {
    let obstacles = Arc::new(ObstacleFiles::new(plan.obstacles.clone()));
    let shards = plan.shards.par_iter().enumerate();
    let verdicts = shards.flat_map(|(shard, frames)| {
        let obstacles = Arc::clone(&obstacles);
        plan.frames[frames.clone()].par_iter().map(move |planned| {
            let Inspection { state, input_is_there, obstacles_are_there } =
                inspect(&plan.frame(planned, &obstacles));
            FrameVerdict { shard, state, input_is_there, obstacles_are_there }
        })
    });
    Verdicts { frames: verdicts.collect() }
}

impl FrameVerdict {
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
    pub fn is_to_be_made(&self) -> bool {
        !matches!(self.state, InspectedState::Done | InspectedState::Uncertified(_))
    }
}

/// All values of [`FrameVerdict::status`].
const STATUSES: [&str; 5] = ["done", "missing", "damaged", "stale", "uncertified"];

impl Verdicts {
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
        let open = self.frames.iter().filter(|frame| frame.is_to_be_made());
        let mut shards: Vec<usize> = open.map(|frame| frame.shard).collect();
        shards.dedup();
        shards
    }

    /// The number of frames whose input is missing.
    pub fn input_missing_count(&self) -> usize {
        self.frames.iter().filter(|frame| !frame.input_is_there).count()
    }

    /// The number of frames with a missing obstacle.
    pub fn obstacle_missing_count(&self) -> usize {
        self.frames.iter().filter(|frame| !frame.obstacles_are_there).count()
    }
}

/// The verdicts as a JSON file.
#[derive(Debug, Serialize)]
pub struct VerdictRecord<'a> {
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
    input_is_there: bool,
    obstacles_are_there: bool,
}

impl<'a> VerdictRecord<'a> {
    /// The verdicts on the plan in the file at `path`, for the outputs in `folder`.
    pub fn new(plan: &'a ShardPlan, verdicts: &'a Verdicts, path: &Path, folder: &Path) -> VerdictRecord<'a> {
        let [done, missing, damaged, stale, uncertified] = verdicts.counts().map(|(_, count)| count);
        let frames = plan.frames.iter().zip(&verdicts.frames).map(|(planned, verdict)| VerifiedFrame {
            input: planned.input.to_string_lossy().into_owned(),
            stem: &planned.stem,
            shard: verdict.shard,
            status: verdict.status(),
            why: verdict.why(),
            input_is_there: verdict.input_is_there,
            obstacles_are_there: verdict.obstacles_are_there,
        });
        VerdictRecord {
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
        write_whole(path, |out| Ok(write_json(out, self)?))
    }
}
