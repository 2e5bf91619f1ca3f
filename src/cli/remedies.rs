//! Suggests options that correct the cause of a warning.

use std::fmt;

use crate::pipeline::Warning;

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
        Warning::SeveralKinds { attribute, .. } => {
            format!("choose some with --where, such as --where '{attribute} == VALUE'")
        }
        Warning::NotConverged => "choose a smaller --step-size".to_owned(),
        Warning::CflExceeded { .. } => "choose a smaller --step-size".to_owned(),
        Warning::SmallRadii { radius_min, .. } => {
            format!("--voxel-size {} or less resolves all of them", rounded_down(radius_min / 3f64.sqrt()))
        }
        Warning::OffsetAway { .. } => {
            "use an --offset nearer to 0, or larger radii (--radius-min, --lone-radius)".to_owned()
        }
        Warning::BetweenVoxels { voxel_size, .. } => {
            format!("use --radius-min {} or more", significant(3f64.sqrt() * voxel_size))
        }
        Warning::Spray { .. } | Warning::Blob { .. } => of_spacing.to_owned(),
        Warning::Holes { .. } | Warning::Fragmented { .. } => {
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
