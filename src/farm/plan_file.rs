//! Reads and writes plans as JSON; `docs/farm.md` describes the format.
//!
//! The structs here mirror the file. Numbers that affect results are text, in the shortest form that reads
//! back as the same number, because many programs that rewrite JSON change the last digits of numbers.
//!
//! A plan is not trusted. An unknown key or an invalid value is an error, which gives its line or a JSON
//! pointer to it. Missing settings have no defaults. Every output has a plain file name in one folder, so a
//! plan cannot write a file elsewhere.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fmt;
use std::io::{self, Read};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use meniscus_formats::UpAxis;
use meniscus_formats::vdb::Compression;
use serde::{Deserialize, Serialize};

use crate::pipeline::files::json::write_json;
use crate::pipeline::{
    CameraChoice, FRAME_RATES, GENERATOR_AND_VERSION, Job, METERS_PER_UNIT, MeasuredSpacing, OutputFormat,
    OutputOptions, PictureOptions, StageOptions, file_of, open_regular, write_atomically,
};
use crate::surface::options::{MethodOptions, Settings};
use crate::surface::reconstruction::DEVIATION_MAX_VOXELS;

use super::partition::SHARDS_MAX;
use super::plan::{PlannedFrame, PlannedSequence, ShardPlan};

/// The version of the file format. Increase it when the format changes.
const VERSION: u64 = 1;

/// Maximum size of a plan; a plan of a million frames takes a third of it.
const SIZE_MAX_BYTES: u64 = 1 << 30;

/// The allowed width and height of pictures, in pixels.
const PICTURE_EDGES: std::ops::RangeInclusive<usize> = 16..=8192;

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PlanFile {
    meniscus_plan: u64,
    generator: String,
    out: String,
    outputs: Outputs,
    obstacles: Vec<String>,
    sequences: Vec<SequenceEntry>,
    shards: Vec<ShardEntry>,
    frames: Vec<PlannedFrame>,
}

/// The fields that identify a plan and its version.
#[derive(Deserialize)]
struct Head {
    meniscus_plan: Option<u64>,
    generator: Option<String>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Outputs {
    formats: Vec<OutputFormat>,
    up: UpAxis,
    #[serde(default = "one", skip_serializing_if = "is_one")]
    meters_per_unit: f64,
    vdb_half: bool,
    vdb_compression: Compression,
    picture_size: [usize; 2],
    #[serde(default, skip_serializing_if = "Option::is_none")]
    stage: Option<StageEntry>,
}

/// A stage, which is in the folder of the results.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct StageEntry {
    name: String,
    fps: f64,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SequenceEntry {
    name: String,
    /// As text, by name: see [`MethodOptions::to_pairs`].
    settings: BTreeMap<String, String>,
    /// For level sets: by how many voxels smoothing may move their surfaces.
    #[serde(alias = "band_slack", default, skip_serializing_if = "Option::is_none")]
    max_deviation: Option<String>,
    /// The camera, if there are pictures.
    camera: Option<String>,
    /// The source of the measured particle spacing.
    measured: Option<PlannedSpacing>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PlannedSpacing {
    on: String,
    spacing: String,
    confidence: f64,
    radius_median: Option<String>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ShardEntry {
    first: usize,
    count: usize,
}

/// An error in a plan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlanError {
    /// A JSON pointer to the invalid value; empty for the whole file. The message of a syntax error contains
    /// its line.
    pub pointer: String,
    /// The message.
    pub message: String,
}

impl PlanError {
    fn at(pointer: impl Into<String>, what: impl Into<String>) -> PlanError {
        PlanError { pointer: pointer.into(), message: what.into() }
    }
}

impl fmt::Display for PlanError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.pointer.as_str() {
            "" => f.write_str(&self.message),
            pointer => write!(f, "{pointer}: {}", self.message),
        }
    }
}

impl std::error::Error for PlanError {}

impl ShardPlan {
    /// Reads a plan from a file.
    ///
    /// # Errors
    /// When the file cannot be read, or is not a plan of this version of the program.
    pub fn read(path: &Path) -> Result<ShardPlan, PlanError> {
        let cannot = |error: io::Error| PlanError::at("", format!("cannot be read: {error}"));
        let mut bytes = Vec::new();
        open_regular(path)
            .and_then(|file| file.take(SIZE_MAX_BYTES + 1).read_to_end(&mut bytes))
            .map_err(cannot)?;
        if bytes.len() as u64 > SIZE_MAX_BYTES {
            return Err(PlanError::at("", "more than 1 GiB: this is not a plan"));
        }
        parse(&bytes)
    }

    /// Writes the plan atomically.
    ///
    /// # Errors
    /// When a path is not Unicode, or the system reports an error.
    pub fn write(&self, path: &Path) -> Result<(), PlanError> {
        let file = PlanFile::of(self)?;
        let written = write_atomically(path, |out| Ok(write_json(out, &file)?));
        written.map_err(|error| PlanError::at("", format!("cannot be written: {error}")))
    }
}

/// Parses the bytes of a plan file.
///
/// # Errors
/// The first error, and its place.
pub fn parse(bytes: &[u8]) -> Result<ShardPlan, PlanError> {
    if !bytes.trim_ascii_start().starts_with(b"{") {
        return Err(PlanError::at("", "this is not a meniscus plan: expected a JSON object"));
    }
    let head: Head = serde_json::from_slice(bytes).map_err(|error| in_words(&error))?;
    match head.meniscus_plan {
        None => return Err(PlanError::at("/meniscus_plan", "missing: this is not a meniscus plan")),
        Some(VERSION) => {}
        Some(other) => {
            return Err(PlanError::at(
                "/meniscus_plan",
                format!(
                    "plan version {other} is not supported (expected {VERSION}): run `meniscus plan` again, or use the version that wrote it"
                ),
            ));
        }
    }
    // Another version of the program may write other bytes for the same frame, but all shards of a plan must
    // write the same ones.
    let generator = head.generator.unwrap_or_default();
    if generator != GENERATOR_AND_VERSION {
        return Err(PlanError::at(
            "/generator",
            format!(
                "the plan was made by `{generator}`, but this program is {GENERATOR_AND_VERSION}: install the same version, or run `meniscus plan` again"
            ),
        ));
    }
    serde_json::from_slice::<PlanFile>(bytes).map_err(|error| in_words(&error))?.into_plan()
}

/// An error of the parser, with its place first, in words that do not depend on the parser.
fn in_words(error: &serde_json::Error) -> PlanError {
    let line = error.line();
    if error.is_eof() {
        let what = "the file ends before the plan does: copy it again, or run `meniscus plan` again";
        return PlanError::at("", format!("line {line}: {what}"));
    }
    let text = error.to_string();
    let what = text.rsplit_once(" at line ").map_or(&*text, |(what, _)| what);
    let found_and_expected = ["invalid type: ", "invalid value: ", "invalid length "]
        .iter()
        .find_map(|start| what.strip_prefix(start)?.rsplit_once(", expected "));
    let what = match found_and_expected {
        Some((found, "u64" | "usize")) => format!("expected a whole number from 0, but found {found}"),
        Some((found, "i64")) => format!("expected a whole number, but found {found}"),
        Some((found, expected)) => format!("expected {expected}, but found {found}"),
        None => what.replacen(" field `", " key `", 1).replacen("unknown variant `", "unknown value `", 1),
    };
    PlanError::at("", format!("line {line}, column {}: {what}", error.column()))
}

impl PlanFile {
    fn of(plan: &ShardPlan) -> Result<PlanFile, PlanError> {
        let first = plan.sequences.first().ok_or_else(|| PlanError::at("/sequences", "must not be empty"))?;
        plan.frames.iter().try_for_each(|frame| text(&frame.input).map(drop))?;
        Ok(PlanFile {
            meniscus_plan: VERSION,
            generator: GENERATOR_AND_VERSION.to_owned(),
            out: text(&first.outputs.folder)?,
            outputs: Outputs::of(&first.outputs)?,
            obstacles: plan.obstacles.iter().map(|path| text(path)).collect::<Result<_, _>>()?,
            sequences: plan.sequences.iter().map(SequenceEntry::of).collect::<Result<_, _>>()?,
            shards: plan.shards.iter().map(|s| ShardEntry { first: s.start, count: s.len() }).collect(),
            frames: plan.frames.clone(),
        })
    }

    fn into_plan(self) -> Result<ShardPlan, PlanError> {
        let folder = absolute("/out", &self.out)?;
        let obstacles = self.obstacles.iter().enumerate();
        let obstacles = obstacles.map(|(index, path)| absolute(&format!("/obstacles/{index}"), path));
        let outputs = self.outputs.into_options(folder)?;
        let sequences = self.sequences.into_iter().enumerate();
        let sequences = sequences
            .map(|(index, entry)| entry.into_sequence(&format!("/sequences/{index}"), &outputs))
            .collect::<Result<Vec<_>, _>>()?;
        if sequences.is_empty() {
            return Err(PlanError::at("/sequences", "must not be empty"));
        }
        let shards = shards(&self.shards, self.frames.len())?;
        check_frames(&self.frames, sequences.len())?;
        let plan = ShardPlan {
            shards,
            frames: self.frames,
            sequences,
            obstacles: obstacles.collect::<Result<_, _>>()?,
        };
        match replaced_input(&plan) {
            Some(index) => Err(PlanError::at(
                format!("/frames/{index}/input"),
                "an output of the plan would overwrite this input",
            )),
            None => Ok(plan),
        }
    }
}

/// The index of a frame whose input would be overwritten by an output of the plan.
fn replaced_input(plan: &ShardPlan) -> Option<usize> {
    let stage = plan.sequences.first().and_then(|sequence| sequence.outputs.stage.as_ref());
    let stage = stage.map(|stage| stage.path.clone());
    let outputs = plan.frames.iter().flat_map(|planned| plan.outputs(planned));
    let outputs: HashSet<PathBuf> = outputs.chain(stage).collect();
    plan.frames.iter().position(|planned| outputs.contains(file_of(&planned.input)))
}

fn one() -> f64 {
    1.0
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde asks so")]
fn is_one(number: &f64) -> bool {
    *number == 1.0
}

impl Outputs {
    fn of(options: &OutputOptions) -> Result<Outputs, PlanError> {
        let OutputOptions { up, meters_per_unit, vdb_half, vdb_compression, .. } = *options;
        let (formats, picture_size) = (options.formats.clone(), options.picture.size);
        let stage = options.stage.as_ref().map(StageEntry::of).transpose()?;
        Ok(Outputs { formats, up, meters_per_unit, vdb_half, vdb_compression, picture_size, stage })
    }

    fn into_options(self, folder: PathBuf) -> Result<OutputOptions, PlanError> {
        let Outputs { formats, up, meters_per_unit, vdb_half, vdb_compression, picture_size, stage } = self;
        let stage = stage.map(|stage| stage.into_options(&folder)).transpose()?;
        if formats.is_empty() {
            return Err(PlanError::at("/outputs/formats", "must not be empty"));
        }
        if let Some(index) = (1..formats.len()).find(|&index| formats[..index].contains(&formats[index])) {
            let what = format!("`{}` is listed twice", formats[index]);
            return Err(PlanError::at(format!("/outputs/formats/{index}"), what));
        }
        if !picture_size.iter().all(|edge| PICTURE_EDGES.contains(edge)) {
            return Err(PlanError::at("/outputs/picture_size", "each must be 16 to 8192"));
        }
        if !METERS_PER_UNIT.contains(&meters_per_unit) {
            return Err(PlanError::at("/outputs/meters_per_unit", "it must be from 1e-9 to 1e9"));
        }
        let picture = PictureOptions { size: picture_size, camera: CameraChoice::default() };
        Ok(OutputOptions { folder, formats, up, meters_per_unit, vdb_half, vdb_compression, picture, stage })
    }
}

impl StageEntry {
    fn of(stage: &StageOptions) -> Result<StageEntry, PlanError> {
        Ok(StageEntry { name: text(Path::new(stage.path.file_name().unwrap_or_default()))?, fps: stage.fps })
    }

    fn into_options(self, folder: &Path) -> Result<StageOptions, PlanError> {
        let StageEntry { name, fps } = self;
        let extension = Path::new(&name).extension();
        if !is_plain_name(&name) || extension.is_none_or(|extension| !extension.eq_ignore_ascii_case("usda"))
        {
            let what = format!("`{name}` is not a plain file name that ends in .usda");
            return Err(PlanError::at("/outputs/stage/name", what));
        }
        if !FRAME_RATES.contains(&fps) {
            return Err(PlanError::at("/outputs/stage/fps", "it must be more than 0 and at most 1000"));
        }
        Ok(StageOptions { path: folder.join(name), fps })
    }
}

impl SequenceEntry {
    fn of(sequence: &PlannedSequence) -> Result<SequenceEntry, PlanError> {
        let PlannedSequence { name, job, settings, measured, outputs } = sequence;
        let measured = measured.as_ref().map(|measured| {
            Ok(PlannedSpacing {
                on: text(&measured.measured_on)?,
                spacing: measured.spacing.to_string(),
                confidence: measured.confidence,
                radius_median: measured.radius_median.map(|radius| radius.to_string()),
            })
        });
        let has_pictures = outputs.has_pictures();
        let pairs = settings.to_options().to_pairs();
        Ok(SequenceEntry {
            name: name.clone(),
            settings: pairs.into_iter().map(|(name, value)| (name.to_owned(), value)).collect(),
            max_deviation: match job {
                Job::LevelSet { max_deviation_voxels, .. } => Some(max_deviation_voxels.to_string()),
                Job::Surface | Job::Particles => None,
            },
            camera: has_pictures.then(|| outputs.picture.camera.to_string()),
            measured: measured.transpose()?,
        })
    }

    fn into_sequence(self, pointer: &str, outputs: &OutputOptions) -> Result<PlannedSequence, PlanError> {
        let settings = self.settings(pointer)?;
        let measured = self.measured.map(|measured| measured.into_measured(pointer));
        let outputs = with_camera(outputs, self.camera.as_deref(), pointer)?;
        let job = match &self.max_deviation {
            None => Job::Surface,
            Some(voxels) => level_set_job(&format!("{pointer}/max_deviation"), voxels)?,
        };
        Ok(PlannedSequence {
            name: self.name,
            job,
            settings: Arc::new(settings),
            measured: measured.transpose()?,
            outputs: Arc::new(outputs),
        })
    }

    fn settings(&self, pointer: &str) -> Result<Settings, PlanError> {
        let mut options = MethodOptions::default();
        for (name, value) in &self.settings {
            options.set(name, value).map_err(|_| {
                let pointer = format!("{pointer}/settings/{}", escaped(name));
                let message = match (MethodOptions::info(name), MethodOptions::range(name)) {
                    (None, _) => "unknown setting".to_owned(),
                    (_, Some(range)) => format!("invalid value `{value}`: expected {range}"),
                    (_, None) => format!("invalid value `{value}`: run `meniscus plan` again"),
                };
                PlanError::at(pointer, message)
            })?;
        }
        let settings = Settings::resolve(&options, None)
            .map_err(|error| PlanError::at(format!("{pointer}/settings"), error.to_string()))?;
        // A missing setting is not replaced by its default, which may differ from the value that was planned.
        let needed = settings.to_options().to_pairs();
        let pointer = |name: &str| format!("{pointer}/settings/{}", escaped(name));
        if let Some((name, _)) = needed.iter().find(|(name, _)| !self.settings.contains_key(*name)) {
            return Err(PlanError::at(pointer(name), "missing: a plan has every setting"));
        }
        match self.settings.keys().find(|key| needed.iter().all(|(name, _)| name != key)) {
            Some(name) => Err(PlanError::at(
                pointer(name),
                "not allowed, because it has no effect with the other settings of the sequence: remove it",
            )),
            None => Ok(settings),
        }
    }
}

impl PlannedSpacing {
    fn into_measured(self, pointer: &str) -> Result<MeasuredSpacing, PlanError> {
        let median = self.radius_median.as_deref();
        let median = median.map(|text| number(&format!("{pointer}/measured/radius_median"), text));
        Ok(MeasuredSpacing {
            spacing: number(&format!("{pointer}/measured/spacing"), &self.spacing)?,
            confidence: self.confidence,
            radius_median: median.transpose()?,
            measured_on: absolute(&format!("{pointer}/measured/on"), &self.on)?,
            measured_count: 0,
            warnings: Vec::new(),
        })
    }
}

/// The job for level sets whose surfaces smoothing may move by this many voxels.
fn level_set_job(pointer: &str, voxels: &str) -> Result<Job, PlanError> {
    let range = 0.0..=f64::from(DEVIATION_MAX_VOXELS);
    let max_deviation_voxels = voxels.parse().ok().filter(|voxels| range.contains(voxels));
    max_deviation_voxels.map(Job::level_set).ok_or_else(|| {
        let what = format!("`{voxels}` is not a number of voxels from 0 to {DEVIATION_MAX_VOXELS}");
        PlanError::at(pointer, what)
    })
}

/// The same outputs with the camera of a sequence.
fn with_camera(
    outputs: &OutputOptions,
    camera: Option<&str>,
    pointer: &str,
) -> Result<OutputOptions, PlanError> {
    let pointer = format!("{pointer}/camera");
    let has_pictures = outputs.has_pictures();
    let camera = match (camera, has_pictures) {
        (None, false) => return Ok(outputs.clone()),
        (None, true) => return Err(PlanError::at(pointer, "missing: the pictures need a camera")),
        (Some(_), false) => {
            return Err(PlanError::at(pointer, "not allowed, because no format is a picture"));
        }
        (Some(camera), true) => camera,
    };
    let camera: CameraChoice = camera.parse().map_err(|why: String| PlanError::at(&*pointer, why))?;
    if camera.needs_bounds() {
        let what = "expected eye, target and ground: without them the camera depends on the frame's bounds";
        return Err(PlanError::at(pointer, what));
    }
    let picture = PictureOptions { camera, ..outputs.picture };
    Ok(OutputOptions { picture, ..outputs.clone() })
}

/// Checks that the shards are contiguous and cover all frames, and returns their ranges.
fn shards(entries: &[ShardEntry], frame_count: usize) -> Result<Vec<Range<usize>>, PlanError> {
    if !(1..=SHARDS_MAX).contains(&entries.len()) {
        return Err(PlanError::at(
            "/shards",
            format!("there are {}, expected 1 to {SHARDS_MAX}", entries.len()),
        ));
    }
    let mut next = 0;
    let mut shards = Vec::with_capacity(entries.len());
    for (index, ShardEntry { first, count }) in entries.iter().enumerate() {
        let end = first.checked_add(*count).filter(|&end| end <= frame_count);
        let end = end.filter(|_| *first == next).ok_or_else(|| {
            PlanError::at(
                format!("/shards/{index}"),
                format!(
                    "`first` is {first} and `count` is {count}: `first` must be {next}, so that no frame is \
                     skipped or repeated, and `first` + `count` at most {frame_count}, the number of frames"
                ),
            )
        })?;
        shards.push(*first..end);
        next = end;
    }
    match next == frame_count {
        true => Ok(shards),
        false => {
            Err(PlanError::at("/shards", format!("the shards cover only {next} of the {frame_count} frames")))
        }
    }
}

/// Checks the frames of a plan.
fn check_frames(frames: &[PlannedFrame], sequence_count: usize) -> Result<(), PlanError> {
    if frames.is_empty() {
        return Err(PlanError::at("/frames", "must not be empty"));
    }
    let mut index_of: HashMap<&str, usize> = HashMap::with_capacity(frames.len());
    for (index, PlannedFrame { input, stem, sequence, .. }) in frames.iter().enumerate() {
        let pointer = |name: &str| format!("/frames/{index}/{name}");
        if *sequence >= sequence_count {
            let what = format!("there is no sequence {sequence}: there are {sequence_count}");
            return Err(PlanError::at(pointer("sequence"), what));
        }
        if !is_plain_name(stem) {
            return Err(PlanError::at(pointer("stem"), format!("`{stem}` is not a plain file name")));
        }
        if let Some(other) = index_of.insert(stem, index) {
            let what = format!("`{stem}` is already the stem of frame {other}");
            return Err(PlanError::at(pointer("stem"), what));
        }
        absolute(&pointer("input"), &text(input)?)?;
    }
    Ok(())
}

/// Whether this is a plain file name on every operating system, so that the file stays in its folder.
fn is_plain_name(stem: &str) -> bool {
    !stem.is_empty() && !stem.contains(['/', '\\', ':', '\0']) && stem != "." && stem != ".."
}

fn absolute(pointer: &str, text: &str) -> Result<PathBuf, PlanError> {
    let path = PathBuf::from(text);
    // A relative path depends on the working directory, which may differ from shard to shard.
    match path.is_absolute() && !text.contains('\0') {
        true => Ok(path),
        false => Err(PlanError::at(pointer, format!("`{text}` is not an absolute path"))),
    }
}

fn number(pointer: &str, text: &str) -> Result<f64, PlanError> {
    let number = text.parse::<f64>().ok().filter(|number| number.is_finite() && *number > 0.0);
    number.ok_or_else(|| PlanError::at(pointer, format!("`{text}` is not a positive number")))
}

fn text(path: &Path) -> Result<String, PlanError> {
    let text = path.to_str().map(str::to_owned);
    text.ok_or_else(|| PlanError::at("", format!("{}: the path is not Unicode", path.display())))
}

/// A key in the form that JSON pointers need.
fn escaped(key: &str) -> String {
    key.replace('~', "~0").replace('/', "~1")
}
