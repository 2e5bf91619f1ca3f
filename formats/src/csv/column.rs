//! One column while it grows: its type is what its values so far allow.
//!
//! ```text
//!   nothing seen yet ──text──▶ texts
//!        │ integer
//!        ▼
//!     integers ──any other number, or none──▶ reals          text in one of these is an error
//! ```
//!
//! Columns of parts that were read side by side are joined where that makes what reading on would have made.

use super::cell::{is_rounded, is_rounded_integer};
use std::collections::HashMap;

/// The values of one column, one per row.
#[derive(Debug)]
pub(super) struct Column {
    pub(super) values: ColumnValues,
    /// Whether any cell held a value; until then it may still become a column of texts.
    has_value: bool,
    /// Whether an integer was written that may read differently among reals: −0, +5, or one of many digits.
    has_odd_integer: bool,
    /// Whether an integer was written that is another one as a 64-bit real.
    pub(super) has_rounded_integer: bool,
}

#[derive(Debug)]
pub(super) enum ColumnValues {
    Integers(Vec<i64>),
    /// Not a number where the cell is empty.
    Reals(Vec<f64>),
    Texts(Texts),
}

/// Distinct texts and which of them each row has, or [`NO_TEXT`].
#[derive(Debug, Default)]
pub(super) struct Texts {
    pub(super) table: Vec<String>,
    pub(super) indices: Vec<i32>,
    index_of: HashMap<Vec<u8>, i32>,
}

impl Column {
    /// An empty column with room for `row_count` numbers.
    pub(super) fn with_capacity(row_count: usize) -> Column {
        let values = ColumnValues::Integers(Vec::with_capacity(row_count));
        Column { values, has_value: false, has_odd_integer: false, has_rounded_integer: false }
    }

    /// Appends a number other than an integer; `text` is how it was written.
    #[inline]
    pub(super) fn push_real(&mut self, value: f64, text: &[u8]) {
        self.has_value = true;
        self.has_rounded_integer = self.has_rounded_integer || is_rounded_integer(text);
        if let Some(reals) = self.reals() {
            reals.push(value);
        }
    }

    /// Appends an integer to a column of integers.
    #[inline]
    pub(super) fn push_integer(&mut self, value: i64, text: &[u8]) {
        self.has_value = true;
        match &mut self.values {
            ColumnValues::Integers(integers) => {
                let is_plain = value.unsigned_abs() <= PLAIN_INTEGER_MAX
                    && (text[0].is_ascii_digit() || (value != 0 && text[0] == b'-'));
                self.has_odd_integer |= !is_plain;
                integers.push(value);
            }
            _ => self.push_real(integer_as_real(value), text),
        }
    }

    pub(super) fn push_missing(&mut self) {
        match &mut self.values {
            ColumnValues::Texts(texts) => texts.indices.push(NO_TEXT),
            _ => {
                if let Some(reals) = self.reals() {
                    reals.push(f64::NAN);
                }
            }
        }
    }

    /// Appends a text, unless this is a column of numbers.
    pub(super) fn push_text(&mut self, text: &[u8]) -> Result<(), NotAText> {
        if !self.has_value {
            let texts = Texts { indices: vec![NO_TEXT; self.len()], ..Texts::default() };
            self.values = ColumnValues::Texts(texts);
            self.has_value = true;
        }
        let ColumnValues::Texts(texts) = &mut self.values else { return Err(NotAText) };
        let index = texts.index_of(text)?;
        texts.indices.push(index);
        Ok(())
    }

    /// Whether every cell is text, even one that looks like a number.
    pub(super) fn is_text(&self) -> bool {
        matches!(self.values, ColumnValues::Texts(_))
    }

    pub(super) fn len(&self) -> usize {
        match &self.values {
            ColumnValues::Integers(integers) => integers.len(),
            ColumnValues::Reals(reals) => reals.len(),
            ColumnValues::Texts(texts) => texts.indices.len(),
        }
    }

    /// Whether the last value is a finite number.
    #[inline]
    pub(super) fn ends_finite(&self) -> bool {
        match &self.values {
            ColumnValues::Integers(integers) => !integers.is_empty(),
            ColumnValues::Reals(reals) => reals.last().is_some_and(|value| value.is_finite()),
            ColumnValues::Texts(_) => false,
        }
    }

    /// Takes the last value back.
    pub(super) fn pop(&mut self) {
        match &mut self.values {
            ColumnValues::Integers(integers) => drop(integers.pop()),
            ColumnValues::Reals(reals) => drop(reals.pop()),
            ColumnValues::Texts(texts) => drop(texts.indices.pop()),
        }
    }

    /// Whether a column that was read by itself, from what follows this one, can be appended, and makes what
    /// reading on would have made.
    pub(super) fn can_append(&self, next: &Column) -> bool {
        match (&self.values, &next.values) {
            (ColumnValues::Texts(texts), ColumnValues::Texts(more)) => {
                i32::try_from(texts.table.len() + more.table.len()).is_ok()
            }
            (ColumnValues::Texts(_), _) | (_, ColumnValues::Texts(_)) => false,
            (ColumnValues::Reals(_), _) => !next.has_odd_integer,
            (ColumnValues::Integers(_), _) => true,
        }
    }

    /// Appends a column that [can be](Column::can_append).
    pub(super) fn append(&mut self, mut next: Column) {
        match (&mut self.values, &mut next.values) {
            (ColumnValues::Texts(texts), ColumnValues::Texts(more)) => texts.append(more),
            (ColumnValues::Integers(integers), ColumnValues::Integers(more)) => integers.append(more),
            _ => {
                if let (Some(reals), Some(more)) = (self.reals(), next.reals()) {
                    reals.append(more);
                }
            }
        }
        self.has_value |= next.has_value;
        self.has_odd_integer |= next.has_odd_integer;
        self.has_rounded_integer |= next.has_rounded_integer;
    }

    /// The column as reals; integers become such. None if it holds texts.
    pub(super) fn reals(&mut self) -> Option<&mut Vec<f64>> {
        if let ColumnValues::Integers(integers) = &mut self.values {
            let integers = std::mem::take(integers);
            self.has_rounded_integer |= integers.iter().any(|value| is_rounded(value.unsigned_abs().into()));
            // Of one size: the allocation stays.
            self.values = ColumnValues::Reals(integers.into_iter().map(integer_as_real).collect());
        }
        match &mut self.values {
            ColumnValues::Reals(reals) => Some(reals),
            _ => None,
        }
    }
}

impl Texts {
    /// The index of a text, which is the next one where it is new.
    fn index_of(&mut self, text: &[u8]) -> Result<i32, NotAText> {
        if let Some(&index) = self.index_of.get(text) {
            return Ok(index);
        }
        let index = i32::try_from(self.table.len()).map_err(|_| NotAText)?;
        self.table.push(String::from_utf8_lossy(text).into_owned());
        self.index_of.insert(text.to_vec(), index);
        Ok(index)
    }

    /// Appends texts, of which there are not too many.
    fn append(&mut self, next: &Texts) {
        // In the order in which they came: as bytes, since different ones can be shown alike.
        let mut texts: Vec<(i32, &[u8])> = next.index_of.iter().map(|(text, &i)| (i, &text[..])).collect();
        texts.sort_unstable();
        let places: Vec<i32> = texts.into_iter().flat_map(|(_, text)| self.index_of(text)).collect();
        let place = |&index: &i32| {
            usize::try_from(index).ok().and_then(|index| places.get(index)).copied().unwrap_or(NO_TEXT)
        };
        self.indices.extend(next.indices.iter().map(place));
    }
}

/// That a text stands in a column of numbers, or is one too many.
#[derive(Debug)]
pub(super) struct NotAText;

/// Exact up to 2⁵³; what is rounded beyond is [told](Column::has_rounded_integer).
fn integer_as_real(value: i64) -> f64 {
    value as f64
}

/// The index of none.
const NO_TEXT: i32 = -1;

/// Integers up to here are 64-bit reals, too.
const PLAIN_INTEGER_MAX: u64 = 1 << f64::MANTISSA_DIGITS;
