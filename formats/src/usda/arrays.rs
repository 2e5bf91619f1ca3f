//! Formats arrays as text in chunks: `(0.5, 1, 2), (0.25, 1, 2), ..`.

use std::ops::Range;

use rayon::prelude::*;

use crate::quads::faces;
use crate::usd::Elements;
use crate::vertex_attributes::string_index;

use super::numbers::NumberWriter;

/// Number of elements formatted per task.
const ELEMENTS_PER_TASK: usize = 1 << 13;

impl Elements<'_> {
    /// The number of elements; for faces, the number of triangles.
    fn count(&self) -> usize {
        match self {
            Elements::Reals { values, stride, .. } => values.len() / stride,
            Elements::Integers { values, arity, .. } => values.len() / arity,
            Elements::Strings { indices, .. } => indices.len(),
            Elements::FaceCounts { triangles, .. } | Elements::FaceCorners { triangles, .. } => {
                triangles.len()
            }
        }
    }

    /// The number of tasks for all elements.
    pub(super) fn task_count(&self) -> usize {
        self.count().div_ceil(ELEMENTS_PER_TASK)
    }

    /// The text of all elements, in pieces.
    pub(super) fn texts(&self) -> Vec<Vec<u8>> {
        (0..self.task_count()).into_par_iter().map(|task| self.text_of(task)).collect()
    }

    /// The text of one task.
    pub(super) fn text_of(&self, task: usize) -> Vec<u8> {
        const ELEMENT_BYTES: usize = 40; // few are longer
        let start = (task * ELEMENTS_PER_TASK).min(self.count());
        let range = start..(start + ELEMENTS_PER_TASK).min(self.count());
        let mut numbers = NumberWriter::with_capacity(range.len() * ELEMENT_BYTES);
        self.append(range, &mut numbers);
        // A separator precedes each element, except the first one of the array.
        match task {
            0 => numbers.text.split_off(SEPARATOR_BYTES.min(numbers.text.len())),
            _ => numbers.text,
        }
    }

    fn append(&self, range: Range<usize>, numbers: &mut NumberWriter) {
        match *self {
            Elements::Reals { values, stride, first, arity } => {
                for element in values[range.start * stride..range.end * stride].chunks_exact(stride) {
                    numbers.separate();
                    numbers.tuple(&element[first..first + arity], NumberWriter::real);
                }
            }
            Elements::Integers { values, arity, .. } => {
                for element in values[range.start * arity..range.end * arity].chunks_exact(arity) {
                    numbers.separate();
                    numbers.tuple(element, NumberWriter::integer);
                }
            }
            Elements::Strings { table, indices } => {
                for &index in &indices[range] {
                    numbers.separate();
                    let index = usize::try_from(string_index(index, table)).unwrap_or(table.len());
                    numbers.integer(index);
                }
            }
            Elements::FaceCounts { triangles, quads } => {
                for face in faces(triangles, quads, range) {
                    numbers.separate();
                    numbers.integer(face.corners().len());
                }
            }
            Elements::FaceCorners { triangles, quads } => {
                for &corner in
                    faces(triangles, quads, range).collect::<Vec<_>>().iter().flat_map(|face| face.corners())
                {
                    numbers.separate();
                    numbers.integer(corner);
                }
            }
        }
    }
}

/// Length in bytes of the text that [`NumberWriter::separate`] writes.
const SEPARATOR_BYTES: usize = 2;
