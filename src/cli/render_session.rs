//! The state shared by all pictures of a command.
//!
//! ```text
//!   sequence ──▶ settings, viewpoint
//!   frame ─┬─ level set or mesh: read ─┬─▶ source ──▶ pictures
//!          └─ particles: reconstruct ──┘
//! ```

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, Error, Result, bail};
use glam::DVec3;
use meniscus_formats::gltf::{CameraData, read_camera};
use meniscus_formats::{UpAxis, read_provenance};

use crate::pipeline::{
    CAMERA, CameraChoice, EMPTY_BOUNDS, FrameError, FrameFile, LevelSetFile, LoadedFrame, MeasuredSpacing,
    MeshFile, ObstacleFiles, OutputFormat, OutputOptions, PictureOptions, PictureScene, Reconstruction,
    Sequence, Stage, Viewpoint, Warning, files_in, is_level_set, is_mesh, is_sequence_file, open_regular,
    picture_provenance, read_regular, sequence_bounds, up_of, velocities,
};
use crate::render::{Picture, render_particles, side_by_side};
use crate::surface::grid::{LeafMask, negative_masks};
use crate::surface::options::{AttributeSelection, ColumnNames, MethodOptions, Settings};
use crate::surface::reconstruction::FrameSurface;
use crate::surface::space::Lattice;

use super::args::{FormatArgs, MethodArgs, MethodOptionArgs, PictureArgs};
use super::console::Console;
use super::destination::{folder_of, refuse_capitals};
use super::inputs::{MatchedInputs, find_with_others};
use super::machine::memory_bytes;
use super::quantities::PictureSize;
use super::settings::{ignored, measure_if_needed, obstacle_files, settings_of, warn_of};
use super::wording::pluralize;

/// Settings and resources shared by all pictures of a command.
pub(super) struct RenderSession<'a> {
    pub(super) method: &'a MethodArgs,
    /// Exactly one format, that of the pictures.
    pub(super) outputs: OutputOptions,
    pub(super) obstacles: ObstacleFiles,
    pub(super) memory_bytes: u64,
}

/// The surface to render.
pub(super) enum RenderSource {
    /// A level set, and the hash of its file.
    LevelSet(Box<LevelSetFile>),
    /// A mesh, and the hash of its file.
    Mesh(MeshFile),
    /// Particles and their surface.
    Reconstructed(Box<RenderedFrame>),
}

/// A frame that was converted for its pictures.
pub(super) struct RenderedFrame {
    pub(super) frame: LoadedFrame,
    pub(super) made: Reconstruction,
    pub(super) settings: Settings,
}

/// The measured spacing of the particles of a sequence; `None` if the options need none.
///
/// # Errors
/// If the spacing cannot be measured.
pub(super) fn spacing_of(
    sequence: &Sequence,
    options: &MethodOptions,
    console: &Console,
) -> Result<Option<MeasuredSpacing>> {
    measure_if_needed(sequence, options, console).map_err(|none| match none.sparse_count {
        // An error of reading a file already begins with the file's name.
        0 => Error::from(none),
        _ => Error::from(none).context(sequence.name.clone()),
    })
}

impl<'a> RenderSession<'a> {
    /// A session for pictures of this format and size, written into this folder.
    ///
    /// # Errors
    /// If an option is invalid.
    pub(super) fn new(
        args: &'a PictureArgs,
        folder: PathBuf,
        format: OutputFormat,
        size: PictureSize,
    ) -> Result<RenderSession<'a>> {
        let PictureArgs { camera, camera_from, up, run, method } = args;
        let camera = match camera_from {
            Some(file) => camera_of_file(file, *up)?,
            None => camera.unwrap_or_default(),
        };
        let outputs = OutputOptions {
            up: up.unwrap_or_default(),
            picture: PictureOptions { size: size.map(usize::from), camera },
            ..OutputOptions::new(folder, &[format])
        };
        let (obstacles, memory_bytes) = (obstacle_files(method)?, memory_bytes(run.memory)?);
        Ok(RenderSession { method, outputs, obstacles, memory_bytes })
    }

    /// Warns about options that have no effect on these formats.
    pub(super) fn warn_of_ignored(&self, written: &[OutputFormat], console: &Console) {
        let options = MethodOptionArgs(self.options());
        let method = MethodArgs { options, ..self.method.clone() };
        for warning in ignored(&method, &FormatArgs::default(), written) {
            console.warning(warning);
        }
    }

    /// What all pictures of a sequence share: the settings for its particles (none for surfaces), and the
    /// camera for pictures of this size.
    ///
    /// # Errors
    /// If options are invalid, there is no voxel size, or none of the frames can be read.
    pub(super) fn prepare(
        &self,
        sequence: &Sequence,
        size: [usize; 2],
        console: &Console,
    ) -> Result<(Option<Settings>, Viewpoint)> {
        let settings = self.settings(sequence, console)?;
        let viewpoint = self.viewpoint(sequence, settings.as_ref(), size)?;
        Ok((settings, viewpoint))
    }

    /// The options, with the velocities that the format has.
    fn options(&self) -> MethodOptions {
        let mut options = self.method.to_options();
        if self.has_velocities() && options.attributes.is_none() {
            options.attributes = Some(AttributeSelection::Named(vec![VELOCITY.to_owned()]));
        }
        options
    }

    fn settings(&self, sequence: &Sequence, console: &Console) -> Result<Option<Settings>> {
        if sequence.frames.iter().all(|file| surface_name(&file.path).is_some()) {
            return Ok(None);
        }
        let choices = self.options();
        let measured = spacing_of(sequence, &choices, console)?;
        let settings = settings_of(sequence, &choices, measured.as_ref())?;
        warn_of(sequence, &settings, console);
        Ok(Some(settings))
    }

    fn viewpoint(
        &self,
        sequence: &Sequence,
        settings: Option<&Settings>,
        size: [usize; 2],
    ) -> Result<Viewpoint> {
        let PictureOptions { camera, .. } = self.outputs.picture;
        let mut bounds = None;
        if camera.needs_bounds() {
            let paths: Vec<&Path> = sequence.frames.iter().map(|file| &*file.path).collect();
            let reading = settings.map(|settings| settings.reading.clone()).unwrap_or_default();
            bounds = sequence_bounds(&paths, settings.map_or(0.0, Settings::resting_height), &reading)?;
        }
        let aspect = size[0] as f64 / size[1] as f64;
        Ok(camera.viewpoint(bounds.unwrap_or(EMPTY_BOUNDS), aspect, up_of(self.outputs.up)))
    }

    /// Reads a level set or a mesh, or converts particles, and prints warnings about the frame.
    ///
    /// # Errors
    /// The errors of every stage.
    pub(super) fn source(
        &self,
        file: &FrameFile,
        settings: Option<&Settings>,
        console: &Console,
    ) -> Result<RenderSource> {
        let source = if is_level_set(&file.path) {
            let level_set = LevelSetFile::read(&file.path, self.has_velocities(), self.memory_bytes)?;
            level_set.require_memory(&file.path, &self.outputs, self.memory_bytes)?;
            RenderSource::LevelSet(Box::new(level_set))
        } else if is_mesh(&file.path) {
            RenderSource::Mesh(MeshFile::read(&file.path)?)
        } else {
            let settings = settings.with_context(|| {
                let file = file.path.display();
                format!("{file}: particles and surfaces must be rendered by separate commands")
            })?;
            let frame = LoadedFrame::read(&file.path, file.number(), settings)?;
            let made = self.reconstruct(&frame, settings)?;
            RenderSource::Reconstructed(Box::new(RenderedFrame { frame, made, settings: settings.clone() }))
        };
        self.print_warnings(file, &source, console);
        Ok(source)
    }

    /// Converts particles to a surface.
    ///
    /// # Errors
    /// The errors of every stage.
    pub(super) fn reconstruct(
        &self,
        frame: &LoadedFrame,
        settings: &Settings,
    ) -> Result<Reconstruction, FrameError> {
        frame.reconstruct(settings, &self.obstacles, &self.outputs, self.memory_bytes)
    }

    /// Prints the warnings about a frame. Missing velocities are a warning only if the user requested them.
    fn print_warnings(&self, file: &FrameFile, source: &RenderSource, console: &Console) {
        let warnings = match source {
            RenderSource::LevelSet(level_set) => &level_set.warnings,
            RenderSource::Mesh(mesh) => {
                if let count @ 1.. = mesh.broken_count() {
                    console.warning(format_args!(
                        "{}: left out {} with a corner that is missing or not finite",
                        file.path.display(),
                        pluralize(count, "triangle")
                    ));
                }
                return;
            }
            RenderSource::Reconstructed(reconstructed) => &reconstructed.made.warnings,
        };
        let is_requested = self.method.options.0.attributes.is_some();
        let is_velocity = |warning: &Warning| warning.subject == VELOCITY;
        for warning in warnings.iter().filter(|warning| is_requested || !is_velocity(warning)) {
            console.warning(format_args!("{}: {warning}", file.path.display()));
        }
    }

    /// Whether the picture format can store velocities.
    fn has_velocities(&self) -> bool {
        self.outputs.formats == [OutputFormat::Exr]
    }
}

impl RenderSource {
    /// What is empty if there is no surface, for messages; `None` if there is one.
    pub(super) fn empty_part(&self) -> Option<&'static str> {
        let (band, part) = match self {
            RenderSource::LevelSet(level_set) => (level_set.scene().band, "level set"),
            RenderSource::Mesh(mesh) => return mesh.bounds().is_none().then_some("mesh"),
            RenderSource::Reconstructed(reconstructed) => {
                let FrameSurface { band, spray, .. } = &reconstructed.made.surface;
                if spray.as_ref().is_some_and(|spray| !spray.positions.is_empty()) {
                    return None;
                }
                (band, "surface")
            }
        };
        negative_masks(&band.phi).iter().all(LeafMask::is_empty).then_some(part)
    }

    /// A picture of the surface, with the data of its pixels, such as depths and normals, if `has_data` is
    /// set.
    pub(super) fn picture(&self, viewpoint: &Viewpoint, size: [usize; 2], has_data: bool) -> Picture {
        match self {
            RenderSource::LevelSet(level_set) => level_set.scene().picture(viewpoint, size, has_data),
            RenderSource::Mesh(mesh) => mesh.picture(viewpoint, size, has_data),
            RenderSource::Reconstructed(reconstructed) => picture_of_reconstruction(
                &reconstructed.made,
                &reconstructed.settings,
                viewpoint,
                size,
                has_data,
            ),
        }
    }

    /// A picture with the particles on the left and the surface on the right; only the surface if there are
    /// no particles.
    pub(super) fn picture_beside_particles(&self, viewpoint: &Viewpoint, size: [usize; 2]) -> Picture {
        let [width, height] = size;
        let RenderSource::Reconstructed(reconstructed) = self else {
            return self.picture(viewpoint, size, false);
        };
        let right = self.picture(viewpoint, [width - width / 2, height], false);
        let view = viewpoint.view([width / 2, height]);
        let radius = BALL_RADIUS * reconstructed.settings.unit_radius();
        side_by_side(&[render_particles(reconstructed.frame.particles(), radius, &view), right])
    }

    /// The provenance to store in a picture of this surface.
    pub(super) fn provenance(&self, input: &Path, options: &PictureOptions) -> Vec<(String, String)> {
        match self {
            RenderSource::LevelSet(level_set) => picture_provenance(input, level_set.hash, None, options),
            RenderSource::Mesh(mesh) => picture_provenance(input, mesh.hash, None, options),
            RenderSource::Reconstructed(reconstructed) => {
                let RenderedFrame { frame, made, settings } = &**reconstructed;
                picture_provenance(input, frame.hash(), Some((settings, &made.obstacles)), options)
            }
        }
    }
}

/// Processes a file; a panic becomes an error of this file, so that the command continues with the others.
pub(super) fn catch_panic<T>(file: &Path, work: impl FnOnce() -> Result<T>) -> Result<T> {
    FrameError::catch(file, Stage::Write, work)?
}

/// A picture of a surface, with the data of its pixels, such as depths and normals, if `has_data` is set.
pub(super) fn picture_of_reconstruction(
    made: &Reconstruction,
    settings: &Settings,
    viewpoint: &Viewpoint,
    size: [usize; 2],
    has_data: bool,
) -> Picture {
    let velocity = if has_data { velocities(&made.surface) } else { None };
    let lattice = Lattice { voxel_size: settings.voxel_size };
    let (band, spray, origin) = (&made.surface.band, made.surface.spray.as_ref(), glam::DVec3::ZERO);
    let scene = PictureScene { band, lattice, origin, velocity: velocity.as_ref(), spray };
    scene.picture(viewpoint, size, has_data)
}

/// The files that the inputs name: particles, and in folders also a surface of each frame without particles.
///
/// # Errors
/// If an input matches no file.
pub(super) fn find_render_sources(
    inputs: &[PathBuf],
    columns: Option<&ColumnNames>,
) -> Result<MatchedInputs> {
    find_with_others(inputs, columns, |input| Ok(surfaces_in(input)), add_surfaces)
}

/// Adds a surface of each frame of a folder that has no particles: its level set, or else its first mesh by
/// name.
fn add_surfaces(found: &mut MatchedInputs, surfaces: Vec<FrameFile>, folder: &Path) {
    // A mesh in PLY counts as particles in other folders.
    found.files.retain(|file| !is_mesh(&file.path));
    let mut stems: HashSet<String> = found.files.iter().map(FrameFile::stem).collect();
    let count = surfaces.len();
    let (known, mut new): (Vec<_>, Vec<_>) =
        surfaces.into_iter().partition(|file| stems.contains(&file.stem()));
    if !known.is_empty() {
        found.warnings.push(format!(
            "{}: skipped {} of {}: the particles of the same frames are used instead",
            folder.display(),
            known.len(),
            pluralize(count, "surface")
        ));
    }
    // All frames that have it use the same format: formats differ in their axes.
    new.sort_by_key(|file| {
        let extension = file.path.extension().unwrap_or_default().to_ascii_lowercase();
        (!is_level_set(&file.path), extension)
    });
    new.retain(|file| stems.insert(file.stem()));
    found.add(MatchedInputs { files: new, ..MatchedInputs::default() });
}

/// The level sets in a folder; empty if the path is not a folder.
pub(super) fn level_sets_in(folder: &Path) -> Vec<FrameFile> {
    files_of(folder, is_level_set)
}

/// The level sets and the meshes in a folder, without sequence files; empty if the path is not a folder.
pub(super) fn surfaces_in(folder: &Path) -> Vec<FrameFile> {
    files_of(folder, |path| surface_name(path).is_some() && !is_sequence_file(path))
}

fn files_of(folder: &Path, is_wanted: impl Fn(&Path) -> bool) -> Vec<FrameFile> {
    let files = if folder.is_dir() { files_in(folder).unwrap_or_default() } else { Vec::new() };
    files.into_iter().filter(|path| is_wanted(path)).map(FrameFile::new).collect()
}

/// What a file with a surface is, for messages; `None` for other files.
pub(super) fn surface_name(path: &Path) -> Option<&'static str> {
    if is_level_set(path) { Some("level set") } else { is_mesh(path).then_some("mesh") }
}

/// The folder, the stem and the extension of a picture's file.
///
/// # Errors
/// If its name is not UTF-8, or has an extension other than these, in lower case.
pub(super) fn named_picture<'e>(file: &Path, extensions: &[&'e str]) -> Result<(PathBuf, String, &'e str)> {
    let extension = file.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let Some(extension) = extensions.iter().find(|known| **known == extension) else {
        bail!("{}: expected a name that ends with .{}", file.display(), extensions.join(" or ."));
    };
    refuse_capitals(file, extension)?;
    let Some(stem) = file.file_stem().and_then(|stem| stem.to_str()) else {
        bail!("{}: expected a name in UTF-8", file.display());
    };
    let folder = folder_of(file);
    Ok((folder.to_owned(), stem.to_owned(), extension))
}

/// The attribute that .exr stores in its own layer.
const VELOCITY: &str = "velocity";

/// The radius of the balls that represent particles, in units of the radius of a lone drop: with the default
/// settings they nearly touch.
const BALL_RADIUS: f64 = 0.5;

// Reads the camera of a scene, or of a picture that meniscus made.

/// Reads the camera. `up` is the axis of the particles that the scene's y axis corresponds to.
///
/// # Errors
/// If the file has no camera.
fn camera_of_file(path: &Path, up: Option<UpAxis>) -> Result<CameraChoice> {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let camera = match &*extension {
        "glb" | "gltf" => camera_of_scene(path, up.unwrap_or_default()),
        "exr" => camera_of_picture(path, OutputFormat::Exr),
        "png" => camera_of_picture(path, OutputFormat::Png),
        _ => bail!(
            "{}: expected a .glb or .gltf with a camera, or a .exr or .png that meniscus wrote",
            path.display()
        ),
    };
    camera.with_context(|| path.display().to_string())
}

fn camera_of_picture(path: &Path, format: OutputFormat) -> Result<CameraChoice> {
    let pairs = read_provenance(format, open_regular(path)?)?;
    let Some((_, text)) = pairs.iter().find(|(name, _)| name == CAMERA) else {
        bail!("this picture does not record its camera: expected a picture that meniscus made");
    };
    text.parse().map_err(anyhow::Error::msg)
}

fn camera_of_scene(path: &Path, up: UpAxis) -> Result<CameraChoice> {
    let CameraData { eye, forward, up: top, view_radians } = read_camera(&read_regular(path)?)?;
    let rotated = |[x, y, z]: [f64; 3]| match up {
        UpAxis::Y => DVec3::new(x, y, z),
        UpAxis::Z => DVec3::new(x, -z, y),
    };
    let (eye, forward, top) = (rotated(eye), rotated(forward).normalize_or_zero(), rotated(top));
    let target = eye + forward;
    let text = |v: DVec3| format!("{}:{}:{}", v.x, v.y, v.z);
    let degrees = view_radians.to_degrees();
    let spec = format!(
        "eye={},target={},top={},view={degrees},up={}",
        text(eye),
        text(target),
        text(top),
        up.name()
    );
    spec.parse().map_err(anyhow::Error::msg)
}
