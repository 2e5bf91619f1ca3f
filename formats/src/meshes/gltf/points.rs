//! Reads particles from glTF: the primitives of points, as placed by the default scene.

use ::gltf::mesh::Mode;
use ::gltf::{Primitive, Semantic};

use super::read::{Buffers, OpenDocument, invalid, open, placed_meshes, scale_of, spend};
use super::{ARITY_MAX, FORMAT, VALUE_BYTES, values_of};
use crate::core::data::{FileAttribute, ParticleFrame, Values};
use crate::core::error::{Error, Result};
use crate::core::limits::Limits;
use crate::core::matrix::{IDENTITY, Matrix, change_vectors, transformed};
use crate::core::named_arrays::{ParticlePart, frame_of_parts, placed};
use crate::core::number::{gathered, positions, wide};
use crate::core::row::{FormatRow, ParticleReader};

/// The row of files with points. Their signature and their names are those of meshes: [`declares_points`] identifies them.
pub(crate) static POINTS: FormatRow =
    FormatRow { particles: Some(ParticleReader::needs_reading(read)), ..FormatRow::new("glTF points", &[]) };

/// Whether all primitives of the document are points, which have the mode 0, judged by the first bytes of the file. Other
/// documents are meshes.
pub(crate) fn declares_points(head: &[u8]) -> bool {
    let after = |word: &'static [u8]| {
        let is_word = move |(_, found): &(usize, &[u8])| *found == word;
        head.windows(word.len()).enumerate().filter(is_word).map(|(at, word)| &head[at + word.len()..])
    };
    let is_zero = |rest: &&[u8]| {
        let value = rest.trim_ascii_start().strip_prefix(b":").unwrap_or_default().trim_ascii_start();
        value.starts_with(b"0") && !value.get(1).is_some_and(u8::is_ascii_digit)
    };
    let count = after(b"\"mode\"").filter(is_zero).count();
    count > 0 && count == after(b"\"attributes\"").count()
}

/// Reads all points, with their attributes. Positions have 64 bits if the scene moves them.
fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let OpenDocument { document, transforms, buffers, mut budget } = open(bytes, limits, None)?;
    let (mut parts, mut notes, mut count) = (Vec::new(), Vec::new(), 0);
    for (mesh, placement) in placed_meshes(&document, &transforms)? {
        for primitive in mesh.primitives() {
            if primitive.mode() == Mode::Points {
                parts.extend(part(&primitive, &placement, &buffers, &mut budget, &mut notes)?);
                count += parts.last().map_or(0, |part| part.positions.len() as u64);
                limits.check_particles(FORMAT, count)?;
            } else {
                notes.push("skipped the lines and triangles of the file".to_owned());
            }
        }
    }
    notes.sort();
    notes.dedup();
    if parts.is_empty() {
        return Err(Error::unsupported(FORMAT, crate::core::row::MESH_REFUSAL));
    }
    Ok(frame_of_parts(parts, "primitives", notes))
}

/// The points of a primitive; `None` if it has no positions.
fn part(
    primitive: &Primitive,
    placement: &Matrix,
    buffers: &Buffers,
    budget: &mut u64,
    notes: &mut Vec<String>,
) -> Result<Option<ParticlePart>> {
    let indices = primitive.indices().map(|indices| buffers.indices(&indices)).transpose()?;
    let (mut arrays, mut found) = (Vec::new(), None);
    for (semantic, accessor) in primitive.attributes() {
        let arity = accessor.dimensions().multiplicity();
        if arity > ARITY_MAX {
            continue;
        }
        let rows = accessor.count().max(indices.as_ref().map_or(0, Vec::len)) as u64;
        spend(budget, rows.checked_mul(2 * VALUE_BYTES * arity as u64))?;
        let mut values = match (values_of(buffers, &accessor)?, scale_of(&accessor)) {
            (Values::I64(values), Some(greatest)) => {
                #[expect(clippy::cast_precision_loss, reason = "at most 32 bits")]
                let real = |value: i64| (value as f64 / greatest).max(-1.0);
                Values::F64(values.into_iter().map(real).collect())
            }
            (values, _) => values,
        };
        if let Some(indices) = &indices {
            let beyond = || invalid("a point has an index beyond the vertices");
            values = gathered(&values, arity, indices).ok_or_else(beyond)?;
        }
        if semantic == Semantic::Positions {
            if arity != 3 {
                return Err(invalid("the positions are not vectors of three numbers"));
            }
            if *placement != IDENTITY {
                values = Values::F64(wide(&values));
                change_vectors(&mut values, |point| transformed(placement, point, 1.0));
            }
            found = positions(values);
            continue;
        }
        // `_RADIUS` and `COLOR_0`
        let name = semantic.to_string();
        let name = name.trim_start_matches('_').trim_end_matches("_0").to_owned();
        arrays.push(FileAttribute::new(name, arity, values));
    }
    if *placement != IDENTITY {
        placed(&mut arrays, placement, "a node", notes);
    }
    Ok(found.map(|positions| ParticlePart { positions, arrays }))
}
