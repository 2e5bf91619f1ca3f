//! The provenance that an output records: the version of this program, the settings, and the input.
//!
//! Provenance does not depend on the time, the folder or the machine: the same input and settings give the
//! same bytes. An output is up to date if it records exactly what this run would record. If an output has
//! another provenance, or none, its frame must be converted again.

use std::io::Read;
use std::path::{Path, PathBuf};

use meniscus_formats::{WriteOption, is_complete, read_provenance};
use twox_hash::XxHash3_64;

use crate::surface::options::{MethodOptions, OptionGroup, Pairs, Settings};

use crate::pipeline::files::open::open_regular;
use crate::pipeline::input::frame::{Frame, Job};
use crate::pipeline::input::steps::frame_name;
use crate::pipeline::target::framing::Framed;
use crate::pipeline::target::outputs::{OutputFormat, OutputOptions, output_path};
use crate::pipeline::target::picture::PictureOptions;

/// Names of settings that earlier versions recorded under another name: the current and the former name.
const RENAMED: [(&str, &str); 1] = [("max_deviation", "band_slack")];

/// The name under which earlier versions recorded a setting.
fn former_name(name: &str) -> &str {
    RENAMED.iter().find(|(current, _)| *current == name).map_or(name, |renamed| renamed.1)
}

/// Reads the provenance of an output. Names that earlier versions recorded are replaced by the current ones.
pub(crate) fn recorded_provenance(
    format: OutputFormat,
    file: impl Read,
) -> meniscus_formats::Result<Vec<(String, String)>> {
    let mut recorded = read_provenance(format, file)?;
    for (name, _) in &mut recorded {
        if let Some((current, _)) = RENAMED.iter().find(|(_, former)| *former == name.as_str()) {
            *name = (*current).to_owned();
        }
    }
    Ok(recorded)
}

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

/// The provenance (names and values) of an output of the frame in `format`. `hash` is that of the frame's
/// input; `obstacles` are the names and hashes of its obstacle files.
pub(crate) fn provenance(
    frame: &Frame,
    (hash, obstacles): (u128, &str),
    format: OutputFormat,
) -> Vec<(String, String)> {
    let mut pairs = made_from(&frame.input, hash);
    match frame.job {
        Job::Particles => {
            pairs.push((CONTENTS, PARTICLES.to_owned()));
            pairs.extend(frame.settings.filter.iter().map(|filter| ("where", filter.to_string())));
            return owned(pairs);
        }
        Job::Surface => pairs.extend(settings_pairs(&frame.settings, format)),
        Job::LevelSet { max_deviation_voxels, .. } => {
            pairs.extend(level_set_pairs(&frame.settings, max_deviation_voxels, format));
        }
    }
    pairs.extend(obstacle_pairs(&frame.settings, obstacles));
    pairs.extend(option_pairs(&frame.outputs, format));
    owned(if format == OutputFormat::Stl { condensed(pairs) } else { pairs })
}

/// Shortens provenance to the 80 characters that an .stl has for it: keeps the generator and the hash of the
/// input. One hash replaces the obstacles, and another one everything else.
fn condensed(pairs: Pairs) -> Pairs {
    const OF_OBSTACLES: [&str; 2] = ["void_threshold", "obstacles"];
    let hash = |pairs: &[&(&str, String)], digits: usize| {
        // With the former names, so that the hash of equal settings is the same as in earlier versions.
        let line = |(name, value): &&(&str, String)| format!("{}={value}\n", former_name(name));
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

/// Whether every output of a frame is complete and records what this run would record. Complete means that
/// the end of the file is present; overwritten bytes in the middle are not detected.
pub(crate) fn is_done(frame: &Frame, hash: u128, obstacles: &str) -> bool {
    match frame.framing.as_ref().filter(|_| frame.has_pictures()) {
        None => records_all(frame, hash, obstacles),
        // A picture with an earlier camera of the sequence is still valid.
        Some(framing) => {
            let Framed { camera, earlier, .. } = framing.framed();
            let mut cameras = std::iter::once(camera).chain(earlier);
            cameras.any(|camera| records_all(&frame.with_camera(camera), hash, obstacles))
        }
    }
}

/// Whether every output of a frame is complete and records exactly this provenance.
fn records_all(frame: &Frame, hash: u128, obstacles: &str) -> bool {
    let options = &*frame.outputs;
    options.formats.iter().all(|&format| {
        let wanted = provenance(frame, (hash, obstacles), format);
        let path = output_path(&options.folder, &frame.stem, format);
        records(&path, format, &wanted).unwrap_or(false)
    })
}

/// Whether a file is complete and records exactly `wanted`.
pub(crate) fn records(
    path: &Path,
    format: OutputFormat,
    wanted: &[(String, String)],
) -> meniscus_formats::Result<bool> {
    // If an option was set when the file was written and is not set now, the file records a name that is not
    // in `wanted`.
    let is_wanted = |(name, _): &(String, String)| wanted.iter().any(|(wanted, _)| wanted == name);
    is_whole_and(path, format, |recorded| {
        recorded.iter().all(is_wanted) && wanted.iter().all(|pair| recorded.contains(pair))
    })
}

/// Whether a file is complete, and `is_meant` accepts its provenance.
fn is_whole_and(
    path: &Path,
    format: OutputFormat,
    is_meant: impl FnOnce(&[(String, String)]) -> bool,
) -> meniscus_formats::Result<bool> {
    let mut file = open_regular(path)?;
    let recorded = recorded_provenance(format, &file)?;
    Ok(is_meant(&recorded) && is_complete(format, &mut file)?)
}

/// The files in a folder that have this stem and an output format, are complete, and record an input with the
/// hash that `hash` returns. Ignores the settings. Calls `hash` only if there are files with this stem and an
/// output format.
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

/// The name in provenance whose value [`PARTICLES`] marks an output that contains particles, not a surface.
const CONTENTS: &str = "contents";
const PARTICLES: &str = "particles";

/// A hash of everything that outputs depend on except the input: the settings, the formats and their options,
/// and the version of this program. If the hash is unchanged, outputs of unchanged inputs are up to date.
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
    let chosen = WriteOption::ALL.into_iter().filter(|option| is_chosen(*option));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn former_names_of_settings_are_read_as_current_names() {
        let head = b"# meniscus_generator: meniscus 0.1.0\n# meniscus_band_slack: 0.5\nv 0 0 0\n";
        let recorded = recorded_provenance(OutputFormat::Obj, &head[..]).expect("read");
        assert_eq!(recorded[1], ("max_deviation".to_owned(), "0.5".to_owned()));
    }

    #[test]
    fn hash_of_settings_is_the_same_under_former_names() {
        let with_name = |name| condensed(vec![("generator", "g".to_owned()), (name, "1".to_owned())]);
        assert_eq!(with_name("max_deviation"), with_name("band_slack"));
    }
}
