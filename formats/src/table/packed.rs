//! The particles of a sample of a container as bytes, for programs that move and hash the bytes of frames.
//!
//! ```text
//!   magic │ format │ positions │ attributes │ notes
//!
//!   text         [bytes] UTF-8                           numbers in brackets have 32 or, for counts of
//!   positions    type [count] x y z x y z ..             particles and values, 64 bits; all are
//!   attributes   [number], each: name [arity]            little-endian
//!                role type [count] values
//!   strings      [count] index index .. [strings] text text ..
//! ```
//!
//! This is no file format: no file has these bytes, and they may change with every version.

use crate::core::bytes::{Cursor, Endian};
use crate::core::data::{AttributeRole, FileAttribute, FilePositions, ParticleFrame, Values};
use crate::core::error::Result;
use crate::core::limits::Limits;
use crate::core::number::{NumberType, append_bytes};
use crate::table::Format;

/// The first bytes.
const MAGIC: &[u8] = b"\x93meniscus particles\x01";

/// The name in errors.
const PACKED: &str = "packed particles";

/// The roles; their codes are their places, from 1.
const ROLES: [AttributeRole; 10] = [
    AttributeRole::Velocity,
    AttributeRole::Acceleration,
    AttributeRole::Normal,
    AttributeRole::Color,
    AttributeRole::Radius,
    AttributeRole::Density,
    AttributeRole::Mass,
    AttributeRole::Id,
    AttributeRole::Kind,
    AttributeRole::TextureCoordinates,
];

/// The types of values; their codes are their places. Strings have the code after them.
const TYPES: [NumberType; 5] =
    [NumberType::F32, NumberType::F64, NumberType::U8, NumberType::I32, NumberType::I64];
const STRINGS: u8 = 5;

/// Packs particles that were read from a file of this format.
pub(crate) fn pack(format: Format, frame: &ParticleFrame) -> Vec<u8> {
    let mut out = MAGIC.to_vec();
    add_text(format.name(), &mut out);
    let count = frame.positions.len() as u64;
    match &frame.positions {
        FilePositions::F32(positions) => {
            add_values(0, 3 * count, positions.as_flattened(), f32::to_le_bytes, &mut out);
        }
        FilePositions::F64(positions) => {
            add_values(1, 3 * count, positions.as_flattened(), f64::to_le_bytes, &mut out);
        }
    }
    add_count(frame.attributes.len(), &mut out);
    for FileAttribute { name, arity, role, values } in &frame.attributes {
        add_text(name, &mut out);
        add_count(*arity, &mut out);
        let code = role.and_then(|role| ROLES.iter().position(|known| *known == role));
        out.push(code.and_then(|code| u8::try_from(code + 1).ok()).unwrap_or(0));
        let count = values.len() as u64;
        match values {
            Values::F32(values) => add_values(0, count, values, f32::to_le_bytes, &mut out),
            Values::F64(values) => add_values(1, count, values, f64::to_le_bytes, &mut out),
            Values::U8(values) => add_values(2, count, values, u8::to_le_bytes, &mut out),
            Values::I32(values) => add_values(3, count, values, i32::to_le_bytes, &mut out),
            Values::I64(values) => add_values(4, count, values, i64::to_le_bytes, &mut out),
            Values::Strings { table, indices } => {
                add_values(STRINGS, count, indices, i32::to_le_bytes, &mut out);
                add_texts(table, &mut out);
            }
        }
    }
    add_texts(&frame.notes, &mut out);
    out
}

fn add_values<T: Copy, const N: usize>(
    code: u8,
    count: u64,
    values: &[T],
    to_bytes: impl Fn(T) -> [u8; N],
    out: &mut Vec<u8>,
) {
    out.push(code);
    out.extend(count.to_le_bytes());
    append_bytes(values, to_bytes, out);
}

/// Adds the length of a list of names, or of a name.
fn add_count(count: usize, out: &mut Vec<u8>) {
    out.extend((count as u64).to_le_bytes());
}

fn add_text(text: &str, out: &mut Vec<u8>) {
    add_count(text.len(), out);
    out.extend(text.as_bytes());
}

fn add_texts(texts: &[String], out: &mut Vec<u8>) {
    add_count(texts.len(), out);
    texts.iter().for_each(|text| add_text(text, out));
}

/// The format of the file that packed particles were read from; `None` for other bytes.
pub fn format_of_packed(bytes: &[u8]) -> Option<Format> {
    let name = text(&mut opened(bytes)?, "the format").ok()?;
    Format::ALL.into_iter().find(|format| format.name() == name)
}

/// Unpacks particles; `None` for other bytes.
///
/// # Errors
/// [`crate::Error::Truncated`] and [`crate::Error::Invalid`] for damaged bytes, [`crate::Error::TooLarge`]
/// beyond `limits`.
pub(crate) fn unpack(bytes: &[u8], limits: &Limits) -> Option<Result<ParticleFrame>> {
    opened(bytes).map(|mut cursor| frame(&mut cursor, limits))
}

fn opened(bytes: &[u8]) -> Option<Cursor<'_>> {
    bytes.starts_with(MAGIC).then(|| Cursor::new(PACKED, Endian::Little, bytes, MAGIC.len()))
}

fn frame(cursor: &mut Cursor, limits: &Limits) -> Result<ParticleFrame> {
    text(cursor, "the format")?;
    let positions = match values(cursor, "the positions")? {
        Values::F32(values) if values.len() % 3 == 0 => FilePositions::F32(values.as_chunks().0.to_vec()),
        Values::F64(values) if values.len() % 3 == 0 => FilePositions::F64(values.as_chunks().0.to_vec()),
        _ => return Err(cursor.invalid("expected positions of three floats")),
    };
    limits.check_particles(PACKED, positions.len() as u64)?;
    let count = length(cursor, "the number of attributes")?;
    limits.check_attributes(PACKED, count, "attributes")?;
    let attributes = (0..count).map(|_| attribute(cursor, positions.len()));
    let attributes = attributes.collect::<Result<_>>()?;
    let notes = texts(cursor, "the notes")?;
    if cursor.remaining() > 0 {
        return Err(cursor.invalid("expected the end"));
    }
    Ok(ParticleFrame { positions, attributes, notes })
}

fn attribute(cursor: &mut Cursor, particle_count: usize) -> Result<FileAttribute> {
    let name = text(cursor, "the name of an attribute")?.to_owned();
    let arity = length(cursor, "an arity")?;
    let role = match cursor.u8("a role")? {
        0 => None,
        code => match ROLES.get(usize::from(code) - 1) {
            None => return Err(cursor.invalid(format!("{code} is not the code of a role"))),
            role => role.copied(),
        },
    };
    let values = values(cursor, &name)?;
    if particle_count.checked_mul(arity) != Some(values.len()) {
        let what = format!("expected {arity} values for each of {particle_count} particles");
        return Err(cursor.invalid(what));
    }
    Ok(FileAttribute { name, arity, role, values })
}

fn values(cursor: &mut Cursor, what: &str) -> Result<Values> {
    let code = cursor.u8("a type")?;
    let number = match code {
        STRINGS => NumberType::I32,
        code => *TYPES
            .get(usize::from(code))
            .ok_or_else(|| cursor.invalid(format!("{code} is not the code of a type")))?,
    };
    let count = cursor.u64("a number of values")?;
    let length = usize::try_from(count).ok().and_then(|count| count.checked_mul(number.size()));
    let bytes = cursor.take(length.unwrap_or(usize::MAX), what)?;
    match number.decode(bytes, Endian::Little) {
        Values::I32(indices) if code == STRINGS => {
            Ok(Values::Strings { table: texts(cursor, "the strings")?, indices })
        }
        values => Ok(values),
    }
}

/// A length; more than the bytes have if it exceeds memory.
fn length(cursor: &mut Cursor, what: &str) -> Result<usize> {
    Ok(usize::try_from(cursor.u64(what)?).unwrap_or(usize::MAX))
}

fn text<'a>(cursor: &mut Cursor<'a>, what: &str) -> Result<&'a str> {
    let length = length(cursor, what)?;
    let bytes = cursor.take(length, what)?;
    std::str::from_utf8(bytes).map_err(|_| cursor.invalid(format!("expected {what} in UTF-8")))
}

/// Each text takes at least the eight bytes of its length.
fn texts(cursor: &mut Cursor, what: &str) -> Result<Vec<String>> {
    let count = length(cursor, what)?;
    if count > cursor.remaining() / 8 {
        let bytes = cursor.remaining();
        return Err(cursor.truncated(format!("expected {count} texts of {what}, found {bytes} bytes")));
    }
    (0..count).map(|_| Ok(text(cursor, what)?.to_owned())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::error::Error;

    fn example() -> ParticleFrame {
        let attribute =
            |name: &str, arity, role, values| FileAttribute { name: name.to_owned(), arity, role, values };
        let table = vec!["wall".to_owned(), String::new(), "flüssig".to_owned()];
        let mut attributes = vec![
            attribute("v", 3, Some(AttributeRole::Velocity), Values::F32(vec![0.5; 6])),
            attribute("T", 1, None, Values::F64(vec![f64::NAN.copysign(-1.0), 1e300])),
            attribute("flags", 2, None, Values::U8(vec![0, 1, 254, 255])),
            attribute("phase", 1, Some(AttributeRole::Kind), Values::I32(vec![-1, i32::MAX])),
            attribute("id", 1, Some(AttributeRole::Id), Values::I64(vec![i64::MIN, 7])),
            attribute("", 1, None, Values::Strings { table, indices: vec![2, -1] }),
        ];
        attributes.extend(ROLES.map(|role| attribute("one", 0, Some(role), Values::U8(vec![]))));
        ParticleFrame {
            positions: FilePositions::F64(vec![[0.1, -0.0, 1e-310], [f64::INFINITY, 2.0, 3.0]]),
            attributes,
            notes: vec!["a note".to_owned(), String::new()],
        }
    }

    #[test]
    fn packed_particles_are_unpacked_exactly() {
        let single = ParticleFrame {
            positions: FilePositions::F32(vec![[0.5, 1.5, -2.5]]),
            ..ParticleFrame::default()
        };
        for frame in [example(), single, ParticleFrame::default()] {
            let bytes = pack(Format::VtkIndex, &frame);
            assert_eq!(format_of_packed(&bytes), Some(Format::VtkIndex));
            let found = unpack(&bytes, &Limits::default()).expect("packed").expect("valid");
            // A number that is not a number does not equal itself.
            assert_eq!(format!("{found:?}"), format!("{frame:?}"));
            assert_eq!(pack(Format::VtkIndex, &found), bytes);
        }
        assert!(unpack(b"ply\n", &Limits::default()).is_none() && format_of_packed(b"ply\n").is_none());
    }

    #[test]
    fn damaged_bytes_are_errors() {
        let bytes = pack(Format::VtkIndex, &example());
        for length in MAGIC.len()..bytes.len() {
            let error = unpack(&bytes[..length], &Limits::default()).expect("the magic").expect_err("cut");
            assert!(matches!(error, Error::Truncated { .. } | Error::Invalid { .. }), "{length}: {error}");
        }
        // Any result is allowed, but no panic and no large allocation.
        let mut state = 1u64;
        for _ in 0..20_000 {
            let mut damaged = bytes.clone();
            for _ in 0..1 + state % 4 {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                let at = MAGIC.len() + (state >> 33) as usize % (bytes.len() - MAGIC.len());
                damaged[at] = (state >> 20).to_le_bytes()[0];
            }
            let _ = unpack(&damaged, &Limits::default());
        }
        let longer = [&bytes[..], b"x"].concat();
        assert!(unpack(&longer, &Limits::default()).expect("packed").is_err());
        let few = Limits { particle_count: 1, ..Limits::default() };
        assert!(matches!(unpack(&bytes, &few), Some(Err(Error::TooLarge { .. }))));
    }
}
