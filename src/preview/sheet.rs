//! Many pictures on one sheet, each with a few lines under it.
//!
//! ```text
//!   ┌──────┐ ┌──────┐ ┌──────┐
//!   │      │ │      │ │      │
//!   └──────┘ └──────┘ └──────┘
//!   dam.0001 dam.0002 dam.0003
//!   1.2 s    1.3 s    failed
//! ```

use std::convert::Infallible;

use embedded_graphics::mono_font::{MonoTextStyle, iso_8859_1::FONT_6X10};
use embedded_graphics::pixelcolor::BinaryColor;
use embedded_graphics::prelude::{DrawTarget, Drawable, OriginDimensions, Pixel, Point, Size};
use embedded_graphics::text::{Baseline, Text};

use super::Picture;

/// A picture on a sheet, and what is written under it.
#[derive(Clone, Debug)]
pub struct Cell {
    /// `None` leaves the place empty: there is no picture.
    pub picture: Option<Picture>,
    /// From the top; what is too long for the cell is cut.
    pub lines: Vec<String>,
}

/// Cells in rows of so many, with a line above all of them, on light grey. Cells are as large as the largest picture.
pub fn sheet(title: &str, cells: &[Cell], columns: usize) -> Picture {
    let columns = columns.clamp(1, cells.len().max(1));
    let pictures = || cells.iter().filter_map(|cell| cell.picture.as_ref());
    let largest = |axis: usize| pictures().map(|picture| picture.size[axis]).max().unwrap_or(LEAST_EDGE);
    let (width, height) = (largest(0), largest(1));
    let line_count = cells.iter().map(|cell| cell.lines.len()).max().unwrap_or(0);
    let (step_x, step_y) = (width + GAP, height + line_count * LINE_HEIGHT + GAP);
    let rows = cells.len().div_ceil(columns);
    let head = if title.is_empty() { GAP } else { 2 * GAP + LINE_HEIGHT };
    let mut canvas = Canvas::new([GAP + columns * step_x, head + rows * step_y]);
    canvas.write(title, [GAP, GAP], columns * step_x - GAP);
    for (index, cell) in cells.iter().enumerate() {
        let (left, top) = (GAP + index % columns * step_x, head + index / columns * step_y);
        if let Some(picture) = &cell.picture {
            canvas.paste(picture, [left, top]);
        }
        for (line, text) in cell.lines.iter().enumerate() {
            canvas.write(text, [left, top + height + 2 + line * LINE_HEIGHT], width);
        }
    }
    canvas.picture
}

/// Pictures side by side, from the left, all of one height.
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

/// Between cells, and around them, in pixels.
const GAP: usize = 8;
const LINE_HEIGHT: usize = 12;
const LETTER_WIDTH: usize = 6;
/// Of cells without any picture.
const LEAST_EDGE: usize = 64;

/// Linear colours.
const PAPER: [f32; 3] = [0.87, 0.88, 0.9];
const INK: [f32; 3] = [0.03, 0.04, 0.05];

/// A picture that is being put together.
struct Canvas {
    picture: Picture,
}

impl Canvas {
    fn new(size: [usize; 2]) -> Canvas {
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

    /// Writes a line whose upper left corner is at a place, no wider than `width`.
    fn write(&mut self, text: &str, [left, top]: [usize; 2], width: usize) {
        let fitting = width / LETTER_WIDTH;
        let text: String = match text.chars().count() > fitting {
            true => text.chars().take(fitting.saturating_sub(3)).chain("...".chars()).collect(),
            false => text.to_owned(),
        };
        let style = MonoTextStyle::new(&FONT_6X10, BinaryColor::On);
        let place = Point::new(left as i32, top as i32);
        let Ok(_) = Text::with_baseline(&text, place, style, Baseline::Top).draw(self);
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
        for Pixel(place, color) in pixels {
            let (Ok(x), Ok(y)) = (usize::try_from(place.x), usize::try_from(place.y)) else { continue };
            if color.is_on() && x < width && y < height {
                self.picture.color[y * width + x] = INK;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plain(size: [usize; 2], value: f32) -> Picture {
        let count = size[0] * size[1];
        Picture { size, color: vec![[value; 3]; count], coverage: vec![1.0; count], data: None }
    }

    #[test]
    fn cells_lie_in_rows_with_their_lines_below() {
        let cell = |value: f32| Cell { picture: Some(plain([40, 20], value)), lines: vec!["a line".into()] };
        let cells = [cell(0.1), cell(0.2), Cell { picture: None, lines: vec!["failed".into()] }];
        let sheet = sheet("three", &cells, 2);
        let [width, height] = sheet.size;
        assert_eq!([width, height], [8 + 2 * 48, 28 + 2 * (20 + 12 + 8)]);
        let at = |x: usize, y: usize| sheet.color[y * width + x];
        assert_eq!((at(8, 28), at(56, 28), at(8 + 47, 28)), ([0.1; 3], [0.2; 3], PAPER));
        let inked = |rows: std::ops::Range<usize>| {
            rows.flat_map(|y| (0..width).map(move |x| (x, y))).filter(|&(x, y)| at(x, y) == INK).count()
        };
        assert!(
            inked(8..20) > 20 && inked(50..62) > 40 && inked(90..102) > 20,
            "titles and lines are written"
        );
        assert_eq!(inked(28..48) + inked(68..88), 0);
    }

    #[test]
    fn what_is_too_long_is_cut() {
        let cells = [Cell { picture: Some(plain([30, 10], 0.5)), lines: vec!["a very long line".into()] }];
        let sheet = sheet("", &cells, 3);
        assert_eq!(sheet.size, [8 + 38, 8 + 10 + 12 + 8]);
        assert!((0..sheet.size[1]).all(|y| sheet.color[y * 46 + 40] == PAPER), "nothing is beyond the cell");
    }

    #[test]
    fn pictures_stand_side_by_side() {
        let both = side_by_side(&[plain([3, 2], 0.1), plain([2, 2], 0.2)]);
        assert_eq!(both.size, [5, 2]);
        assert_eq!(both.color[2..4], [[0.1; 3], [0.2; 3]]);
    }
}
