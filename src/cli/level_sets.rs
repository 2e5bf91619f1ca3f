//! .vdb level sets as inputs: contoured unchanged, or smoothed within --max-deviation.

use anyhow::{Result, bail};

use crate::pipeline::{Job, is_level_set};
use crate::surface::options::{LengthUnit, MethodOptions, OptionGroup};

use super::args::{MethodArgs, OptionSet};
use super::select::{InputSelection, selected_files};
use super::wording::option_names;

/// How the selected files become surfaces: all are level sets, or all are particles.
///
/// # Errors
/// If both are selected, --max-deviation is given for particles, or options do not apply to level sets.
pub(super) fn surface_job(
    selection: &InputSelection,
    max_deviation: Option<f64>,
    method: &MethodArgs,
) -> Result<Job> {
    let mut files = selected_files(&selection.sequences);
    let is_one = files.clone().any(|file| is_level_set(&file.path));
    match files.find(|file| is_level_set(&file.path) != is_one) {
        Some(other) if is_one => {
            bail!(
                "{}: one command cannot convert both level sets and particles: run a command for each",
                other.path.display()
            )
        }
        _ if is_one => {
            let max_deviation_voxels = max_deviation.unwrap_or(0.0);
            refuse_options(method, if max_deviation_voxels == 0.0 { Use::AsItIs } else { Use::Smoothed })?;
            Ok(Job::level_set(max_deviation_voxels))
        }
        _ if max_deviation.is_some() => bail!("--max-deviation is for level sets in .vdb"),
        _ => Ok(Job::Surface),
    }
}

/// The purpose of a level set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Use {
    /// A surface, contoured unchanged.
    AsItIs,
    /// A surface, smoothed first.
    Smoothed,
    /// A picture.
    Picture,
}

/// Refuses options that do not apply to a level set.
///
/// # Errors
/// If such an option is given. The message names it, and states why it does not apply.
pub(super) fn refuse_options(method: &MethodArgs, reason: Use) -> Result<()> {
    let solver_has_no_use = match reason {
        Use::Picture => "a picture shows the surface of the file unchanged",
        Use::AsItIs | Use::Smoothed => "without --max-deviation it is not smoothed",
    };
    // Offsets in voxels or spacings cannot be resolved: the voxel size of a level set is known only when it
    // is read, and a level set has no particle spacing.
    if method.options.0.offset.is_some_and(|offset| offset.unit != LengthUnit::World) {
        bail!("--offset must be in world units for a level set in .vdb, such as --offset 0.01");
    }
    for (group, why) in [
        (OptionGroup::General, "the voxel size is that of the file, and presets are for particles"),
        (OptionGroup::Surface, "this option is for particles, and a surface has none"),
        (OptionGroup::Particles, "this option is for particles, and a surface has none"),
        (OptionGroup::Obstacles, "obstacles are for particles"),
        (OptionGroup::Solver, solver_has_no_use),
    ] {
        let mut given = method.given();
        given.retain(|name| group_of(name, reason) == Some(group));
        if !given.is_empty() && (group != OptionGroup::Solver || reason != Use::Smoothed) {
            let what = if reason == Use::Picture { "a level set or a mesh" } else { "a level set in .vdb" };
            bail!("{} cannot be given with {what}: {why}", option_names(&given));
        }
    }
    Ok(())
}

/// The group of an option with respect to level sets. `--offset` is allowed (`None`), except for pictures,
/// which show the level set unchanged.
fn group_of(name: &str, reason: Use) -> Option<OptionGroup> {
    match name {
        "obstacle" => Some(OptionGroup::Obstacles),
        "offset" => (reason == Use::Picture).then_some(OptionGroup::Solver),
        _ => MethodOptions::info(name).map(|info| info.group),
    }
}
