//! Finds the frame number in a file name.
//!
//! ```text
//!   name                   number
//!   dam_0001_v003           0001    not a version: v, ver, version, rev, take or wedge before the digits
//!   dam.0001.50          0001.50    frame 1, subframe .50: a frame with a subframe has 4 digits or more, and
//!                                   its subframe has fewer digits than the frame
//!   shot.010.1                 1    a shot and its frame
//!   hilbert2_7954_points       2    not a count: particles, points, pts, .. after the digits
//!   frame_12_particles        12    a number after frame, frm, step or timestep
//!   take2_dam7                 7    otherwise: the last number
//! ```
//!
//! These rules use only the name itself. If a name has only versions and counts, one of them is the frame
//! number. Afterwards [`varying_number`] and [`numbers_behind_shots`] compare names that differ only in
//! numbers, and correct the choice.

use std::collections::HashSet;
use std::ops::Range;

/// The meaning of a number in a name, according to the words around it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum NumberRole {
    Frame,
    Plain,
    Count,
    Version,
}

/// Words before a frame number, with or without a separator.
const FRAME_WORDS: [&str; 4] = ["frame", "frm", "step", "timestep"];

/// Words directly before the number of a version.
const VERSION_WORDS: [&str; 6] = ["v", "ver", "version", "rev", "take", "wedge"];

/// Words after a count, with or without a separator.
const COUNT_WORDS: [&str; 9] =
    ["particle", "particles", "point", "points", "pts", "parts", "vertices", "atoms", "spheres"];

/// Minimum number of digits of a frame that has a subframe: `take.2.1` and `shot.010.1` are frame 1.
const SUBFRAME_OF_DIGITS_MIN: usize = 4;

/// The range of the frame number in the stem of a file name. It includes the subframe, if there is one:
/// `0001.50`.
pub(crate) fn frame_number(stem: &str) -> Option<Range<usize>> {
    let numbers = numbers(stem);
    let of_role = |role| numbers.iter().rev().find(|number| role_of(stem, number) == role);
    let found = [NumberRole::Frame, NumberRole::Plain, NumberRole::Count, NumberRole::Version]
        .into_iter()
        .find_map(of_role)?
        .clone();
    Some(with_subframe(stem, &numbers, &found).unwrap_or(found))
}

/// The range of a frame number and the subframe after it, if the stem ends in them and `found` is one of the
/// two numbers. (`found` is the first of them if a word such as `frame` precedes it.)
fn with_subframe(stem: &str, numbers: &[Range<usize>], found: &Range<usize>) -> Option<Range<usize>> {
    let [.., frame, last] = numbers else { return None };
    let follows_separator = stem[..frame.start].chars().next_back().is_none_or(|c| !c.is_alphanumeric());
    let is_subframe = (found == frame || found == last)
        && last.end == stem.len()
        && &stem[frame.end..last.start] == "."
        && (SUBFRAME_OF_DIGITS_MIN.max(last.len() + 1)..).contains(&frame.len())
        && follows_separator;
    is_subframe.then_some(frame.start..last.end)
}

/// The ranges of the frame numbers in stems that differ only in numbers: the ranges of the only number that
/// varies, whichever number [`frame_number`] chose. `None` if no number varies, or several. A version is
/// never the frame number, and a count only if three or more values have equal differences, as frames have.
pub(crate) fn varying_number(stems: &[&str]) -> Option<Vec<Range<usize>>> {
    let all: Vec<Vec<Range<usize>>> = stems.iter().map(|stem| numbers(stem)).collect();
    let (first, first_numbers) = (stems.first()?, all.first()?);
    let text = |index: usize, column: usize| Some(&stems[index][all[index].get(column)?.clone()]);
    let varies = |column: &usize| (1..stems.len()).any(|index| text(index, *column) != text(0, *column));
    let varying: Vec<usize> = (0..first_numbers.len()).filter(varies).collect();
    let &[column] = &varying[..] else { return None };
    let role = role_of(first, &first_numbers[column]);
    let is_frame = match role {
        NumberRole::Frame | NumberRole::Plain => true,
        NumberRole::Version => false,
        NumberRole::Count => are_even((0..stems.len()).filter_map(|index| text(index, column)?.parse().ok())),
    };
    is_frame.then(|| all.iter().filter_map(|numbers| numbers.get(column).cloned()).collect())
}

/// The ranges of the last numbers of stems, if [`frame_number`] mistook the frames of a shot for subframes,
/// as in `shot.0100.1` to `shot.0100.120`. The stems differ only in numbers, and `spans` contains the ranges
/// that [`frame_number`] returned.
///
/// The last numbers are not subframes in any of these cases:
/// - Two of them are the same fraction, as 1 and 10 are, behind the same frame.
/// - One of them cannot be a subframe, for example because it has as many digits as the number before it.
/// - There is only one number before them, and they count up, as 1 and 2 do.
///
/// `is_shot_possible` is false if the sequence also has a whole frame, which proves that the other frames
/// have subframes.
pub(crate) fn numbers_behind_shots(
    stems: &[&str],
    spans: &[Range<usize>],
    is_shot_possible: bool,
) -> Option<Vec<Range<usize>>> {
    let last: Vec<Range<usize>> = stems.iter().filter_map(|stem| numbers(stem).pop()).collect();
    if last.len() != spans.len() || !is_shot_possible {
        return None;
    }
    let (mut frames, mut fractions, mut values) = (HashSet::new(), HashSet::new(), HashSet::new());
    let (mut subframe_count, mut is_contradicted) = (0, false);
    for ((stem, span), last) in stems.iter().zip(spans).zip(&last) {
        match stem[span.clone()].split_once('.') {
            Some((frame, digits)) => {
                subframe_count += 1;
                frames.insert(frame);
                values.extend(digits.parse::<u64>());
                is_contradicted |= !fractions.insert((frame, digits.trim_end_matches('0')));
            }
            None => is_contradicted |= span == last,
        }
    }
    let counts_up = values.iter().any(|value| values.contains(&value.saturating_add(1)));
    (subframe_count > 0 && (is_contradicted || frames.len() == 1 && counts_up)).then_some(last)
}

/// Whether there are three or more numbers with equal differences.
fn are_even(numbers: impl Iterator<Item = u64>) -> bool {
    let mut numbers: Vec<u64> = numbers.collect();
    numbers.sort_unstable();
    numbers.dedup();
    numbers.len() >= 3 && numbers.windows(3).all(|three| three[1] - three[0] == three[2] - three[1])
}

/// The text with `#` in place of each number. The result is equal for names that differ only in numbers.
pub(crate) fn without_numbers(text: &str) -> String {
    let mut shared = String::with_capacity(text.len());
    let mut end = 0;
    for number in numbers(text) {
        shared += &text[end..number.start];
        shared.push('#');
        end = number.end;
    }
    shared + &text[end..]
}

/// All runs of digits.
fn numbers(text: &str) -> Vec<Range<usize>> {
    let mut numbers: Vec<Range<usize>> = Vec::new();
    for (index, _) in text.bytes().enumerate().filter(|(_, byte)| byte.is_ascii_digit()) {
        match numbers.last_mut() {
            Some(number) if number.end == index => number.end += 1,
            _ => numbers.push(index..index + 1),
        }
    }
    numbers
}

fn role_of(stem: &str, number: &Range<usize>) -> NumberRole {
    let (before, after) = (&stem[..number.start], &stem[number.end..]);
    let word_before = |text: &str| {
        let letters = text.bytes().rev().take_while(u8::is_ascii_alphabetic).count();
        text[text.len() - letters..].to_ascii_lowercase()
    };
    let word_after = |text: &str| {
        let letters = text.bytes().take_while(u8::is_ascii_alphabetic).count();
        text[..letters].to_ascii_lowercase()
    };
    let touching = word_before(before);
    let separated = word_before(before.strip_suffix(SEPARATORS).unwrap_or(before));
    let following = word_after(after.strip_prefix(SEPARATORS).unwrap_or(after));
    let is_padded = number.len() > 1 && stem[number.clone()].starts_with('0');
    if FRAME_WORDS.contains(&&*separated) {
        NumberRole::Frame
    } else if VERSION_WORDS.contains(&&*touching) {
        NumberRole::Version
    } else if !is_padded && COUNT_WORDS.contains(&&*following) {
        NumberRole::Count
    } else {
        NumberRole::Plain
    }
}

const SEPARATORS: [char; 4] = ['.', '_', '-', ' '];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_determine_the_frame_number() {
        for (stem, expected) in [
            ("dam.0012", Some("0012")),
            ("dam_0001_v003", Some("0001")),
            ("dam_0001.v2", Some("0001")),
            ("dam_0001-v12", Some("0001")),
            ("dam_V2_0001", Some("0001")),
            ("dam_0001_take7", Some("0001")),
            ("take2_frame7", Some("7")),
            ("dam_v003", Some("003")),
            ("v1.5", Some("5")),
            ("wave3", Some("3")),
            ("frame_12_particles", Some("12")),
            ("frame12_0003", Some("12")),
            ("hilbert2_7954_particles", Some("2")),
            ("fluid2_0007_particles", Some("0007")),
            ("fluid_7_particles", Some("7")),
            ("dam_v2_17_particles", Some("17")),
            ("ParticleData_Fluid_1", Some("1")),
            ("ü3ß", Some("3")),
            ("dam", None),
            ("", None),
        ] {
            assert_eq!(frame_number(stem).map(|span| &stem[span]), expected, "{stem}");
        }
    }

    #[test]
    fn subframes_belong_to_their_frame() {
        for (stem, expected) in [
            ("dam.0001.50", "0001.50"),
            ("dam_0001.5", "0001.5"),
            ("0001.25", "0001.25"),
            ("dam.1001.250", "1001.250"),
            ("frame.0001.50", "0001.50"),
            ("step.0001.5", "0001.5"),
            ("frame_0012.25", "0012.25"),
            // A wedge, a take or a shot comes first, then the frame.
            ("cache.0.0001", "0001"),
            ("shot.010.0001", "0001"),
            ("shot.010.1", "1"),
            ("shot.010.99", "99"),
            ("frame.010.1", "010"),
            ("dam_v003.12", "12"),
            ("sh010.12", "12"),
            ("dam.2.1", "1"),
            ("dam.0001-50", "50"),
            ("dam.0001.50_b", "50"),
        ] {
            assert_eq!(frame_number(stem).map(|span| &stem[span]), Some(expected), "{stem}");
        }
    }

    #[test]
    fn only_varying_number_is_the_frame() {
        let numbers_of = |stems: &[&'static str]| -> Option<Vec<&'static str>> {
            let spans = varying_number(stems)?;
            Some(stems.iter().zip(spans).map(|(stem, span)| &stem[span]).collect())
        };
        assert_eq!(numbers_of(&["dam_0001_b7", "dam_0002_b7"]), Some(vec!["0001", "0002"]));
        assert_eq!(numbers_of(&["dam_0001_b7", "dam_0002_b8"]), None);
        assert_eq!(numbers_of(&["dam_0001_v1", "dam_0001_v2"]), None);
        assert_eq!(numbers_of(&["hilbert2_7954_particles", "hilbert2_18856_particles"]), None);
        let counted = ["f2_1_points", "f2_2_points", "f2_3_points"];
        assert_eq!(numbers_of(&counted), Some(vec!["1", "2", "3"]));
        assert_eq!(numbers_of(&["f2_1_points", "f2_2_points", "f2_18856_points"]), None);
        assert_eq!(numbers_of(&["dam.7"]), None);
        assert_eq!(numbers_of(&[]), None);
    }

    #[test]
    fn numbers_that_cannot_be_subframes_are_frames_of_a_shot() {
        let numbers_of = |stems: &[&'static str], is_shot_possible| -> Option<Vec<&'static str>> {
            let spans: Vec<_> = stems.iter().filter_map(|stem| frame_number(stem)).collect();
            let last = numbers_behind_shots(stems, &spans, is_shot_possible)?;
            Some(stems.iter().zip(last).map(|(stem, span)| &stem[span]).collect())
        };
        assert_eq!(numbers_of(&["s.0100.9", "s.0100.10"], true), Some(vec!["9", "10"]));
        assert_eq!(numbers_of(&["s.0100.1", "s.0100.10"], true), Some(vec!["1", "10"]));
        assert_eq!(numbers_of(&["s.0100.7", "s.0100.1000"], true), Some(vec!["7", "1000"]));
        assert_eq!(numbers_of(&["s.0100.1", "s.0100.10", "s.0200.3"], true), Some(vec!["1", "10", "3"]));
        assert_eq!(numbers_of(&["s.0100.9", "s.0100.10"], false), None);
        for subframes in
            [&["d.0001.25", "d.0001.5", "d.0001.75"][..], &["d.0001.1", "d.0002.2"], &["d.0001.1"]]
        {
            assert_eq!(numbers_of(subframes, true), None, "{subframes:?}");
        }
        assert_eq!(numbers_of(&["d.1", "d.2"], true), None);
    }

    #[test]
    fn names_that_differ_in_numbers_share_the_rest() {
        assert_eq!(without_numbers("dam_0001_v3.ply"), "dam_#_v#.ply");
        assert_eq!(without_numbers("7ü"), "#ü");
        assert_eq!(without_numbers("dam"), "dam");
    }
}
