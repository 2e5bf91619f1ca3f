//! The frame rate: by the times of the steps of a file that states them, or by the motion of particles.

use std::path::Path;

use super::attributes::AttributeRequest;
use super::reading::{parse_particles, read_file};
use super::steps::times_of_steps;
use crate::pipeline::error::FrameError;
use crate::pipeline::target::outputs::FRAME_RATES;
use crate::surface::attributes::time_between;
use crate::surface::options::Settings;
use crate::surface::particles::ParticleCloud;

/// How far a time may be from that of an even rate, in frames: solvers write at the first step after a frame.
const TOLERANCE_FRAMES: f64 = 0.05;

/// A rate is taken for a whole number that differs by less than this, relatively: times have few digits.
const WHOLE_WITHIN: f64 = 1e-3;

/// The frame rate by the times of the steps of a file, if they are regular: the frames with the numbers n and m are
/// (n - m) / rate seconds apart. `None` if the times are only the numbers of the frames, as many programs write them.
pub fn frame_rate(file: &Path) -> Option<f64> {
    rate_of(&times_of_steps(file)?)
}

fn rate_of(times: &[(i64, f64)]) -> Option<f64> {
    let times: Vec<(f64, f64)> = times.iter().map(|&(number, time)| (number as f64, time)).collect();
    let (&(first, start), &(last, end)) = (times.first()?, times.last()?);
    let rate = (last - first) / (end - start);
    let whole = rate.round();
    let rate = if (rate - whole).abs() < WHOLE_WITHIN * rate { whole } else { rate };
    let is_regular =
        |&(number, time): &(f64, f64)| ((time - start) * rate - (number - first)).abs() < TOLERANCE_FRAMES;
    let is_number = |&(number, time): &(f64, f64)| time == number;
    let is_rate = FRAME_RATES.contains(&rate) && times.iter().all(is_regular) && !times.iter().all(is_number);
    is_rate.then_some(rate)
}

/// The seconds from a frame to the next, by these three frames: see [`time_between`].
///
/// # Errors
/// When a frame cannot be read.
pub fn seconds_by_motion(frames: [&Path; 3], settings: &Settings) -> Result<Option<f64>, FrameError> {
    let particles = |path: &Path| -> Result<ParticleCloud, FrameError> {
        Ok(parse_particles(path, read_file(path)?, &AttributeRequest::to_follow(&settings.reading))?.cloud)
    };
    let [before, own, after] = frames;
    let time = time_between(&particles(before)?, &particles(own)?, &particles(after)?);
    Ok(time.map(|time| time / settings.velocity_scale))
}

/// Whether two times between frames are the same, as far as the motion of particles shows.
pub fn is_same_time(measured: f64, given: f64) -> bool {
    (0.8..=1.25).contains(&(measured / given))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regular_times_give_a_rate() {
        let rate = |times: &[f64]| rate_of(&(0..).zip(times.iter().copied()).collect::<Vec<_>>());
        assert_eq!(rate(&[0.0, 0.041667, 0.083333, 0.125]), Some(24.0));
        assert_eq!(rate(&[5.0, 5.02, 5.04]), Some(50.0));
        assert_eq!(rate(&[0.0, 0.0401, 0.0802, 0.12]), Some(25.0));
        assert_eq!(rate(&[0.0, 0.3, 0.6]).map(|rate| (rate * 3.0).round()), Some(10.0));
        for irregular in [
            &[0.0, 0.1, 0.3][..],
            &[0.0, 1.0, 2.0],
            &[0.5],
            &[],
            &[0.3, 0.2],
            &[0.1, 0.1],
            &[0.0, f64::NAN],
            &[0.0, 1e-9],
        ] {
            assert_eq!(rate(irregular), None, "{irregular:?}");
        }
        assert_eq!(rate_of(&[(100, 0.5), (200, 1.0), (300, 1.5)]), Some(200.0));
        assert_eq!(rate_of(&[(i64::MIN, 0.0), (i64::MAX, 1.0)]), None);
    }
}
