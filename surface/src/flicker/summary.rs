//! Summary statistics.

/// Statistics of the magnitudes of numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distribution {
    /// How many numbers were summarized; if 0, all other fields are 0.
    pub count: usize,
    /// Root mean square.
    pub rms: f64,
    /// Median magnitude.
    pub median: f64,
    /// 99th percentile of the magnitudes.
    pub percentile_99: f64,
    /// Largest magnitude.
    pub max: f64,
}

impl Distribution {
    /// The summary of these numbers. Their order affects only the rounding of `rms`.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Distribution {
        let mut sizes: Vec<f64> = values.into_iter().map(f64::abs).collect();
        let count = sizes.len();
        if count == 0 {
            return Distribution::default();
        }
        let rms = (sizes.iter().map(|size| size * size).sum::<f64>() / count as f64).sqrt();
        let mut of_rank = |part: f64| {
            let rank = ((part * count as f64).ceil() as usize).clamp(1, count) - 1;
            *sizes.select_nth_unstable_by(rank, f64::total_cmp).1
        };
        Distribution { count, rms, median: of_rank(0.5), percentile_99: of_rank(0.99), max: of_rank(1.0) }
    }
}
