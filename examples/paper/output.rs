//! The output of an experiment: a page with its tables, plots and pictures.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::process::Command;

use meniscus::render::{Cell, CellGroup, CellPicture, Picture, Sheet};
use meniscus_formats::{PictureView, png};
use plotters::prelude::*;

use crate::Outcome;

/// A page that is being written.
pub(crate) struct Page {
    folder: PathBuf,
    name: &'static str,
    text: String,
}

impl Page {
    /// An empty page.
    pub(crate) fn new(folder: &Path, name: &'static str, title: &str) -> Page {
        Page { folder: folder.to_owned(), name, text: format!("# {title}\n") }
    }

    /// Adds a paragraph.
    pub(crate) fn paragraph(&mut self, text: &str) {
        let _ = write!(self.text, "\n{text}\n");
    }

    /// Adds a table. Each row has a cell for each column.
    pub(crate) fn table(&mut self, columns: &[&str], rows: &[Vec<String>]) {
        self.text.push('\n');
        let mut line = |cells: &mut dyn Iterator<Item = &str>| {
            self.text.push('|');
            cells.for_each(|cell| {
                let _ = write!(self.text, " {cell} |");
            });
            self.text.push('\n');
        };
        line(&mut columns.iter().copied());
        line(&mut columns.iter().map(|_| "---"));
        rows.iter().for_each(|row| line(&mut row.iter().map(String::as_str)));
    }

    /// Writes a plot and adds a link to it.
    pub(crate) fn plot(&mut self, part: &str, plot: &Plot) -> Outcome<()> {
        let file = format!("{}_{part}.svg", self.name);
        plot.write(&self.folder.join(&file))?;
        self.paragraph(&format!("![{}]({file})", plot.title));
        Ok(())
    }

    /// Writes pictures in rows, each with its caption, and adds a link.
    pub(crate) fn pictures(
        &mut self,
        part: &str,
        caption: &str,
        rows: Vec<Vec<(Picture, String)>>,
    ) -> Outcome<()> {
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
        let file = format!("{}_{part}.png", self.name);
        let mut out = BufWriter::new(File::create(self.folder.join(&file))?);
        let Picture { size, color, .. } = &sheet;
        png::write(
            &PictureView { size: *size, color, layers: &[], camera: None, provenance: &[] },
            &mut out,
        )?;
        self.paragraph(&format!("![{caption}]({file})"));
        Ok(())
    }

    /// Writes the page.
    pub(crate) fn finish(mut self) -> Outcome<()> {
        self.paragraph(&format!(
            "Made by `cargo run --release -p paper -- {}`: {}.",
            self.name,
            conditions()
        ));
        Ok(fs::write(self.folder.join(format!("{}.md", self.name)), self.text)?)
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
