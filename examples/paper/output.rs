//! The output of an experiment: its tables, plots and pictures, as files that docs/results.md shows.

use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::process::Command;

use meniscus::render::{Cell, CellGroup, CellPicture, Picture, Sheet};
use meniscus_formats::{PictureView, png};
use plotters::prelude::*;

use crate::Outcome;

/// The files of an experiment: `<name>_<part>.csv`, `.svg` and `.png` in one folder.
pub(crate) struct Files {
    folder: PathBuf,
    name: &'static str,
}

impl Files {
    /// The files of the experiment `name`.
    pub(crate) fn new(folder: &Path, name: &'static str) -> Files {
        Files { folder: folder.to_owned(), name }
    }

    /// Writes a table, below a comment with the command and the machine. Each row has a cell for each column.
    pub(crate) fn table(&self, part: &str, columns: &[&str], rows: &[Vec<String>]) -> Outcome<()> {
        let quoted = |cell: &str| {
            if cell.contains([',', '"']) {
                format!("\"{}\"", cell.replace('"', "\"\""))
            } else {
                cell.to_owned()
            }
        };
        let head: Vec<String> = columns.iter().map(|column| quoted(column)).collect();
        let rows = rows.iter().map(|row| row.iter().map(|cell| quoted(cell)).collect());
        let lines: Vec<String> =
            [head].into_iter().chain(rows).map(|row: Vec<String>| row.join(",")).collect();
        let made = format!("cargo run --release -p paper -- {}: {}", self.name, conditions());
        Ok(fs::write(self.path(part, "csv"), format!("# {made}\n{}\n", lines.join("\n")))?)
    }

    /// Writes a plot.
    pub(crate) fn plot(&self, part: &str, plot: &Plot) -> Outcome<()> {
        plot.write(&self.path(part, "svg"))
    }

    /// Writes rows of pictures, each with a label, as one picture.
    pub(crate) fn pictures(&self, part: &str, rows: Vec<Vec<(Picture, String)>>) -> Outcome<()> {
        let picture_size = rows.iter().flatten().map(|(picture, _)| picture.size).next().unwrap_or([1, 1]);
        let columns = rows.iter().map(Vec::len).max().unwrap_or(1);
        let cell = |(picture, line)| Cell { content: CellPicture::Picture(picture), lines: vec![line] };
        let block = |row: Vec<_>| CellGroup {
            title: String::new(),
            cells: row.into_iter().map(cell).collect(),
            columns,
        };
        let blocks = rows.into_iter().map(block).collect();
        let sheet = Sheet { title: String::new(), picture_size, blocks, footer: Vec::new() }.picture();
        let mut out = BufWriter::new(File::create(self.path(part, "png"))?);
        let Picture { size, color, .. } = &sheet;
        png::write(
            &PictureView { size: *size, color, layers: &[], camera: None, provenance: &[] },
            &mut out,
        )?;
        Ok(())
    }

    fn path(&self, part: &str, extension: &str) -> PathBuf {
        self.folder.join(format!("{}_{part}.{extension}", self.name))
    }
}

/// The machine, the commit and its date.
fn conditions() -> String {
    let processors = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = processors.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    let model = model.map_or("a processor of unknown name", |(_, name)| name);
    let git = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).output();
        output.map_or(String::new(), |output| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let commit = git(&["log", "-1", "--format=commit %h of %cs"]);
    let commit = if commit.is_empty() { "no known commit" } else { &commit };
    let is_changed = !git(&["status", "--porcelain", "src", "formats", "examples"]).is_empty();
    let changes = if is_changed { ", and changes" } else { "" };
    format!("{model}, {} threads; {commit}{changes}", rayon::current_num_threads())
}

/// Curves in one coordinate system.
pub(crate) struct Plot {
    /// The title above the plot.
    pub(crate) title: String,
    /// The axis labels, with units.
    pub(crate) axes: [&'static str; 2],
    /// Which axes are logarithmic.
    pub(crate) is_log: [bool; 2],
    /// The curves: names, and points (x, y).
    pub(crate) curves: Vec<(String, Vec<[f64; 2]>)>,
}

const SIZE: (u32, u32) = (960, 420);

/// X position of the legend, to the right of the plot.
const NAMES_FROM: u32 = 750;

const NAME_HEIGHT: i32 = 22;

/// Dark enough on white, and distinguishable for colour-blind readers.
const COLORS: [RGBColor; 6] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(120, 120, 120),
    RGBColor(230, 159, 0),
];

impl Plot {
    fn write(&self, path: &Path) -> Outcome<()> {
        let area = SVGBackend::new(path, SIZE).into_drawing_area();
        area.fill(&WHITE)?;
        let (axes, names) = area.split_horizontally(NAMES_FROM);
        let [x, y] = [0, 1].map(|axis| self.range(axis));
        let mut chart = ChartBuilder::on(&axes)
            .caption(&self.title, ("sans-serif", 16))
            .margin(12)
            .x_label_area_size(42)
            .y_label_area_size(64)
            .build_cartesian_2d(x, y)?;
        // Logarithms are plotted, but the axis labels show the original values.
        let axis_label = |axis: usize| {
            move |value: &f64| if self.is_log[axis] { number(10f64.powf(*value)) } else { number(*value) }
        };
        chart
            .configure_mesh()
            .x_desc(self.axes[0])
            .y_desc(self.axes[1])
            .x_label_formatter(&axis_label(0))
            .y_label_formatter(&axis_label(1))
            .light_line_style(WHITE)
            .label_style(("sans-serif", 13))
            .draw()?;
        for (index, (name, points)) in self.curves.iter().enumerate() {
            let color = COLORS[index % COLORS.len()];
            let points = points.iter().map(|point| (self.scaled(point, 0), self.scaled(point, 1)));
            // 0 has no logarithm.
            let points = points.filter(|(x, y)| x.is_finite() && y.is_finite());
            chart.draw_series(LineSeries::new(points, color.stroke_width(2)))?;
            // The legend is outside of the axes, where no curve can hide it.
            let y = 60 + NAME_HEIGHT * index as i32;
            names.draw(&PathElement::new([(6, y), (24, y)], color.stroke_width(2)))?;
            names.draw(&Text::new(name.as_str(), (30, y - 7), ("sans-serif", 13)))?;
        }
        Ok(area.present()?)
    }

    fn scaled(&self, point: &[f64; 2], axis: usize) -> f64 {
        if self.is_log[axis] { point[axis].log10() } else { point[axis] }
    }

    /// The range of all points, with a margin.
    fn range(&self, axis: usize) -> std::ops::Range<f64> {
        let values = self.curves.iter().flat_map(|(_, points)| points).map(|point| self.scaled(point, axis));
        let (low, high) = values
            .filter(|value| value.is_finite())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
        let margin = if high > low { 0.04 * (high - low) } else { 1.0 };
        low - margin..high + margin
    }
}

fn number(value: f64) -> String {
    match value.abs() {
        0.0 => "0".into(),
        size if !(0.001..100_000.0).contains(&size) => format!("{value:.1e}"),
        size if size < 0.1 => format!("{value:.4}"),
        size if size < 10.0 => format!("{value:.2}"),
        size if size < 100.0 => format!("{value:.1}").trim_end_matches(".0").to_owned(),
        _ => format!("{value:.0}"),
    }
}
