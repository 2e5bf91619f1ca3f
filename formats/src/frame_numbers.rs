//! The numbers of frames in files of sequences.

use crate::error::{Error, Position, Result};

/// Checks that the numbers of named frames increase, and that a format can represent them: they are at most
/// `max`.
///
/// # Errors
/// [`Error::Invalid`] and [`Error::Unsupported`] with the frame's name.
pub(crate) fn check_numbers<'a>(
    format: &'static str,
    max: u64,
    frames: impl Iterator<Item = (&'a str, u64)>,
) -> Result<()> {
    let mut last: Option<(&str, u64)> = None;
    for (name, number) in frames {
        if let Some((before, lower)) = last.filter(|(_, lower)| *lower >= number) {
            let what = format!(
                "frame numbers must increase: {before} has {lower}, and {name}, which follows it, has {number}"
            );
            return Err(Error::invalid(format, Position::File, what));
        }
        if number > max {
            let what = format!("the frame number {number} of {name} exceeds the limit, {max}");
            return Err(Error::unsupported(format, what));
        }
        last = Some((name, number));
    }
    Ok(())
}
