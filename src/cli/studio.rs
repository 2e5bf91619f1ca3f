//! Where pictures are taken: what is the same for all pictures of a command.
//!
//! ```text
//!   sequence ──▶ settings, viewpoint
//!   frame ─┬─ .vdb: read ──────┬─▶ subject ──▶ pictures
//!          └─ particles: skin ─┘
//! ```

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, Error, Result, bail};

use crate::pipeline::{
    FrameError, FrameFile, LevelSetFile, LoadedFrame, NOTHING, ObstacleFiles, OutputFormat, OutputOptions,
    PictureOptions, Reconstruction, Scene, Sequence, Stage, Viewpoint, Warning, files_in, is_level_set,
    picture_provenance, sequence_bounds, up_of, velocities,
};
use crate::render::{Picture, render_particles, side_by_side};
use crate::surface::options::{AttributeSelection, Measured, MethodOptions, Settings};
use crate::surface::space::Lattice;

use super::args::{FormatArgs, MethodArgs, RunArgs, ViewArgs};
use super::camera_file::camera_of_file;
use super::choices::{ignored, output_options};
use super::console::Console;
use super::inputs::{Found, find_beside_others, find_inputs};
use super::quantities::{PictureSize, memory_bytes};
use super::remedies::with_remedy;
use super::resolving::measured_spacing;
use super::wording::counted;

/// What is the same for all pictures of a command.
pub(super) struct Studio<'a> {
    pub(super) method: &'a MethodArgs,
    /// One format, that of the pictures.
    pub(super) outputs: OutputOptions,
    pub(super) obstacles: ObstacleFiles,
    pub(super) memory_bytes: u64,
}

/// What there is to take pictures of.
pub(super) enum Subject {
    /// A level set, and a hash of its file.
    LevelSet(Box<LevelSetFile>),
    /// Particles and their surface.
    Skinned(Box<Skinned>),
}

/// A frame that was skinned for its pictures.
pub(super) struct Skinned {
    pub(super) frame: LoadedFrame,
    pub(super) made: Reconstruction,
    pub(super) settings: Settings,
}

/// The particle spacing of a sequence, where these choices need it.
///
/// # Errors
/// When it cannot be measured.
pub(super) fn measured(
    sequence: &Sequence,
    choices: &MethodOptions,
    console: &Console,
) -> Result<Option<Measured>> {
    let measured = measured_spacing(sequence, choices, console).map_err(|none| match none.sparse_count {
        // Why a file cannot be read begins with its name.
        0 => Error::from(none),
        _ => Error::from(none).context(sequence.name.clone()),
    })?;
    Ok(measured.as_ref().map(Measured::from))
}

impl<'a> Studio<'a> {
    /// For pictures of this format and size that go into this folder.
    ///
    /// # Errors
    /// When an option is wrong.
    pub(super) fn new(
        method: &'a MethodArgs,
        (view, run): (&ViewArgs, &RunArgs),
        (folder, format, size): (PathBuf, OutputFormat, PictureSize),
    ) -> Result<Studio<'a>> {
        let camera = match (&view.camera_from, view.camera) {
            (Some(file), _) => camera_of_file(file, view.up)?,
            (None, camera) => camera.unwrap_or_default(),
        };
        let typed = FormatArgs { up: view.up, preview_size: Some(size), ..FormatArgs::default() };
        let mut outputs = output_options(folder, None, &typed);
        outputs.picture.camera = camera;
        outputs.formats = vec![format];
        let obstacles = ObstacleFiles::new(method.obstacle.clone());
        if let Some(missing) = obstacles.missing() {
            bail!("{}: there is no such obstacle", missing.display());
        }
        Ok(Studio { method, outputs, obstacles, memory_bytes: memory_bytes(run.memory)? })
    }

    /// Tells of options that change nothing where these formats are written.
    pub(super) fn warn_of_ignored(&self, written: &[OutputFormat], console: &Console) {
        for warning in ignored(self.method, written, &FormatArgs::default()) {
            console.warn(format_args!("warning: {warning}"));
        }
    }

    /// The settings that the particles of a sequence are skinned with; none for level sets.
    ///
    /// # Errors
    /// When options make no sense, or there is no voxel size.
    pub(super) fn settings(&self, sequence: &Sequence, console: &Console) -> Result<Option<Settings>> {
        if sequence.frames.iter().all(|file| is_level_set(&file.path)) {
            return Ok(None);
        }
        let mut choices = self.method.to_options();
        if self.has_velocities() && choices.attributes.is_none() {
            choices.attributes = Some(AttributeSelection::Named(vec![VELOCITY.to_owned()]));
        }
        let measured = measured(sequence, &choices, console)?;
        let settings = Settings::resolve(&choices, measured).with_context(|| sequence.name.clone())?;
        for warning in settings.warnings() {
            console.warn(format_args!("warning: {}: {warning}", sequence.name));
        }
        Ok(Some(settings))
    }

    /// Where all pictures of a sequence are taken from.
    ///
    /// # Errors
    /// When none of its frames can be read.
    pub(super) fn viewpoint(
        &self,
        sequence: &Sequence,
        settings: Option<&Settings>,
        size: [usize; 2],
    ) -> Result<Viewpoint> {
        let PictureOptions { camera, .. } = self.outputs.picture;
        let bounds = match camera.needs_bounds() {
            true => {
                let paths: Vec<&Path> = sequence.frames.iter().map(|file| &*file.path).collect();
                sequence_bounds(&paths, settings.map_or(0.0, Settings::resting_height))?
            }
            false => None,
        };
        let aspect = size[0] as f64 / size[1] as f64;
        Ok(camera.viewpoint(bounds.unwrap_or(NOTHING), aspect, up_of(self.outputs.up)))
    }

    /// Reads a level set, or skins particles.
    ///
    /// # Errors
    /// Those of every stage.
    pub(super) fn subject(&self, file: &FrameFile, settings: Option<&Settings>) -> Result<Subject> {
        if is_level_set(&file.path) {
            let level_set = LevelSetFile::read(&file.path, self.has_velocities())?;
            return Ok(Subject::LevelSet(Box::new(level_set)));
        }
        let settings = settings.context("there are no settings for particles among level sets")?;
        let frame = LoadedFrame::read((&file.path, file.number()), settings)?;
        let made = self.skin(&frame, settings)?;
        Ok(Subject::Skinned(Box::new(Skinned { frame, made, settings: settings.clone() })))
    }

    /// Skins particles.
    ///
    /// # Errors
    /// Those of every stage.
    pub(super) fn skin(
        &self,
        frame: &LoadedFrame,
        settings: &Settings,
    ) -> Result<Reconstruction, FrameError> {
        frame.skin(settings, &self.obstacles, &self.outputs, self.memory_bytes)
    }

    /// Prints the warnings about a frame. Velocities that are missing are not one where the user did not ask for them.
    pub(super) fn print_warnings(&self, file: &FrameFile, subject: &Subject, console: &Console) {
        let warnings = match subject {
            Subject::LevelSet(level_set) => &level_set.warnings,
            Subject::Skinned(skinned) => &skinned.made.warnings,
        };
        let is_asked = self.method.options.attributes.is_some();
        let is_velocity =
            |warning: &Warning| matches!(warning, Warning::MissingAttribute { name, .. } if name == VELOCITY);
        for warning in warnings.iter().filter(|warning| is_asked || !is_velocity(warning)) {
            console.warn(format_args!("warning: {}: {}", file.path.display(), with_remedy(warning)));
        }
    }

    /// Whether pictures have a place for velocities.
    fn has_velocities(&self) -> bool {
        self.outputs.formats == [OutputFormat::Exr]
    }
}

impl Subject {
    /// A picture of the surface, with what is known of its pixels if that is wanted.
    pub(super) fn picture(&self, viewpoint: &Viewpoint, size: [usize; 2], has_data: bool) -> Picture {
        match self {
            Subject::LevelSet(level_set) => level_set.scene().picture(viewpoint, size, has_data),
            Subject::Skinned(skinned) => {
                picture_of_reconstruction(&skinned.made, &skinned.settings, (viewpoint, size), has_data)
            }
        }
    }

    /// The particles to the left, the surface to the right. A level set has no particles, and is alone.
    pub(super) fn picture_beside_particles(&self, viewpoint: &Viewpoint, size: [usize; 2]) -> Picture {
        let [width, height] = size;
        let Subject::Skinned(skinned) = self else { return self.picture(viewpoint, size, false) };
        let right = self.picture(viewpoint, [width - width / 2, height], false);
        let view = viewpoint.view([width / 2, height]);
        let radius = BALL_RADIUS * skinned.settings.radius_min;
        side_by_side(&[render_particles(skinned.frame.particles(), radius, &view), right])
    }

    /// What made a picture of it.
    pub(super) fn provenance(&self, input: &Path, options: &PictureOptions) -> Vec<(String, String)> {
        match self {
            Subject::LevelSet(level_set) => picture_provenance(input, level_set.hash, None, options),
            Subject::Skinned(skinned) => {
                let Skinned { frame, made, settings } = &**skinned;
                picture_provenance(input, frame.hash(), Some((settings, &made.obstacles)), options)
            }
        }
    }
}

/// Does what a picture of a file takes; a panic becomes an error of this one, and the others go on.
pub(super) fn caught<T>(file: &Path, work: impl FnOnce() -> Result<T>) -> Result<T> {
    FrameError::catch(file, Stage::Write, work)?
}

/// A picture of a surface, with what is known of its pixels if that is wanted.
pub(super) fn picture_of_reconstruction(
    made: &Reconstruction,
    settings: &Settings,
    (viewpoint, size): (&Viewpoint, [usize; 2]),
    has_data: bool,
) -> Picture {
    let velocity = if has_data { velocities(&made.surface) } else { None };
    let lattice = Lattice { voxel_size: settings.voxel_size };
    let (band, origin) = (&made.surface.band, glam::DVec3::ZERO);
    Scene { band, lattice, origin, velocity: velocity.as_ref() }.picture(viewpoint, size, has_data)
}

/// The files that were meant; of a folder its particles, and the level sets of other frames.
///
/// # Errors
/// When an input stands for no file at all.
pub(super) fn find_subjects(inputs: &[PathBuf]) -> Result<Found> {
    let mut all = Found::default();
    for input in inputs {
        let level_sets = level_sets_in(input);
        all.add(match level_sets.is_empty() {
            true => find_inputs(std::slice::from_ref(input))?,
            false => with_level_sets(find_beside_others(input)?, level_sets, input),
        });
    }
    Ok(all)
}

/// Particles, and those level sets of the same folder whose frames are not there as particles.
fn with_level_sets(mut found: Found, level_sets: Vec<FrameFile>, folder: &Path) -> Found {
    let stems: HashSet<String> = found.files.iter().map(FrameFile::stem).collect();
    let count = level_sets.len();
    let (known, new): (Vec<_>, Vec<_>) = level_sets
        .into_iter()
        .partition(|file| file.path.file_stem().is_some_and(|stem| stems.contains(&*stem.to_string_lossy())));
    if !known.is_empty() {
        found.warnings.push(format!(
            "{}: {} of {} passed over: their frames are there as particles",
            folder.display(),
            known.len(),
            counted(count, "level set")
        ));
    }
    found.add(Found { files: new, ..Found::default() });
    found
}

/// The level sets in a folder; none in what is no folder.
pub(super) fn level_sets_in(folder: &Path) -> Vec<FrameFile> {
    let files = if folder.is_dir() { files_in(folder).unwrap_or_default() } else { Vec::new() };
    files.into_iter().filter(|path| is_level_set(path)).map(FrameFile::new).collect()
}

/// The folder, the stem and the extension, in small letters, of a picture's file.
///
/// # Errors
/// When its name is not UTF-8, or has another extension than these.
pub(super) fn named_picture<'e>(file: &Path, extensions: &[&'e str]) -> Result<(PathBuf, String, &'e str)> {
    let extension = file.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let Some(extension) = extensions.iter().find(|known| **known == extension) else {
        bail!("{}: expected a name that ends with .{}", file.display(), extensions.join(" or ."));
    };
    let Some(stem) = file.file_stem().and_then(|stem| stem.to_str()) else {
        bail!("{}: expected a name in UTF-8", file.display());
    };
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    Ok((folder.to_owned(), stem.to_owned(), extension))
}

/// The attribute that .exr has a layer for.
const VELOCITY: &str = "velocity";

/// The radius of the balls that particles are shown as, in units of r_min: by default they nearly touch.
const BALL_RADIUS: f64 = 0.5;
