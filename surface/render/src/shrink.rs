//! Scales a picture down.
//!
//! Each pixel of the result is the mean of the original pixels that it covers, weighted by the covered area.
//! No pixel is skipped, so filaments and drops stay visible.

use super::Picture;

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
