//! Reads the document: counts, point attributes and the types of the primitives.

use std::collections::BTreeMap;

use crate::columns::role_of;
use crate::data::{FilePositions, ParticleFrame, Values};
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::named_arrays::{NamedArray, frame_of};

use super::FORMAT;
use super::attributes::{PointAttribute, point_attribute, positions};
use super::groups::point_group;
use super::token::JsonToken;
use super::tokens::TokenWalk;

/// The content found so far.
#[derive(Default)]
struct FoundGeometry {
    point_count: Option<usize>,
    positions: Option<FilePositions>,
    arrays: Vec<NamedArray>,
    notes: Vec<String>,
    /// Number of primitives of each type.
    primitives: BTreeMap<String, u64>,
}

/// Limit on the number of primitive types; geometry has a few.
const PRIMITIVE_TYPE_COUNT_MAX: usize = 1024;

/// Reads the points.
pub(super) fn read(mut walk: TokenWalk, limits: &Limits) -> Result<ParticleFrame> {
    let mut found = FoundGeometry::default();
    walk.object("", |walk, key| match key {
        "pointcount" if found.point_count.is_some() => Err(walk.invalid("pointcount occurs twice")),
        "pointcount" => {
            found.point_count = Some(point_count(walk, limits)?);
            Ok(())
        }
        "attributes" => walk.object(key, |walk, key| match key {
            "pointattributes" => point_attributes(walk, &mut found, limits),
            _ => walk.skip(),
        }),
        "pointgroups" => point_groups(walk, &mut found, limits),
        "primitives" => walk.items(key, |walk, token| primitive(walk, &token, &mut found.primitives)),
        _ => walk.skip(),
    })?;
    walk.finish()?;
    let count = found.point_count.ok_or_else(|| walk.invalid("pointcount is missing"))?;
    check_primitives(&found.primitives, count)?;
    let positions = match found.positions {
        Some(positions) => positions,
        None if count == 0 => FilePositions::default(),
        None => return Err(walk.invalid("the point attribute P is missing")),
    };
    // With positions given, a frame is always returned.
    let mut frame = frame_of(Some(positions), found.arrays).unwrap_or_default();
    frame.notes.append(&mut found.notes);
    Ok(frame)
}

fn point_count(walk: &mut TokenWalk, limits: &Limits) -> Result<usize> {
    let count = walk.count()?;
    let too_large = || {
        Error::too_large(
            FORMAT,
            format!("the file has {count} points, more than the limit of {}", limits.particle_count),
        )
    };
    usize::try_from(count).ok().filter(|_| count <= limits.particle_count).ok_or_else(too_large)
}

/// Reads the point groups as attributes, which are 1 for the members and 0 for other points. A group whose
/// name has another meaning for attributes gets the prefix `group_`.
fn point_groups(walk: &mut TokenWalk, found: &mut FoundGeometry, limits: &Limits) -> Result<()> {
    let count = found.point_count.ok_or_else(|| walk.invalid("the groups come before the pointcount"))?;
    walk.items("pointgroups", |walk, token| {
        if token != JsonToken::Open {
            return Err(walk.unexpected("a group", &token));
        }
        found.check_limit(limits)?;
        match point_group(walk, count, limits)? {
            (name, Some(members)) => {
                let is_taken = found.arrays.iter().any(|array| array.name == name);
                let prefix = if is_taken || role_of(&name, 1).is_some() { "group_" } else { "" };
                let name = format!("{prefix}{name}");
                found.arrays.push(NamedArray { name, arity: 1, values: Values::U8(members) });
            }
            (name, None) => {
                found.notes.push(format!("skipped the point group {name:?}: its encoding is not supported"));
            }
        }
        Ok(())
    })
}

impl FoundGeometry {
    /// Fails if there is no room for another attribute or group.
    fn check_limit(&self, limits: &Limits) -> Result<()> {
        if self.arrays.len() + self.notes.len() >= limits.attribute_count {
            let what = format!("the file has more attributes than the limit of {}", limits.attribute_count);
            return Err(Error::too_large(FORMAT, what));
        }
        Ok(())
    }
}

fn point_attributes(walk: &mut TokenWalk, found: &mut FoundGeometry, limits: &Limits) -> Result<()> {
    let count = found.point_count.ok_or_else(|| walk.invalid("the attributes come before the pointcount"))?;
    walk.items("pointattributes", |walk, token| {
        if token != JsonToken::Open {
            return Err(walk.unexpected("an attribute", &token));
        }
        found.check_limit(limits)?;
        match point_attribute(walk, count, limits)? {
            PointAttribute::Read(array) if array.name == "P" => {
                let arity = array.arity;
                let no_positions =
                    || walk.invalid(format!("P must have 3 or 4 numbers per point, found {arity} values"));
                found.positions = Some(positions(array).ok_or_else(no_positions)?);
            }
            PointAttribute::Read(array) if array.arity == 0 => {
                found.notes.push(format!("skipped the point attribute {:?}: it has no values", array.name));
            }
            PointAttribute::Read(array) => found.arrays.push(array),
            PointAttribute::LeftOut { name, kind } => {
                found.notes.push(format!(
                    "skipped the point attribute {name:?}: its type {kind:?} is not supported"
                ));
            }
        }
        Ok(())
    })
}

/// Counts a primitive, or a run of primitives, by type.
fn primitive(walk: &mut TokenWalk, token: &JsonToken, primitives: &mut BTreeMap<String, u64>) -> Result<()> {
    if *token != JsonToken::Open {
        return Err(walk.unexpected("a primitive", token));
    }
    let mut kind = String::new();
    walk.object("primitive", |walk, key| {
        match key {
            // A run of primitives states their type as `runtype`, which takes precedence.
            "type" if kind.is_empty() => kind = long_name(&walk.text()?).to_owned(),
            "runtype" => kind = long_name(&walk.text()?).to_owned(),
            _ => walk.skip()?,
        }
        Ok(())
    })?;
    if primitives.len() < PRIMITIVE_TYPE_COUNT_MAX || primitives.contains_key(&kind) {
        *primitives.entry(kind).or_default() += 1;
    }
    loop {
        match walk.next()? {
            JsonToken::Close => return Ok(()),
            token => walk.skip_rest(&token)?,
        }
    }
}

/// The full name of an abbreviated type.
fn long_name(kind: &str) -> &str {
    match kind {
        "p_r" => "Poly", // a run of polygons
        other => other,
    }
}

/// Fails if the points are not particles.
fn check_primitives(primitives: &BTreeMap<String, u64>, point_count: usize) -> Result<()> {
    let is_particles = |kind: &str| matches!(kind, "Part" | "ParticleSystem");
    let Some(kind) = primitives.keys().find(|kind| !is_particles(kind)) else { return Ok(()) };
    let lower = kind.to_ascii_lowercase();
    let what = if lower.contains("packed") || lower.contains("alembic") {
        format!(
            "the file contains packed primitives ({kind}): its {point_count} points are their pivots, not particles; \
             unpack them before saving"
        )
    } else if lower.contains("vdb") || lower.contains("volume") {
        format!(
            "the file contains volumes ({kind}): its {point_count} points are their locations, not particles; use \
             the particles from which the volumes were made"
        )
    } else {
        format!(
            "the file contains surfaces or curves ({kind}): its {point_count} points belong to them and are not \
             particles; delete the primitives and keep the points, or use the original particles"
        )
    };
    Err(Error::unsupported(FORMAT, what))
}
