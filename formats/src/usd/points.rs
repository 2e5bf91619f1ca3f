//! Reads particles from stages: prims of the types `Points` and `PointInstancer`.
//!
//! ```text
//!   Points            points, widths (diameters), velocities, accelerations, ids, primvars:NAME
//!   PointInstancer    positions, velocities, accelerations, ids, protoIndices, orientations, scales
//! ```
//!
//! All visible prims are one frame. The transforms of the prims are applied; positions then have 64 bits.
//! Values stay in the units and axes of the stage, which a note states if they are not metres and y.
//! Each time code at which a prim has a sample of its points is a frame.

use std::collections::BTreeMap;
use std::rc::Rc;

use super::FORMAT;
use super::composed::{ComposedStage, StagePrim};
use super::layer::Value;
use crate::core::columns::role_of;
use crate::core::container::{ContainerFile, ContainerFrames, ContainerReader, Sample, frame_at};
use crate::core::data::{AttributeRole, FileAttribute, ParticleFrame, Values};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::matrix::{IDENTITY, change_vectors, transformed};
use crate::core::named_arrays::{ParticlePart, frame_of_parts, placed};
use crate::core::number;
use crate::core::row::{FormatRow, ParticleReader};
use crate::core::text::{excerpt, excerpts};

/// How frames are read from the text form, the binary form and packages.
pub(crate) const READER: ParticleReader = ParticleReader::container(ContainerReader {
    meshes: Some(super::mesh::READER),
    ..ContainerReader::new(|container, limits| Ok(ContainerFrames::new(samples(container, limits)?, READ)))
});

const READ: fn(&ContainerFile, usize, &Limits) -> Result<ParticleFrame> = read;

/// The row of packages in the table of formats.
pub(crate) static PACKAGE_ROW: FormatRow = FormatRow {
    beginnings: &[b"PK\x03\x04"],
    particles: Some(READER),
    read_mesh: Some(super::mesh::read_alone),
    ..FormatRow::new("USD", &["usdz"])
};

/// The frames of a stage.
fn samples(container: &ContainerFile, limits: &Limits) -> Result<Vec<Sample>> {
    let stage = ComposedStage::open(container, limits, true)?;
    let codes = codes_of(&stage, &PointPrims::find(&stage)?, limits)?;
    let per_second = stage.codes_per_second()?;
    let are_integers = codes.iter().flatten().all(|code| code.fract() == 0.0 && code.abs() < 2_f64.powi(53));
    let sample = |(index, code): (i64, Option<f64>)| {
        #[expect(clippy::cast_possible_truncation, reason = "an integer of at most 53 bits")]
        let number = code.filter(|_| are_integers).map_or(index, |code| code as i64);
        Sample { number, time: code.map(|code| code / per_second) }
    };
    Ok((0..).zip(codes).map(sample).collect())
}

/// The time codes at which points have samples or, if they have none, at which their transforms have; a single
/// `None` without any samples.
fn codes_of(stage: &ComposedStage, found: &PointPrims, limits: &Limits) -> Result<Vec<Option<f64>>> {
    let mut codes = Vec::new();
    for (prim, points) in &found.prims {
        codes.extend(stage.sample_codes(prim, points)?);
    }
    if codes.is_empty() {
        for (prim, _) in &found.prims {
            codes.extend(stage.transform_codes(prim)?);
        }
    }
    let codes = distinct(codes);
    limits.check_step(FORMAT, codes.len().saturating_sub(1))?;
    Ok(if codes.is_empty() { vec![None] } else { codes.into_iter().map(Some).collect() })
}

/// Time codes in ascending order, each once.
pub(crate) fn distinct(mut codes: Vec<f64>) -> Vec<f64> {
    codes.retain(|code| code.is_finite());
    codes.sort_by(f64::total_cmp);
    codes.dedup();
    codes
}

fn read(container: &ContainerFile, index: usize, limits: &Limits) -> Result<ParticleFrame> {
    // The checksums were compared when the frames were listed.
    let stage = ComposedStage::open(container, limits, false)?;
    let found = PointPrims::find(&stage)?;
    let codes = codes_of(&stage, &found, limits)?;
    let time = *frame_at(FORMAT, &codes, index)?;
    let mut notes = found.notes;
    let mut parts = Vec::new();
    let mut hidden = Vec::new();
    for (prim, points) in &found.prims {
        if !stage.is_visible(prim, time)? {
            hidden.push(prim.path.clone());
            continue;
        }
        parts.push(read_prim(&stage, prim, points, time, &mut notes, limits)?);
        limits.check_particles(
            FORMAT,
            parts.iter().map(|part: &ParticlePart| part.positions.len() as u64).sum(),
        )?;
    }
    if !hidden.is_empty() {
        notes.push(format!("skipped invisible prims: {}", excerpts(&hidden)));
    }
    notes.extend(units_note(&stage)?);
    Ok(frame_of_parts(parts, "prims", notes))
}

/// A note on the unit and the axis of the stage, unless they are the usual ones.
fn units_note(stage: &ComposedStage) -> Result<Option<String>> {
    stage.root_layer(|layer| {
        let meters = layer.number(0, "metersPerUnit")?.filter(|meters| *meters != 1.0);
        let axis = layer.word(0, "upAxis")?.filter(|axis| axis != "Y");
        let parts = [
            meters.map(|meters| format!("metersPerUnit {meters}")),
            axis.map(|axis| format!("upAxis {}", excerpt(axis))),
        ];
        let parts: Vec<String> = parts.into_iter().flatten().collect();
        let note = || format!("values stay in the unit and axes of the stage: {}", parts.join(", "));
        Ok((!parts.is_empty()).then(note))
    })
}

/// The prims with points, and the names of their positions.
struct PointPrims {
    prims: Vec<(Rc<StagePrim>, &'static str)>,
    notes: Vec<String>,
}

impl PointPrims {
    fn find(stage: &ComposedStage) -> Result<PointPrims> {
        let mut found = PointPrims { prims: Vec::new(), notes: Vec::new() };
        let (mut unrendered, mut others) = (Vec::new(), BTreeMap::<String, usize>::new());
        stage.traverse(&mut |prim| {
            let kind = stage.type_name(prim)?;
            let points = match kind.as_str() {
                "Points" => "points",
                "PointInstancer" => "positions",
                _ => {
                    *others.entry(kind).or_default() += 1;
                    return Ok(true);
                }
            };
            if !stage.is_rendered(prim)? {
                unrendered.push(prim.path.clone());
                return Ok(true);
            }
            if points == "positions" {
                found.notes.push(format!(
                    "only the positions of {} are read, not what it places",
                    excerpt(&prim.path)
                ));
            }
            found.prims.push((Rc::clone(prim), points));
            Ok(points == "points")
        })?;
        if !unrendered.is_empty() {
            found
                .notes
                .push(format!("skipped prims for purposes other than rendering: {}", excerpts(&unrendered)));
        }
        found.notes.extend(stage.left_out_note());
        if !found.prims.is_empty() {
            return Ok(found);
        }
        if others.contains_key("Mesh") {
            return Err(Error::unsupported(FORMAT, crate::core::row::MESH_REFUSAL));
        }
        others.remove("");
        let others: Vec<String> =
            others.into_iter().map(|(kind, count)| format!("{count} {}", excerpt(kind))).collect();
        let others = if others.is_empty() { "no others".to_owned() } else { others.join(", ") };
        let left_out = stage.left_out_note().map(|note| format!("; {note}")).unwrap_or_default();
        let what =
            format!("the stage has no prims of the type Points or PointInstancer; it has {others}{left_out}");
        Err(Error::unsupported(FORMAT, what))
    }
}

fn read_prim(
    stage: &ComposedStage,
    prim: &StagePrim,
    points: &str,
    time: Option<f64>,
    notes: &mut Vec<String>,
    limits: &Limits,
) -> Result<ParticlePart> {
    let matrix = stage.world(prim, time)?;
    let Some((array, is_between)) = stage.array_at(prim, points, time)? else {
        notes.push(format!("{} has no {points} at this time", excerpt(&prim.path)));
        return Ok(ParticlePart::default());
    };
    if array.arity != 3 || matches!(array.values, Values::Strings { .. }) {
        let what = format!("{}.{points} has elements of other than three numbers", excerpt(&prim.path));
        return Err(Error::invalid(FORMAT, Position::File, what));
    }
    if is_between {
        notes.push(format!("the points of {} are interpolated between two samples", excerpt(&prim.path)));
    }
    let count = array.particle_count();
    limits.check_particles(FORMAT, count as u64)?;
    let mut values = array.values;
    if matrix != IDENTITY {
        values = Values::F64(number::wide(&values));
        change_vectors(&mut values, |point| transformed(&matrix, point, 1.0));
    }
    let positions = number::positions(values).unwrap_or_default();
    let is_skipped = |name: &str| name == points || name == "extent" || name.starts_with("xformOp");
    let mut arrays = attributes(stage, prim, (count, time), is_skipped, notes)?;
    drop_copied_ids(&mut arrays);
    if matrix != IDENTITY {
        placed(&mut arrays, &matrix, &prim.path, notes);
        let moves = !stage.transform_codes(prim)?.is_empty();
        if moves
            && arrays.iter().any(|array| role_of(&array.name, array.arity) == Some(AttributeRole::Velocity))
        {
            notes.push(format!(
                "the velocities of {} lack those of its animated transform",
                excerpt(&prim.path)
            ));
        }
    }
    Ok(ParticlePart { positions, arrays })
}

/// Removes the primvar `id` if it repeats the ids, as in files that this crate writes.
fn drop_copied_ids(arrays: &mut Vec<FileAttribute>) {
    let of_name = |name: &str| arrays.iter().position(|array| array.name == name && array.arity == 1);
    let (Some(ids), Some(copy)) = (of_name("ids"), of_name(super::ID)) else { return };
    if let (Values::I64(ids), Values::I32(copied)) = (&arrays[ids].values, &arrays[copy].values)
        && ids.iter().copied().eq(copied.iter().map(|id| i64::from(*id)))
    {
        arrays.remove(copy);
    }
}

/// The arrays of a prim that have a value per point.
///
/// # Errors
/// [`Error::Invalid`] if the indices of an array are outside its table.
pub(crate) fn attributes(
    stage: &ComposedStage,
    prim: &StagePrim,
    (count, time): (usize, Option<f64>),
    is_skipped: impl Fn(&str) -> bool,
    notes: &mut Vec<String>,
) -> Result<Vec<FileAttribute>> {
    let mut found: Vec<FileAttribute> = Vec::new();
    let (mut constant, mut unfit) = (Vec::new(), Vec::new());
    for attribute in stage.attribute_names(prim)? {
        if attribute.ends_with(super::INDICES) || is_skipped(&attribute) {
            continue;
        }
        let primvar = attribute.strip_prefix(PRIMVARS);
        let name = primvar.unwrap_or(&attribute);
        let kind = stage.attribute_field(prim, &attribute, "typeName")?;
        if primvar.is_none() && !matches!(kind, Some(Value::Word(kind)) if kind.ends_with("[]")) {
            continue;
        }
        let Some((array, _)) = stage.array_at(prim, &attribute, time)? else {
            if primvar.is_some() {
                constant.push(name.to_owned());
            }
            continue;
        };
        let field = |field: &str| stage.attribute_field(prim, &attribute, field);
        let mut array = FileAttribute { name: name.to_owned(), ..array };
        if let Some((indices, _)) = stage.array_at(prim, &format!("{attribute}{}", super::INDICES), time)? {
            let values = match &indices.values {
                Values::I32(indices) => number::gathered(&array.values, array.arity, indices),
                _ => None,
            };
            array.values = values.ok_or_else(|| {
                let what =
                    format!("the indices of {}.{attribute} are outside its table", excerpt(&prim.path));
                Error::invalid(FORMAT, Position::File, what)
            })?;
        } else if let Values::Strings { table, .. } = array.values {
            array.values = number::distinct_strings(table);
        }
        let size = field("elementSize")?.and_then(|size| size.number()).unwrap_or(1.0);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a small integer, or none fits"
        )]
        let size = size.clamp(1.0, f64::from(u16::MAX)) as usize;
        array.arity *= size;
        // One width or radius is that of all points.
        let is_for_all = array.values.len() == 1 && role_of(name, 1) == Some(AttributeRole::Radius);
        if is_for_all && let Some(values) = number::gathered(&array.values, 1, &vec![0_u8; count]) {
            array.values = values;
        }
        let fits = count.checked_mul(array.arity) == Some(array.values.len());
        let interpolation = match field("interpolation")? {
            Some(Value::Word(word)) => word,
            // The fallback is that of a constant, except for the attributes of points.
            _ if primvar.is_none() || fits && count > 1 => "vertex".to_owned(),
            _ => "constant".to_owned(),
        };
        let is_per_point = is_for_all || ["vertex", "varying"].contains(&interpolation.as_str());
        if !is_per_point || !fits {
            let is_constant = !is_per_point || array.values.len() == array.arity;
            let skipped = if is_constant { &mut constant } else { &mut unfit };
            skipped.push(name.to_owned());
        } else if !found.iter().any(|known| known.name == array.name) {
            found.push(array);
        }
    }
    for (names, what) in
        [(constant, "without a value per point"), (unfit, "that have other lengths than its points")]
    {
        if !names.is_empty() {
            let names = excerpts(&names);
            notes.push(format!("skipped attributes of {} {what}: {names}", excerpt(&prim.path)));
        }
    }
    Ok(found)
}

const PRIMVARS: &str = "primvars:";
