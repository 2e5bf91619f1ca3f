//! Formats numbers, times, options, warnings and errors as text.

use std::time::Duration;

use crate::pipeline::{FrameReport, Job};
pub(in crate::cli) use crate::surface::words::{pluralize, shortest, significant};

/// Lines that were printed more than this many frames ago have probably scrolled out of view.
pub(super) const FRAMES_IN_VIEW: usize = 20;

/// An option as the user types it.
pub(super) fn option_name(name: &str) -> String {
    match name {
        "inputs" => "INPUT".to_owned(),
        _ => format!("--{}", name.replace('_', "-")),
    }
}

/// Options as the user types them, separated by commas.
pub(super) fn option_names(names: &[&str]) -> String {
    names.iter().map(|name| option_name(name)).collect::<Vec<_>>().join(", ")
}

/// One line about a converted frame.
pub(super) fn described(job: &Job, report: &FrameReport) -> String {
    let reconstruction = &report.reconstruction;
    let particles = pluralize(reconstruction.particle_count, "particle");
    let seconds = report.seconds.total();
    let mesh = format!(
        "{}, {}",
        pluralize(reconstruction.mesh.vertex_count, "vertex"),
        pluralize(reconstruction.mesh.triangle_count, "triangle")
    );
    match job {
        Job::Surface => {
            let spray = reconstruction.spray.map(|spray| format!(", {} as spray", spray.particles));
            format!("{particles}{}, {mesh}, {seconds:.2} s", spray.unwrap_or_default())
        }
        Job::LevelSet { .. } => format!("{mesh}, {seconds:.2} s"),
        Job::Particles => format!("{particles}, {seconds:.2} s"),
    }
}

/// An error and its causes. A cause that the text already ends with is not repeated.
pub(super) fn with_causes(error: &anyhow::Error) -> String {
    let mut message = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !message.ends_with(&cause) {
            message += &format!(": {cause}");
        }
    }
    message
}

/// The last line of a run in which some results failed validation.
pub(super) fn failed_validation(broken_count: usize, frame_count: usize, details: &str) -> String {
    let frames = pluralize(frame_count, "frame");
    format!("{broken_count} of {frames} failed validation{details}; outputs were kept")
}

/// Such as `1 frame is` and `3 frames are`.
pub(super) fn counted_are(count: u64) -> String {
    if count == 1 { "1 frame is".into() } else { format!("{count} frames are") }
}

/// How to transfer the particles' velocities to the outputs.
pub(super) fn velocity_hint(name: &str) -> String {
    format!(
        "frames have the attribute \"{name}\" (velocity); --attributes {name} adds it to the outputs for motion blur"
    )
}

// Formats times.

/// The time since a moment, in the two largest non-zero units.
pub(super) fn ago(at_ms: u64, now_ms: u64) -> String {
    let seconds = now_ms.saturating_sub(at_ms) / 1000;
    if seconds == 0 {
        return "just now".to_owned();
    }
    let text = humantime::format_duration(Duration::from_secs(seconds)).to_string();
    let units: Vec<&str> = text.split(' ').take(2).collect();
    format!("{} ago", units.join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{FrameError, Stage};

    #[test]
    fn repeated_cause_is_printed_once() {
        let bare = || meniscus_formats::Error::unsupported("PLY", "of another kind");
        let of_frame = FrameError::file("a.ply".as_ref(), Stage::Read, bare());
        assert_eq!(with_causes(&anyhow::Error::from(of_frame)), "a.ply: PLY: of another kind");
        assert_eq!(
            with_causes(&anyhow::Error::from(bare()).context("in all")),
            "in all: PLY: of another kind"
        );
    }

    #[test]
    fn times_have_at_most_two_units() {
        for (seconds, expected) in
            [(0, "just now"), (59, "59s ago"), (3600, "1h ago"), (3725, "1h 2m ago"), (90_061, "1day 1h ago")]
        {
            assert_eq!(ago(1000, 1000 + seconds * 1000 + 999), expected);
        }
        // A clock that was set back.
        assert_eq!(ago(5000, 1000), "just now");
    }
}
