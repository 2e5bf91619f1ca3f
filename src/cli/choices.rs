//! Detects options without effect, and finds the obstacles.

use std::io;
use std::path::PathBuf;

use anyhow::{Result, anyhow, bail};
use meniscus_formats::compression::read_head;
use meniscus_formats::{WriteOption, check_obstacle, listed};

use crate::pipeline::{ObstacleFiles, OutputFormat, open_regular};
use crate::surface::options::{MethodOptions, OptionGroup, Settings};

use super::args::{FormatArgs, MethodArgs, OptionSet};
use super::console::Console;
use super::wording::option_name;

/// Warns about options that have no effect. Skipped if the options are invalid: that error is reported later.
pub(super) fn warn_of_ignored(method: &MethodArgs, formats: &FormatArgs, console: &Console) {
    if Settings::check(&method.to_options()).is_ok() {
        for warning in ignored(method, formats, &formats.written()) {
            console.warning(warning);
        }
    }
}

/// The obstacle files that the options name.
///
/// # Errors
/// If a file is missing, or is neither a mesh nor a level set.
pub(super) fn obstacle_files(method: &MethodArgs) -> Result<ObstacleFiles> {
    let obstacles = ObstacleFiles::new(method.obstacle.clone());
    refuse_other_kinds(&obstacles)?;
    if let Some((path, error)) = obstacles.unreadable().next() {
        let name = path.display();
        match error.kind() {
            io::ErrorKind::NotFound => bail!("{name}: obstacle not found"),
            _ => bail!("obstacle {name}: {error}"),
        }
    }
    for path in method.obstacle.iter().filter(|path| path.is_file()) {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let head = open_regular(path).and_then(|file| read_head(file, HEAD_BYTES));
        // An error of reading is reported for each frame, because it may be temporary.
        if let Ok(head) = head {
            check_obstacle(&head, &name).map_err(|error| anyhow!("obstacle {}: {error}", path.display()))?;
        }
    }
    Ok(obstacles)
}

/// Refuses obstacles that exist and are no files, but folders or devices.
///
/// # Errors
/// What it is instead.
pub(super) fn refuse_other_kinds(obstacles: &ObstacleFiles) -> Result<()> {
    for (path, error) in obstacles.unreadable() {
        let name = path.display();
        match error.kind() {
            io::ErrorKind::IsADirectory => bail!(
                "{name}: this is a folder, not an obstacle: give a file, or a pattern such as body.####.obj"
            ),
            io::ErrorKind::InvalidInput => bail!("obstacle {name}: {error}"),
            _ => {}
        }
    }
    Ok(())
}

/// More bytes than are needed to recognise a mesh.
const HEAD_BYTES: u64 = 64 << 10;

/// Warnings about given options that have no effect, one sentence each.
pub(super) fn ignored(method: &MethodArgs, formats: &FormatArgs, written: &[OutputFormat]) -> Vec<String> {
    let options = method.to_options();
    let ignored = options.ineffective(!method.obstacle.is_empty()).into_iter();
    let ignored = ignored.map(|(name, needed)| {
        let needed = listed(needed.iter().map(|option| option.flag()).collect(), "and");
        format!("{} is ignored: it is for {needed} only", option_name(name))
    });
    // A stage records the axis and the unit.
    let of_stage = [WriteOption::Up, WriteOption::MetersPerUnit].map(WriteOption::key);
    let is_of_stage = |name: &&str| formats.stage.is_some() && of_stage.contains(name);
    let given = method.given().into_iter().chain(formats.given()).filter(|name| !is_of_stage(name));
    let idle = given.filter_map(|name| {
        let changed = formats_changed_by(name)?;
        let is_idle = !written.iter().any(|format| changed.contains(format));
        is_idle.then(|| format!("{} is ignored: it affects {} only", option_name(name), kinds(&changed)))
    });
    ignored.chain(idle).collect()
}

/// The formats whose files an option affects, by its name as an option or in records; `None` for an option
/// that affects the surface, and thus all formats.
pub(super) fn formats_changed_by(name: &str) -> Option<Vec<OutputFormat>> {
    let write_option =
        WriteOption::ALL.into_iter().find(|option| [option.key(), option.name()].contains(&name));
    let is_of_mesh = MethodOptions::info(name).is_some_and(|info| info.group == OptionGroup::Mesh);
    let is_changed = |format: &OutputFormat| match write_option {
        Some(option) => format.has_option(option),
        None => format.is_mesh(),
    };
    (write_option.is_some() || is_of_mesh).then(|| OutputFormat::ALL.into_iter().filter(is_changed).collect())
}

/// The name for these formats in the message about an option that affects only them.
fn kinds(formats: &[OutputFormat]) -> String {
    let (pictures, files): (Vec<_>, Vec<_>) = formats.iter().partition(|format| format.is_picture());
    let has_all_meshes = OutputFormat::ALL.iter().all(|format| !format.is_mesh() || files.contains(format));
    match (files.as_slice(), pictures.as_slice()) {
        ([], _) => "--preview".to_owned(),
        (_, []) if has_all_meshes => "meshes".to_owned(),
        (files, pictures) => {
            let names = files.iter().map(|format| format!(".{format}"));
            let pictures = (!pictures.is_empty()).then(|| "pictures".to_owned());
            listed(names.chain(pictures).collect(), "and")
        }
    }
}

/// Refuses a number that was meant as the value of --smooth-normals, which must follow a =, and was parsed as
/// an input.
///
/// # Errors
/// If there is such a number. The message states the correct spelling.
pub(super) fn refuse_misplaced_rounds(args: &MethodArgs, inputs: &[PathBuf]) -> Result<()> {
    let is_misplaced = |input: &&PathBuf| {
        input.to_str().is_some_and(|text| text.parse::<u32>().is_ok()) && input.symlink_metadata().is_err()
    };
    if args.options.0.smooth_normals.is_some()
        && let Some(input) = inputs.iter().find(is_misplaced)
    {
        let number = input.display();
        bail!("{number}: no such file or folder; for {number} rounds, write --smooth-normals={number}");
    }
    Ok(())
}
