//! Writes a sequence as one mesh with one or two samples per frame.
//!
//! ```text
//!   frames    5    6      9    10        6 is shown until 9
//!   samples   5    6   8.99    9    10   8.99 refers to the data of 6
//! ```
//!
//! At a time between two samples, programs show the mesh of the earlier or of the nearer one, or blend the two if
//! they have the same number of vertices. Where frames are missing or have the same number of vertices, the second
//! sample, just before the next frame, prevents this. Frame n is at n / fps seconds.
//!
//! The writer reads each array of a frame from the frame's file, a `.glb` of this crate, just before writing
//! the array. So only one array of one frame is in memory at a time.

use std::io::{self, Read, Seek, Write};

use crate::data::Provenance;
use crate::error::{Error, Position, Result};
use crate::frame_numbers::{check_numbers, held_times};
use crate::gltf::{POSITION, SequenceFrame, SequencePlacement, VertexColumn};
use crate::vertex_attributes::{UsedNames, plain_name};

use super::FORMAT;
use super::document::{AbcObject, AbcProperty, Times, write_archive};
use super::mesh::{
    FrameSamples, MeshSamples, ParamType, bounds_sample, real_sample, to_world, triangle_samples,
};
use super::ogawa::{Ogawa, Sample};
use super::write::check_vertex_count;

/// The limit of frame numbers: larger ones are not exact as 64-bit floats.
const NUMBER_MAX: u64 = 1 << 53;

const NORMAL: &str = "NORMAL";
const VELOCITY: &str = "_VELOCITY";
const COLOR: &str = "COLOR_0";

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
        check_numbers(FORMAT, NUMBER_MAX, self.frames.iter().map(|frame| (frame.name.as_str(), frame.code)))?;
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
        let reals = |semantic: &str, extent: u64, per_vertex: u64, ogawa: &mut Ogawa| {
            let found = match ogawa.is_measuring() {
                true => None,
                false => file.read_attribute(semantic, &transform, &mut open(index)?)?,
            };
            let values = found.map(|(_, values)| values).unwrap_or_default();
            real_sample(&values, (vertices * per_vertex, extent), ogawa)
        };
        let positions = reals(POSITION, 3, 1, ogawa)?;
        let corners = if file.has_mesh() && !ogawa.is_measuring() {
            file.read_triangles(&mut open(index)?)?
        } else {
            Vec::new()
        };
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
        let mut values = Vec::new();
        for attribute in &self.attributes {
            let ParamType { extent, elements, .. } = attribute.kind;
            let sample = reals(&attribute.semantic, extent.into(), elements as u64, ogawa)?;
            if attribute.is_velocity() {
                frame.velocities = Some(sample);
            }
            values.push(sample);
        }
        Ok((frame, values))
    }
}

impl AbcAttribute {
    fn is_velocity(&self) -> bool {
        self.semantic == VELOCITY && self.kind == ParamType::numbers(3)
    }
}

/// The attributes that all frames with a mesh have, and notes on the others.
fn attributes(frames: &[SequenceFrame]) -> Result<(Vec<AbcAttribute>, Vec<String>)> {
    let files = || frames.iter().map(|frame| &frame.file).filter(|file| file.has_mesh());
    let mut semantics: Vec<&String> = Vec::new();
    for file in files() {
        semantics.extend(file.attributes()?.keys());
    }
    semantics.sort();
    semantics.dedup();
    semantics.retain(|semantic| ![NORMAL, POSITION].contains(&semantic.as_str()));
    let (mut found, mut notes, mut used) = (Vec::new(), Vec::new(), UsedNames::new(&[]));
    for semantic in semantics {
        if files().any(|file| file.has_string_indices(semantic)) {
            notes.push(format!(
                "{semantic} is missing in the sequence: its values are strings, and each frame has its own table"
            ));
            continue;
        }
        let columns: Vec<Option<VertexColumn>> =
            files().map(|file| file.column(semantic)).collect::<Result<_>>()?;
        let arities: Option<Vec<usize>> = columns.iter().map(|column| Some((*column)?.arity)).collect();
        let arity =
            arities.and_then(|arities| arities.iter().all(|a| *a == arities[0]).then_some(arities[0]));
        let Some(arity) = arity else {
            notes.push(format!(
                "{semantic} is missing in the sequence: not all frames have it with the same number of values per vertex"
            ));
            continue;
        };
        let (kind, wanted) = match (semantic.as_str(), arity) {
            (COLOR, 3 | 4) => (ParamType::color(arity), "Cd".to_owned()),
            // In the `.glb` files, names start with an underscore and are in upper case.
            _ => {
                let name = plain_name(semantic.strip_prefix('_').unwrap_or(semantic)).to_ascii_lowercase();
                (ParamType::numbers(arity), name)
            }
        };
        let mut attribute = AbcAttribute { semantic: semantic.clone(), name: String::new(), kind };
        if !attribute.is_velocity() {
            attribute.name = used.take(&wanted, |stem| vec![stem.to_owned()]).concat();
            if attribute.name != wanted {
                notes.push(format!("{semantic} is named {} in the sequence", attribute.name));
            }
        }
        found.push(attribute);
    }
    Ok((found, notes))
}
