//! What made an output, recorded in it: the version of this program, the settings, the input.
//!
//! Nothing here depends on when, where or on which machine it was made: the same input and settings
//! give the same bytes. And an output that records what this run would record need not be made
//! again; whatever else it records, or nothing at all, means that it must.

use std::io::Read;
use std::path::{Path, PathBuf};

use meniscus_formats::{WriteOption, is_whole, read_provenance};
use twox_hash::XxHash3_64;

use crate::surface::options::{MethodOptions, OptionGroup, Pairs, Settings};

use crate::pipeline::files::open::open_regular;
use crate::pipeline::input::frame::{Frame, Job};
use crate::pipeline::input::steps::frame_name;
use crate::pipeline::target::framing::Framed;
use crate::pipeline::target::outputs::{OutputFormat, OutputOptions, output_path};
use crate::pipeline::target::picture::PictureOptions;

/// What an output's generator begins with; the version follows.
const GENERATOR: &str = "meniscus ";

/// The provenance of an output is within this much from its start, unless the input's name is very long.
pub(crate) const HEAD_BYTES: u64 = 16 << 10;

/// This program and its version, as outputs have them.
pub const GENERATOR_AND_VERSION: &str = concat!("meniscus ", env!("CARGO_PKG_VERSION"));

/// A hash as provenance has it.
pub(crate) fn hash_text(hash: u128) -> String {
    format!("xxh3-128:{hash:032x}")
}

/// Names and values for an output in `format`, made from the frame's input with this hash, among these obstacles.
pub(crate) fn provenance(
    frame: &Frame,
    (hash, obstacles): (u128, &str),
    format: OutputFormat,
) -> Vec<(String, String)> {
    let mut pairs = made_from(&frame.input, hash);
    match frame.job {
        Job::Particles => {
            pairs.push((CONTENTS, PARTICLES.to_owned()));
            return owned(pairs);
        }
        Job::Surface => pairs.extend(settings_pairs(&frame.settings, format)),
        Job::LevelSet { slack_voxels, .. } => {
            pairs.extend(level_set_pairs(&frame.settings, slack_voxels, format));
        }
    }
    pairs.extend(obstacle_pairs(&frame.settings, obstacles));
    pairs.extend(option_pairs(&frame.outputs, format));
    owned(if format == OutputFormat::Stl { condensed(pairs) } else { pairs })
}

/// The same where there is room for 80 characters: what the input and the obstacles were is told by hashes, and so is all
/// else together.
fn condensed(pairs: Pairs) -> Pairs {
    const OF_OBSTACLES: [&str; 2] = ["void_threshold", "obstacles"];
    let hash = |pairs: &[&(&str, String)], digits: usize| {
        let text: String = pairs.iter().map(|(name, value)| format!("{name}={value}\n")).collect();
        format!("{:016x}", XxHash3_64::oneshot(text.as_bytes()))[..digits].to_owned()
    };
    let (kept, hashed): (Vec<_>, Vec<_>) =
        pairs.iter().partition(|(name, _)| ["generator", "input_hash"].contains(name));
    let (obstacles, settings): (Vec<_>, Vec<_>) =
        hashed.into_iter().partition(|(name, _)| OF_OBSTACLES.contains(name));
    let obstacles = (!obstacles.is_empty()).then(|| ("obstacles", hash(&obstacles, 8)));
    kept.into_iter().cloned().chain([("settings", hash(&settings, 12))]).chain(obstacles).collect()
}

/// The settings of a surface of a level set that is at most this many voxels away from it: those that have a say.
pub(crate) fn level_set_pairs(settings: &Settings, slack_voxels: f64, format: OutputFormat) -> Pairs {
    let has_say = |name: &str| match MethodOptions::info(name).map(|info| info.group) {
        Some(OptionGroup::Mesh) => true,
        Some(OptionGroup::Solver) => slack_voxels > 0.0,
        _ => ["voxel_size", "offset"].contains(&name),
    };
    let pairs = settings_pairs(settings, format).into_iter().filter(|(name, _)| has_say(name));
    [("band_slack", slack_voxels.to_string())].into_iter().chain(pairs).collect()
}

/// Names and values for a picture of a file with this hash; with the settings by which it was skinned, among these
/// obstacles, if it was.
pub fn picture_provenance(
    input: &Path,
    hash: u128,
    skinned: Option<(&Settings, &str)>,
    options: &PictureOptions,
) -> Vec<(String, String)> {
    let mut pairs = made_from(input, hash);
    if let Some((settings, obstacles)) = skinned {
        pairs.extend(settings_pairs(settings, OutputFormat::Png));
        pairs.extend(obstacle_pairs(settings, obstacles));
    }
    pairs.extend(picture_pairs(options));
    owned(pairs)
}

/// A part of a sheet, and what it was made from.
#[derive(Clone, Debug)]
pub struct SheetPart {
    /// The name of the sequence or the file.
    pub name: String,
    /// A hash of the file, if it is one.
    pub hash: Option<u128>,
    /// What of it is shown, such as `60 of 240 frames, from pictures`.
    pub what: String,
    /// The settings by which it was skinned, if it was by one.
    pub settings: Option<Settings>,
    /// How its pictures were taken, if that was for the sheet.
    pub options: Option<PictureOptions>,
}

/// Names and values for a sheet of this kind, part by part.
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

/// Whether every output of a frame is there, whole, and records what this run would record. Whole
/// is one that has its end; bytes overwritten in the middle are not found out.
pub(crate) fn is_done(frame: &Frame, hash: u128, obstacles: &str) -> bool {
    match frame.framing.as_ref().filter(|_| frame.has_pictures()) {
        None => records_all(frame, hash, obstacles),
        // A picture that was taken before the camera of the sequence was refitted is as good as a new one.
        Some(framing) => {
            let Framed { camera, earlier, .. } = framing.framed();
            let mut cameras = std::iter::once(camera).chain(earlier);
            cameras.any(|camera| records_all(&frame.taken_by(camera), hash, obstacles))
        }
    }
}

/// Whether every output of a frame is there, whole, and records exactly this.
fn records_all(frame: &Frame, hash: u128, obstacles: &str) -> bool {
    let options = &*frame.outputs;
    options.formats.iter().all(|&format| {
        let wanted = provenance(frame, (hash, obstacles), format);
        let path = output_path(&options.folder, &frame.stem, format);
        records(&path, format, &wanted).unwrap_or(false)
    })
}

/// Whether a file records `wanted` and nothing else, and is whole.
pub(crate) fn records(
    path: &Path,
    format: OutputFormat,
    wanted: &[(String, String)],
) -> meniscus_formats::Result<bool> {
    // What was asked for then, and is not now, has a name that is not wanted.
    let is_wanted = |(name, _): &(String, String)| wanted.iter().any(|(wanted, _)| wanted == name);
    is_whole_and(path, format, |recorded| {
        recorded.iter().all(is_wanted) && wanted.iter().all(|pair| recorded.contains(pair))
    })
}

/// Whether a file is whole, and what it records is what is meant.
fn is_whole_and(
    path: &Path,
    format: OutputFormat,
    is_meant: impl FnOnce(&[(String, String)]) -> bool,
) -> meniscus_formats::Result<bool> {
    let mut file = open_regular(path)?;
    let recorded = read_provenance(format, &file)?;
    Ok(is_meant(&recorded) && is_whole(format, &mut file)?)
}

/// The files in a folder that have this stem, are in a format of outputs, are whole, and say that they were made from an input with the
/// hash that `hash` finds, which is not asked where there are no such files. With which settings is not looked at.
pub fn outputs_made_from<E>(
    folder: &Path,
    stem: &str,
    hash: impl FnOnce() -> Result<u128, E>,
) -> Result<Vec<PathBuf>, E> {
    let mut outputs: Vec<(OutputFormat, PathBuf)> =
        OutputFormat::ALL.map(|format| (format, output_path(folder, stem, format))).into();
    outputs.retain(|(_, path)| path.metadata().is_ok_and(|metadata| metadata.is_file()));
    if outputs.is_empty() {
        return Ok(Vec::new());
    }
    let wanted = ("input_hash".to_owned(), hash_text(hash()?));
    let is_made_from = |(format, path): &(OutputFormat, PathBuf)| {
        is_whole_and(path, *format, |recorded| recorded.contains(&wanted)).unwrap_or(false)
    };
    Ok(outputs.into_iter().filter(is_made_from).map(|(_, path)| path).collect())
}

/// Whether a file is an output of this program, of whatever version, by what it says of itself; what cannot
/// be read is none. Only the head of the file is looked at.
pub fn is_own_output(path: &Path) -> bool {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let Some(format) = OutputFormat::from_extension(&extension) else { return false };
    let recorded = open_regular(path)
        .map_err(meniscus_formats::Error::from)
        .and_then(|file| read_provenance(format, file.take(HEAD_BYTES)));
    let is_generator = |(name, value): &(String, String)| name == "generator" && value.starts_with(GENERATOR);
    recorded.is_ok_and(|pairs| pairs.iter().any(is_generator) && !are_particles(&pairs))
}

/// Whether a file that this program wrote holds particles, and may be a frame.
pub fn are_particles(recorded: &[(String, String)]) -> bool {
    recorded.iter().any(|(name, value)| name == CONTENTS && value == PARTICLES)
}

/// What says that an output holds particles and no surface.
const CONTENTS: &str = "contents";
const PARTICLES: &str = "particles";

/// All that outputs depend on but the input, in short: the settings, the formats and how they are written,
/// the version of this program. Equal ones mean that an output need not be made again.
pub fn settings_fingerprint(settings: &Settings, options: &OutputOptions) -> String {
    let mut formats = options.formats.clone();
    formats.sort_by_key(|format| format.extension());
    let mut text = format!("meniscus {}", env!("CARGO_PKG_VERSION"));
    for format in formats {
        text += &format!("\n{}", format.extension());
        for (name, value) in settings_pairs(settings, format).into_iter().chain(option_pairs(options, format))
        {
            text += &format!(" {name}={value}");
        }
    }
    format!("{:016x}", XxHash3_64::oneshot(text.as_bytes()))
}

/// How an output in `format` is written, as far as that can be chosen.
fn option_pairs(options: &OutputOptions, format: OutputFormat) -> Pairs {
    let is_recorded = |option: &WriteOption| match option {
        WriteOption::Quads | WriteOption::Quantize => false,
        WriteOption::MetersPerUnit => !options.is_default(*option),
        _ => true,
    };
    let of_format = format.options().iter().copied().filter(is_recorded);
    let mut pairs: Pairs = of_format.map(|option| (option.name(), options.value(option))).collect();
    // The mesh of all formats lacks the triangles that have no area in 16 bits.
    if format.is_mesh() && options.quantize && options.has_option(WriteOption::Quantize) {
        pairs.push((WriteOption::Quantize.name(), options.value(WriteOption::Quantize)));
    }
    pairs
}

/// How a picture is taken.
fn picture_pairs(options: &PictureOptions) -> Pairs {
    let outputs = OutputOptions { picture: *options, ..OutputOptions::new("", &[]) };
    OF_PICTURES.map(|option| (option.name(), outputs.value(option))).to_vec()
}

const OF_PICTURES: [WriteOption; 2] = [WriteOption::Size, WriteOption::Camera];

/// The name of what says that a picture is a sheet of others, and of which kind.
pub(crate) const SHEET: &str = "sheet";

/// The name of what says where a picture was taken from.
pub const CAMERA: &str = "camera";

/// Of how outputs are written, what is not the default; and how pictures are taken.
pub(crate) fn chosen_options(options: &OutputOptions, settings: &Settings) -> Pairs {
    let is_chosen = |option: WriteOption| match option {
        WriteOption::Quads => settings.quads && options.has_option(option),
        // Pictures say it themselves.
        WriteOption::Up => {
            let has_up = |format: &OutputFormat| !format.is_picture() && format.has_option(option);
            options.formats.iter().any(has_up) && !options.is_default(option)
        }
        _ if OF_PICTURES.contains(&option) => options.has_option(option),
        _ => options.has_option(option) && !options.is_default(option),
    };
    let name = |option: WriteOption| if OF_PICTURES.contains(&option) { option.name() } else { option.key() };
    let chosen = WriteOption::ALL.into_iter().filter(|option| is_chosen(*option));
    chosen.map(|option| (name(option), options.value(option))).collect()
}

/// Every setting that matters to an output in `format`. A level set is written as it is, before it becomes a mesh;
/// obstacles have [their own](obstacle_pairs).
fn settings_pairs(settings: &Settings, format: OutputFormat) -> Pairs {
    settings.pairs(|name| match MethodOptions::info(name).map(|info| info.group) {
        Some(OptionGroup::Obstacles) => false,
        Some(OptionGroup::Mesh) if name == "quads" => format.has_option(WriteOption::Quads),
        Some(OptionGroup::Mesh) => format.is_mesh(),
        _ => true,
    })
}
