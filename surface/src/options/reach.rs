//! The frames of a sequence that a frame depends on.
//!
//! ```text
//!   number   1 2 3 4 5 6 7 8 9          --rest 3 --temporal 1: frame 7 depends on the frames marked #
//!                # # # # ○ #
//!                └history┘ └beside
//! ```

use crate::attributes::names_velocity;

use super::{MethodOptions, SPRAY_KEEP, Settings};
use crate::spray::frames_needed;

/// The frames of a sequence that a frame depends on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameReach {
    /// The number of frames before and after it.
    pub beside: u32,
    /// Those since its reference frames.
    pub rest: Option<RestFrames>,
}

impl FrameReach {
    /// The options that determine it.
    pub const OPTIONS: [&str; 7] =
        ["temporal", "spray", "spray_keep", "rest", "rest_period", "attributes", "time_step"];

    /// The number of the first frame of the history of a frame, if it has one. The history ends before the frame.
    pub fn first(&self, number: i64) -> Option<i64> {
        self.rest.map(|rest| rest.at(number).first()).filter(|first| *first < number)
    }

    /// Whether frames depend on no others.
    pub fn is_none(&self) -> bool {
        self.beside == 0 && !self.has_history()
    }

    /// Whether frames depend on more than those beside them.
    pub fn has_history(&self) -> bool {
        self.rest.is_some()
    }
}

/// The frames whose positions are rest coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RestFrames {
    /// The number of the first one.
    pub first: u32,
    /// After which difference of numbers each of the two sets of coordinates begins again; `None` for one set, which
    /// never does.
    pub period: Option<u32>,
}

/// The rest coordinates of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RestAt {
    /// The number of the reference frame of the first set.
    pub rest: i64,
    /// That of the second set, and its weight from 0 to 1: that of the first one is the rest to 1.
    pub second: Option<(i64, f32)>,
}

impl RestFrames {
    /// The rest coordinates of the frame with this number. A frame before the first reference frame is its own.
    ///
    /// A set begins again when its weight is 0: the first one at each period, the second one half a period later.
    pub fn at(&self, number: i64) -> RestAt {
        let first = i64::from(self.first).min(number);
        let Some(period) = self.period.map(i64::from) else { return RestAt { rest: first, second: None } };
        let since = number.saturating_sub(first).rem_euclid(period);
        let since_second = (since + period / 2).rem_euclid(period);
        let second = first.max(number.saturating_sub(since_second));
        let phase = since as f64 / period as f64;
        RestAt {
            rest: number.saturating_sub(since),
            second: Some((second, (2.0 * phase - 1.0).abs() as f32)),
        }
    }
}

impl RestAt {
    /// The number of the earlier one of the reference frames.
    pub fn first(&self) -> i64 {
        self.second.map_or(self.rest, |(second, _)| second.min(self.rest))
    }
}

impl MethodOptions {
    /// The frames on which a frame depends.
    pub fn frame_reach(&self) -> FrameReach {
        let of_spray =
            if self.has_spray() { frames_needed(self.spray_keep.unwrap_or(SPRAY_KEEP)) } else { 0 };
        let averaged = self.temporal.unwrap_or(0).saturating_add(of_spray);
        let computed = self.time_step.is_some() && names_velocity(self.attributes.as_ref());
        FrameReach { beside: averaged.max(computed.into()), rest: self.rest_frames() }
    }

    /// The frames whose positions are rest coordinates.
    pub(super) fn rest_frames(&self) -> Option<RestFrames> {
        self.rest.map(|first| RestFrames { first, period: self.rest_period })
    }
}

impl Settings {
    /// The frames on which a frame depends.
    #[doc(hidden)]
    pub fn frame_reach(&self) -> FrameReach {
        let averaged = self.temporal + self.spray_reach();
        FrameReach { beside: averaged.max(self.computes_velocities().into()), rest: self.rest }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_begin_again_when_their_weight_is_0() {
        let frames = RestFrames { first: 10, period: Some(8) };
        let mut before: Option<RestAt> = None;
        for number in 0..60 {
            let at = frames.at(number);
            let (second, weight) = at.second.expect("two sets");
            assert!(at.rest <= number && second <= number && at.first() >= number - 8, "{number}: {at:?}");
            if number <= 10 {
                assert_eq!((at.rest, second), (number, number));
            }
            if let Some(RestAt { rest, second: Some((other, _)) }) = before.filter(|_| number > 10) {
                assert!(rest == at.rest || weight == 1.0, "{number}: {at:?}");
                assert!(other == second || weight == 0.0, "{number}: {at:?}");
            }
            before = Some(at);
        }
        assert_eq!(frames.at(14), RestAt { rest: 10, second: Some((14, 0.0)) });
        assert_eq!(frames.at(16), RestAt { rest: 10, second: Some((14, 0.5)) });
        assert_eq!(frames.at(18), RestAt { rest: 18, second: Some((14, 1.0)) });
        assert_eq!(RestFrames { first: 10, period: None }.at(99), RestAt { rest: 10, second: None });
        for number in [i64::MIN, i64::MAX] {
            assert!(frames.at(number).first() <= number);
        }
    }

    #[test]
    fn histories_begin_at_the_earlier_reference_frame() {
        let options =
            |text: &[(&str, &str)]| MethodOptions::from_pairs(text.iter().copied()).expect("options");
        let reach = options(&[("rest", "3"), ("rest_period", "10")]).frame_reach();
        assert_eq!(
            [2, 3, 4, 8, 12, 14].map(|number| reach.first(number)),
            [None, None, Some(3), Some(3), Some(3), Some(8)]
        );
        assert!(options(&[("attributes", "all"), ("time_step", "1")]).frame_reach().is_none());
        assert_eq!(options(&[("attributes", "vel"), ("time_step", "1")]).frame_reach().beside, 1);
    }
}
