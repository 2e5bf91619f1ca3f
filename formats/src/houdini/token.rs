//! A token of JSON, in text or binary form, and limits of the memory that tokens may take.

use std::borrow::Cow;

use crate::bytes::Endian;
use crate::number::NumberType;

/// A token of JSON. Commas and colons carry no information and are not tokens.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum JsonToken<'a> {
    /// The start of an array or map.
    Open,
    Close,
    Null,
    Bool(bool),
    Integer(i64),
    Real(f64),
    Text(Cow<'a, str>),
    /// A uniform array of numbers. This and the following tokens occur only in the binary form.
    Numbers {
        number: NumberType,
        endian: Endian,
        payload: &'a [u8],
    },
    /// A uniform array of booleans.
    Bools(Vec<bool>),
    /// A uniform array of strings.
    Texts(Vec<Cow<'a, str>>),
}

/// The maximum number of strings in a list, for a file of this size. Even an empty string takes some dozens
/// of bytes of memory.
pub(super) fn text_count_max(file_bytes: usize) -> usize {
    (1 << 16) + file_bytes / 16
}

/// The maximum size in memory, in bytes, of items that take less space in the file; for a file of this size.
pub(super) fn widened_bytes_max(file_bytes: usize) -> usize {
    (16 << 20) + 2 * file_bytes
}
