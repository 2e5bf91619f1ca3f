//! Determines the settings of sequences: which frames to measure, and what to do with the result.

use std::sync::Arc;

use crate::pipeline::{
    FileStamp, Job, MeasuredSpacing, Reason, RecordLine, SequenceKey, SharedSettings, UnfinishedState,
    natural_order, order_by_number, single_frames_note,
};
use crate::surface::options::Start;

use super::events::{Effect, Log, SlowRequest};
use super::frames::{FrameId, FramePhase, FrameState};
use super::sequences::{MeasureOrder, SequenceSettings, SpacingResult, framing_of};
use super::state::Core;

impl Core {
    /// Warns once for each folder if files look like one sequence but form many, each with its own particle
    /// spacing.
    pub(super) fn warn_of_single_frames(&mut self) {
        // Without `once`, more frames may come: two sequences may have only just started, and have one frame
        // each, so it takes three. With `once`, no more frames come, and two are enough.
        let count_min = if self.config.once { 2 } else { 3 };
        for (root, folder, count) in self.sequences.folders_of_single_frame_sequences(count_min) {
            let watch = &self.config.watches[root];
            if watch.needs_measuring() {
                let note = single_frames_note(count, &watch.choices);
                self.log(move || tracing::warn!(folder = %folder.display(), "{note}"));
            }
        }
    }

    /// Requests the measurement of sequences that are ready for it.
    pub(super) fn resolve_sequences(&mut self) {
        for index in std::mem::take(&mut self.dirty_sequences) {
            // Which frames are complete is known once all inspections have ended.
            let is_inspecting = self.frames.is_inspecting(Some(index));
            if is_inspecting || self.config.once && self.awaits_frames(index) {
                self.dirty_sequences.insert(index);
                continue;
            }
            if let Some(order) = self.measure_order(index) {
                self.sequences.get_mut(index).settings = SequenceSettings::BeingMeasured;
                self.measuring_count += 1;
                self.effects.push(Effect::Slow(SlowRequest::Measure(Box::new(order))));
            }
        }
    }

    /// Whether a frame of an unmeasured sequence may soon be complete.
    fn awaits_frames(&self, index: usize) -> bool {
        let awaited = |frame: &FrameState| match frame.phase {
            FramePhase::Settling(_) => !frame.is_stuck(),
            FramePhase::FindingSteps | FramePhase::Retrying(_) => true,
            _ => false,
        };
        matches!(self.sequences.get(index).settings, SequenceSettings::Unknown(_))
            && self.frames.iter().any(|(_, frame)| frame.sequence == index && awaited(frame))
    }

    /// A request to measure the complete frames of a sequence that precede all incomplete ones in natural
    /// order; `None` if there are no such frames, or nothing must be measured.
    fn measure_order(&self, index: usize) -> Option<MeasureOrder> {
        let sequence = self.sequences.get(index);
        let SequenceSettings::Unknown(options) = &sequence.settings else { return None };
        let mut members: Vec<(&FrameId, Option<FileStamp>)> = self
            .frames
            .iter()
            .filter(|(_, frame)| frame.sequence == index && !frame.is_sparse)
            .filter_map(|(id, frame)| match frame.phase {
                FramePhase::Held => Some((id, Some(frame.stamp))),
                FramePhase::Settling(_) | FramePhase::FindingSteps | FramePhase::Retrying(_) => {
                    Some((id, None))
                }
                _ => None,
            })
            .collect();
        members.sort_by(|(a, _), (b, _)| natural_order(&a.path.to_string_lossy(), &b.path.to_string_lossy()));
        order_by_number(&mut members, |(id, _)| id.frame_file(self.root_path(id.root)));
        let files: Vec<(FrameId, FileStamp)> =
            members.into_iter().map_while(|(id, stamp)| Some((id.clone(), stamp?))).collect();
        let watch = self.config.watches[sequence.root].clone();
        let remembered = self.output_folder(sequence.root).records.sequences.get(&sequence.key).cloned();
        let given = (!watch.needs_measuring()).then(SharedSettings::default);
        let (options, known) = (options.clone(), given.or(remembered));
        let others_may_come = !self.config.once;
        let order = MeasureOrder { sequence: index, files, options, known, others_may_come, watch };
        (!order.files.is_empty()).then_some(order)
    }

    /// A sequence was measured, or could not be.
    pub(super) fn on_measured(&mut self, measured: SpacingResult) {
        self.measuring_count -= 1;
        let SpacingResult { sequence: index, record, sparse, unreadable, changed, warnings } = measured;
        let root = self.sequences.get(index).root;
        // Results about files that have changed since are ignored.
        let sparse = sparse.into_iter().filter(|(id, stamp)| self.is_still(id, FramePhase::Held, stamp));
        let sparse: Vec<FrameId> = sparse.map(|(id, _)| id).collect();
        for id in &sparse {
            if let Some(frame) = self.frames.get_mut(id) {
                frame.is_sparse = true;
            }
        }
        let sequence = self.sequences.get_mut(index);
        let watch = &self.config.watches[root];
        sequence.settings = SequenceSettings::new(watch, record.as_ref());
        sequence.framing = framing_of(watch, record.as_ref());
        if record.is_none() {
            self.log_sparse(index, &sparse);
        }
        for (id, stamp, unreadable) in unreadable {
            if self.is_still(&id, FramePhase::Held, &stamp) {
                self.unreadable_frame(&id, unreadable);
            }
        }
        if let Some(id) = changed {
            self.check_stamp(&id);
        }
        if let Some(record) = record {
            let key = self.sequences.get(index).key.clone();
            let known = self.output_folder(root).records.sequences.get(&key);
            let has_spacing = self.config.watches[root].choices.spacing.is_some();
            let headline = headline_of(has_spacing, &record, known);
            let log = self.log_of_settings(index, headline, warnings);
            self.record_sequence(root, key, record, log);
            self.changed_sequences.push(index);
            if self.depends_on_others(root) {
                self.doubt_all(index);
            }
            for id in
                self.frames.ids_of(|_, frame| frame.sequence == index && frame.phase == FramePhase::Held)
            {
                self.queue_if_ready(&id);
            }
        }
        // More frames may have arrived in the meantime.
        self.dirty_sequences.insert(index);
    }

    /// Records the camera of a sequence if it was refitted.
    pub(super) fn note_camera(&mut self, index: usize) {
        let sequence = self.sequences.get(index);
        let Some(framed) = sequence.framing.as_ref().map(|framing| framing.framed()) else { return };
        let (root, key) = (sequence.root, sequence.key.clone());
        let Some(mut record) = self.output_folder(root).records.sequences.get(&key).cloned() else { return };
        let Some(camera) = record.camera.as_mut().filter(|camera| camera.framed != framed) else { return };
        camera.framed = framed;
        let path = key.folder.join(&key.name);
        let log = Log::new(move || {
            let what =
                "a frame exceeds the camera's view: the camera is refitted for this frame and later ones";
            tracing::info!(sequence = %path.display(), "{what}");
        });
        self.record_sequence(root, key, record, Some(log));
    }

    fn record_sequence(&mut self, root: usize, key: SequenceKey, shared: SharedSettings, log: Option<Log>) {
        // The latest record counts, also if the clock was set back.
        let after = self
            .output_folder(root)
            .records
            .sequences
            .get(&key)
            .map_or(0, |known| known.at_ms.saturating_add(1));
        let shared = Box::new(SharedSettings { at_ms: self.now.unix_ms.max(after), ..shared });
        self.record(self.output_folder_of[root], RecordLine::Sequence { key, shared }, log);
    }

    /// Logs, once, that frames wait for another one with more particles.
    fn log_sparse(&mut self, index: usize, sparse: &[FrameId]) {
        let root = self.sequences.get(index).root;
        let watch = &self.config.watches[root];
        let why = match (watch.needs_measuring(), watch.choices.spacing) {
            (true, None) => Reason::NoSpacing,
            (true, Some(_)) => Reason::NoPreset,
            (false, _) => Reason::NoCamera,
        };
        let sequence = self.sequences.get_mut(index);
        if !sparse.is_empty() && !std::mem::replace(&mut sequence.is_sparse_logged, true) {
            let path = sequence.key.folder.join(&sequence.key.name);
            let why = why.clone();
            self.log_about(path, move |sequence| tracing::warn!(%sequence, "{why}"));
        }
        for id in sparse {
            self.record_state(id, UnfinishedState::Queued, Some(why.clone()), None);
        }
    }

    fn log_of_settings(&self, index: usize, headline: String, warnings: Vec<String>) -> Option<Log> {
        let sequence = self.sequences.get(index);
        let SequenceSettings::Fixed(settings, _) = &sequence.settings else { return None };
        // Nothing was measured for level sets: their files contain the voxel size.
        if self.config.watches[sequence.root].job() != Job::Surface {
            return None;
        }
        let (settings, key) = (Arc::clone(settings), sequence.key.clone());
        Some(Log::new(move || {
            let with_spheres = |length| (settings.start == Start::Spheres).then(|| six_digits(length));
            let with_kernels = |length| (settings.start == Start::Kernels).then(|| six_digits(length));
            tracing::info!(
                sequence = %key.folder.join(&key.name).display(),
                preset = %settings.preset,
                spacing = six_digits(settings.spacing),
                voxel_size = six_digits(settings.voxel_size),
                radius_min = with_spheres(settings.radius_min),
                radius_init = with_spheres(settings.radius_init),
                radius_max = with_spheres(settings.radius_max),
                blend = with_kernels(settings.radius_max),
                "{headline}"
            );
            for warning in warnings {
                tracing::warn!(sequence = %key.name, "{warning}");
            }
            for warning in settings.warnings() {
                tracing::warn!(sequence = %key.name, "{warning}");
            }
        }))
    }

    /// Whether a frame is still in this phase, and its file unchanged.
    pub(super) fn is_still(&self, id: &FrameId, phase: FramePhase, stamp: &FileStamp) -> bool {
        self.frames.get(id).is_some_and(|frame| frame.phase == phase && frame.stamp == *stamp)
    }
}

/// The message about the settings of a sequence: its particle spacing was measured, or was given or known
/// already.
fn headline_of(has_spacing: bool, record: &SharedSettings, known: Option<&SharedSettings>) -> String {
    let was_known = has_spacing || known.is_some_and(|known| known.measured.is_some());
    match &record.measured {
        // A daemon that starts when more frames exist may measure another.
        Some(MeasuredSpacing { spacing, measured_count: 1, .. }) if !was_known => format!(
            "measured the particle spacing on one frame, for all frames of the sequence; --spacing {} makes every run alike",
            six_digits(*spacing)
        ),
        Some(_) if !was_known => "measured the particle spacing, for all frames of the sequence".to_owned(),
        _ => "settings of the sequence".to_owned(),
    }
}

/// Rounds to six significant digits, which is enough for people.
fn six_digits(value: f64) -> f64 {
    format!("{value:.5e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_new_spacing_is_announced_as_measured() {
        let given = SharedSettings::default();
        let spacing = MeasuredSpacing {
            spacing: 0.1,
            confidence: 1.0,
            irregularity: None,
            radius_median: None,
            measured_on: "/in/a.1.ply".into(),
            measured_count: 1,
            warnings: Vec::new(),
        };
        let measured = SharedSettings { measured: Some(spacing), ..SharedSettings::default() };
        let is_announced = |has_spacing, record, known| {
            headline_of(has_spacing, record, known).starts_with("measured the particle spacing")
        };
        assert!(is_announced(false, &measured, None));
        assert!(headline_of(false, &measured, None).contains("--spacing 0.1 makes every run alike"));
        assert!(!is_announced(false, &measured, Some(&measured)));
        assert!(!is_announced(true, &given, None));
        // With a given spacing, particles are measured to choose a preset.
        assert!(!is_announced(true, &measured, None));
    }
}
