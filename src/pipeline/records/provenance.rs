//! The provenance that an output records: the version of this program, the settings, and the input.
//!
//! Provenance does not depend on the time, the folder or the machine: the same input and settings give the
//! same bytes. It is for people and other programs: whether a frame is done follows from its
//! [record](super::frame_records).

use std::io::Read;
use std::path::Path;

use meniscus_formats::provenance::{CONTENTS, PARTICLES, SPRAY};
use meniscus_formats::{PointFormat, WriteOption, read_provenance};
use twox_hash::XxHash3_64;

use crate::surface::options::{MethodOptions, OptionGroup, Pairs, ReadOptions, Settings};

use super::frame_records::SettingValues;
use crate::pipeline::files::open::open_regular;
use crate::pipeline::input::around::RecordedAround;
use crate::pipeline::input::frame::{Frame, Job};
use crate::pipeline::input::obstacles::ObstacleFiles;
use crate::pipeline::input::steps::frame_name;
use crate::pipeline::target::framing::{Framed, Framing};
use crate::pipeline::target::outputs::{OutputFormat, OutputOptions};
use crate::pipeline::target::picture::PictureOptions;

/// The value of `generator` in provenance begins with this text; the version follows.
const GENERATOR: &str = "meniscus ";

/// The provenance is within this many bytes from the start of an output, unless the input's name is very
/// long.
pub(crate) const HEAD_BYTES: u64 = 16 << 10;

/// This program and its version: the value of `generator` in provenance.
pub const GENERATOR_AND_VERSION: &str = concat!("meniscus ", env!("CARGO_PKG_VERSION"));

/// A hash as text in provenance.
pub(crate) fn hash_text(hash: u128) -> String {
    format!("xxh3-128:{hash:032x}")
}

/// The files that a frame was made from.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct MadeFrom<'a> {
    /// The hash of its input.
    pub(crate) input_hash: u128,
    /// The names and hashes of its obstacle files.
    pub(crate) obstacles: &'a str,
    /// The frames before and after it.
    pub(crate) around: &'a [RecordedAround],
}

/// The provenance (names and values) of an output of the frame in `format`.
pub(crate) fn provenance(
    frame: &Frame,
    MadeFrom { input_hash, obstacles, around }: MadeFrom<'_>,
    format: OutputFormat,
) -> Vec<(String, String)> {
    let mut pairs = made_from_around(frame, input_hash, around);
    pairs.extend(job_pairs(&frame.job, &frame.settings, format));
    if frame.job != Job::Particles {
        pairs.extend(obstacle_pairs(&frame.settings, obstacles));
        pairs.extend(option_pairs(&frame.outputs, format));
    }
    owned(if format == OutputFormat::Stl { condensed(pairs) } else { pairs })
}

/// The provenance of the points beside the frame's surface.
pub(crate) fn spray_provenance(
    frame: &Frame,
    MadeFrom { input_hash, obstacles, around }: MadeFrom<'_>,
    format: PointFormat,
) -> Vec<(String, String)> {
    let mut pairs = made_from_around(frame, input_hash, around);
    pairs.push((CONTENTS, SPRAY.to_owned()));
    let is_of_mesh =
        |name: &str| MethodOptions::info(name).is_some_and(|info| info.group == OptionGroup::Mesh);
    pairs.extend(frame.settings.pairs(|name| !is_of_mesh(name)));
    pairs.extend(obstacle_pairs(&frame.settings, obstacles));
    pairs.extend(points_option_pairs(&frame.outputs, format));
    owned(pairs)
}

/// The options of points in `format`.
fn points_option_pairs(options: &OutputOptions, format: PointFormat) -> Pairs {
    let [up, unit] =
        [WriteOption::Up, WriteOption::MetersPerUnit].map(|option| (option.name(), options.value(option)));
    match format {
        PointFormat::Usda if options.points_have_time_samples() => {
            vec![up, unit, (WriteOption::TimeSamples.name(), true.to_string())]
        }
        PointFormat::Usda | PointFormat::Usdc => vec![up, unit],
        PointFormat::Abc => vec![up],
        PointFormat::Ply | PointFormat::Vtp | PointFormat::Bgeo => Pairs::new(),
    }
}

fn made_from_around(frame: &Frame, input_hash: u128, around: &[RecordedAround]) -> Pairs {
    let mut pairs = made_from(&frame.input, input_hash);
    if !around.is_empty() {
        let text = |around: &RecordedAround| {
            let RecordedAround { steps, name, hash, obstacles } = around;
            let with = if obstacles.is_empty() { String::new() } else { format!(" with {obstacles}") };
            let steps = if around.is_history() { String::new() } else { format!("{steps:+} ") };
            format!("{steps}{name} {}{with}", hash_text(hash.unwrap_or(0)))
        };
        pairs.push(("around", around.iter().map(text).collect::<Vec<_>>().join(", ")));
    }
    pairs
}

/// The settings that affect the output of a frame in `format`.
fn job_pairs(job: &Job, settings: &Settings, format: OutputFormat) -> Pairs {
    match *job {
        Job::Particles => {
            let ReadOptions { columns, filter } = &settings.reading;
            let columns = columns.iter().map(|columns| ("columns", columns.to_string()));
            let filter = filter.iter().map(|filter| ("where", filter.to_string()));
            std::iter::once((CONTENTS, PARTICLES.to_owned())).chain(columns).chain(filter).collect()
        }
        Job::Surface => settings_pairs(settings, format),
        Job::LevelSet { max_deviation_voxels, .. } => level_set_pairs(settings, max_deviation_voxels, format),
    }
}

/// Shortens provenance to the 80 characters that an .stl has for it: keeps the generator and the hash of the
/// input. One hash replaces the obstacles, and another one everything else.
fn condensed(pairs: Pairs) -> Pairs {
    const OF_OBSTACLES: [&str; 2] = ["void_threshold", "obstacles"];
    let hash = |pairs: &[&(&str, String)], digits: usize| {
        let line = |(name, value): &&(&str, String)| format!("{name}={value}\n");
        let text: String = pairs.iter().map(line).collect();
        format!("{:016x}", XxHash3_64::oneshot(text.as_bytes()))[..digits].to_owned()
    };
    let (kept, hashed): (Vec<_>, Vec<_>) =
        pairs.iter().partition(|(name, _)| ["generator", "input_hash"].contains(name));
    let (obstacles, settings): (Vec<_>, Vec<_>) =
        hashed.into_iter().partition(|(name, _)| OF_OBSTACLES.contains(name));
    let obstacles = (!obstacles.is_empty()).then(|| ("obstacles", hash(&obstacles, 8)));
    kept.into_iter().cloned().chain([("settings", hash(&settings, 12))]).chain(obstacles).collect()
}

/// The settings that affect the output of a level set whose surface may move by `max_deviation_voxels`.
pub(crate) fn level_set_pairs(settings: &Settings, max_deviation_voxels: f64, format: OutputFormat) -> Pairs {
    let has_say = |name: &str| match MethodOptions::info(name).map(|info| info.group) {
        Some(OptionGroup::Mesh) => true,
        Some(OptionGroup::Solver) => max_deviation_voxels > 0.0,
        _ => ["voxel_size", "offset"].contains(&name),
    };
    let pairs = settings_pairs(settings, format).into_iter().filter(|(name, _)| has_say(name));
    [("max_deviation", max_deviation_voxels.to_string())].into_iter().chain(pairs).collect()
}

/// The provenance of a picture of a file with this hash. Includes the settings and obstacles of the
/// reconstruction, if the file was reconstructed for the picture.
pub fn picture_provenance(
    input: &Path,
    hash: u128,
    reconstructed: Option<(&Settings, &str)>,
    options: &PictureOptions,
) -> Vec<(String, String)> {
    let mut pairs = made_from(input, hash);
    if let Some((settings, obstacles)) = reconstructed {
        pairs.extend(settings_pairs(settings, OutputFormat::Png));
        pairs.extend(obstacle_pairs(settings, obstacles));
    }
    pairs.extend(picture_pairs(options));
    owned(pairs)
}

/// A part of a sheet, and its source.
#[derive(Clone, Debug)]
pub struct SheetPart {
    /// The name of the sequence or the file.
    pub name: String,
    /// A hash of the file, if the part is a single file.
    pub hash: Option<u128>,
    /// What the part shows, such as `60 of 240 frames, from pictures`.
    pub what: String,
    /// The settings of the reconstruction, if all frames of the part have the same settings.
    pub settings: Option<Settings>,
    /// The options of its pictures, if they were rendered for the sheet.
    pub options: Option<PictureOptions>,
}

/// The provenance of a sheet of this kind, part by part.
pub fn sheet_provenance(kind: &str, parts: &[SheetPart]) -> Vec<(String, String)> {
    let mut pairs = vec![("generator", GENERATOR_AND_VERSION.to_owned()), (SHEET, kind.to_owned())];
    for part in parts {
        pairs.push(("input", part.name.clone()));
        pairs.extend(part.hash.map(|hash| ("input_hash", hash_text(hash))));
        pairs.push(("shown", part.what.clone()));
        pairs.extend(part.settings.iter().flat_map(|settings| settings_pairs(settings, OutputFormat::Png)));
        pairs.extend(part.options.iter().flat_map(picture_pairs));
    }
    owned(pairs)
}

fn made_from(input: &Path, hash: u128) -> Pairs {
    vec![
        ("generator", GENERATOR_AND_VERSION.to_owned()),
        ("input", frame_name(input)),
        ("input_hash", hash_text(hash)),
    ]
}

fn obstacle_pairs(settings: &Settings, obstacles: &str) -> Pairs {
    if obstacles.is_empty() {
        return Pairs::new();
    }
    vec![("void_threshold", settings.void_threshold.to_string()), ("obstacles", obstacles.to_owned())]
}

fn owned(pairs: Pairs) -> Vec<(String, String)> {
    pairs.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

/// The settings that affect the outputs of frames, for their records: those of all formats together, and the
/// version of this program. Not among them are the camera of pictures, which may follow the frames, and the
/// voxel size of a level set, which its file has.
pub(crate) fn recorded_settings(
    job: &Job,
    settings: &Settings,
    outputs: &OutputOptions,
    obstacles: &ObstacleFiles,
) -> SettingValues {
    let mut formats: Vec<&str> = outputs.formats.iter().map(|format| format.extension()).collect();
    formats.sort_unstable();
    let mut pairs = vec![("program", GENERATOR_AND_VERSION.to_owned()), ("formats", formats.join(","))];
    for &format in &outputs.formats {
        pairs.extend(job_pairs(job, settings, format));
        pairs.extend(option_pairs(outputs, format));
    }
    if !outputs.spray.is_empty() {
        let mut formats: Vec<&str> = outputs.spray.iter().map(|format| format.extension()).collect();
        formats.sort_unstable();
        pairs.push(("spray_formats", formats.join(",")));
        pairs.extend(outputs.spray.iter().flat_map(|format| points_option_pairs(outputs, *format)));
    }
    if !obstacles.is_empty() {
        pairs.push(("void_threshold", settings.void_threshold.to_string()));
    }
    let is_level_set = matches!(job, Job::LevelSet { .. });
    let is_recorded = |name: &str| name != CAMERA && !(is_level_set && name == "voxel_size");
    owned(pairs.into_iter().filter(|(name, _)| is_recorded(name)).collect()).into_iter().collect()
}

/// The cameras that the pictures of a frame may have, the current one first; empty if it has no pictures. A
/// picture with an earlier camera of its sequence is still valid.
pub(crate) fn valid_cameras(outputs: &OutputOptions, framing: Option<&Framing>) -> Vec<String> {
    if !outputs.has_pictures() {
        return Vec::new();
    }
    let Some(framing) = framing else { return vec![outputs.picture.camera.to_string()] };
    let Framed { camera, earlier, .. } = framing.framed();
    std::iter::once(camera).chain(earlier).map(|camera| camera.to_string()).collect()
}

/// Whether a file is a surface or a picture that any version of this program wrote, according to its
/// provenance; `false` for particles, and for a file that cannot be read. Reads only the head of the file.
pub fn is_own_output(path: &Path) -> bool {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let Some(format) = OutputFormat::from_extension(&extension) else { return false };
    let recorded = open_regular(path)
        .map_err(meniscus_formats::Error::from)
        .and_then(|file| read_provenance(format, file.take(HEAD_BYTES)));
    let is_generator = |(name, value): &(String, String)| name == "generator" && value.starts_with(GENERATOR);
    recorded.is_ok_and(|pairs| pairs.iter().any(is_generator) && !are_particles(&pairs))
}

/// Whether a file with this provenance contains particles, and so may be an input.
pub fn are_particles(recorded: &[(String, String)]) -> bool {
    recorded.iter().any(|(name, value)| name == CONTENTS && value == PARTICLES)
}

/// The options of an output in `format`.
fn option_pairs(options: &OutputOptions, format: OutputFormat) -> Pairs {
    let is_recorded = |option: &WriteOption| match option {
        WriteOption::Quads => false,
        WriteOption::MetersPerUnit | WriteOption::TimeSamples => !options.is_default(*option),
        _ => true,
    };
    let of_format = format.options().iter().copied().filter(is_recorded);
    of_format.map(|option| (option.name(), options.value(option))).collect()
}

/// The options of a picture.
fn picture_pairs(options: &PictureOptions) -> Pairs {
    let outputs = OutputOptions { picture: *options, ..OutputOptions::new("", &[]) };
    OF_PICTURES.map(|option| (option.name(), outputs.value(option))).to_vec()
}

const OF_PICTURES: [WriteOption; 2] = [WriteOption::Size, WriteOption::Camera];

/// The name in provenance whose value is the kind of a sheet of pictures.
pub(crate) const SHEET: &str = "sheet";

/// The name in provenance whose value is the viewpoint of a picture.
pub const CAMERA: &str = "camera";

/// The output options that do not have their default value, and the options of pictures.
pub(crate) fn chosen_options(options: &OutputOptions, settings: &Settings) -> Pairs {
    let is_chosen = |option: WriteOption| match option {
        WriteOption::Quads => settings.quads && options.has_option(option),
        // Pictures record the up axis as part of their camera.
        WriteOption::Up => {
            let has_up = |format: &OutputFormat| !format.is_picture() && format.has_option(option);
            options.formats.iter().any(has_up) && !options.is_default(option)
        }
        _ if OF_PICTURES.contains(&option) => options.has_option(option),
        _ => options.has_option(option) && !options.is_default(option),
    };
    let name = |option: WriteOption| if OF_PICTURES.contains(&option) { option.name() } else { option.key() };
    let chosen = WriteOption::SETTINGS.into_iter().filter(|option| is_chosen(*option));
    chosen.map(|option| (name(option), options.value(option))).collect()
}

/// The settings that affect an output in `format`. Options of the mesh do not affect level sets. Obstacles
/// have [separate pairs](obstacle_pairs).
fn settings_pairs(settings: &Settings, format: OutputFormat) -> Pairs {
    settings.pairs(|name| match MethodOptions::info(name).map(|info| info.group) {
        Some(OptionGroup::Obstacles) => false,
        Some(OptionGroup::Mesh) if name == "quads" => format.has_option(WriteOption::Quads),
        Some(OptionGroup::Mesh) => format.is_mesh(),
        _ => true,
    })
}
