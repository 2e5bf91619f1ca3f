//! From what was typed, or stands in a file, to the types of the layers below.

use std::io;
use std::path::PathBuf;

use anyhow::{Result, bail};
use meniscus_formats::{UpAxis, WriteOption, listed, vdb};

use crate::pipeline::{ObstacleFiles, OutputFormat, OutputOptions, PictureOptions};
use crate::surface::options::Settings;

use super::args::{CompressionChoice, Format, FormatArgs, MethodArgs, OptionSet, UpChoice, typed};
use super::console::Console;

/// Warns about options that have no effect. Skipped if the options are invalid: that error is reported later.
pub(super) fn warn_of_ignored(
    method: &MethodArgs,
    formats: Option<&[Format]>,
    format_args: &FormatArgs,
    console: &Console,
) {
    if Settings::check(&method.to_options()).is_ok() {
        for warning in ignored(method, &written_formats(formats, format_args), format_args) {
            console.warn(format_args!("warning: {warning}"));
        }
    }
}

/// The obstacles that were named.
///
/// # Errors
/// When there is no such file.
pub(super) fn obstacle_files(method: &MethodArgs) -> Result<ObstacleFiles> {
    let obstacles = ObstacleFiles::new(method.obstacle.clone());
    if let Some(missing) = obstacles.missing() {
        let name = missing.display();
        match missing.metadata() {
            Ok(there) if there.is_dir() => {
                bail!("{name}: a folder is no obstacle: give a file, or a pattern such as body.####.obj")
            }
            Err(error) if error.kind() != io::ErrorKind::NotFound => bail!("obstacle {name}: {error}"),
            Ok(_) => bail!("{name}: an obstacle has to be a regular file"),
            Err(_) => bail!("{name}: there is no such obstacle"),
        }
    }
    Ok(obstacles)
}

/// The options that are given and have no effect, a sentence each.
pub(super) fn ignored(args: &MethodArgs, written: &[OutputFormat], format_args: &FormatArgs) -> Vec<String> {
    let options = args.to_options();
    let successor = options.preset.and_then(|preset| Some((preset, preset.successor()?)));
    let deprecated = successor
        .map(|(preset, successor)| format!("the preset `{preset}` is deprecated: use --preset {successor}"));
    let ignored = options.without_effect(!args.obstacle.is_empty()).into_iter();
    let ignored = ignored.map(|(name, need)| format!("{} is ignored: it is for {need} only", typed(name)));
    let given = args.given().into_iter().chain(format_args.given());
    let idle = given.filter_map(|option| {
        let kind = unwritten_kind(&option, written)?;
        Some(format!("{option} changes no file: it is for {kind} only"))
    });
    deprecated.into_iter().chain(ignored).chain(idle).collect()
}

/// What an option is for, where no such file is written.
fn unwritten_kind(option: &str, written: &[OutputFormat]) -> Option<String> {
    let is_for_meshes = ["--contour", "--decimate", "--smooth-normals"].contains(&option);
    // --quantize is refused where it changes nothing, see `refuse_idle_quantize`.
    let write_option = WriteOption::ALL
        .into_iter()
        .find(|known| *known != WriteOption::Quantize && typed(known.key()) == option);
    let is_for = |format: &OutputFormat| match write_option {
        Some(write_option) => format.has_option(write_option),
        None => format.is_mesh(),
    };
    if !(is_for_meshes || write_option.is_some()) || written.iter().any(is_for) {
        return None;
    }
    Some(kinds(&OutputFormat::ALL.into_iter().filter(is_for).collect::<Vec<_>>()))
}

/// What these formats are called where an option is for them only.
fn kinds(formats: &[OutputFormat]) -> String {
    let (pictures, files): (Vec<_>, Vec<_>) = formats.iter().partition(|format| format.is_picture());
    let has_all_meshes = OutputFormat::ALL.iter().all(|format| !format.is_mesh() || files.contains(format));
    match (files.as_slice(), pictures.as_slice()) {
        ([], _) => "--preview".to_owned(),
        (_, []) if has_all_meshes => "meshes".to_owned(),
        (files, []) => listed(files.iter().map(|format| format!(".{format}")).collect(), "and"),
        (files, _) => {
            let files = files.iter().map(|format| format!(".{format}"));
            listed(files.chain(["pictures".to_owned()]).collect(), "and")
        }
    }
}

/// Refuses a number that was to be the value of --smooth-normals and is taken for an input, since that has its value
/// after a =.
///
/// # Errors
/// What to write instead.
pub(super) fn refuse_stray_rounds(args: &MethodArgs, inputs: &[PathBuf]) -> Result<()> {
    let is_stray = |input: &&PathBuf| {
        input.to_str().is_some_and(|text| text.parse::<u32>().is_ok()) && input.symlink_metadata().is_err()
    };
    if args.options.smooth_normals.is_some()
        && let Some(input) = inputs.iter().find(is_stray)
    {
        let number = input.display();
        bail!("{number}: no such file or folder; for {number} rounds, write --smooth-normals={number}");
    }
    Ok(())
}

/// Refuses to quantize where no .glb is written: whoever asks for it counts on small files.
///
/// # Errors
/// What to do instead.
pub(super) fn refuse_idle_quantize(formats: Option<&[Format]>, args: &FormatArgs) -> Result<()> {
    let written = written_formats(formats, args);
    if args.quantize && !written.iter().any(|format| format.has_option(WriteOption::Quantize)) {
        bail!("--quantize is for .glb only, and none is written: leave it out, or add glb to --format");
    }
    Ok(())
}

/// What is written, to `folder`: .glb and .vdb by default.
pub(super) fn output_options(
    folder: PathBuf,
    formats: Option<&[Format]>,
    args: &FormatArgs,
) -> OutputOptions {
    OutputOptions {
        folder,
        formats: written_formats(formats, args),
        up: match args.up.unwrap_or(UpChoice::Y) {
            UpChoice::Y => UpAxis::Y,
            UpChoice::Z => UpAxis::Z,
        },
        meters_per_unit: args.meters_per_unit.unwrap_or(1.0),
        quantize: args.quantize,
        vdb_half: args.vdb_half,
        vdb_compression: match args.vdb_compression.unwrap_or(CompressionChoice::Blosc) {
            CompressionChoice::None => vdb::Compression::None,
            CompressionChoice::Active => vdb::Compression::ActiveMask,
            CompressionChoice::Blosc => vdb::Compression::Blosc,
        },
        picture: picture_options(args),
    }
}

/// How pictures are taken.
fn picture_options(args: &FormatArgs) -> PictureOptions {
    let default = PictureOptions::default();
    PictureOptions {
        size: args.preview_size.map_or(default.size, |size| size.map(usize::from)),
        camera: args.camera.unwrap_or(default.camera),
    }
}

/// The formats to write, each once: .glb and .vdb by default; and a picture if that was asked for.
pub(super) fn written_formats(formats: Option<&[Format]>, args: &FormatArgs) -> Vec<OutputFormat> {
    let mut written = Vec::new();
    let formats = formats.unwrap_or(&DEFAULT_FORMATS).iter().map(|format| format.0);
    for format in formats.chain(args.preview.map(|preview| preview.0)) {
        if !written.contains(&format) {
            written.push(format);
        }
    }
    written
}

const DEFAULT_FORMATS: [Format; 2] = [Format(OutputFormat::Glb), Format(OutputFormat::Vdb)];
