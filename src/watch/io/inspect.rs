//! Inspects one file, as far as the core requests.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use meniscus_formats::{Completeness, completeness};

use crate::pipeline::{
    ChangedOutput, Conflict, FileStamp, ObstacleStamps, SniffedContent, content, is_cut_off,
    may_hold_several, open_regular,
};
use crate::watch::config::{StabilityTimeouts, Watch};
use crate::watch::core::completeness::{
    Candidate, FileHint, Readiness, Sentinel, path_of_sentinel, sentinel_counts,
};
use crate::watch::core::events::{
    Complete, FileContents, Inspect, Inspected, InspectionExtent, InspectionResult, Recorded,
};
use crate::watch::core::frames::FrameId;
use crate::watch::core::sequences::obstacle_stamp;

use super::root::Root;
use super::scan::file_state;
#[cfg(target_os = "linux")]
use super::writers::is_open_for_writing;

/// Other systems do not show it without unsafe code.
#[cfg(not(target_os = "linux"))]
fn is_open_for_writing(_file: &Path, _unchanged_for: std::time::Duration) -> bool {
    false
}

impl Root {
    /// Inspects a file.
    pub(super) fn inspect(&self, request: Inspect) -> Inspected {
        let own = &self.obstacles[self.index];
        let stamps = || Arc::new(own.stamps(request.id.frame_file(&self.path).number()));
        let obstacles = (!own.is_empty()).then(stamps);
        let found = self.examine(&request, obstacles.as_deref());
        Inspected { id: request.id, number: request.number, found, obstacles }
    }

    fn examine(&self, request: &Inspect, obstacles: Option<&ObstacleStamps>) -> InspectionResult {
        let Inspect { id, stamp, outputs, extent, recorded, .. } = request;
        let changed_output = recorded.as_ref().and_then(|recorded| self.changed_output_of(recorded));
        let has_obstacles = |recorded: &Recorded| has_recorded_obstacles(recorded, obstacles);
        let is_as_recorded = changed_output.is_none() && recorded.as_ref().is_some_and(has_obstacles);
        if is_as_recorded && *extent == InspectionExtent::AllOfJustSeen {
            return InspectionResult::AsRecorded;
        }
        let file = id.file_path();
        let seen = match file_state(file, self.trust_clock()) {
            Ok(Some(seen)) => seen,
            Ok(None) => return InspectionResult::Missing,
            Err(error) => return InspectionResult::Unreadable(error),
        };
        let at = Instant::now();
        if seen.stamp != *stamp {
            return InspectionResult::Changed(seen, at);
        }
        if *extent == InspectionExtent::Stamp {
            return InspectionResult::Same;
        }
        if is_as_recorded {
            return InspectionResult::AsRecorded;
        }
        if changed_output.is_some() && !self.output.is_in_place() {
            return InspectionResult::OutputsAway;
        }
        let mut proof = None;
        if let Some(mut candidate) = request.candidate {
            candidate.see(at, &seen, FileHint::Changed);
            match readiness_of(file, &candidate, at, &self.watch, &self.timeouts()) {
                Readiness::Ready(found) => proof = Some(found),
                Readiness::Waiting { until, why } => return InspectionResult::Waiting { until, why },
            }
        }
        let contents = contents_of(id);
        let conflict = match contents {
            FileContents::Frame | FileContents::MaybeSteps => {
                match self.conflict_of(outputs, recorded.as_ref()) {
                    // The other file only seems to be gone: the pipeline does not check it again.
                    None if !self.output.is_in_place() => return InspectionResult::OutputsAway,
                    conflict => conflict,
                }
            }
            FileContents::NotParticles | FileContents::Neighbor(_) | FileContents::Unreadable(_) => None,
        };
        InspectionResult::Complete(Complete { proof, changed_output, contents, conflict })
    }

    /// The first recorded output that has changed.
    fn changed_output_of(&self, recorded: &Recorded) -> Option<ChangedOutput> {
        recorded.record.if_done()?.changed_output(&self.output.folder)
    }

    /// Why these outputs must not be written: one would replace particles, a mesh or a level set of
    /// another program, or an obstacle of any watched folder. `None` if nothing is wrong. A recorded output that
    /// was cut off since it was written may be replaced.
    fn conflict_of(&self, outputs: &[PathBuf], recorded: Option<&Recorded>) -> Option<String> {
        let done = recorded.and_then(|recorded| recorded.record.if_done());
        let own: Vec<PathBuf> =
            done.into_iter().flat_map(|record| record.output_paths(&self.output.folder)).collect();
        for output in outputs {
            if replaces_data(output) && !(own.contains(output) && is_cut_off(output)) {
                return Some(replacement(output));
            }
            for obstacles in &self.obstacles {
                if let Err(conflict) = obstacles.refuse_output(output) {
                    return Some(conflict.to_string());
                }
            }
        }
        None
    }
}

/// Whether an output would replace particles, or a mesh or a level set of another program. An extension
/// suffices here: the file may be a frame that a simulation has only begun to write.
fn replaces_data(output: &Path) -> bool {
    content(output).is_ok_and(SniffedContent::is_data)
}

/// Why such an output is not written.
fn replacement(output: &Path) -> String {
    Conflict::ReplacesData { output: output.to_owned(), other_count: 0 }.to_string()
}

fn has_recorded_obstacles(recorded: &Recorded, obstacles: Option<&ObstacleStamps>) -> bool {
    !recorded.checks_obstacles || recorded.record.obstacle_stamp() == obstacles.map(obstacle_stamp).as_ref()
}

fn contents_of(id: &FrameId) -> FileContents {
    match content(id.file_path()) {
        Ok(SniffedContent::OwnOutput | SniffedContent::NotParticles) => return FileContents::NotParticles,
        Ok(SniffedContent::Neighbor(neighbor)) => return FileContents::Neighbor(neighbor),
        // An unreadable file counts as a frame: reading it reports what is wrong.
        Ok(SniffedContent::Particles | SniffedContent::OwnParticles) | Err(_) => {}
    }
    if id.is_step() {
        return FileContents::Frame;
    }
    match may_hold_several(&id.path) {
        Ok(true) => FileContents::MaybeSteps,
        Ok(false) => FileContents::Frame,
        Err(error) => FileContents::Unreadable(error),
    }
}

/// Whether this file may be read now.
fn readiness_of(
    file: &Path,
    candidate: &Candidate,
    now: Instant,
    watch: &Watch,
    timeouts: &StabilityTimeouts,
) -> Readiness {
    let sentinel = FileStamp::of_path(&path_of_sentinel(watch, file));
    let sentinel = Sentinel {
        is_required: watch.sentinel.is_some(),
        // A sentinel of an earlier version of the frame proves nothing.
        exists: sentinel.is_ok_and(|sentinel| sentinel_counts(&sentinel, candidate.stamp())),
    };
    candidate.readiness(
        now,
        timeouts,
        sentinel,
        || completeness_of(file),
        |unchanged_for| is_open_for_writing(file, unchanged_for),
    )
}

/// The completeness according to the file format. Errors are ignored here, because reading the frame reports
/// them.
fn completeness_of(path: &Path) -> Completeness {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let check = || completeness(&mut open_regular(path)?, &name);
    check().unwrap_or(Completeness::Unknown)
}
