//! A selection of frame numbers: `1-240x2`, `1-10,20,30-40x5`, `-24-240`.

use std::collections::HashSet;
use std::fmt;
use std::str::FromStr;

use crate::pipeline::{FrameFile, common_step};
use crate::surface::options::expected;

/// A set of frame numbers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct FrameSelection {
    ranges: Vec<StepRange>,
}

/// `first`, and every `step`-th number from there up to `last`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct StepRange {
    first: i64,
    last: i64,
    step: u64,
}

impl StepRange {
    /// The range as given, unchecked; the step is 1 if none is given. `None` if a number is too large or not a
    /// number.
    fn parse(text: &str) -> Option<StepRange> {
        let (range, step) = match text.split_once(['x', 'X']) {
            Some((range, step)) => (range, parse_number(step)?),
            None => (text, 1),
        };
        // A minus at the start is a sign; the next one is between the numbers.
        let dash = range.char_indices().skip(1).find(|(_, c)| *c == '-').map(|(at, _)| at);
        let (first, last) = dash.map_or((range, range), |at| (&range[..at], &range[at + 1..]));
        Some(StepRange { first: parse_number(first)?, last: parse_number(last)?, step })
    }

    fn contains(&self, number: i64) -> bool {
        (self.first..=self.last).contains(&number) && number.abs_diff(self.first).is_multiple_of(self.step)
    }

    /// How many numbers it has.
    fn count(&self) -> u64 {
        (self.last.abs_diff(self.first) / self.step).saturating_add(1)
    }
}

impl fmt::Display for StepRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.first == self.last, self.step) {
            (true, _) => write!(f, "{}", self.first),
            (false, 1) => write!(f, "{}-{}", self.first, self.last),
            (false, step) => write!(f, "{}-{}x{step}", self.first, self.last),
        }
    }
}

/// The numbers that a sequence file lacks, as text such as `3-7,20`, and how many they are: multiples of the
/// [common step](common_step) between existing numbers. `None` if none is missing, or if the numbers do not
/// increase: then frames are counted from 1.
pub(super) fn missing_numbers(numbers: &[i64]) -> Option<(String, u64)> {
    let is_increasing = numbers.is_sorted_by(|one, next| one < next);
    is_increasing.then(|| gaps_in_steps(numbers, common_step(numbers))).flatten()
}

/// The numbers that are missing between these ascending numbers, whose differences are multiples of `step`.
fn gaps_in_steps(numbers: &[i64], step: u64) -> Option<(String, u64)> {
    let between = |low: i64, high: i64| StepRange {
        first: low.saturating_add_unsigned(step),
        last: high.saturating_sub_unsigned(step),
        step,
    };
    let gaps: Vec<StepRange> = numbers
        .windows(2)
        .filter(|pair| pair[1].abs_diff(pair[0]) > step)
        .map(|pair| between(pair[0], pair[1]))
        .collect();
    let count = gaps.iter().map(StepRange::count).fold(0, u64::saturating_add);
    let mut named: Vec<String> = gaps.iter().take(GAPS_NAMED).map(StepRange::to_string).collect();
    named.extend((gaps.len() > GAPS_NAMED).then(|| "..".to_owned()));
    (count > 0).then(|| (named.join(","), count))
}

/// Maximum number of gaps that are named.
const GAPS_NAMED: usize = 8;

/// A longer range that selects any frame means "all existing frames": nothing in it is missing.
const CHECKED_MAX: u64 = 100_000;

impl FrameSelection {
    /// The selected ranges with numbers that are missing in `numbers`, and the count of the missing numbers.
    pub(super) fn missing(&self, numbers: &HashSet<i64>) -> Vec<(String, u64)> {
        let missing = |range: &StepRange| {
            let existing_count = numbers.iter().filter(|&&number| range.contains(number)).count() as u64;
            let means_all = range.count() > CHECKED_MAX && existing_count > 0;
            if means_all { 0 } else { range.count() - existing_count }
        };
        let counted = self.ranges.iter().map(|range| (range.to_string(), missing(range)));
        counted.filter(|&(_, count)| count > 0).collect()
    }

    /// Whether a frame is selected. Without a selection, all frames are.
    pub(super) fn takes(selection: Option<&FrameSelection>, file: &FrameFile) -> bool {
        selection.is_none_or(|selection| file.number().is_some_and(|number| selection.contains(number)))
    }

    pub(super) fn contains(&self, number: i64) -> bool {
        self.ranges.iter().any(|range| range.contains(number))
    }
}

impl FromStr for FrameSelection {
    type Err = String;

    fn from_str(text: &str) -> Result<FrameSelection, String> {
        let ranges = text.split(',').map(|part| parse_range(part.trim())).collect::<Result<_, _>>()?;
        Ok(FrameSelection { ranges })
    }
}

fn parse_range(text: &str) -> Result<StepRange, String> {
    let what = "a selection of frames: give a number such as 12, a range such as 1-240, or -24-240 for -24 to 240, every other frame of a range \
                as in 1-240x2, or several of these with commas between";
    let range = expected(text, StepRange::parse(text), what)?;
    if range.step == 0 {
        return Err(format!("`{text}` has a step of 0; at least 1 is needed"));
    }
    if range.last < range.first {
        let ascending = StepRange { first: range.last, last: range.first, ..range };
        return Err(format!("`{text}` ends before it starts: use {ascending}"));
    }
    Ok(range)
}

/// Parses digits, with or without a minus if the type has a sign.
fn parse_number<T: FromStr>(text: &str) -> Option<T> {
    text.trim().parse().ok().filter(|_| !text.contains('+'))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn selected(text: &str) -> Vec<i64> {
        let selection: FrameSelection = text.parse().expect(text);
        (-50..50).filter(|&number| selection.contains(number)).collect()
    }

    #[test]
    fn ranges_with_steps_and_lists() {
        assert_eq!(selected("7"), [7]);
        assert_eq!(selected("3-5"), [3, 4, 5]);
        assert_eq!(selected("1-9x4"), [1, 5, 9]);
        assert_eq!(selected("0-10x3"), [0, 3, 6, 9]);
        assert_eq!(selected("1-3, 20 ,30-40x5"), [1, 2, 3, 20, 30, 35, 40]);
        assert_eq!(selected("0003"), [3]);
        assert_eq!(selected("49-9223372036854775807x18446744073709551615"), [49]);
        assert_eq!(selected("-2-1"), [-2, -1, 0, 1]);
        assert_eq!(selected("-3--1,5"), [-3, -2, -1, 5]);
        assert_eq!(selected("-2"), [-2]);
        assert_eq!(selected("-4-4x4"), [-4, 0, 4]);
        let all = "-9223372036854775808-9223372036854775807";
        assert_eq!(
            all.parse::<FrameSelection>().expect(all).missing(&HashSet::new()),
            [(all.to_owned(), u64::MAX)]
        );
    }

    #[test]
    fn anything_else_is_refused() {
        for text in [
            "",
            "a",
            "1-",
            "-",
            "--3",
            "1-3x",
            "1-3x0",
            "1-3x-1",
            "5-3",
            "-1--3",
            "1,,2",
            "1-2-3",
            "+4",
            "1-3x+1",
            "0.5",
            "99999999999999999999",
        ] {
            assert!(text.parse::<FrameSelection>().is_err(), "{text}");
        }
    }

    #[test]
    fn errors_quote_the_whole_item() {
        for (text, item) in
            [("x", "x"), ("1-", "1-"), ("1-2x", "1-2x"), ("5,1-2x,7", "1-2x"), ("a-3x2", "a-3x2")]
        {
            let error = text.parse::<FrameSelection>().expect_err(text);
            assert!(error.starts_with(&format!("`{item}` is not a selection")), "{error}");
            assert!(error.contains("1-240x2"), "{error}");
        }
    }

    #[test]
    fn gaps_of_a_sequence_file_are_multiples_of_the_common_step() {
        for (numbers, expected) in [
            (&[][..], None),
            (&[7], None),
            (&[1, 900], None),
            (&[-2, 1], None),
            (&[-3, -2, 1], Some(("-1-0", 2))),
            (&[1, 2, 8], Some(("3-7", 5))),
            (&[1, 4, 8], Some(("2-3,5-7", 5))),
            (&[0, 100, 300], Some(("200", 1))),
            (&[1, 1, 8], None),
            (&[8, 2, 1], None),
        ] {
            let expected = expected.map(|(gaps, count)| (gaps.to_owned(), count));
            assert_eq!(missing_numbers(numbers), expected, "{numbers:?}");
        }
    }
}
