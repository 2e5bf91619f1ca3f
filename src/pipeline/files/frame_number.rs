//! Numbers in names: which of them is the frame's, its value, and the order of names.
//!
//! ```text
//!   name                   number
//!   dam_0001_v003           0001    not a version: v, ver, version, rev, take or wedge before the digits
//!   dam.-012                -012    a minus after a separator, or at the start, is a sign
//!   dam.0001.50          0001.50    frame 1, subframe .50: a frame with a subframe has 4 digits or more, and
//!                                   its subframe has fewer digits than the frame
//!   result_0.05             0.05    a time: two numbers with a point between them, the first without leading
//!                                   zeros and not after a dot or a letter (except in t0.05, time0.05)
//!   x.0.5                    0.5    a time: after a dot or a letter only below 1, with one or two decimals
//!   shot.010.1                 1    a shot and its frame
//!   v1.2.0001               0001    three numbers with points between them are not a time
//!   tank_2.0001           2.0001    a time, or frame 1 of take 2: three decimals or more may be a frame
//!   hilbert2_7954_points       2    not a count: particles, points, pts, .. after the digits
//!   frame_12_particles        12    a number after frame, frm, step or timestep
//!   take2_dam7                 7    otherwise: the last number
//! ```
//!
//! These rules use only the name itself. If a name has only versions and counts, one of them is the frame
//! number. Afterwards [`compared_numbers`] compares names that differ only in numbers, and corrects the
//! choice.

use std::cmp::Ordering;
use std::collections::HashSet;
use std::ops::Range;

/// The number of a frame in its name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct NameNumber {
    /// Its bytes in the name, with the sign, and with the digits after a decimal point.
    pub(crate) span: Range<usize>,
    pub(crate) kind: NumberMeaning,
}

/// What the number in a name counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NumberMeaning {
    /// A frame.
    Frame,
    /// A frame and its subframe, `0001.50`.
    Subframe,
    /// A time, `0.05`.
    Time,
    /// A time, or the number of a take and that of a frame: only other names of the sequence show which.
    /// Either way, the value gives the order.
    TimeOrTake,
}

impl NumberMeaning {
    /// The kind of a number whose place in the name is known.
    pub(crate) fn of_text(number: &str) -> NumberMeaning {
        match number.split_once('.') {
            _ if number.contains(['e', 'E']) => NumberMeaning::Time,
            None => NumberMeaning::Frame,
            Some((frame, subframe)) if is_frame_with_subframe(frame, subframe) => NumberMeaning::Subframe,
            Some(_) => NumberMeaning::Time,
        }
    }

    /// The number of the frame; `None` for a time, and if it does not fit into 64 bits.
    pub(crate) fn frame_in(self, number: &str) -> Option<i64> {
        let (whole, decimals) = number.split_once('.').unwrap_or((number, ""));
        match self {
            NumberMeaning::Frame | NumberMeaning::Subframe => whole.parse().ok(),
            NumberMeaning::TimeOrTake => decimals.parse().ok(),
            NumberMeaning::Time => None,
        }
    }
}

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

/// Words directly before a time.
const TIME_WORDS: [&str; 2] = ["t", "time"];

/// Words after a count, with or without a separator.
const COUNT_WORDS: [&str; 9] =
    ["particle", "particles", "point", "points", "pts", "parts", "vertices", "atoms", "spheres"];

/// Minimum number of digits of a frame that has a subframe: `take.2.1` and `shot.010.1` are frame 1.
const SUBFRAME_OF_DIGITS_MIN: usize = 4;

/// Minimum number of decimals that may be the padded number of a frame, as in `tank_2.001`.
const TAKE_DECIMALS_MIN: usize = 3;

/// The number of the frame in the stem of a file name.
pub(crate) fn frame_number(stem: &str) -> Option<NameNumber> {
    let numbers = numbers(stem);
    let of_role = |role| numbers.iter().rev().find(|number| role_of(stem, number) == role);
    let found = [NumberRole::Frame, NumberRole::Plain, NumberRole::Count, NumberRole::Version]
        .into_iter()
        .find_map(of_role)?
        .clone();
    if let Some(span) = with_subframe(stem, &numbers, &found) {
        return Some(NameNumber { span, kind: NumberMeaning::Subframe });
    }
    let decimal = DecimalNumber::around(stem, &numbers, &found);
    let decimal = decimal.and_then(|decimal| Some((decimal.kind(stem)?, decimal.span())));
    let (kind, span) = decimal.unwrap_or((NumberMeaning::Frame, found));
    Some(NameNumber { span, kind })
}

/// The range of a frame number and the subframe after it, if the stem ends in them and `found` is one of the
/// two numbers. (`found` is the first of them if a word such as `frame` precedes it.)
fn with_subframe(stem: &str, numbers: &[Range<usize>], found: &Range<usize>) -> Option<Range<usize>> {
    let [.., frame, last] = numbers else { return None };
    let follows_separator = stem[..frame.start].chars().next_back().is_none_or(|c| !c.is_alphanumeric());
    let is_subframe = (found == frame || found == last)
        && last.end == stem.len()
        && &stem[frame.end..last.start] == "."
        && is_frame_with_subframe(&stem[frame.clone()], &stem[last.clone()])
        && follows_separator;
    is_subframe.then_some(frame.start..last.end)
}

fn is_frame_with_subframe(frame: &str, subframe: &str) -> bool {
    (SUBFRAME_OF_DIGITS_MIN.max(subframe.len() + 1)..).contains(&without_sign(frame).len())
}

fn without_sign(number: &str) -> &str {
    number.strip_prefix('-').unwrap_or(number)
}

/// Two numbers with a point between them, or a number with an exponent, such as `1e-05`.
struct DecimalNumber {
    /// The digits before the point, with the sign.
    whole: Range<usize>,
    /// The digits after the point; empty without one.
    decimals: Range<usize>,
    /// The end of the exponent, or of the decimals.
    end: usize,
}

impl DecimalNumber {
    /// The decimal number that begins with these digits. Three numbers with points between them, such as a
    /// version or a date, are none.
    fn at(text: &str, whole: &Range<usize>) -> Option<DecimalNumber> {
        let decimals = decimals_at(text, whole)?;
        let end = decimals.end + exponent_length(&text[decimals.end..]);
        (end > whole.end).then(|| DecimalNumber { whole: whole.clone(), decimals, end })
    }

    /// The decimal number that contains this number.
    fn around(stem: &str, numbers: &[Range<usize>], found: &Range<usize>) -> Option<DecimalNumber> {
        let candidates = numbers.iter().rev().filter(|number| number.start <= found.start);
        let decimal = candidates.filter_map(|whole| DecimalNumber::at(stem, whole)).next()?;
        let is_version = role_of(stem, &decimal.whole) == NumberRole::Version;
        (found.end <= decimal.end && !is_version).then_some(decimal)
    }

    fn span(&self) -> Range<usize> {
        self.whole.start..self.end
    }

    /// What it is, by this name alone; `None` if it is not a decimal number but a frame.
    fn kind(&self, stem: &str) -> Option<NumberMeaning> {
        let whole = &stem[self.whole.clone()];
        let is_open = may_precede_time(&stem[..self.whole.start]);
        let is_short = self.decimals.len() < TAKE_DECIMALS_MIN;
        if is_padded(whole) {
            None
        } else if self.end > self.decimals.end {
            is_open.then_some(NumberMeaning::Time)
        } else if is_short {
            (is_open || without_sign(whole) == "0").then_some(NumberMeaning::Time)
        } else {
            let is_frame = role_of(stem, &self.whole) == NumberRole::Frame;
            (is_open && !is_frame).then_some(NumberMeaning::TimeOrTake)
        }
    }
}

/// The digits after the point that follows a number, empty without such; `None` for one of three numbers with
/// points between them.
fn decimals_at(text: &str, whole: &Range<usize>) -> Option<Range<usize>> {
    let start = whole.end + 1;
    let length = text[whole.end..].strip_prefix('.').map_or(0, |rest| digit_count(rest.as_bytes()));
    let decimals = if length > 0 { start..start + length } else { whole.end..whole.end };
    let continues =
        text[decimals.end..].strip_prefix('.').is_some_and(|rest| digit_count(rest.as_bytes()) > 0);
    let before = text[..whole.start].strip_suffix('.').unwrap_or_default();
    (!continues && !before.ends_with(|c: char| c.is_ascii_digit())).then_some(decimals)
}

/// The length of an exponent such as `e-05` at the start of a text; 0 without one.
fn exponent_length(text: &str) -> usize {
    let digits = text.strip_prefix(['e', 'E']).and_then(|rest| rest.strip_prefix(['-', '+']));
    let count = digits.map_or(0, |digits| digit_count(digits.as_bytes()));
    let is_word = text.get(2 + count..).is_some_and(|rest| rest.starts_with(char::is_alphanumeric));
    if count > 0 && !is_word { 2 + count } else { 0 }
}

fn is_padded(number: &str) -> bool {
    let digits = without_sign(number);
    digits.len() > 1 && digits.starts_with('0')
}

/// Whether a decimal number after this text is a time. After a dot or a letter it may be the frame of a take.
fn may_precede_time(before: &str) -> bool {
    match before.chars().next_back() {
        Some('.') => false,
        Some(c) if c.is_alphanumeric() => TIME_WORDS.contains(&&*word_before(before)),
        _ => true,
    }
}

/// Whether a minus after this text is the sign of the digits that follow it.
pub(crate) fn may_precede_sign(before: &str) -> bool {
    !before.ends_with(char::is_alphanumeric)
}

/// Whether a whole text is a number, such as the name of the folder of a time: `0.05`, `0012`, `1e-05`.
pub fn is_number(text: &str) -> bool {
    let whole = text.len() - without_sign(text).len();
    let whole = 0..whole + digit_count(&text.as_bytes()[whole..]);
    let is_whole = without_sign(&text[whole.clone()]).is_empty().then_some(false);
    let is_decimal = || DecimalNumber::at(text, &whole).is_some_and(|decimal| decimal.end == text.len());
    is_whole.unwrap_or_else(|| whole.end == text.len() || is_decimal())
}

/// The numbers of names that differ only in numbers, after a comparison; `found` has those that
/// [`frame_number`] found. `None` if the comparison confirms them.
///
/// 1. Apparent subframes may be [the frames of a shot](numbers_behind_shots), if `is_shot_possible`.
/// 2. Decimal numbers may be [times](are_times), or takes and their frames.
/// 3. If [only one number varies](varying_number), it is that of the frame.
pub(crate) fn compared_numbers(
    stems: &[&str],
    found: &[NameNumber],
    is_shot_possible: bool,
) -> Option<Vec<NameNumber>> {
    let frames = |spans: Vec<Range<usize>>| -> Vec<NameNumber> {
        spans.into_iter().map(|span| NameNumber { span, kind: NumberMeaning::Frame }).collect()
    };
    let has = |kind| found.iter().any(|number| number.kind == kind);
    let has_times = has(NumberMeaning::Time) || has(NumberMeaning::TimeOrTake);
    if !has_times && let Some(last) = numbers_behind_shots(stems, found, is_shot_possible) {
        return Some(frames(last));
    }
    let verdict = if has(NumberMeaning::Subframe) && !has_times { None } else { decimals_of(stems, found) };
    if let Some((true, decimals)) = &verdict {
        let time = |decimal: &DecimalNumber| NameNumber { span: decimal.span(), kind: NumberMeaning::Time };
        return Some(decimals.iter().map(time).collect());
    }
    let numbers = verdict.map(|(_, decimals)| {
        frames(decimals.into_iter().map(|DecimalNumber { decimals, .. }| decimals).collect())
    });
    let Some(varying) = varying_number(stems) else { return numbers };
    // If only the subframe varies, the number that was found contains it already.
    let contains =
        |now: &NameNumber, span: &Range<usize>| now.span.start <= span.start && span.end <= now.span.end;
    let now = numbers.as_deref().unwrap_or(found);
    if now.len() == varying.len() && now.iter().zip(&varying).all(|(now, span)| contains(now, span)) {
        return numbers;
    }
    Some(frames(varying))
}

/// The decimal numbers of names, and whether they are times; `None` if a name has none, or if the names do
/// not show what they are.
fn decimals_of(stems: &[&str], found: &[NameNumber]) -> Option<(bool, Vec<DecimalNumber>)> {
    let decimal = |(stem, number): (&&str, &NameNumber)| {
        // The last of the digits: those of a frame, if it is a take with a frame.
        let numbers = numbers(stem);
        let last = numbers.iter().rev().find(|digits| digits.end <= number.span.end)?;
        DecimalNumber::around(stem, &numbers, last)
    };
    let decimals = stems.iter().zip(found).map(decimal).collect::<Option<Vec<DecimalNumber>>>()?;
    let verdict = are_times(stems, found, &decimals)?;
    Some((verdict, decimals))
}

/// Whether decimal numbers are times. The first evidence decides:
///
/// ```text
///   tank_2.9  tank_2.10                no     no program writes the zero of 2.10 but not that of 2.90
///   p.0.95  p.1.00  p.1.05             yes    the step over a whole number is like the others
///   x.1.05  x.1.1                      yes    a frame is padded in all names, or in none
///   result_0.1  result_0.2             yes    by the names alone
///   tank_2.001  tank_2.002             no     three decimals or more are the frames of a take, except
///   p_0.900  p_0.950                   yes    between 0 and 1 if they do not count up
/// ```
fn are_times(stems: &[&str], found: &[NameNumber], numbers: &[DecimalNumber]) -> Option<bool> {
    let texts = |part: fn(&DecimalNumber) -> Range<usize>| -> Vec<&str> {
        stems.iter().zip(numbers).map(|(stem, number)| &stem[part(number)]).collect()
    };
    let wholes = texts(|number| number.whole.clone());
    let decimals = texts(|number| number.decimals.clone());
    let values: Vec<f64> = texts(DecimalNumber::span).iter().filter_map(|text| text.parse().ok()).collect();
    let has = |kind| found.iter().any(|number| number.kind == kind);
    let is_expected =
        found.iter().zip(stems).all(|(number, stem)| may_precede_time(&stem[..number.span.start]));
    let width_varies = decimals.iter().any(|digits| digits.len() != decimals[0].len());
    let are_below_one = wholes.iter().all(|whole| without_sign(whole) == "0");
    if width_varies && decimals.iter().any(|digits| digits.len() > 1 && digits.ends_with('0')) {
        Some(false)
    } else if decimals.iter().any(|digits| *digits != decimals[0])
        && step_over_whole_number(values, is_expected)
    {
        Some(true)
    } else if wholes.iter().any(|whole| is_padded(whole)) {
        None
    } else if width_varies && decimals.iter().any(|digits| is_padded(digits)) {
        Some(true)
    } else if has(NumberMeaning::Time) {
        Some(is_expected || are_below_one)
    } else if has(NumberMeaning::TimeOrTake) {
        let frames: HashSet<u64> = decimals.iter().filter_map(|digits| digits.parse().ok()).collect();
        let counts_up = frames.iter().any(|frame| frames.contains(&frame.saturating_add(1)));
        Some(are_below_one && !counts_up)
    } else {
        None
    }
}

/// Whether a step over a whole number, or to one from below, is about as long as the others. A single step
/// counts if times are expected here.
fn step_over_whole_number(mut values: Vec<f64>, is_expected: bool) -> bool {
    values.sort_by(f64::total_cmp);
    values.dedup();
    let mut steps: Vec<f64> = values.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.sort_by(f64::total_cmp);
    let longest = match &steps[..] {
        [] => return false,
        [_] => {
            if is_expected {
                0.5
            } else {
                0.0
            }
        }
        steps => STEP_FACTOR_MAX * steps[(steps.len() - 1) / 2],
    };
    values.windows(2).any(|pair| pair[0].floor() < pair[1].floor() && pair[1] - pair[0] < longest)
}

/// How much longer than the median a step may be: times are rounded. From 1.9 to 2.1, where frames 10 and 0
/// would be, the step is twice as long.
const STEP_FACTOR_MAX: f64 = 1.5;

/// The ranges of the frame numbers in stems that differ only in numbers: the ranges of the only number that
/// varies, whichever number [`frame_number`] chose. `None` if no number varies, or several. A version is
/// never the frame number, and a count only if three or more values have equal differences, as frames have.
fn varying_number(stems: &[&str]) -> Option<Vec<Range<usize>>> {
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
/// as in `shot.0100.1` to `shot.0100.120`. The stems differ only in numbers, and `found` contains the numbers
/// that [`frame_number`] returned.
///
/// The last numbers are not subframes in any of these cases:
/// - Two of them are the same fraction, as 1 and 10 are, behind the same frame.
/// - One of them cannot be a subframe, for example because it has as many digits as the number before it.
/// - There is only one number before them, and they count up, as 1 and 2 do.
///
/// `is_shot_possible` is false if the sequence also has a whole frame, which proves that the other frames
/// have subframes.
fn numbers_behind_shots(
    stems: &[&str],
    found: &[NameNumber],
    is_shot_possible: bool,
) -> Option<Vec<Range<usize>>> {
    let last: Vec<Range<usize>> = stems.iter().filter_map(|stem| numbers(stem).pop()).collect();
    if last.len() != found.len() || !is_shot_possible {
        return None;
    }
    let (mut frames, mut fractions, mut values) = (HashSet::new(), HashSet::new(), HashSet::new());
    let (mut subframe_count, mut is_contradicted) = (0, false);
    for ((stem, NameNumber { span, .. }), last) in stems.iter().zip(found).zip(&last) {
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

/// All runs of digits, with their signs.
fn numbers(text: &str) -> Vec<Range<usize>> {
    let mut numbers: Vec<Range<usize>> = Vec::new();
    for (index, _) in text.bytes().enumerate().filter(|(_, byte)| byte.is_ascii_digit()) {
        match numbers.last_mut() {
            Some(number) if number.end == index => number.end += 1,
            _ => {
                let before = text[..index].strip_suffix('-').filter(|before| may_precede_sign(before));
                numbers.push(index - usize::from(before.is_some())..index + 1);
            }
        }
    }
    numbers
}

fn digit_count(text: &[u8]) -> usize {
    text.iter().take_while(|byte| byte.is_ascii_digit()).count()
}

/// The letters at the end of a text, in lower case.
fn word_before(text: &str) -> String {
    let letters = text.bytes().rev().take_while(u8::is_ascii_alphabetic).count();
    text[text.len() - letters..].to_ascii_lowercase()
}

fn role_of(stem: &str, number: &Range<usize>) -> NumberRole {
    let (before, after) = (&stem[..number.start], &stem[number.end..]);
    let word_after = |text: &str| {
        let letters = text.bytes().take_while(u8::is_ascii_alphabetic).count();
        text[..letters].to_ascii_lowercase()
    };
    let touching = word_before(before);
    let separated = word_before(before.strip_suffix(SEPARATORS).unwrap_or(before));
    let following = word_after(after.strip_prefix(SEPARATORS).unwrap_or(after));
    if FRAME_WORDS.contains(&&*separated) {
        NumberRole::Frame
    } else if VERSION_WORDS.contains(&&*touching) {
        NumberRole::Version
    } else if !is_padded(&stem[number.clone()]) && COUNT_WORDS.contains(&&*following) {
        NumberRole::Count
    } else {
        NumberRole::Plain
    }
}

const SEPARATORS: [char; 4] = ['.', '_', '-', ' '];

/// Compares text, with numbers by their value: -2 before 10, and 10 before 10.05, which comes before 10.5.
/// Decimal points are recognized as in names of frames; of equal numbers, the one with fewer leading zeros
/// comes first.
pub fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut left, mut right) = (0, 0);
    while left < a.len() && right < b.len() {
        let (one, other) = (NaturalPart::at(a, left), NaturalPart::at(b, right));
        let order = one.compare(&other);
        if order != Ordering::Equal {
            return order;
        }
        (left, right) = (left + one.length, right + other.length);
    }
    let rest = (a.len() - left).cmp(&(b.len() - right));
    rest.then_with(|| a.len().cmp(&b.len())).then_with(|| a.cmp(b))
}

/// A number in a text, or a byte of the text between numbers.
struct NaturalPart<'a> {
    /// The byte; of a number, `-` or `0`.
    byte: u8,
    /// The digits of a number without leading zeros, and its decimals.
    number: Option<(&'a [u8], Option<&'a [u8]>)>,
    length: usize,
}

impl<'a> NaturalPart<'a> {
    fn at(text: &'a str, start: usize) -> NaturalPart<'a> {
        let bytes = text.as_bytes();
        let is_sign = bytes[start] == b'-'
            && bytes.get(start + 1).is_some_and(u8::is_ascii_digit)
            && may_precede_sign(&text[..start]);
        let digits_at = start + usize::from(is_sign);
        let end = digits_at + digit_count(&bytes[digits_at..]);
        if end == digits_at {
            return NaturalPart { byte: bytes[start], number: None, length: 1 };
        }
        let digits = &bytes[digits_at..end];
        let zeros = digits.iter().take_while(|&&digit| digit == b'0').count();
        let decimals = decimals_at(text, &(start..end)).filter(|decimals| {
            let is_short = decimals.len() < TAKE_DECIMALS_MIN;
            !decimals.is_empty()
                && !is_padded(&text[digits_at..end])
                && (digits == b"0" && is_short || may_precede_time(&text[..start]))
        });
        let length = decimals.as_ref().map_or(end, |decimals| decimals.end) - start;
        let number = (&digits[zeros..], decimals.map(|decimals| &bytes[decimals]));
        NaturalPart { byte: if is_sign { b'-' } else { b'0' }, number: Some(number), length }
    }

    fn compare(&self, other: &NaturalPart) -> Ordering {
        let by_text = self.byte.cmp(&other.byte).then(self.number.is_some().cmp(&other.number.is_some()));
        by_text.then_with(|| {
            let (Some((whole, decimals)), Some((other_whole, other_decimals))) = (self.number, other.number)
            else {
                return Ordering::Equal;
            };
            let by_whole = whole.len().cmp(&other_whole.len()).then_with(|| whole.cmp(other_whole));
            let by_value = by_whole.then_with(|| decimals.cmp(&other_decimals));
            if self.byte == b'-' { by_value.reverse() } else { by_value }
        })
    }
}

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
            assert_eq!(frame_number(stem).map(|found| &stem[found.span]), expected, "{stem}");
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
            assert_eq!(frame_number(stem).map(|found| &stem[found.span]), Some(expected), "{stem}");
        }
    }

    #[test]
    fn minus_after_a_separator_is_a_sign() {
        for (stem, expected) in [
            ("dam.-001", "-001"),
            ("dam_-12", "-12"),
            ("-7", "-7"),
            ("dam--7", "-7"),
            ("frame_-5_particles", "-5"),
            ("dam-001", "001"),
            ("2024-05", "05"),
            ("dam_0001-v12", "0001"),
        ] {
            assert_eq!(frame_number(stem).map(|found| &stem[found.span]), Some(expected), "{stem}");
        }
    }

    #[test]
    fn decimal_number_is_a_time() {
        use NumberMeaning::{Frame, Subframe, Time, TimeOrTake};
        for (stem, number, kind) in [
            ("result_0.05", "0.05", Time),
            ("result_12.5", "12.5", Time),
            ("result_-0.5", "-0.5", Time),
            ("0.1", "0.1", Time),
            ("t0.05", "0.05", Time),
            ("dam time 1.25", "1.25", Time),
            ("x.0.5", "0.5", Time),
            ("p_0.05_surface", "0.05", Time),
            ("p_0.5_particles", "0.5", Time),
            ("p_1e-05", "1e-05", Time),
            ("p_1.5e-05", "1.5e-05", Time),
            ("p_0.9000", "0.9000", TimeOrTake),
            ("tank_2.0001", "2.0001", TimeOrTake),
            ("dam_1000.5", "1000.5", Subframe),
            // Versions, dates, takes, shots and frames.
            ("dam.0001", "0001", Frame),
            ("v1.2.0001", "0001", Frame),
            ("v1.5", "5", Frame),
            ("dam_v0.5", "5", Frame),
            ("run_2024.05.01", "01", Frame),
            ("p_0.5_0001", "0001", Frame),
            ("p_0.5.0001", "0001", Frame),
            ("dam.2.1", "1", Frame),
            ("dt0.5_7", "7", Frame),
            ("filecache1.0001", "0001", Frame),
            ("cache.0.0001", "0001", Frame),
            ("shot_010.1", "1", Frame),
            ("a1e-05b", "05", Frame),
        ] {
            let found = frame_number(stem).expect(stem);
            assert_eq!((&stem[found.span], found.kind), (number, kind), "{stem}");
        }
        for (number, kind, frame) in [
            ("-012", Frame, Some(-12)),
            ("0001.50", Subframe, Some(1)),
            ("2.0012", TimeOrTake, Some(12)),
            ("2.5", Time, None),
            ("99999999999999999999", Frame, None),
        ] {
            assert_eq!(kind.frame_in(number), frame, "{number}");
        }
    }

    #[test]
    fn names_of_a_sequence_show_whether_decimal_numbers_are_times() {
        let numbers_of = |stems: &[&'static str]| -> Vec<&'static str> {
            let found: Vec<_> = stems.iter().filter_map(|stem| frame_number(stem)).collect();
            let found = compared_numbers(stems, &found, true).unwrap_or(found);
            stems.iter().zip(found).map(|(stem, found)| &stem[found.span]).collect()
        };
        for (stems, numbers) in [
            // Times.
            (&["p_0.9000", "p_0.9500", "p_1.0000", "p_1.0500", "p_2.0000"][..], &["0.9000", "0.9500"][..]),
            (&["p_0.9667", "p_1.0000", "p_1.0333"], &["0.9667"]),
            (&["p_0.9500", "p_1.0000"], &["0.9500"]),
            (&["p_0.9000", "p_0.9500"], &["0.9000"]),
            (&["p_0.9000"], &["0.9000"]),
            (&["p_0.125", "p_0.25", "p_0.375"], &["0.125"]),
            (&["fluid.0.95", "fluid.1.00", "fluid.1.05"], &["0.95", "1.00"]),
            (&["fluid2.05", "fluid2.1", "fluid2.15"], &["2.05"]),
            (&["t999.5", "t1000.0", "t1000.5"], &["999.5", "1000.0"]),
            (&["result_2.1", "result_2.2"], &["2.1"]),
            (&["p_1.5", "p_2.5"], &["1.5"]),
            // Takes and their frames.
            (&["tank_2.9", "tank_2.10", "tank_2.11"], &["9", "10"]),
            (&["tank_2.0001", "tank_2.0002"], &["0001"]),
            (&["tank_2.0001"], &["0001"]),
            (&["tank_1.0001", "tank_1.0002", "tank_2.0001", "tank_2.0002"], &["0001"]),
            (&["tank_2.1001", "tank_2.1003"], &["1001"]),
            (&["x.0.1", "x.0.2", "x.1.1", "x.1.2"], &["1"]),
            (&["s1.9", "s2.1"], &["9"]),
            // Only the number before the point varies.
            (&["p_1.0000", "p_2.0000", "p_3.0000"], &["1", "2"]),
        ] {
            let found = numbers_of(stems);
            assert_eq!(found[..numbers.len()], *numbers, "{stems:?}");
        }
    }

    #[test]
    fn names_of_folders_are_whole_numbers() {
        for number in ["0", "0.1", "0012", "-3", "1e-05", "2.5e+10"] {
            assert!(is_number(number), "{number}");
        }
        for other in ["", "-", "a", "v1", "0.", ".5", "1.2.3", "0.1s", "2024-05", "1e5x"] {
            assert!(!is_number(other), "{other}");
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
            let found: Vec<_> = stems.iter().filter_map(|stem| frame_number(stem)).collect();
            let last = numbers_behind_shots(stems, &found, is_shot_possible)?;
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
    fn order_is_natural() {
        // The web page sorts the same names (order.js) and uses the same test list.
        let sorted: Vec<&str> = include_str!("../../../tests/natural_order.txt").lines().collect();
        assert!(sorted.len() > 30);
        for (i, left) in sorted.iter().enumerate() {
            for (j, right) in sorted.iter().enumerate() {
                assert_eq!(natural_order(left, right), i.cmp(&j), "{left} {right}");
            }
        }
        let huge = "9".repeat(40);
        assert_eq!(natural_order(&huge, &format!("1{huge}")), Ordering::Less);
    }

    #[test]
    fn names_that_differ_in_numbers_share_the_rest() {
        assert_eq!(without_numbers("dam_0001_v3.ply"), "dam_#_v#.ply");
        assert_eq!(without_numbers("7ü"), "#ü");
        assert_eq!(without_numbers("dam.-003-4"), "dam.#-#");
        assert_eq!(without_numbers("dam"), "dam");
    }
}
