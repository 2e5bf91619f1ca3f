//! Members of ZIP archives, stored or deflated: of `.npz` and `.usdz` files.
//!
//! ```text
//!   local header, name, bytes   ×  members
//!   central directory: sizes, checksum and offset of each member
//!   (ZIP64: the following record, with 64-bit values)
//!   end of the central directory: the directory's offset
//! ```
//!
//! Members are found by the central directory only. Those of a hostile archive can overlap, so the size of the archive
//! limits the total size of all members, compressed and decompressed.

use std::borrow::Cow;
use std::io::Read;

use crate::core::bytes::{Cursor, Endian};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::text::excerpt;

/// The name of the format of `.npz` files in errors.
pub(crate) const ARCHIVE: &str = "NumPy archive";

const END: &[u8; 4] = b"PK\x05\x06";
const END_BYTES: usize = 22;
const END_64_LOCATOR: &[u8; 4] = b"PK\x06\x07";
const END_64_LOCATOR_BYTES: usize = 20;
const END_64: &[u8; 4] = b"PK\x06\x06";
const ENTRY: &[u8; 4] = b"PK\x01\x02";
const ENTRY_BYTES: u64 = 46;
const LOCAL: &[u8; 4] = b"PK\x03\x04";
/// The longest comment after the end of the central directory.
const COMMENT_BYTES_MAX: usize = u16::MAX as usize;

pub(crate) const STORED: u16 = 0;
const DEFLATED: u16 = 8;

/// A file in the archive.
pub(crate) struct ArchiveMember {
    pub(crate) name: String,
    pub(crate) method: u16,
    pub(crate) checksum: u32,
    packed_bytes: u64,
    pub(crate) bytes: u64,
    pub(crate) local_offset: u64,
}

/// Total sizes of the members read so far.
#[derive(Default)]
pub(crate) struct ArchiveTotals {
    packed_bytes: u64,
    bytes: u64,
}

/// The entries of a central directory.
pub(crate) fn entries(directory: &[u8], count: u64) -> Result<Vec<ArchiveMember>> {
    let mut cursor = Cursor::new(ARCHIVE, Endian::Little, directory, 0);
    if (cursor.remaining() as u64) < count.saturating_mul(ENTRY_BYTES) {
        return Err(cursor.invalid(format!("expected {count} entries in the central directory")));
    }
    (0..count).map(|_| member(&mut cursor)).collect::<Result<_>>().map_err(as_invalid)
}

/// The number of members, and the offset of the central directory. `bytes` are the end of the archive, from
/// the offset `base` on.
pub(crate) fn directory(bytes: &[u8], base: u64) -> Result<(u64, u64)> {
    let at = end_of_directory(bytes)?;
    let mut end = Cursor::new(ARCHIVE, Endian::Little, bytes, at + 10);
    let count = u64::from(end.u16("the number of members")?);
    end.take(4, "the size of the central directory")?;
    let offset = u64::from(end.u32("the offset of the central directory")?);
    let locator = at.checked_sub(END_64_LOCATOR_BYTES).filter(|&at| bytes[at..].starts_with(END_64_LOCATOR));
    let Some(locator) = locator else { return Ok((count, offset)) };
    let mut locator = Cursor::new(ARCHIVE, Endian::Little, bytes, locator + 8);
    let at = locator.u64("the offset of the end")?.saturating_sub(base);
    let at = usize::try_from(at).unwrap_or(usize::MAX).min(bytes.len());
    let mut end = Cursor::new(ARCHIVE, Endian::Little, bytes, at);
    if end.take(4, "the end of the central directory").map_err(as_invalid)? != END_64 {
        return Err(end.invalid("expected the end of the central directory"));
    }
    end.take(28, "the end of the central directory").map_err(as_invalid)?;
    let count = end.u64("the number of members").map_err(as_invalid)?;
    end.take(8, "the size of the central directory").map_err(as_invalid)?;
    Ok((count, end.u64("the offset of the central directory").map_err(as_invalid)?))
}

/// The offset of the end record of the central directory. Only a comment can follow that record.
fn end_of_directory(bytes: &[u8]) -> Result<usize> {
    let tail_start = bytes.len().saturating_sub(END_BYTES + COMMENT_BYTES_MAX);
    let end_of = |at: usize| {
        let comment = bytes.get(at + 20..at + END_BYTES)?;
        Some(at + END_BYTES + usize::from(u16::from_le_bytes([comment[0], comment[1]])))
    };
    // The comment may contain the signature, too. The right record is the one whose comment ends with the
    // file.
    let candidates = (tail_start..bytes.len()).rev().filter(|&at| bytes[at..].starts_with(END));
    let exact = candidates.clone().find(|&at| end_of(at) == Some(bytes.len()));
    let found =
        exact.or_else(|| candidates.clone().find(|&at| end_of(at).is_some_and(|end| end <= bytes.len())));
    found.ok_or_else(|| {
        let what = "the archive ends before its central directory does";
        Error::truncated(ARCHIVE, Position::Offset(bytes.len() as u64), what)
    })
}

/// Turns `Truncated` into `Invalid`: the archive's end is present, so nothing more will be appended.
fn as_invalid(error: Error) -> Error {
    match error {
        Error::Truncated { format, position, what } => Error::Invalid { format, position, what },
        other => other,
    }
}

fn member(cursor: &mut Cursor) -> Result<ArchiveMember> {
    if cursor.take(4, "an entry of the central directory")? != ENTRY {
        return Err(cursor.invalid("expected an entry of the central directory"));
    }
    cursor.take(4, "the versions")?;
    let flags = cursor.u16("the flags")?;
    let method = cursor.u16("the method")?;
    cursor.take(4, "the time")?;
    let checksum = cursor.u32("the checksum")?;
    let packed_bytes = cursor.u32("the compressed size")?;
    let bytes = cursor.u32("the size")?;
    let [name, extra, comment] = [
        cursor.u16("the length of the name")?,
        cursor.u16("the length of the extra field")?,
        cursor.u16("the length of the comment")?,
    ];
    cursor.take(8, "the attributes")?;
    let local_offset = cursor.u32("the offset")?;
    let name = String::from_utf8_lossy(cursor.take(name.into(), "the name")?).into_owned();
    let extra = cursor.take(extra.into(), "the extra field")?;
    cursor.take(comment.into(), "the comment")?;
    if flags & 1 != 0 {
        return Err(Error::unsupported(ARCHIVE, format!("`{}` is encrypted", excerpt(&name))));
    }
    let [bytes, packed_bytes, local_offset] = widened_sizes([bytes, packed_bytes, local_offset], extra);
    Ok(ArchiveMember { name, method, checksum, packed_bytes, bytes, local_offset })
}

/// Replaces numbers that do not fit into 32 bits: the entry has `u32::MAX` instead, and the ZIP64 field of
/// `extra` has the 64-bit values, in the order of `numbers`.
fn widened_sizes(numbers: [u32; 3], mut extra: &[u8]) -> [u64; 3] {
    let mut wide: &[u8] = &[];
    while let [a, b, c, d, rest @ ..] = extra {
        let length = usize::from(u16::from_le_bytes([*c, *d])).min(rest.len());
        let (field, next) = rest.split_at(length);
        if u16::from_le_bytes([*a, *b]) == 1 {
            wide = field;
        }
        extra = next;
    }
    numbers.map(|number| match (number, wide.split_first_chunk::<8>()) {
        (u32::MAX, Some((number, rest))) => {
            wide = rest;
            u64::from_le_bytes(*number)
        }
        _ => number.into(),
    })
}

impl ArchiveMember {
    /// The member's content, decompressed and verified. Adds its sizes to `totals`, and checks them.
    pub(crate) fn content<'a>(
        &self,
        archive: &'a [u8],
        limits: &Limits,
        totals: &mut ArchiveTotals,
    ) -> Result<Cow<'a, [u8]>> {
        let packed = self.packed(archive).map_err(as_invalid)?;
        totals.packed_bytes = totals.packed_bytes.saturating_add(self.packed_bytes);
        totals.bytes = totals.bytes.saturating_add(self.bytes);
        if totals.packed_bytes > archive.len() as u64 {
            return Err(Error::invalid(
                ARCHIVE,
                Position::File,
                "the members have more bytes in total than the archive",
            ));
        }
        limits.check_decompressed(ARCHIVE, totals.bytes, totals.packed_bytes)?;
        let content = match self.method {
            STORED => Cow::Borrowed(packed),
            DEFLATED => Cow::Owned(self.inflated(packed)?),
            other => {
                let what = format!(
                    "`{}` uses compression method {other}, which is not supported: save it stored or deflated",
                    excerpt(&self.name)
                );
                return Err(Error::unsupported(ARCHIVE, what));
            }
        };
        let mut checksum = flate2::Crc::new();
        checksum.update(&content);
        if content.len() as u64 != self.bytes || checksum.sum() != self.checksum {
            return Err(self.damaged());
        }
        Ok(content)
    }

    fn packed<'a>(&self, archive: &'a [u8]) -> Result<&'a [u8]> {
        let offset = usize::try_from(self.local_offset).unwrap_or(usize::MAX);
        let mut cursor = Cursor::new(ARCHIVE, Endian::Little, archive, offset);
        if cursor.take(4, "the header of a member")? != LOCAL {
            return Err(cursor.invalid(format!("expected the header of `{}`", excerpt(&self.name))));
        }
        cursor.take(22, "the header of a member")?;
        let name = cursor.u16("the length of the name")?;
        let extra = cursor.u16("the length of the extra field")?;
        cursor.take(usize::from(name) + usize::from(extra), "the name of a member")?;
        cursor.take(usize::try_from(self.packed_bytes).unwrap_or(usize::MAX), "a member")
    }

    fn inflated(&self, packed: &[u8]) -> Result<Vec<u8>> {
        let mut content = Vec::new();
        let mut decoder = flate2::bufread::DeflateDecoder::new(packed).take(self.bytes.saturating_add(1));
        decoder.read_to_end(&mut content).map_err(|_| self.damaged())?;
        Ok(content)
    }

    fn damaged(&self) -> Error {
        let what = format!("the member `{}` is damaged", excerpt(&self.name));
        Error::invalid(ARCHIVE, Position::Offset(self.local_offset), what)
    }
}
