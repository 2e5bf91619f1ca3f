//! The settings of each sequence: fixed once, and kept.
//!
//! ```text
//!   spacing given ───────────────────────────────────┐
//!   in the journal, from an earlier run ─────────────┼──▶ fixed: every frame has the same
//!   measured on the first, middle and last of the ───┘
//!   frames that are complete by then
//! ```
//!
//! Until then, frames that are complete are held. A frame that comes before them by name, and is
//! still being written, is waited for: which frame is the first must not depend on which of two files was
//! finished first, or on the order in which frames are converted. With `--once` all frames are waited for:
//! they are measured as `convert` measures them.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use twox_hash::XxHash3_64;

use crate::pipeline::{
    Attempt, FileStamp, FrameError, FrameFile, Framed, Framing, Job, ObstacleFiles, ObstacleStamps,
    OutputOptions, PictureOptions, file_of, have_fallen_apart, measure_sequence, sequence_bounds,
    settings_fingerprint,
};
use crate::surface::options::{self, OwnRadii, Settings};

use super::config::Watch;
use super::frames::FrameId;
use super::journal::{SequenceCamera, SequenceKey, SequenceRecord, State};

/// All sequences that were met.
#[derive(Debug, Default)]
pub(super) struct Sequences {
    all: Vec<Sequence>,
    index_of: HashMap<(usize, PathBuf, String), usize>,
    /// What files have in common whose names differ in their numbers only: their root and [`FrameFile::kin`].
    kin: HashMap<(usize, PathBuf, String), Kin>,
}

/// Sequences whose names differ in their numbers only.
#[derive(Debug, Default)]
struct Kin {
    sequence_count: usize,
    /// How many of them have one frame.
    single_count: usize,
    was_named: bool,
}

/// Frames whose names differ in their number only.
#[derive(Debug)]
pub(super) struct Sequence {
    /// What the journal knows it by.
    pub(super) key: SequenceKey,
    /// The index of its root.
    pub(super) root: usize,
    /// The kin that counts it as a sequence of one frame, as long as it has no more.
    single_in: Option<(usize, PathBuf, String)>,
    /// Its settings, or what is missing.
    pub(super) settings: SequenceSettings,
    /// The camera that was placed for its pictures, if one had to be.
    pub(super) framing: Option<Arc<Framing>>,
    /// Frames that were looked at and have too few particles to measure the spacing.
    pub(super) sparse: HashSet<FrameId>,
    /// That its frames wait for one with more particles was told.
    pub(super) is_told: bool,
    /// The gist of what was told of its frames.
    pub(super) told: HashSet<String>,
}

impl Sequence {
    /// What the journal knows the settings of a frame by, and its obstacles as they are now; empty while there are
    /// none.
    pub(super) fn fingerprint(&self, obstacles: &ObstacleFiles, frame: &Path) -> String {
        match &self.settings {
            SequenceSettings::Fixed(settings, fingerprint) => {
                frame_fingerprint(settings, fingerprint, obstacles, frame)
            }
            _ => String::new(),
        }
    }

    /// The same of a frame among obstacles with these stamps.
    pub(super) fn fingerprint_among(&self, stamps: &ObstacleStamps) -> String {
        match &self.settings {
            SequenceSettings::Fixed(settings, fingerprint) => {
                fingerprint_among(settings, fingerprint, stamps)
            }
            _ => String::new(),
        }
    }
}

/// The settings of a sequence, or what is missing.
#[derive(Clone, Debug)]
pub(super) enum SequenceSettings {
    /// What all its frames are converted with, and what the journal knows these settings by.
    Fixed(Arc<Settings>, Arc<str>),
    /// To be measured on its frames; and where their particles have radii of their own.
    Unknown(Option<OwnRadii>),
    /// Under way.
    BeingMeasured,
    /// There are none, and this is why.
    Impossible(String),
}

impl Sequences {
    /// The index of the sequence that a frame belongs to; `remembered` is asked for what is known of one that is
    /// met for the first time.
    pub(super) fn index(
        &mut self,
        id: &FrameId,
        watch: &Watch,
        remembered: impl FnOnce(&SequenceKey) -> Option<SequenceRecord>,
    ) -> usize {
        let file = FrameFile::new(id.path.to_path_buf());
        let (folder, name) = file.sequence();
        let place = (id.root, folder, name);
        let known = self.index_of.get(&place).copied();
        if let Some(index) = known {
            let kin = self.all[index].single_in.take();
            if let Some(kin) = kin.and_then(|key| self.kin.get_mut(&key)) {
                kin.single_count -= 1;
            }
            return index;
        }
        let single_in = file.kin().map(|(folder, shared_name)| (id.root, folder, shared_name));
        if let Some(key) = &single_in {
            let kin = self.kin.entry(key.clone()).or_default();
            kin.sequence_count += 1;
            kin.single_count += 1;
        }
        let (_, folder, name) = place.clone();
        let key = SequenceKey { folder, name, choices: choices_fingerprint(watch) };
        let remembered = remembered(&key);
        let settings = SequenceSettings::new(watch, remembered.as_ref());
        let framing = framing_of(watch, remembered.as_ref());
        self.all.push(Sequence {
            key,
            root: id.root,
            single_in,
            settings,
            framing,
            sparse: HashSet::new(),
            is_told: false,
            told: HashSet::new(),
        });
        self.index_of.insert(place, self.all.len() - 1);
        self.all.len() - 1
    }

    /// Folders in which this many sequences or more, and most of those whose names differ in their numbers only, have one
    /// frame; each is named once: its root, the folder, and how many.
    pub(super) fn newly_fallen_apart(&mut self, count_min: usize) -> Vec<(usize, PathBuf, usize)> {
        let mut folders = Vec::new();
        for ((root, folder, _), kin) in &mut self.kin {
            let has_fallen =
                kin.single_count >= count_min && have_fallen_apart(kin.sequence_count, kin.single_count);
            if has_fallen && !kin.was_named {
                kin.was_named = true;
                folders.push((*root, folder.clone(), kin.single_count));
            }
        }
        folders.sort();
        folders
    }

    pub(super) fn get(&self, index: usize) -> &Sequence {
        &self.all[index]
    }

    /// How many there are.
    pub(super) fn len(&self) -> usize {
        self.all.len()
    }

    pub(super) fn get_mut(&mut self, index: usize) -> &mut Sequence {
        &mut self.all[index]
    }
}

impl SequenceSettings {
    /// The settings, where they need no measuring: the particle spacing was given, or is remembered, and so is the camera if
    /// there are to be pictures.
    pub(super) fn new(watch: &Watch, remembered: Option<&SequenceRecord>) -> SequenceSettings {
        let measured = remembered.and_then(|record| record.measured.as_ref()).map(options::Measured::from);
        let lacks_camera = watch.outputs.needs_camera() && framing_of(watch, remembered).is_none();
        let unknown = || watch.choices.own_radii().map(SequenceSettings::Unknown);
        let resolved = || match watch.job() {
            Job::LevelSet { .. } => Settings::of_level_sets(&watch.choices),
            Job::Surface | Job::Particles => Settings::resolve(&watch.choices, measured),
        };
        let settings = match watch.needs_spacing() && measured.is_none() {
            true => unknown(),
            false => resolved().and_then(|settings| {
                if lacks_camera {
                    return unknown();
                }
                // With the camera as it was asked for: one that is refitted makes no frame stale.
                let fingerprint = settings_fingerprint(&settings, &watch.outputs).into();
                Ok(SequenceSettings::Fixed(Arc::new(settings), fingerprint))
            }),
        };
        settings.unwrap_or_else(|error| SequenceSettings::Impossible(error.to_string()))
    }
}

/// The camera that is remembered for the pictures of a sequence, if one was placed for what is asked for now.
pub(super) fn framing_of(watch: &Watch, remembered: Option<&SequenceRecord>) -> Option<Arc<Framing>> {
    let SequenceCamera { asked, framed } = remembered?.camera.as_ref()?;
    let is_asked = watch.outputs.needs_camera() && *asked == asked_camera(&watch.outputs);
    is_asked.then(|| Arc::new(Framing::new(&watch.outputs, framed.clone())))
}

/// All that a camera depends on beside the frame.
fn asked_camera(outputs: &OutputOptions) -> String {
    let PictureOptions { size: [width, height], camera } = outputs.picture;
    format!("{width}x{height} {camera} {:?}", outputs.up())
}

/// What the journal knows the settings by that a frame would be converted with now; `None` where the
/// particle spacing is needed, and neither given nor remembered.
pub fn remembered_fingerprint(watch: &Watch, frame: &Path, state: &State) -> Option<String> {
    let (folder, name) = FrameFile::new(frame.to_owned()).sequence();
    let key = SequenceKey { folder, name, choices: choices_fingerprint(watch) };
    match SequenceSettings::new(watch, state.sequences.get(&key)) {
        SequenceSettings::Fixed(settings, fingerprint) => {
            Some(frame_fingerprint(&settings, &fingerprint, &obstacle_files(watch), frame))
        }
        _ => None,
    }
}

/// The obstacles of a watch.
pub(super) fn obstacle_files(watch: &Watch) -> ObstacleFiles {
    ObstacleFiles::new(watch.obstacles.clone())
}

/// The fingerprint of the settings, and of the files of obstacles if there are any: as they lie there, for the journal is
/// to tell without reading them.
fn frame_fingerprint(
    settings: &Settings,
    fingerprint: &str,
    obstacles: &ObstacleFiles,
    frame: &Path,
) -> String {
    if obstacles.is_empty() {
        return fingerprint.to_owned();
    }
    let stamps = obstacles.stamps(FrameFile::new(frame.to_owned()).number());
    fingerprint_among(settings, fingerprint, &stamps)
}

fn fingerprint_among(settings: &Settings, fingerprint: &str, stamps: &ObstacleStamps) -> String {
    let text = format!("{fingerprint}\n{}\n{}", settings.void_threshold, stamps.text);
    format!("{:016x}", XxHash3_64::oneshot(text.as_bytes()))
}

/// What a sequence is to be measured on.
#[derive(Debug)]
pub(super) struct MeasureOrder {
    /// Which sequence.
    pub(super) sequence: usize,
    /// Its complete frames, in natural order, and what they were when they were found complete.
    pub(super) files: Vec<(PathBuf, FileStamp)>,
    /// Where its particles have radii of their own.
    pub(super) own_radii: Option<OwnRadii>,
    /// What is known already: the particle spacing, where only the camera is not.
    pub(super) known: Option<SequenceRecord>,
    /// What was asked for.
    pub(super) watch: Watch,
}

/// What came of it.
#[derive(Debug)]
pub(super) struct Measured {
    /// Which sequence.
    pub(super) sequence: usize,
    /// The particle spacing and where it is from, if one of the files tells.
    pub(super) record: Option<SequenceRecord>,
    /// Files with too few particles.
    pub(super) sparse: Vec<(PathBuf, FileStamp)>,
    /// Files that cannot be read.
    pub(super) unreadable: Vec<(PathBuf, FileStamp, FrameError)>,
    /// A file that was written again meanwhile: with it, nothing is known.
    pub(super) changed: Option<PathBuf>,
    /// What should make a user check the spacing.
    pub(super) warnings: Vec<String>,
}

/// Measures the spacing, unless the voxel size is known, and places the camera of pictures.
pub(super) fn measure(order: MeasureOrder) -> Measured {
    let mut measured = Measured {
        sequence: order.sequence,
        record: None,
        sparse: Vec::new(),
        unreadable: Vec::new(),
        changed: None,
        warnings: Vec::new(),
    };
    let record = match &order.known {
        Some(record) => Some(record.clone()),
        None => {
            let paths: Vec<&Path> = order.files.iter().map(|(path, _)| path.as_path()).collect();
            let note = |path: &Path, attempt: Attempt| measured.note(path, attempt, &order);
            let found = measure_sequence(&paths, order.own_radii.as_ref(), note);
            found.map(|found| {
                measured.warnings.clone_from(&found.warnings);
                SequenceRecord { measured: Some(found), camera: None }
            })
        }
    };
    let record = match record {
        Some(record) if order.watch.outputs.needs_camera() => with_camera(record, &order, &mut measured),
        record => record,
    };
    measured.record = record.filter(|_| measured.changed.is_none());
    measured
}

impl Measured {
    /// Notes what came of a frame, unless it has changed since it was found complete.
    fn note(&mut self, path: &Path, attempt: Attempt, order: &MeasureOrder) {
        let found = order.files.iter().find(|(file, _)| file == path);
        let Some(&(_, stamp)) = found else { return };
        if FileStamp::of_path(file_of(path)).ok() != Some(stamp) {
            self.changed.get_or_insert_with(|| path.to_owned());
            return;
        }
        match attempt {
            Attempt::Measured => {}
            Attempt::Sparse => self.sparse.push((path.to_owned(), stamp)),
            Attempt::Unreadable(error) => self.unreadable.push((path.to_owned(), stamp, error)),
        }
    }
}

/// The record with the camera that the first frame asks for, of those that were not skipped when the spacing was measured;
/// `None` if there is no such frame.
fn with_camera(
    record: SequenceRecord,
    order: &MeasureOrder,
    measured: &mut Measured,
) -> Option<SequenceRecord> {
    let outputs = &order.watch.outputs;
    // Settings that make no sense end the sequence in another place.
    let spacing = record.measured.as_ref().map(options::Measured::from);
    let settings = Settings::resolve(&order.watch.choices, spacing);
    let radius = settings.map_or(0.0, |settings| settings.resting_height());
    let measured_on = record.measured.as_ref().map(|measured| &measured.measured_on);
    let measured_here = measured_on.filter(|_| order.known.is_none());
    let is_before = |path: &PathBuf| measured_here.is_some_and(|first| path != first);
    for (path, _) in order.files.iter().skip_while(|(path, _)| is_before(path)) {
        let (attempt, bounds) = match sequence_bounds(&[path.as_path()], radius) {
            Ok(Some(bounds)) => (Attempt::Measured, Some(bounds)),
            Ok(None) => (Attempt::Sparse, None),
            Err(error) => (Attempt::Unreadable(error), None),
        };
        measured.note(path, attempt, order);
        if let Some(bounds) = bounds {
            let framed = Framed::around(widened(bounds, outputs.up().direction()), outputs);
            let camera = Some(SequenceCamera { asked: asked_camera(outputs), framed });
            return Some(SequenceRecord { camera, ..record });
        }
        if measured.changed.is_some() {
            return None;
        }
    }
    None
}

/// A box that holds what a fluid in this one may come to: it is wider by half its height on each side.
fn widened([least, greatest]: [DVec3; 2], up: DVec3) -> [DVec3; 2] {
    let aside = (DVec3::ONE - up) * (0.5 * (greatest - least).dot(up));
    [least - aside, greatest + aside]
}

/// What the user chose, in short: with other choices, a sequence is another.
fn choices_fingerprint(watch: &Watch) -> String {
    format!("{:016x}", XxHash3_64::oneshot(format!("{:?}", watch.choices).as_bytes()))
}
