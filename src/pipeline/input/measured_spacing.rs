//! Estimates the particle spacing of a sequence if none is given, and how irregular it is.
//!
//! The spacing is twice the median radius if each particle's size follows from its own radius, or if the
//! particles have a radius attribute that is consistent with their positions; otherwise it is an estimate
//! from the positions. It is measured on the first, the middle and the last readable frame, and is the same
//! for all frames, because a separate spacing for each frame would make the surface flicker. All frames of
//! the sequence count, even if only some are converted, so a part of a sequence gets the same result as the
//! whole.
//!
//! ```text
//!   frame     1   2   3   4   5   6   7   8   9
//!             ×   ●───┐         ●             ●         × one particle, or unreadable: use the next frame
//!                     └────┬────┴─────────────┘
//!                 median weighted by confidence, rounded to two digits: 0.0498 ▶ 0.05
//! ```

use std::fmt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::surface::options::{self, MethodOptions, Preset, SpacingOptions};
use crate::surface::particles::{Attribute, Role, erased};
use crate::surface::spacing::{
    CONFIDENCE_MIN, SequenceEstimate, SourceSample, SpacingEstimate, combine_estimates, estimate_spacing,
    median, rounded,
};
use crate::surface::words::{pluralize, significant};

use super::attributes::AttributeRequest;
use super::frame_input::{FileParticles, FrameInput};
use super::reading::{ParsedParticles, parse_particles, read_file};
use super::steps::{frame_name, step_of};
use crate::pipeline::error::{Cause, FrameError, Stage};
use crate::pipeline::files::input_file::InputFile;
use crate::pipeline::files::json::{path, text};
use crate::pipeline::warning::Warning;

/// The maximum number of frames to try for the middle one, and for the last one.
const TRIES_MAX: usize = 8;

/// The particle spacing of a sequence, and its source.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeasuredSpacing {
    /// The particle spacing, world units, rounded to two significant digits.
    #[serde(with = "text")]
    pub spacing: f64,
    /// The confidence of the estimate, from 0 to 1: see [`SequenceEstimate::confidence`].
    pub confidence: f64,
    /// How irregularly the particles are spaced: see [`SpacingEstimate::irregularity`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub irregularity: Option<f64>,
    /// The median radius of particles with per-particle radii, world units.
    #[serde(with = "text::option", default, skip_serializing_if = "Option::is_none")]
    pub radius_median: Option<f64>,
    /// The first measured frame.
    #[serde(with = "path")]
    pub measured_on: PathBuf,
    /// The number of measured frames, one to three.
    pub measured_count: usize,
    /// Warnings about the spacing: frames that disagree, or a low confidence. Not recorded.
    #[serde(skip)]
    pub warnings: Vec<String>,
}

impl From<&MeasuredSpacing> for options::SequenceSpacing {
    fn from(measured: &MeasuredSpacing) -> options::SequenceSpacing {
        options::SequenceSpacing {
            spacing: measured.spacing,
            radius_median: measured.radius_median,
            irregularity: measured.irregularity,
        }
    }
}

/// What is measured on the particles with these options, and which options replace that, for messages.
pub fn measured_by(options: &MethodOptions) -> (&'static str, &'static str) {
    match (options.spacing, options.is_auto()) {
        (None, false) => ("particle spacing", "--spacing"),
        (None, true) => ("particle spacing and preset", "--spacing and a --preset other than auto"),
        (Some(_), _) => ("preset", "a --preset other than auto"),
    }
}

/// A warning about the preset for particles that were measured, or could not be: it does not suit them, or it
/// could not be chosen by them.
pub fn preset_warning(options: &MethodOptions, irregularity: Option<f64>) -> Option<Warning> {
    let suitable = Preset::for_fluid(irregularity);
    match (options.preset, irregularity) {
        (None, Some(irregularity)) if !options.is_auto() && suitable != Preset::default() => {
            let warning = Warning::new(format!(
                "the particles are spaced irregularly (irregularity {} %): the preset {suitable} makes pools and waves \
                 calmer, but splashes thicker, than {}",
                (100.0 * irregularity).round(),
                Preset::default()
            ));
            Some(warning.with_remedy(format!(
                "use --preset {suitable}, or give --preset fluid if splashes matter more"
            )))
        }
        (Some(Preset::Auto), None) => Some(Warning::new(format!(
            "too few particles are surrounded by others to measure how evenly they are spaced: the preset is {suitable}"
        ))),
        _ => None,
    }
}

/// Why the spacing could not be measured.
#[derive(Debug, Default)]
pub struct NoSpacing {
    /// The number of readable frames with too few particles.
    pub sparse_count: usize,
    /// How many of these have no particles.
    pub empty_count: usize,
    /// The number of frames that cannot be used: they are unreadable, or lack the radii.
    pub unreadable_count: usize,
    /// How many of these lack the radii.
    pub missing_count: usize,
    /// The error of the first of these frames.
    pub unreadable: Option<Box<FrameError>>,
    /// The condition that particles must meet, if there is one.
    pub condition: Option<String>,
}

impl fmt::Display for NoSpacing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let NoSpacing { sparse_count, empty_count, unreadable_count, missing_count, unreadable, condition } =
            self;
        if let (None, true, Some(condition)) = (unreadable, empty_count == sparse_count, condition) {
            return write!(
                f,
                "cannot measure the particle spacing, because no particle meets the condition \"{condition}\""
            );
        }
        match unreadable {
            None if empty_count == sparse_count => f.write_str(
                "cannot measure the particle spacing, because there are no particles: give --spacing",
            ),
            None => f.write_str(
                "cannot measure the particle spacing, because no frame has two particles in different places: \
                 give --spacing",
            ),
            // No hint to give --spacing: it would not help, because the files are unreadable.
            Some(error) if *sparse_count == 0 => match unreadable_count {
                ..=1 => write!(f, "{error}"),
                count if count == missing_count => {
                    write!(f, "{error}; the same applies to all {count} frames")
                }
                count => write!(f, "{error}; none of the {count} frames can be read"),
            },
            Some(error) => {
                let first = if *unreadable_count == 1 { ":" } else { "; the first:" };
                write!(
                    f,
                    "cannot measure the particle spacing, because no readable frame has two particles in \
                     different places: give --spacing; {} cannot be read{first} {error}",
                    pluralize(*unreadable_count, "frame")
                )
            }
        }
    }
}

impl std::error::Error for NoSpacing {}

/// Measures the spacing of the chosen particles in these frames, which are in the order of their sequence.
///
/// # Errors
/// When no frame can be measured. Skips frames that cannot be read, or lack the radii: their conversion
/// reports the reason.
pub fn measure_spacing<'a>(
    files: impl IntoIterator<Item = &'a Path>,
    options: &SpacingOptions,
) -> Result<MeasuredSpacing, NoSpacing> {
    let files: Vec<&Path> = files.into_iter().collect();
    let condition = options.reading.filter.as_ref().map(ToString::to_string);
    let mut none = NoSpacing { condition, ..NoSpacing::default() };
    let note = |_: &Path, attempt: Attempt| match attempt {
        Attempt::Measured => {}
        Attempt::TooFewParticles { count } => {
            none.sparse_count += 1;
            none.empty_count += usize::from(count == 0);
        }
        Attempt::Unreadable(error) => {
            none.unreadable_count += 1;
            none.missing_count += usize::from(matches!(error.cause, Cause::Missing(_)));
            none.unreadable.get_or_insert_with(|| Box::new(error));
        }
    };
    measure_sequence(&files, options, false, note).ok_or(none)
}

/// The result of measuring a frame.
#[derive(Debug)]
pub(crate) enum Attempt {
    /// The frame was measured.
    Measured,
    /// It has this many particles, which are too few to measure.
    TooFewParticles { count: usize },
    /// It cannot be read.
    Unreadable(FrameError),
}

/// A frame with fewer particles, as at the start of an inflow, is measured only if no other frame can be.
const PARTICLES_MIN: usize = 16;

/// Estimates the spacing of a sequence from its first, middle and last frame, or their neighbours if these
/// cannot be measured; `note` receives every frame that was read. `None` if none can be measured. If
/// `others_may_come` is true, frames with [few particles](PARTICLES_MIN) are not measured.
pub(crate) fn measure_sequence(
    files: &[&Path],
    options: &SpacingOptions,
    others_may_come: bool,
    mut note: impl FnMut(&Path, Attempt),
) -> Option<MeasuredSpacing> {
    let mut is_read = vec![false; files.len()];
    let mut small_frames = Vec::new();
    let mut find = |candidates: &mut dyn Iterator<Item = usize>| {
        for index in candidates {
            if std::mem::replace(&mut is_read[index], true) {
                continue;
            }
            let (attempt, frame) = match measured(files[index], options) {
                // Radii say as much in a small frame.
                Ok((count, Some(frame)))
                    if count >= PARTICLES_MIN || options.per_particle_radius.is_some() =>
                {
                    (Attempt::Measured, Some((index, frame)))
                }
                Ok((_, Some(frame))) if !others_may_come => {
                    small_frames.push(frame);
                    (Attempt::Measured, None)
                }
                Ok((count, _)) => (Attempt::TooFewParticles { count }, None),
                Err(error) => (Attempt::Unreadable(error), None),
            };
            note(files[index], attempt);
            if frame.is_some() {
                return frame;
            }
        }
        None
    };
    let Some((first, first_frame)) = find(&mut (0..files.len())) else {
        let last = small_frames.len().checked_sub(1)?;
        let chosen = small_frames.into_iter().enumerate();
        let chosen = chosen.filter(|(index, _)| [0, last / 2, last].contains(index));
        return combined(&chosen.map(|(_, frame)| frame).collect::<Vec<_>>());
    };
    let (last, last_frame) = find(&mut (first + 1..files.len()).rev().take(TRIES_MAX)).unzip();
    let last = last.unwrap_or(first);
    let mut between: Vec<usize> = (first + 1..last).collect();
    between.sort_by_key(|&index| index.abs_diff(first.midpoint(last)));
    let middle_frame = find(&mut between.into_iter().take(TRIES_MAX)).map(|(_, frame)| frame);
    combined(&[Some(first_frame), middle_frame, last_frame].into_iter().flatten().collect::<Vec<_>>())
}

/// The measurements of a frame.
#[derive(Debug)]
struct FrameSpacing {
    path: PathBuf,
    estimate: SpacingEstimate,
    /// The name of a radius attribute that contradicts the positions, and twice its median.
    contradicting_radius: Option<(String, f64)>,
    radius_median: Option<f64>,
}

/// Counts the particles of a frame, and measures them; `None` if they are too few.
fn measured(path: &Path, options: &SpacingOptions) -> Result<(usize, Option<FrameSpacing>), FrameError> {
    let measured = FrameError::catch(path, Stage::Read, || {
        if options.per_particle_radius.is_none()
            && let Some(file) = large_file(path)?
        {
            return measured_sample(path, file, options).map_err(|cause| FrameError {
                path: path.to_owned(),
                during: Stage::Read,
                cause,
            });
        }
        let content = read_file(path)?;
        let read = parse_particles(path, content, &AttributeRequest::for_spacing(options).and_radius())?;
        Ok((read.cloud.positions.len(), measured_of(path, &read, options)))
    });
    measured.flatten()
}

/// Counts the particles in a large file, and measures a sample of their positions.
fn measured_sample(
    path: &Path,
    file: FileParticles,
    options: &SpacingOptions,
) -> Result<(usize, Option<FrameSpacing>), Cause> {
    let particles = FrameInput::OnDisk(Box::new(file.chosen_by(options.reading.filter.as_ref())?));
    let count = particles.len();
    let estimate = erased(&particles, |source| SourceSample::of(source, count)?.estimate(source))?;
    let path = path.to_owned();
    let frame = estimate.map(|estimate| FrameSpacing {
        path,
        estimate,
        contradicting_radius: None,
        radius_median: None,
    });
    Ok((count, frame))
}

/// Opens the particles of a file that is too large to read whole, if its format can be read in parts.
fn large_file(path: &Path) -> Result<Option<FileParticles>, FrameError> {
    let failed = |error| FrameError::file(path, Stage::Read, error);
    if step_of(path).is_some() {
        return Ok(None);
    }
    let file = InputFile::open(path).map_err(|error| failed(error.into()))?;
    if file.is_regular() && file.stamp().size >= SAMPLED_FROM_BYTES {
        FileParticles::open(path, file).map_err(failed)
    } else {
        Ok(None)
    }
}

/// In files of this size and larger, only a sample of the positions is measured, and no radii.
const SAMPLED_FROM_BYTES: u64 = 256 << 20;

fn measured_of(path: &Path, read: &ParsedParticles, options: &SpacingOptions) -> Option<FrameSpacing> {
    let per_particle_radius = options.per_particle_radius.as_ref();
    let own_spacing = per_particle_radius.and_then(|own| own.spacing(&read.cloud.attributes));
    let estimate = estimate_spacing(&read.cloud.positions);
    let irregularity = estimate.and_then(|estimate| estimate.irregularity);
    // Spray, with its own radii, has no other spacing.
    let by_positions = estimate.filter(|_| own_spacing.is_none());
    let radius = match per_particle_radius {
        Some(own) => read.cloud.find_attribute(&own.attribute, 1),
        None => read.cloud.attributes.iter().find(|attribute| attribute.role == Role::Radius),
    };
    let by_radius = radius.and_then(|radius| Some((radius.name.clone(), 2.0 * median(positive(radius))?)));
    let of_radius = |spacing| SpacingEstimate { spacing, confidence: 1.0, irregularity };
    let (estimate, contradicting_radius) = match (by_positions, by_radius) {
        (Some(estimate), Some((name, spacing))) => {
            let ratio = spacing / estimate.spacing;
            let fits = (1.0 / RADIUS_FACTOR_MAX..=RADIUS_FACTOR_MAX).contains(&ratio);
            match (fits, estimate.confidence < CONFIDENCE_MIN) {
                (true, _) => (of_radius(spacing), None),
                (false, true) => (SpacingEstimate { spacing, ..estimate }, None),
                (false, false) => (estimate, Some((name, spacing))),
            }
        }
        (Some(estimate), None) => (estimate, None),
        (None, Some((_, spacing))) => (of_radius(spacing), None),
        (None, None) => return None,
    };
    let radius_median = per_particle_radius.and_then(|own| median(own.radii_min(&read.cloud.attributes)));
    Some(FrameSpacing { path: path.to_owned(), estimate, contradicting_radius, radius_median })
}

/// The positive values of an attribute.
fn positive(attribute: &Attribute) -> Vec<f64> {
    let numbers = attribute.values.numbers().unwrap_or_default();
    let numbers = numbers.iter().map(|&number| f64::from(number));
    numbers.filter(|number| number.is_finite() && *number > 0.0).collect()
}

/// Twice the radius is the spacing if it differs from the estimate by this factor at most: simulations derive
/// the particle radius from the spacing, but some files have radii for another purpose. If the estimate from
/// the positions has a low confidence, the radius decides whatever the factor.
const RADIUS_FACTOR_MAX: f64 = 1.5;

/// Combines the measurements of these frames; `None` without frames.
fn combined(frames: &[FrameSpacing]) -> Option<MeasuredSpacing> {
    let measured_on = frames.first()?.path.clone();
    let estimates: Vec<SpacingEstimate> = frames.iter().map(|frame| frame.estimate).collect();
    let estimate = combine_estimates(&estimates)?;
    Some(MeasuredSpacing {
        spacing: rounded(estimate.spacing),
        confidence: estimate.confidence,
        irregularity: estimate.irregularity,
        radius_median: median(frames.iter().filter_map(|frame| frame.radius_median).collect()),
        measured_on,
        measured_count: frames.len(),
        warnings: warnings(frames, &estimate),
    })
}

/// The reasons to doubt the spacing of a sequence.
fn warnings(frames: &[FrameSpacing], estimate: &SequenceEstimate) -> Vec<String> {
    let order = |a: &&FrameSpacing, b: &&FrameSpacing| a.estimate.spacing.total_cmp(&b.estimate.spacing);
    let mut warnings = Vec::new();
    if let Some((frame, (name, spacing))) =
        frames.iter().find_map(|frame| Some((frame, frame.contradicting_radius.as_ref()?)))
    {
        warnings.push(format!(
            "the radii in `{name}` imply a spacing of {}, but the positions imply {}, which is used: give --spacing if that is wrong",
            significant(rounded(*spacing)),
            significant(rounded(frame.estimate.spacing))
        ));
    }
    if let (true, Some(least), Some(greatest)) =
        (estimate.frames_disagree(), frames.iter().min_by(order), frames.iter().max_by(order))
    {
        let spacing = |frame: &FrameSpacing| significant(rounded(frame.estimate.spacing));
        warnings.push(format!(
            "particles are {} apart in {} but {} in {}: give --spacing",
            spacing(least),
            frame_name(&least.path),
            spacing(greatest),
            frame_name(&greatest.path)
        ));
    } else if estimate.confidence < CONFIDENCE_MIN {
        warnings.push(format!(
            "particles are about {} apart, which is uncertain: they are few or unevenly spread; give --spacing if you know it",
            significant(rounded(estimate.spacing))
        ));
    }
    warnings
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::options::PerParticleRadius;
    use crate::surface::particles::{AttributeValues, OwnedPositions, ParticleCloud};

    #[test]
    fn median_of_per_particle_radii_is_measured() {
        let count = 6 * 6 * 6;
        let positions = (0..count).map(|i| [i % 6, i / 6 % 6, i / 36].map(f64::from)).collect();
        // Invalid radii are ignored.
        let of_radii = |radii: [f32; 3]| {
            let mut values = vec![f32::NAN; count as usize];
            values.iter_mut().zip(radii.iter().cycle()).take(90).for_each(|(value, radius)| *value = *radius);
            let radii = Attribute {
                name: "pscale".into(),
                role: Role::Radius,
                arity: 1,
                values: AttributeValues::Numbers(values),
            };
            let positions = OwnedPositions::F64(Vec::clone(&positions));
            let cloud = ParticleCloud { attributes: vec![radii], ..ParticleCloud::from(positions) };
            ParsedParticles { cloud, warnings: Vec::new(), unused_velocity: None }
        };
        let of_frame = |read: &ParsedParticles, own: Option<&PerParticleRadius>| {
            let options = SpacingOptions { per_particle_radius: own.cloned(), ..SpacingOptions::default() };
            combined(&[measured_of(Path::new("a"), read, &options).expect("enough")]).expect("a frame")
        };
        let own = PerParticleRadius { attribute: "pscale".into(), scale: 2.0 };
        assert_eq!(of_frame(&of_radii([0.25, 0.01, 40.0]), Some(&own)).radius_median, Some(0.5));
        assert_eq!(of_frame(&of_radii([3.0, 2.0, 1.0]), Some(&own)).radius_median, Some(4.0));
        assert_eq!(of_frame(&of_radii([0.0, -1.0, f32::NAN]), Some(&own)).radius_median, None);
        assert_eq!(of_frame(&of_radii([0.25, 0.01, 40.0]), None).radius_median, None);
        // Twice the radius is the spacing if it is close to the estimate from the positions.
        for (radius, spacing, is_doubted) in
            [(0.5, 1.0, false), (0.6, 1.2, false), (0.35, 0.7, false), (0.01, 1.0, true), (40.0, 1.0, true)]
        {
            let measured = of_frame(&of_radii([radius; 3]), None);
            assert_eq!((measured.spacing, measured.warnings.len()), (spacing, usize::from(is_doubted)));
            assert!(measured.warnings.iter().all(|warning| warning.contains("`pscale`")));
        }
        assert_eq!(of_frame(&of_radii([f32::NAN; 3]), None).warnings, [""; 0]);
    }
}
