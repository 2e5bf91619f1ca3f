//! Reads a point group: its name and its members.
//!
//! ```text
//!   [["name", "fluid"], ["selection", ["unordered", ["i8", [1, 1, 0, 0]]]]]               a flag per point
//!                        "selection", ["unordered", ["boolRLE", [2, true, 2, false]]]     runs of flags
//!                        "selection", ["ordered", [0, 1]]                                 indices of points
//! ```

use crate::data::Values;
use crate::error::Result;
use crate::limits::Limits;

use super::attributes::short_text;
use super::token::JsonToken;
use super::tokens::TokenWalk;
use super::values::{StorageType, numbers};

/// Reads the definition and the body of a group: a list whose start the caller has consumed. Returns its
/// name, and 1 or 0 for each of `count` points; `None` for an unknown encoding.
pub(super) fn point_group(
    walk: &mut TokenWalk,
    count: usize,
    limits: &Limits,
) -> Result<(String, Option<Vec<u8>>)> {
    let (mut name, mut members) = (String::new(), None);
    walk.object("definition", |walk, key| match key {
        "name" => {
            name = short_text(walk)?;
            Ok(())
        }
        _ => walk.skip(),
    })?;
    walk.within(&name, |walk| {
        walk.object("group", |walk, key| match key {
            "selection" => {
                members = selection(walk, count, limits)?;
                Ok(())
            }
            _ => walk.skip(),
        })
    })?;
    loop {
        match walk.next()? {
            JsonToken::Close => return Ok((name, members)),
            token => walk.skip_rest(&token)?,
        }
    }
}

fn selection(walk: &mut TokenWalk, count: usize, limits: &Limits) -> Result<Option<Vec<u8>>> {
    let mut members = None;
    walk.object("selection", |walk, key| match key {
        "unordered" => walk.object(key, |walk, key| {
            match key {
                "i8" => members = Some(flags(walk, key, count)?),
                "boolRLE" => members = Some(runs(walk, key, count, limits)?),
                _ => walk.skip()?,
            }
            Ok(())
        }),
        "ordered" => {
            members = Some(indices(walk, key, count, limits)?);
            Ok(())
        }
        _ => walk.skip(),
    })?;
    Ok(members)
}

fn flags(walk: &mut TokenWalk, key: &str, count: usize) -> Result<Vec<u8>> {
    match numbers(walk, key, StorageType::U8, count)? {
        Values::U8(mut flags) if flags.len() == count => {
            flags.iter_mut().for_each(|flag| *flag = u8::from(*flag != 0));
            Ok(flags)
        }
        _ => Err(walk.invalid(format!("the group does not have {count} flags"))),
    }
}

/// Reads pairs of a number of points and their flag.
fn runs(walk: &mut TokenWalk, key: &str, count: usize, limits: &Limits) -> Result<Vec<u8>> {
    let Values::I64(pairs) = numbers(walk, key, StorageType::I64, count.saturating_mul(2).max(2))? else {
        return Err(walk.invalid("the runs of the group are not integers"));
    };
    walk.check_spread(count as u64, limits)?;
    let mut flags = Vec::with_capacity(count);
    for [length, flag] in pairs.as_chunks::<2>().0 {
        let end = usize::try_from(*length).ok().and_then(|length| flags.len().checked_add(length));
        let end = end.filter(|end| *end <= count);
        let end = end.ok_or_else(|| walk.invalid(format!("the runs of the group exceed {count} points")))?;
        flags.resize(end, u8::from(*flag != 0));
    }
    match flags.len() == count && pairs.len() % 2 == 0 {
        true => Ok(flags),
        false => Err(walk.invalid(format!("the runs of the group do not cover {count} points"))),
    }
}

fn indices(walk: &mut TokenWalk, key: &str, count: usize, limits: &Limits) -> Result<Vec<u8>> {
    let Values::I64(indices) = numbers(walk, key, StorageType::I64, count)? else {
        return Err(walk.invalid("the members of the group are not integers"));
    };
    walk.check_spread(count as u64, limits)?;
    let mut flags = vec![0; count];
    for index in indices {
        let flag = usize::try_from(index).ok().and_then(|index| flags.get_mut(index));
        *flag.ok_or_else(|| walk.invalid(format!("the group has the point {index} of {count}")))? = 1;
    }
    Ok(flags)
}
