//! Level sets to surfaces: what a .vdb holds, contoured, or smoothed within bounds and then contoured.
//!
//! ```text
//!   .vdb ──read──▶ φ on the file's own lattice ──▶ [smooth] ──▶ contour ──write──▶ .glb .obj .vdb ..
//! ```
//!
//! Files are read, told apart and written as frames of particles are. There is no sequence: each file has its voxel size.

use std::path::PathBuf;
use std::sync::Arc;

use glam::DVec3;
use meniscus_formats::{Error, Limits, vdb};
use twox_hash::XxHash3_128;

use crate::surface::options::{Choices, Settings};
use crate::surface::skin::{resurface, resurfacing_bytes};

use super::crew::{Crew, Tasks};
use super::frame::{Frame, FrameError, FrameReport, Outcome, ReadInput, Stage};
use super::level_set_file::{LevelSetFile, level_set_limits};
use super::notes::fault;
use super::obstacles::ObstacleFiles;
use super::outputs::{OutputFormat, OutputOptions, output_path};
use super::provenance::{level_set_provenance, records};
use super::reading::read_unchanged;
use super::stages::{Conduct, OnError};
use super::stored::stored;
use super::writing::{Written, surface_notes, write_files, write_made};

/// A level set of which the surface is to be written.
#[derive(Clone, Debug)]
pub struct BandToSurface {
    /// The .vdb.
    pub input: PathBuf,
    /// What the outputs are called, without folder and extension.
    pub stem: String,
    /// What was asked for of smoothing and of the mesh.
    pub choices: Choices,
    /// By how much the surface may move, in voxels; 0 for not at all.
    pub slack_voxels: f64,
    /// What is written, and where.
    pub outputs: Arc<OutputOptions>,
}

/// Writes the surfaces of the level sets of a list, one after the other; `finished` hears of each, by its index.
pub fn resurface_all(
    bands: &[BandToSurface],
    conduct: &Conduct<'_>,
    mut finished: impl FnMut(usize, Outcome),
) {
    let mut is_stopped = false;
    for (index, band) in bands.iter().enumerate() {
        let outcome = match is_stopped {
            true => Outcome::NotStarted,
            false => {
                let made = FrameError::catch(&band.input, Stage::Contour, || made(band, conduct));
                made.map_err(Outcome::Failed).flatten().unwrap_or_else(|outcome| outcome)
            }
        };
        let is_failure = matches!(outcome, Outcome::Failed(_) | Outcome::Changed);
        is_stopped |= is_failure && conduct.on_error == OnError::Stop;
        finished(index, outcome);
    }
}

fn made(band: &BandToSurface, conduct: &Conduct<'_>) -> Result<Outcome, Outcome> {
    let failed = |error| Outcome::Failed(FrameError::file(&band.input, Stage::Read, error));
    let limits = level_set_limits(conduct.memory_bytes);
    let file_bytes = band.input.metadata().map_or(0, |metadata| metadata.len());
    limits.check_level_set(file_bytes, "").map_err(failed)?;
    let unchanged = read_unchanged(&band.input).map_err(|error| failed(error.into()))?;
    let (bytes, stamp) = unchanged.ok_or(Outcome::Changed)?;
    let input = ReadInput { stamp, hash: XxHash3_128::oneshot(&bytes) };
    let mut file =
        LevelSetFile::of_bytes(&band.input, &bytes, false, conduct.memory_bytes).map_err(Outcome::Failed)?;
    let refused = |what: String| failed(Error::unsupported("OpenVDB", what));
    if !file.is_declared() {
        let name = file.name();
        return Err(refused(format!(
            "the class of the grid \"{name}\" is not \"level set\": save it as one"
        )));
    }
    let settings = Settings::paper(file.lattice().voxel_size, &band.choices)
        .map_err(|error| refused(error.to_string()))?;
    let has_vdb = band.outputs.formats.contains(&OutputFormat::Vdb);
    if has_vdb && file.origin() != DVec3::ZERO {
        let [x, y, z] = file.origin().to_array();
        return Err(refused(format!(
            "its voxels are moved by ({x}, {y}, {z}) from the world's lattice, on which a .vdb is written: leave vdb out of --format"
        )));
    }
    let frame = Frame {
        input: band.input.clone(),
        stem: band.stem.clone(),
        settings: Arc::new(settings),
        outputs: Arc::clone(&band.outputs),
        number: None,
        obstacles: Arc::new(ObstacleFiles::default()),
        framing: None,
    };
    let provenance = |format| level_set_provenance(&frame, input.hash, band.slack_voxels, format);
    let is_done = |&format: &OutputFormat| {
        let path = output_path(&band.outputs.folder, &band.stem, format);
        records(&path, format, &provenance(format)).unwrap_or(false)
    };
    if conduct.skip_done
        && band.outputs.formats.iter().all(is_done)
        && let Some(fault) = conduct.recorded_fault(&frame.output_paths())
    {
        return Err(Outcome::AlreadyDone { input, fault });
    }
    let mut notes = std::mem::take(&mut file.notes);
    notes.extend(notes_of_grids(&bytes));
    drop(bytes);
    let origin = file.origin();
    let slack = band.slack_voxels as f32;
    let stored = stored(&frame.outputs);
    let needed = conduct.pool.install(|| resurfacing_bytes(file.band(), slack, &frame.settings));
    limits.check_level_set(needed, "").map_err(failed)?;
    let band = file.into_band();
    let surface = conduct.pool.install(|| resurface(band, origin, slack, &frame.settings, &stored));
    notes.extend(surface_notes(&surface, &frame.outputs, &frame.settings));
    let surface = Arc::new(surface);
    let tasks = Tasks::default();
    let written = conduct.pool.in_place_scope(|scope| {
        let crew = Crew::new(scope, &tasks);
        write_files(
            &frame,
            |format, out| write_made(&surface, (0, &frame), provenance(format), format, &crew, out),
            None,
        )
    });
    let Written { paths, sizes_bytes } = written.map_err(Outcome::Failed)?;
    conduct.record(&paths, fault(&surface.report).as_deref());
    let report = FrameReport {
        input,
        skin: surface.report.clone(),
        outputs: paths,
        output_bytes: sizes_bytes,
        notes,
        ..FrameReport::default()
    };
    Ok(Outcome::Converted(Box::new(report)))
}

/// What a user should know: that of several grids one was taken.
fn notes_of_grids(bytes: &[u8]) -> Vec<String> {
    let grids = vdb::grids(bytes, &Limits::default()).unwrap_or_default();
    let others = grids.len().saturating_sub(1);
    match others {
        0 => Vec::new(),
        1 => vec!["1 more grid in the file is not kept".to_owned()],
        _ => vec![format!("{others} more grids in the file are not kept")],
    }
}
