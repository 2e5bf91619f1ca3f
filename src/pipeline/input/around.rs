//! The frames before and after a frame on which its surface depends: with which it is averaged (`--temporal`), which say
//! what is spray (`--spray`), from which its particles come (`--rest`), and from which their velocities follow (`--time-step`).

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ops::Bound;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use twox_hash::XxHash3_128;

use super::frame::Frame;
use super::obstacles::ObstacleFiles;
use super::reading::hash_and_stamp;
use super::source::FrameFile;
use super::steps::{IndexPolicy, file_of, frame_name};
use crate::pipeline::error::{FrameError, Stage};
use crate::pipeline::files::json::hex;
use crate::pipeline::files::stamp::FileStamp;
use crate::pipeline::warning::Warning;
use crate::surface::options::{FrameReach, Settings};
use crate::surface::temporal::TemporalReport;
use crate::surface::words::pluralize;

/// A frame before or after another one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AroundFrame {
    /// By how many frames it is later; negative if it is earlier.
    pub steps: i32,
    /// Its file.
    pub path: PathBuf,
    /// Its number.
    pub number: i64,
}

/// A frame before or after another one, when that one was read.
#[derive(Clone, Debug)]
pub(crate) struct FoundFrame {
    pub(crate) frame: AroundFrame,
    /// `None` if the frame is left out, because it could not be read or computed.
    pub(crate) content: Option<FrameContent>,
}

/// What the level set of a frame is made from, besides the settings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FrameContent {
    pub(crate) path: PathBuf,
    /// The hash of its bytes.
    pub(crate) hash: u128,
    /// The names and hashes of its obstacle files.
    pub(crate) obstacles: String,
}

/// A frame before or after another one in the record of that one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedAround {
    /// By how many frames it is later; negative if it is earlier. The least number for those of a history, together.
    pub steps: i32,
    /// Its name, without folder; of a history, how many frames it has, and the names of the first and the last.
    pub name: String,
    /// The hash of its bytes; `None` if it was left out, because it could not be read or computed.
    #[serde(with = "hex::option", default, skip_serializing_if = "Option::is_none")]
    pub hash: Option<u128>,
    /// The names and hashes of its obstacle files.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub obstacles: String,
}

impl AroundFrame {
    /// The frame as records contain it: independent of the folder that it is in.
    pub fn recorded(&self, hash: Option<u128>, obstacles: &str) -> RecordedAround {
        let (name, obstacles) = (frame_name(&self.path), obstacles.to_owned());
        RecordedAround { steps: self.steps, name, hash, obstacles }
    }
}

impl RecordedAround {
    /// Whether it is the frames of a history, together.
    pub fn is_history(&self) -> bool {
        self.steps == HISTORY_STEPS
    }

    /// These frames, of which those farther than `beside` steps are one: there may be very many.
    pub fn with_history(all: Vec<RecordedAround>, beside: u32) -> Vec<RecordedAround> {
        let (history, beside): (Vec<_>, Vec<_>) =
            all.into_iter().partition(|around| around.steps.unsigned_abs() > beside);
        let Some((first, last)) = history.first().zip(history.last()) else { return beside };
        let hashed = |around: &RecordedAround| {
            let name = around.name.as_bytes().iter().copied();
            around.hash.unwrap_or(0).to_le_bytes().into_iter().chain(name).chain([0]).collect::<Vec<u8>>()
        };
        let bytes: Vec<u8> = history.iter().flat_map(hashed).collect();
        let name = format!("{} from {} to {}", pluralize(history.len(), "frame"), first.name, last.name);
        let hash = Some(XxHash3_128::oneshot(&bytes));
        let history = RecordedAround { steps: HISTORY_STEPS, name, hash, obstacles: String::new() };
        std::iter::once(history).chain(beside).collect()
    }
}

/// In place of a number of steps, for the frames of a history.
const HISTORY_STEPS: i32 = i32::MIN;

/// The frames as records contain them: see [`RecordedAround::with_history`].
pub(crate) fn recorded(around: &[FoundFrame], beside: u32) -> Vec<RecordedAround> {
    let recorded = |FoundFrame { frame, content }: &FoundFrame| match content {
        Some(FrameContent { hash, obstacles, .. }) => frame.recorded(Some(*hash), obstacles),
        None => frame.recorded(None, ""),
    };
    RecordedAround::with_history(around.iter().map(recorded).collect(), beside)
}

/// The frames of a sequence by their numbers.
#[derive(Clone, Debug)]
pub struct NumberedFrames<T> {
    /// Several frames with one number are between it and the next: they are averaged with none.
    frames: BTreeMap<i64, Vec<T>>,
    /// How often each difference between a number and the next occurs.
    gaps: BTreeMap<i64, usize>,
    /// The same, by count. The last one is a step: the most frequent difference, and the smallest of these.
    by_count: BTreeSet<(usize, Reverse<i64>)>,
}

impl<T> Default for NumberedFrames<T> {
    fn default() -> NumberedFrames<T> {
        NumberedFrames { frames: BTreeMap::new(), gaps: BTreeMap::new(), by_count: BTreeSet::new() }
    }
}

impl<T: PartialEq> NumberedFrames<T> {
    /// Adds a frame. Returns whether that changes how far apart frames are.
    pub fn insert(&mut self, number: i64, frame: T) -> bool {
        let step = self.step();
        let of_number = self.frames.entry(number).or_default();
        if of_number.contains(&frame) {
            return false;
        }
        of_number.push(frame);
        if of_number.len() > 1 {
            return false;
        }
        let [before, after] = self.gaps_at(number);
        self.count_gaps([between(before, after)], false);
        self.count_gaps([before, after], true);
        self.step() != step
    }

    /// Removes a frame. Returns whether that changes how far apart frames are.
    pub fn remove(&mut self, number: i64, frame: &T) -> bool {
        let step = self.step();
        let Some(of_number) = self.frames.get_mut(&number) else { return false };
        of_number.retain(|other| other != frame);
        if !of_number.is_empty() {
            return false;
        }
        self.frames.remove(&number);
        let [before, after] = self.gaps_at(number);
        self.count_gaps([before, after], false);
        self.count_gaps([between(before, after)], true);
        self.step() != step
    }

    /// By how much numbers of frames next to each other differ.
    pub fn step(&self) -> Option<i64> {
        self.by_count.last().map(|(_, Reverse(gap))| *gap)
    }

    /// The differences between a number and those before and after it.
    fn gaps_at(&self, number: i64) -> [Option<i64>; 2] {
        let before = self.frames.range(..number).next_back().and_then(|(at, _)| number.checked_sub(*at));
        let after = self.frames.range((Bound::Excluded(number), Bound::Unbounded)).next();
        [before, after.and_then(|(at, _)| at.checked_sub(number))]
    }

    fn count_gaps(&mut self, gaps: impl IntoIterator<Item = Option<i64>>, are_added: bool) {
        for gap in gaps.into_iter().flatten() {
            let former = self.gaps.remove(&gap).unwrap_or(0);
            self.by_count.remove(&(former, Reverse(gap)));
            let count = if are_added { former + 1 } else { former.saturating_sub(1) };
            if count > 0 {
                self.gaps.insert(gap, count);
                self.by_count.insert((count, Reverse(gap)));
            }
        }
    }

    /// Whether a frame up to `reach` steps before or after this one is missing although there are frames at its
    /// number or beyond, or this one shares its number.
    pub fn is_beside_gap(&self, number: i64, reach: u32) -> bool {
        let is_missing = |steps: i64| {
            let far = self.step().and_then(|step| step.checked_mul(steps));
            far.and_then(|far| number.checked_add(far)).is_some_and(|at| {
                let mut beyond = if steps < 0 { self.frames.range(..=at) } else { self.frames.range(at..) };
                self.only(at).is_none() && beyond.next().is_some()
            })
        };
        let reach = i64::from(reach);
        self.only(number).is_none() || (-reach..=reach).any(|steps| steps != 0 && is_missing(steps))
    }

    /// Whether a frame up to `reach` steps after this one may still come.
    pub fn may_grow_after(&self, number: i64, reach: u32) -> bool {
        let is_free = |step: i64, steps: u32| {
            let number = step.checked_mul(steps.into()).and_then(|far| number.checked_add(far));
            number.is_some_and(|number| !self.frames.contains_key(&number))
        };
        reach > 0
            && self.only(number).is_some()
            && self.step().is_none_or(|step| (1..=reach).any(|steps| is_free(step, steps)))
    }

    /// The frame with this number, if only one has it.
    pub fn only(&self, number: i64) -> Option<&T> {
        match &self.frames.get(&number)?[..] {
            [frame] => Some(frame),
            _ => None,
        }
    }

    /// The frames that a frame depends on, in order, with the number of steps and their numbers. Where one beside it is
    /// missing, the others keep their distance. A frame without a number, or with one that others have, too, depends on no
    /// other one.
    pub fn around(&self, number: Option<i64>, reach: FrameReach) -> Vec<(i32, i64, &T)> {
        let Some(number) = number.filter(|number| self.only(*number).is_some()) else { return Vec::new() };
        let Some(step) = self.step() else { return Vec::new() };
        let beside = i32::try_from(reach.beside).unwrap_or(i32::MAX / 2);
        let first = reach.first(number).unwrap_or(number);
        // Those of the history need not be at equal distances: they are counted back.
        let is_beside = |at: i64| {
            steps_between(number, at, step).is_some_and(|steps| steps.unsigned_abs() <= reach.beside)
        };
        let before = self.frames.range(first..number).rev().filter(|(at, _)| !is_beside(**at));
        let before = before.filter_map(|(at, _)| Some((*at, self.only(*at)?))).take(HISTORY_MAX);
        let counted = before.zip(1..).map(|((at, frame), back)| (-beside - back, at, frame));
        let mut around: Vec<(i32, i64, &T)> = counted.collect();
        around.reverse();
        let frame = |steps: i32| {
            let number = number.checked_add(step.checked_mul(steps.into())?)?;
            Some((steps, number, self.only(number)?))
        };
        around.extend((-beside..=beside).filter(|steps| *steps != 0).filter_map(frame));
        around
    }

    /// The frames that depend on those with this number.
    pub fn dependent(&self, number: i64, reach: FrameReach) -> Vec<&T> {
        let is_dependent = |at: &i64| {
            let depends = |step: i64| {
                let steps = steps_between(*at, number, step).map(i32::unsigned_abs);
                steps.is_some_and(|steps| steps != 0 && steps <= reach.beside)
            };
            self.step().is_some_and(depends)
                || number < *at && reach.first(*at).is_some_and(|first| first <= number)
        };
        // Only frames nearby depend on those beside them.
        let far = self.step().unwrap_or(0).saturating_mul(reach.beside.into());
        let last = if reach.has_history() { i64::MAX } else { number.saturating_add(far) };
        let range = self.frames.range(number.saturating_sub(far)..=last);
        range.filter(|(at, _)| is_dependent(at)).filter_map(|(at, _)| self.only(*at)).collect()
    }
}

impl NumberedFrames<PathBuf> {
    /// All frames of a sequence.
    pub fn of_files<'a>(files: impl IntoIterator<Item = &'a FrameFile>) -> NumberedFrames<PathBuf> {
        let mut numbered = NumberedFrames::default();
        for (number, path) in files.into_iter().filter_map(|file| Some((file.number()?, &file.path))) {
            numbered.insert(number, path.clone());
        }
        numbered
    }

    /// Like [`around`](Self::around), for a [frame](super::frame::Frame).
    pub fn frames_around(&self, number: Option<i64>, reach: FrameReach) -> Arc<[AroundFrame]> {
        let frame =
            |(steps, number, path): (i32, i64, &PathBuf)| AroundFrame { steps, path: path.clone(), number };
        self.around(number, reach).into_iter().map(frame).collect()
    }
}

/// The most frames before a frame that it depends on.
const HISTORY_MAX: usize = 100_000;

/// By how many steps a number is greater than another one, if it is a whole number of them.
fn steps_between(number: i64, other: i64, step: i64) -> Option<i32> {
    let far = other.checked_sub(number)?;
    if far.checked_rem(step)? == 0 { i32::try_from(far / step).ok() } else { None }
}

/// The difference between the numbers before and after one, from its differences to both.
fn between(before: Option<i64>, after: Option<i64>) -> Option<i64> {
    before?.checked_add(after?)
}

/// Hashes of files that were read to compare them, by path. Each frame of a sequence is hashed for those around it,
/// too.
#[derive(Default)]
pub(crate) struct KnownHashes(Mutex<HashMap<PathBuf, (FileStamp, u128)>>);

/// More files than any frames in flight have around them, except those with a long history.
const HASHES_MAX: usize = 1 << 16;

impl KnownHashes {
    /// The hash of a frame's bytes.
    fn of(&self, path: &Path, index_policy: IndexPolicy) -> meniscus_formats::Result<u128> {
        let known = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let now = FileStamp::of_path(file_of(path))?;
        if let Some((stamp, hash)) = known().get(path)
            && *stamp == now
        {
            return Ok(*hash);
        }
        let (hash, stamp) = hash_and_stamp(path, index_policy)?;
        let mut known = known();
        if known.len() >= HASHES_MAX {
            known.clear();
        }
        known.insert(path.to_owned(), (stamp, hash));
        Ok(hash)
    }
}

/// Finds and hashes the frames around a frame, with their obstacles. One that cannot be read now is left out, with
/// a warning; also warns if none can be found, because the frame has no number.
pub(crate) fn find_around(
    frame: &Frame,
    hashes: &KnownHashes,
    index_policy: IndexPolicy,
) -> (Vec<FoundFrame>, Vec<Warning>) {
    let mut warnings = Vec::new();
    let (reach, Settings { temporal, rest, .. }) = (frame.settings.frame_reach(), &*frame.settings);
    let needs_number = *temporal > 0 || reach.has_history() || frame.settings.computes_velocities();
    if needs_number && frame.number.is_none() {
        warnings.push(Warning::new(
            "the frame depends on no others, although an option wants that: its name has no frame number; times in names do \
             not count",
        ));
    }
    if let (Some(rest), Some(number)) = (rest, frame.number) {
        let first = i64::from(rest.first);
        let is_wanted = first < number && rest.at(number).first() == first;
        if is_wanted && !frame.around.iter().any(|around| around.number == first) {
            warnings.push(Warning::new(format!(
                "frame {first}, which --rest names, is missing or there twice: particles have the position at which they \
                 appeared after it"
            )));
        }
    }
    let mut find = |around: &AroundFrame| {
        // The level sets of the history are not needed.
        let is_beside = around.steps.unsigned_abs() <= reach.beside;
        let obstacles = is_beside.then_some(&*frame.obstacles);
        let content = content_of(around, obstacles, hashes, index_policy);
        let content = content.map_err(|error| warnings.push(not_averaged(&error))).ok();
        FoundFrame { frame: around.clone(), content }
    };
    (frame.around.iter().map(&mut find).collect(), warnings)
}

/// The warning about a frame around that is left out because of this error.
pub(crate) fn not_averaged(error: &FrameError) -> Warning {
    Warning::of_frame(format!(
        "one of the frames around it, on which the surface depends, is left out: {error}"
    ))
}

/// Recorded of a frame whose obstacles cannot be found.
pub(crate) const MISSING_OBSTACLES: &str = "missing";

/// A warning if a surface was not averaged, or hardly, although there are frames around it.
pub fn not_followed(report: &TemporalReport) -> Option<Warning> {
    match report.confidence {
        _ if report.frame_count == 0 => {
            let warning = Warning::new(
                "the surface is not averaged with the frames around it: the particles have no ids of their own, and no \
                 velocities with a time step, by which they could be followed",
            );
            Some(warning.with_remedy("write `id` with the particles, or `velocity`, and give --time-step"))
        }
        // There is no surface.
        _ if report.voxel_count == 0 => None,
        confidence if confidence < CONFIDENCE_MIN => Some(Warning::new(format!(
            "the surface is hardly averaged with the frames around it: only {} % of their weight was used, because few of \
             its particles could be followed, or they move irregularly; check the ids, or the unit and the time step of the \
             velocities",
            (100.0 * confidence).round()
        ))),
        _ => None,
    }
}

/// The confidence of splashes is above 0.9.
const CONFIDENCE_MIN: f64 = 0.5;

fn content_of(
    around: &AroundFrame,
    obstacles: Option<&ObstacleFiles>,
    hashes: &KnownHashes,
    index_policy: IndexPolicy,
) -> Result<FrameContent, FrameError> {
    let AroundFrame { path, number, .. } = around;
    let hash = hashes.of(path, index_policy);
    let hash = hash.map_err(|error| FrameError::file(path, Stage::Read, error))?;
    // Without its obstacles the frame will be left out when its level set is needed.
    let recorded = |obstacles: &ObstacleFiles| {
        let found = obstacles.find(Some(*number));
        found.map_or_else(|_| MISSING_OBSTACLES.to_owned(), |found| found.recorded())
    };
    let obstacles = obstacles.map(recorded).unwrap_or_default();
    Ok(FrameContent { path: path.clone(), hash, obstacles })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::options::RestFrames;

    fn files(names: &[&str]) -> Vec<FrameFile> {
        names.iter().map(|name| FrameFile::new(name.into())).collect()
    }

    fn beside(reach: u32) -> FrameReach {
        FrameReach { beside: reach, ..FrameReach::default() }
    }

    #[test]
    fn histories_are_the_frames_since_the_reference() {
        let mut numbered = NumberedFrames::default();
        for number in [2, 4, 5, 6, 8, 10, 12] {
            numbered.insert(number, number);
        }
        let reach = FrameReach { rest: Some(RestFrames { first: 4, period: None }), ..beside(1) };
        let around = |number, reach| -> Vec<(i32, i64)> {
            numbered.around(Some(number), reach).iter().map(|(steps, at, _)| (*steps, *at)).collect()
        };
        assert_eq!(around(10, reach), [(-4, 4), (-3, 5), (-2, 6), (-1, 8), (1, 12)]);
        assert_eq!(around(4, reach), [(-1, 2), (1, 6)]);
        for reach in [reach, beside(2), beside(0)] {
            for number in [2, 4, 6, 8, 10, 12] {
                let mut expected = vec![2, 4, 5, 6, 8, 10, 12];
                expected.retain(|at| around(*at, reach).iter().any(|(_, other)| *other == number));
                let found: Vec<i64> = numbered.dependent(number, reach).into_iter().copied().collect();
                assert_eq!(found, expected, "{number} with {reach:?}");
            }
        }
    }

    #[test]
    fn histories_are_one_entry_of_a_record() {
        let frame = |steps: i32, hash: u128| RecordedAround {
            steps,
            name: format!("a.{steps}"),
            hash: Some(hash),
            obstacles: String::new(),
        };
        let all = vec![frame(-3, 1), frame(-2, 2), frame(-1, 3), frame(1, 4)];
        let recorded = RecordedAround::with_history(all.clone(), 1);
        assert_eq!(recorded[1..], all[2..]);
        assert_eq!(recorded[0].name, "2 frames from a.-3 to a.-2");
        let mut changed = all.clone();
        changed[0].hash = Some(9);
        assert_ne!(RecordedAround::with_history(changed, 1)[0].hash, recorded[0].hash);
        assert_eq!(RecordedAround::with_history(all.clone(), 3), all);
    }

    fn numbers(given: &[i64], number: i64, reach: u32) -> Vec<(i32, i64)> {
        let names: Vec<String> = given.iter().map(|number| format!("f.{number:04}.ply")).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let around = NumberedFrames::of_files(&files(&names)).frames_around(Some(number), beside(reach));
        around.iter().map(|frame| (frame.steps, frame.number)).collect()
    }

    #[test]
    fn frames_around_keep_their_distance() {
        assert_eq!(numbers(&[1, 2, 3, 4], 2, 1), [(-1, 1), (1, 3)]);
        assert_eq!(numbers(&[1, 2, 3, 4], 1, 3), [(1, 2), (2, 3), (3, 4)]);
        // A gap, and numbers with steps.
        assert_eq!(numbers(&[10, 20, 40, 50], 40, 2), [(-2, 20), (1, 50)]);
        assert_eq!(numbers(&[7], 7, 3), []);
        // One odd number, and the smaller one of two steps that are equally frequent.
        assert_eq!(numbers(&[0, 100, 200, 300, 303], 200, 1), [(-1, 100), (1, 300)]);
        assert_eq!(numbers(&[0, 100, 200, 300, 303], 303, 1), []);
        assert_eq!(numbers(&[1, 2, 4], 2, 1), [(-1, 1)]);
        assert_eq!(numbers(&[i64::MIN, i64::MAX, 0], 0, 3), [(1, i64::MAX)]);
        let alone = NumberedFrames::of_files(&files(&["drop.ply"]));
        assert_eq!(alone.frames_around(None, beside(2)).len(), 0);
    }

    #[test]
    fn frames_beside_gaps_are_not_those_at_the_ends() {
        let beside_gaps = |given: &[i64], reach| -> Vec<i64> {
            let mut numbered = NumberedFrames::default();
            given.iter().enumerate().for_each(|(index, number)| _ = numbered.insert(*number, index));
            let mut found = given.to_vec();
            found.retain(|number| numbered.is_beside_gap(*number, reach));
            found
        };
        assert!(beside_gaps(&[1, 2, 3, 4], 3).is_empty());
        assert_eq!(beside_gaps(&[1, 2, 3, 5, 6, 7], 1), [3, 5]);
        assert_eq!(beside_gaps(&[1, 2, 3, 5, 6, 7], 2), [2, 3, 5, 6]);
        assert_eq!(beside_gaps(&[0, 100, 200, 300, 303], 1), [303]);
        assert_eq!(beside_gaps(&[1, 2, 2, 3, 4], 1), [1, 2, 2, 3]);
        assert_eq!(beside_gaps(&[i64::MIN, i64::MAX, 0], 1), [i64::MIN, 0]);
    }

    #[test]
    fn subframes_are_next_to_no_other_frame() {
        let names = ["f.0001.ply", "f.0002.25.ply", "f.0002.5.ply", "f.0003.ply", "f.0004.ply"];
        let numbered = NumberedFrames::of_files(&files(&names));
        let steps = |number| -> Vec<i32> {
            numbered.around(Some(number), beside(1)).iter().map(|(steps, ..)| *steps).collect()
        };
        assert_eq!((steps(1), steps(2), steps(3)), (vec![], vec![], vec![1]));
    }

    #[test]
    fn frames_that_come_and_go_change_how_far_apart_frames_are() {
        let mut numbered = NumberedFrames::default();
        let inserted = [4, 8, 6, 7].map(|number| numbered.insert(number, number));
        assert_eq!(inserted, [false, true, true, true]);
        let steps = |numbered: &NumberedFrames<i64>| -> Vec<i32> {
            numbered.around(Some(6), beside(2)).iter().map(|(steps, ..)| *steps).collect()
        };
        assert_eq!(steps(&numbered), [-2, 1, 2]);
        assert!(!numbered.remove(7, &99) && numbered.remove(7, &7));
        assert_eq!(steps(&numbered), [-1, 1]);
        assert!(!numbered.remove(4, &4));
        // A second frame of a number takes both from between the others, until one of them is gone.
        assert!(!numbered.insert(6, 60) && !numbered.insert(6, 61));
        assert!(steps(&numbered).is_empty());
        assert!(!numbered.remove(6, &60) && !numbered.remove(6, &61));
        assert_eq!(steps(&numbered), [1]);
    }

    #[test]
    fn frames_may_come_until_all_numbers_after_a_frame_are_taken() {
        let mut numbered = NumberedFrames::default();
        assert!(!numbered.may_grow_after(1, 1));
        numbered.insert(1, 1);
        assert!(numbered.may_grow_after(1, 1));
        numbered.insert(2, 2);
        assert_eq!([1, 2].map(|number| numbered.may_grow_after(number, 1)), [false, true]);
        assert!(numbered.may_grow_after(1, 2));
        // Two frames with one number are averaged with none.
        numbered.insert(2, 20);
        assert_eq!([1, 2].map(|number| numbered.may_grow_after(number, 1)), [false, false]);
        numbered.insert(i64::MAX, 9);
        assert!(!numbered.may_grow_after(i64::MAX, 3));
    }
}
