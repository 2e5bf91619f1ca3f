//! Writes a stage that plays the files of the frames that exist so far.
//!
//! ```text
//!   out/dam.0012.usdc  out/dam.0013.usdc  ..  ◀── shot.usda ──▶  out/dam.0012.vdb  ..
//!                                                   └──────────▶  out/dam.0012.spray.usdc  ..
//! ```
//!
//! A stage depends only on the names of the frames, and on the files that exist, of which the largest define
//! the attributes: outputs appear complete, by rename. So every process that knows the frames writes the same
//! stage at any time: `convert` and the daemon while frames arrive, and each shard of a farm. Shards need no
//! order: each looks for files again after it has written the stage, so the last one to write it has seen the
//! files of all.

use std::cmp::Reverse;
use std::collections::{HashMap, HashSet};
use std::ffi::OsStr;
use std::fs;
use std::io::{self, Cursor, Read, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use meniscus_formats::usda::{ClipFile, SampledProperty, StageClips, UsdStage, stage_text};
use meniscus_formats::{PointFormat, is_complete, read_provenance, usda, usdc, vdb};

use super::sequence_file::{SequenceError, increasing};
use crate::pipeline::files::atomic_write::write_atomically;
use crate::pipeline::files::frame_number::natural_order;
use crate::pipeline::files::identity::real_path;
use crate::pipeline::files::open::open_regular;
use crate::pipeline::memory::reading_limits;
use crate::pipeline::records::provenance::{GENERATOR_AND_VERSION, HEAD_BYTES};
use crate::pipeline::target::outputs::{
    OutputFormat, OutputOptions, UsdStageOptions, output_path, spray_path,
};

/// The frames of a sequence in a stage, whether their files exist or not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UsdStageSequence {
    /// The base name of its outputs below the folder of outputs, with `{}` in place of the number: `dam.{}`,
    /// or `sub/dam.{}` in a sub-folder. The prim gets its name from it.
    pub name: String,
    /// Its frames, in their order.
    pub frames: Vec<UsdStageFrame>,
}

/// The files of a frame that a stage plays.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UsdStageFrame {
    /// The frame's number, if it has one.
    pub number: Option<i64>,
    /// The path of its mesh in USD, if it is among the outputs.
    pub mesh: Option<PathBuf>,
    /// The path of its level set in OpenVDB, if it is among the outputs.
    pub volume: Option<PathBuf>,
    /// The path of the points beside its surface in USD, if they are among the outputs.
    pub points: Option<PathBuf>,
}

impl UsdStageFrame {
    /// The frame whose outputs have this stem.
    pub fn new(outputs: &OutputOptions, stem: &str, number: Option<i64>) -> UsdStageFrame {
        let path = |format| output_path(&outputs.folder, stem, format);
        let has_volume = outputs.formats.contains(&OutputFormat::Vdb);
        UsdStageFrame {
            number,
            mesh: outputs.stage_mesh_format().map(path),
            volume: has_volume.then(|| path(OutputFormat::Vdb)),
            points: outputs.stage_points_format().map(|format| spray_path(&outputs.folder, stem, format)),
        }
    }

    /// Whether a stage can list its files: USD cannot name every file, and has no time code for every number.
    pub fn is_playable(&self) -> bool {
        let mut names = self.files().map(|file| file.file_name().unwrap_or_default());
        self.has_time_code() && names.all(|name| usd_text(name).is_some())
    }

    fn has_time_code(&self) -> bool {
        self.number.is_none_or(|number| (-TIME_CODE_MAX..=TIME_CODE_MAX).contains(&number))
    }

    fn files(&self) -> impl Iterator<Item = &PathBuf> {
        [&self.mesh, &self.volume, &self.points].into_iter().flatten()
    }
}

/// Time codes are 64-bit floats, which cannot distinguish larger integers.
const TIME_CODE_MAX: i64 = 1 << f64::MANTISSA_DIGITS;

/// A name as USD can write it; `None` if it is not Unicode, or has control characters.
fn usd_text(name: &OsStr) -> Option<&str> {
    name.to_str().filter(|name| !name.contains(char::is_control))
}

/// What a stage plays.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct UsdStageReport {
    /// The number of frames that have a file.
    pub frame_count: usize,
    /// The number of meshes.
    pub mesh_count: usize,
    /// The number of level sets.
    pub volume_count: usize,
    /// The number of files of points.
    pub points_count: usize,
    /// The names of the files that do not exist yet, in the order of the frames.
    pub missing: Vec<String>,
    /// Which frames are left out although their files exist, and why: a sentence each.
    pub left_out: Vec<String>,
}

/// Writes the stage of the [options](OutputOptions::stage) atomically, unless the file is up to date. Returns
/// `None`, and writes nothing, if no frame has a file, or if there is no stage in the options. A frame that
/// the stage cannot play is left out; if it can play none, nothing is written, and the report has no frames.
///
/// # Errors
/// When the file exists and is not a stage of this program, USD cannot name the stage itself, or the system
/// reports an error.
pub fn write_stage(
    outputs: &OutputOptions,
    sequences: &[UsdStageSequence],
) -> Result<Option<UsdStageReport>, SequenceError> {
    let Some(options) = &outputs.stage else { return Ok(None) };
    let path = options.path.as_path();
    let fail = |what: String| SequenceError { path: path.to_owned(), what };
    // Another shard may write at the same time: the file is compared again after it was written.
    for _ in 0..ROUNDS_MAX {
        let Some((stage, report)) = stage_of(outputs, options, sequences).map_err(fail)? else {
            return Ok(None);
        };
        if report.frame_count == 0 {
            return Ok(Some(report));
        }
        let text = stage_text(&stage, &provenance(&report)).map_err(|error| fail(error.to_string()))?;
        if known_text(path).map_err(fail)?.as_deref() == Some(text.as_bytes()) {
            return Ok(Some(report));
        }
        write_atomically(path, |out| Ok(out.write_all(text.as_bytes())?))
            .map_err(|error| fail(error.to_string()))?;
    }
    Ok(stage_of(outputs, options, sequences).map_err(fail)?.map(|(_, report)| report))
}

/// How many times to write the stage. If files still change then, the next frame updates it.
const ROUNDS_MAX: usize = 8;

/// The earliest time for the next update of stages, after they were written from `start` until now: a second
/// later, and so late that frames wait for stages for at most a twentieth of the time.
pub fn next_stage_update(start: Instant) -> Instant {
    Instant::now() + Duration::from_secs(1).max(20 * start.elapsed())
}

/// The name in provenance whose value is the number of frames of a stage.
pub(crate) const USD_STAGE_FRAMES: &str = "stage_frames";

fn provenance(report: &UsdStageReport) -> Vec<(String, String)> {
    let pair = |name: &str, value: String| (name.to_owned(), value);
    vec![
        pair("generator", GENERATOR_AND_VERSION.to_owned()),
        pair(USD_STAGE_FRAMES, report.frame_count.to_string()),
    ]
}

/// The number of frames that the stage in a file lists; `None` if there is no file.
///
/// # Errors
/// When the file is not a stage of this program, or another program has changed it.
pub fn stage_frame_count(path: &Path) -> Result<Option<usize>, String> {
    Ok(known_text(path)?.and_then(|text| recorded_frame_count(&text)))
}

fn recorded_frame_count(head: &[u8]) -> Option<usize> {
    let recorded = read_provenance(OutputFormat::Usda, head).ok()?;
    let (_, count) = recorded.iter().find(|(name, _)| name == USD_STAGE_FRAMES)?;
    count.parse().ok()
}

/// The bytes of an existing stage; `None` if there is no file. Refuses a file that is not a stage of this
/// program, because it may be a user's shot. Also refuses a stage that another program has changed: when such
/// a program saves the stage, it drops the comment at the end.
fn known_text(path: &Path) -> Result<Option<Vec<u8>>, String> {
    match read_stage(path) {
        // Another shard may replace the file while it is read. Then it is written, and read again.
        Err(error)
            if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::StaleNetworkFileHandle) =>
        {
            Ok(None)
        }
        read => read.map_err(|error| error.to_string())?.map(Some),
    }
}

/// The bytes of a stage, or why the file is none.
fn read_stage(path: &Path) -> io::Result<Result<Vec<u8>, String>> {
    let mut file = open_regular(path)?;
    let mut text = Vec::new();
    Read::by_ref(&mut file).take(HEAD_BYTES).read_to_end(&mut text)?;
    if recorded_frame_count(&text).is_none() {
        return Ok(Err("exists, and is not a stage of meniscus: choose another name".to_owned()));
    }
    file.read_to_end(&mut text)?;
    let is_ours = is_complete(OutputFormat::Usda, &mut Cursor::new(&text)).map_err(io::Error::other)?;
    Ok(if is_ours { Ok(text) } else { Err("was changed by another program: choose another name".to_owned()) })
}

/// The stage of the files that exist, which may have to leave out all of them; `None` without any.
fn stage_of(
    outputs: &OutputOptions,
    options: &UsdStageOptions,
    sequences: &[UsdStageSequence],
) -> Result<Option<(UsdStage, UsdStageReport)>, String> {
    let mut assets = AssetPaths::new(&options.path)?;
    let format = outputs.stage_mesh_format().unwrap_or(OutputFormat::Usdc);
    let are_points_text = outputs.stage_points_format() == Some(PointFormat::Usda);
    let points_format = if are_points_text { OutputFormat::Usda } else { OutputFormat::Usdc };
    let (mut found, mut report) = (Vec::new(), UsdStageReport::default());
    for (name, frames) in merged(sequences) {
        let (frames, beyond): (Vec<_>, Vec<_>) = frames.into_iter().partition(|frame| frame.has_time_code());
        for file in beyond.into_iter().filter_map(|frame| frame.files().next()) {
            let why = format!("frame numbers in USD are at most {TIME_CODE_MAX}");
            report.left_out.push(left_out(file, &why));
        }
        let numbers: Vec<Option<i64>> = frames.iter().map(|frame| frame.number).collect();
        let codes = increasing(&numbers);
        let mut meshes =
            ExistingFiles::of(frames.iter().map(|frame| frame.mesh.as_deref()), &codes, &mut assets)?;
        let volumes =
            ExistingFiles::of(frames.iter().map(|frame| frame.volume.as_deref()), &codes, &mut assets)?;
        let largest =
            volumes.largest_first().first().and_then(|&index| open_regular(volumes.sizes[index].1).ok());
        let mut points =
            ExistingFiles::of(frames.iter().map(|frame| frame.points.as_deref()), &codes, &mut assets)?;
        let (declared_by, properties) = meshes.defining(format, &mut report);
        let (points_declared_by, point_properties) = points.defining(points_format, &mut report);
        report.add(&meshes, &volumes, &points);
        let has_points = frames.iter().any(|frame| frame.points.is_some());
        found.push(StageClips {
            name: prim_name(name),
            are_points: false,
            declared_by,
            properties,
            meshes: meshes.clips,
            volumes: volumes.clips,
            has_velocity: largest.is_some_and(|mut file| vdb::has_velocity(&mut file).unwrap_or(false)),
        });
        found.extend(has_points.then(|| StageClips {
            name: format!("{}_spray", prim_name(name)),
            are_points: true,
            declared_by: points_declared_by,
            properties: point_properties,
            meshes: points.clips,
            ..StageClips::default()
        }));
    }
    let OutputOptions { up, meters_per_unit, .. } = *outputs;
    let stage =
        UsdStage { path: assets.of_stage()?, up, meters_per_unit, fps: options.fps, sequences: found };
    Ok((report.frame_count + report.left_out.len() > 0).then_some((stage, report)))
}

/// The frames of each name, and each output once. Inputs of several sequences may have outputs of one name,
/// such as files of which some are compressed. Two inputs may even have the same outputs, such as a file and
/// its compressed copy.
fn merged(sequences: &[UsdStageSequence]) -> Vec<(&str, Vec<&UsdStageFrame>)> {
    let mut merged: Vec<(&str, Vec<&UsdStageFrame>)> = Vec::new();
    let (mut index_of, mut listed) = (HashMap::new(), HashSet::new());
    for UsdStageSequence { name, frames } in sequences {
        let index = *index_of.entry(name).or_insert(merged.len());
        if index == merged.len() {
            merged.push((name.as_str(), Vec::new()));
        }
        let known = &mut merged[index].1;
        let is_first = known.is_empty();
        known.extend(frames.iter().filter(|frame| listed.insert((&frame.mesh, &frame.volume))));
        if !is_first {
            // Times have no numbers.
            known.sort_by(|one, other| {
                let [one_path, other_path] = [one, other].map(|frame| {
                    let path = frame.mesh.as_ref().or(frame.volume.as_ref());
                    path.map(|path| path.to_string_lossy()).unwrap_or_default()
                });
                one.number.cmp(&other.number).then_with(|| natural_order(&one_path, &other_path))
            });
        }
    }
    // Of equal names, the prims are numbered in this order, which must not depend on the command.
    merged.sort_by_key(|(name, _)| *name);
    merged
}

/// Files of frames that exist.
struct ExistingFiles<'a> {
    clips: Vec<ClipFile>,
    /// The size and path of each.
    sizes: Vec<(u64, &'a Path)>,
    /// For each frame, the state of its file.
    states: Vec<FileState<'a>>,
}

/// The file of a frame in a stage.
#[derive(Clone, Copy)]
enum FileState<'a> {
    /// The stage needs no such file.
    Unlisted,
    Listed,
    /// It does not exist yet.
    Missing(&'a Path),
    /// USD cannot name it.
    Unnamable(&'a Path),
}

impl<'a> ExistingFiles<'a> {
    fn of(
        paths: impl Iterator<Item = Option<&'a Path>>,
        codes: &[i64],
        assets: &mut AssetPaths,
    ) -> Result<ExistingFiles<'a>, String> {
        let (mut clips, mut sizes, mut states) = (Vec::new(), Vec::new(), Vec::new());
        for (path, &code) in paths.zip(codes) {
            let state_of = |path: &'a Path| -> Result<FileState<'a>, String> {
                let Some(metadata) = path.metadata().ok().filter(fs::Metadata::is_file) else {
                    return Ok(FileState::Missing(path));
                };
                let Some(asset) = assets.of(path)? else { return Ok(FileState::Unnamable(path)) };
                sizes.push((metadata.len(), path));
                clips.push(ClipFile { code, path: asset });
                Ok(FileState::Listed)
            };
            states.push(path.map_or(Ok(FileState::Unlisted), state_of)?);
        }
        Ok(ExistingFiles { clips, sizes, states })
    }

    /// See [`defining`]. If no file can define the attributes, says why, and removes all files from the stage.
    fn defining(
        &mut self,
        format: OutputFormat,
        report: &mut UsdStageReport,
    ) -> (usize, Vec<SampledProperty>) {
        defining(self, format).unwrap_or_else(|why| {
            report.left_out.push(why);
            self.unlist();
            (0, Vec::new())
        })
    }

    /// Removes all files from the stage.
    fn unlist(&mut self) {
        self.clips.clear();
        let listed = self.states.iter_mut().filter(|state| matches!(state, FileState::Listed));
        listed.for_each(|state| *state = FileState::Unlisted);
    }

    /// The indices of the files, by descending size.
    fn largest_first(&self) -> Vec<usize> {
        let mut indices: Vec<usize> = (0..self.sizes.len()).collect();
        indices.sort_by_key(|&index| Reverse(self.sizes[index].0));
        indices
    }
}

impl UsdStageReport {
    /// Adds the files of the frames of a sequence.
    fn add(&mut self, meshes: &ExistingFiles, volumes: &ExistingFiles, points: &ExistingFiles) {
        self.mesh_count += meshes.clips.len();
        self.volume_count += volumes.clips.len();
        self.points_count += points.clips.len();
        for ((mesh, volume), points) in meshes.states.iter().zip(&volumes.states).zip(&points.states) {
            let files = [*mesh, *volume, *points];
            self.frame_count += usize::from(files.iter().any(|state| matches!(state, FileState::Listed)));
            let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            self.missing.extend(files.iter().filter_map(|state| match state {
                FileState::Missing(path) => Some(name(path)),
                _ => None,
            }));
            let unnamable = files.iter().find_map(|state| match state {
                FileState::Unnamable(path) => Some(path),
                _ => None,
            });
            let why = "its path has control characters or is not Unicode, so USD cannot name it";
            self.left_out.extend(unnamable.map(|path| left_out(path, why)));
        }
    }
}

/// The sentence about a frame that is left out of a stage, with one of its files.
fn left_out(file: &Path, why: &str) -> String {
    format!("{} is left out of the stage: {why}; rename its frame", file.display())
}

/// The mesh that defines the attributes of all, by its index, and those that have time samples in it: the
/// largest, because the file of an empty frame may lack some. A file that cannot define them, because it is
/// damaged or another program wrote it, is passed over.
fn defining(meshes: &ExistingFiles, format: OutputFormat) -> Result<(usize, Vec<SampledProperty>), String> {
    let mut failure = None;
    for index in meshes.largest_first().into_iter().take(DEFINING_MAX) {
        let path = meshes.sizes[index].1;
        let why = match sampled_properties(path, format) {
            Ok(properties) if !properties.is_empty() => return Ok((index, properties)),
            Ok(_) => {
                "it has no time samples, so a stage cannot play it: convert it again, with --stage".to_owned()
            }
            Err(error) => error.to_string(),
        };
        failure.get_or_insert_with(|| format!("{}: {why}", path.display()));
    }
    failure.map_or(Ok((0, Vec::new())), Err)
}

/// How many files are read to find one that can define the attributes.
const DEFINING_MAX: usize = 100;

/// The attributes with time samples in a file.
fn sampled_properties(path: &Path, format: OutputFormat) -> meniscus_formats::Result<Vec<SampledProperty>> {
    let mut file = open_regular(path)?;
    if format != OutputFormat::Usda {
        return usdc::read_sampled_properties(&mut file, &reading_limits());
    }
    let mut head = Vec::new();
    file.take(SAMPLED_HEAD_BYTES).read_to_end(&mut head)?;
    usda::read_sampled_properties(&head)
}

/// Holds the head of a `.usda`, with hundreds of attributes.
const SAMPLED_HEAD_BYTES: u64 = 64 << 10;

/// Makes paths relative to the folder of a stage.
struct AssetPaths {
    stage: PathBuf,
    /// The folder of the stage, without links.
    folder: PathBuf,
    /// The relative path of each folder; `None` if USD cannot name it.
    relative: HashMap<PathBuf, Option<String>>,
}

impl AssetPaths {
    fn new(stage: &Path) -> Result<AssetPaths, String> {
        let folder = real_folder(stage)?;
        Ok(AssetPaths { stage: stage.to_owned(), folder, relative: HashMap::new() })
    }

    /// The path of the stage itself.
    fn of_stage(&self) -> Result<String, String> {
        let name = usd_text(self.stage.file_name().unwrap_or_default());
        let name = name.ok_or("has control characters or is not Unicode: choose another name")?;
        Ok(format!("./{name}"))
    }

    /// The path of a file, for the stage; `None` if USD cannot name it.
    fn of(&mut self, file: &Path) -> Result<Option<String>, String> {
        let parent = file.parent().unwrap_or(Path::new(""));
        if !self.relative.contains_key(parent) {
            let folder = relative_folder(&self.folder, &real_folder(file)?);
            self.relative.insert(parent.to_owned(), folder);
        }
        let name = usd_text(file.file_name().unwrap_or_default());
        let Some((folder, name)) = self.relative[parent].as_ref().zip(name) else { return Ok(None) };
        if folder == "./" && self.stage.file_name().is_some_and(|stage| stage == name) {
            return Err("the stage would replace one of its frames: choose another name".to_owned());
        }
        Ok(Some(format!("{folder}{name}")))
    }
}

/// The folder of a file, without links.
fn real_folder(file: &Path) -> Result<PathBuf, String> {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    folder.metadata().map_err(|error| format!("{}: {error}", folder.display()))?;
    Ok(real_path(folder))
}

/// The path from one folder to another, with `/` after each name; absolute if the folders have only the root
/// in common. A relative path starts with a dot: otherwise programs would also search for it in other
/// folders. `None` if USD cannot write it.
fn relative_folder(from: &Path, to: &Path) -> Option<String> {
    let common = from.components().zip(to.components()).take_while(|(from, to)| from == to).count();
    let mut relative = match from.components().count() - common {
        _ if common < 2 => String::new(),
        0 => "./".to_owned(),
        up_count => "../".repeat(up_count),
    };
    let rest: PathBuf = to.components().skip(if relative.is_empty() { 0 } else { common }).collect();
    relative += &usd_text(rest.as_os_str())?.replace(std::path::MAIN_SEPARATOR, "/");
    if !relative.ends_with('/') {
        relative.push('/');
    }
    Some(relative)
}

/// The part of a sequence's name before the number: `dam` of `dam.{}`, `sub/dam` of `sub/dam.{}`.
fn prim_name(sequence: &str) -> String {
    let stem = sequence.replacen("{}/", "", 1);
    let stem = stem.split_once("{}").map_or(&*stem, |(before, _)| before);
    let plain = stem.trim_end_matches(|c: char| !c.is_alphanumeric());
    if plain.is_empty() { "frames".to_owned() } else { plain.to_owned() }
}

#[cfg(test)]
mod tests {
    use meniscus_formats::{MeshOptions, MeshView};

    use super::*;

    #[test]
    fn prims_are_named_after_sequences() {
        for (name, prim) in [
            ("dam.{}", "dam"),
            ("my sim_v2.{}", "my sim_v2"),
            ("run.0002.{}", "run.0002"),
            ("water", "water"),
            ("{}", "frames"),
            ("dam_{}_b7", "dam"),
            ("sub/dam.{}", "sub/dam"),
            ("sub/{}", "sub"),
            ("{}/p", "p"),
            ("sub/{}/p", "sub/p"),
        ] {
            assert_eq!(prim_name(name), prim, "{name}");
        }
    }

    #[test]
    fn folders_are_relative_to_the_stage() {
        for (from, to, relative) in [
            ("/shots/dam", "/shots/dam", "./"),
            ("/shots/dam", "/shots/dam/out/a b", "./out/a b/"),
            ("/shots/dam/usd", "/shots/dam/out", "../out/"),
            ("/shots/dam", "/cache/dam", "/cache/dam/"),
            ("/", "/out", "/out/"),
            ("/out", "/", "/"),
        ] {
            assert_eq!(
                relative_folder(Path::new(from), Path::new(to)).as_deref(),
                Some(relative),
                "{from} {to}"
            );
        }
    }

    fn outputs(folder: &Path, formats: &[OutputFormat]) -> OutputOptions {
        let stage = UsdStageOptions { path: folder.join("shot.usda"), fps: 24.0 };
        OutputOptions { stage: Some(stage), ..OutputOptions::new(folder.join("out"), formats) }
    }

    fn sequence(outputs: &OutputOptions, numbers: &[i64]) -> Vec<UsdStageSequence> {
        let frame = |number: &i64| UsdStageFrame::new(outputs, &format!("dam.{number}"), Some(*number));
        vec![UsdStageSequence { name: "dam.{}".to_owned(), frames: numbers.iter().map(frame).collect() }]
    }

    /// A mesh in USD, with this many triangles.
    fn mesh(path: &Path, triangle_count: usize) {
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]].repeat(triangle_count);
        let triangles: Vec<[u32; 3]> =
            (0..).step_by(3).map(|i| [i, i + 1, i + 2]).take(triangle_count).collect();
        let view = MeshView {
            positions: &positions,
            normals: &positions,
            triangles: &triangles,
            origin: [0.0; 3],
            attributes: &[],
        };
        let format = if path.extension().is_some_and(|extension| extension == "usda") {
            OutputFormat::Usda
        } else {
            OutputFormat::Usdc
        };
        let options = MeshOptions { time_samples: true, ..MeshOptions::default() };
        let mut bytes = Vec::new();
        format.write_mesh(&view, &options, &[], &mut bytes).expect("writing to memory");
        fs::write(path, bytes).expect("written");
    }

    #[test]
    fn stage_lists_the_files_that_exist_and_takes_attributes_from_the_largest() {
        let folder = tempfile::tempdir().expect("a folder");
        let outputs = outputs(folder.path(), &[OutputFormat::Glb, OutputFormat::Usdc, OutputFormat::Vdb]);
        let frames = sequence(&outputs, &[1, 2, 3, 4]);
        assert_eq!(write_stage(&outputs, &frames).expect("no error"), None);
        assert!(!folder.path().join("shot.usda").exists());
        fs::create_dir(folder.path().join("out")).expect("made");
        for (name, triangle_count) in [("dam.1.usdc", 1), ("dam.2.usdc", 9), ("dam.4.usdc", 9)] {
            mesh(&folder.path().join("out").join(name), triangle_count);
        }
        fs::write(folder.path().join("out/dam.4.vdb"), "volume").expect("written");
        let missing = ["dam.1.vdb", "dam.2.vdb", "dam.3.usdc", "dam.3.vdb"].map(str::to_owned).to_vec();
        let report = UsdStageReport {
            frame_count: 3,
            mesh_count: 3,
            volume_count: 1,
            missing,
            ..UsdStageReport::default()
        };
        assert_eq!(write_stage(&outputs, &frames).expect("written"), Some(report));
        let text = fs::read_to_string(folder.path().join("shot.usda")).expect("written");
        for part in [
            "[@./out/dam.1.usdc@, @./out/dam.2.usdc@, @./out/dam.4.usdc@]",
            "references = @./out/dam.2.usdc@",
            "asset manifestAssetPath = @./shot.usda@",
            "        point3f[] points\n",
            "4: @./out/dam.4.vdb@",
            "endTimeCode = 4",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }

    #[test]
    fn outputs_that_two_inputs_have_in_common_are_listed_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let outputs = outputs(folder.path(), &[OutputFormat::Usdc]);
        fs::create_dir(folder.path().join("out")).expect("made");
        for number in 1..=4 {
            mesh(&folder.path().join(format!("out/dam.{number}.usdc")), 1);
        }
        // Such as files of which some are compressed.
        let mut frames = sequence(&outputs, &[1, 1, 3, 3]);
        frames.extend(sequence(&outputs, &[1, 2, 3]));
        let mut others = sequence(&outputs, &[2, 4]);
        others[0].name = "drops.{}".to_owned();
        frames.extend(others);
        let report = write_stage(&outputs, &frames).expect("written").expect("frames");
        assert_eq!((report.mesh_count, report.missing.len()), (4, 0));
        let text = fs::read_to_string(folder.path().join("shot.usda")).expect("written");
        for part in [
            "[@./out/dam.1.usdc@, @./out/dam.2.usdc@, @./out/dam.3.usdc@]",
            "active = [(1, 0), (1.984375, 0), (2, 1), (2.984375, 1), (3, 2)]",
            "[@./out/dam.4.usdc@]",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }

    #[test]
    fn file_that_cannot_define_the_attributes_is_passed_over() {
        let folder = tempfile::tempdir().expect("a folder");
        let outputs = outputs(folder.path(), &[OutputFormat::Usdc]);
        let frames = sequence(&outputs, &[1, 2]);
        fs::create_dir(folder.path().join("out")).expect("made");
        fs::write(folder.path().join("out/dam.2.usdc"), vec![0; 1 << 20]).expect("written");
        let report = write_stage(&outputs, &frames).expect("no error").expect("a file");
        assert!(report.frame_count == 0 && report.left_out[0].contains("dam.2.usdc: "), "{report:?}");
        assert!(!folder.path().join("shot.usda").exists());
        mesh(&folder.path().join("out/dam.1.usdc"), 1);
        let report = write_stage(&outputs, &frames).expect("written").expect("frames");
        assert_eq!(report.frame_count, 2);
        let text = fs::read_to_string(folder.path().join("shot.usda")).expect("written");
        assert!(text.contains("references = @./out/dam.1.usdc@"), "{text}");
    }

    /// One file does not take the stage from all frames.
    #[test]
    #[cfg_attr(windows, ignore = "names of files have no control characters")]
    fn frames_that_cannot_be_played_are_left_out() {
        let folder = tempfile::tempdir().expect("a folder");
        let outputs = outputs(folder.path(), &[OutputFormat::Usdc]);
        fs::create_dir(folder.path().join("out")).expect("made");
        let of = |stem: &str, number: i64| UsdStageSequence {
            name: format!("{stem}.{{}}"),
            frames: vec![UsdStageFrame::new(&outputs, &format!("{stem}.{number}"), Some(number))],
        };
        let sequences = [of("dam", 1), of("a\u{1}b", 1), of("late", 1 << 60), of("torn", 1)];
        let playable = sequences.each_ref().map(|sequence| sequence.frames[0].is_playable());
        assert_eq!(playable, [true, false, false, true]);
        for name in ["a\u{1}b.1.usdc", "late.1152921504606846976.usdc"] {
            mesh(&folder.path().join("out").join(name), 1);
        }
        fs::write(folder.path().join("out/torn.1.usdc"), "torn").expect("written");
        let report = write_stage(&outputs, &sequences).expect("no error").expect("files");
        assert_eq!((report.frame_count, report.missing.len(), report.left_out.len()), (0, 1, 3));
        assert!(!folder.path().join("shot.usda").exists());
        mesh(&folder.path().join("out/dam.1.usdc"), 1);
        let report = write_stage(&outputs, &sequences).expect("written").expect("frames");
        assert_eq!((report.frame_count, report.mesh_count, report.missing.len()), (1, 1, 0));
        let [control, number, torn] = &report.left_out[..] else { panic!("{:?}", report.left_out) };
        assert!(control.contains("a\u{1}b.1.usdc is left out"), "{control}");
        assert!(number.contains("frame numbers in USD are at most 9007199254740992"), "{number}");
        assert!(torn.contains("torn.1.usdc: "), "{torn}");
        let text = fs::read_to_string(folder.path().join("shot.usda")).expect("written");
        assert!(text.contains("[@./out/dam.1.usdc@]") && !text.contains("torn"), "{text}");
    }

    #[test]
    fn sequence_keeps_its_prim_while_others_have_no_files() {
        let folder = tempfile::tempdir().expect("a folder");
        let outputs = outputs(folder.path(), &[OutputFormat::Usdc]);
        fs::create_dir(folder.path().join("out")).expect("made");
        let of = |name: &str, number: i64| UsdStageSequence {
            name: name.to_owned(),
            frames: vec![UsdStageFrame::new(
                &outputs,
                &name.replace("{}", &number.to_string()),
                Some(number),
            )],
        };
        let sequences = [of("dam_{}_a", 1), of("dam_{}_b", 1)];
        let prims = || {
            let written = write_stage(&outputs, &sequences).expect("written").expect("frames");
            let text = fs::read_to_string(folder.path().join("shot.usda")).expect("written");
            let prims = ["dam", "dam_2"].map(|name| text.contains(&format!("    def Xform \"{name}\" (")));
            (written.missing, prims)
        };
        mesh(&folder.path().join("out/dam_1_b.usdc"), 1);
        assert_eq!(prims(), (vec!["dam_1_a.usdc".to_owned()], [false, true]));
        assert_eq!(stage_frame_count(&folder.path().join("shot.usda")), Ok(Some(1)));
        mesh(&folder.path().join("out/dam_1_a.usdc"), 1);
        assert_eq!(prims(), (vec![], [true, true]));
        assert_eq!(stage_frame_count(&folder.path().join("shot.usda")), Ok(Some(2)));
        assert!(stage_frame_count(&folder.path().join("out/dam_1_a.usdc")).is_err());
    }

    #[test]
    fn stage_that_is_up_to_date_is_not_written_again_and_another_file_never() {
        let folder = tempfile::tempdir().expect("a folder");
        let outputs = outputs(folder.path(), &[OutputFormat::Usda]);
        let (path, frames) = (folder.path().join("shot.usda"), sequence(&outputs, &[1, 2]));
        fs::create_dir(folder.path().join("out")).expect("made");
        mesh(&folder.path().join("out/dam.1.usda"), 1);
        write_stage(&outputs, &frames).expect("written");
        let modified = || path.metadata().and_then(|metadata| metadata.modified()).expect("there");
        let before = modified();
        write_stage(&outputs, &frames).expect("up to date");
        assert_eq!(modified(), before);
        let stage = fs::read_to_string(&path).expect("there");
        // OpenUSD drops comments when it saves a layer.
        let saved = stage.lines().filter(|line| !line.starts_with("# end")).collect::<Vec<_>>().join("\n");
        for (foreign, why) in [
            ("", "exists, and is not a stage of meniscus"),
            ("#usda 1.0\n(\n)\n", "exists, and is not a stage of meniscus"),
            ("text", "exists, and is not a stage of meniscus"),
            (&saved, "was changed by another program"),
        ] {
            fs::write(&path, foreign).expect("written");
            let error = write_stage(&outputs, &frames).expect_err("not a stage").to_string();
            assert!(error.contains(&format!("shot.usda: {why}")), "{error}");
            assert_eq!(fs::read_to_string(&path).expect("there"), foreign);
        }
        let stage = UsdStageOptions { path: folder.path().join("out/dam.1.usda"), fps: 24.0 };
        let error = write_stage(&OutputOptions { stage: Some(stage), ..outputs }, &frames);
        assert!(error.expect_err("a frame").to_string().contains("would replace one of its frames"));
    }
}
