//! `meniscus tune`: one frame under a grid of settings, for visual comparison.
//!
//! ```text
//!   INPUT ──▶ a frame, read once ──▶ settings without --vary ──▶ a camera for all
//!                                          │ --vary
//!                                          ▼
//!                         cells: options ──▶ surface ──▶ picture, label, command
//! ```
//!
//! A cell is a set of command options with some values replaced. Its settings and its printed command line
//! come from the same options, so they cannot differ.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::slice;
use std::str::FromStr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};
use meniscus_formats::{UpAxis, listed};

use crate::cli::args::{MethodArgs, OptionSet, TuneArgs};
use crate::cli::console::Console;
use crate::cli::inputs::{SelectedSequence, find_inputs, only_sequence, selected_of};
use crate::cli::machine::{memory_bytes, thread_pool, when_interrupted};
use crate::cli::render_session::{
    RenderSession, catch_panic, picture_of_reconstruction, spacing_of, surface_name,
};
use crate::cli::settings::warn_of_siblings;
use crate::cli::wording::{option_name, pluralize, with_causes};
use crate::cli::{CommandOutcome, DoneCounts};
use crate::pipeline::{
    AttributeRequest, CameraChoice, EMPTY_BOUNDS, FrameFile, LoadedFrame, OutputFormat, Reconstruction,
    ReportedWarnings, Sequence, SheetPart, Viewpoint, Warning, bounds_of_particles, close_up, up_of,
};
use crate::render::{Cell, CellGroup, CellPicture, Picture, Sheet};
use crate::surface::options::{MethodOptions, OptionInfo, SequenceSpacing, Settings, SpacingOptions};

use super::{SheetFile, even_columns, fixed, reason, refuse_large};

/// Shows one frame under the requested settings.
///
/// # Errors
/// If no cell can be attempted. A cell that fails is reported and counted.
pub(in crate::cli) fn tune(args: &TuneArgs, console: &mut Console) -> Result<CommandOutcome> {
    let grid = Grid::new(args)?;
    let found = find_inputs(&args.inputs, args.pictures.method.to_options().columns.as_ref())?;
    found.report(console);
    let paths: Vec<PathBuf> = found.files.iter().map(|file| file.path.clone()).collect();
    let sequence = only_sequence(found.files, "`meniscus tune` shows one frame of one sequence")?;
    let surface = sequence.frames.iter().find_map(|file| Some((file, surface_name(&file.path)?)));
    if let Some((file, name)) = surface {
        bail!(
            "{}: this is a {name}, and tune needs the particles that it was made from: `meniscus render` shows \
             a {name}",
            file.path.display()
        );
    }
    let selected = selected_of(vec![sequence], args.frames.as_ref())?;
    let [SelectedSequence { sequence, selected }] = &selected[..] else { bail!("no frame was selected") };
    // The middle one of the selected frames.
    let frame = &selected[selected.len() / 2];
    let (file, session) =
        SheetFile::prepare(&args.out, &args.pictures, args.size, &paths, Some(&CONVERTED), console)?;
    let pool = thread_pool(args.pictures.run.threads)?;
    let tuning = pool.install(|| Tuning::new(args, session, sequence, frame, &grid, console))?;
    if sequence.frames.len() > 1 {
        let frame_count = pluralize(sequence.frames.len(), "frame");
        let (frame, name) = (frame.name(), &sequence.name);
        console.print_line(format_args!(
            "showing {frame}, one of {frame_count} of {name}; --frames selects another"
        ));
    }
    console.show_bar(grid.cells.len());
    let part = tuning.made_from(&grid);
    let write = Arc::new(move |sheet: &Sheet| file.write(sheet, "tune", slice::from_ref(&part)));
    let sheet = Arc::new(Mutex::new(tuning.empty_sheet(&grid)));
    when_interrupted({
        let (sheet, write) = (Arc::clone(&sheet), Arc::clone(&write));
        move || {
            let sheet = lock(&sheet);
            if !sheet.footer.is_empty() {
                // The process exits, so a failure cannot be reported.
                let _ = write(&sheet);
            }
        }
    });
    let (counts, written) = pool.install(|| tuning.cells(&grid, &sheet, &*write, console))?;
    console.hide_bar();
    if let Some(written) = written {
        console.print_line(written);
    }
    Ok(counts.outcome())
}

/// The least time between two writes of the sheet: users open it while its cells are computed.
const BETWEEN_WRITES: Duration = Duration::from_secs(2);

/// Writing the sheet early takes at most one part in this of the time.
const WRITING_SHARE: u32 = 10;

/// The formats that the printed commands write.
const CONVERTED: [OutputFormat; 2] = [OutputFormat::Glb, OutputFormat::Vdb];

/// The cells, row by row.
struct Grid {
    /// The options that differ from row to row, and from column to column.
    axes: Vec<VariedOption>,
    cells: Vec<TunedCell>,
    columns: usize,
}

/// The options of a cell.
struct TunedCell {
    options: MethodOptions,
    /// For each axis, its value.
    values: Vec<String>,
}

impl Grid {
    fn new(args: &TuneArgs) -> Result<Grid> {
        let method = &args.pictures.method;
        let axes = axes(args)?;
        let cell_count: usize = axes.iter().map(|axis| axis.values.len()).product();
        if cell_count > CELLS_MAX {
            bail!("--vary makes {cell_count} cells; at most {CELLS_MAX} are shown: give fewer values");
        }
        refuse_large(cell_count, args.size, memory_bytes(args.pictures.run.memory)?)?;
        let mut cells = vec![TunedCell { options: method.to_options(), values: Vec::new() }];
        for axis in &axes {
            let with_value = |cell: &TunedCell, value: &String| {
                let (mut options, mut values) = (cell.options.clone(), cell.values.clone());
                axis.put(value, &mut options);
                values.push(value.clone());
                TunedCell { options, values }
            };
            let with_values = |cell: &TunedCell| -> Vec<TunedCell> {
                axis.values.iter().map(|value| with_value(cell, value)).collect()
            };
            cells = cells.iter().flat_map(with_values).collect();
        }
        for axis in &axes {
            let needed = |cell: &TunedCell| {
                let ineffective = cell.options.ineffective(!method.obstacle.is_empty());
                ineffective.into_iter().find(|(name, _)| *name == axis.name()).map(|(_, needed)| needed)
            };
            let needed: Option<Vec<_>> = cells.iter().map(needed).collect();
            if let Some(needed) = needed.as_ref().and_then(|needed| needed.first()) {
                let needed = listed(needed.iter().map(|option| option.flag()).collect(), "or");
                bail!("--vary {} has no effect without {needed}", axis.flag());
            }
        }
        let columns = match &axes[..] {
            [_, columns] => columns.values.len(),
            _ if cells.len() <= ROW_MAX => cells.len(),
            _ => even_columns(cells.len()),
        };
        Ok(Grid { axes, cells, columns })
    }

    /// The meaning of rows and columns.
    fn meaning(&self) -> String {
        match &self.axes[..] {
            [] => "the given settings".to_owned(),
            [axis] => format!("by {}", axis.flag()),
            [rows, columns, ..] => format!("rows: {}, columns: {}", rows.flag(), columns.flag()),
        }
    }

    /// The values of a cell, as text.
    fn label(&self, cell: &TunedCell) -> String {
        let labels =
            self.axes.iter().zip(&cell.values).map(|(axis, value)| format!("{} {value}", axis.flag()));
        labels.collect::<Vec<_>>().join(", ")
    }
}

/// The options to vary: at most two. By default, the first of [`DEFAULT`] that are not given, and suit the others.
fn axes(args: &TuneArgs) -> Result<Vec<VariedOption>> {
    let given = args.pictures.method.given();
    let is_given = |axis: &VariedOption| given.contains(&axis.name());
    if args.vary.is_empty() {
        let method = &args.pictures.method;
        let suits = |axis: &VariedOption| {
            axis.values.iter().all(|value| {
                let mut options = method.to_options();
                axis.put(value, &mut options);
                let ineffective = options.ineffective(!method.obstacle.is_empty());
                Settings::check(&options).is_ok() && !ineffective.iter().any(|(name, _)| *name == axis.name())
            })
        };
        let usual = DEFAULT.iter().map(|text| text.parse::<VariedOption>().map_err(anyhow::Error::msg));
        return usual
            .filter(|axis| axis.as_ref().ok().is_none_or(|axis| !is_given(axis) && suits(axis)))
            .take(2)
            .collect();
    }
    let axes = args.vary.clone();
    if axes.len() > 2 {
        bail!("--vary is given {} times, and a sheet varies at most two options", axes.len());
    }
    if let [one, other] = &axes[..]
        && one.name() == other.name()
    {
        bail!("--vary {}: give all values of an option in one --vary", one.flag());
    }
    match axes.iter().find(|axis| is_given(axis)) {
        Some(axis) => bail!("{} is given and varied: remove one of the two", option_name(axis.name())),
        None => Ok(axes),
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
    /// The frame, with the attributes that the settings without --vary require.
    frame: LoadedFrame,
    file: FrameFile,
    /// The settings without --vary.
    without: Settings,
    /// The settings of each cell.
    settings: Vec<Result<Settings>>,
    viewpoint: Viewpoint,
}

impl<'a> Tuning<'a> {
    fn new(
        args: &'a TuneArgs,
        session: RenderSession<'a>,
        sequence: &Sequence,
        file: &FrameFile,
        grid: &Grid,
        console: &Console,
    ) -> Result<Tuning<'a>> {
        let mut spacings = MeasuredSpacings { sequence, measured: Vec::new() };
        let options = args.pictures.method.to_options();
        let spacing = spacings.spacing(&options, console)?;
        let without = Settings::resolve(&options, spacing).with_context(|| sequence.name.clone())?;
        let settings_of = |TunedCell { options, .. }: &TunedCell| -> Result<Settings> {
            Ok(Settings::resolve(options, spacings.spacing(options, console)?)?)
        };
        let settings = grid.cells.iter().map(settings_of).collect();
        if !spacings.measured.is_empty() {
            warn_of_siblings(sequence, &options, console);
        }
        let frame = LoadedFrame::read(&file.path, file.number(), &without)?;
        let picture = session.outputs.picture;
        let bounds = bounds_of_particles(frame.particles(), without.radius_init).unwrap_or(EMPTY_BOUNDS);
        let viewpoint =
            |bounds| picture.camera.viewpoint(bounds, picture.aspect(), up_of(session.outputs.up));
        let whole = viewpoint(bounds);
        // If the user chose no camera, a close-up shows best how the settings differ.
        let part = (picture.camera == CameraChoice::default())
            .then(|| close_up(frame.particles(), without.spacing, whole.eye - whole.target))
            .flatten();
        let viewpoint = part.map_or(whole, |part| Viewpoint { ground: whole.ground, ..viewpoint(part) });
        Ok(Tuning { args, session, frame, file: file.clone(), without, settings, viewpoint })
    }

    /// Renders all cells, those with the largest voxels first, and writes the sheet now and then. Returns what the last
    /// write says, if any cell has a picture.
    fn cells(
        &self,
        grid: &Grid,
        sheet: &Mutex<Sheet>,
        write: &dyn Fn(&Sheet) -> Result<String>,
        console: &mut Console,
    ) -> Result<(DoneCounts, Option<String>)> {
        let (mut counts, mut reported) = (DoneCounts::default(), ReportedWarnings::default());
        let mut next_write: Option<Instant> = None;
        let mut commands = BTreeMap::new();
        let voxel_size = |index: usize| {
            self.settings[index].as_ref().map_or(f64::INFINITY, |settings| settings.voxel_size)
        };
        let mut order: Vec<usize> = (0..grid.cells.len()).collect();
        order.sort_by(|&one, &other| voxel_size(other).total_cmp(&voxel_size(one)));
        for (done_count, index) in order.into_iter().enumerate() {
            let (cell, settings, number) = (&grid.cells[index], &self.settings[index], index + 1);
            let label = self.label(number, &grid.label(cell), settings);
            let mut lines = vec![label.clone()];
            let rendered = match settings {
                Ok(settings) => catch_panic(self.frame.path(), || self.rendered(settings))
                    .map(|(made, picture)| (made, settings, picture)),
                Err(error) => Err(anyhow!(with_causes(error))),
            };
            counts.add(rendered.is_ok());
            let content = match rendered {
                Ok((made, settings, picture)) => {
                    let of_settings = settings.warnings().into_iter().map(Warning::new);
                    for warning in of_settings.chain(made.warnings.iter().cloned()) {
                        if reported.is_new(&warning) {
                            console.warning(format_args!("cell {number}: {warning}"));
                        }
                    }
                    let triangles = pluralize(made.surface.report.mesh.triangle_count, "triangle");
                    let command = CommandLine::convert(self.args, &cell.options);
                    // The time differs from run to run, so it is not part of the picture.
                    let seconds = made.seconds;
                    console.print_line(format_args!("{label}: {seconds:.2} s, {triangles}"));
                    console.print_line(command.text());
                    lines.push(triangles);
                    commands.insert(number, format!("{number}: {}", command.short_text()));
                    CellPicture::Picture(picture)
                }
                Err(error) => {
                    console.error(format_args!("cell {label}: {}", with_causes(&error)));
                    CellPicture::Text(reason(&error, self.frame.path()))
                }
            };
            console.advance_bar();
            let mut sheet = lock(sheet);
            sheet.blocks[0].cells[index] = Cell { content, lines };
            sheet.footer = commands.values().cloned().collect();
            let began = Instant::now();
            let is_due = next_write.is_none_or(|next| began >= next);
            if counts.done_count > 0 && is_due && done_count + 1 < grid.cells.len() {
                if let Err(error) = write(&sheet) {
                    // The first one shows whether it can be written at all.
                    if next_write.is_none() {
                        return Err(error);
                    }
                    console.warning(format_args!("the sheet is not written yet: {}", with_causes(&error)));
                }
                next_write = Some(Instant::now() + BETWEEN_WRITES.max(WRITING_SHARE * began.elapsed()));
            }
        }
        let written = (counts.done_count > 0).then(|| write(&lock(sheet))).transpose()?;
        Ok((counts, written))
    }

    fn rendered(&self, settings: &Settings) -> Result<(Reconstruction, Picture)> {
        let requests = [settings, &self.without].map(AttributeRequest::for_settings);
        let made = if requests[0] == requests[1] {
            self.session.reconstruct(&self.frame, settings)?
        } else {
            let frame = LoadedFrame::read(&self.file.path, self.file.number(), settings)?;
            self.session.reconstruct(&frame, settings)?
        };
        let size = self.session.outputs.picture.size;
        let picture = picture_of_reconstruction(&made, settings, &self.viewpoint, size, false);
        Ok((made, picture))
    }

    fn label(&self, number: usize, values: &str, settings: &Result<Settings>) -> String {
        let is_without = settings.as_ref().is_ok_and(|settings| *settings == self.without);
        let without = match (is_without, self.args.pictures.method == MethodArgs::default()) {
            (false, _) => "",
            (true, true) => " (the defaults)",
            (true, false) => " (without --vary)",
        };
        let label = format!("{values}{without}");
        format!("{number}: {}", label.trim_start())
    }

    /// The sheet before any cell is computed.
    fn empty_sheet(&self, grid: &Grid) -> Sheet {
        let particles = pluralize(self.frame.particles().len(), "particle");
        let title = format!("{}: {particles}; {}", self.name(), grid.meaning());
        let cell = |_| Cell { content: CellPicture::Text("not computed yet".to_owned()), lines: Vec::new() };
        let cells = grid.cells.iter().map(cell).collect();
        let blocks = vec![CellGroup { title: String::new(), cells, columns: grid.columns }];
        Sheet { title, picture_size: self.args.size.map(usize::from), blocks, footer: Vec::new() }
    }

    fn made_from(&self, grid: &Grid) -> SheetPart {
        let cells = pluralize(grid.cells.len(), "cell");
        SheetPart {
            name: self.name(),
            hash: Some(self.frame.hash()),
            what: format!("{cells}: {}", grid.meaning()),
            settings: Some(self.without.clone()),
            options: Some(fixed(&self.session, self.viewpoint)),
        }
    }

    fn name(&self) -> String {
        self.frame.path().file_name().unwrap_or_default().to_string_lossy().into_owned()
    }
}

fn lock(sheet: &Mutex<Sheet>) -> MutexGuard<'_, Sheet> {
    sheet.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The spacings of a sequence, each measured once.
struct MeasuredSpacings<'a> {
    sequence: &'a Sequence,
    measured: Vec<(SpacingOptions, Option<SequenceSpacing>)>,
}

impl MeasuredSpacings<'_> {
    /// The spacing that `convert` measures with these options; `None` if they need none.
    fn spacing(&mut self, options: &MethodOptions, console: &Console) -> Result<Option<SequenceSpacing>> {
        if !options.needs_measuring() {
            return Ok(None);
        }
        // `Settings::resolve` reports an invalid radius scale.
        let measured_with = options.spacing_options().unwrap_or_default();
        if let Some((_, spacing)) = self.measured.iter().find(|(of, _)| *of == measured_with) {
            return Ok(*spacing);
        }
        let measured = spacing_of(self.sequence, options, console)?;
        let spacing = measured.as_ref().map(SequenceSpacing::from);
        self.measured.push((measured_with, spacing));
        Ok(spacing)
    }
}

// An option that `meniscus tune` varies, with the values to show: `--vary preset=fluid,noisy,splash`.

/// An option and its values.
#[derive(Clone, Debug)]
pub(in crate::cli) struct VariedOption {
    info: &'static OptionInfo<MethodOptions>,
    /// At least one. The option accepts them.
    pub(super) values: Vec<String>,
}

/// What `tune` varies by itself: two of these.
const DEFAULT: [&str; 3] =
    ["position-smoothing=0,0.25,0.5,0.75", "blend=1.4d,1.7d,2.1d,2.6d", "laplacian-steps=1,4,15,40"];

impl VariedOption {
    /// The name of the option's field.
    pub(super) fn name(&self) -> &'static str {
        self.info.name
    }

    /// The option without the hyphens at its beginning.
    pub(super) fn flag(&self) -> String {
        flag(self.info)
    }

    /// Sets the option to one of the values.
    fn put(&self, value: &str, options: &mut MethodOptions) {
        let is_set = options.set(self.info.name, value);
        debug_assert!(is_set.is_ok(), "{} accepted {value} before", self.info.name);
    }
}

fn flag(info: &OptionInfo<MethodOptions>) -> String {
    option_name(info.name).trim_start_matches('-').to_owned()
}

impl FromStr for VariedOption {
    type Err = String;

    fn from_str(text: &str) -> Result<VariedOption, String> {
        let Some((name, values)) = text.split_once('=') else {
            return Err("expected an option and its values, such as blend=1.8d,2.1d,2.6d".to_owned());
        };
        let info = MethodOptions::ALL.iter().find(|info| flag(info) == name);
        let info = info.ok_or_else(|| format!("there is no option --{name} to vary"))?;
        let values: Vec<String> = values.split(',').map(|value| value.trim().to_owned()).collect();
        for value in &values {
            info.check(value).map_err(|why| format!("{name}: {why}"))?;
        }
        Ok(VariedOption { info, values })
    }
}

// The command line for a cell of a sheet of `meniscus tune`: it converts all frames of INPUT with the cell's
// options.

/// The words of a command, each quoted for the shell.
struct CommandLine {
    words: Vec<String>,
    /// The same words with abbreviated paths.
    short_words: Vec<String>,
}

impl CommandLine {
    /// The command that converts the inputs of `tune` with these options. The output folder, the obstacles
    /// and the up axis are those given to `tune`.
    pub(super) fn convert(
        TuneArgs { inputs, results, pictures, .. }: &TuneArgs,
        options: &MethodOptions,
    ) -> CommandLine {
        let mut line = CommandLine { words: Vec::new(), short_words: Vec::new() };
        line.add("meniscus");
        line.add("convert");
        inputs.iter().for_each(|input| line.add_path(input));
        line.add("--out");
        line.add_path(results);
        for (name, value) in options.to_pairs() {
            match name {
                "quads" if value == "true" => line.add("--quads"),
                // The value of this option is optional, so it must follow a =.
                "quads" => line.add(&format!("{}={value}", option_name(name))),
                _ => line.add_option(name, &value),
            }
        }
        for obstacle in &pictures.method.obstacle {
            line.add("--obstacle");
            line.add_path(obstacle);
        }
        if pictures.up == Some(UpAxis::Z) {
            line.add_option("up", "z");
        }
        line
    }

    /// The whole command.
    pub(super) fn text(&self) -> String {
        self.words.join(" ")
    }

    /// The command with abbreviated paths.
    fn short_text(&self) -> String {
        self.short_words.join(" ")
    }

    fn add(&mut self, word: &str) {
        self.words.push(quoted(word));
        self.short_words.push(quoted(word));
    }

    fn add_option(&mut self, name: &str, value: &str) {
        let option = option_name(name);
        // A value that begins with a hyphen must follow a =.
        if value.starts_with('-') {
            return self.add(&format!("{option}={value}"));
        }
        self.add(&option);
        self.add(value);
    }

    fn add_path(&mut self, path: &Path) {
        let text = path.to_string_lossy();
        // A path that begins with a hyphen needs a leading `./`.
        let text = if text.starts_with('-') { format!("./{text}") } else { text.into_owned() };
        self.words.push(quoted(&text));
        self.short_words.push(quoted(&abbreviated(&text, path)));
    }
}

/// A path, abbreviated to its last component if it is long.
fn abbreviated(text: &str, path: &Path) -> String {
    match path.file_name() {
        Some(name) if text.chars().count() > PATH_LETTERS => format!(".../{}", name.to_string_lossy()),
        _ => text.to_owned(),
    }
}

/// Paths with more characters are abbreviated on sheets.
const PATH_LETTERS: usize = 40;

/// Quotes a word for the shell.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "-_./,:=+%@".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    use crate::cli::args::{Cli, Command};

    #[test]
    fn option_is_varied_by_its_own_name() {
        let varied: VariedOption = "blend=1.8d, 2d".parse().expect("lengths");
        let mut options = MethodOptions::default();
        varied.put(&varied.values[1], &mut options);
        assert_eq!(options.to_pairs(), [("blend", "2d".to_owned())]);
        for text in DEFAULT {
            assert_eq!(text.parse::<VariedOption>().map(|varied| varied.values.len()), Ok(4));
        }
    }

    #[test]
    fn errors_name_the_option_and_the_expected_values() {
        for (text, expected) in [
            ("", "such as blend=1.8d,2.1d,2.6d"),
            ("2,3", "such as blend=1.8d,2.1d,2.6d"),
            ("q=2", "there is no option --q to vary"),
            ("voxel_size=1", "there is no option --voxel_size to vary"),
            ("radius-ratio=", "radius-ratio: `` is not a number"),
            ("steps=1,2.5", "steps: `2.5` is not a whole number"),
            ("voxel-size=2h", "voxel-size: `2h` is not a voxel size"),
            ("preset=fluid,sea", "preset: `sea` is unknown: expected one of fluid"),
            ("clip=0,0,0,1,1,1", "clip: `0` is not a box"),
        ] {
            let error = text.parse::<VariedOption>().expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
    }

    #[test]
    fn words_are_quoted_for_the_shell() {
        for (word, expected) in [
            ("dam.0012.bgeo", "dam.0012.bgeo"),
            ("dam.####.bgeo", "'dam.####.bgeo'"),
            ("a b", "'a b'"),
            ("it's", r"'it'\''s'"),
            ("", "''"),
            ("größe.ply", "größe.ply"),
        ] {
            assert_eq!(quoted(word), expected);
        }
    }

    #[test]
    fn long_paths_are_abbreviated_on_sheets_only() {
        let long = "a/long/way/to/somewhere/that/nobody/knows/dam.####.bgeo";
        let typed = ["meniscus", "tune", long, "./-x.ply", "-o=s.png", "--results=my meshes", "--up=z"];
        let Command::Tune(args) = Cli::parse_from(typed).command else { panic!("another command") };
        let line = CommandLine::convert(
            &TuneArgs { inputs: vec![long.into(), "-x.ply".into()], ..*args },
            &MethodOptions {
                radius_ratio: Some(1.5),
                smooth_normals: Some(3),
                clip: "-1,0,0,1,1,1".parse().ok(),
                ..MethodOptions::default()
            },
        );
        let options = "--radius-ratio 1.5 --clip=-1,0,0,1,1,1 --smooth-normals 3 --up z";
        assert_eq!(line.text(), format!("meniscus convert '{long}' ./-x.ply --out 'my meshes' {options}"));
        let short = format!("meniscus convert '.../dam.####.bgeo' ./-x.ply --out 'my meshes' {options}");
        assert_eq!(line.short_text(), short);
    }
}
