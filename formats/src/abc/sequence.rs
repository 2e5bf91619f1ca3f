//! Writes a sequence as one mesh with one or two samples per frame.
//!
//! ```text
//!   frames    5    6      9    10        6 is shown until 9
//!   samples   5    6   8.99    9    10   8.99 refers to the data of 6
//! ```
//!
//! At a time between two samples, programs show the mesh of the earlier or of the nearer one, or blend the
//! two if they have the same number of vertices. Where frames are missing or have the same number of
//! vertices, the second sample, just before the next frame, prevents this. Frame n is at n / fps seconds.
//!
//! The writer reads each array of a frame from the frame's file, a `.glb` of this crate, just before writing
//! the array. So only one array of one frame is in memory at a time.

use std::io::{self, Read, Seek, Write};

use crate::data::Provenance;
use crate::error::{Error, Position, Result};
use crate::frame_numbers::{check_numbers, held_times};
use crate::gltf::{
    COLOR, NORMAL, POSITION, SequenceFrame, SequencePlacement, SharedAttribute, VELOCITY, shared_attributes,
};
use crate::vertex_attributes::{UsedNames, plain_name};

use super::FORMAT;
use super::document::{AbcObject, AbcProperty, Times, write_archive};
use super::mesh::{
    FrameSamples, MeshSamples, ParamType, bounds_sample, real_sample, to_world, triangle_samples,
};
use super::ogawa::{Ogawa, Sample};
use super::write::check_vertex_count;

/// Writes a sequence of frames, whose numbers must increase. `open` opens the file of a frame, by its index.
/// Returns notes on attributes that are renamed, or omitted because the frames differ in them.
///
/// # Errors
///
/// [`Error::Io`] if a file cannot be read or `out` fails; [`Error::Invalid`] if a document is damaged, a file
/// changed, numbers do not increase, or there are no frames; [`Error::Unsupported`] for numbers beyond 2⁵³;
/// [`Error::TooLarge`] for a frame with more than 2³¹ vertices.
pub fn write_sequence<R: Read + Seek>(
    frames: &[SequenceFrame],
    fps: f64,
    provenance: &Provenance,
    open: impl Fn(usize) -> io::Result<R>,
    out: &mut impl Write,
) -> Result<Vec<String>> {
    let (attributes, notes) = attributes(frames)?;
    let sequence = AbcSequence { frames, placement: SequencePlacement::of(frames, FORMAT)?, attributes };
    let times = Times::Frames { times: sequence.times()?, fps };
    write_archive(provenance, &times, |ogawa| sequence.object(&open, ogawa), out)?;
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
        let needs_hold = |next: &&SequenceFrame| {
            next.code - frame.code > 1 || next.file.vertex_count() == frame.file.vertex_count()
        };
        held_times(frame.code, self.frames.get(index + 1).filter(needs_hold).map(|next| next.code))
    }

    fn object<R: Read + Seek>(
        &self,
        open: &impl Fn(usize) -> io::Result<R>,
        ogawa: &mut Ogawa,
    ) -> Result<AbcObject> {
        let SequencePlacement { up, origin } = self.placement;
        let mut samples = MeshSamples::at(to_world(up, origin));
        let mut params: Vec<Vec<Sample>> = vec![Vec::new(); self.attributes.len()];
        for index in 0..self.frames.len() {
            let (frame, values) = self.frame(index, open, ogawa)?;
            for _ in self.times_of(index) {
                samples.push(frame);
                params.iter_mut().zip(&values).for_each(|(samples, sample)| samples.push(*sample));
            }
        }
        let others = self.attributes.iter().zip(params).filter(|(attribute, _)| !attribute.is_velocity());
        let params: Vec<AbcProperty> =
            others.map(|(attribute, samples)| attribute.kind.property(&attribute.name, samples)).collect();
        samples.object(params, ogawa)
    }

    /// Writes the arrays of a frame. Returns the samples of the mesh, and those of the attributes.
    fn frame<R: Read + Seek>(
        &self,
        index: usize,
        open: &impl Fn(usize) -> io::Result<R>,
        ogawa: &mut Ogawa,
    ) -> Result<(FrameSamples, Vec<Sample>)> {
        let file = &self.frames[index].file;
        let transform = self.placement.transform(file)?;
        let (vertices, triangles) = (file.vertex_count() as u64, file.triangle_count()? as u64);
        let mut values = Vec::new();
        let mut reals = |semantic: &str, extent: u64, per_vertex: u64, ogawa: &mut Ogawa| {
            if !ogawa.is_measuring() {
                file.read_attribute(semantic, &transform, &mut open(index)?, &mut values)?;
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
        let bounds = file.transformed_bounds(&transform)?.map(|corner| corner.map(f64::from));
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
}

/// The attributes that all frames with a mesh have, and notes on the others.
fn attributes(frames: &[SequenceFrame]) -> Result<(Vec<AbcAttribute>, Vec<String>)> {
    let (shared, mut notes) = shared_attributes(frames)?;
    let (mut found, mut used) = (Vec::new(), UsedNames::new(&[]));
    for SharedAttribute { semantic, name, arity } in shared {
        let wanted = plain_name(&name);
        let kind = match (semantic.as_str(), arity) {
            (COLOR, 3 | 4) => ParamType::color(arity),
            _ => ParamType::numbers(arity),
        };
        let mut attribute = AbcAttribute { semantic, name: String::new(), kind };
        if !attribute.is_velocity() {
            attribute.name = used.take(&wanted, |stem| vec![stem.to_owned()]).concat();
            if attribute.name != wanted {
                notes.push(format!("{} is named {} in the sequence", attribute.semantic, attribute.name));
            }
        }
        found.push(attribute);
    }
    Ok((found, notes))
}
