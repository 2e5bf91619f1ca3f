//! One column while it grows: its type is what its values so far allow.
//!
//! ```text
//!   nothing seen yet ──text──▶ texts
//!        │ integer
//!        ▼
//!     integers ──any other number, or none──▶ reals          text in one of these is an error
//! ```

use super::cell::{exceeds_f32, narrow};
use std::collections::HashMap;

/// The values of one column, one per row.
#[derive(Debug)]
pub(super) struct Column {
    pub(super) values: ColumnValues,
    /// Whether any cell held a value; until then it may still become a column of texts.
    has_value: bool,
    /// Whether a number was written that a 32-bit real cannot stand for.
    pub(super) exceeds_f32: bool,
}

#[derive(Debug)]
pub(super) enum ColumnValues {
    Integers(Vec<i64>),
    /// Not a number where the cell is empty.
    Reals(Vec<f64>),
    Texts(Texts),
}

/// Distinct texts and which of them each row has; -1 is none.
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
        Column { values, has_value: false, exceeds_f32: false }
    }

    /// Appends a number other than an integer; `text` is how it was written.
    #[inline]
    pub(super) fn push_real(&mut self, value: f64, text: &[u8]) {
        self.has_value = true;
        if !self.exceeds_f32 {
            self.exceeds_f32 = exceeds_f32(text, value);
        }
        if let Some(reals) = self.reals() {
            reals.push(value);
        }
    }

    /// Appends an integer to a column of integers.
    #[inline]
    pub(super) fn push_integer(&mut self, value: i64, text: &[u8]) {
        self.has_value = true;
        match &mut self.values {
            ColumnValues::Integers(integers) => integers.push(value),
            _ => self.push_real(integer_as_real(value), text),
        }
    }

    pub(super) fn push_missing(&mut self) {
        match &mut self.values {
            ColumnValues::Texts(texts) => texts.indices.push(-1),
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
            let texts = Texts { indices: vec![-1; self.len()], ..Texts::default() };
            self.values = ColumnValues::Texts(texts);
            self.has_value = true;
        }
        let ColumnValues::Texts(texts) = &mut self.values else { return Err(NotAText) };
        let index = match texts.index_of.get(text) {
            Some(&index) => index,
            None => {
                let index = i32::try_from(texts.table.len()).map_err(|_| NotAText)?;
                texts.table.push(String::from_utf8_lossy(text).into_owned());
                texts.index_of.insert(text.to_vec(), index);
                index
            }
        };
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

    /// The column as reals; integers become such. None if it holds texts.
    pub(super) fn reals(&mut self) -> Option<&mut Vec<f64>> {
        if let ColumnValues::Integers(integers) = &mut self.values {
            let integers = std::mem::take(integers);
            self.exceeds_f32 |= integers.iter().any(|&value| {
                let value = integer_as_real(value);
                f64::from(narrow(value)) != value
            });
            // Of one size: the allocation stays.
            self.values = ColumnValues::Reals(integers.into_iter().map(integer_as_real).collect());
        }
        match &mut self.values {
            ColumnValues::Reals(reals) => Some(reals),
            _ => None,
        }
    }
}

/// That a text stands in a column of numbers, or is one too many.
#[derive(Debug)]
pub(super) struct NotAText;

/// Exact up to 2⁵³; identities beyond keep their column free of other numbers.
fn integer_as_real(value: i64) -> f64 {
    value as f64
}
