//! Suggests options that correct the cause of a warning.

use std::fmt;

use crate::pipeline::{FrameWarning, InputWarning, SurfaceWarning, Warning};

use super::wording::{rounded_down, significant};

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
        Warning::Frame(FrameWarning::NotConverged) => "choose a smaller --step-size or a larger --cg-tolerance".to_owned(),
        Warning::Frame(FrameWarning::CflExceeded { .. }) => "choose a smaller --step-size".to_owned(),
        Warning::Input(InputWarning::SmallRadii { radius_min, .. }) => {
            format!("--voxel-size {} or less resolves all of them", rounded_down(radius_min / 3f64.sqrt()))
        }
        Warning::Frame(FrameWarning::CoarsePositions { format: Some(format), .. }) => {
            format!("leave {format} out of --format")
        }
        Warning::Surface(SurfaceWarning::OffsetAway { .. }) => {
            "use an --offset nearer to 0, or larger radii (--radius-min, --lone-radius)".to_owned()
        }
        Warning::Surface(SurfaceWarning::BetweenVoxels { voxel_size, .. }) => {
            format!("use --radius-min {} or more", significant(3f64.sqrt() * voxel_size))
        }
        Warning::Surface(SurfaceWarning::Spray { .. } | SurfaceWarning::Blob { .. }) => of_spacing.to_owned(),
        Warning::Surface(SurfaceWarning::Holes { .. } | SurfaceWarning::Fragmented { .. }) => {
            "check --spacing and --voxel-size, or leave them out; with --preset paper also give --radius-min 0.87d"
                .to_owned()
        }
        _ => return None,
    })
}

/// How to transfer the particles' velocities to the outputs.
pub(super) fn velocity_hint(name: &str) -> String {
    format!(
        "frames have the attribute \"{name}\" (velocity); --attributes {name} adds it to the outputs for motion blur"
    )
}
