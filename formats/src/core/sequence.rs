//! The numbers and times of frames in files of sequences, for all writers of such files.

use crate::core::error::{Error, Position, Result};

/// The provenance name of the number of frames in a sequence.
pub const SEQUENCE_FRAMES: &str = "frames";

/// The content of a sequence.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SequenceInfo {
    /// Number of frames, including those without a mesh.
    pub frames: u64,
    /// Number of vertices, in all frames.
    pub vertices: u64,
    /// Number of triangles, in all frames.
    pub triangles: u64,
}

/// The largest absolute value of a frame number. Times are 64-bit floats, which cannot distinguish larger
/// integers.
pub(crate) const NUMBER_MAX: i64 = 1 << 53;

/// Checks that the numbers of named frames increase, and are within ±[`NUMBER_MAX`].
///
/// # Errors
/// [`Error::Invalid`] and [`Error::Unsupported`] with the frame's name.
pub(crate) fn check_numbers<'a>(
    format: &'static str,
    frames: impl Iterator<Item = (&'a str, i64)>,
) -> Result<()> {
    let mut last: Option<(&str, i64)> = None;
    for (name, number) in frames {
        if let Some((before, lower)) = last.filter(|(_, lower)| *lower >= number) {
            let what = format!(
                "frame numbers must increase: {before} has {lower}, and {name}, which follows it, has {number}"
            );
            return Err(Error::invalid(format, Position::File, what));
        }
        if number.unsigned_abs() > NUMBER_MAX.unsigned_abs() {
            let what = format!("the frame number {number} of {name} exceeds the limit, ±{NUMBER_MAX}");
            return Err(Error::unsupported(format, what));
        }
        last = Some((name, number));
    }
    Ok(())
}

/// The time between the last sample of a frame and the next frame, in frames. It is exact in binary, and
/// shorter than the intervals at which programs evaluate a scene. It is long enough for programs that take
/// the nearest sample at a rounded frame rate: with 23.976 instead of 24000/1001 frames per second, frame
/// 5,000 is 1/200 of a frame late.
const LAST_MOMENT: f64 = 1.0 / MOMENTS as f64;

/// How many of these make a frame.
pub(crate) const MOMENTS: i64 = 64;

/// The times, in frames, at which the frame with this number needs a sample, if programs interpolate between
/// it and the frame with the number `next`: its own, and the last moment before the next frame. Programs
/// interpolate between samples of the same size, but the vertices of two frames do not correspond.
#[expect(clippy::cast_precision_loss, reason = "the formats refuse numbers beyond 2⁵³")]
pub(crate) fn held_times(number: i64, next: Option<i64>) -> impl Iterator<Item = f64> {
    let (own, next) = (number as f64, next.map(|next| next as f64));
    let held = next.map(|next| next - LAST_MOMENT).filter(|held| own < *held && Some(*held) < next);
    [own].into_iter().chain(held)
}
