//! Keeps particles on one side for at least K frames.
//!
//! ```text
//!   apart in the frame         . # . . # # # # . # # # . . . # . .       K = 3
//!   in rows of K or more       . . . . # # # # . # # # . . . . . .       short rows stay in the mesh,
//!   gaps of K or more          . . . . # # # # # # # # . . . . . .       then short gaps stay spray
//! ```
//!
//! The first step needs the K − 1 frames on each side. The second needs the results of the first in as many frames. So a
//! frame depends on 2 (K − 1) frames on each side of it. The result is the same in whatever order, and on however many
//! machines, the frames of a sequence are converted. A frame that is missing, or does not have the particle, contradicts
//! nothing.

use crate::particles::unique_ids;

/// Which particles of a frame are apart, by their ids.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FrameSides {
    /// The ids that one particle has: ranges from the first to the last, sorted.
    present: Vec<[i64; 2]>,
    /// Those of particles that are apart, sorted.
    apart: Vec<i64>,
}

impl FrameSides {
    /// The sides of the particles with these ids. One without a side counts as missing in the frame.
    pub fn of(ids: &[i64], is_apart: &[Option<bool>]) -> FrameSides {
        let mut index_of_id = unique_ids(ids);
        index_of_id.retain(|_, index| is_apart[*index as usize].is_some());
        let mut all: Vec<i64> = index_of_id.keys().copied().collect();
        all.sort_unstable();
        let ranges = all.chunk_by(|one, next| one.checked_add(1) == Some(*next));
        let present = ranges.filter_map(|range| Some([*range.first()?, *range.last()?])).collect();
        let mut apart: Vec<i64> =
            ids.iter().zip(is_apart).filter(|(_, is)| **is == Some(true)).map(|(id, _)| *id).collect();
        apart.retain(|id| index_of_id.contains_key(id));
        apart.sort_unstable();
        FrameSides { present, apart }
    }

    /// Whether no particle has an id of its own.
    pub fn is_empty(&self) -> bool {
        self.present.is_empty()
    }

    /// The memory of the sides, in bytes.
    pub fn size_bytes(&self) -> usize {
        size_of_val(&*self.present) + size_of_val(&*self.apart)
    }

    /// Whether the particle is apart; `None` if the frame does not have it.
    fn is_apart(&self, id: i64) -> Option<bool> {
        let range = self.present.partition_point(|[_, last]| *last < id);
        let is_present = self.present.get(range).is_some_and(|[first, _]| *first <= id);
        is_present.then(|| self.apart.binary_search(&id).is_ok())
    }
}

/// The number of frames on each side on which the side of a particle depends.
pub fn frames_needed(keep: u32) -> u32 {
    keep.saturating_sub(1).saturating_mul(2)
}

/// Whether each particle is spray, and for how many frames before this one it has been apart in a row. `own` are the
/// same sides by ids; `around` are other frames, each with the number of frames by which it is later.
pub fn steady_sides(
    ids: &[i64],
    is_apart: &[Option<bool>],
    own: &FrameSides,
    around: &[(i32, &FrameSides)],
    keep: u32,
) -> (Vec<bool>, Vec<u32>) {
    let reach = frames_needed(keep) as usize;
    let mut frames: Vec<Option<&FrameSides>> = vec![None; 2 * reach + 1];
    frames[reach] = Some(own);
    for (steps, sides) in around {
        let index = usize::try_from(*steps + reach as i32).ok().filter(|index| *index != reach);
        if let Some(frame) = index.and_then(|index| frames.get_mut(index)) {
            *frame = Some(sides);
        }
    }
    // The others are in the mesh in all frames.
    let mut candidates: Vec<i64> =
        frames.iter().flatten().flat_map(|frame| frame.apart.iter().copied()).collect();
    candidates.sort_unstable();
    candidates.dedup();
    let side = |(&id, &is_apart): (&i64, &Option<bool>)| {
        if own.is_apart(id).is_none() {
            // Several particles have the id, or this one has no side.
            return (is_apart == Some(true), 0);
        }
        if candidates.binary_search(&id).is_err() {
            return (false, 0);
        }
        let apart: Vec<Option<bool>> =
            frames.iter().map(|frame| frame.and_then(|frame| frame.is_apart(id))).collect();
        // A missing frame contradicts nothing, and does not count.
        let before =
            apart[..reach].iter().rev().take_while(|is_apart| **is_apart != Some(false)).flatten().count();
        (is_steady(&apart, keep.max(1) as usize), before as u32)
    };
    ids.iter().zip(is_apart).map(side).unzip()
}

/// Whether a particle is spray in the middle one of 4 K − 3 frames.
fn is_steady(apart: &[Option<bool>], keep: usize) -> bool {
    let middle = apart.len() / 2;
    // Whether a frame is in K frames in a row of which none says otherwise.
    let is_in_row = |frames: &[Option<bool>], at: usize, side: bool| {
        (at + 1 - keep..=at).any(|first| {
            let row = frames.get(first..first + keep).unwrap_or_default();
            row.len() == keep && row.iter().all(|found| *found != Some(!side))
        })
    };
    let mut rows: Vec<Option<bool>> = vec![None; apart.len()];
    for at in middle + 1 - keep..middle + keep {
        rows[at] = apart[at].map(|is_apart| is_apart && is_in_row(apart, at, true));
    }
    rows[middle] == Some(true) || !is_in_row(&rows[middle + 1 - keep..middle + keep], keep - 1, false)
}
