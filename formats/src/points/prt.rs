//! PRT, the particle files of Krakatoa, which tyFlow, FumeFX and Frost write as well: versions 1.0 and 1.1.
//!
//! ```text
//!   C0 P R T 0D 0A 1A 0A         signature
//!   u32 = H                      length of the header, from the signature to the end of the metadata
//!   32 bytes                     "Extensible Particle Format"
//!   i32 = 1 or 2                 1.0 or 1.1
//!   i64 = N                      number of particles; −1 until the writer has finished
//!   "Meta" u32, bytes  ×  any    metadata of 1.1: a channel or "", a name, a type and a value
//!   "Stop" u32 = 0
//!   i32 = 4, i32 = C, i32 = L    number of channels, and the length of their definitions
//!   name (32 bytes), i32 type, i32 arity, i32 offset  ×  C
//!   one zlib stream              N records; channels are at their offsets
//! ```
//!
//! All numbers are little-endian. Source: Thinkbox, PRT File Format v1.1.

use flate2::{Decompress, FlushDecompress, Status};

use crate::core::bytes::{Cursor, Endian};
use crate::core::data::{FileAttribute, ParticleFrame};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::named_arrays::frame_of;
use crate::core::number::NumberType;
use crate::core::row::{Completeness, FormatRow, HeadCheck, ParticleReader};
use crate::core::text::{excerpt, excerpts};

/// The format's name in errors.
const FORMAT: &str = "PRT";

const MAGIC: &[u8] = b"\xc0PRT\r\n\x1a\n";
/// Offset of the number of particles.
const COUNT_AT: u64 = 48;
/// Length of a header without metadata.
const HEADER_BYTES: usize = 56;
/// Length of the definition of a channel, without additions of later versions.
const CHANNEL_BYTES: usize = 44;
/// Bytes decompressed between checks of the limits.
const PIECE_BYTES: usize = 256 << 10;

/// The types of channels, by number.
const TYPES: [NumberType; 11] = {
    use NumberType::{F16, F32, F64, I8, I16, I32, I64, U8, U16, U32, U64};
    [I16, I32, I64, F16, F32, F64, U16, U32, U64, I8, U8]
};

/// Reads the particles of a PRT file.
///
/// # Errors
///
/// [`Error::Truncated`] if the number of particles is −1, or if data is missing; [`Error::Invalid`] for a
/// malformed file or one without the channel `Position`; [`Error::Unsupported`] for later versions;
/// [`Error::TooLarge`] beyond `limits`.
pub fn read(bytes: &[u8], limits: &Limits) -> Result<ParticleFrame> {
    let PrtHeader { count, channels, stride, data_at, mut notes } = header(bytes, limits)?;
    let count = u64::try_from(count).map_err(|_| {
        let what = format!("the number of particles is {count}: the writer has not finished the file");
        Error::truncated(FORMAT, Position::Offset(COUNT_AT), what)
    })?;
    limits.check_particles(FORMAT, count)?;
    let records = match count.checked_mul(stride as u64) {
        Some(0) => Vec::new(),
        Some(length) => records(bytes, data_at, length, limits)?,
        None => return Err(Error::too_large(FORMAT, format!("{count} particles of {stride} bytes each"))),
    };
    let names: Vec<String> = channels.iter().map(|channel| channel.name.clone()).collect();
    let array = |PrtChannel { name, number, arity, offset }| {
        let values = number.decode_strided(&records, Endian::Little, stride.max(1), offset, arity);
        FileAttribute::new(name, arity, values)
    };
    let mut frame = frame_of(None, channels.into_iter().map(array).collect()).ok_or_else(|| {
        let what = format!("expected a channel Position with three numbers, found: {}", excerpts(&names));
        Error::invalid(FORMAT, Position::File, what)
    })?;
    frame.notes.append(&mut notes);
    Ok(frame)
}

/// Everything before the records.
struct PrtHeader {
    /// The number of particles; negative in a file that is not finished.
    count: i64,
    channels: Vec<PrtChannel>,
    /// Bytes per particle.
    stride: usize,
    /// Offset of the compressed records.
    data_at: usize,
    notes: Vec<String>,
}

struct PrtChannel {
    name: String,
    number: NumberType,
    arity: usize,
    /// Offset in the record.
    offset: usize,
}

fn header(bytes: &[u8], limits: &Limits) -> Result<PrtHeader> {
    let mut cursor = Cursor::new(FORMAT, Endian::Little, bytes, 0);
    if cursor.take(MAGIC.len(), "the signature")? != MAGIC {
        return Err(cursor.invalid("expected the signature of PRT"));
    }
    let header_bytes = cursor.u32("the length of the header")? as usize;
    cursor.take(32, "the name of the format")?;
    let version = cursor.i32("the version")?;
    let count = cursor.i64("the number of particles")?;
    if version > 2 {
        let what = format!("version {version} is not supported: save it as PRT 1.1");
        return Err(Error::unsupported(FORMAT, what));
    }
    if header_bytes < HEADER_BYTES {
        return Err(
            cursor.invalid(format!("the length of the header is {header_bytes}, less than {HEADER_BYTES}"))
        );
    }
    if header_bytes as u64 > limits.header_bytes {
        let what = format!("the header has {header_bytes} bytes, the limit is {}", limits.header_bytes);
        return Err(Error::too_large(FORMAT, what));
    }
    let metadata = cursor.take(header_bytes - HEADER_BYTES, "metadata")?;
    let mut notes = if version == 2 { notes_on(metadata)? } else { Vec::new() };
    let reserved = cursor.i32("the reserved number")?;
    if reserved != 4 {
        return Err(cursor.invalid(format!("expected the number 4 after the header, found {reserved}")));
    }
    let channel_count = cursor.u32("the number of channels")? as usize;
    let channel_bytes = cursor.u32("the length of a channel's definition")? as usize;
    limits.check_attributes(FORMAT, channel_count, "channels")?;
    if channel_bytes < CHANNEL_BYTES {
        return Err(cursor.invalid(format!(
            "a channel's definition has {channel_bytes} bytes, less than {CHANNEL_BYTES}"
        )));
    }
    let (mut channels, mut stride, mut sum) = (Vec::new(), 0, 0);
    for _ in 0..channel_count {
        let end = cursor.at().saturating_add(channel_bytes);
        let channel = channel(&mut cursor)?;
        cursor.take(end.saturating_sub(cursor.at()), "a channel's definition")?;
        let channel_bytes = channel.arity * channel.number.size();
        stride = stride.max(channel.offset.saturating_add(channel_bytes));
        sum += channel_bytes;
        if channel.arity == 0 {
            notes.push(format!("skipped `{}`: it has no values", excerpt(&channel.name)));
        } else {
            if channel.number == NumberType::F16 && channel.name.eq_ignore_ascii_case("position") {
                notes.push("positions have 16 bits: about three digits".into());
            }
            channels.push(channel);
        }
    }
    if sum > stride {
        return Err(
            cursor.invalid(format!("the channels overlap: they have {sum} bytes in records of {stride}"))
        );
    }
    Ok(PrtHeader { count, channels, stride, data_at: cursor.at(), notes })
}

fn channel(cursor: &mut Cursor) -> Result<PrtChannel> {
    let name = cursor.take(32, "the name of a channel")?;
    let name = String::from_utf8_lossy(name.split(|&byte| byte == 0).next().unwrap_or_default()).into_owned();
    let [kind, arity, offset] = [
        cursor.i32("the type of a channel")?,
        cursor.i32("the number of values of a channel")?,
        cursor.i32("the offset of a channel")?,
    ];
    let number = usize::try_from(kind).ok().and_then(|kind| TYPES.get(kind).copied());
    match (number, u16::try_from(arity), u32::try_from(offset)) {
        (Some(number), Ok(arity), Ok(offset)) => {
            Ok(PrtChannel { name, number, arity: arity.into(), offset: offset as usize })
        }
        _ => {
            let name = excerpt(&name);
            Err(cursor
                .invalid(format!("the channel `{name}` has type {kind}, {arity} values and offset {offset}")))
        }
    }
}

/// Notes on the metadata that concern the positions. The reader skips all other metadata.
fn notes_on(metadata: &[u8]) -> Result<Vec<String>> {
    let mut notes = Vec::new();
    let mut rest = metadata;
    while let Some((head, after)) = rest.split_first_chunk::<8>() {
        let (kind, length) = (&head[..4], u32::from_le_bytes([head[4], head[5], head[6], head[7]]) as usize);
        if kind == b"Stop" {
            break;
        }
        let Some((content, after)) = after.split_at_checked(length) else {
            let at = HEADER_BYTES + metadata.len() - rest.len();
            let what = format!("a piece of metadata has {length} bytes, more than the header");
            return Err(Error::invalid(FORMAT, Position::Offset(at as u64), what));
        };
        if kind == b"Meta" {
            notes.extend(note_on(content));
        }
        rest = after;
    }
    Ok(notes)
}

/// A note on a value that applies to all channels: a channel's name, here empty, the value's name, each with a
/// zero at its end, its type and its bytes.
fn note_on(content: &[u8]) -> Option<String> {
    const AXES: [&str; 4] = [
        "right-handed, with Y up",
        "right-handed, with Z up",
        "left-handed, with Y up",
        "left-handed, with Z up",
    ];
    let content = content.strip_prefix(b"\0")?;
    let name = content.split(|&byte| byte == 0).next()?;
    let value = content.get(name.len() + 1..)?;
    let (kind, value) = value.split_first_chunk::<4>()?;
    let number = *TYPES.get(usize::try_from(i32::from_le_bytes(*kind)).ok()?)?;
    if value.len() != number.size() {
        return None;
    }
    match (name, number) {
        (b"CoordSys", NumberType::I32) => {
            let axes = AXES.get(usize::from(*value.first()?).checked_sub(1)?)?;
            Some(format!("the file states that its axes are {axes}: positions are kept as they are"))
        }
        (b"LengthUnitInMeters", NumberType::F64) => {
            let unit = f64::from_le_bytes(value.try_into().ok()?);
            Some(format!(
                "the file states that its unit of length is {unit} m: positions are kept as they are"
            ))
        }
        _ => None,
    }
}

/// The `length` decompressed bytes of the records.
fn records(bytes: &[u8], data_at: usize, length: u64, limits: &Limits) -> Result<Vec<u8>> {
    let packed = &bytes[data_at..];
    let mut inflater = Decompress::new(true);
    let mut records = Vec::new();
    loop {
        let (consumed, before) = (inflater.total_in(), records.len());
        let position = Position::Offset(data_at as u64 + consumed);
        let rest =
            usize::try_from(consumed).ok().and_then(|consumed| packed.get(consumed..)).unwrap_or_default();
        records.reserve(PIECE_BYTES.min(usize::try_from(length).unwrap_or(PIECE_BYTES)));
        let status = inflater.decompress_vec(rest, &mut records, FlushDecompress::None).map_err(|error| {
            Error::invalid(FORMAT, position, format!("the compressed particles are damaged: {error}"))
        })?;
        limits.check_decompressed(FORMAT, records.len() as u64, inflater.total_in())?;
        let is_end = status == Status::StreamEnd;
        if records.len() as u64 > length || is_end && records.len() as u64 != length {
            let found = records.len();
            let what = format!(
                "expected {length} bytes of particles, found {found}{}",
                if is_end { "" } else { " or more" }
            );
            return Err(Error::invalid(FORMAT, position, what));
        }
        if is_end {
            return Ok(records);
        }
        if inflater.total_in() == consumed && records.len() == before {
            let what = format!("expected {length} bytes of particles, found {before} before the end");
            return Err(Error::truncated(FORMAT, position, what));
        }
    }
}

/// Whether the writer has finished the file.
fn completeness(head: &[u8], file_bytes: u64) -> Result<HeadCheck> {
    let header = header(head, &Limits::default())?;
    // A writer that knows the number beforehand writes it first, so it proves nothing.
    let expected = if header.count < 0 { file_bytes + 1 } else { header.data_at as u64 };
    Ok(HeadCheck::Known(Completeness::of_minimum_size(expected, file_bytes, Completeness::NeedsReading)))
}

/// The row in the table of formats.
pub(crate) static ROW: FormatRow = FormatRow {
    signatures: &[MAGIC],
    beginnings: &[MAGIC],
    particles: Some(ParticleReader { completeness, ..ParticleReader::new(read) }),
    ..FormatRow::new(FORMAT, &["prt"])
};
