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

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use twox_hash::XxHash3_64;

use crate::pipeline::{
    FileStamp, FrameError, Framing, Job, ObstacleStamps, OutputOptions, PictureOptions, ReportedWarnings,
    have_fallen_apart, settings_fingerprint,
};
use crate::surface::options::{self, OwnRadii, Settings};
use crate::watch::config::Watch;
use crate::watch::journal::{JournaledSequence, SequenceCamera, SequenceKey};

use super::frames::FrameId;

/// All sequences that were met.
#[derive(Debug, Default)]
pub(crate) struct Sequences {
    all: Vec<WatchedSequence>,
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
pub(crate) struct WatchedSequence {
    /// What the journal knows it by.
    pub(crate) key: SequenceKey,
    /// The index of its root.
    pub(crate) root: usize,
    /// The kin that counts it as a sequence of one frame, as long as it has no more.
    single_in: Option<(usize, PathBuf, String)>,
    /// Its settings, or what is missing.
    pub(crate) settings: SequenceSettings,
    /// The camera that was placed for its pictures, if one had to be.
    pub(crate) framing: Option<Arc<Framing>>,
    /// That its frames wait for one with more particles was told.
    pub(crate) is_sparse_logged: bool,
    /// Which warnings about its frames were logged.
    pub(crate) reported: ReportedWarnings,
    /// Whether it was logged that its frames have velocities which the outputs lack.
    pub(crate) has_reported_velocity: bool,
}

impl WatchedSequence {
    /// The fingerprint of the settings and of the obstacles of a frame; empty while there are no settings.
    pub(crate) fn fingerprint(&self, obstacles: Option<&ObstacleStamps>) -> String {
        match &self.settings {
            SequenceSettings::Fixed(settings, fingerprint) => {
                fingerprint_with(settings, fingerprint, obstacles)
            }
            _ => String::new(),
        }
    }
}

/// The settings of a sequence, or what is missing.
#[derive(Clone, Debug)]
pub(crate) enum SequenceSettings {
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
    pub(crate) fn index(
        &mut self,
        id: &FrameId,
        watch: &Watch,
        remembered: impl FnOnce(&SequenceKey) -> Option<JournaledSequence>,
    ) -> usize {
        let file = id.frame_file();
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
        self.all.push(WatchedSequence {
            key,
            root: id.root,
            single_in,
            settings,
            framing,
            is_sparse_logged: false,
            reported: ReportedWarnings::default(),
            has_reported_velocity: false,
        });
        self.index_of.insert(place, self.all.len() - 1);
        self.all.len() - 1
    }

    /// Folders in which this many sequences or more, and most of those whose names differ in their numbers only, have one
    /// frame; each is named once: its root, the folder, and how many.
    pub(crate) fn newly_fallen_apart(&mut self, count_min: usize) -> Vec<(usize, PathBuf, usize)> {
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

    pub(crate) fn get(&self, index: usize) -> &WatchedSequence {
        &self.all[index]
    }

    /// How many there are.
    pub(crate) fn len(&self) -> usize {
        self.all.len()
    }

    pub(crate) fn get_mut(&mut self, index: usize) -> &mut WatchedSequence {
        &mut self.all[index]
    }
}

impl SequenceSettings {
    /// The settings, where they need no measuring: the particle spacing was given, or is remembered, and so is the camera if
    /// there are to be pictures.
    pub(crate) fn new(watch: &Watch, remembered: Option<&JournaledSequence>) -> SequenceSettings {
        let measured =
            remembered.and_then(|record| record.measured.as_ref()).map(options::SequenceSpacing::from);
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
pub(crate) fn framing_of(watch: &Watch, remembered: Option<&JournaledSequence>) -> Option<Arc<Framing>> {
    let SequenceCamera { asked, framed } = remembered?.camera.as_ref()?;
    let is_asked = watch.outputs.needs_camera() && *asked == asked_camera(&watch.outputs);
    is_asked.then(|| Arc::new(Framing::new(&watch.outputs, framed.clone())))
}

/// All that a camera depends on beside the frame.
pub(crate) fn asked_camera(outputs: &OutputOptions) -> String {
    let PictureOptions { size: [width, height], camera } = outputs.picture;
    format!("{width}x{height} {camera} {:?}", outputs.up())
}

/// The fingerprint of the settings, and of the files of obstacles if there are any: by their stamps, because they are
/// compared without being read.
pub(crate) fn fingerprint_with(
    settings: &Settings,
    fingerprint: &str,
    obstacles: Option<&ObstacleStamps>,
) -> String {
    let Some(stamps) = obstacles else { return fingerprint.to_owned() };
    let text = format!("{fingerprint}\n{}\n{}", settings.void_threshold, stamps.text);
    format!("{:016x}", XxHash3_64::oneshot(text.as_bytes()))
}

/// What a sequence is to be measured on.
#[derive(Debug)]
pub(crate) struct MeasureOrder {
    /// Which sequence.
    pub(crate) sequence: usize,
    /// Its complete frames, in natural order, and what they were when they were found complete.
    pub(crate) files: Vec<(FrameId, FileStamp)>,
    /// Where its particles have radii of their own.
    pub(crate) own_radii: Option<OwnRadii>,
    /// What is known already: the particle spacing, where only the camera is not.
    pub(crate) known: Option<JournaledSequence>,
    /// What was asked for.
    pub(crate) watch: Watch,
}

/// What came of it.
#[derive(Debug)]
pub(crate) struct SpacingResult {
    /// Which sequence.
    pub(crate) sequence: usize,
    /// The particle spacing and where it is from, if one of the files tells.
    pub(crate) record: Option<JournaledSequence>,
    /// Files with too few particles.
    pub(crate) sparse: Vec<(FrameId, FileStamp)>,
    /// Files that cannot be read.
    pub(crate) unreadable: Vec<(FrameId, FileStamp, FrameError)>,
    /// A file that was written again meanwhile: with it, nothing is known.
    pub(crate) changed: Option<FrameId>,
    /// What should make a user check the spacing.
    pub(crate) warnings: Vec<String>,
}

/// What the user chose, in short: with other choices, a sequence is another.
pub(crate) fn choices_fingerprint(watch: &Watch) -> String {
    format!("{:016x}", XxHash3_64::oneshot(format!("{:?}", watch.choices).as_bytes()))
}
