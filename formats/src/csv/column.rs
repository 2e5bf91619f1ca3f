//! A column under construction: its type depends on its values so far.
//!
//! ```text
//!   no value yet ──text──▶ texts
//!        │ integer
//!        ▼
//!     integers ──a number that is not an integer, or a missing value──▶ floats
//! ```
//!
//! Text in a column of integers or floats is an error.
//!
//! Parts of a table can be read in parallel. Their columns are joined if the result equals that of sequential
//! reading.

use super::cell::{is_rounded, is_rounded_integer};
use std::collections::HashMap;

/// The values of a column, one per row.
#[derive(Debug)]
pub(super) struct Column {
    pub(super) values: ColumnValues,
    /// Whether any cell had a value; until then the column may still become text.
    has_value: bool,
    /// Whether the column has an integer whose text may give another result when it is read as a float: −0,
    /// +5, or one with many digits.
    has_odd_integer: bool,
    /// Whether the column has an integer that a 64-bit float cannot represent exactly.
    pub(super) has_rounded_integer: bool,
}

#[derive(Debug)]
pub(super) enum ColumnValues {
    Integers(Vec<i64>),
    /// NaN for a missing value.
    Reals(Vec<f64>),
    Texts(Texts),
}

/// Distinct texts, and the index of the text of each row, or [`NO_TEXT`].
#[derive(Debug, Default)]
pub(super) struct Texts {
    pub(super) table: Vec<String>,
    pub(super) indices: Vec<i32>,
    index_of: HashMap<Vec<u8>, i32>,
}

impl Column {
    /// An empty column with capacity for `row_count` numbers.
    pub(super) fn with_capacity(row_count: usize) -> Column {
        let values = ColumnValues::Integers(Vec::with_capacity(row_count));
        Column { values, has_value: false, has_odd_integer: false, has_rounded_integer: false }
    }

    /// Appends a number as a float, and converts a column of integers. `text` is the number in the file.
    #[inline]
    pub(super) fn push_real(&mut self, value: f64, text: &[u8]) {
        self.has_value = true;
        self.has_rounded_integer = self.has_rounded_integer || is_rounded_integer(text);
        if let Some(reals) = self.reals() {
            reals.push(value);
        }
    }

    /// Appends an integer. In a column of floats, it becomes a float.
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

    /// Appends a text, unless the column is numeric.
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

    /// Whether this is a column of text, in which even cells that look like numbers are text.
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

    /// Removes the last value.
    pub(super) fn pop(&mut self) {
        match &mut self.values {
            ColumnValues::Integers(integers) => drop(integers.pop()),
            ColumnValues::Reals(reals) => drop(reals.pop()),
            ColumnValues::Texts(texts) => drop(texts.indices.pop()),
        }
    }

    /// Whether appending `next`, which was parsed separately from the rows after those of this column, gives
    /// the same result as sequential parsing.
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

    /// Appends a column for which [`can_append`](Column::can_append) is true.
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

    /// A copy of the values as floats; `None` for text.
    pub(super) fn numbers(&self) -> Option<Vec<f64>> {
        match &self.values {
            ColumnValues::Integers(integers) => Some(integers.iter().copied().map(integer_as_real).collect()),
            ColumnValues::Reals(reals) => Some(reals.clone()),
            ColumnValues::Texts(_) => None,
        }
    }

    /// The column as floats, converting integers. `None` for text.
    pub(super) fn reals(&mut self) -> Option<&mut Vec<f64>> {
        if let ColumnValues::Integers(integers) = &mut self.values {
            let integers = std::mem::take(integers);
            self.has_rounded_integer |= integers.iter().any(|value| is_rounded(value.unsigned_abs().into()));
            // Both types have the same size, so the allocation is reused.
            self.values = ColumnValues::Reals(integers.into_iter().map(integer_as_real).collect());
        }
        match &mut self.values {
            ColumnValues::Reals(reals) => Some(reals),
            _ => None,
        }
    }
}

impl Texts {
    /// The index of a text; a new text gets the next index.
    fn index_of(&mut self, text: &[u8]) -> Result<i32, NotAText> {
        if let Some(&index) = self.index_of.get(text) {
            return Ok(index);
        }
        let index = i32::try_from(self.table.len()).map_err(|_| NotAText)?;
        self.table.push(String::from_utf8_lossy(text).into_owned());
        self.index_of.insert(text.to_vec(), index);
        Ok(index)
    }

    /// Appends texts. [`Column::can_append`] has checked that the total number of distinct texts fits into 31
    /// bits.
    fn append(&mut self, next: &Texts) {
        // The texts are added in order of appearance. They are compared as bytes, because the lossy
        // conversion to strings can make different bytes equal.
        let mut texts: Vec<(i32, &[u8])> = next.index_of.iter().map(|(text, &i)| (i, &text[..])).collect();
        texts.sort_unstable();
        let merged: Vec<i32> = texts.into_iter().flat_map(|(_, text)| self.index_of(text)).collect();
        let merged_index = |&index: &i32| {
            usize::try_from(index).ok().and_then(|index| merged.get(index)).copied().unwrap_or(NO_TEXT)
        };
        self.indices.extend(next.indices.iter().map(merged_index));
    }
}

/// Error: a text in a numeric column, or too many different texts.
#[derive(Debug)]
pub(super) struct NotAText;

/// Exact up to 2⁵³; [`has_rounded_integer`](Column::has_rounded_integer) records that a larger one was
/// rounded.
fn integer_as_real(value: i64) -> f64 {
    value as f64
}

/// The index of a missing text.
const NO_TEXT: i32 = -1;

/// Integers up to this are exact as 64-bit floats.
const PLAIN_INTEGER_MAX: u64 = 1 << f64::MANTISSA_DIGITS;
