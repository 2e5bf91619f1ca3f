//! The bootstrap at the start of a file, and the table of contents at its end.

use crate::error::{Error, Position, Result};
use crate::row::ReadPiece;
use crate::usd::FORMAT;

/// The first bytes of every file in Crate, the binary format of USD.
pub(super) const MAGIC: &[u8] = b"PXR-USDC";

/// The version of the format that the writer uses. OpenUSD reads it since v19.11 (2019).
const VERSION: [u8; 3] = [0, 8, 0];

/// The size of the bootstrap.
pub(super) const BOOTSTRAP_BYTES: usize = 88;

/// The offset, within the bootstrap, of the field that holds the offset of the table of contents.
pub(super) const CONTENTS_AT: usize = 16;

/// The sections, in the order of the file.
pub(super) const SECTIONS: [&str; 6] = ["TOKENS", "STRINGS", "FIELDS", "FIELDSETS", "PATHS", "SPECS"];

const NAME_BYTES: usize = 16;
const ENTRY_BYTES: usize = NAME_BYTES + 16;

/// The size of our table of contents.
pub(super) const TABLE_BYTES: usize = 8 + SECTIONS.len() * ENTRY_BYTES;

/// The bootstrap of a file whose table of contents is at this offset.
pub(super) fn bootstrap(contents_at: u64) -> [u8; BOOTSTRAP_BYTES] {
    let mut bytes = [0; BOOTSTRAP_BYTES];
    bytes[..MAGIC.len()].copy_from_slice(MAGIC);
    bytes[MAGIC.len()..][..VERSION.len()].copy_from_slice(&VERSION);
    bytes[CONTENTS_AT..CONTENTS_AT + 8].copy_from_slice(&contents_at.to_le_bytes());
    bytes
}

/// Appends the table of contents: the offset and size of each section.
pub(super) fn append_contents(sections: [(u64, u64); SECTIONS.len()], out: &mut Vec<u8>) {
    out.extend_from_slice(&(SECTIONS.len() as u64).to_le_bytes());
    for (name, (start, size)) in SECTIONS.into_iter().zip(sections) {
        let mut field = [0; NAME_BYTES];
        field[..name.len()].copy_from_slice(name.as_bytes());
        out.extend_from_slice(&field);
        out.extend_from_slice(&start.to_le_bytes());
        out.extend_from_slice(&size.to_le_bytes());
    }
}

/// Fails unless a file starts like binary USD.
pub(super) fn check_magic(head: &[u8]) -> Result<()> {
    match head.starts_with(MAGIC) {
        true => Ok(()),
        false => Err(Error::invalid(FORMAT, Position::Offset(0), "expected PXR-USDC")),
    }
}

/// The offset of the table of contents, according to the bootstrap.
pub(super) fn contents_at(head: &[u8]) -> Result<u64> {
    check_magic(head)?;
    let Some(bootstrap) = head.first_chunk::<BOOTSTRAP_BYTES>() else {
        return Err(Error::truncated(FORMAT, Position::Offset(0), "expected a bootstrap of 88 bytes"));
    };
    let [_, _, _, _, _, _, _, _, major, minor, patch, ..] = *bootstrap;
    if [major, minor, patch] != VERSION {
        let what = format!("this is version {major}.{minor}.{patch} of binary USD: {NOT_OURS}");
        return Err(Error::unsupported(FORMAT, what));
    }
    let mut offset = [0; 8];
    offset.copy_from_slice(&bootstrap[CONTENTS_AT..CONTENTS_AT + 8]);
    Ok(u64::from_le_bytes(offset))
}

/// Fails unless the table of contents can be at this offset of a file with `file_bytes` bytes. The offset
/// is 0 until a file is complete.
pub(super) fn check_contents_at(at: u64, file_bytes: u64) -> Result<()> {
    if at == 0 || at > file_bytes {
        let what = format!("the table of contents at {at} is missing: the file is not complete");
        return Err(Error::truncated(FORMAT, Position::Offset(CONTENTS_AT as u64), what));
    }
    Ok(())
}

pub(super) const NOT_OURS: &str = "binary USD is read only as meniscus writes it: give a file of meniscus, or save the mesh as .ply or .obj";

/// The offset and size of each section, from a table of contents with all sections in our order.
pub(super) fn read_contents(table: &[u8], at: u64) -> Result<[(u64, u64); SECTIONS.len()]> {
    let position = Position::Offset(at);
    let Some(table) = table.first_chunk::<TABLE_BYTES>() else {
        let what = format!("expected a table of contents of {TABLE_BYTES} bytes, found {}", table.len());
        return Err(Error::truncated(FORMAT, position, what));
    };
    let (count, entries) = table.split_at(8);
    if count != (SECTIONS.len() as u64).to_le_bytes() {
        return Err(Error::unsupported(FORMAT, format!("this file has unknown sections: {NOT_OURS}")));
    }
    let mut found = [(0, 0); SECTIONS.len()];
    for (index, entry) in entries.as_chunks::<ENTRY_BYTES>().0.iter().enumerate() {
        let (name, range) = entry.split_at(NAME_BYTES);
        let name = String::from_utf8_lossy(name);
        if name.trim_end_matches('\0') != SECTIONS[index] {
            return Err(Error::unsupported(FORMAT, format!("this file has unknown sections: {NOT_OURS}")));
        }
        let [start, size] = [0, 8].map(|at| {
            let mut number = [0; 8];
            number.copy_from_slice(&range[at..at + 8]);
            u64::from_le_bytes(number)
        });
        if start < BOOTSTRAP_BYTES as u64 || start.checked_add(size).is_none_or(|end| end > at) {
            let what = format!(
                "section {} has {size} bytes from {start}; expected it between the bootstrap and this table",
                SECTIONS[index]
            );
            return Err(Error::invalid(FORMAT, position, what));
        }
        found[index] = (start, size);
    }
    Ok(found)
}

/// The size that a file of our writer has when it is complete: it ends with its table of contents. `None` if
/// the bootstrap is incomplete, or the table is missing, incomplete or invalid.
pub(super) fn claimed_bytes(head: &[u8], read: &mut ReadPiece) -> Result<Option<u64>> {
    let Some(head) = head.first_chunk::<BOOTSTRAP_BYTES>() else { return Ok(None) };
    let at = contents_at(head)?;
    let is_complete = read_contents(&read(at, TABLE_BYTES as u64)?, at).is_ok();
    Ok(is_complete.then(|| at + TABLE_BYTES as u64))
}
