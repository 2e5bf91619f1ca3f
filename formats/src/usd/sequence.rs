//! The frames of a sequence in USD, the attributes that all of them have, and the points beside their meshes.

use super::{
    ACCELERATIONS, FORMAT, LayerInfo, MeshProperty, PropertyValue, RESERVED, TEXTURE, TEXTURE_KIND,
    VELOCITIES, identifier, interpolation, point_properties, vector,
};
use crate::data::{ParticleFrame, VertexAttribute};
use crate::error::Result;
use crate::gltf::{
    ACCELERATION, COLOR, NORMAL, POSITION, SequenceFrame, SequencePlacement, SharedAttribute,
    TEXTURE as GLTF_TEXTURE, VELOCITY, shared_attributes,
};
use crate::narrow_points::NarrowPoints;
use crate::sequence::{check_numbers, held_times};
use crate::sequence_points::SequencePoints;
use crate::vertex_attributes::UsedNames;

/// The frames of a sequence.
pub(crate) struct UsdSequence<'a> {
    pub(crate) frames: &'a [SequenceFrame],
    pub(crate) placement: SequencePlacement,
}

/// The extent without a mesh or points: the empty range of OpenUSD, so that no box contains the origin. OpenUSD warns of
/// an empty array.
const EMPTY_EXTENT: [[f32; 3]; 2] = [[f32::MAX; 3], [f32::MIN; 3]];

/// A vertex attribute to write.
pub(crate) struct SequenceAttribute {
    /// Its name in the frames' `.glb` files.
    pub(crate) semantic: String,
    /// Its type and name in USD.
    pub(crate) kind: String,
    pub(crate) name: String,
    /// The components to write: the index of the first, and their number.
    pub(crate) first: usize,
    pub(crate) arity: usize,
    /// Its interpolation, if it needs one.
    pub(crate) interpolation: Option<&'static str>,
}

impl SequenceAttribute {
    fn new(semantic: &str, (kind, name): (&str, &str), first: usize, arity: usize) -> SequenceAttribute {
        let interpolation = interpolation(name);
        let [semantic, kind, name] = [semantic, kind, name].map(str::to_owned);
        SequenceAttribute { semantic, kind, name, first, arity, interpolation }
    }
}

impl<'a> UsdSequence<'a> {
    /// Checks the frames, whose numbers must increase, and beside which there may be points.
    pub(crate) fn of(frames: &'a [SequenceFrame], has_points: bool) -> Result<UsdSequence<'a>> {
        check_numbers(FORMAT, frames.iter().map(|frame| (frame.name.as_str(), frame.code)))?;
        Ok(UsdSequence { frames, placement: SequencePlacement::of(frames, has_points, FORMAT)? })
    }

    /// The first and the last time code, or zeros without frames.
    pub(crate) fn code_range(&self) -> [i64; 2] {
        [self.frames.first(), self.frames.last()].map(|frame| frame.map_or(0, |frame| frame.code))
    }

    /// The summary of all frames.
    pub(crate) fn layer_info(&self) -> Result<LayerInfo> {
        let mut info = LayerInfo { frames: Some(self.frames.len() as u64), ..LayerInfo::default() };
        for frame in self.frames {
            info.vertices += frame.file.vertex_count() as u64;
            info.faces += frame.file.triangle_count()? as u64;
        }
        Ok(info)
    }

    /// The attributes that all frames with a mesh have, and notes on the others.
    pub(crate) fn attributes(&self) -> Result<(Vec<SequenceAttribute>, Vec<String>)> {
        let mut found = vec![
            SequenceAttribute::new(NORMAL, ("normal3f[]", "normals"), 0, 3),
            SequenceAttribute::new(POSITION, ("point3f[]", "points"), 0, 3),
        ];
        let (shared, mut notes) = shared_attributes(self.frames)?;
        let mut used = UsedNames::new(&RESERVED);
        let has_texture =
            |attribute: &SharedAttribute| attribute.semantic == GLTF_TEXTURE && attribute.arity == 2;
        if shared.iter().any(has_texture) {
            used.take(TEXTURE);
        }
        for SharedAttribute { semantic, name, arity } in shared {
            let attribute = |about, first, arity| SequenceAttribute::new(&semantic, about, first, arity);
            match (semantic.as_str(), arity) {
                (VELOCITY, 3) => found.push(attribute(("vector3f[]", VELOCITIES), 0, 3)),
                (ACCELERATION, 3) => found.push(attribute(("vector3f[]", ACCELERATIONS), 0, 3)),
                (COLOR, 3 | 4) => {
                    found.push(attribute(("color3f[]", "primvars:displayColor"), 0, 3));
                    let opacity = attribute(("float[]", "primvars:displayOpacity"), 3, 1);
                    found.extend((arity == 4).then_some(opacity));
                }
                (GLTF_TEXTURE, 2) => {
                    found.push(attribute((TEXTURE_KIND, &format!("primvars:{TEXTURE}")), 0, 2));
                }
                _ => {
                    let kind = format!("{}[]", vector("float", arity));
                    let wanted = identifier(&name);
                    let plain = used.take(&wanted);
                    if plain != wanted {
                        notes.push(format!("{semantic} is named primvars:{plain} in the sequence"));
                    }
                    found.push(attribute((&kind, &format!("primvars:{plain}")), 0, arity));
                }
            }
        }
        Ok((found, notes))
    }

    /// What must be added to the positions of a frame.
    pub(crate) fn shift(&self, index: usize) -> Result<[f64; 3]> {
        self.placement.shift(&self.frames[index].file)
    }

    /// The minimum and maximum corner of a frame, relative to the sequence's origin, or the [`EMPTY_EXTENT`].
    pub(crate) fn extent(&self, index: usize) -> Result<[[f32; 3]; 2]> {
        if !self.frames[index].file.has_mesh() {
            return Ok(EMPTY_EXTENT);
        }
        self.frames[index].file.shifted_bounds(self.shift(index)?)
    }

    /// The origin of the sequence, unless it is zero.
    pub(crate) fn origin(&self) -> Option<[f64; 3]> {
        Some(self.placement.origin).filter(|origin| *origin != [0.0; 3])
    }

    /// The [time codes](held_times) at which a frame needs a sample of a value that has the same size in all
    /// frames, such as its extent.
    pub(crate) fn held_codes(&self, index: usize) -> impl Iterator<Item = f64> {
        held_times(self.frames[index].code, self.frames.get(index + 1).map(|next| next.code))
    }

    /// The [time codes](held_times) at which a frame needs samples of the values of its vertices.
    pub(crate) fn vertex_codes(&self, index: usize) -> impl Iterator<Item = f64> {
        let frame = &self.frames[index];
        let is_as_large = |next: &&SequenceFrame| next.file.vertex_count() == frame.file.vertex_count();
        held_times(frame.code, self.frames.get(index + 1).filter(is_as_large).map(|next| next.code))
    }
}

/// The points beside the meshes of a sequence.
pub(crate) struct UsdSequencePoints<'a> {
    points: &'a SequencePoints<'a>,
    codes: Vec<i64>,
    /// See [`SequencePoints::template`].
    template: ParticleFrame,
}

impl<'a> UsdSequencePoints<'a> {
    pub(crate) fn of(shot: &UsdSequence, points: &'a SequencePoints<'a>) -> UsdSequencePoints<'a> {
        let codes = shot.frames.iter().map(|frame| frame.code).collect();
        UsdSequencePoints { points, codes, template: points.template() }
    }

    /// The indices of the frames.
    pub(crate) fn frames(&self) -> std::ops::Range<usize> {
        0..self.codes.len()
    }

    /// The number of points in all frames.
    pub(crate) fn total(&self) -> usize {
        self.points.total()
    }

    /// Notes on attributes that the sequence does not have.
    pub(crate) fn notes(&self) -> &[String] {
        self.points.notes()
    }

    /// The origin of the points, unless it is zero.
    pub(crate) fn origin(&self) -> Option<[f64; 3]> {
        Some(self.points.origin).filter(|origin| *origin != [0.0; 3])
    }

    /// The minimum and maximum corner of a frame, relative to the origin, or the [`EMPTY_EXTENT`].
    pub(crate) fn extent(&self, index: usize) -> [[f32; 3]; 2] {
        self.points.extent(index).unwrap_or(EMPTY_EXTENT)
    }

    /// The [time codes](held_times) at which a frame needs a sample of its extent.
    pub(crate) fn held_codes(&self, index: usize) -> impl Iterator<Item = f64> {
        held_times(self.codes[index], self.codes.get(index + 1).copied())
    }

    /// The [time codes](held_times) at which a frame needs samples of the values of its points.
    pub(crate) fn point_codes(&self, index: usize) -> impl Iterator<Item = f64> {
        self.points.held_times(&self.codes, index)
    }

    /// The properties that every frame has, in their order, with their types but values of no frame.
    ///
    /// # Errors
    /// Those of `of`.
    pub(crate) fn with_template<T>(&self, of: impl FnOnce(&[MeshProperty]) -> Result<T>) -> Result<T> {
        let points = NarrowPoints::of(&self.template, FORMAT)?;
        of(&arrays(&points, &points.others()))
    }

    /// Reads the points of a frame, and passes on the properties, which have no values in a frame without points.
    ///
    /// # Errors
    /// Those of reading the points and of `of`.
    pub(crate) fn with_properties<T>(
        &self,
        index: usize,
        of: impl FnOnce(&[MeshProperty]) -> Result<T>,
    ) -> Result<T> {
        let frame = self.points.frame(index)?;
        let points = NarrowPoints::around(&frame, self.points.origin, FORMAT)?;
        let others = points.others();
        self.with_template(|template| {
            let mut properties = arrays(&points, &others);
            // A frame with narrow ids has them twice, and a sequence only if those of all frames are narrow.
            properties.retain(|property| template.iter().any(|typed| typed.name == property.name));
            for (property, typed) in properties.iter_mut().zip(template) {
                if property.kind != typed.kind {
                    property.widen();
                }
            }
            of(&properties)
        })
    }
}

/// The properties with a value per point, or with a table of such values.
fn arrays<'a>(points: &'a NarrowPoints<'_>, others: &[VertexAttribute<'a>]) -> Vec<MeshProperty<'a>> {
    let mut properties = point_properties(points, others, false);
    properties
        .retain(|property| matches!(property.value, PropertyValue::Array(_) | PropertyValue::StringTable(_)));
    properties
}
