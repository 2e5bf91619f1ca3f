//! Reads the records of a body value by value, in any encoding.
//!
//! This is the slow path, for faces, skipped elements and records with lists.

use rayon::prelude::*;

use super::FORMAT;
use super::ascii::BodyLines;
use super::header::{Element, PlyHeader, Property, PropertyType};
use crate::bytes::{Cursor, Endian};
use crate::error::{Error, Position, Result};
use crate::limits::Limits;
use crate::number::Scalar;

/// A read position in the body.
pub(super) enum RecordReader<'a> {
    Binary(Cursor<'a>),
    Ascii(BodyLines<'a>),
}

impl<'a> RecordReader<'a> {
    /// Starts at offset `at` of the file.
    pub(super) fn new(bytes: &'a [u8], header: &PlyHeader, at: usize) -> RecordReader<'a> {
        match header.encoding.endian() {
            Some(endian) => RecordReader::Binary(Cursor::new(FORMAT, endian, bytes, at)),
            None => RecordReader::Ascii(BodyLines::new(bytes, at)),
        }
    }

    /// Offset in bytes from the start of the file.
    pub(super) fn at(&self) -> usize {
        match self {
            RecordReader::Binary(cursor) => cursor.at(),
            RecordReader::Ascii(lines) => lines.at(),
        }
    }

    /// Before the first record of an element.
    pub(super) fn begin(&mut self, element: &Element) {
        match self {
            RecordReader::Binary(_) => {}
            RecordReader::Ascii(lines) => lines.begin(element),
        }
    }

    /// Starts the next record.
    pub(super) fn start(&mut self) -> Result<()> {
        match self {
            RecordReader::Binary(_) => Ok(()),
            RecordReader::Ascii(lines) => lines.start(),
        }
    }

    /// Ends the record, all of whose values must have been read.
    pub(super) fn finish(&mut self) -> Result<()> {
        match self {
            RecordReader::Binary(_) => Ok(()),
            RecordReader::Ascii(lines) => lines.finish(),
        }
    }

    /// Reads the next value as an integer.
    pub(super) fn integer(&mut self, scalar: Scalar, what: &str) -> Result<i64> {
        match self {
            RecordReader::Binary(cursor) => cursor.integer(scalar, what),
            RecordReader::Ascii(lines) => lines.integer(scalar, what),
        }
    }

    /// Reads the count of a list, which must not be negative or exceed the remaining bytes.
    pub(super) fn list_length(&mut self, scalar: Scalar, property: &Property) -> Result<usize> {
        let count = self.integer(scalar, &property.name)?;
        let most = match self {
            RecordReader::Binary(cursor) => cursor.remaining(),
            RecordReader::Ascii(lines) => lines.remaining(),
        };
        usize::try_from(count).ok().filter(|&count| count <= most).ok_or_else(|| {
            let name = &property.name;
            if count < 0 {
                self.invalid(format!("list `{name}` has a negative count, {count}"))
            } else {
                self.truncated(format!("list `{name}` has a count of {count}, beyond the end of the file"))
            }
        })
    }

    /// Skips one property.
    pub(super) fn skip(&mut self, property: &Property) -> Result<()> {
        let (item, count) = match property.kind {
            PropertyType::Scalar(scalar) => (scalar, 1),
            PropertyType::List { count, item } => (item, self.list_length(count, property)?),
        };
        match self {
            RecordReader::Binary(cursor) => {
                let length = count.saturating_mul(item.size());
                cursor.take(length, &property.name).map(|_| ())
            }
            RecordReader::Ascii(lines) => (0..count).try_for_each(|_| lines.skip(&property.name)),
        }
    }

    /// Skips all records of an element.
    fn skip_element(&mut self, element: &Element) -> Result<()> {
        let count = checked_count(self, element)?;
        if let (RecordReader::Binary(cursor), false) = (&mut *self, element.has_list()) {
            // `checked_count` has compared the product with the remaining bytes.
            cursor.take(count * element.record_size_min(), &element.name)?;
            return Ok(());
        }
        self.begin(element);
        for _ in 0..count {
            self.start()?;
            for property in &element.properties {
                self.skip(property)?;
            }
            self.finish()?;
        }
        Ok(())
    }

    fn truncated(&self, what: String) -> Error {
        match self {
            RecordReader::Binary(cursor) => cursor.truncated(what),
            RecordReader::Ascii(lines) => lines.truncated(what),
        }
    }

    pub(super) fn invalid(&self, what: String) -> Error {
        match self {
            RecordReader::Binary(cursor) => cursor.invalid(what),
            RecordReader::Ascii(lines) => lines.invalid(what),
        }
    }
}

/// The number of records of the element at the current position, checked against the remaining bytes.
pub(super) fn checked_count(rows: &RecordReader<'_>, element: &Element) -> Result<usize> {
    let at = rows.at() as u64;
    match rows {
        RecordReader::Binary(cursor) => checked_binary_count(element, at, cursor.remaining() as u64),
        RecordReader::Ascii(lines) => {
            // Each value needs a digit and a separator, but the last line needs no line end.
            let (remaining, record) = (lines.remaining() as u64, 2 * element.properties.len());
            checked(element, at, remaining, remaining + 1, record, "bytes of text")
        }
    }
}

/// [`checked_count`] for a binary element at offset `at`, from which on `remaining` bytes follow.
pub(super) fn checked_binary_count(element: &Element, at: u64, remaining: u64) -> Result<usize> {
    checked(element, at, remaining, remaining, element.record_size_min(), "bytes")
}

/// The declared number of records, if they fit into `count_max` bytes with at least `record` bytes each.
fn checked(
    element: &Element,
    at: u64,
    remaining: u64,
    count_max: u64,
    record: usize,
    kind: &str,
) -> Result<usize> {
    if element.properties.is_empty() {
        return Ok(0); // records without properties need no reading
    }
    let most = count_max / record as u64;
    usize::try_from(element.count).ok().filter(|&count| count as u64 <= most).ok_or_else(|| {
        let Element { name, count, .. } = element;
        let what = format!(
            "the header declares {count} `{name}` records of at least {record} {kind}, but only {remaining} bytes follow",
        );
        let position = Position::Offset(at);
        // A size beyond 2⁶⁴ is invalid: no file that is still being written will reach it.
        match count.checked_mul(record as u64) {
            None => Error::invalid(FORMAT, position, what),
            Some(_) => Error::truncated(FORMAT, position, what),
        }
    })
}

/// Positions a reader at the records of `element`, which belongs to the header.
pub(super) fn rows_of<'a>(
    bytes: &'a [u8],
    header: &PlyHeader,
    element: &Element,
) -> Result<RecordReader<'a>> {
    let mut rows = RecordReader::new(bytes, header, header.body_offset);
    for earlier in header.elements.iter().take_while(|earlier| !std::ptr::eq(*earlier, element)) {
        rows.skip_element(earlier)?;
    }
    Ok(rows)
}

/// Checks the number of particles against the limit.
pub(super) fn check_limit(count: usize, limits: &Limits) -> Result<()> {
    if count as u64 <= limits.particle_count {
        return Ok(());
    }
    let most = limits.particle_count;
    Err(Error::too_large(FORMAT, format!("the file has {count} vertices; the limit is {most}")))
}

// Where the values of records go.

/// The destination of values.
pub(super) struct Target<'a> {
    /// Index and type of the property of each component; never empty.
    pub(super) columns: Vec<(usize, Scalar)>,
    /// All components of all particles.
    pub(super) slots: Slots<'a>,
}

/// The vector that a target fills. Its type can hold every value of the columns' scalar types.
pub(super) enum Slots<'a> {
    F32(&'a mut [f32]),
    F64(&'a mut [f64]),
    U8(&'a mut [u8]),
    I32(&'a mut [i32]),
    I64(&'a mut [i64]),
}

impl<'a> Target<'a> {
    /// Splits off the slots of the first `count` records.
    pub(super) fn take_front(&mut self, count: usize) -> Target<'a> {
        fn take<'a, T>(slots: &mut &'a mut [T], count: usize) -> &'a mut [T] {
            let (front, rest) = std::mem::take(slots).split_at_mut(count);
            *slots = rest;
            front
        }
        let count = count * self.columns.len();
        let slots = match &mut self.slots {
            Slots::F32(slots) => Slots::F32(take(slots, count)),
            Slots::F64(slots) => Slots::F64(take(slots, count)),
            Slots::U8(slots) => Slots::U8(take(slots, count)),
            Slots::I32(slots) => Slots::I32(take(slots, count)),
            Slots::I64(slots) => Slots::I64(take(slots, count)),
        };
        Target { columns: self.columns.clone(), slots }
    }
}

// Copies columns out of packed binary records.
//
//   records   x y z vx vy vz id | x y z vx vy vz id | ..       stride apart
//   targets   [x y z] [x y z] ..    [vx vy vz] ..    [id] ..
//
// The records are divided among the threads and processed in blocks that fit into the cache. Within a block,
// each target is filled by a loop specialised at compile time for type, byte order and arity.

/// Bytes of records per block: a block and the values copied from it fit into the L2 cache.
const BLOCK_BYTES: usize = 128 << 10;

/// Bytes of records per task. Most of a task's time is spent on page faults, at the first access to the
/// destination memory.
const PART_BYTES: usize = 2 << 20;

/// Fills the targets from records of `stride` bytes, in the caller's thread pool. `offsets` has the offset of
/// each property within a record.
pub(super) fn gather(
    records: &[u8],
    stride: usize,
    offsets: &[usize],
    endian: Endian,
    mut targets: Vec<Target<'_>>,
) {
    let part_records = (PART_BYTES / stride).max(1);
    let parts = records.chunks(part_records * stride).map(|records| {
        let count = records.len() / stride;
        let targets: Vec<Target> = targets.iter_mut().map(|target| target.take_front(count)).collect();
        (records, targets)
    });
    let parts: Vec<(&[u8], Vec<Target>)> = parts.collect();
    let gather_part = |(records, mut targets): (&[u8], Vec<Target>)| {
        gather_part(records, stride, offsets, endian, &mut targets);
    };
    parts.into_par_iter().for_each(gather_part);
}

/// [`gather`] on the current thread.
pub(super) fn gather_part(
    records: &[u8],
    stride: usize,
    offsets: &[usize],
    endian: Endian,
    targets: &mut [Target<'_>],
) {
    let block_records = (BLOCK_BYTES / stride).max(1);
    for (index, records) in records.chunks(block_records * stride).enumerate() {
        let block = RecordBlock { records, stride, first: index * block_records };
        for target in targets.iter_mut() {
            match endian {
                Endian::Little => block.fill::<false>(offsets, target),
                Endian::Big => block.fill::<true>(offsets, target),
            }
        }
    }
}

/// The offset of each property in a record without its lists, and the length of this record. A list has the
/// offset of the property after it.
pub(super) fn scalar_offsets(element: &Element) -> (Vec<usize>, usize) {
    let mut at = 0;
    let mut offsets = Vec::with_capacity(element.properties.len());
    for property in &element.properties {
        offsets.push(at);
        if let PropertyType::Scalar(scalar) = property.kind {
            at += scalar.size();
        }
    }
    (offsets, at)
}

/// Copies records without their lists.
pub(super) fn without_lists(rows: &mut RecordReader<'_>, element: &Element, count: usize) -> Result<Vec<u8>> {
    let (_, stride) = scalar_offsets(element);
    // The caller has checked that the file has `count` times `stride` bytes.
    let mut packed = Vec::with_capacity(count * stride);
    for _ in 0..count {
        for property in &element.properties {
            match (property.kind, &mut *rows) {
                (PropertyType::Scalar(scalar), RecordReader::Binary(cursor)) => {
                    packed.extend_from_slice(cursor.take(scalar.size(), &property.name)?);
                }
                _ => rows.skip(property)?,
            }
        }
    }
    Ok(packed)
}

/// A range of the records.
struct RecordBlock<'a> {
    records: &'a [u8],
    stride: usize,
    /// Index of the first record.
    first: usize,
}

impl RecordBlock<'_> {
    /// Fills one target.
    fn fill<const BIG: bool>(&self, offsets: &[usize], target: &mut Target<'_>) {
        let scalar = target.columns[0].1;
        let arity = target.columns.len();
        // Positions and vectors are copied in one pass.
        if let [x, y, z] = target.columns[..]
            && [x.1, y.1, z.1] == [scalar; 3]
        {
            let at = [x.0, y.0, z.0].map(|property| offsets[property]);
            return self.convert::<BIG, 3>(at, scalar, &mut target.slots, 0, 3);
        }
        for (component, &(property, scalar)) in target.columns.iter().enumerate() {
            self.convert::<BIG, 1>([offsets[property]], scalar, &mut target.slots, component, arity);
        }
    }

    /// Selects the conversion from the type in the file to the type of the slots.
    fn convert<const BIG: bool, const A: usize>(
        &self,
        offsets: [usize; A],
        scalar: Scalar,
        slots: &mut Slots<'_>,
        component: usize,
        arity: usize,
    ) {
        macro_rules! copy {
            ($out:ident, $from:ty) => {
                self.copy(offsets, &mut $out[self.first * arity..], component, arity, |bytes| {
                    <$from>::from_le_bytes(ordered::<BIG, _>(bytes)).into()
                })
            };
        }
        match (slots, scalar) {
            (Slots::F32(out), Scalar::F32) => copy!(out, f32),
            (Slots::F32(out), Scalar::I8) => copy!(out, i8),
            (Slots::F32(out), Scalar::U8) => copy!(out, u8),
            (Slots::F32(out), Scalar::I16) => copy!(out, i16),
            (Slots::F32(out), Scalar::U16) => copy!(out, u16),
            (Slots::F64(out), Scalar::F64) => copy!(out, f64),
            (Slots::F64(out), Scalar::F32) => copy!(out, f32),
            (Slots::F64(out), Scalar::I8) => copy!(out, i8),
            (Slots::F64(out), Scalar::U8) => copy!(out, u8),
            (Slots::F64(out), Scalar::I16) => copy!(out, i16),
            (Slots::F64(out), Scalar::U16) => copy!(out, u16),
            (Slots::F64(out), Scalar::I32) => copy!(out, i32),
            (Slots::F64(out), Scalar::U32) => copy!(out, u32),
            (Slots::U8(out), Scalar::U8) => copy!(out, u8),
            (Slots::I32(out), Scalar::I8) => copy!(out, i8),
            (Slots::I32(out), Scalar::I16) => copy!(out, i16),
            (Slots::I32(out), Scalar::U16) => copy!(out, u16),
            (Slots::I32(out), Scalar::I32) => copy!(out, i32),
            (Slots::I64(out), Scalar::U32) => copy!(out, u32),
            _ => unreachable!("slots can hold every value of their scalar type"),
        }
    }

    /// The copy loop. It copies all components of a record at a time (`A` is the arity, and `component` is
    /// 0), or only the given component (`A` is 1).
    fn copy<T, const N: usize, const A: usize>(
        &self,
        offsets: [usize; A],
        out: &mut [T],
        component: usize,
        arity: usize,
        decode: impl Fn([u8; N]) -> T + Copy,
    ) {
        let records = self.records.chunks_exact(self.stride);
        if A == arity {
            for (row, record) in out.as_chunks_mut::<A>().0.iter_mut().zip(records) {
                for (slot, offset) in row.iter_mut().zip(offsets) {
                    *slot = decode(array_at(record, offset));
                }
            }
        } else {
            let slots = out.iter_mut().skip(component).step_by(arity);
            for (slot, record) in slots.zip(records) {
                *slot = decode(array_at(record, offsets[0]));
            }
        }
    }
}

fn array_at<const N: usize>(record: &[u8], offset: usize) -> [u8; N] {
    let mut array = [0; N];
    array.copy_from_slice(&record[offset..offset + N]);
    array
}

/// The bytes with the least significant first.
fn ordered<const BIG: bool, const N: usize>(mut bytes: [u8; N]) -> [u8; N] {
    if BIG {
        bytes.reverse();
    }
    bytes
}
