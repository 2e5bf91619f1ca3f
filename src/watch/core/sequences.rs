//! The settings of each sequence: determined once, then kept.
//!
//! ```text
//!   spacing given, and a preset other than auto ─────┐
//!   recorded, from an earlier run ───────────────────┼──▶ fixed: every frame has the same
//!   measured on the first, middle and last of the ───┘
//!   frames that are complete by then
//! ```
//!
//! Until the settings are known, complete frames are held. They also wait for frames that precede them by
//! name and are still being written, because the first of the measured frames must not depend on which file
//! was finished first, or on the order of conversion. With `--once` they wait for all frames, so that the
//! result of measuring is that of `convert`.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use twox_hash::XxHash3_64;

use crate::pipeline::{
    DoneRecord, FileStamp, FrameFile, Framing, Job, NumberedFrames, ObstacleFiles, ObstacleStamps,
    OutputOptions, PictureOptions, RecordedFrame, ReportedWarnings, SequenceCamera, SequenceKey,
    SharedSettings, are_single_frames, recorded_settings, settings_id, valid_cameras,
};
use crate::surface::options::{self, Settings, SpacingOptions};
use crate::watch::config::Watch;

use super::events::UnreadableFrame;
use super::frames::FrameId;
use super::state::Core;

/// All sequences found so far.
#[derive(Debug, Default)]
pub(crate) struct Sequences {
    all: Vec<WatchedSequence>,
    index_of: HashMap<(usize, PathBuf, String), usize>,
    /// Groups files whose names differ only in their numbers, by their root and [`FrameFile::group_key`].
    name_groups: HashMap<(usize, PathBuf, String), NameGroup>,
}

/// Sequences whose names differ only in their numbers.
#[derive(Debug, Default)]
struct NameGroup {
    sequence_count: usize,
    /// How many of them have only one frame.
    single_count: usize,
    was_named: bool,
}

/// Frames whose names differ only in their frame number.
#[derive(Debug)]
pub(crate) struct WatchedSequence {
    /// Its key in the records.
    pub(crate) key: SequenceKey,
    /// The index of its root.
    pub(crate) root: usize,
    /// The key of the [`NameGroup`] that counts it as a sequence with one frame, while it has only one.
    single_in: Option<(usize, PathBuf, String)>,
    /// Its settings, or what is missing for them.
    pub(crate) settings: SequenceSettings,
    /// Its frames that have numbers.
    pub(crate) numbered: NumberedFrames<FrameId>,
    /// The camera of its pictures, if one had to be fitted.
    pub(crate) framing: Option<Arc<Framing>>,
    /// Whether it was logged that its frames wait for one with more particles.
    pub(crate) is_sparse_logged: bool,
    /// Whether it was logged that a file of this name has no particles.
    pub(crate) is_neighbor_logged: bool,
    /// The warnings about its frames that were logged.
    pub(crate) reported: ReportedWarnings,
    /// Whether it was logged that its frames have velocities and the outputs do not.
    pub(crate) has_reported_velocity: bool,
}

impl WatchedSequence {
    /// The id of its settings; `None` while they are unknown.
    pub(crate) fn settings_id(&self) -> Option<&str> {
        match &self.settings {
            SequenceSettings::Fixed(_, id) => Some(id),
            _ => None,
        }
    }

    /// Whether a frame was recorded with the settings of the sequence, apart from its obstacles.
    pub(crate) fn has_settings_of(&self, record: &RecordedFrame, outputs: &OutputOptions) -> bool {
        let has_camera = |done: &DoneRecord| {
            let cameras = valid_cameras(outputs, self.framing.as_deref());
            cameras.is_empty() || done.camera.as_ref().is_some_and(|camera| cameras.contains(camera))
        };
        match (&record.unfinished, &record.done) {
            (Some(unfinished), _) => self.settings_id() == Some(&unfinished.settings),
            (None, Some(done)) => self.settings_id() == Some(&done.settings) && has_camera(done),
            (None, None) => false,
        }
    }
}

/// The settings of a sequence, or what is missing for them.
#[derive(Clone, Debug)]
pub(crate) enum SequenceSettings {
    /// The settings of all its frames, and their id in records.
    Fixed(Arc<Settings>, Arc<str>),
    /// Not measured yet; the options that affect the measurement.
    Unknown(SpacingOptions),
    /// The measurement is in progress.
    BeingMeasured,
    /// The settings cannot be determined, for this reason.
    Impossible(String),
}

impl Sequences {
    /// The index of the sequence of a frame with this name. `remembered` returns what is recorded of a
    /// sequence that is new.
    pub(crate) fn index(
        &mut self,
        id: &FrameId,
        file: &FrameFile,
        watch: &Watch,
        remembered: impl FnOnce(&SequenceKey) -> Option<SharedSettings>,
    ) -> usize {
        let (folder, name) = file.sequence();
        let location = (id.root, folder, name);
        let known = self.index_of.get(&location).copied();
        if let Some(index) = known {
            let group = self.all[index].single_in.take();
            if let Some(group) = group.and_then(|key| self.name_groups.get_mut(&key)) {
                group.single_count -= 1;
            }
            return index;
        }
        let single_in = file.group_key().map(|(folder, shared_name)| (id.root, folder, shared_name));
        if let Some(key) = &single_in {
            let group = self.name_groups.entry(key.clone()).or_default();
            group.sequence_count += 1;
            group.single_count += 1;
        }
        let (_, folder, name) = location.clone();
        let key = SequenceKey { folder, name, choices: choices_fingerprint(watch) };
        let remembered = remembered(&key);
        let settings = SequenceSettings::new(watch, remembered.as_ref());
        let framing = framing_of(watch, remembered.as_ref());
        self.all.push(WatchedSequence {
            key,
            root: id.root,
            single_in,
            settings,
            numbered: NumberedFrames::default(),
            framing,
            is_sparse_logged: false,
            is_neighbor_logged: false,
            reported: ReportedWarnings::default(),
            has_reported_velocity: false,
        });
        self.index_of.insert(location, self.all.len() - 1);
        self.all.len() - 1
    }

    /// Folders whose files look like one sequence but form several: of the sequences whose names differ only
    /// in their numbers, most, and at least `count_min`, have only one frame. Each folder is returned once:
    /// its root, its path, and the number of these sequences.
    pub(crate) fn folders_of_single_frame_sequences(
        &mut self,
        count_min: usize,
    ) -> Vec<(usize, PathBuf, usize)> {
        let mut folders = Vec::new();
        for ((root, folder, _), group) in &mut self.name_groups {
            let has_fallen = group.single_count >= count_min
                && are_single_frames(group.sequence_count, group.single_count);
            if has_fallen && !group.was_named {
                group.was_named = true;
                folders.push((*root, folder.clone(), group.single_count));
            }
        }
        folders.sort();
        folders
    }

    pub(crate) fn get(&self, index: usize) -> &WatchedSequence {
        &self.all[index]
    }

    /// The number of sequences.
    pub(crate) fn len(&self) -> usize {
        self.all.len()
    }

    pub(crate) fn get_mut(&mut self, index: usize) -> &mut WatchedSequence {
        &mut self.all[index]
    }
}

impl Core {
    /// The index of the sequence of a file. A sequence that is new is added.
    pub(super) fn sequence_of(&mut self, id: &FrameId) -> usize {
        let watch = &self.config.watches[id.root];
        let remembered = &self.output_folders[self.output_folder_of[id.root]].records.sequences;
        let known_count = self.sequences.len();
        let file = id.frame_file(&self.roots[id.root].path);
        let index = self.sequences.index(id, &file, watch, |key| remembered.get(key).cloned());
        if index == known_count {
            self.changed_sequences.push(index);
        }
        index
    }
}

impl SequenceSettings {
    /// The settings, if nothing must be measured: the particle spacing is given or remembered, and so is the
    /// camera if pictures are requested.
    pub(crate) fn new(watch: &Watch, remembered: Option<&SharedSettings>) -> SequenceSettings {
        let measured =
            remembered.and_then(|record| record.measured.as_ref()).map(options::SequenceSpacing::from);
        let lacks_camera = watch.outputs.needs_camera() && framing_of(watch, remembered).is_none();
        let unknown = || watch.choices.spacing_options().map(SequenceSettings::Unknown);
        let resolved = || match watch.job() {
            Job::LevelSet { .. } => Settings::for_level_sets(&watch.choices),
            Job::Surface | Job::Particles => Settings::resolve(&watch.choices, measured),
        };
        let settings = if watch.needs_measuring() && measured.is_none() {
            unknown()
        } else {
            resolved().and_then(|settings| {
                if lacks_camera {
                    return unknown();
                }
                let obstacles = ObstacleFiles::new(watch.obstacles.clone());
                let values = recorded_settings(&watch.job(), &settings, &watch.outputs, &obstacles);
                Ok(SequenceSettings::Fixed(Arc::new(settings), settings_id(&values).into()))
            })
        };
        settings.unwrap_or_else(|error| SequenceSettings::Impossible(error.to_string()))
    }
}

/// The remembered camera of a sequence, if it was fitted for the current options.
pub(crate) fn framing_of(watch: &Watch, remembered: Option<&SharedSettings>) -> Option<Arc<Framing>> {
    let SequenceCamera { requested, framed } = remembered?.camera.as_ref()?;
    let is_requested = watch.outputs.needs_camera() && *requested == requested_camera(&watch.outputs);
    is_requested.then(|| Arc::new(Framing::new(&watch.outputs, framed.clone())))
}

/// The options that the camera depends on.
pub(crate) fn requested_camera(outputs: &OutputOptions) -> String {
    let PictureOptions { size: [width, height], camera } = outputs.picture;
    format!("{width}x{height} {camera} {:?}", outputs.up())
}

/// A hash of the stamps of obstacles, for records: the content of obstacles is not read to compare them.
pub(crate) fn obstacle_stamp(stamps: &ObstacleStamps) -> String {
    format!("{:016x}", XxHash3_64::oneshot(stamps.text.as_bytes()))
}

/// A request to measure a sequence.
#[derive(Debug)]
pub(crate) struct MeasureOrder {
    /// The index of the sequence.
    pub(crate) sequence: usize,
    /// Its complete frames in natural order, with their stamps when they were found complete.
    pub(crate) files: Vec<(FrameId, FileStamp)>,
    /// The options that affect the measurement.
    pub(crate) options: SpacingOptions,
    /// The known particle spacing, if only the camera is missing.
    pub(crate) known: Option<SharedSettings>,
    /// Whether further frames may come, so that those with few particles need not be measured.
    pub(crate) others_may_come: bool,
    /// The configuration of the watched folder.
    pub(crate) watch: Watch,
}

/// The result of measuring a sequence.
#[derive(Debug)]
pub(crate) struct SpacingResult {
    /// The index of the sequence.
    pub(crate) sequence: usize,
    /// The particle spacing and its source, if one of the files yields it.
    pub(crate) record: Option<SharedSettings>,
    /// Files with too few particles.
    pub(crate) sparse: Vec<(FrameId, FileStamp)>,
    /// Files that cannot be read.
    pub(crate) unreadable: Vec<(FrameId, FileStamp, UnreadableFrame)>,
    /// A file that changed during the measurement, which makes the result invalid.
    pub(crate) changed: Option<FrameId>,
    /// Reasons for the user to check the spacing.
    pub(crate) warnings: Vec<String>,
}

/// A fingerprint of the user's options. It is part of the key of a sequence, so files that are converted with
/// other options are another sequence.
pub(crate) fn choices_fingerprint(watch: &Watch) -> String {
    format!("{:016x}", XxHash3_64::oneshot(format!("{:?}", watch.choices).as_bytes()))
}
