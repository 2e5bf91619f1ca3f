//! The settings of each sequence: fixed once, and kept.
//!
//! ```text
//!   voxel size given ────────────────────────────────┐
//!   in the journal, from an earlier run ─────────────┼──▶ fixed: every frame has the same
//!   measured on the first frame, in natural order, ──┘
//!   that has enough particles
//! ```
//!
//! Until then, frames that are complete are held. A frame that comes before them by name, and is
//! still being written, is waited for: what is measured must not depend on which of two files was
//! finished first, or on the order in which frames are converted.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use twox_hash::XxHash3_64;

use crate::pipeline::{
    FileStamp, FrameError, FrameFile, Framed, Framing, ObstacleFiles, ObstacleStamps, OutputOptions,
    PictureOptions, automatic_voxel_size, file_of, have_fallen_apart, sequence_bounds, settings_fingerprint,
};
use crate::settings::{OwnRadii, Settings};

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
    /// To be measured on the first frame there is; and where its particles have radii of their own.
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
    /// The settings, where they need no measuring: the voxel size was given, or is remembered, and so is the camera if
    /// there are to be pictures.
    pub(super) fn new(watch: &Watch, remembered: Option<&SequenceRecord>) -> SequenceSettings {
        let voxel_size = watch.voxel_size.or(remembered.map(|record| record.voxel_size));
        let lacks_camera = watch.outputs.needs_camera() && framing_of(watch, remembered).is_none();
        let unknown = || watch.choices.own_radii().map(SequenceSettings::Unknown);
        let settings = match voxel_size {
            None => unknown(),
            Some(voxel_size) => Settings::resolve(voxel_size, &watch.choices).and_then(|settings| {
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
/// voxel size is neither given nor remembered.
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
    /// What is known already: the voxel size, where only the camera is not.
    pub(super) known: Option<SequenceRecord>,
    /// What was asked for.
    pub(super) watch: Watch,
}

/// What came of it.
#[derive(Debug)]
pub(super) struct Measured {
    /// Which sequence.
    pub(super) sequence: usize,
    /// The voxel size and where it is from, if one of the files tells.
    pub(super) record: Option<SequenceRecord>,
    /// Files with too few particles.
    pub(super) sparse: Vec<(PathBuf, FileStamp)>,
    /// Files that cannot be read.
    pub(super) unreadable: Vec<(PathBuf, FileStamp, FrameError)>,
    /// A file that was written again meanwhile: with it, nothing is known.
    pub(super) changed: Option<PathBuf>,
}

/// Looks at the files one by one until the spacing is known.
pub(super) fn measure(mut order: MeasureOrder) -> Measured {
    let mut measured = Measured {
        sequence: order.sequence,
        record: None,
        sparse: Vec::new(),
        unreadable: Vec::new(),
        changed: None,
    };
    for (path, stamp) in std::mem::take(&mut order.files) {
        let found = measured_on(&path, &order);
        if FileStamp::of_path(file_of(&path)).ok() != Some(stamp) {
            measured.changed = Some(path);
            break;
        }
        match found {
            Ok(Some(record)) => {
                measured.record = Some(record);
                break;
            }
            Ok(None) => measured.sparse.push((path, stamp)),
            Err(error) => measured.unreadable.push((path, stamp, error)),
        }
    }
    measured
}

/// What a frame says of its sequence; `None` if it has too few particles.
fn measured_on(path: &Path, order: &MeasureOrder) -> Result<Option<SequenceRecord>, FrameError> {
    let record = match &order.known {
        Some(record) => record.clone(),
        None => match automatic_voxel_size([path], order.own_radii.as_ref()) {
            Ok(automatic) => SequenceRecord {
                voxel_size: automatic.voxel_size,
                spacing: Some(automatic.spacing),
                measured_on: Some(automatic.measured_on),
                camera: None,
            },
            Err(none) => return none.unreadable.map_or(Ok(None), Err),
        },
    };
    let outputs = &order.watch.outputs;
    if !outputs.needs_camera() {
        return Ok(Some(record));
    }
    let settings = Settings::resolve(record.voxel_size, &order.watch.choices);
    let radius = settings.map_or(record.voxel_size, |settings| settings.radius_min);
    let Some(bounds) = sequence_bounds(&[path], radius)? else { return Ok(None) };
    let framed = Framed::around(widened(bounds, outputs.up().direction()), outputs);
    let camera = Some(SequenceCamera { asked: asked_camera(outputs), framed });
    Ok(Some(SequenceRecord { camera, ..record }))
}

/// A box that holds what a fluid in this one may come to: it is wider by half its height on each side.
fn widened([least, greatest]: [DVec3; 2], up: DVec3) -> [DVec3; 2] {
    let aside = (DVec3::ONE - up) * (0.5 * (greatest - least).dot(up));
    [least - aside, greatest + aside]
}

/// What the user chose, in short: with other choices, a sequence is another.
fn choices_fingerprint(watch: &Watch) -> String {
    let chosen = format!("{:?} {:?}", watch.voxel_size, watch.choices);
    format!("{:016x}", XxHash3_64::oneshot(chosen.as_bytes()))
}
