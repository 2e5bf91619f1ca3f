//! The placement of the frames of a sequence, relative to one origin.

use std::io::{Read, Seek};

use super::frame_file::{FramePlacement, GlbFrame, POSITION};
use super::sequence::SequenceFrame;
use crate::error::{Error, Position, Result};
use crate::mesh_options::UpAxis;

/// The placement of all frames of a sequence.
///
/// Frames far from the world's origin have origins of their own, which jump from one frame to the next.
/// Programs interpolate transforms, and compute motion blur from them. So a sequence has one origin, that of
/// its first frame with a mesh, and the positions of all frames are relative to it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct SequencePlacement {
    pub(crate) up: UpAxis,
    pub(crate) origin: [f64; 3],
}

/// How the positions in the file of a frame become positions of a sequence.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PositionTransform {
    shift: [f64; 3],
}

impl SequencePlacement {
    /// The placement of these frames.
    ///
    /// # Errors
    ///
    /// [`Error::Invalid`] if a document is damaged, or if frames differ in their up axis.
    pub(crate) fn of(frames: &[SequenceFrame], format: &'static str) -> Result<SequencePlacement> {
        let mut placement = None;
        for frame in frames.iter().filter(|frame| frame.file.has_mesh()) {
            let FramePlacement { up, origin } = frame.file.placement()?;
            let first = placement.get_or_insert(SequencePlacement { up, origin });
            if up != first.up {
                let what = "some frames have Y up and others Z up: convert all frames with the same --up";
                return Err(Error::invalid(format, Position::File, what));
            }
        }
        Ok(placement.unwrap_or_default())
    }

    /// The transform of the positions of a frame.
    pub(crate) fn transform(&self, frame: &GlbFrame) -> Result<PositionTransform> {
        if !frame.has_mesh() {
            return Ok(PositionTransform { shift: [0.0; 3] });
        }
        let origin = frame.placement()?.origin;
        Ok(PositionTransform { shift: std::array::from_fn(|axis| origin[axis] - self.origin[axis]) })
    }
}

impl PositionTransform {
    #[expect(clippy::cast_possible_truncation, reason = "positions are written in 32 bits")]
    fn shifted(&self, axis: usize, coordinate: f32) -> f32 {
        (f64::from(coordinate) + self.shift[axis]) as f32
    }
}

impl GlbFrame {
    /// Reads a vertex attribute, whose numbers replace the `values`. Returns how many each vertex has; `None`
    /// if the vertices do not have the attribute. Positions are transformed.
    pub(crate) fn read_attribute(
        &self,
        semantic: &str,
        positions: &PositionTransform,
        file: &mut (impl Read + Seek),
        values: &mut Vec<f32>,
    ) -> Result<Option<usize>> {
        values.clear();
        let Some(column) = self.column(semantic)? else { return Ok(None) };
        self.read_column(&column, file, values)?;
        if semantic == POSITION {
            for position in values.as_chunks_mut::<3>().0 {
                *position = std::array::from_fn(|axis| positions.shifted(axis, position[axis]));
            }
        }
        Ok(Some(column.arity))
    }

    /// The smallest and the largest transformed position; zeros for a frame without a mesh.
    pub(crate) fn transformed_bounds(&self, positions: &PositionTransform) -> Result<[[f32; 3]; 2]> {
        #[expect(clippy::cast_possible_truncation, reason = "positions are written in 32 bits")]
        let corner =
            |corner: [f64; 3]| std::array::from_fn(|axis| positions.shifted(axis, corner[axis] as f32));
        Ok(self.bounds()?.map(corner))
    }
}
