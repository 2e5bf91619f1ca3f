//! Writes particles as VTK's XML PolyData, `.vtp`: each point is also a cell, so that ParaView displays it.
//!
//! ```text
//!   <PointData> every attribute under its own name, with its own type
//!   <Points>    floats of 32 or 64 bits, as in the particles
//!   <Verts>     connectivity 0 1 2 .., offsets 1 2 3 ..
//! ```
//!
//! See [`super::appended`] for the document around the data.

use std::borrow::Cow;
use std::io::Write;

use crate::data::{FilePositions, ParticleFrame, Provenance, Values};
use crate::error::Result;
use crate::le_bytes::{write_f32s, write_pieces};
use crate::particle_columns::{check, written};
use crate::vertex_attributes::string_index;

use super::XML;
use super::appended::{
    Array, ArrayData, CellKind, FLOAT_32, FLOAT_64, INT_32, INT_64, NumberKind, UINT_8, VtpDocument, names_of,
};

/// Writes positions and attributes.
///
/// # Errors
///
/// [`crate::Error::Io`] if `out` fails; [`crate::Error::Invalid`] if an attribute has the wrong number of
/// values.
pub fn write_particles(frame: &ParticleFrame, provenance: &Provenance, out: &mut impl Write) -> Result<()> {
    check(frame, XML)?;
    document(frame).write(provenance, out)
}

/// Notes on attributes that a .vtp file cannot store exactly.
pub fn particle_notes(frame: &ParticleFrame) -> Vec<String> {
    let mut notes = Vec::new();
    for (attribute, name) in frame.attributes.iter().zip(names_in_file(frame)) {
        if attribute.name != name {
            notes.push(format!("{} is named {name} in the .vtp", attribute.name));
        }
        if matches!(attribute.values, Values::Strings { .. }) {
            notes.push(format!("{name} is stored as indices in the .vtp; the strings are in its field data"));
        }
    }
    notes
}

fn names_in_file(frame: &ParticleFrame) -> Vec<String> {
    names_of(frame.attributes.iter().map(|attribute| &*attribute.name), &[])
}

fn document(frame: &ParticleFrame) -> VtpDocument<ParticleArray<'_>> {
    let point_count = frame.positions.len();
    let attributes = frame.attributes.iter().zip(names_in_file(frame));
    VtpDocument {
        normals: None,
        of_points: attributes
            .map(|(attribute, name)| {
                Array::new(name, attribute.arity, ParticleArray::Values(written(attribute)))
            })
            .collect(),
        point_count,
        points: ParticleArray::Positions(&frame.positions),
        cells: CellKind::Verts,
        cell_count: point_count,
        connectivity: ParticleArray::Counted(0, point_count),
        offsets: ParticleArray::Counted(1, point_count),
    }
}

/// The data of an array.
enum ParticleArray<'a> {
    Values(Cow<'a, Values>),
    Positions(&'a FilePositions),
    /// Consecutive integers: the first, and their number.
    Counted(i64, usize),
}

impl ArrayData for ParticleArray<'_> {
    fn kind(&self) -> NumberKind {
        match self {
            ParticleArray::Positions(FilePositions::F32(_)) => FLOAT_32,
            ParticleArray::Positions(FilePositions::F64(_)) => FLOAT_64,
            ParticleArray::Counted(..) => INT_64,
            ParticleArray::Values(values) => match &**values {
                Values::F32(_) => FLOAT_32,
                Values::F64(_) => FLOAT_64,
                Values::U8(_) => UINT_8,
                Values::I32(_) | Values::Strings { .. } => INT_32,
                Values::I64(_) => INT_64,
            },
        }
    }

    fn count(&self) -> u64 {
        let count = match self {
            ParticleArray::Positions(positions) => 3 * positions.len(),
            ParticleArray::Counted(_, count) => *count,
            ParticleArray::Values(values) => crate::number::length(values),
        };
        count as u64
    }

    fn table(&self) -> Option<&[String]> {
        let ParticleArray::Values(values) = self else { return None };
        let Values::Strings { table, .. } = &**values else { return None };
        Some(table)
    }

    fn write(&self, out: &mut impl Write) -> Result<()> {
        match self {
            ParticleArray::Positions(FilePositions::F32(positions)) => {
                write_f32s(positions.as_flattened(), out)
            }
            ParticleArray::Positions(FilePositions::F64(positions)) => {
                write_pieces(positions.as_flattened(), f64::to_le_bytes, out)
            }
            ParticleArray::Counted(from, count) => {
                let mut next = *from;
                for piece in (0..*count).step_by(PIECE) {
                    let length = PIECE.min(count - piece) as i64;
                    let numbers: Vec<i64> = (next..next + length).collect();
                    write_pieces(&numbers, i64::to_le_bytes, out)?;
                    next += length;
                }
                Ok(())
            }
            ParticleArray::Values(values) => match &**values {
                Values::F32(values) => write_f32s(values, out),
                Values::F64(values) => write_pieces(values, f64::to_le_bytes, out),
                Values::U8(values) => Ok(out.write_all(values)?),
                Values::I32(values) => write_pieces(values, i32::to_le_bytes, out),
                Values::I64(values) => write_pieces(values, i64::to_le_bytes, out),
                Values::Strings { table, indices } => {
                    write_pieces(indices, |index| string_index(index, table).to_le_bytes(), out)
                }
            },
        }
    }
}

/// Number of values encoded at a time.
const PIECE: usize = 4096;
