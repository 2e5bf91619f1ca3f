//! What `convert` and `plan` have in common: which frames become which files, and how.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Result, bail};
use rayon::ThreadPool;

use crate::pipeline::{Job, MeasuredSpacing, ObstacleFiles, OutputOptions, check_outputs};
use crate::surface::options::{MethodOptions, Settings};
use crate::surface::simd::level_warning;

use super::args::{FormatArgs, MethodArgs};
use super::choices::{obstacle_files, warn_of_ignored};
use super::console::Console;
use super::out_folder::OutFolder;
use super::resolving::{measured_spacing, outputs_of, say_settings, settings_of, warn_of, warn_of_siblings};
use super::selecting::{InputSelection, SelectedSequence, refuse_odd_place, selected_files};
use super::wording::all_typed;

/// Frames and what becomes of them, checked before anything is written.
pub(super) struct Conversion {
    pub(super) sequences: Vec<SelectedSequence>,
    /// Every file that the inputs stand for, selected or not.
    found: Vec<PathBuf>,
    pub(super) job: Job,
    options: MethodOptions,
    pub(super) obstacles: Arc<ObstacleFiles>,
    pub(super) outputs: OutputOptions,
    /// The folder of the outputs, which is removed again unless it is kept.
    pub(super) folder: OutFolder,
}

impl Conversion {
    /// Finds the obstacles, and makes the folder of the outputs.
    ///
    /// # Errors
    /// When an obstacle is missing, or the folder cannot be made.
    pub(super) fn new(
        selection: InputSelection,
        job: Job,
        method: &MethodArgs,
        outputs: OutputOptions,
    ) -> Result<Conversion> {
        let obstacles = Arc::new(obstacle_files(method)?);
        let folder = OutFolder::make(&outputs.folder)?;
        let InputSelection { sequences, found, .. } = selection;
        Ok(Conversion { sequences, found, job, options: method.to_options(), obstacles, outputs, folder })
    }

    /// Refuses to write outputs, or another file such as the report, over inputs, obstacles or each other: also what was found
    /// but not selected must stay.
    ///
    /// # Errors
    /// Which would replace which.
    pub(super) fn refuse_conflicts(&self, other: Option<(&'static str, &Path)>) -> Result<()> {
        if let Some((what, path)) = other {
            refuse_odd_place(what, path)?;
        }
        let planned: Vec<_> =
            selected_files(&self.sequences).map(|file| (file.path.clone(), file.stem())).collect();
        Ok(check_outputs(&planned, &self.found, &self.obstacles, &self.outputs, other)?)
    }

    /// What the frames of a sequence share, or why they cannot be converted.
    ///
    /// # Errors
    /// When the options make no sense for any frame.
    pub(super) fn resolve(
        &self,
        SelectedSequence { sequence, selected }: &SelectedSequence,
        pool: &ThreadPool,
        console: &mut Console,
    ) -> Result<Result<Resolved, String>> {
        let (settings, measured) = match self.job {
            Job::Surface => {
                let measured = match pool.install(|| measured_spacing(sequence, &self.options, console)) {
                    Ok(measured) => measured,
                    Err(error) => return Ok(Err(error.to_string())),
                };
                let settings = settings_of(sequence, &self.options, measured.as_ref())?;
                say_settings(sequence, selected.len(), &settings, measured.as_ref(), console);
                if measured.is_some() {
                    warn_of_siblings(sequence, console);
                }
                warn_of(sequence, &settings, console);
                (settings, measured)
            }
            Job::LevelSet { .. } => (Settings::of_level_sets(&self.options)?, None),
            Job::Particles => (Settings::of_level_sets(&MethodOptions::default())?, None),
        };
        let outputs = pool.install(|| outputs_of(sequence, &settings, &self.outputs));
        let resolved =
            outputs.map(|outputs| Resolved { settings: settings.into(), measured, outputs: outputs.into() });
        Ok(resolved.map_err(|error| error.to_string()))
    }
}

/// What all frames of a sequence are converted with.
pub(super) struct Resolved {
    pub(super) settings: Arc<Settings>,
    /// Where the particle spacing is from, unless it was given or is not needed.
    pub(super) measured: Option<MeasuredSpacing>,
    /// The camera of pictures is fixed.
    pub(super) outputs: Arc<OutputOptions>,
}

/// Warns about options that change nothing, and about kernels that are not there.
pub(super) fn warn_before(method: &MethodArgs, formats: &FormatArgs, console: &Console) {
    warn_of_ignored(method, formats, console);
    warn_of_level(console);
}

/// Warns about kernels that were asked for and are not there.
pub(super) fn warn_of_level(console: &Console) {
    if let Some(warning) = level_warning() {
        console.warning(warning);
    }
}

/// Refuses options that are given beside another one, but for these.
///
/// # Errors
/// Which, and why.
pub(super) fn refuse_beside(given: &[&str], allowed: &[&str], why: &str) -> Result<()> {
    let refused: Vec<&str> = given.iter().copied().filter(|name| !allowed.contains(name)).collect();
    if !refused.is_empty() {
        bail!("{}: {why}", all_typed(&refused));
    }
    Ok(())
}
