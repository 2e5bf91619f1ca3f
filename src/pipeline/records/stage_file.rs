//! Writes a stage that plays the files of the frames that exist so far.
//!
//! ```text
//!   out/dam.0012.usdc  out/dam.0013.usdc  ..  ◀── shot.usda ──▶  out/dam.0012.vdb  ..
//! ```
//!
//! A stage depends only on the names of the frames and on which of their files exist: outputs appear
//! complete, by rename. So every process that knows the frames writes the same stage at any time: `convert`
//! and the daemon while frames arrive, and each shard of a farm. Shards need no order: each looks for files
//! again after it has written the stage, so the last one to write it has seen the files of all.

use std::cmp::Reverse;
use std::collections::{HashMap, HashSet};
use std::fs;
use std::io::{self, Cursor, Read, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use meniscus_formats::usda::{ClipFile, StageClips, UsdStage, stage_text};
use meniscus_formats::{is_complete, read_provenance, vdb};

use super::provenance::{GENERATOR_AND_VERSION, HEAD_BYTES};
use super::sequence_file::{SequenceError, increasing};
use crate::pipeline::files::atomic_write::write_atomically;
use crate::pipeline::files::open::open_regular;
use crate::pipeline::target::outputs::{OutputFormat, OutputOptions, StageOptions, output_path};

/// The frames of a sequence in a stage, whether their files exist or not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StageSequence {
    /// Its name, such as `dam.{}.bgeo`.
    pub name: String,
    /// Its frames, in their order.
    pub frames: Vec<StageFrame>,
}

/// The files of a frame that a stage plays.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StageFrame {
    /// The frame's number, if it has one.
    pub number: Option<u64>,
    /// The path of its mesh in USD, if it is among the outputs.
    pub mesh: Option<PathBuf>,
    /// The path of its level set in OpenVDB, if it is among the outputs.
    pub volume: Option<PathBuf>,
}

impl StageFrame {
    /// The frame whose outputs have this stem.
    pub fn new(outputs: &OutputOptions, stem: &str, number: Option<u64>) -> StageFrame {
        let path = |format| output_path(&outputs.folder, stem, format);
        let has_volume = outputs.formats.contains(&OutputFormat::Vdb);
        StageFrame {
            number,
            mesh: outputs.stage_mesh_format().map(path),
            volume: has_volume.then(|| path(OutputFormat::Vdb)),
        }
    }
}

/// What a stage plays.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StageReport {
    /// The number of meshes.
    pub mesh_count: usize,
    /// The number of level sets.
    pub volume_count: usize,
    /// The number of frames that have no file yet.
    pub missing_count: usize,
}

/// Writes the stage of the [options](OutputOptions::stage) atomically, unless the file is up to date. Returns
/// `None`, and writes nothing, if no frame has a file, or if there is no stage in the options.
///
/// # Errors
/// When the file exists and is not a stage of this program, a name is not Unicode, or the system reports an
/// error.
pub fn write_stage(
    outputs: &OutputOptions,
    sequences: &[StageSequence],
) -> Result<Option<StageReport>, SequenceError> {
    let Some(StageOptions { path, fps }) = &outputs.stage else { return Ok(None) };
    let (path, fps) = (path.as_path(), *fps);
    let fail = |what: String| SequenceError { path: path.to_owned(), what };
    // Another shard may write at the same time: the file is compared again after it was written.
    for _ in 0..ROUNDS_MAX {
        let Some((stage, report)) = stage_of(outputs, (path, fps), sequences).map_err(fail)? else {
            return Ok(None);
        };
        let text = stage_text(&stage, &provenance(report)).map_err(|error| fail(error.to_string()))?;
        if known_text(path).map_err(fail)?.as_deref() == Some(text.as_bytes()) {
            return Ok(Some(report));
        }
        write_atomically(path, |out| Ok(out.write_all(text.as_bytes())?))
            .map_err(|error| fail(error.to_string()))?;
    }
    Ok(stage_of(outputs, (path, fps), sequences).map_err(fail)?.map(|(_, report)| report))
}

/// How many times to write the stage. If files still change then, the next frame updates it.
const ROUNDS_MAX: usize = 8;

/// The earliest time for the next update of stages, after they were written from `start` until now: a second
/// later, and so late that frames wait for stages for at most a twentieth of the time.
pub fn next_stage_update(start: Instant) -> Instant {
    Instant::now() + Duration::from_secs(1).max(20 * start.elapsed())
}

/// The name in provenance whose value is the number of frames of a stage.
const STAGE_FRAMES: &str = "stage_frames";

fn provenance(report: StageReport) -> Vec<(String, String)> {
    let pair = |name: &str, value: String| (name.to_owned(), value);
    let frame_count = report.mesh_count.max(report.volume_count);
    vec![pair("generator", GENERATOR_AND_VERSION.to_owned()), pair(STAGE_FRAMES, frame_count.to_string())]
}

/// The bytes of an existing stage; `None` if there is no file. Refuses a file that is not a stage of this
/// program, because it may be a user's shot. Also refuses a stage that another program has changed: when such
/// a program saves the stage, it drops the comment at the end.
fn known_text(path: &Path) -> Result<Option<Vec<u8>>, String> {
    let refused = || "exists, and is not a stage of meniscus: choose another name".to_owned();
    let mut file = match open_regular(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file.map_err(|error| error.to_string())?,
    };
    let mut text = Vec::new();
    Read::by_ref(&mut file).take(HEAD_BYTES).read_to_end(&mut text).map_err(|error| error.to_string())?;
    let recorded = read_provenance(OutputFormat::Usda, &*text).map_err(|_| refused())?;
    if !recorded.iter().any(|(name, _)| name == STAGE_FRAMES) {
        return Err(refused());
    }
    file.read_to_end(&mut text).map_err(|error| error.to_string())?;
    if !is_complete(OutputFormat::Usda, &mut Cursor::new(&text)).map_err(|error| error.to_string())? {
        return Err("was changed by another program: choose another name".to_owned());
    }
    Ok(Some(text))
}

/// The stage of the files that exist; `None` without any.
fn stage_of(
    outputs: &OutputOptions,
    (path, fps): (&Path, f64),
    sequences: &[StageSequence],
) -> Result<Option<(UsdStage, StageReport)>, String> {
    let mut assets = AssetPaths::new(path)?;
    let (mut found, mut report) = (Vec::new(), StageReport::default());
    // Two inputs may have the same outputs, for example a file and its compressed copy: a stage lists these
    // outputs once.
    let mut listed = HashSet::new();
    for StageSequence { name, frames } in sequences {
        let frames: Vec<&StageFrame> =
            frames.iter().filter(|frame| listed.insert((&frame.mesh, &frame.volume))).collect();
        let numbers: Vec<Option<u64>> = frames.iter().map(|frame| frame.number).collect();
        let codes = increasing(&numbers);
        let meshes =
            ExistingFiles::of(frames.iter().map(|frame| frame.mesh.as_deref()), &codes, &mut assets)?;
        let volumes =
            ExistingFiles::of(frames.iter().map(|frame| frame.volume.as_deref()), &codes, &mut assets)?;
        report.mesh_count += meshes.clips.len();
        report.volume_count += volumes.clips.len();
        report.missing_count += frames.len() - meshes.clips.len().max(volumes.clips.len());
        if !meshes.clips.is_empty() || !volumes.clips.is_empty() {
            let largest = volumes.largest.and_then(|(_, path)| open_regular(path).ok());
            found.push(StageClips {
                name: prim_name(name).to_owned(),
                declared_by: meshes.largest.map_or(0, |(index, _)| index),
                meshes: meshes.clips,
                volumes: volumes.clips,
                has_velocity: largest.is_some_and(|mut file| vdb::has_velocity(&mut file).unwrap_or(false)),
            });
        }
    }
    let OutputOptions { up, meters_per_unit, .. } = *outputs;
    let stage = UsdStage { up, meters_per_unit, fps, sequences: found };
    Ok((!stage.sequences.is_empty()).then_some((stage, report)))
}

/// Files of frames that exist.
struct ExistingFiles<'a> {
    clips: Vec<ClipFile>,
    /// The index and path of the largest file, which declares the attributes, because the file of an empty
    /// frame may lack some.
    largest: Option<(usize, &'a Path)>,
}

impl<'a> ExistingFiles<'a> {
    fn of(
        paths: impl Iterator<Item = Option<&'a Path>>,
        codes: &[u64],
        assets: &mut AssetPaths,
    ) -> Result<ExistingFiles<'a>, String> {
        let (mut clips, mut sizes) = (Vec::new(), Vec::new());
        for (path, &code) in paths.zip(codes) {
            let Some(path) = path else { continue };
            let Some(size) = path.metadata().ok().filter(fs::Metadata::is_file).map(|file| file.len()) else {
                continue;
            };
            sizes.push((size, path));
            clips.push(ClipFile { code, path: assets.of(path)? });
        }
        let largest = (0..sizes.len()).max_by_key(|&index| (sizes[index].0, Reverse(index)));
        Ok(ExistingFiles { clips, largest: largest.map(|index| (index, sizes[index].1)) })
    }
}

/// Makes paths relative to the folder of a stage.
struct AssetPaths {
    stage: PathBuf,
    /// The folder of the stage, without links.
    folder: PathBuf,
    /// The relative path of each folder.
    relative: HashMap<PathBuf, String>,
}

impl AssetPaths {
    fn new(stage: &Path) -> Result<AssetPaths, String> {
        let folder = real_folder(stage)?;
        Ok(AssetPaths { stage: stage.to_owned(), folder, relative: HashMap::new() })
    }

    /// The path of a file, for the stage.
    fn of(&mut self, file: &Path) -> Result<String, String> {
        let parent = file.parent().unwrap_or(Path::new(""));
        if !self.relative.contains_key(parent) {
            let folder = relative_folder(&self.folder, &real_folder(file)?)?;
            self.relative.insert(parent.to_owned(), folder);
        }
        let name = file.file_name().unwrap_or_default().to_str().ok_or_else(|| not_unicode(file))?;
        let folder = &self.relative[parent];
        if folder == "./" && self.stage.file_name().is_some_and(|stage| stage == name) {
            return Err("the stage would replace one of its frames: choose another name".to_owned());
        }
        Ok(format!("{folder}{name}"))
    }
}

/// The folder of a file, without links.
fn real_folder(file: &Path) -> Result<PathBuf, String> {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    folder.canonicalize().map_err(|error| format!("{}: {error}", folder.display()))
}

fn not_unicode(path: &Path) -> String {
    format!("{} is not Unicode, so a stage cannot name it", path.display())
}

/// The path from one folder to another, with `/` after each name; absolute if the folders have only the root
/// in common. A relative path starts with a dot: otherwise programs would also search for it in other
/// folders.
fn relative_folder(from: &Path, to: &Path) -> Result<String, String> {
    let common = from.components().zip(to.components()).take_while(|(from, to)| from == to).count();
    let mut relative = match from.components().count() - common {
        _ if common < 2 => String::new(),
        0 => "./".to_owned(),
        up_count => "../".repeat(up_count),
    };
    let rest: PathBuf = to.components().skip(if relative.is_empty() { 0 } else { common }).collect();
    relative += &rest.to_str().ok_or_else(|| not_unicode(to))?.replace(std::path::MAIN_SEPARATOR, "/");
    if !relative.ends_with('/') {
        relative.push('/');
    }
    Ok(relative)
}

/// The part of a sequence's name before the number: `dam` of `dam.{}.bgeo`, `dump.lammpstrj` of its steps.
fn prim_name(sequence: &str) -> &str {
    let file = sequence.split('/').next().unwrap_or_default();
    let stem = match file.split_once("{}") {
        Some((before, _)) => before,
        None if sequence.len() > file.len() => file,
        None => file.split_once('.').map_or(file, |(stem, _)| stem),
    };
    let plain = stem.trim_end_matches(|c: char| !c.is_alphanumeric());
    if plain.is_empty() { "frames" } else { plain }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prims_are_named_after_sequences() {
        for (name, prim) in [
            ("dam.{}.bgeo", "dam"),
            ("my sim_v2.{}.ply", "my sim_v2"),
            ("dump.lammpstrj/step={}", "dump.lammpstrj"),
            ("water.bgeo.sc", "water"),
            ("{}.ply", "frames"),
            ("dam_{}_b7.ply", "dam"),
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
                Ok(relative),
                "{from} {to}"
            );
        }
    }

    fn outputs(folder: &Path, formats: &[OutputFormat]) -> OutputOptions {
        let stage = StageOptions { path: folder.join("shot.usda"), fps: 24.0 };
        OutputOptions { stage: Some(stage), ..OutputOptions::new(folder.join("out"), formats) }
    }

    fn sequence(outputs: &OutputOptions, numbers: &[u64]) -> Vec<StageSequence> {
        let frame = |number: &u64| StageFrame::new(outputs, &format!("dam.{number}"), Some(*number));
        vec![StageSequence { name: "dam.{}.ply".to_owned(), frames: numbers.iter().map(frame).collect() }]
    }

    #[test]
    fn stage_lists_the_files_that_exist_and_takes_attributes_from_the_largest() {
        let folder = tempfile::tempdir().expect("a folder");
        let outputs = outputs(folder.path(), &[OutputFormat::Glb, OutputFormat::Usdc, OutputFormat::Vdb]);
        let frames = sequence(&outputs, &[1, 2, 3, 4]);
        assert_eq!(write_stage(&outputs, &frames).expect("no error"), None);
        assert!(!folder.path().join("shot.usda").exists());
        fs::create_dir(folder.path().join("out")).expect("made");
        for (name, size) in [("dam.1.usdc", 1), ("dam.2.usdc", 9), ("dam.4.usdc", 9), ("dam.4.vdb", 1)] {
            fs::write(folder.path().join("out").join(name), vec![0; size]).expect("written");
        }
        let report = StageReport { mesh_count: 3, volume_count: 1, missing_count: 1 };
        assert_eq!(write_stage(&outputs, &frames).expect("written"), Some(report));
        let text = fs::read_to_string(folder.path().join("shot.usda")).expect("written");
        for part in [
            "[@./out/dam.1.usdc@, @./out/dam.2.usdc@, @./out/dam.4.usdc@]",
            "references = @./out/dam.2.usdc@",
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
        for number in 1..=3 {
            fs::write(folder.path().join(format!("out/dam.{number}.usdc")), "mesh").expect("written");
        }
        let mut frames = sequence(&outputs, &[1, 1, 2, 2]);
        frames.extend(sequence(&outputs, &[1, 2, 3]));
        let report = write_stage(&outputs, &frames).expect("written").expect("frames");
        assert_eq!((report.mesh_count, report.missing_count), (3, 0));
        let text = fs::read_to_string(folder.path().join("shot.usda")).expect("written");
        for part in
            ["[@./out/dam.1.usdc@, @./out/dam.2.usdc@]", "active = [(1, 0), (2, 1)]", "[@./out/dam.3.usdc@]"]
        {
            assert!(text.contains(part), "{part}: {text}");
        }
    }

    #[test]
    fn stage_that_is_up_to_date_is_not_written_again_and_another_file_never() {
        let folder = tempfile::tempdir().expect("a folder");
        let outputs = outputs(folder.path(), &[OutputFormat::Usda]);
        let (path, frames) = (folder.path().join("shot.usda"), sequence(&outputs, &[1, 2]));
        fs::create_dir(folder.path().join("out")).expect("made");
        fs::write(folder.path().join("out/dam.1.usda"), "1").expect("written");
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
        let stage = StageOptions { path: folder.path().join("out/dam.1.usda"), fps: 24.0 };
        let error = write_stage(&OutputOptions { stage: Some(stage), ..outputs }, &frames);
        assert!(error.expect_err("a frame").to_string().contains("would replace one of its frames"));
    }
}
