//! Reconstructs surfaces from particles, for Python.

use std::path::{Path, PathBuf};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, PoisonError};

use meniscus::pipeline::{self, ScratchFile, not_followed};
use meniscus::surface::options::Preset;
use meniscus::surface::reconstruction::FrameSurface;
use meniscus::surface::spacing::estimate_spacing;
use meniscus::surface::temporal::{OtherFrame, TimedFrame, with_particles};
use meniscus::surface::{
    Attribute, Options, Progress, Reconstructor, RequestedParts, Settings, SmoothedFrame,
};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;

use crate::arrays::{AttributeSlice, Attributes, Given, Positions};
use crate::compute::{run, run_with_progress};
use crate::errors::{ParticleError, of_method};
use crate::options::{Pairs, effective_pairs, parse, selection};
use crate::program::{Obstacle, needed_attributes, prepared_for};
use crate::surface::Surface;

/// A frame as Python passes it.
struct FrameRequest<'a> {
    options: Options,
    positions: meniscus::surface::Positions<'a>,
    attributes: Vec<AttributeSlice<'a>>,
    obstacles: Vec<&'a Obstacle>,
    memory: u64,
    scratch: Option<PathBuf>,
}

impl FrameRequest<'_> {
    /// A reconstructor for the frame, the attributes that it needs, and warnings.
    fn prepare<'r>(
        &self,
        advance: Sender<Progress>,
    ) -> Result<(Reconstructor<'r>, Vec<Attribute>, Vec<String>), Failure> {
        let (attributes, mut warnings) =
            needed_attributes(&self.attributes, &self.options).map_err(Failure::Particles)?;
        warnings.extend(preset_warning(&self.options, &self.positions, &attributes));
        let mut reconstructor = Reconstructor::new(self.options.clone());
        let obstacles = self.obstacles.iter().map(|obstacle| obstacle.shared());
        reconstructor.memory_limit(self.memory).obstacles(obstacles);
        if let Some(folder) = self.scratch.clone() {
            reconstructor.scratch(move || ScratchFile::storage(&folder));
        }
        // The receiver exists as long as the caller runs.
        reconstructor.on_progress(move |progress| {
            let _ = advance.send(progress);
        });
        Ok((reconstructor, attributes, warnings))
    }

    /// The names and hashes of the obstacles.
    fn recorded(&self) -> String {
        let recorded: Vec<&str> = self.obstacles.iter().map(|obstacle| obstacle.recorded()).collect();
        recorded.join(", ")
    }
}

/// The surface of a frame. `pairs` are the names and values of options. The surface gets all attributes, or
/// those in `attribute_names`. `formats` are the extensions of the files that it is prepared for. The frame
/// may take `memory` bytes; a larger frame uses scratch files in the folder `scratch`.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "the Python layer has them as keywords")]
pub(crate) fn reconstruct(
    py: Python<'_>,
    pairs: Pairs,
    all_attributes: bool,
    attribute_names: Vec<String>,
    points: &Bound<'_, PyAny>,
    attributes: Vec<Given<'_>>,
    obstacles: Vec<Py<Obstacle>>,
    formats: Vec<String>,
    memory: u64,
    scratch: Option<PathBuf>,
    threads: Option<usize>,
    progress: Option<Py<PyAny>>,
) -> PyResult<Surface> {
    let mut options = parse(&pairs)?;
    options.attributes = selection(all_attributes, attribute_names).or(options.attributes);
    let (positions, attributes) = (Positions::new(points)?, Attributes::new(attributes)?);
    let (positions, attributes) = (positions.as_slice()?, attributes.as_slices()?);
    check_finite(&positions)?;
    let prepared = prepared_for(&formats)?;
    let obstacles: Vec<&Obstacle> = obstacles.iter().map(Py::get).collect();
    let request = FrameRequest { options, positions, attributes, obstacles, memory, scratch };
    let made = run_with_progress(py, threads, progress.as_ref(), |advance| {
        let (mut reconstructor, attributes, mut warnings) = request.prepare(advance)?;
        // The positions are borrowed, so the clone copies nothing.
        let made = reconstructor.reconstruct_parts(request.positions.clone(), &attributes, prepared);
        let (surface, settings) = made.map_err(Failure::Method)?;
        warnings.extend(Obstacle::warnings(&request.obstacles, &request.positions, &settings));
        warnings.extend(emptiness(&surface));
        Ok((surface, settings, warnings))
    })?;
    let folder = request.scratch.clone().unwrap_or_default();
    let (surface, settings, warnings) = made.map_err(|failure: Failure| failure.raised(&folder))?;
    Ok(Surface::new(surface, Arc::new(settings), request.recorded(), prepared, warnings))
}

fn emptiness(surface: &FrameSurface) -> Option<String> {
    (surface.report.particle_count == 0).then(|| "no particles are left, so the surface is empty".to_owned())
}

/// A frame of a sequence that has its smoothed level set, and waits for those that it is averaged with.
#[pyclass(frozen, module = "pymeniscus._native")]
pub(crate) struct Smoothed {
    /// Until its surface is made.
    frame: Mutex<Option<SmoothedFrame<'static>>>,
    timed: Option<Arc<TimedFrame>>,
    obstacles: String,
    prepared: RequestedParts,
    warnings: Vec<String>,
}

/// The first half of [`reconstruct`], for a frame that is averaged with others.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "the Python layer has them as keywords")]
pub(crate) fn smooth(
    py: Python<'_>,
    pairs: Pairs,
    all_attributes: bool,
    attribute_names: Vec<String>,
    points: &Bound<'_, PyAny>,
    attributes: Vec<Given<'_>>,
    obstacles: Vec<Py<Obstacle>>,
    formats: Vec<String>,
    memory: u64,
    scratch: Option<PathBuf>,
    threads: Option<usize>,
) -> PyResult<Smoothed> {
    let mut options = parse(&pairs)?;
    options.attributes = selection(all_attributes, attribute_names).or(options.attributes);
    let (positions, attributes) = (Positions::new(points)?, Attributes::new(attributes)?);
    let (positions, attributes) = (positions.as_slice()?, attributes.as_slices()?);
    check_finite(&positions)?;
    let prepared = prepared_for(&formats)?;
    let obstacles: Vec<&Obstacle> = obstacles.iter().map(Py::get).collect();
    let request = FrameRequest { options, positions, attributes, obstacles, memory, scratch };
    let made = run_with_progress(py, threads, None, |advance| {
        let (mut reconstructor, attributes, mut warnings) = request.prepare(advance)?;
        let frame = reconstructor.smooth_parts(request.positions.clone().into(), attributes, prepared);
        let frame = frame.map_err(Failure::Method)?;
        warnings.extend(Obstacle::warnings(&request.obstacles, &request.positions, frame.settings()));
        Ok((frame, warnings))
    })?;
    let folder = request.scratch.clone().unwrap_or_default();
    let (frame, warnings) = made.map_err(|failure: Failure| failure.raised(&folder))?;
    let (timed, obstacles) = (frame.timed(), request.recorded());
    Ok(Smoothed { frame: Mutex::new(Some(frame)), timed, obstacles, prepared, warnings })
}

/// The second half: averages a frame with others, each with the number of frames by which it is later, and makes
/// its surface. Each frame has only one surface.
#[pyfunction]
pub(crate) fn average(
    py: Python<'_>,
    smoothed: &Bound<'_, Smoothed>,
    others: Vec<(i32, Py<Smoothed>)>,
    threads: Option<usize>,
) -> PyResult<Surface> {
    let smoothed = smoothed.get();
    let frame = smoothed.frame.lock().unwrap_or_else(PoisonError::into_inner).take();
    let frame =
        frame.ok_or_else(|| PyRuntimeError::new_err("internal error: the frame has its surface already"))?;
    let other = |(steps, other): &(i32, Py<Smoothed>)| {
        Some(OtherFrame { frame: other.get().timed.clone()?, steps: *steps })
    };
    let others: Vec<OtherFrame> = others.iter().filter_map(other).collect();
    let made = run_with_progress(py, threads, None, |_| {
        let mut reconstructor = Reconstructor::new(Options::default());
        reconstructor.contour_parts(frame, &others)
    })?;
    let (surface, settings) = made.map_err(|error| of_method(error, Path::new("")))?;
    let mut warnings = smoothed.warnings.clone();
    warnings.extend(emptiness(&surface));
    if with_particles(&others).next().is_some() {
        warnings.extend(not_followed(&surface.report.temporal).map(|warning| warning.sentence));
    }
    Ok(Surface::new(surface, Arc::new(settings), smoothed.obstacles.clone(), smoothed.prepared, warnings))
}

/// Why a frame has no surface.
enum Failure {
    Particles(String),
    Method(meniscus::surface::Error),
}

impl Failure {
    fn raised(self, scratch: &Path) -> PyErr {
        match self {
            Failure::Particles(why) => ParticleError::new_err(why),
            Failure::Method(failure) => of_method(failure, scratch),
        }
    }
}

/// Names and values of settings, and a warning about them.
type Resolved = (Vec<(&'static str, String)>, Option<String>);

/// The resolved settings, as names and values in text, and a warning about the preset. What the options leave
/// open is measured on these particles. Options without effect are left out, except those in `pairs`.
#[pyfunction]
pub(crate) fn resolve(
    py: Python<'_>,
    pairs: Pairs,
    points: &Bound<'_, PyAny>,
    attributes: Vec<Given<'_>>,
) -> PyResult<Resolved> {
    let options = parse(&pairs)?;
    let (positions, attributes) = (Positions::new(points)?, Attributes::new(attributes)?);
    let (positions, attributes) = (positions.as_slice()?, attributes.as_slices()?);
    check_finite(&positions)?;
    let is_empty = positions.is_empty();
    let resolved = run(py, || {
        if is_empty && options.needs_measuring() {
            return Err(Failure::Method(meniscus::surface::Error::NoParticles { input_count: 0 }));
        }
        let (attributes, _) = needed_attributes(&attributes, &options).map_err(Failure::Particles)?;
        let warning = preset_warning(&options, &positions, &attributes);
        let mut reconstructor = Reconstructor::new(options);
        let settings = reconstructor.resolve_on(positions, &attributes);
        let settings = settings.map(Settings::to_options).map_err(Failure::Method)?;
        Ok((settings, warning))
    })?;
    let (resolved, warning) = resolved.map_err(|failure: Failure| failure.raised(Path::new("")))?;
    Ok((effective_pairs(&resolved, false, &pairs), warning))
}

/// A warning if no preset is given and the default does not suit these particles, or if `auto` cannot choose
/// by them. As on the command line, they are not measured for this if everything is given.
fn preset_warning(
    options: &Options,
    positions: &meniscus::surface::Positions<'_>,
    attributes: &[Attribute],
) -> Option<String> {
    let is_open = options.preset.is_none() || options.is_auto();
    if !is_open || !options.needs_measuring() {
        return None;
    }
    let chosen = options.r#where.as_ref().map(|filter| filter.chosen(positions, attributes));
    let estimate = match &chosen {
        Some(Ok((chosen, _))) => estimate_spacing(chosen),
        // The condition is reported when the frame is reconstructed.
        Some(Err(_)) => return None,
        None => estimate_spacing(positions.clone()),
    };
    let irregularity = estimate.and_then(|estimate| estimate.irregularity);
    let warning = pipeline::preset_warning(options, irregularity)?;
    if warning.remedy.is_none() {
        return Some(warning.sentence);
    }
    let suitable = Preset::for_fluid(irregularity);
    Some(format!(
        "{}; use `preset=\"{suitable}\"`, or give `preset=\"fluid\"` if splashes matter more",
        warning.sentence
    ))
}

/// # Errors
/// `ParticleError` if there are positions, and none is finite.
fn check_finite(positions: &meniscus::surface::Positions<'_>) -> PyResult<()> {
    let count = positions.len();
    if count == 0 || (0..count).any(|index| positions.position(index).is_finite()) {
        return Ok(());
    }
    Err(ParticleError::new_err(format!(
        "none of the {count} positions is finite: each has a coordinate that is NaN or infinite"
    )))
}
