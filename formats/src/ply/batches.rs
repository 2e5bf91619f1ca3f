//! Locates the vertices of a binary PLY file, so that they can be read in batches.

use std::sync::Arc;

use crate::bytes::Endian;
use crate::data::{AttributeRole, FilePositions};
use crate::error::Result;
use crate::limits::Limits;
use crate::records::Records;
use crate::scalar::Scalar;

use super::FORMAT;
use super::binary::{gather_part, scalar_offsets};
use super::header::{Element, PlyHeader};
use super::read::{VertexElement, fits_f32, frame_of_records, note_on_faces, notes, scalar_of, vertices};
use super::rows::{check_limit, checked_binary_count};
use super::target::{Slots, Target};

/// Locates the vertices in a file of `file_bytes` bytes. `None` if their offsets cannot be computed: in an
/// ASCII file, or if the vertices or an earlier element have lists.
///
/// # Errors
/// Those of [`super::read`], after the header.
pub(super) fn records(header: &PlyHeader, file_bytes: u64, limits: &Limits) -> Result<Option<Records>> {
    let VertexElement { element, columns, position } = vertices(header)?;
    let Some(endian) = header.encoding.endian() else { return Ok(None) };
    let earlier = || header.elements.iter().take_while(|earlier| !std::ptr::eq(*earlier, element));
    if element.has_list() || earlier().any(Element::has_list) {
        return Ok(None);
    }
    let mut at = header.body_offset as u64;
    for element in earlier() {
        let count = checked_binary_count(element, at, file_bytes - at)?;
        at += (count * element.record_size_min()) as u64;
    }
    let count = checked_binary_count(element, at, file_bytes - at)?;
    check_limit(count, limits)?;
    let (offsets, stride) = scalar_offsets(element);
    let scalars = position.map(|property| scalar_of(element, property));
    let mut notes = notes(element, &columns);
    notes.extend(note_on_faces(header));
    let velocity = columns.groups.iter().find(|group| group.role == Some(AttributeRole::Velocity));
    let velocity = velocity.map(|group| group.name.clone());
    let columns = PositionColumns { offsets: position.map(|property| offsets[property]), scalars };
    let gather =
        Arc::new(move |records: &[u8], stride: usize, count: usize, positions: &mut FilePositions| {
            columns.gather(records, stride, endian, count, positions);
        });
    let header = header.clone();
    let frame = Arc::new(move |records: &[u8]| frame_of_records(&header, records, endian));
    Ok(Some(Records { format: FORMAT, offset: at, stride, count, gather, frame, notes, velocity }))
}

/// The location of a position in a record: offsets in bytes, and types.
struct PositionColumns {
    offsets: [usize; 3],
    scalars: [Scalar; 3],
}

impl PositionColumns {
    /// Replaces `positions` with the positions of `count` records.
    fn gather(
        &self,
        records: &[u8],
        stride: usize,
        endian: Endian,
        count: usize,
        positions: &mut FilePositions,
    ) {
        match (fits_f32(self.scalars), &mut *positions) {
            (true, FilePositions::F32(positions)) => positions.resize(count, [0.0; 3]),
            (true, FilePositions::F64(_)) => *positions = FilePositions::F32(vec![[0.0; 3]; count]),
            (false, FilePositions::F64(positions)) => positions.resize(count, [0.0; 3]),
            (false, FilePositions::F32(_)) => *positions = FilePositions::F64(vec![[0.0; 3]; count]),
        }
        let slots = match positions {
            FilePositions::F32(positions) => Slots::F32(positions.as_flattened_mut()),
            FilePositions::F64(positions) => Slots::F64(positions.as_flattened_mut()),
        };
        let columns = self.scalars.into_iter().enumerate().collect();
        gather_part(records, stride, &self.offsets, endian, &mut [Target { columns, slots }]);
    }
}
