//! Arrays as text, a run of elements at a time: `(0.5, 1, 2), (0.25, 1, 2), ..`.

use std::ops::Range;

use rayon::prelude::*;

use crate::quads::faces;
use crate::vertex_attributes::string_index;

use super::numbers::Numbers;

/// Elements that are formatted as one task.
const ELEMENTS_PER_TASK: usize = 1 << 13;

/// What an array is of.
#[derive(Clone, Copy)]
pub(super) enum Elements<'a> {
    /// `arity` numbers from `first` on of each `stride`.
    Reals {
        values: &'a [f32],
        stride: usize,
        first: usize,
        arity: usize,
    },
    Integers {
        values: &'a [i64],
        arity: usize,
    },
    /// Indices into so many strings; where there is none, the index behind the last.
    Strings {
        table: &'a [String],
        indices: &'a [i32],
    },
    /// How many corners each face has, and which vertices they are.
    FaceCounts {
        triangles: &'a [[u32; 3]],
        quads: &'a [bool],
    },
    FaceCorners {
        triangles: &'a [[u32; 3]],
        quads: &'a [bool],
    },
}

impl<'a> Elements<'a> {
    /// Vectors of this many numbers each.
    pub(super) fn reals(values: &'a [f32], arity: usize) -> Elements<'a> {
        Elements::Reals { values, stride: arity, first: 0, arity }
    }

    /// Elements; of faces, their triangles.
    fn count(&self) -> usize {
        match self {
            Elements::Reals { values, stride, .. } => values.len() / stride,
            Elements::Integers { values, arity } => values.len() / arity,
            Elements::Strings { indices, .. } => indices.len(),
            Elements::FaceCounts { triangles, .. } | Elements::FaceCorners { triangles, .. } => {
                triangles.len()
            }
        }
    }

    /// How many tasks it takes to format all of them.
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
        let mut numbers = Numbers::with_capacity(range.len() * ELEMENT_BYTES);
        self.append(range, &mut numbers);
        // What stands between two elements comes with the second, which is never the first of all.
        match task {
            0 => numbers.text.split_off(SEPARATOR_BYTES.min(numbers.text.len())),
            _ => numbers.text,
        }
    }

    fn append(&self, range: Range<usize>, numbers: &mut Numbers) {
        match *self {
            Elements::Reals { values, stride, first, arity } => {
                for element in values[range.start * stride..range.end * stride].chunks_exact(stride) {
                    numbers.separate();
                    numbers.tuple(&element[first..first + arity], Numbers::real);
                }
            }
            Elements::Integers { values, arity } => {
                for element in values[range.start * arity..range.end * arity].chunks_exact(arity) {
                    numbers.separate();
                    numbers.tuple(element, Numbers::integer);
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

/// Bytes of what [`Numbers::separate`] writes.
const SEPARATOR_BYTES: usize = 2;
