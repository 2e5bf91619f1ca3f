//! Parses the values of options, on the command line and in a configuration file: `500ms`, `8GiB`,
//! `1280x720`.

use std::net::SocketAddr;
use std::time::Duration;

use bytesize::ByteSize;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use humantime::format_duration;

use crate::pipeline::FRAME_RATES;
use crate::surface::options::expected;
use crate::watch::Poll;

/// The longest duration: longer than anyone waits, and short enough that arithmetic with times does not
/// overflow.
const DURATION_MAX: Duration = Duration::from_secs(30 * 24 * 3600);

/// The shortest scan interval: with shorter ones the machine would do nothing but scan.
const POLL_MIN: Duration = Duration::from_millis(50);

/// Width and height of a picture in pixels.
pub(super) type PictureSize = [u16; 2];

/// The range of a picture's width and height in pixels.
const PICTURE_EDGE: std::ops::RangeInclusive<u16> = 16..=8192;

/// The maximum number of pixels: writing an .exr takes 130 bytes for each, 4 GB in all.
const PICTURE_PIXELS_MAX: u32 = 8192 * 4096;

/// Parses one of these values by its word, ignoring case. `--help` lists the words with their meanings.
pub(super) fn one_of<T: Copy + Send + Sync + 'static>(
    values: impl IntoIterator<Item = (T, &'static str, &'static str)>,
) -> impl TypedValueParser<Value = T> {
    let values: Vec<_> = values.into_iter().collect();
    let words: Vec<_> = values.iter().map(|(_, word, help)| PossibleValue::new(*word).help(*help)).collect();
    PossibleValuesParser::new(words).try_map(move |text| {
        let found = values.iter().find(|(_, word, _)| word.eq_ignore_ascii_case(&text));
        expected(&text, found.map(|(value, ..)| *value), "known")
    })
}

/// Parses a width and a height with an x between them.
pub(super) fn parse_picture_size(text: &str) -> Result<PictureSize, String> {
    let edge = |text: &str| text.trim().parse().ok().filter(|edge| PICTURE_EDGE.contains(edge));
    let size = text.split_once('x').and_then(|(width, height)| Some([edge(width)?, edge(height)?]));
    let fits = |[width, height]: &PictureSize| u32::from(*width) * u32::from(*height) <= PICTURE_PIXELS_MAX;
    let [least, most] = [PICTURE_EDGE.start(), PICTURE_EDGE.end()];
    let what = format_args!(
        "width and height in pixels, such as 1280x720: each {least} to {most}, and at most 33 million pixels (8K)"
    );
    expected(text, size.filter(fits), what)
}

/// Parses a time from 0 to 30 days.
pub(super) fn parse_duration(text: &str) -> Result<Duration, String> {
    parse_time(text, Duration::ZERO)
}

/// Parses the interval between scans of the folders, or `auto`.
pub(super) fn parse_poll(text: &str) -> Result<Poll, String> {
    match text {
        "auto" => Ok(Poll::Auto),
        _ => {
            parse_time(text, POLL_MIN).map(Poll::Every).map_err(|why| format!("{why}; auto is also allowed"))
        }
    }
}

fn parse_time(text: &str, least: Duration) -> Result<Duration, String> {
    let time = humantime::parse_duration(text.trim()).ok();
    let time = time.filter(|time| (least..=DURATION_MAX).contains(time));
    let [least, most] = [least, DURATION_MAX].map(format_duration);
    expected(
        text,
        time,
        format_args!("a time with a unit, such as 500ms, 2s or 1m 30s, from {least} to {most}"),
    )
}

/// Parses an address to listen on.
pub(super) fn parse_listen(text: &str) -> Result<SocketAddr, String> {
    expected(text, text.parse().ok(), "an address with a port, such as 127.0.0.1:7700 or [::1]:7700")
}

/// Parses a number of bytes.
///
/// # Errors
/// Why the text is not a number of bytes.
#[doc(hidden)]
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let size = text.trim().parse().ok().map(|size: ByteSize| size.as_u64());
    expected(
        text,
        size,
        "a size: expected a number of bytes, or a number with a unit, such as 512MiB or 8GiB",
    )
}

/// Parses a positive number.
pub(super) fn parse_positive(text: &str) -> Result<f64, String> {
    let number = text.trim().parse().ok().filter(|number: &f64| number.is_normal() && *number > 0.0);
    expected(text, number, "a positive number")
}

/// Parses a number of frames per second.
pub(super) fn parse_fps(text: &str) -> Result<f64, String> {
    let fps = text.parse().ok().filter(|fps| FRAME_RATES.contains(fps));
    expected(text, fps, "a number of frames per second: more than 0, at most 1000")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_units_and_bounds() {
        for (text, ms) in
            [("0", 0), ("500ms", 500), ("2s", 2000), (" 1m 30s ", 90_000), ("30d", 2_592_000_000)]
        {
            assert_eq!(parse_duration(text), Ok(Duration::from_millis(ms)), "{text}");
        }
        for text in ["", "5", "-1s", "2 parsecs", "31d", "99999999999999999999y", "1e3s"] {
            assert!(parse_duration(text).is_err_and(|why| why.contains(text)), "{text}");
        }
    }

    #[test]
    fn picture_sizes_need_width_and_height() {
        assert_eq!(parse_picture_size("1280x720"), Ok([1280, 720]));
        assert_eq!(parse_picture_size("7680x4320"), Ok([7680, 4320]));
        assert!(parse_picture_size("8192x8192").is_err_and(|why| why.contains("33 million")));
        for text in ["", "1280", "15x720", "8193x16", "1280x720x3", "ax16"] {
            assert!(parse_picture_size(text).is_err_and(|why| why.contains("1280x720")), "{text}");
        }
    }

    #[test]
    fn poll_interval_has_a_minimum() {
        assert_eq!(parse_poll("auto"), Ok(Poll::Auto));
        assert_eq!(parse_poll("2s"), Ok(Poll::Every(Duration::from_secs(2))));
        assert_eq!(parse_poll("50ms"), Ok(Poll::Every(POLL_MIN)));
        for text in ["0", "1ms", "never"] {
            assert!(parse_poll(text).is_err(), "{text}");
        }
    }

    #[test]
    fn sizes_are_binary_or_decimal() {
        let sizes = [("0", 0), ("1024", 1024), ("8GiB", 8 << 30), ("8 GB", 8_000_000_000), ("1.5KiB", 1536)];
        for (text, bytes) in sizes {
            assert_eq!(parse_bytes(text), Ok(bytes), "{text}");
        }
        for text in ["", "-1", "much", "8 giraffes"] {
            assert!(parse_bytes(text).is_err(), "{text}");
        }
    }
}
