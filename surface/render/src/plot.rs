//! A line plot of numbers over frames, with a logarithmic scale.
//!
//! ```text
//!   0.1  |         _
//!        |  __/\__/ \     a line from frame to frame; it breaks where frames are missing
//!   0.01 |_/         \_
//!        +------------------
//!         1       50     100
//! ```

use super::Picture;
use super::sheet::{Canvas, TEXT, TextLines};

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

#[cfg(test)]
mod tests {
    use super::*;

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
}
