//! Reads particles: the Points of an archive, in world space.
//!
//! ```text
//!   .geom   P .pointIds .velocities .widths   positions, id, velocity, width
//!           .arbGeomParams                    other attributes with a value per point
//! ```
//!
//! A sample is a time at which an object, its transform or its visibility changes. Its number is the frame if
//! the times are those of whole frames, at the rate of the shortest step between two of them; else its index.

use super::FORMAT;
use super::archive::{PropertyHeader, entry};
use super::document::Pod;
use super::mesh::{names, to_world};
use super::placement;
use super::read::{MESHES, is_own_sequence};
use super::scene::{Geometry, GeometryKind, Scene, vectors};
use crate::core::batches::ReadAt;
use crate::core::container::{ContainerFile, ContainerFrames, ContainerReader, Sample, frame_at};
use crate::core::data::{FileAttribute, FilePositions, ParticleFrame, Values};
use crate::core::error::Result;
use crate::core::limits::Limits;
use crate::core::matrix::{IDENTITY, Matrix, change_vectors, determinant, normal_transform, transformed};
use crate::core::named_arrays::{ParticlePart, frame_of_parts};
use crate::core::options::UpAxis;
use crate::core::text::excerpt;

pub(super) const READER: ContainerReader = ContainerReader {
    meshes: Some(MESHES),
    ..ContainerReader::new(|file, limits| Ok(ContainerFrames::new(samples(file, limits)?, READ)))
};

const READ: fn(&ContainerFile, usize, &Limits) -> Result<ParticleFrame> =
    |file, index, limits| read_sample(file.file, index, limits);

/// The largest difference between a time, in frames, and a whole frame.
const FRAME_TOLERANCE: f64 = 1e-3;

fn samples(file: &ContainerFile, limits: &Limits) -> Result<Vec<Sample>> {
    let scene = Scene::open(file.file, limits)?;
    let times = times(&scene, limits)?;
    let numbers = frame_numbers(&times.iter().copied().flatten().collect::<Vec<_>>());
    let numbers = numbers.unwrap_or_else(|| (0..).take(times.len()).collect());
    Ok(numbers.into_iter().zip(times).map(|(number, time)| Sample { number, time }).collect())
}

/// The times of the samples; a single `None` if there is one sample, without a time.
fn times(scene: &Scene, limits: &Limits) -> Result<Vec<Option<f64>>> {
    // The points of our sequences are beside meshes, and repeated before the next frame.
    if scene.of_kind(GeometryKind::Points).next().is_none() || is_own_sequence(scene)? {
        return Err(scene.without(GeometryKind::Points));
    }
    let times = scene.times(GeometryKind::Points, limits)?;
    Ok(if times.is_empty() { vec![None] } else { times.into_iter().map(Some).collect() })
}

/// The frames of these times; `None` unless all are whole frames at a rate of at least one frame per second: the
/// inverse of the shortest step, rounded to a whole number if possible.
pub(super) fn frame_numbers(times: &[f64]) -> Option<Vec<i64>> {
    let step = times.windows(2).map(|pair| pair[1] - pair[0]).min_by(f64::total_cmp)?;
    let rates = [(1.0 / step).round(), 1.0 / step];
    rates.into_iter().filter(|fps| *fps >= 1.0).find_map(|fps| {
        #[expect(clippy::cast_possible_truncation, reason = "below 2⁵³")]
        let number = |time: &f64| {
            let frame = time * fps;
            let is_whole = (frame - frame.round()).abs() < FRAME_TOLERANCE && frame.abs() < 1e15;
            is_whole.then_some(frame.round() as i64)
        };
        let numbers: Vec<i64> = times.iter().map(number).collect::<Option<_>>()?;
        numbers.windows(2).all(|pair| pair[0] < pair[1]).then_some(numbers)
    })
}

/// Reads the particles of one sample of an archive in memory, by its index.
///
/// # Errors
///
/// [`Unsupported`](crate::Error::Unsupported) for archives without Points, and for HDF5;
/// [`Truncated`](crate::Error::Truncated) or [`Invalid`](crate::Error::Invalid), with the position, if the file is
/// truncated or damaged, or has fewer samples; [`TooLarge`](crate::Error::TooLarge) beyond `limits`.
pub fn read_points(bytes: &[u8], index: usize, limits: &Limits) -> Result<ParticleFrame> {
    read_sample(&bytes, index, limits)
}

/// Reads the points of an archive of this crate with one sample in the axes in which they were given to the writer.
///
/// # Errors
///
/// Those of [`read_points`]; [`Invalid`](crate::Error::Invalid) if the transform is not one that this crate writes.
pub(crate) fn read_own_points(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let mut frame = read_placed(&bytes, 0, true, limits)?;
    for attribute in &mut frame.attributes {
        // The last string of the file marks missing values.
        if let Values::Strings { table, .. } = &mut attribute.values {
            table.pop();
        }
    }
    Ok(frame)
}

fn read_sample(file: &dyn ReadAt, index: usize, limits: &Limits) -> Result<ParticleFrame> {
    read_placed(file, index, false, limits)
}

/// Reads the particles of a sample. Those that `are_own` keep their axes, and have ids of 64 bits with a sign.
fn read_placed(file: &dyn ReadAt, index: usize, are_own: bool, limits: &Limits) -> Result<ParticleFrame> {
    let scene = Scene::open(file, limits)?;
    let times = times(&scene, limits)?;
    let time = *frame_at(FORMAT, &times, index)?;
    let (mut parts, mut notes, mut hidden, mut count) = (Vec::new(), Vec::new(), 0, 0);
    let mut reader = PointsReader { scene: &scene, time, are_own, limits, notes: &mut notes };
    for points in scene.of_kind(GeometryKind::Points) {
        if !scene.is_visible(points, time)? {
            hidden += 1;
            continue;
        }
        let part = reader.part(points)?;
        count += part.positions.len() as u64;
        limits.check_particles(FORMAT, count)?;
        parts.push(part);
    }
    let others = scene.others_than(GeometryKind::Points);
    if !others.is_empty() {
        notes.push(format!("skipped objects that are not particles: {others}"));
    }
    if hidden > 0 {
        notes.push(format!("skipped {hidden} hidden Points"));
    }
    Ok(frame_of_parts(parts, "Points", notes))
}

/// Reads the Points of an archive at a time.
struct PointsReader<'a> {
    scene: &'a Scene<'a>,
    time: Option<f64>,
    /// See [`read_placed`].
    are_own: bool,
    limits: &'a Limits,
    notes: &'a mut Vec<String>,
}

impl PointsReader<'_> {
    fn part(&mut self, points: &Geometry) -> Result<ParticlePart> {
        let archive = &self.scene.archive;
        let mut matrix = self.scene.world(points, self.time)?;
        if self.are_own {
            matrix = to_world(UpAxis::Y, placement(&matrix)?.1);
        }
        let positions = points.required(names::POSITIONS)?;
        let local = vectors(self.scene, positions, archive.index_at(positions, self.time))?;
        let count = local.len();
        let mut arrays = Vec::new();
        for (property, name) in
            [(names::IDS, "id"), (names::VELOCITIES, super::read::VELOCITY), (names::WIDTHS, "width")]
        {
            if let Some(property) = points.property(property) {
                arrays.extend(self.array(property, name, count, &matrix)?);
            }
        }
        if points.property(names::VELOCITIES).is_some() && self.scene.is_moving(points) {
            let name = excerpt(&points.name);
            self.notes.push(format!("the velocities of {name} do not include the movement of its parents"));
        }
        let params =
            points.property(names::PARAMS).map_or(Ok(Vec::new()), |params| archive.compound(params))?;
        self.limits.check_attributes(FORMAT, params.len(), "attributes")?;
        for param in &params {
            arrays.extend(self.array(param, &param.name, count, &matrix)?);
        }
        let positions = if matrix == IDENTITY {
            FilePositions::F32(local)
        } else {
            let to_world = |point: [f32; 3]| transformed(&matrix, point.map(f64::from), 1.0);
            FilePositions::F64(local.into_iter().map(to_world).collect())
        };
        Ok(ParticlePart { positions, arrays })
    }

    /// The values of an attribute in world space; `None` if there are none, and, with a note, if there is one
    /// for all points.
    fn array(
        &mut self,
        property: &PropertyHeader,
        name: &str,
        count: usize,
        matrix: &Matrix,
    ) -> Result<Option<FileAttribute>> {
        let is_constant = entry(&property.metadata, "geoScope") == "con";
        let archive = &self.scene.archive;
        let (arity, mut values) = if self.are_own && property.name == names::IDS {
            let ids =
                archive.elements::<8>(property, (Pod::U64, 1), archive.index_at(property, self.time))?;
            (1, Values::I64(ids.into_iter().map(i64::from_le_bytes).collect()))
        } else {
            archive.param(property, self.time)?
        };
        if values.len() == 0 && count > 0 {
            return Ok(None); // the library writes empty arrays for those that it was not given
        }
        if let Values::F32(widths) = &mut values
            && property.name == names::WIDTHS
            && (is_constant || count > 1)
            && let [width] = widths[..]
        {
            *widths = vec![width; count];
        } else if is_constant {
            self.notes.push(format!("skipped `{}`: it has one value for all particles", excerpt(name)));
            return Ok(None);
        }
        if *matrix != IDENTITY && matches!(values, Values::F32(_)) {
            match (&*property.name, entry(&property.metadata, "interpretation"), arity) {
                (names::WIDTHS, ..) => {
                    let scale = determinant(matrix).abs().cbrt();
                    values.scale(scale);
                    if (scale - 1.0).abs() > 1e-6 {
                        self.notes.push("scaled the widths by the transforms of the points".to_owned());
                    }
                }
                (names::VELOCITIES, ..) | (_, "vector", 3) => {
                    change_vectors(&mut values, |vector| transformed(matrix, vector, 0.0));
                }
                (_, "normal", 3) => change_vectors(&mut values, normal_transform(matrix)),
                (_, "point", 3) => change_vectors(&mut values, |point| transformed(matrix, point, 1.0)),
                _ => {}
            }
        }
        Ok(Some(FileAttribute::new(name, arity, values)))
    }
}
