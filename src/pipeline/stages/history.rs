//! Follows the particles of a frame back through the frames before it, to their rest coordinates (`--rest`).
//!
//! ```text
//!   frame 3   frame 4   frame 5 ──▶ origins since frame 3: from which frame 6 gets its rest coordinates
//! ```
//!
//! The origins of one frame serve the next one, which adds only the frame between them. Each is read for itself and for
//! its successor, unless the successor comes right after it.

use std::path::PathBuf;

use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::input::around::{FoundFrame, not_averaged};
use crate::pipeline::input::attributes::AttributeRequest;
use crate::pipeline::input::frame::Frame;
use crate::pipeline::warning::Warning;
use crate::surface::options::{REST_NAMES, RestAt, Settings};
use crate::surface::origins::Origins;
use crate::surface::particles::{
    Attribute, AttributeValues, OwnedPositions, ParticleCloud, Role, ids_of, unique_ids,
};

use super::compute::is_of_content;
use super::frame_cache::FrameCache;
use super::{StageContext, lock};

/// The origins that were collected last, by the number from which they were and the first frame.
pub(super) type KnownHistories = FrameCache<(i64, Option<PathBuf>), KnownHistory>;

/// The frames whose particles were followed, and the origins of these.
#[derive(Default)]
pub(super) struct KnownHistory {
    /// The frames that were added, in order.
    frames: Vec<AddedFrame>,
    origins: Origins,
}

struct AddedFrame {
    of: HistoryFrame,
    /// Why nothing of it was added.
    warning: Option<Warning>,
}

/// A frame before another one.
#[derive(Clone, Debug, PartialEq, Eq)]
struct HistoryFrame {
    path: PathBuf,
    number: i64,
    /// The hash of its bytes; `None` if it cannot be read now.
    hash: Option<u128>,
}

impl KnownHistory {
    pub(super) fn size_bytes(&self) -> u64 {
        let frame = |frame: &AddedFrame| size_of_val(frame) + frame.of.path.as_os_str().len();
        self.origins.size_bytes() + self.frames.iter().map(frame).sum::<usize>() as u64
    }

    /// Whether it has only frames that are wanted, or all that are wanted and later ones.
    fn suits(&self, wanted: &[HistoryFrame]) -> bool {
        let is_same = |(added, wanted): (&AddedFrame, &HistoryFrame)| added.of == *wanted;
        self.frames.iter().zip(wanted).all(is_same)
    }
}

/// What following particles leaves to report.
#[derive(Default)]
pub(super) struct HistoryNotes {
    pub(super) warnings: Vec<Warning>,
    /// The frames that could not be read, and may be at the next attempt: by how many frames each is later.
    pub(super) unread: Vec<i32>,
    /// Whether the velocities are not those of the file.
    pub(super) has_computed_velocities: bool,
}

impl StageContext<'_> {
    /// Adds the rest coordinates to the particles of a frame, if the settings ask for them. The hash is that of the
    /// frame's bytes.
    pub(super) fn follow_back(
        &self,
        cloud: &mut ParticleCloud,
        (frame, hash): (&Frame, u128),
        around: &[FoundFrame],
    ) -> HistoryNotes {
        let mut notes = HistoryNotes::default();
        let settings = &*frame.settings;
        let Some((ids, rest)) = ids_of(&cloud.attributes).zip(settings.rest) else { return notes };
        // A frame without a number follows none.
        let number = frame.number.unwrap_or(i64::MIN);
        let mut given = FollowedFrame {
            frame,
            number,
            hash,
            ids,
            positions: &cloud.positions,
            around,
            notes: &mut notes,
        };
        let RestAt { rest, second } = rest.at(number);
        let mut found = vec![vector(REST_NAMES[0], self.positions_since(rest, &mut given))];
        if let Some((second, weight)) = second {
            found.push(vector(REST_NAMES[1], self.positions_since(second, &mut given)));
            let weights = AttributeValues::Numbers(vec![weight; cloud.positions.len()]);
            let name = REST_NAMES[2].to_owned();
            found.push(Attribute { name, role: Role::Other, arity: 1, values: weights });
        }
        // The option names them, so attributes of these names in the file do not count.
        let is_replaced = |given: &Attribute| REST_NAMES.contains(&&*given.name);
        if !ids.is_empty() && unique_ids(ids).is_empty() {
            notes.warnings.push(Warning::new(
                "rest coordinates are those of this frame: the particles have no ids of their own, by which they could be \
                 followed",
            ));
        }
        cloud.attributes.retain(|given| !is_replaced(given));
        cloud.attributes.append(&mut found);
        notes.warnings.dedup();
        notes
    }

    /// Where the particles appeared in the frames since `first`: see [`Origins::positions`].
    fn positions_since(&self, first: i64, given: &mut FollowedFrame<'_>) -> Vec<f32> {
        let settings = &given.frame.settings;
        let wanted: Vec<HistoryFrame> = given.frames_since(first);
        let mut histories = lock(&self.histories);
        let known = histories.take(settings, |known| !wanted.is_empty() && known.suits(&wanted));
        let mut history = known.unwrap_or_default();
        let added = history.frames.len().min(wanted.len());
        for frame in &wanted[added..] {
            let (mut of, mut warning) = (frame.clone(), None);
            if let Some(Err(error)) = frame.hash.map(|hash| self.add(&mut history, settings, frame, hash)) {
                warning = Some(not_averaged(&error));
                if !is_of_content(&error.cause, "") {
                    of.hash = None;
                    given.notes.unread.push(given.steps_to(frame.number));
                }
            }
            history.frames.push(AddedFrame { of, warning });
        }
        let used = &history.frames[..wanted.len()];
        given.notes.warnings.extend(used.iter().filter_map(|added| added.warning.clone()));
        let FollowedFrame { frame, number, hash, ids, positions, .. } = *given;
        let result = history.origins.positions(ids, positions, number);
        if history.frames.len() == wanted.len() && frame.number.is_some() && first <= number {
            history.origins.add(ids, positions, number);
            let of = HistoryFrame { path: frame.input.clone(), number, hash: Some(hash) };
            history.frames.push(AddedFrame { of, warning: None });
        }
        let key = (first, wanted.first().map(|frame| frame.path.clone()));
        histories.keep(key, settings, history, usize::MAX);
        result
    }

    fn add(
        &self,
        history: &mut KnownHistory,
        settings: &Settings,
        frame: &HistoryFrame,
        hash: u128,
    ) -> Result<(), FrameError> {
        let wanted = AttributeRequest::to_follow(&settings.reading);
        let cloud = self.particles_of(&frame.path, hash, &wanted)?;
        if cloud.positions.is_empty() {
            return Ok(());
        }
        let missing = || FrameError {
            path: frame.path.clone(),
            during: Stage::Read,
            cause: Cause::Missing("the particles have no ids that are whole numbers".to_owned()),
        };
        let ids = ids_of(&cloud.attributes).filter(|ids| ids.len() == cloud.positions.len());
        history.origins.add(ids.ok_or_else(missing)?, &cloud.positions, frame.number);
        Ok(())
    }
}

/// A frame whose particles are followed back.
struct FollowedFrame<'a> {
    frame: &'a Frame,
    number: i64,
    /// The hash of its bytes.
    hash: u128,
    ids: &'a [i64],
    positions: &'a OwnedPositions,
    around: &'a [FoundFrame],
    notes: &'a mut HistoryNotes,
}

impl FollowedFrame<'_> {
    /// The frames before it, from this number on.
    fn frames_since(&self, first: i64) -> Vec<HistoryFrame> {
        let is_history = |found: &&FoundFrame| (first..self.number).contains(&found.frame.number);
        let frame = |found: &FoundFrame| HistoryFrame {
            path: found.frame.path.clone(),
            number: found.frame.number,
            hash: found.content.as_ref().map(|content| content.hash),
        };
        self.around.iter().filter(is_history).map(frame).collect()
    }

    /// By how many frames the frame with this number is later.
    fn steps_to(&self, number: i64) -> i32 {
        let found = self.around.iter().find(|found| found.frame.number == number);
        found.map_or(0, |found| found.frame.steps)
    }
}

fn vector(name: &str, values: Vec<f32>) -> Attribute {
    Attribute { name: name.to_owned(), role: Role::Rest, arity: 3, values: AttributeValues::Numbers(values) }
}
