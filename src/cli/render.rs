//! `meniscus render`: pictures of frames.
//!
//! ```text
//!   INPUT ──▶ sequences ──▶ a camera for each ──▶ frame ─┬─ .vdb: read ──────┬─▶ pictures: one, or once around
//!                                                        └─ particles: skin ─┘
//! ```

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail};

use crate::pipeline::{
    self, CameraChoice, FrameFile, LevelSetFile, NOTHING, ObstacleFiles, OutputFormat, OutputOptions,
    PictureFormat, PictureOptions, Scene, Sequence, Still, Viewpoint, automatic_voxel_size, check_outputs,
    encode_picture, files_in, is_level_set, output_path, picture_provenance, read_file, sequence_bounds,
    skin_file, up_of, velocities, write_whole,
};
use crate::preview::{Picture, render_particles, side_by_side};
use crate::settings::{AttributeSelection, Settings};
use crate::space::Lattice;

use super::Verdict;
use super::args::{FormatArgs, PreviewChoice, RenderArgs};
use super::camera_file::camera_of_file;
use super::choices::{choices, ignored, output_options, refuse_stray_rounds};
use super::console::Console;
use super::convert::thread_pool;
use super::inputs::{Found, find_inputs};
use super::interrupt::clean_up_when_interrupted;
use super::out_folder::OutFolder;
use super::quantities::memory_bytes;
use super::wording::counted;

/// Takes the pictures that the arguments ask for.
///
/// # Errors
/// When nothing can be done at all. A frame that fails is told, and counted.
pub(super) fn render(args: &RenderArgs, console: &mut Console) -> Result<Verdict> {
    clean_up_when_interrupted();
    refuse_stray_rounds(&args.method, &args.inputs)?;
    let found = find(&args.inputs)?;
    for warning in &found.warnings {
        console.warn(format_args!("warning: {warning}"));
    }
    let paths: Vec<PathBuf> = found.files.iter().map(|file| file.path.clone()).collect();
    let sequences = pipeline::sequences(found.files);
    let shots = Shots::new(args, &sequences)?;
    for warning in ignored(&args.method, &shots.outputs.formats, &FormatArgs::default()) {
        console.warn(format_args!("warning: {warning}"));
    }
    if let Some(missing) = shots.obstacles.missing() {
        bail!("{}: there is no such obstacle", missing.display());
    }
    let folder = OutFolder::make(&shots.outputs.folder)
        .with_context(|| format!("cannot make the folder {}", shots.outputs.folder.display()))?;
    let planned = sequences.iter().flat_map(|sequence| shots.selected(sequence));
    let planned: Vec<(PathBuf, String)> = planned
        .flat_map(|file| shots.stems(file).into_iter().map(|stem| (file.path.clone(), stem)))
        .collect();
    check_outputs(&planned, &paths, &shots.obstacles, &shots.outputs, None)?;
    folder.keep();
    let pool = thread_pool(args.threads)?;
    let (mut done_count, mut failed_count) = (0, 0);
    for sequence in &sequences {
        let (done, failed) = pool.install(|| shots.take(sequence, console))?;
        done_count += done;
        failed_count += failed;
    }
    Ok(match (failed_count, done_count) {
        (0, _) => Verdict::Done,
        (_, 0) => Verdict::NothingDone,
        _ => Verdict::SomeFailed,
    })
}

/// The files that were meant; of a folder without particles, its level sets.
fn find(inputs: &[PathBuf]) -> Result<Found> {
    let mut all = Found::default();
    for input in inputs {
        let found = find_inputs(std::slice::from_ref(input)).or_else(|error| {
            let files = if input.is_dir() { files_in(input).unwrap_or_default() } else { Vec::new() };
            let files: Vec<FrameFile> =
                files.into_iter().filter(|path| is_level_set(path)).map(FrameFile::new).collect();
            if files.is_empty() { Err(error) } else { Ok(Found { files, ..Found::default() }) }
        })?;
        let is_new = |file: &FrameFile| all.files.iter().all(|known| known.path != file.path);
        let new: Vec<FrameFile> = found.files.into_iter().filter(is_new).collect();
        all.files.extend(new);
        all.warnings.extend(found.warnings);
    }
    Ok(all)
}

/// The pictures that were asked for.
struct Shots<'a> {
    args: &'a RenderArgs,
    outputs: OutputOptions,
    format: PictureFormat,
    /// What the picture of the only frame is called, where it has a name.
    stem: Option<String>,
    obstacles: ObstacleFiles,
    memory_bytes: u64,
}

/// What there is to take pictures of.
enum Subject {
    LevelSet(LevelSetFile, u128),
    Skinned(Box<Still>, Box<Settings>),
}

impl<'a> Shots<'a> {
    fn new(args: &'a RenderArgs, sequences: &[Sequence]) -> Result<Shots<'a>> {
        let (folder, stem, preview) = match (&args.output, &args.out) {
            (Some(file), _) => {
                let (folder, stem, preview) = named_file(file)?;
                (folder, Some(stem), preview)
            }
            (None, Some(folder)) => (folder.clone(), None, args.format.unwrap_or(PreviewChoice::Png)),
            (None, None) => bail!("--output or --out is missing: where the picture goes"),
        };
        let camera = match (&args.camera_from, args.camera) {
            (Some(file), _) => camera_of_file(file, args.up)?,
            (None, camera) => camera.unwrap_or_default(),
        };
        let typed = FormatArgs { up: args.up, preview_size: Some(args.size), ..FormatArgs::default() };
        let mut outputs = output_options(folder, None, &typed);
        outputs.picture.camera = camera;
        let (kind, format) = match preview {
            PreviewChoice::Png => (OutputFormat::Png, PictureFormat::Png),
            PreviewChoice::Exr => (OutputFormat::Exr, PictureFormat::Exr),
        };
        outputs.formats = vec![kind];
        let shots = Shots {
            args,
            outputs,
            format,
            stem,
            obstacles: ObstacleFiles::new(args.method.obstacles.obstacle.clone()),
            memory_bytes: memory_bytes(args.memory)?,
        };
        shots.check(sequences)?;
        Ok(shots)
    }

    fn check(&self, sequences: &[Sequence]) -> Result<()> {
        let count = sequences.iter().flat_map(|sequence| self.selected(sequence)).count();
        if count == 0 {
            bail!("--frames selects none of the frames");
        }
        if count > 1 && self.stem.is_some() {
            bail!("-o names one picture, and there are {count} frames: give --out with a folder");
        }
        let mut files = sequences.iter().flat_map(|sequence| &sequence.frames);
        if self.args.particles
            && let Some(file) = files.find(|file| is_level_set(&file.path))
        {
            bail!("{}: --particles is for files of particles, and this is a level set", file.path.display());
        }
        Ok(())
    }

    fn selected<'s>(&self, sequence: &'s Sequence) -> impl Iterator<Item = &'s FrameFile> {
        let frames = self.args.frames.clone();
        sequence.frames.iter().filter(move |file| {
            let is_in = |number| frames.as_ref().is_none_or(|frames| frames.contains(number));
            frames.is_none() || file.number().is_some_and(is_in)
        })
    }

    /// What the pictures of a frame are called.
    fn stems(&self, file: &FrameFile) -> Vec<String> {
        let stem = file.stem();
        let of_file = if is_level_set(&file.path) { &stem[..stem.len() - ".vdb".len()] } else { &stem };
        let stem = self.stem.as_deref().unwrap_or(of_file);
        match self.args.turntable {
            None => vec![stem.to_owned()],
            Some(count) => (0..count).map(|index| format!("{stem}.{index:03}")).collect(),
        }
    }

    /// Takes the pictures of a sequence. How many frames are done, and how many failed.
    fn take(&self, sequence: &Sequence, console: &mut Console) -> Result<(usize, usize)> {
        let (mut done_count, mut failed_count) = (0, 0);
        let frames: Vec<&FrameFile> = self.selected(sequence).collect();
        if frames.is_empty() {
            return Ok((0, 0));
        }
        let prepared = match self.settings(sequence, console) {
            Ok(settings) => {
                self.viewpoint(sequence, settings.as_ref()).map(|viewpoint| (settings, viewpoint))
            }
            Err(error) => Err(error),
        };
        let (settings, viewpoint) = match prepared {
            Ok(prepared) => prepared,
            Err(error) => {
                console.warn(format_args!("error: {error:#}"));
                return Ok((0, frames.len()));
            }
        };
        for file in frames {
            let start = Instant::now();
            match self.take_frame(file, settings.as_ref(), &viewpoint, console) {
                Ok(names) => {
                    done_count += 1;
                    let seconds = start.elapsed().as_secs_f64();
                    let what = match &names[..] {
                        [name] => name.strip_prefix(".").unwrap_or(name).display().to_string(),
                        names => counted(names.len(), "picture"),
                    };
                    console.say(format_args!("{}: {what}, {seconds:.2} s", file.path.display()));
                }
                Err(error) => {
                    failed_count += 1;
                    console.warn(format_args!("error: {error:#}"));
                }
            }
        }
        Ok((done_count, failed_count))
    }

    /// The settings that the particles of a sequence are skinned with; none for level sets.
    fn settings(&self, sequence: &Sequence, console: &Console) -> Result<Option<Settings>> {
        if sequence.frames.iter().all(|file| is_level_set(&file.path)) {
            return Ok(None);
        }
        let mut choices = choices(&self.args.method);
        if self.format == PictureFormat::Exr && choices.attributes.is_none() {
            choices.attributes = Some(AttributeSelection::Named(vec![VELOCITY.to_owned()]));
        }
        let voxel_size = match self.args.method.first.voxel_size {
            Some(voxel_size) => voxel_size,
            None => {
                let paths = sequence.frames.iter().map(|file| &*file.path);
                automatic_voxel_size(paths, choices.own_radii()?.as_ref())?.voxel_size
            }
        };
        let settings = Settings::resolve(voxel_size, &choices).with_context(|| sequence.name.clone())?;
        for warning in settings.warnings() {
            console.warn(format_args!("warning: {}: {warning}", sequence.name));
        }
        Ok(Some(settings))
    }

    /// Where all pictures of a sequence are taken from.
    fn viewpoint(&self, sequence: &Sequence, settings: Option<&Settings>) -> Result<Viewpoint> {
        let PictureOptions { camera, .. } = self.outputs.picture;
        let bounds = match camera.needs_bounds() {
            true => {
                let paths: Vec<&Path> = sequence.frames.iter().map(|file| &*file.path).collect();
                sequence_bounds(&paths, settings.map_or(0.0, |settings| settings.radius_min))?
            }
            false => None,
        };
        let aspect = self.picture_size()[0] as f64 / self.picture_size()[1] as f64;
        Ok(camera.viewpoint(bounds.unwrap_or(NOTHING), aspect, up_of(self.outputs.up)))
    }

    /// Of two pictures side by side, the right one.
    fn picture_size(&self) -> [usize; 2] {
        let [width, height] = self.outputs.picture.size;
        [if self.args.particles { width - width / 2 } else { width }, height]
    }

    fn take_frame(
        &self,
        file: &FrameFile,
        settings: Option<&Settings>,
        viewpoint: &Viewpoint,
        console: &Console,
    ) -> Result<Vec<PathBuf>> {
        let subject = self.subject(file, settings)?;
        let notes = match &subject {
            Subject::LevelSet(level_set, _) => &level_set.notes,
            Subject::Skinned(still, _) => &still.notes,
        };
        for note in notes.iter().filter(|note| self.is_worth_telling(note)) {
            console.warn(format_args!("warning: {}: {note}", file.path.display()));
        }
        let mut written = Vec::new();
        let stems = self.stems(file);
        for (index, stem) in stems.iter().enumerate() {
            let turned = viewpoint.turned(360.0 * index as f64 / stems.len() as f64);
            let viewpoint = if index == 0 { *viewpoint } else { turned };
            let path = output_path(&self.outputs.folder, stem, self.outputs.formats[0]);
            let bytes = self.encoded(&subject, file, &viewpoint)?;
            write_whole(&path, |out| Ok(std::io::Write::write_all(out, &bytes)?))
                .with_context(|| format!("{}: cannot write", path.display()))?;
            written.push(path);
        }
        Ok(written)
    }

    /// That there are no velocities is nothing to tell where nobody asked for them.
    fn is_worth_telling(&self, note: &str) -> bool {
        let is_asked = self.args.method.particles.attributes.is_some();
        is_asked || !note.starts_with(&format!("no attribute `{VELOCITY}`"))
    }

    fn subject(&self, file: &FrameFile, settings: Option<&Settings>) -> Result<Subject> {
        if is_level_set(&file.path) {
            let hash = twox_hash::XxHash3_128::oneshot(&read_file(&file.path)?);
            return Ok(Subject::LevelSet(
                LevelSetFile::read(&file.path, self.format == PictureFormat::Exr)?,
                hash,
            ));
        }
        let settings = settings.context("there are no settings for particles among level sets")?;
        let frame = (&*file.path, file.number());
        let still = skin_file(frame, settings, &self.obstacles, &self.outputs, self.memory_bytes)?;
        Ok(Subject::Skinned(Box::new(still), Box::new(settings.clone())))
    }

    fn encoded(&self, subject: &Subject, file: &FrameFile, viewpoint: &Viewpoint) -> Result<Vec<u8>> {
        let options = PictureOptions { camera: CameraChoice::from(*viewpoint), ..self.outputs.picture };
        let (picture, provenance) = match subject {
            Subject::LevelSet(level_set, hash) => (
                self.picture(&level_set.scene(), viewpoint),
                picture_provenance(&file.path, *hash, None, &options),
            ),
            Subject::Skinned(still, settings) => (
                self.picture_of_particles(still, settings, viewpoint),
                picture_provenance(&file.path, still.hash, Some((settings, &still.obstacles)), &options),
            ),
        };
        // Side by side are two pictures, and no matrix leads to both.
        let camera = (!self.args.particles).then_some(viewpoint);
        Ok(encode_picture(&picture, camera, self.format, &provenance)?)
    }

    fn picture(&self, scene: &Scene, viewpoint: &Viewpoint) -> Picture {
        let has_data = self.format == PictureFormat::Exr && !self.args.particles;
        scene.picture(viewpoint, self.picture_size(), has_data)
    }

    fn picture_of_particles(&self, still: &Still, settings: &Settings, viewpoint: &Viewpoint) -> Picture {
        let surface = &still.surface;
        let velocity = if self.format == PictureFormat::Exr { velocities(surface) } else { None };
        let lattice = Lattice { voxel_size: settings.voxel_size };
        let scene =
            Scene { band: &surface.band, lattice, origin: glam::DVec3::ZERO, velocity: velocity.as_ref() };
        let right = self.picture(&scene, viewpoint);
        if !self.args.particles {
            return right;
        }
        let [width, height] = self.outputs.picture.size;
        let view = viewpoint.view([width / 2, height]);
        let left = render_particles(&still.particles, BALL_RADIUS * settings.radius_min, &view);
        side_by_side(&[left, right])
    }
}

/// The folder, the stem and the format of a picture's file.
fn named_file(file: &Path) -> Result<(PathBuf, String, PreviewChoice)> {
    let extension = file.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let preview = match &*extension {
        "png" => PreviewChoice::Png,
        "exr" => PreviewChoice::Exr,
        _ => bail!("{}: expected a name that ends with .png or .exr", file.display()),
    };
    let Some(stem) = file.file_stem().and_then(|stem| stem.to_str()) else {
        bail!("{}: expected a name in UTF-8", file.display());
    };
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    Ok((folder.to_owned(), stem.to_owned(), preview))
}

/// The attribute that .exr has a layer for.
const VELOCITY: &str = "velocity";

/// The radius of the balls that particles are shown as, in units of r_min: by default they nearly touch.
const BALL_RADIUS: f64 = 0.5;
