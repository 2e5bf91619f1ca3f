//! Gunzips a file that another format is packed in.
//!
//! The result is not believed to be small because the file is: it is produced piece by piece, and
//! abandoned at the first piece beyond the limits.

use std::io::Read;

use flate2::bufread::GzDecoder;

use crate::error::{Error, Place, Result};
use crate::limits::{Limits, RATIO_FREE_BYTES};

const FORMAT: &str = "gzip";

/// What every gzip member starts with.
const MAGIC: [u8; 2] = [0x1f, 0x8b];

/// Bytes inflated between two looks at the limits.
const PIECE_BYTES: usize = 256 << 10;

/// Whether the file is gzipped.
pub(crate) fn is_gzip(bytes: &[u8]) -> bool {
    bytes.starts_with(&MAGIC)
}

/// Inflates all members of the file, one after the other.
///
/// # Errors
/// `Short` if it ends too soon and `Invalid` if it is damaged, with the offset in the compressed file;
/// `TooLarge` beyond `decompressed_bytes` or `decompression_ratio`.
pub(crate) fn inflate(bytes: &[u8], limits: &Limits) -> Result<Vec<u8>> {
    let mut inflated = Vec::new();
    let mut rest = bytes;
    while is_gzip(rest) {
        rest = inflate_member(bytes.len(), rest, limits, &mut inflated)?;
    }
    // Tapes and some copying tools pad files with zeros.
    if let Some(at) = rest.iter().position(|&byte| byte != 0) {
        let place = Place::Offset((bytes.len() - rest.len() + at) as u64);
        let what = "the compressed data is followed by something else";
        // Unless that is the first byte of another member.
        return Err(match MAGIC.starts_with(rest) {
            true => Error::short(FORMAT, place, what),
            false => Error::invalid(FORMAT, place, what),
        });
    }
    Ok(inflated)
}

/// Inflates the member at the start of `rest`, and returns what follows it.
fn inflate_member<'a>(
    total: usize,
    rest: &'a [u8],
    limits: &Limits,
    inflated: &mut Vec<u8>,
) -> Result<&'a [u8]> {
    let mut decoder = GzDecoder::new(rest);
    loop {
        let before = inflated.len();
        let outcome = decoder.by_ref().take(PIECE_BYTES as u64).read_to_end(inflated);
        let consumed = total - decoder.get_ref().len();
        limits.check_unpacked(FORMAT, inflated.len() as u64, consumed as u64)?;
        if let Err(source) = outcome {
            return Err(damage(&source, consumed));
        }
        if inflated.len() == before {
            return Ok(decoder.into_inner());
        }
    }
}

fn damage(source: &std::io::Error, consumed: usize) -> Error {
    let place = Place::Offset(consumed as u64);
    match source.kind() {
        std::io::ErrorKind::UnexpectedEof => Error::short(FORMAT, place, "the compressed data ends too soon"),
        _ => Error::invalid(FORMAT, place, format!("the compressed data is damaged: {source}")),
    }
}

/// Looks for damage in the first bytes without keeping what comes out of them: what little could be
/// inflated of a damaged file may look like anything.
///
/// # Errors
/// `Short` and `Invalid`, as from [`inflate`].
pub(crate) fn check_start(bytes: &[u8]) -> Result<()> {
    let mut start = GzDecoder::new(bytes).take(RATIO_FREE_BYTES);
    let outcome = std::io::copy(&mut start, &mut std::io::sink());
    outcome.map(drop).map_err(|source| damage(&source, bytes.len() - start.get_ref().get_ref().len()))
}

/// The first bytes of the content, as many as can be had, at most `length`.
pub(crate) fn inflate_head(bytes: &[u8], length: usize) -> Vec<u8> {
    let mut head = Vec::new();
    // What was inflated before an error is in `head`, and is all that is asked for.
    let _ = GzDecoder::new(bytes).take(length as u64).read_to_end(&mut head);
    head
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn gzipped(bytes: &[u8]) -> Vec<u8> {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        encoder.write_all(bytes).unwrap();
        encoder.finish().unwrap()
    }

    #[test]
    fn members_are_joined_and_padding_is_dropped() {
        let mut file = [gzipped(b"one "), gzipped(b"two")].concat();
        assert_eq!(inflate(&file, &Limits::default()).unwrap(), b"one two");
        file.extend([0; 100]);
        assert_eq!(inflate(&file, &Limits::default()).unwrap(), b"one two");
        file.push(7);
        let error = inflate(&file, &Limits::default()).unwrap_err().to_string();
        assert!(error.contains("followed by something else"), "{error}");
    }

    #[test]
    fn damage_is_told_with_its_offset() {
        let mut file = gzipped(&[7; 5000]);
        let error = inflate(&file[..file.len() - 3], &Limits::default()).unwrap_err();
        assert!(error.is_short() && error.to_string().contains("ends too soon"), "{error}");
        let middle = file.len() - 7; // within the checksum
        file[middle] ^= 1;
        let error = inflate(&file, &Limits::default()).unwrap_err();
        assert!(!error.is_short() && error.to_string().contains("is damaged"), "{error}");
    }

    #[test]
    fn a_bomb_is_abandoned_early() {
        let bomb = gzipped(&vec![0; 64 << 20]);
        assert!(matches!(inflate(&bomb, &Limits::default()), Err(Error::TooLarge { .. })));
        let limits = Limits { decompressed_bytes: 5 << 20, ..Limits::default() };
        assert!(matches!(inflate(&bomb, &limits), Err(Error::TooLarge { .. })));
        let limits = Limits { decompression_ratio: 1032, ..Limits::default() };
        assert_eq!(inflate(&bomb, &limits).unwrap().len(), 64 << 20);
        let small = gzipped(&vec![0; 16 << 20]);
        assert_eq!(inflate(&small, &Limits::default()).unwrap().len(), 16 << 20);
    }
}
