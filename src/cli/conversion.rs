//! What `convert` converts: which frames become which files, and how.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Result, bail};
use rayon::ThreadPool;

use crate::pipeline::{
    Job, MeasuredSpacing, ObstacleFiles, OutputOptions, Sequence, check_existing, check_outputs,
};
use crate::surface::options::{MethodOptions, Settings};
use crate::surface::simd::level_warning;

use super::args::{FormatArgs, MethodArgs};
use super::choices::{obstacle_files, warn_of_ignored};
use super::console::Console;
use super::out_folder::OutFolder;
use super::resolve::{measured_spacing, outputs_of, report_settings, settings_of, warn_of, warn_of_siblings};
use super::select::{InputSelection, SelectedSequence, check_output_path, selected_files};
use super::wording::option_names;

/// The frames and their outputs, checked before anything is written.
pub(super) struct Conversion {
    pub(super) sequences: Vec<SelectedSequence>,
    /// The sequences without any selected frame, which a stage plays nevertheless.
    pub(super) unselected: Vec<Sequence>,
    /// Every file that the inputs name, selected or not.
    found: Vec<PathBuf>,
    pub(super) job: Job,
    options: MethodOptions,
    pub(super) obstacles: Arc<ObstacleFiles>,
    pub(super) outputs: OutputOptions,
    /// The folder of the outputs. If it was created, it is removed again unless it is kept.
    pub(super) folder: OutFolder,
}

impl Conversion {
    /// Finds the obstacles, and creates the folder of the outputs.
    ///
    /// # Errors
    /// If an obstacle is missing, or the folder cannot be created.
    pub(super) fn new(
        selection: InputSelection,
        job: Job,
        method: &MethodArgs,
        outputs: OutputOptions,
    ) -> Result<Conversion> {
        let obstacles = Arc::new(obstacle_files(method)?);
        let folder = OutFolder::make(&outputs.folder)?;
        let InputSelection { sequences, unselected, found, .. } = selection;
        let options = method.to_options();
        Ok(Conversion { sequences, unselected, found, job, options, obstacles, outputs, folder })
    }

    /// Refuses outputs, or `others` such as the report, that would replace inputs, obstacles, data of other
    /// programs or each other. Inputs that are not selected are protected, too.
    ///
    /// # Errors
    /// If a file would replace another one; the error names both.
    pub(super) fn refuse_conflicts(&self, others: &[(&'static str, &Path)]) -> Result<()> {
        for (what, path) in others {
            check_output_path(what, path)?;
        }
        let planned: Vec<_> =
            selected_files(&self.sequences).map(|file| (file.path.clone(), file.stem())).collect();
        check_outputs(&planned, &self.found, &self.obstacles, &self.outputs, others)?;
        Ok(check_existing(&planned, &self.outputs, self.job)?)
    }

    /// The settings shared by the frames of a sequence, or why the frames cannot be converted.
    ///
    /// # Errors
    /// If the options are invalid for every frame.
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
                report_settings(sequence, selected.len(), &settings, measured.as_ref(), console);
                if measured.is_some() {
                    warn_of_siblings(sequence, console);
                }
                warn_of(sequence, &settings, console);
                (settings, measured)
            }
            Job::LevelSet { .. } => (Settings::for_level_sets(&self.options)?, None),
            Job::Particles => {
                let r#where = self.options.r#where.clone();
                (Settings::for_level_sets(&MethodOptions { r#where, ..MethodOptions::default() })?, None)
            }
        };
        let outputs = pool.install(|| outputs_of(sequence, &settings, &self.outputs));
        let resolved =
            outputs.map(|outputs| Resolved { settings: settings.into(), measured, outputs: outputs.into() });
        Ok(resolved.map_err(|error| error.to_string()))
    }
}

/// The settings shared by all frames of a sequence.
pub(super) struct Resolved {
    pub(super) settings: Arc<Settings>,
    /// The frame that the particle spacing was measured on, unless the spacing was given or is not needed.
    pub(super) measured: Option<MeasuredSpacing>,
    /// The outputs, with a fixed camera for pictures.
    pub(super) outputs: Arc<OutputOptions>,
}

/// Warns about options without effect, and about missing SIMD kernels.
pub(super) fn warn_before(method: &MethodArgs, formats: &FormatArgs, console: &Console) {
    warn_of_ignored(method, formats, console);
    warn_of_level(console);
}

/// Warns about requested SIMD kernels that are missing on this machine.
pub(super) fn warn_of_level(console: &Console) {
    if let Some(warning) = level_warning() {
        console.warning(warning);
    }
}

/// Refuses given options, except for the allowed ones, because they cannot be combined with another option.
///
/// # Errors
/// If options are refused; the error names them, and says why.
pub(super) fn refuse_combination(given: &[&str], allowed: &[&str], why: &str) -> Result<()> {
    let refused: Vec<&str> = given.iter().copied().filter(|name| !allowed.contains(name)).collect();
    if !refused.is_empty() {
        bail!("{}: {why}", option_names(&refused));
    }
    Ok(())
}
