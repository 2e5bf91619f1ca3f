//! Reads the values of an attribute in one of their three layouts.
//!
//! ```text
//!   "tuples", [[x, y, z], [x, y, z], ..]             point by point
//!   "arrays", [[a, a, a, ..], ..]                    component by component
//!   "rawpagedata", [..]                              page by page, see below; the only binary layout
//!
//!   pages of 1024 points, "packing" [3, 1]:          x y z  x y z ..  w w w ..  │  x y z  x y z ..  w w w ..
//!   with "constantpageflags" [[0, 1], []]:           the second page stores x y z once, for all its points
//! ```
//!
//! The packing divides the components of a point into parts: x y z and w. A page stores one part of all its
//! points, then the next part. The flags of a part say for each page whether the part is constant there.

use super::FORMAT;
use super::tokens::{JsonToken, TokenWalk};
use crate::core::bytes::Endian;
use crate::core::data::Values;
use crate::core::error::Result;
use crate::core::limits::Limits;
use crate::core::number::{self, NumberType, interleaved, of_any_type};
use crate::core::text::excerpt;

/// The type in which values are kept, for Houdini's name of a storage.
fn storage_type(name: &str) -> Option<NumberType> {
    Some(match name {
        "fpreal16" | "fpreal32" => NumberType::F32,
        "fpreal64" => NumberType::F64,
        "uint8" | "bool" => NumberType::U8,
        "int8" | "int16" | "int32" => NumberType::I32,
        "int64" => NumberType::I64,
        _ => return None,
    })
}

/// The values of all points, and the number per point.
pub(super) struct Tuples {
    pub(super) size: usize,
    pub(super) values: Values,
}

/// The layout of pages.
struct Pages {
    page_points: usize,
    /// The number of components of each part; empty if all components form one part.
    packing: Vec<usize>,
    /// For each part of the packing, the flags of constant pages; empty if no page is constant.
    constant: Vec<Vec<bool>>,
}

/// Reads the value of the key `values` or `indices`, for `count` points.
pub(super) fn tuples(walk: &mut TokenWalk, key: &str, count: usize, limits: &Limits) -> Result<Tuples> {
    let (mut size, mut storage) = (1, NumberType::F32);
    let mut pages = Pages { page_points: 1024, packing: Vec::new(), constant: Vec::new() };
    let mut values = None;
    walk.object(key, |walk, key| {
        if values.is_some() && LAYOUT_KEYS.contains(&key) {
            return Err(walk.invalid(format!("`{key}` comes after the values that it describes")));
        }
        match key {
            "size" => size = small(walk, limits)?,
            "storage" => storage = storage_of(walk)?,
            "pagesize" => pages.page_points = usize::try_from(walk.count()?).unwrap_or(usize::MAX).max(1),
            "packing" => {
                let packing = numbers(walk, key, NumberType::I64, limits.attribute_count)?;
                pages.packing = widths(walk, packing, size)?;
            }
            "constantpageflags" => {
                pages.constant = flags(walk, count.div_ceil(pages.page_points), limits)?;
            }
            "rawpagedata" => {
                let raw = numbers(walk, key, storage, count.saturating_mul(size))?;
                values =
                    Some(walk.within(key, |walk| unpaged(walk, raw, count, size, &pages, storage, limits))?);
            }
            "tuples" => values = Some(numbers(walk, key, storage, count.saturating_mul(size))?),
            "arrays" => {
                let all = numbers(walk, key, storage, count.saturating_mul(size))?;
                values = Some(by_points(all, count, size));
            }
            _ => walk.skip()?,
        }
        Ok(())
    })?;
    let values = values.unwrap_or_else(|| storage.zeros(0));
    let found = values.len();
    if count.checked_mul(size) == Some(found) {
        Ok(Tuples { size, values })
    } else {
        Err(walk.invalid(format!("{key}: expected {size} values for each of {count} points, found {found}")))
    }
}

/// Keys that describe the layout of the values.
const LAYOUT_KEYS: [&str; 5] = ["size", "storage", "pagesize", "packing", "constantpageflags"];

/// Reads the next value as a number of components.
fn small(walk: &mut TokenWalk, limits: &Limits) -> Result<usize> {
    let size = walk.count()?;
    let size = usize::try_from(size).unwrap_or(usize::MAX);
    limits.check_attributes(FORMAT, size, "values per point")?;
    Ok(size)
}

fn storage_of(walk: &mut TokenWalk) -> Result<NumberType> {
    let name = walk.text()?;
    storage_type(&name).ok_or_else(|| walk.invalid(format!("unknown storage \"{}\"", excerpt(&*name))))
}

/// Reads the next value, an array of numbers or of arrays of numbers, and flattens it. Fails if it has more
/// than `most` numbers.
pub(super) fn numbers(walk: &mut TokenWalk, name: &str, storage: NumberType, most: usize) -> Result<Values> {
    walk.within(name, |walk| {
        // The capacity to reserve: a number takes at least two bytes of the file. Only in uniform arrays it can
        // take fewer.
        let capacity = most.min(walk.remaining() / 2);
        let mut list = List(storage.zeros(0));
        let mut depth = 0usize;
        loop {
            match walk.next()? {
                JsonToken::Open => {
                    if depth == 0 {
                        list.reserve(capacity);
                    }
                    depth += 1;
                }
                JsonToken::Close if depth != 0 => depth -= 1,
                JsonToken::Integer(value) => list.push_integer(value),
                JsonToken::Real(value) => list.push_real(value),
                JsonToken::Bool(value) => list.push_integer(value.into()),
                JsonToken::Bools(values) => {
                    walk.check_widened(values.len().saturating_mul(storage.size()))?;
                    values.into_iter().for_each(|value| list.push_integer(value.into()));
                }
                JsonToken::Numbers { number, endian, payload } => {
                    let more = payload.len() / number.size();
                    if most - list.0.len() < more {
                        return Err(walk.invalid(format!("expected at most {most} numbers, found more")));
                    }
                    if storage.size() > number.size() {
                        walk.check_widened(more.saturating_mul(storage.size()))?;
                    }
                    list.append(number, endian, payload);
                }
                other => return Err(walk.unexpected("numbers", &other)),
            }
            if list.0.len() > most {
                return Err(walk.invalid(format!("expected at most {most} numbers, found more")));
            }
            if depth == 0 {
                return Ok(list.0);
            }
        }
    })
}

/// Collects numbers as values of one type.
struct List(Values);

#[expect(clippy::cast_possible_truncation, reason = "the file declares the storage type")]
impl List {
    fn reserve(&mut self, count: usize) {
        of_any_type!(&mut self.0, values => values.reserve(count));
    }

    fn push_integer(&mut self, value: i64) {
        match &mut self.0 {
            Values::F32(values) => values.push(value as f32),
            Values::F64(values) => values.push(value as f64),
            Values::U8(values) => values.push(value as u8),
            Values::I32(values) => values.push(value as i32),
            Values::I64(values) => values.push(value),
            Values::Strings { .. } => {}
        }
    }

    fn push_real(&mut self, value: f64) {
        match &mut self.0 {
            Values::F32(values) => values.push(value as f32),
            Values::F64(values) => values.push(value),
            _ => self.push_integer(value as i64),
        }
    }

    /// Appends a uniform array. An array of another type is converted in chunks, to limit the additional
    /// memory.
    fn append(&mut self, number: NumberType, endian: Endian, payload: &[u8]) {
        const PART_COUNT: usize = 4096;
        let is_same = std::mem::discriminant(&self.0) == std::mem::discriminant(&number.decode(&[], endian));
        if self.0.len() == 0 && is_same {
            self.0 = number.decode(payload, endian);
            return;
        }
        self.reserve(payload.len() / number.size());
        for part in payload.chunks(PART_COUNT * number.size()) {
            self.push_all(number.decode(part, endian));
        }
    }

    fn push_all(&mut self, more: Values) {
        match more {
            Values::F32(more) => more.into_iter().for_each(|value| self.push_real(value.into())),
            Values::F64(more) => more.into_iter().for_each(|value| self.push_real(value)),
            Values::U8(more) => more.into_iter().for_each(|value| self.push_integer(value.into())),
            Values::I32(more) => more.into_iter().for_each(|value| self.push_integer(value.into())),
            Values::I64(more) => more.into_iter().for_each(|value| self.push_integer(value)),
            Values::Strings { .. } => {}
        }
    }
}

/// The widths of the parts of a point, which must add up to `size`.
fn widths(walk: &TokenWalk, packing: Values, size: usize) -> Result<Vec<usize>> {
    let Values::I64(packing) = packing else { return Ok(Vec::new()) };
    let widths: Vec<usize> = packing.iter().filter_map(|&width| usize::try_from(width).ok()).collect();
    let sum = widths.iter().try_fold(0usize, |sum, &width| sum.checked_add(width));
    // A part of zero width would cost time for each page without holding data.
    let is_wide = size == 0 || widths.iter().all(|&width| width != 0);
    if sum == Some(size) && widths.len() == packing.len() && is_wide {
        Ok(widths)
    } else {
        Err(walk.invalid(format!("the packing {packing:?} does not match {size} values")))
    }
}

/// Reads the flags of constant pages for each part of the packing.
fn flags(walk: &mut TokenWalk, page_count: usize, limits: &Limits) -> Result<Vec<Vec<bool>>> {
    let mut all = Vec::new();
    let too_many =
        |walk: &TokenWalk| walk.invalid(format!("there are more flags than the {page_count} pages"));
    walk.items("constantpageflags", |walk, token| {
        if all.len() > limits.attribute_count {
            return Err(walk.invalid("there are too many lists of flags"));
        }
        let mut part = Vec::new();
        match token {
            JsonToken::Bools(bools) => part = bools,
            JsonToken::Numbers { number, endian, payload } if payload.len() / number.size() <= page_count => {
                let values = number.decode(payload, endian);
                part = match values {
                    Values::U8(values) => values.iter().map(|&value| value != 0).collect(),
                    Values::I32(values) => values.iter().map(|&value| value != 0).collect(),
                    _ => return Err(walk.invalid("the flags are not booleans")),
                };
            }
            JsonToken::Open => loop {
                match walk.next()? {
                    JsonToken::Close => break,
                    _ if part.len() >= page_count => return Err(too_many(walk)),
                    JsonToken::Bool(flag) => part.push(flag),
                    JsonToken::Integer(flag) => part.push(flag != 0),
                    other => return Err(walk.unexpected("a boolean", &other)),
                }
            },
            JsonToken::Numbers { .. } => return Err(too_many(walk)),
            other => return Err(walk.unexpected("an array of booleans", &other)),
        }
        if part.len() > page_count {
            return Err(too_many(walk));
        }
        walk.check_widened(part.len())?;
        all.push(part);
        Ok(())
    })?;
    Ok(all)
}

/// Converts values from component by component to point by point.
fn by_points(all: Values, count: usize, size: usize) -> Values {
    if size == 1 || all.len() != count * size {
        return all;
    }
    let columns: Vec<Values> =
        (0..size).map(|index| number::slice(&all, index * count..(index + 1) * count)).collect();
    interleaved(&columns.iter().collect::<Vec<_>>()).unwrap_or(all)
}

/// Converts values from page by page to point by point.
fn unpaged(
    walk: &mut TokenWalk,
    raw: Values,
    count: usize,
    size: usize,
    pages: &Pages,
    storage: NumberType,
    limits: &Limits,
) -> Result<Values> {
    let is_plain = pages.packing.len() <= 1 && pages.constant.iter().all(Vec::is_empty);
    if is_plain {
        return Ok(raw);
    }
    let bytes = (count as u64).saturating_mul(size as u64).saturating_mul(storage.size() as u64);
    walk.check_spread(bytes, limits)?;
    let whole = [size];
    let packing = if pages.packing.is_empty() { &whole[..] } else { &pages.packing };
    let spread = match raw {
        Values::F32(raw) => spread(&raw, count, pages, packing).map(Values::F32),
        Values::F64(raw) => spread(&raw, count, pages, packing).map(Values::F64),
        Values::U8(raw) => spread(&raw, count, pages, packing).map(Values::U8),
        Values::I32(raw) => spread(&raw, count, pages, packing).map(Values::I32),
        Values::I64(raw) => spread(&raw, count, pages, packing).map(Values::I64),
        Values::Strings { .. } => None,
    };
    spread.ok_or_else(|| walk.invalid("the pages have the wrong number of values"))
}

/// The values of all points; `None` if their number does not match the pages.
fn spread<T: Copy + Default>(raw: &[T], count: usize, pages: &Pages, packing: &[usize]) -> Option<Vec<T>> {
    let size: usize = packing.iter().sum();
    let mut out = vec![T::default(); count * size];
    let mut rest = raw;
    if size == 0 {
        return rest.is_empty().then_some(out);
    }
    for (page, points) in out.chunks_mut(pages.page_points.saturating_mul(size)).enumerate() {
        let mut component = 0;
        for (part, &width) in packing.iter().enumerate() {
            let is_constant =
                pages.constant.get(part).and_then(|flags| flags.get(page)).copied().unwrap_or(false);
            let point_count = if is_constant { 1 } else { points.len() / size };
            let (values, after) = rest.split_at_checked(point_count * width)?;
            rest = after;
            for (index, point) in points.chunks_exact_mut(size).enumerate() {
                let at = if is_constant { 0 } else { index * width };
                point[component..component + width].copy_from_slice(&values[at..at + width]);
            }
            component += width;
        }
    }
    rest.is_empty().then_some(out)
}
