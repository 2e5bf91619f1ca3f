//! Contact sheets: many pictures on one sheet, with text.
//!
//! ```text
//!   dam: 60 of 240 frames
//!   ┌──────┐ ┌──────┐ ┌──────┐
//!   │      │ │      │ │ why  │      a group: cells in rows; a cell without a picture
//!   └──────┘ └──────┘ │ not  │      contains text that says why
//!   dam.0001 dam.0002 └──────┘
//!   1.2 s    1.3 s    dam.0003
//!
//!   1  meniscus convert …           the footer, wrapped at the width of the sheet
//! ```
//!
//! Long lines are wrapped. Only the text in place of a picture is cut if it is too long for the picture area.

use std::convert::Infallible;

use embedded_graphics::mono_font::iso_8859_1::{FONT_7X13, FONT_9X18_BOLD};
use embedded_graphics::mono_font::{MonoFont, MonoTextStyle};
use embedded_graphics::pixelcolor::BinaryColor;
use embedded_graphics::prelude::{DrawTarget, Drawable, OriginDimensions, Pixel, Point, Size};
use embedded_graphics::text::{Baseline, Text};

use crate::Picture;

/// A sheet to draw.
#[derive(Clone, Debug)]
pub struct Sheet {
    /// Text at the top of the sheet; may be empty.
    pub title: String,
    /// Width and height of a cell's picture area, pixels. No picture is larger.
    pub picture_size: [usize; 2],
    /// The groups, from top to bottom.
    pub blocks: Vec<CellGroup>,
    /// Paragraphs at the bottom of the sheet.
    pub footer: Vec<String>,
}

/// A group of cells.
#[derive(Clone, Debug)]
pub struct CellGroup {
    /// Text above the cells; may be empty.
    pub title: String,
    /// The cells, row by row.
    pub cells: Vec<Cell>,
    /// Number of cells per row.
    pub columns: usize,
}

/// A cell of a sheet, with the text below it.
#[derive(Clone, Debug)]
pub struct Cell {
    /// The contents of the picture area.
    pub content: CellPicture,
    /// Lines of text, from the top.
    pub lines: Vec<String>,
}

/// The contents of a cell's picture area.
#[derive(Clone, Debug)]
pub enum CellPicture {
    /// A picture.
    Picture(Picture),
    /// Text instead of a picture: the reason why the picture is missing.
    Text(String),
}

impl Sheet {
    /// Draws the sheet.
    pub fn picture(&self) -> Picture {
        let width = self.width();
        let title = TextLines::new(&self.title, &HEADING, width);
        let footer: Vec<TextLines> =
            self.footer.iter().map(|text| TextLines::new(text, &TEXT, width)).collect();
        let heights = self.blocks.iter().map(|block| self.block_height(block, width)).sum::<usize>();
        let foot_height: usize = footer.iter().map(TextLines::height).sum();
        let height = GAP + title.height_with_gap() + heights + foot_height;
        let foot_gap = if footer.is_empty() { 0 } else { GAP };
        let mut canvas = Canvas::new([width + 2 * GAP, height + foot_gap]);
        let mut top = GAP;
        canvas.write(&title, [GAP, top]);
        top += title.height_with_gap();
        for block in &self.blocks {
            self.draw(block, width, &mut canvas, top);
            top += self.block_height(block, width);
        }
        for words in &footer {
            canvas.write(words, [GAP, top]);
            top += words.height();
        }
        canvas.picture
    }

    /// Width between the margins, pixels.
    fn width(&self) -> usize {
        let columns = self.blocks.iter().map(|block| block.columns.min(block.cells.len())).max();
        let of_cells = columns.unwrap_or(0) * (self.picture_size[0] + GAP);
        let least = if self.footer.is_empty() { MIN_WIDTH } else { MIN_WIDTH_WITH_FOOTER };
        of_cells.saturating_sub(GAP).max(least)
    }

    fn block_height(&self, block: &CellGroup, width: usize) -> usize {
        let title = TextLines::new(&block.title, &TEXT, width);
        let rows = block.cells.len().div_ceil(block.columns.max(1));
        title.height_with_gap() + rows * self.row_height(block)
    }

    fn row_height(&self, block: &CellGroup) -> usize {
        let of_lines = |cell: &Cell| cell.lines.iter().map(|line| self.label(line).height()).sum::<usize>();
        self.picture_size[1] + LABEL_GAP + block.cells.iter().map(of_lines).max().unwrap_or(0) + GAP
    }

    fn label(&self, line: &str) -> TextLines<'_> {
        TextLines::new(line, &TEXT, self.picture_size[0])
    }

    fn draw(&self, block: &CellGroup, width: usize, canvas: &mut Canvas, mut top: usize) {
        let title = TextLines::new(&block.title, &TEXT, width);
        canvas.write(&title, [GAP, top]);
        top += title.height_with_gap();
        let [place_width, place_height] = self.picture_size;
        let row_height = self.row_height(block);
        for (index, cell) in block.cells.iter().enumerate() {
            let (row, column) = (index / block.columns.max(1), index % block.columns.max(1));
            let left = GAP + column * (place_width + GAP);
            let cell_top = top + row * row_height;
            match &cell.content {
                CellPicture::Picture(picture) => {
                    let [x, y] =
                        [0, 1].map(|axis| self.picture_size[axis].saturating_sub(picture.size[axis]) / 2);
                    canvas.paste(picture, [left + x, cell_top + y]);
                }
                CellPicture::Text(words) => {
                    canvas.fill(EMPTY, [left, cell_top], self.picture_size);
                    let available = self.picture_size.map(|edge| edge.saturating_sub(2 * GAP));
                    let words = TextLines::new(words, &TEXT, available[0]).within(available[1]);
                    canvas.write(&words, [left + GAP, cell_top + GAP]);
                }
            }
            let mut line_top = cell_top + place_height + LABEL_GAP;
            for words in cell.lines.iter().map(|line| self.label(line)) {
                canvas.write(&words, [left, line_top]);
                line_top += words.height();
            }
        }
    }
}

/// Places pictures of the same height side by side, from the left.
pub fn side_by_side(pictures: &[Picture]) -> Picture {
    let width = pictures.iter().map(|picture| picture.size[0]).sum();
    let height = pictures.iter().map(|picture| picture.size[1]).max().unwrap_or(0);
    let mut canvas = Canvas::new([width, height]);
    let mut left = 0;
    for picture in pictures {
        canvas.paste(picture, [left, 0]);
        left += picture.size[0];
    }
    canvas.picture
}

/// Stacks pictures of the same width, from the top.
pub fn stacked(pictures: &[Picture]) -> Picture {
    let width = pictures.iter().map(|picture| picture.size[0]).max().unwrap_or(0);
    let height = pictures.iter().map(|picture| picture.size[1]).sum();
    let mut canvas = Canvas::new([width, height]);
    let mut top = 0;
    for picture in pictures {
        canvas.paste(picture, [0, top]);
        top += picture.size[1];
    }
    canvas.picture
}

/// A font with its line height.
struct TextStyle {
    font: MonoFont<'static>,
    /// Distance from one line to the next, pixels.
    line_height: usize,
}

const TEXT: TextStyle = TextStyle { font: FONT_7X13, line_height: 15 };
const HEADING: TextStyle = TextStyle { font: FONT_9X18_BOLD, line_height: 22 };

/// Wrapped text.
struct TextLines<'h> {
    style: &'h TextStyle,
    lines: Vec<String>,
}

impl<'h> TextLines<'h> {
    /// Wraps text at a width in pixels.
    pub(super) fn new(text: &str, style: &'h TextStyle, width: usize) -> TextLines<'h> {
        let letters = width / style.font.character_size.width as usize;
        TextLines { style, lines: wrapped(text, letters.max(1)) }
    }

    fn height(&self) -> usize {
        self.lines.len() * self.style.line_height
    }

    /// The height including the gap below; 0 without text.
    fn height_with_gap(&self) -> usize {
        if self.lines.is_empty() { 0 } else { self.height() + GAP }
    }

    /// Cuts the text to a height in pixels. Dots mark the cut.
    fn within(mut self, height: usize) -> TextLines<'h> {
        let line_count = height / self.style.line_height;
        if self.lines.len() > line_count {
            self.lines.truncate(line_count);
            if let Some(last) = self.lines.last_mut() {
                let kept = last.chars().count().saturating_sub(DOTS.len());
                *last = last.chars().take(kept).chain(DOTS.chars()).collect();
            }
        }
        self
    }
}

const DOTS: &str = "...";

/// Wraps text at `letters` characters per line, between words if possible.
fn wrapped(text: &str, letters: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    let mut line_letters = 0;
    for word in text.split_whitespace() {
        let word: Vec<char> = word.chars().collect();
        match lines.last_mut() {
            Some(line) if line_letters + 1 + word.len() <= letters => {
                line.push(' ');
                line.extend(&word);
                line_letters += 1 + word.len();
            }
            _ => {
                for piece in word.chunks(letters) {
                    lines.push(piece.iter().collect());
                    line_letters = piece.len();
                }
            }
        }
    }
    lines
}

/// Gap between cells, and around them, pixels.
const GAP: usize = 10;
/// Gap between a picture and the text below it, pixels.
const LABEL_GAP: usize = 3;
/// Smallest width of a sheet, pixels: leaves room for titles.
const MIN_WIDTH: usize = 240;
/// Smallest width of a sheet with a footer, pixels: leaves room for commands.
const MIN_WIDTH_WITH_FOOTER: usize = 720;

/// The colours of the background, of a picture area without a picture, and of text; linear.
const PAPER: [f32; 3] = [0.87, 0.88, 0.9];
const EMPTY: [f32; 3] = [0.68, 0.69, 0.71];
const INK: [f32; 3] = [0.03, 0.04, 0.05];

/// A picture to draw on.
struct Canvas {
    pub(super) picture: Picture,
}

impl Canvas {
    pub(super) fn new(size: [usize; 2]) -> Canvas {
        let count = size[0] * size[1];
        let (color, coverage) = (vec![PAPER; count], vec![0.0; count]);
        Canvas { picture: Picture { size, color, coverage, data: None } }
    }

    fn paste(&mut self, picture: &Picture, [left, top]: [usize; 2]) {
        let [width, height] = picture.size;
        for row in 0..height {
            let (from, to) = (row * width, (top + row) * self.picture.size[0] + left);
            self.picture.color[to..to + width].copy_from_slice(&picture.color[from..from + width]);
            self.picture.coverage[to..to + width].copy_from_slice(&picture.coverage[from..from + width]);
        }
    }

    pub(super) fn fill(&mut self, color: [f32; 3], [left, top]: [usize; 2], [width, height]: [usize; 2]) {
        for row in top..top + height {
            let first = row * self.picture.size[0] + left;
            self.picture.color[first..first + width].fill(color);
        }
    }

    /// Writes lines of text. The upper left corner of the text is at this pixel.
    fn write(&mut self, words: &TextLines, [left, top]: [usize; 2]) {
        let style = MonoTextStyle::new(&words.style.font, BinaryColor::On);
        for (index, line) in words.lines.iter().enumerate() {
            let picture_size = Point::new(left as i32, (top + index * words.style.line_height) as i32);
            let Ok(_) = Text::with_baseline(line, picture_size, style, Baseline::Top).draw(self);
        }
    }
}

impl OriginDimensions for Canvas {
    fn size(&self) -> Size {
        Size::new(self.picture.size[0] as u32, self.picture.size[1] as u32)
    }
}

impl DrawTarget for Canvas {
    type Color = BinaryColor;
    type Error = Infallible;

    fn draw_iter<I: IntoIterator<Item = Pixel<BinaryColor>>>(&mut self, pixels: I) -> Result<(), Infallible> {
        let [width, height] = self.picture.size;
        for Pixel(picture_size, color) in pixels {
            let (Ok(x), Ok(y)) = (usize::try_from(picture_size.x), usize::try_from(picture_size.y)) else {
                continue;
            };
            if color.is_on() && x < width && y < height {
                self.picture.color[y * width + x] = INK;
            }
        }
        Ok(())
    }
}

// A line plot of numbers over frames, with a logarithmic scale.
//
//   0.1  |         _
//        |  __/\__/ \     a line from frame to frame; it breaks where frames are missing
//   0.01 |_/         \_
//        +------------------
//         1       50     100

/// A plot of one or more lines.
#[derive(Clone, Debug)]
pub struct Plot {
    /// Width and height, pixels; each edge at least 160.
    pub size: [usize; 2],
    /// Points farther apart than this along x are not connected.
    pub step: f64,
    /// The lines, in drawing order: later lines cover earlier ones.
    pub lines: Vec<Line>,
}

/// A line of a plot.
#[derive(Clone, Debug)]
pub struct Line {
    /// Its name in the legend.
    pub name: String,
    /// Linear colour with the primaries of sRGB.
    pub color: [f32; 3],
    /// x and y, with ascending x. A point whose y is not positive is drawn at the lower edge.
    pub points: Vec<[f64; 2]>,
}

const GROUND: [f32; 3] = [0.97, 0.97, 0.98];
const RULE: [f32; 3] = [0.74, 0.75, 0.77];

/// Margins of the plot area, pixels. They hold the scale on the left, the legend above, and the frame numbers
/// below.
const LEFT: usize = 64;
const TOP: usize = 24;
const RIGHT: usize = 12;
const BOTTOM: usize = 24;

/// Edge of the squares that a line is drawn with, pixels.
const THICKNESS: usize = 2;

/// Smallest distance between labels along x, pixels.
const LABEL_PIXELS: f64 = 60.0;

/// Smallest and largest number of decades (powers of ten) on the scale.
const DECADES: [i32; 2] = [1, 5];

impl Plot {
    /// Draws the plot.
    pub fn picture(&self) -> Picture {
        let area = Area::new(self);
        let mut canvas = Canvas::new(self.size);
        canvas.fill(GROUND, [LEFT, TOP], area.size);
        for decade in area.decades[0]..=area.decades[1] {
            let y = area.y(10f64.powi(decade));
            canvas.fill(RULE, [LEFT, y], [area.size[0], 1]);
            write(&mut canvas, &format!("{:>7}", 10f64.powi(decade)), [4, y.saturating_sub(7)]);
        }
        for number in area.labels() {
            let x = area.x(number);
            canvas.fill(RULE, [x, TOP], [1, area.size[1]]);
            let text = number.to_string();
            write(&mut canvas, &text, [x.saturating_sub(7 * text.len() / 2), TOP + area.size[1] + 4]);
        }
        let mut left = LEFT;
        for line in &self.lines {
            area.draw(line, self.step, &mut canvas);
            canvas.fill(line.color, [left, 8], [14, 8]);
            write(&mut canvas, &line.name, [left + 20, 4]);
            left += 20 + 7 * (line.name.len() + 3);
        }
        canvas.picture
    }
}

fn write(canvas: &mut Canvas, text: &str, position: [usize; 2]) {
    canvas.write(&TextLines::new(text, &TEXT, usize::MAX), position);
}

/// The plot area.
struct Area {
    size: [usize; 2],
    /// Range along x.
    range: [f64; 2],
    /// Exponents of ten at the lower and the upper edge.
    decades: [i32; 2],
}

impl Area {
    fn new(plot: &Plot) -> Area {
        let points = || plot.lines.iter().flat_map(|line| &line.points);
        let size = [plot.size[0].saturating_sub(LEFT + RIGHT), plot.size[1].saturating_sub(TOP + BOTTOM)];
        let (mut range, mut values) = ([f64::INFINITY, f64::NEG_INFINITY], [f64::INFINITY, 0.0]);
        for &[x, y] in points() {
            range = [range[0].min(x), range[1].max(x)];
            if y > 0.0 && y.is_finite() {
                values = [f64::min(values[0], y), f64::max(values[1], y)];
            }
        }
        if range[0] > range[1] {
            range = [0.0, 1.0];
        }
        if values[1] == 0.0 {
            values = [0.1, 1.0];
        }
        let highest = values[1].log10().ceil() as i32;
        let lowest = (values[0].log10().floor() as i32).clamp(highest - DECADES[1], highest - DECADES[0]);
        Area { size, range, decades: [lowest, highest] }
    }

    /// Converts x to a pixel column.
    fn x(&self, x: f64) -> usize {
        let width = self.range[1] - self.range[0];
        // A single frame is drawn in the middle.
        let part = if width > 0.0 { (x - self.range[0]) / width } else { 0.5 };
        LEFT + (part * self.size[0].saturating_sub(THICKNESS) as f64).round() as usize
    }

    /// Converts a value to a pixel row, from the top.
    fn y(&self, value: f64) -> usize {
        let [lowest, highest] = self.decades.map(f64::from);
        let exponent = if value > 0.0 { value.log10().clamp(lowest, highest) } else { lowest };
        let part = (highest - exponent) / (highest - lowest);
        TOP + (part * self.size[1].saturating_sub(THICKNESS) as f64).round() as usize
    }

    /// Integers along x for the labels: multiples of 1, 2 or 5 times a power of ten.
    fn labels(&self) -> Vec<f64> {
        let most = (self.size[0] as f64 / LABEL_PIXELS).max(1.0);
        let least_step = ((self.range[1] - self.range[0]) / most).max(1.0);
        let power = 10f64.powf(least_step.log10().floor());
        let step =
            [1.0, 2.0, 5.0, 10.0].map(|part| part * power).into_iter().find(|&step| step >= least_step);
        let step = step.unwrap_or(least_step);
        let (first, last) = ((self.range[0] / step).ceil(), (self.range[1] / step).floor());
        let count = if first <= last { (last - first) as usize + 1 } else { 0 };
        (0..count).map(|index| (first + index as f64) * step).collect()
    }

    fn draw(&self, line: &Line, step: f64, canvas: &mut Canvas) {
        let position = |&[x, y]: &[f64; 2]| [self.x(x), self.y(y)];
        let mut dot = |[x, y]: [usize; 2]| canvas.fill(line.color, [x, y], [THICKNESS; 2]);
        line.points.iter().map(position).for_each(&mut dot);
        for pair in line.points.windows(2).filter(|pair| pair[1][0] - pair[0][0] <= step) {
            let ends = [&pair[0], &pair[1]].map(|point| position(point).map(|along| along as f64));
            let length = (0..2).map(|axis| (ends[1][axis] - ends[0][axis]).abs()).fold(1.0, f64::max);
            for index in 0..=length as usize {
                let part = index as f64 / length;
                dot([0, 1]
                    .map(|axis| (ends[0][axis] + part * (ends[1][axis] - ends[0][axis])).round() as usize));
            }
        }
    }
}

// Scales a picture down.
//
// Each pixel of the result is the mean of the original pixels that it covers, weighted by the covered area.
// No pixel is skipped, so filaments and drops stay visible.

impl Picture {
    /// Scales the picture down to fit into `limit` (width and height, pixels), with the same aspect ratio.
    /// Keeps the size of a picture that fits. The result has no [`data`](Picture::data).
    pub fn scaled_to_fit(&self, limit: [usize; 2]) -> Picture {
        let scale = [0, 1].map(|axis| limit[axis] as f64 / self.size[axis].max(1) as f64);
        let scale = scale[0].min(scale[1]);
        if scale >= 1.0 {
            return Picture { data: None, ..self.clone() };
        }
        let size: [usize; 2] = [0, 1]
            .map(|axis| ((self.size[axis] as f64 * scale).round() as usize).clamp(1, limit[axis].max(1)));
        let [across, down] = [0, 1].map(|axis| shares(self.size[axis], size[axis]));
        let mut shrunk = Picture { size, color: Vec::new(), coverage: Vec::new(), data: None };
        for rows in &down {
            for columns in &across {
                let (color, coverage) = self.mean(columns, rows);
                shrunk.color.push(color);
                shrunk.coverage.push(coverage);
            }
        }
        shrunk
    }

    fn mean(&self, columns: &[(usize, f32)], rows: &[(usize, f32)]) -> ([f32; 3], f32) {
        let (mut color, mut coverage, mut whole) = ([0.0; 3], 0.0, 0.0);
        for &(y, of_row) in rows {
            for &(x, of_column) in columns {
                let (pixel, share) = (y * self.size[0] + x, of_row * of_column);
                (0..3).for_each(|channel| color[channel] += share * self.color[pixel][channel]);
                coverage += share * self.coverage[pixel];
                whole += share;
            }
        }
        (color.map(|sum| sum / whole), coverage / whole)
    }
}

/// For each of `to` pixels, the `from` pixels that it covers, with the covered fraction.
fn shares(from: usize, to: usize) -> Vec<Vec<(usize, f32)>> {
    let step = from as f64 / to as f64;
    let of_pixel = |index: usize| {
        let (start, end) = (index as f64 * step, (index + 1) as f64 * step);
        let last = (end.ceil() as usize).min(from);
        let share = |pixel: usize| (end.min((pixel + 1) as f64) - start.max(pixel as f64)) as f32;
        let shares = (start as usize..last).map(|pixel| (pixel, share(pixel)));
        shares.filter(|(_, share)| *share > 0.0).collect()
    };
    (0..to).map(of_pixel).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plain(size: [usize; 2], value: f32) -> Picture {
        let count = size[0] * size[1];
        Picture { size, color: vec![[value; 3]; count], coverage: vec![1.0; count], data: None }
    }

    fn cell(value: f32, line: &str) -> Cell {
        Cell { content: CellPicture::Picture(plain([140, 20], value)), lines: vec![line.into()] }
    }

    /// The number of pixels with ink in these rows, from column `left` on.
    fn inked(sheet: &Picture, rows: std::ops::Range<usize>, left: usize) -> usize {
        let width = sheet.size[0];
        let row = |y: usize| &sheet.color[y * width + left..(y + 1) * width];
        rows.flat_map(row).filter(|&&color| color == INK).count()
    }

    #[test]
    fn cells_are_laid_out_in_rows_with_their_lines_below() {
        let words = Cell { content: CellPicture::Text("why not".into()), lines: vec!["third".into()] };
        let block = CellGroup {
            title: String::new(),
            cells: vec![cell(0.1, "a"), cell(0.2, "b"), words],
            columns: 2,
        };
        let sheet =
            Sheet { title: "three".into(), picture_size: [140, 40], blocks: vec![block], footer: Vec::new() };
        let drawn = sheet.picture();
        let (head, row) = (10 + 22 + 10, 40 + 3 + 15 + 10);
        assert_eq!(drawn.size, [10 + 2 * 150, head + 2 * row]);
        let at = |x: usize, y: usize| drawn.color[y * drawn.size[0] + x];
        // A picture smaller than its area is centred in it.
        assert_eq!((at(10, head + 9), at(10, head + 10), at(160, head + 10)), (PAPER, [0.1; 3], [0.2; 3]));
        assert_eq!((at(155, head + 10), at(10, head + row)), (PAPER, EMPTY));
        assert!(inked(&drawn, 10..32, 0) > 40, "the title is written");
        assert!(inked(&drawn, head + 43..head + 58, 0) > 20, "lines are written");
        assert!(inked(&drawn, head + row..head + row + 40, 0) > 40, "words are written");
        assert_eq!(inked(&drawn, head..head + 40, 0), 0);
    }

    #[test]
    fn long_lines_are_wrapped() {
        let sheet = |line: &str, footer: &[&str]| Sheet {
            title: String::new(),
            picture_size: [140, 20],
            blocks: vec![CellGroup { title: String::new(), cells: vec![cell(0.5, line)], columns: 3 }],
            footer: footer.iter().map(|&text| text.to_owned()).collect(),
        };
        let [short, long] = ["short", "three words and a few more"].map(|line| sheet(line, &[]).picture());
        assert_eq!(long.size[1], short.size[1] + 15);
        assert_eq!(inked(&long, 0..long.size[1], 150), 0, "no text beyond the cell");
        let footed = sheet("short", &["word ".repeat(60).as_str(), "one"]).picture();
        // 300 letters in lines of 102, and one more line.
        assert_eq!(footed.size, [740, short.size[1] + 4 * 15 + 10]);
    }

    #[test]
    fn wrapping_breaks_between_words_if_possible() {
        assert_eq!(wrapped("a bc  def", 4), ["a bc", "def"]);
        assert_eq!(wrapped("abcdefghij k", 4), ["abcd", "efgh", "ij k"]);
        assert_eq!(wrapped(" ", 4), [""; 0]);
        let cut = TextLines::new("one two three four", &TEXT, 7 * 5).within(2 * 15);
        assert_eq!(cut.lines, ["one", "..."]);
    }

    #[test]
    fn pictures_are_joined_side_by_side_and_stacked() {
        let pictures = [plain([3, 2], 0.1), plain([2, 2], 0.2)];
        let both = side_by_side(&pictures);
        assert_eq!(both.size, [5, 2]);
        assert_eq!(both.color[2..4], [[0.1; 3], [0.2; 3]]);
        let both = stacked(&pictures);
        assert_eq!(both.size, [3, 4]);
        assert_eq!(both.color[5..9], [[0.1; 3], [0.2; 3], [0.2; 3], PAPER]);
    }

    const RED: [f32; 3] = [1.0, 0.0, 0.0];

    fn plot(points: &[[f64; 2]]) -> Plot {
        let line = Line { name: "rms".into(), color: RED, points: points.to_vec() };
        Plot { size: [400, 200], step: 1.0, lines: vec![line] }
    }

    /// The rows of a column that contain red.
    fn red_rows(picture: &Picture, x: usize) -> Vec<usize> {
        (TOP..picture.size[1]).filter(|y| picture.color[y * picture.size[0] + x] == RED).collect()
    }

    #[test]
    fn lines_connect_values_and_break_at_gaps() {
        let picture = plot(&[[1.0, 0.01], [2.0, 1.0], [4.0, 0.1]]).picture();
        let area =
            Area { size: [400 - LEFT - RIGHT, 200 - TOP - BOTTOM], range: [1.0, 4.0], decades: [-2, 0] };
        let middle = area.y(0.1);
        assert_eq!(red_rows(&picture, area.x(1.0)), [area.y(0.01), area.y(0.01) + 1]);
        assert!(
            red_rows(&picture, area.x(1.5)).contains(&middle),
            "the scale is logarithmic between the ends"
        );
        assert_eq!(red_rows(&picture, area.x(2.0))[0], area.y(1.0));
        assert_eq!(red_rows(&picture, area.x(3.0)), [0; 0], "frame 3 is missing");
        assert_eq!(red_rows(&picture, area.x(4.0))[0], middle);
    }

    #[test]
    fn scale_accepts_any_numbers() {
        let area = |points: &[[f64; 2]]| Area::new(&plot(points));
        assert_eq!(area(&[[0.0, 3e-4], [9.0, 0.2]]).decades, [-4, 0]);
        assert_eq!(area(&[[0.0, 1e-30], [9.0, 0.2]]).decades, [-5, 0]);
        assert_eq!(area(&[[0.0, 0.0]]).decades, [-1, 0]);
        assert_eq!(area(&[]).range, [0.0, 1.0]);
        assert_eq!(area(&[[1.0, 1.0], [58.0, 1.0]]).labels(), [20.0, 40.0]);
        assert_eq!(area(&[[7.0, 1.0]]).labels(), [7.0]);
        assert_eq!(area(&[[3.0, 1.0], [5.0, 1.0]]).labels(), [3.0, 4.0, 5.0]);
        for points in [&[][..], &[[5.0, 0.0]], &[[0.0, f64::MAX], [1e18, f64::MIN_POSITIVE]]] {
            assert_eq!(plot(points).picture().size, [400, 200]);
        }
    }

    fn picture(size: [usize; 2], value: impl Fn(usize, usize) -> f32) -> Picture {
        let color = (0..size[0] * size[1]).map(|pixel| [value(pixel % size[0], pixel / size[0]); 3]);
        let color: Vec<[f32; 3]> = color.collect();
        Picture { size, coverage: vec![0.5; color.len()], color, data: None }
    }

    #[test]
    fn shrinking_keeps_the_mean() {
        let wide = picture([30, 20], |x, y| (x * y) as f32);
        let mean = |picture: &Picture| {
            picture.color.iter().map(|color| f64::from(color[0])).sum::<f64>() / picture.color.len() as f64
        };
        for (limit, size) in [([15, 100], [15, 10]), ([7, 7], [7, 5]), ([100, 6], [9, 6]), ([1, 1], [1, 1])] {
            let shrunk = wide.scaled_to_fit(limit);
            assert_eq!((shrunk.size, shrunk.color.len()), (size, size[0] * size[1]));
            assert!((mean(&shrunk) / mean(&wide) - 1.0).abs() < 1e-4, "{limit:?}");
            assert!(shrunk.coverage.iter().all(|part| (part - 0.5).abs() < 1e-5));
        }
        assert_eq!(wide.scaled_to_fit([30, 20]), wide);
        assert_eq!(wide.scaled_to_fit([300, 200]), wide);
        let halves = picture([4, 2], |x, _| if x < 2 { 1.0 } else { 3.0 });
        assert_eq!(halves.scaled_to_fit([2, 2]).color, [[1.0; 3], [3.0; 3]]);
    }
}
