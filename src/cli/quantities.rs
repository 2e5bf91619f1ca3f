//! Times and sizes as they are typed, on the command line and in a file: `500ms`, `8GiB`.

use std::net::SocketAddr;
use std::time::Duration;

use anyhow::bail;
use bytesize::ByteSize;

use crate::pipeline::{METERS_PER_UNIT, default_memory_bytes};
use crate::watch::Poll;

/// Nobody waits longer; and a moment so far away can still be computed.
const DURATION_MAX: Duration = Duration::from_secs(30 * 24 * 3600);

/// Looking more often than this is all that a machine would do.
const POLL_MIN: Duration = Duration::from_millis(50);

/// No frame does with less memory, in bytes: whoever asks for that has left out the unit.
const MEMORY_MIN_BYTES: u64 = 1 << 20;

/// Width and height of a picture, pixels.
pub(super) type PictureSize = [u16; 2];

/// Width and height with an x between them.
pub(super) fn parse_picture_size(text: &str) -> Result<PictureSize, String> {
    let edge = |text: &str| text.trim().parse().ok().filter(|edge| PICTURE_EDGE.contains(edge));
    let size = text.split_once('x').and_then(|(width, height)| Some([edge(width)?, edge(height)?]));
    if size.is_some_and(|[width, height]| u32::from(width) * u32::from(height) > PICTURE_PIXELS_MAX) {
        return Err(format!("`{text}` is too large: expected no more than 33 million pixels, which is 8K"));
    }
    let [least, most] = [PICTURE_EDGE.start(), PICTURE_EDGE.end()];
    size.ok_or_else(|| {
        format!("`{text}` is no size: expected width and height in pixels, each {least} to {most}, such as 1280x720")
    })
}

/// Pixels along the edge of a picture.
const PICTURE_EDGE: std::ops::RangeInclusive<u16> = 16..=8192;

/// Pixels of a picture: at 130 bytes for each while an .exr is made, 4 GB.
const PICTURE_PIXELS_MAX: u32 = 8192 * 4096;

/// A time from nothing to 30 days.
pub(super) fn parse_duration(text: &str) -> Result<Duration, String> {
    let duration = humantime::parse_duration(text.trim())
        .map_err(|_| format!("`{text}` is no time: a number with a unit, such as 500ms, 2s, 1m 30s"))?;
    if duration > DURATION_MAX {
        return Err(format!("`{text}` is too long: at most {}", humantime::format_duration(DURATION_MAX)));
    }
    Ok(duration)
}

/// A time between two looks at the folders, or `auto`.
pub(super) fn parse_poll(text: &str) -> Result<Poll, String> {
    if text == "auto" {
        return Ok(Poll::Auto);
    }
    let duration = parse_duration(text).map_err(|why| format!("{why}; or auto"))?;
    at_least(text, duration, POLL_MIN).map(Poll::Every)
}

/// A time between two looks at everything.
pub(super) fn parse_rescan(text: &str) -> Result<Duration, String> {
    at_least(text, parse_duration(text)?, POLL_MIN)
}

fn at_least(text: &str, duration: Duration, least: Duration) -> Result<Duration, String> {
    if duration < least {
        return Err(format!("`{text}` is too short: at least {}", humantime::format_duration(least)));
    }
    Ok(duration)
}

/// An address to listen at.
pub(super) fn parse_listen(text: &str) -> Result<SocketAddr, String> {
    text.parse()
        .map_err(|_| format!("`{text}` is no address with a port, such as 127.0.0.1:7700 or [::1]:7700"))
}

/// The length of a world unit in metres.
pub(super) fn parse_meters_per_unit(text: &str) -> Result<f64, String> {
    let meters = text.trim().parse().ok().filter(|meters| METERS_PER_UNIT.contains(meters));
    let [least, most] = [METERS_PER_UNIT.start(), METERS_PER_UNIT.end()];
    meters.ok_or_else(|| format!("`{text}` is not a number of metres from {least:e} to {most:e}"))
}

/// A number of bytes.
pub(super) fn parse_bytes(text: &str) -> Result<u64, String> {
    let size: ByteSize =
        text.trim().parse().map_err(|_| format!("`{text}` is no size: bytes, or such as 512MiB, 8GiB"))?;
    Ok(size.as_u64())
}

/// The memory that frames may take, in bytes: what was asked for, or half of what there is.
///
/// # Errors
/// When it is too little for any frame.
pub(super) fn memory_bytes(given: Option<u64>) -> anyhow::Result<u64> {
    match given {
        Some(bytes) if bytes < MEMORY_MIN_BYTES => {
            bail!("{bytes} bytes of memory are too little for any frame: give 1MiB at least, or such as 8GiB")
        }
        Some(bytes) => Ok(bytes),
        None => Ok(default_memory_bytes()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_without_a_unit_is_too_little() {
        assert!(memory_bytes(Some(5)).is_err_and(|why| why.to_string().contains("5 bytes of memory")));
        assert_eq!(memory_bytes(Some(1 << 20)).ok(), Some(1 << 20));
    }

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
    fn pictures_have_two_edges() {
        assert_eq!(parse_picture_size("1280x720"), Ok([1280, 720]));
        assert_eq!(parse_picture_size("7680x4320"), Ok([7680, 4320]));
        assert!(parse_picture_size("8192x8192").is_err_and(|why| why.contains("33 million")));
        for text in ["", "1280", "15x720", "8193x16", "1280x720x3", "ax16"] {
            assert!(parse_picture_size(text).is_err_and(|why| why.contains("1280x720")), "{text}");
        }
    }

    #[test]
    fn looking_takes_time() {
        assert_eq!(parse_poll("auto"), Ok(Poll::Auto));
        assert_eq!(parse_poll("2s"), Ok(Poll::Every(Duration::from_secs(2))));
        assert_eq!(parse_rescan("50ms"), Ok(POLL_MIN));
        for text in ["0", "1ms", "never"] {
            assert!(parse_poll(text).is_err() && parse_rescan(text).is_err(), "{text}");
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
