//! `meniscus tune`: one frame under a grid of settings, for visual comparison.
//!
//! ```text
//!   INPUT ──▶ a frame, read once ──▶ base settings ─────▶ a camera for all
//!                                          │ --vary
//!                                          ▼
//!                         cells: settings ──▶ surface ──▶ picture, label, command
//! ```
//!
//! A cell is a set of command options with some values replaced. Its settings and its printed command line
//! come from the same options, so they cannot differ.

use std::path::PathBuf;

use anyhow::{Result, bail};

use crate::cli::args::{MethodArgs, TuneArgs};
use crate::cli::choices::refuse_misplaced_rounds;
use crate::cli::console::Console;
use crate::cli::inputs::find_inputs;
use crate::cli::machine::{memory_bytes, thread_pool};
use crate::cli::parameter_sweep::{Parameter, SweepValue};
use crate::cli::remedies::with_remedy;
use crate::cli::render_session::{RenderSession, catch_panic, picture_of_reconstruction, spacing_of};
use crate::cli::resolve::{settings_of, warn_of_siblings};
use crate::cli::select::{SelectedSequence, only_sequence, selected_of};
use crate::cli::wording::{pluralize, with_causes};
use crate::cli::{CommandOutcome, DoneCounts};
use crate::pipeline::{
    CameraChoice, EMPTY_BOUNDS, FrameFile, LoadedFrame, OutputFormat, Reconstruction, ReportedWarnings,
    Sequence, SheetPart, Viewpoint, Warning, bounds_of_particles, close_up, is_level_set, up_of,
};
use crate::render::{Cell, CellGroup, CellPicture, Picture, Sheet};
use crate::surface::options::{MethodOptions, SequenceSpacing, Settings};

use super::command::CommandLine;
use super::{SheetFile, even_columns, fixed, reason, refuse_large};

/// Shows one frame under the requested settings.
///
/// # Errors
/// If no cell can be attempted. A cell that fails is reported and counted.
pub(in crate::cli) fn tune(args: &TuneArgs, console: &mut Console) -> Result<CommandOutcome> {
    refuse_misplaced_rounds(&args.pictures.method, &args.inputs)?;
    let found = find_inputs(&args.inputs)?;
    found.report(console);
    let paths: Vec<PathBuf> = found.files.iter().map(|file| file.path.clone()).collect();
    let sequence = only_sequence(found.files, "`meniscus tune` shows one frame of one sequence")?;
    if let Some(file) = sequence.frames.iter().find(|file| is_level_set(&file.path)) {
        bail!("{}: this is a level set, and tune needs particles", file.path.display());
    }
    let selected = selected_of(vec![sequence], args.frames.as_ref())?;
    let [SelectedSequence { sequence, selected }] = &selected[..] else { bail!("no frame was selected") };
    // The middle one of the selected frames.
    let frame = &selected[selected.len() / 2];
    let (file, session) =
        SheetFile::prepare(&args.output, &args.pictures, (args.size, &paths), Some(&CONVERTED), console)?;
    let pool = thread_pool(args.pictures.run.threads)?;
    let tuning = pool.install(|| Tuning::new(args, session, sequence, frame, console))?;
    let grid = Grid::new(args, &tuning.without)?;
    if sequence.frames.len() > 1 {
        let frame_count = pluralize(sequence.frames.len(), "frame");
        let (frame, name) = (frame.name(), &sequence.name);
        console.print_line(format_args!(
            "showing {frame}, one of {frame_count} of {name}; --frames selects another"
        ));
    }
    console.show_bar(grid.settings.len());
    let (cells, counts) = pool.install(|| tuning.cells(&grid, console));
    console.hide_bar();
    if counts.done_count > 0 {
        let part = tuning.made_from(&grid);
        console.print_line(file.write(&tuning.sheet(&grid, cells), "tune", &[part])?);
    }
    Ok(counts.outcome())
}

/// The formats that the printed commands write.
const CONVERTED: [OutputFormat; 2] = [OutputFormat::Glb, OutputFormat::Vdb];

/// The settings of the cells, row by row and block by block.
struct Grid {
    /// For each cell, its value on each axis.
    settings: Vec<Vec<SweepValue>>,
    axes: Vec<&'static Parameter>,
    columns: usize,
    /// The value of each block on the third axis; a single `None` if there are no blocks.
    blocks: Vec<Option<SweepValue>>,
}

impl Grid {
    fn new(args: &TuneArgs, without: &Settings) -> Result<Grid> {
        let varied = args.vary.values(without).map_err(anyhow::Error::msg)?;
        let axes = varied.iter().map(|(axis, _)| *axis).collect();
        let mut values = varied.into_iter().map(|(_, values)| values);
        let (rows, columns, blocks) = (values.next().unwrap_or_default(), values.next(), values.next());
        let count = |values: &Option<Vec<SweepValue>>| values.as_ref().map_or(1, Vec::len);
        let cell_count = rows.len() * count(&columns) * count(&blocks);
        if cell_count > CELLS_MAX {
            bail!("--vary makes {cell_count} cells; at most {CELLS_MAX} are shown: give fewer values");
        }
        refuse_large(cell_count, args.size, memory_bytes(args.pictures.run.memory)?)?;
        // An axis that is not varied has the single value `None`.
        let or_none = |values: Option<Vec<SweepValue>>| -> Vec<Option<SweepValue>> {
            values.map_or(vec![None], |values| values.into_iter().map(Some).collect())
        };
        let [across, blocks] = [&columns, &blocks].map(|values| or_none(values.clone()));
        let mut settings = Vec::new();
        for block in &blocks {
            for row in &rows {
                for column in &across {
                    settings.push([Some(*row), *column, *block].into_iter().flatten().collect());
                }
            }
        }
        let alone = if rows.len() <= ROW_MAX { rows.len() } else { even_columns(rows.len()) };
        let columns = columns.map_or(alone, |columns| columns.len());
        Ok(Grid { settings, axes, columns, blocks })
    }

    /// The meaning of rows, columns and blocks.
    fn meaning(&self) -> String {
        match &self.axes[..] {
            [axis] => format!("by {}", axis.meaning),
            [rows, columns, ..] => format!("rows: {}, columns: {}", rows.meaning, columns.meaning),
            [] => String::new(),
        }
    }
}

/// Maximum number of cells that can reasonably be compared.
const CELLS_MAX: usize = 100;

/// With a single axis, up to this many cells form one row; more are arranged in several rows.
const ROW_MAX: usize = 6;

/// A frame, and what all cells share.
struct Tuning<'a> {
    args: &'a TuneArgs,
    session: RenderSession<'a>,
    frame: LoadedFrame,
    /// The spacing measured on the frame's sequence.
    measured: Option<SequenceSpacing>,
    /// The settings without --vary.
    without: Settings,
    viewpoint: Viewpoint,
}

impl<'a> Tuning<'a> {
    fn new(
        args: &'a TuneArgs,
        session: RenderSession<'a>,
        sequence: &Sequence,
        file: &FrameFile,
        console: &Console,
    ) -> Result<Tuning<'a>> {
        let options = args.pictures.method.to_options();
        let measured = spacing_of(sequence, &args.vary.with_spacings(&options), console)?;
        let without = settings_of(sequence, &options, measured.as_ref())?;
        if measured.is_some() {
            warn_of_siblings(sequence, console);
        }
        let measured = measured.as_ref().map(SequenceSpacing::from);
        let frame = LoadedFrame::read((&file.path, file.number()), &without)?;
        let picture = session.outputs.picture;
        let bounds = bounds_of_particles(frame.particles(), without.radius_init).unwrap_or(EMPTY_BOUNDS);
        let viewpoint =
            |bounds| picture.camera.viewpoint(bounds, picture.aspect(), up_of(session.outputs.up));
        let whole = viewpoint(bounds);
        let viewpoint = match picture.camera == CameraChoice::default() {
            // If the user chose no camera, a close-up shows best how the settings differ.
            true => close_up(frame.particles(), without.spacing, whole.eye - whole.target)
                .map_or(whole, |part| Viewpoint { ground: whole.ground, ..viewpoint(part) }),
            false => whole,
        };
        Ok(Tuning { args, session, frame, measured, without, viewpoint })
    }

    /// Renders all cells, and collects the command of each cell with a picture.
    fn cells(&self, grid: &Grid, console: &mut Console) -> (Vec<(Cell, Option<CommandLine>)>, DoneCounts) {
        let (mut counts, mut reported) = (DoneCounts::default(), ReportedWarnings::default());
        let mut cells = Vec::new();
        for (index, values) in grid.settings.iter().enumerate() {
            let (number, options) = (index + 1, self.options(values));
            // Some settings are derived from others, so the label uses those of the cell.
            let settings = Settings::resolve(&options, self.measured);
            let label = self.label(number, values, settings.as_ref().unwrap_or(&self.without));
            let mut lines = vec![label.clone()];
            let (content, command) = match catch_panic(self.frame.path(), || self.rendered(&options)) {
                Ok((made, settings, picture)) => {
                    counts.add(true);
                    let of_settings = settings.warnings().into_iter().map(Warning::Sentence);
                    for warning in of_settings.chain(made.warnings.iter().cloned()) {
                        if reported.is_new(&warning) {
                            console.warning(format_args!("cell {number}: {}", with_remedy(&warning)));
                        }
                    }
                    let triangles = pluralize(made.surface.report.mesh.triangle_count, "triangle");
                    let command = CommandLine::convert(self.args, &options);
                    // The time differs from run to run, so it is not part of the picture.
                    let seconds = seconds(&made);
                    console.print_line(format_args!("{label}: {seconds:.2} s, {triangles}"));
                    console.print_line(command.text());
                    lines.push(triangles);
                    (CellPicture::Picture(picture), Some(command))
                }
                Err(error) => {
                    counts.add(false);
                    console.error(format_args!("cell {label}: {}", with_causes(&error)));
                    (CellPicture::Text(reason(&error, self.frame.path())), None)
                }
            };
            console.advance_bar();
            cells.push((Cell { content, lines }, command));
        }
        (cells, counts)
    }

    /// The options of a cell: the user's options with the varied ones replaced.
    fn options(&self, values: &[SweepValue]) -> MethodOptions {
        let mut options = self.args.pictures.method.to_options();
        values.iter().for_each(|value| value.put(&mut options, &self.without));
        options
    }

    fn rendered(&self, options: &MethodOptions) -> Result<(Reconstruction, Settings, Picture)> {
        let settings = Settings::resolve(options, self.measured)?;
        let made = self.session.reconstruct(&self.frame, &settings)?;
        let seen = (&self.viewpoint, self.session.outputs.picture.size);
        let picture = picture_of_reconstruction(&made, &settings, seen, false);
        Ok((made, settings, picture))
    }

    fn label(&self, number: usize, values: &[SweepValue], settings: &Settings) -> String {
        let labels: Vec<String> = values.iter().map(|value| value.label(settings)).collect();
        let is_without = values.iter().all(|value| value.is_without(&self.without));
        let without = match (is_without, self.args.pictures.method == MethodArgs::default()) {
            (false, _) => "",
            (true, true) => " (the defaults)",
            (true, false) => " (as typed)",
        };
        format!("{number}: {}{without}", labels.join(", "))
    }

    fn sheet(&self, grid: &Grid, cells: Vec<(Cell, Option<CommandLine>)>) -> Sheet {
        let particles = pluralize(self.frame.particles().len(), "particle");
        let title = format!("{}: {particles}; {}", self.name(), grid.meaning());
        let commands = cells.iter().enumerate().filter_map(|(index, (_, command))| {
            Some(format!("{}: {}", index + 1, command.as_ref()?.short_text()))
        });
        let footer = commands.collect();
        let mut cells: Vec<Cell> = cells.into_iter().map(|(cell, _)| cell).collect();
        let of_block = cells.len() / grid.blocks.len().max(1);
        let blocks = grid.blocks.iter().map(|value| {
            let rest = cells.split_off(of_block.min(cells.len()));
            let title = value.map_or(String::new(), |value| value.label(&self.without));
            CellGroup { title, cells: std::mem::replace(&mut cells, rest), columns: grid.columns }
        });
        Sheet { title, picture_size: self.args.size.map(usize::from), blocks: blocks.collect(), footer }
    }

    fn made_from(&self, grid: &Grid) -> SheetPart {
        let axes: Vec<&str> = grid.axes.iter().map(|axis| axis.name).collect();
        SheetPart {
            name: self.name(),
            hash: Some(self.frame.hash()),
            what: format!("{} by {}", pluralize(grid.settings.len(), "cell"), axes.join(", ")),
            settings: Some(self.without.clone()),
            options: Some(fixed(&self.session, self.viewpoint)),
        }
    }

    fn name(&self) -> String {
        self.frame.path().file_name().unwrap_or_default().to_string_lossy().into_owned()
    }
}

/// The computing time of a reconstruction, in seconds.
fn seconds(made: &Reconstruction) -> f64 {
    let seconds = &made.surface.report.seconds;
    seconds.rasterize + seconds.smooth + seconds.contour
}
