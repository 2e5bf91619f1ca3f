//! Writes a sequence of `.glb` frames as one Alembic mesh, and the points beside it, with one or two samples per frame.
//!
//! ```text
//!   frames    5    6      9    10        6 is shown until 9
//!   samples   5    6   8.99    9    10   8.99 refers to the data of 6
//! ```
//!
//! At a time between two samples, programs show the mesh of the earlier or of the nearer one, or blend the
//! two if they have the same number of vertices. Where frames are missing or have the same number of
//! vertices or of points, the second sample, just before the next frame, prevents this. Frame n is at n / fps
//! seconds.
//!
//! Each array of a frame is read from the frame's file, a `.glb` of this crate, just before it is written. So only one
//! array of one frame, or the points of one frame, are in memory at a time.

use std::io::{self, Read, Seek, Write};

use crate::abc::document::{AbcObject, AbcProperty, Ogawa, StoredSample, Times, write_archive};
use crate::abc::mesh::{
    FrameSamples, MeshSamples, ParamType, SEQUENCE_POINTS, bounds_sample, names, points_object, real_sample,
    to_world, triangle_samples,
};
use crate::abc::{FORMAT, are_wide, check_vertex_count, names_of, point_geometry};
use crate::core::data::Provenance;
use crate::core::error::{Error, Position, Result};
use crate::core::narrow_points::NarrowPoints;
use crate::core::sequence::{check_numbers, held_times};
use crate::core::sequence_points::SequencePoints;
use crate::core::vertex_attributes::{UsedNames, plain_name};
use crate::meshes::gltf::{
    COLOR, NORMAL, POSITION, SequenceFrame, SequencePlacement, SharedAttribute, TEXTURE, VELOCITY,
    shared_attributes,
};

/// Writes a sequence of frames, whose numbers must increase, and the points beside their meshes. `open` opens the
/// file of a frame, by its index. Returns notes on attributes that are renamed, or omitted because the frames
/// differ in them.
///
/// # Errors
///
/// [`Error::Io`] if a file cannot be read or `out` fails; [`Error::Invalid`] if a document is damaged, a file
/// changed, numbers do not increase, or there are no frames; [`Error::Unsupported`] for numbers beyond 2⁵³;
/// [`Error::TooLarge`] for a frame with more than 2³¹ vertices; those of reading the points.
pub fn write_abc_sequence<R: Read + Seek>(
    frames: &[SequenceFrame],
    points: Option<&SequencePoints>,
    fps: f64,
    provenance: &Provenance,
    open: impl Fn(usize) -> io::Result<R>,
    out: &mut impl Write,
) -> Result<Vec<String>> {
    let (attributes, mut notes) = sequence_attributes(frames)?;
    let placement = SequencePlacement::of(frames, points.is_some(), FORMAT)?;
    let sequence = AbcSequence { frames, placement, attributes, points };
    let times = Times::Frames { times: sequence.times()?, fps };
    let objects = |ogawa: &mut Ogawa| {
        let mut objects = vec![sequence.object(&open, ogawa)?];
        objects.extend(points.map(|points| sequence.points_object(points, ogawa)).transpose()?);
        Ok(objects)
    };
    write_archive(provenance, &times, objects, out)?;
    notes.extend(points.into_iter().flat_map(SequencePoints::notes).cloned());
    Ok(notes)
}

/// A vertex attribute to write.
struct AbcAttribute {
    /// Its name in the frames' `.glb` files.
    semantic: String,
    name: String,
    kind: ParamType,
}

struct AbcSequence<'a> {
    frames: &'a [SequenceFrame],
    placement: SequencePlacement,
    /// All attributes to write, including the velocities.
    attributes: Vec<AbcAttribute>,
    points: Option<&'a SequencePoints<'a>>,
}

impl AbcSequence<'_> {
    /// The times of the samples, in frames.
    fn times(&self) -> Result<Vec<f64>> {
        if self.frames.is_empty() {
            return Err(Error::invalid(FORMAT, Position::File, "the sequence has no frames"));
        }
        check_numbers(FORMAT, self.frames.iter().map(|frame| (frame.name.as_str(), frame.code)))?;
        for frame in self.frames {
            check_vertex_count(frame.file.vertex_count() as u64)?;
        }
        Ok((0..self.frames.len()).flat_map(|index| self.times_of(index)).collect())
    }

    /// The times of the samples of a frame, in frames.
    fn times_of(&self, index: usize) -> impl Iterator<Item = f64> {
        let frame = &self.frames[index];
        let has_as_many_points = self.points.is_some_and(|points| points.is_as_large_as_next(index));
        let needs_hold = |next: &&SequenceFrame| {
            next.code - frame.code > 1
                || next.file.vertex_count() == frame.file.vertex_count()
                || has_as_many_points
        };
        held_times(frame.code, self.frames.get(index + 1).filter(needs_hold).map(|next| next.code))
    }

    /// The points beside the meshes.
    fn points_object(&self, points: &SequencePoints, ogawa: &mut Ogawa) -> Result<AbcObject> {
        let template = points.template();
        let typed = NarrowPoints::of(&template, FORMAT)?;
        let (names, are_wide) = (names_of(&typed.others()), are_wide(&typed.others()));
        let mut all: Vec<AbcProperty> = Vec::new();
        for index in 0..self.frames.len() {
            let frame = points.frame(index)?;
            let frame = NarrowPoints::around(&frame, points.origin, FORMAT)?;
            let geometry = point_geometry(&frame, &names, &are_wide, ogawa)?;
            for _ in self.times_of(index) {
                if all.is_empty() {
                    all.clone_from(&geometry);
                } else {
                    all.iter_mut().zip(&geometry).for_each(|(property, later)| property.append(later));
                }
            }
        }
        points_object(SEQUENCE_POINTS, &to_world(self.placement.up, points.origin), all, ogawa)
    }

    fn object<R: Read + Seek>(
        &self,
        open: &impl Fn(usize) -> io::Result<R>,
        ogawa: &mut Ogawa,
    ) -> Result<AbcObject> {
        let SequencePlacement { up, origin } = self.placement;
        let mut samples = MeshSamples::at(to_world(up, origin));
        let mut params: Vec<Vec<StoredSample>> = vec![Vec::new(); self.attributes.len()];
        for index in 0..self.frames.len() {
            let (frame, values) = self.frame(index, open, ogawa)?;
            for _ in self.times_of(index) {
                samples.push(frame);
                params.iter_mut().zip(&values).for_each(|(samples, sample)| samples.push(*sample));
            }
        }
        let (mut texture, mut others) = (None, Vec::new());
        for (attribute, samples) in self.attributes.iter().zip(params) {
            if attribute.is_texture() {
                texture = Some(attribute.kind.property(names::TEXTURE, samples));
            } else if !attribute.is_velocity() {
                others.push(attribute.kind.property(&attribute.name, samples));
            }
        }
        samples.object(texture, others, ogawa)
    }

    /// Writes the arrays of a frame. Returns the samples of the mesh, and those of the attributes.
    fn frame<R: Read + Seek>(
        &self,
        index: usize,
        open: &impl Fn(usize) -> io::Result<R>,
        ogawa: &mut Ogawa,
    ) -> Result<(FrameSamples, Vec<StoredSample>)> {
        let file = &self.frames[index].file;
        let shift = self.placement.shift(file)?;
        let (vertices, triangles) = (file.vertex_count() as u64, file.triangle_count()? as u64);
        let mut values = Vec::new();
        let mut reals = |semantic: &str, extent: u64, per_vertex: u64, ogawa: &mut Ogawa| {
            if !ogawa.is_measuring() {
                file.read_attribute(semantic, shift, &mut open(index)?, &mut values)?;
            }
            real_sample(&values, (vertices * per_vertex, extent), ogawa)
        };
        let positions = reals(POSITION, 3, 1, ogawa)?;
        let mut corners = Vec::new();
        if !ogawa.is_measuring() {
            file.read_triangles(&mut open(index)?, &mut corners)?;
        }
        let faces = triangle_samples(&corners, triangles, ogawa)?;
        drop(corners);
        let bounds = file.shifted_bounds(shift)?.map(|corner| corner.map(f64::from));
        let mut frame = FrameSamples {
            bounds: bounds_sample(bounds, ogawa)?,
            positions,
            faces,
            normals: reals(NORMAL, 3, 1, ogawa)?,
            velocities: None,
        };
        let mut samples = Vec::new();
        for attribute in &self.attributes {
            let ParamType { extent, elements, .. } = attribute.kind;
            let sample = reals(&attribute.semantic, extent.into(), elements as u64, ogawa)?;
            if attribute.is_velocity() {
                frame.velocities = Some(sample);
            }
            samples.push(sample);
        }
        Ok((frame, samples))
    }
}

impl AbcAttribute {
    fn is_velocity(&self) -> bool {
        self.semantic == VELOCITY && self.kind == ParamType::numbers(3)
    }

    /// Whether it has texture coordinates.
    fn is_texture(&self) -> bool {
        self.semantic == TEXTURE && self.kind == ParamType::numbers(2)
    }
}

/// The attributes that all frames with a mesh have, and notes on the others.
fn sequence_attributes(frames: &[SequenceFrame]) -> Result<(Vec<AbcAttribute>, Vec<String>)> {
    let (shared, mut notes) = shared_attributes(frames)?;
    let (mut found, mut used) = (Vec::new(), UsedNames::new(&[]));
    for SharedAttribute { semantic, name, arity } in shared {
        let wanted = plain_name(&name);
        let kind = match (semantic.as_str(), arity) {
            (COLOR, 3 | 4) => ParamType::color(arity),
            _ => ParamType::numbers(arity),
        };
        let mut attribute = AbcAttribute { semantic, name: String::new(), kind };
        if !attribute.is_velocity() && !attribute.is_texture() {
            attribute.name = used.take(&wanted);
            if attribute.name != wanted {
                notes.push(format!("{} is named {} in the sequence", attribute.semantic, attribute.name));
            }
        }
        found.push(attribute);
    }
    Ok((found, notes))
}
