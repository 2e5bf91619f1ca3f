//! Formats numbers, times, options, warnings and errors as text.

use std::fmt;
use std::time::Duration;

use crate::pipeline::{FrameReport, FrameWarning, InputWarning, Job, ParticleSize, SurfaceWarning, Warning};
use crate::surface::options::Start;
use crate::surface::particles::Role;
pub(in crate::cli) use crate::surface::words::{pluralize, rounded_down, shortest, significant};

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

// Suggests options that correct the cause of a warning.

/// A warning, followed by the options that correct its cause.
pub(super) fn with_remedy(warning: &Warning) -> impl fmt::Display {
    match remedy(warning) {
        Some(remedy) => format!("{warning}; {remedy}"),
        None => warning.to_string(),
    }
}

fn remedy(warning: &Warning) -> Option<String> {
    let of_spacing = "check --spacing and --voxel-size, or leave them out: then the spacing is measured";
    Some(match warning {
        Warning::Tiled { .. } => "raise the limit with --memory".to_owned(),
        Warning::Input(InputWarning::SeveralKinds { attribute, .. }) => {
            format!("choose some with --where, such as --where '{attribute} == VALUE'")
        }
        Warning::Input(InputWarning::VariousSizes { size, attribute, .. }) => match size {
            ParticleSize::Radius => format!("--radius-attribute {attribute} uses them"),
            ParticleSize::SmoothingLength => {
                format!("use --radius-attribute {attribute}, with the radius of a particle over it as --radius-scale")
            }
            ParticleSize::Mass => "write their radii, too, and name them with --radius-attribute".to_owned(),
        },
        Warning::Input(InputWarning::SharedPosition { at: [x, y, z], .. }) => {
            let [x, y, z] = [x, y, z].map(|along| f64::from(*along as f32));
            format!("leave them out with --where 'x != {x} or y != {y} or z != {z}'")
        }
        Warning::Input(InputWarning::NotFollowed) => {
            "write `id` with the particles, or `velocity`, and give --time-step".to_owned()
        }
        Warning::Input(InputWarning::NotComputed { .. }) => COMPUTED_VELOCITIES.to_owned(),
        Warning::Input(InputWarning::MissingAttribute { name, .. }) if Role::Velocity.has_name(name) => {
            COMPUTED_VELOCITIES.to_owned()
        }
        Warning::Input(InputWarning::OtherTimeStep { velocity_scale, .. }) => format!(
            "check --time-step, or use --velocity-scale {} if the velocities have another unit of time",
            significant(*velocity_scale)
        ),
        Warning::Input(InputWarning::Irregular { suitable, .. }) => {
            format!("use --preset {suitable}, or give --preset fluid if splashes matter more")
        }
        Warning::Frame(FrameWarning::NotConverged | FrameWarning::CflExceeded { .. }) => {
            "choose a smaller --step-size".to_owned()
        }
        Warning::Input(InputWarning::SmallRadii { voxel_size, .. }) => {
            format!("--voxel-size {} or less resolves all of them", rounded_down(*voxel_size))
        }
        Warning::Input(InputWarning::LargeRadii { voxel_size, .. }) => {
            format!("--voxel-size {} or more keeps the radii of all", significant(voxel_size * 1.001))
        }
        Warning::Frame(FrameWarning::CoarsePositions { format: Some(format), .. }) => {
            format!("leave {format} out of --format")
        }
        Warning::Surface(SurfaceWarning::OffsetAway { .. }) => {
            "use an --offset nearer to 0, or larger particles (--blend, or --radius-min with --preset paper)".to_owned()
        }
        Warning::Surface(SurfaceWarning::BetweenVoxels { voxel_size, .. }) => {
            format!("use --radius-min {} or more", significant(Start::Spheres.resolved_voxels() * voxel_size))
        }
        Warning::Surface(SurfaceWarning::Spray { .. } | SurfaceWarning::Blob { .. }) => of_spacing.to_owned(),
        Warning::Surface(SurfaceWarning::Holes { .. } | SurfaceWarning::Fragmented { .. }) => {
            "check --spacing, --voxel-size and --neighbor-radius, or leave them out; a larger --blend, such as 2.4d, closes more of \
             them, and with --preset paper --radius-min 0.87d"
                .to_owned()
        }
        _ => return None,
    })
}

const COMPUTED_VELOCITIES: &str = "--time-step SECONDS, the time from one frame to the next, computes velocities from the frames before and after";

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
