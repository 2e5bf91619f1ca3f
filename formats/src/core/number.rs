//! Decodes raw numbers of any type and byte order into [`Values`], and encodes numbers.
//!
//! 16-bit floats become 32-bit ones. Unsigned 64-bit integers become 64-bit floats if one of them exceeds the
//! signed range.

use std::collections::HashMap;
use std::io::Write;

use crate::core::bytes::Endian;
use crate::core::data::{FilePositions, Values};
use crate::core::error::Result;
use crate::core::text::parse_number;

/// Evaluates an expression for the numbers of any type, or for the indices of strings.
macro_rules! of_any_type {
    ($values:expr, $list:ident => $result:expr) => {
        match $values {
            Values::F32($list) => $result,
            Values::F64($list) => $result,
            Values::U8($list) => $result,
            Values::I32($list) => $result,
            Values::I64($list) => $result,
            Values::Strings { indices: $list, .. } => $result,
        }
    };
}

/// As `of_any_type`, for an expression that gives numbers of the same type.
macro_rules! map_any_type {
    ($values:expr, $list:ident => $result:expr) => {
        match $values {
            Values::F32($list) => Values::F32($result),
            Values::F64($list) => Values::F64($result),
            Values::U8($list) => Values::U8($result),
            Values::I32($list) => Values::I32($result),
            Values::I64($list) => Values::I64($result),
            Values::Strings { table, indices: $list } => {
                Values::Strings { table: table.clone(), indices: $result }
            }
        }
    };
}
pub(crate) use of_any_type;

/// A number type as stored in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[expect(missing_docs, reason = "the names say it")]
pub enum NumberType {
    /// One byte: 0 is false, any other value is true.
    Bool,
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F16,
    F32,
    F64,
}

impl NumberType {
    /// Bytes per number.
    pub const fn size(self) -> usize {
        match self {
            NumberType::Bool | NumberType::I8 | NumberType::U8 => 1,
            NumberType::I16 | NumberType::U16 | NumberType::F16 => 2,
            NumberType::I32 | NumberType::U32 | NumberType::F32 => 4,
            NumberType::I64 | NumberType::U64 | NumberType::F64 => 8,
        }
    }

    /// The numbers of a kind (`i`: signed integers, `u`: unsigned ones, `f`: floats) that have this many bytes.
    pub(crate) fn of_kind(kind: char, bytes: usize) -> Option<NumberType> {
        Some(match (kind, bytes) {
            ('i', 1) => NumberType::I8,
            ('u', 1) => NumberType::U8,
            ('i', 2) => NumberType::I16,
            ('u', 2) => NumberType::U16,
            ('i', 4) => NumberType::I32,
            ('u', 4) => NumberType::U32,
            ('i', 8) => NumberType::I64,
            ('u', 8) => NumberType::U64,
            ('f', 2) => NumberType::F16,
            ('f', 4) => NumberType::F32,
            ('f', 8) => NumberType::F64,
            _ => return None,
        })
    }

    /// The type with a name such as `uint8` or `Float32`.
    pub(crate) fn named(name: &str) -> Option<NumberType> {
        let (stem, bits) = name.split_at(name.find(|c: char| c.is_ascii_digit())?);
        let kind = match &*stem.to_ascii_lowercase() {
            "int" => 'i',
            "uint" => 'u',
            "float" => 'f',
            _ => return None,
        };
        let bits: usize = bits.parse().ok().filter(|bits| bits % 8 == 0)?;
        NumberType::of_kind(kind, bits / 8)
    }

    /// Zeros of the type to which these numbers decode.
    pub(crate) fn zeros(self, count: usize) -> Values {
        let mut values = self.decode(&[], Endian::Little);
        of_any_type!(&mut values, values => values.resize(count, Default::default()));
        values
    }

    /// Decodes tightly packed numbers; ignores an incomplete number at the end.
    pub(crate) fn decode(self, bytes: &[u8], endian: Endian) -> Values {
        self.decode_strided(bytes, endian, self.size(), 0, 1)
    }

    /// Decodes the `arity` numbers at `offset` in each record of `stride` bytes. They must lie within the
    /// record.
    pub(crate) fn decode_strided(
        self,
        bytes: &[u8],
        endian: Endian,
        stride: usize,
        offset: usize,
        arity: usize,
    ) -> Values {
        let records = StridedNumbers { bytes, endian, stride, offset, arity };
        match self {
            NumberType::Bool => Values::U8(records.map(|[byte]: [u8; 1]| u8::from(byte != 0))),
            NumberType::U8 => Values::U8(records.map(|[byte]: [u8; 1]| byte)),
            NumberType::I8 => Values::I32(records.map(|byte| i8::from_le_bytes(byte).into())),
            NumberType::I16 => Values::I32(records.map(|bytes| i16::from_le_bytes(bytes).into())),
            NumberType::U16 => Values::I32(records.map(|bytes| u16::from_le_bytes(bytes).into())),
            NumberType::I32 => Values::I32(records.map(i32::from_le_bytes)),
            NumberType::U32 => Values::I64(records.map(|bytes| u32::from_le_bytes(bytes).into())),
            NumberType::I64 => Values::I64(records.map(i64::from_le_bytes)),
            NumberType::U64 => unsigned(&records),
            NumberType::F16 => Values::F32(records.map(|bytes| half::f16::from_le_bytes(bytes).to_f32())),
            NumberType::F32 => Values::F32(records.map(f32::from_le_bytes)),
            NumberType::F64 => Values::F64(records.map(f64::from_le_bytes)),
        }
    }
}

fn unsigned(records: &StridedNumbers) -> Values {
    let is_signed = |value: &i64| *value >= 0;
    let signed = records.map(i64::from_le_bytes);
    if signed.iter().all(is_signed) {
        Values::I64(signed)
    } else {
        Values::F64(records.map(|bytes| u64::from_le_bytes(bytes) as f64))
    }
}

/// Locations of numbers in an array of records.
struct StridedNumbers<'a> {
    bytes: &'a [u8],
    endian: Endian,
    stride: usize,
    offset: usize,
    arity: usize,
}

impl StridedNumbers<'_> {
    /// Applies `decode` to the bytes of each number, least significant byte first.
    fn map<const N: usize, T>(&self, decode: impl Fn([u8; N]) -> T) -> Vec<T> {
        let decode = |mut number: [u8; N]| {
            if self.endian == Endian::Big {
                number.reverse();
            }
            decode(number)
        };
        if self.stride == N && self.arity == 1 {
            return self.bytes.as_chunks::<N>().0.iter().map(|&number| decode(number)).collect();
        }
        let mut values = Vec::with_capacity(self.bytes.len() / self.stride.max(1) * self.arity);
        for record in self.bytes.chunks_exact(self.stride) {
            let numbers = record.get(self.offset..self.offset + self.arity * N).unwrap_or_default();
            values.extend(numbers.as_chunks::<N>().0.iter().map(|&number| decode(number)));
        }
        values
    }
}

impl Values {
    /// The number of values.
    pub(crate) fn len(&self) -> usize {
        of_any_type!(self, values => values.len())
    }
}

/// The values as 64-bit floats; none for strings.
pub(crate) fn wide(values: &Values) -> Vec<f64> {
    match values {
        Values::F32(values) => values.iter().map(|&value| value.into()).collect(),
        Values::F64(values) => values.clone(),
        Values::U8(values) => values.iter().map(|&value| value.into()).collect(),
        Values::I32(values) => values.iter().map(|&value| value.into()).collect(),
        Values::I64(values) => values.iter().map(|&value| value as f64).collect(),
        Values::Strings { .. } => Vec::new(),
    }
}

/// Strings, each of which is in the table once.
pub(crate) fn distinct_strings(words: Vec<String>) -> Values {
    let (mut table, mut indices, mut known) = (Vec::new(), Vec::with_capacity(words.len()), HashMap::new());
    for word in words {
        let next = i32::try_from(table.len()).unwrap_or(-1);
        indices.push(*known.entry(word).or_insert_with_key(|word: &String| {
            table.push(word.clone());
            next
        }));
    }
    Values::Strings { table, indices }
}

/// Converts values to positions of three values each. The positions have 64 bits if 32-bit floats cannot hold
/// all values of this type exactly. `None` for strings.
pub(crate) fn positions(values: Values) -> Option<FilePositions> {
    fn triple<T: Copy, U>(values: &[T], widen: impl Fn(T) -> U) -> Vec<[U; 3]> {
        values.as_chunks::<3>().0.iter().map(|position| position.map(&widen)).collect()
    }
    Some(match values {
        Values::F32(values) => FilePositions::F32(triple(&values, |x| x)),
        Values::U8(values) => FilePositions::F32(triple(&values, f32::from)),
        Values::F64(values) => FilePositions::F64(triple(&values, |x| x)),
        Values::I32(values) => FilePositions::F64(triple(&values, f64::from)),
        Values::I64(values) => FilePositions::F64(triple(&values, |x| x as f64)),
        Values::Strings { .. } => return None,
    })
}

/// The position of a homogeneous point with weight `w`. Weights 0 and 1 leave it unchanged.
pub(crate) fn divided<T>([x, y, z, w]: [T; 4]) -> [T; 3]
where
    T: Copy + PartialEq + From<u8> + std::ops::Div<Output = T>,
{
    if w == T::from(0) || w == T::from(1) { [x, y, z] } else { [x / w, y / w, z / w] }
}

/// The given range of each particle's `arity` components.
pub(crate) fn components(values: &Values, arity: usize, range: std::ops::Range<usize>) -> Values {
    map_any_type!(values, values => {
        values.chunks_exact(arity).flat_map(|particle| &particle[range.clone()]).copied().collect()
    })
}

/// The elements of `arity` values that indices refer to; `None` if one does not exist.
pub(crate) fn gathered(
    values: &Values,
    arity: usize,
    indices: &[impl Copy + TryInto<usize>],
) -> Option<Values> {
    fn gather<T: Copy>(table: &[T], arity: usize, indices: &[impl Copy + TryInto<usize>]) -> Option<Vec<T>> {
        let mut all = Vec::with_capacity(indices.len().checked_mul(arity)?);
        for index in indices {
            let index: usize = (*index).try_into().ok()?;
            let start = index.checked_mul(arity)?;
            all.extend_from_slice(table.get(start..)?.get(..arity)?);
        }
        Some(all)
    }
    Some(map_any_type!(values, values => gather(values, arity, indices)?))
}

/// A range of the values, which must be in bounds.
pub(crate) fn slice(values: &Values, range: std::ops::Range<usize>) -> Values {
    map_any_type!(values, values => values[range].to_vec())
}

/// Interleaves columns of one type into a vector attribute. `None` for strings, mixed types,
/// different lengths or no columns.
pub(crate) fn interleaved(columns: &[&Values]) -> Option<Values> {
    fn gather<T: Copy>(columns: &[&Values], of: impl Fn(&Values) -> Option<&[T]>) -> Option<Vec<T>> {
        let columns: Vec<&[T]> = columns.iter().map(|column| of(column)).collect::<Option<_>>()?;
        let row_count = columns.first()?.len();
        let are_equal = columns.iter().all(|column| column.len() == row_count);
        are_equal
            .then(|| (0..row_count).flat_map(|row| columns.iter().map(move |column| column[row])).collect())
    }
    macro_rules! of {
        ($variant:ident) => {
            gather(columns, |values| match values {
                Values::$variant(values) => Some(values),
                _ => None,
            })
            .map(Values::$variant)
        };
    }
    match columns.first()? {
        Values::F32(_) => of!(F32),
        Values::F64(_) => of!(F64),
        Values::U8(_) => of!(U8),
        Values::I32(_) => of!(I32),
        Values::I64(_) => of!(I64),
        Values::Strings { .. } => None,
    }
}

/// Appends values of the same type; returns whether the types matched. String tables must be equal.
/// [`append_any`] has no such condition.
pub(crate) fn append(values: &mut Values, more: Values) -> bool {
    match (values, more) {
        (Values::F32(values), Values::F32(more)) => values.extend(more),
        (Values::F64(values), Values::F64(more)) => values.extend(more),
        (Values::U8(values), Values::U8(more)) => values.extend(more),
        (Values::I32(values), Values::I32(more)) => values.extend(more),
        (Values::I64(values), Values::I64(more)) => values.extend(more),
        (Values::Strings { table, indices }, Values::Strings { table: other, indices: more })
            if *table == other =>
        {
            indices.extend(more);
        }
        _ => return false,
    }
    true
}

/// Appends values of the same type, and strings with any table; returns whether the types matched.
pub(crate) fn append_any(values: &mut Values, more: Values) -> bool {
    if let (Values::Strings { table, indices }, Values::Strings { table: other, indices: more }) =
        (&mut *values, &more)
    {
        let (first, end) = (table.len(), other.len());
        let moved = |index: &i32| {
            let index = usize::try_from(*index).ok().filter(|index| *index < end);
            index.and_then(|index| i32::try_from(first + index).ok()).unwrap_or(-1)
        };
        indices.extend(more.iter().map(moved));
        table.extend_from_slice(other);
        return true;
    }
    append(values, more)
}

// Writes numbers as little-endian bytes, in chunks that fit into the cache.

/// Numbers converted per chunk.
const PIECE: usize = 4096;

/// Writes floats.
pub(crate) fn write_f32s(numbers: &[f32], out: &mut (impl Write + ?Sized)) -> Result<()> {
    write_pieces(numbers, f32::to_le_bytes, out)
}

/// Converts each number with `to_bytes` and writes the results.
pub(crate) fn write_pieces<T: Copy, const N: usize>(
    numbers: &[T],
    to_bytes: impl Fn(T) -> [u8; N],
    out: &mut (impl Write + ?Sized),
) -> Result<()> {
    let mut bytes = [[0; N]; PIECE];
    for piece in numbers.chunks(PIECE) {
        for (bytes, &number) in bytes.iter_mut().zip(piece) {
            *bytes = to_bytes(number);
        }
        out.write_all(bytes[..piece.len()].as_flattened())?;
    }
    Ok(())
}

/// Converts each number with `to_bytes` and appends the results.
pub(crate) fn append_bytes<T: Copy, const N: usize>(
    numbers: &[T],
    to_bytes: impl Fn(T) -> [u8; N],
    out: &mut Vec<u8>,
) {
    let start = out.len();
    out.resize(start + N * numbers.len(), 0);
    for (bytes, &number) in out[start..].as_chunks_mut::<N>().0.iter_mut().zip(numbers) {
        *bytes = to_bytes(number);
    }
}

/// Parses the first `count` words as values of the type that [`NumberType::decode`] returns. The error is the
/// beginning of the first invalid word.
pub(crate) fn decimals<'a>(
    words: impl Iterator<Item = &'a [u8]>,
    number: NumberType,
    count: usize,
) -> std::result::Result<Values, Vec<u8>> {
    fn parse<'a, T>(
        words: impl Iterator<Item = &'a [u8]>,
        count: usize,
        parse: impl Fn(&'a [u8]) -> Option<T>,
    ) -> std::result::Result<Vec<T>, Vec<u8>> {
        let mut values = Vec::with_capacity(count);
        for word in words.take(count) {
            values.push(parse(word).ok_or_else(|| word[..word.len().min(24)].to_vec())?);
        }
        Ok(values)
    }
    fn real<T: fast_float2::FastFloat>(word: &[u8]) -> Option<T> {
        parse_number(word).filter(|(_, length)| *length == word.len()).map(|(value, _)| value)
    }
    fn integer<T: std::str::FromStr>(word: &[u8]) -> Option<T> {
        std::str::from_utf8(word).ok()?.parse().ok()
    }
    Ok(match number {
        NumberType::F16 | NumberType::F32 => Values::F32(parse(words, count, real)?),
        NumberType::F64 => Values::F64(parse(words, count, real)?),
        NumberType::Bool | NumberType::U8 => Values::U8(parse(words, count, integer)?),
        NumberType::I8 | NumberType::I16 | NumberType::U16 | NumberType::I32 => {
            Values::I32(parse(words, count, integer)?)
        }
        NumberType::U32 | NumberType::I64 => Values::I64(parse(words, count, integer)?),
        NumberType::U64 => {
            let integers: Vec<u64> = parse(words, count, integer)?;
            // `decode` chooses floats if a value exceeds the signed range.
            let bytes: Vec<u8> = integers.iter().flat_map(|value| value.to_le_bytes()).collect();
            NumberType::U64.decode(&bytes, Endian::Little)
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_decoded_in_both_byte_orders() {
        let bytes = [0x3c, 0x00, 0x80, 0x01];
        let table = [
            (NumberType::F16, Endian::Big, Values::F32(vec![1.0, -5.960_464_5e-8])),
            (NumberType::F16, Endian::Little, Values::F32(vec![3.576_278_7e-6, 2.288_818_4e-5])),
            (NumberType::U16, Endian::Big, Values::I32(vec![0x3c00, 0x8001])),
            (NumberType::I16, Endian::Big, Values::I32(vec![0x3c00, -0x7fff])),
            (NumberType::U32, Endian::Little, Values::I64(vec![0x0180_003c])),
            (NumberType::Bool, Endian::Little, Values::U8(vec![1, 0, 1, 1])),
            (NumberType::I8, Endian::Little, Values::I32(vec![0x3c, 0, -128, 1])),
            (NumberType::F64, Endian::Little, Values::F64(vec![])),
        ];
        for (number, endian, expected) in table {
            assert_eq!(number.decode(&bytes, endian), expected, "{number:?} {endian:?}");
        }
        let wide = [[0xff; 8], [1, 0, 0, 0, 0, 0, 0, 0]].concat();
        assert_eq!(
            NumberType::U64.decode(&wide, Endian::Little),
            Values::F64(vec![18_446_744_073_709_551_615.0, 1.0])
        );
        assert_eq!(NumberType::I64.decode(&wide, Endian::Little), Values::I64(vec![-1, 1]));
        let strided = NumberType::U8.decode_strided(&bytes, Endian::Little, 2, 1, 1);
        assert_eq!(strided, Values::U8(vec![0, 1]));
    }

    #[test]
    fn values_are_split_and_joined() {
        let (x, y) = (Values::I32(vec![1, 3]), Values::I32(vec![2, 4]));
        let both = interleaved(&[&x, &y]).unwrap();
        assert_eq!(both, Values::I32(vec![1, 2, 3, 4]));
        assert_eq!(components(&both, 2, 1..2), y);
        assert_eq!(interleaved(&[&x, &Values::F32(vec![0.0; 2])]), None);
        assert_eq!(interleaved(&[&x, &Values::F64(vec![0.0; 3])]), None);
        assert_eq!(interleaved(&[]), None);
        let mut longer = x;
        assert!(append(&mut longer, y) && !append(&mut longer, Values::U8(vec![1])));
        assert_eq!(longer, Values::I32(vec![1, 3, 2, 4]));
        assert_eq!(positions(Values::U8(vec![1, 2, 3, 4])), Some(FilePositions::F32(vec![[1.0, 2.0, 3.0]])));
    }
}
