//! Checks whether a file is complete: an input that may still be being written, or an output of this crate.
//!
//! For a particle file, [`completeness`] compares the size of the file with the size that its header
//! declares, if the format allows that:
//!
//! ```text
//!   what the header declares      declared │      binary PLY, classic BGEO that ends with its points
//!   the file  ▏▏▏▏▏▏▏▏▏▏▏▏▏▏               │      Incomplete
//!             ▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏│      Complete
//!             ▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏│▏▏▏▏  Unknown: the header may yet be corrected
//! ```
//!
//! Some writers do not know the number of particles when they start: they write a number, often 0, append the
//! records, and correct the header at the end. So the size proves nothing if the file has more data than its
//! header declares, or if the header declares no data. The size also cannot reveal bytes that were reserved
//! and not yet filled: the caller should also check that the file no longer changes.
//!
//! For an output, [`is_complete`] checks the end of the file: an interrupted copy or a full disk leaves the
//! beginning of a file, which includes its provenance. Each format defines its own check in the table of
//! formats. Overwritten bytes are not detected: a file of the right length may still be damaged inside.

use std::io::{Read, Seek, SeekFrom};

use serde::de::IgnoredAny;

use crate::core::bytes::piece;
use crate::core::compression::Codec;
use crate::core::error::Result;
use crate::core::provenance::HEAD_BYTES_MAX;
use crate::core::row::{Completeness, HeadCheck, Integrity};
use crate::table::probe::{Probe, ProbedKind, probe};
use crate::table::{Format, OutputFormat};

/// The number of bytes to read at the end of a file: the last line of any output is shorter.
const TAIL_BYTES: u64 = 256;

/// Whether an output of this crate is neither truncated nor extended. May return false for complete files of
/// other programs.
///
/// # Errors
///
/// [`crate::Error::Io`] if reading fails; [`crate::Error::Invalid`] if the head is not of this format.
pub fn is_complete(format: OutputFormat, file: &mut (impl Read + Seek)) -> Result<bool> {
    let file_bytes = file.seek(SeekFrom::End(0))?;
    // An offset in a damaged file may be beyond its end, and even beyond what the system can seek to.
    let mut read = |start: u64, length: u64| {
        if start < file_bytes { piece(file, start, length) } else { Ok(Vec::new()) }
    };
    match format.row().integrity {
        Integrity::Tail(ends_as_written) => {
            Ok(ends_as_written(&read(file_bytes.saturating_sub(TAIL_BYTES), TAIL_BYTES)?))
        }
        Integrity::Length(claimed) => {
            let head = read(0, HEAD_BYTES_MAX)?;
            Ok(claimed(&head, &mut read)? == Some(file_bytes))
        }
        Integrity::Json => {
            let text = read(0, u64::MAX)?;
            // The writer ends the file with a line feed.
            Ok(text.ends_with(b"\n") && serde_json::from_slice::<IgnoredAny>(&text).is_ok())
        }
    }
}

/// Compares a file's size with its head, of which at most 1 MiB is read. `file_name` is used only for
/// [`probe()`]. Unsupported and malformed files are `Unknown`: the reader reports what is wrong with them.
///
/// # Errors
///
/// [`crate::Error::Io`] if reading fails.
pub fn completeness(file: &mut (impl Read + Seek), file_name: &str) -> Result<Completeness> {
    let mut found = HeadCheck::NeedsMoreHead;
    for head_bytes in HEADS_BYTES {
        let head = piece(file, 0, head_bytes)?;
        // Measured last: a file that grows meanwhile can only look larger than the head says, never smaller.
        let file_bytes = file.seek(SeekFrom::End(0))?;
        found = check_head(&head, file_bytes, file_name);
        if !matches!(found, HeadCheck::NeedsMoreHead) {
            break;
        }
    }
    match found {
        HeadCheck::Known(completeness) => Ok(completeness),
        HeadCheck::NeedsLastByte => {
            Ok(if ends_with_whitespace(file)? { Completeness::NeedsReading } else { Completeness::Unknown })
        }
        // No reader accepts a header that exceeds the largest head.
        HeadCheck::NeedsMoreHead => Ok(Completeness::Unknown),
    }
}

fn check_head(head: &[u8], file_bytes: u64, file_name: &str) -> HeadCheck {
    let Probe { kind, codec } = probe(head, file_name);
    let by_reading = |expected| {
        HeadCheck::Known(Completeness::of_minimum_size(expected, file_bytes, Completeness::NeedsReading))
    };
    if let Some(beginning) = truncated_signature(head) {
        return by_reading(beginning.len() as u64);
    }
    if let Some(codec) = codec {
        return by_reading(codec.file_bytes_min());
    }
    let unknown = HeadCheck::Known(Completeness::Unknown);
    let ProbedKind::Format(format) = kind else { return unknown };
    let Some(particles) = &format.row().particles else { return unknown };
    (particles.completeness)(head, file_bytes).unwrap_or_else(|error| {
        if !error.is_truncated() {
            unknown
        } else if (head.len() as u64) < file_bytes {
            HeadCheck::NeedsMoreHead
        } else {
            HeadCheck::Known(Completeness::Incomplete { expected: file_bytes + 1, found: file_bytes })
        }
    })
}

/// The signature of which `head` is a proper prefix, if there is one: the file ends within its signature.
pub(crate) fn truncated_signature(head: &[u8]) -> Option<&'static [u8]> {
    let of_formats = Format::ALL.into_iter().flat_map(|format| format.row().beginnings).copied();
    let mut all = of_formats.chain(Codec::ALL.map(Codec::beginning));
    all.find(|beginning| beginning.starts_with(head) && head.len() < beginning.len())
}

/// Whether the file ends with white space. Otherwise a number at the end may lack its last digits.
fn ends_with_whitespace(file: &mut (impl Read + Seek)) -> Result<bool> {
    let mut last = [0];
    file.seek(SeekFrom::End(-1))?;
    file.read_exact(&mut last)?;
    Ok(last[0].is_ascii_whitespace())
}

/// Bytes of the head to read: first enough for nearly every header, then enough for any.
const HEADS_BYTES: [u64; 2] = [16 << 10, 1 << 20];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::houdini::bgeo;
    use std::io::{Cursor, Write};

    const TWO_POINTS: &str = "element vertex 2\nproperty float x\nproperty float y\nproperty float z\n";

    fn of(bytes: &[u8], name: &str) -> Completeness {
        completeness(&mut Cursor::new(bytes), name).unwrap()
    }

    fn ply(encoding: &str, declared: &str, body: &[u8]) -> Vec<u8> {
        [format!("ply\nformat {encoding} 1.0\n{declared}end_header\n").as_bytes(), body].concat()
    }

    fn bgeo(point_count: usize, primitive_count: i32) -> Vec<u8> {
        let positions = crate::FilePositions::F32(vec![[1.0; 3]; point_count]);
        let frame = crate::ParticleFrame { positions, attributes: Vec::new(), notes: Vec::new() };
        let mut bytes = Vec::new();
        bgeo::write(&frame, &mut bytes).unwrap();
        bytes[13..17].copy_from_slice(&primitive_count.to_be_bytes());
        bytes
    }

    #[test]
    fn size_is_compared_with_the_declared_one() {
        use Completeness::{Complete, Incomplete, NeedsReading, Unknown};
        let binary = |body: usize| ply("binary_little_endian", TWO_POINTS, &vec![0; body]);
        let lists = "element face 2\nproperty list uchar int vertex_indices\n";
        let with_faces =
            |body: usize| ply("binary_big_endian", &format!("{TWO_POINTS}{lists}"), &vec![0; body]);
        let ascii = |body: &str| ply("ascii", TWO_POINTS, body.as_bytes());
        let short = |bytes: &[u8], by: usize| Incomplete {
            expected: (bytes.len() + by) as u64,
            found: bytes.len() as u64,
        };
        let points = bgeo(3, 0);
        let table: &[(&str, Vec<u8>, Completeness)] = &[
            ("all of it", binary(24), Complete),
            ("a byte less", binary(23), short(&binary(23), 1)),
            ("no body", binary(0), short(&binary(0), 24)),
            ("more than declared", binary(36), Unknown),
            (
                "nothing declared",
                ply("binary_little_endian", "element vertex 0\nproperty int x\n", b""),
                Unknown,
            ),
            (
                "too much declared",
                ply("binary_little_endian", "element vertex 18446744073709551615\nproperty int x\n", b""),
                Unknown,
            ),
            ("faces, enough", with_faces(26), NeedsReading),
            ("faces, too few bytes", with_faces(25), short(&with_faces(25), 1)),
            ("text", ascii("0 0 0\n1 1 1\n"), NeedsReading),
            ("text, last number open", ascii("0 0 0\n1 1 1"), Unknown),
            ("text, half", ascii("0 0 0\n"), short(&ascii("0 0 0\n"), 5)),
            ("points", points.clone(), Complete),
            (
                "points without the end",
                points[..points.len() - 1].to_vec(),
                short(&points[..points.len() - 1], 1),
            ),
            ("points and more", [&points[..], b"more"].concat(), Unknown),
            ("no points", bgeo(0, 0), Unknown),
            ("points and primitives", bgeo(3, 1), NeedsReading),
            ("empty", Vec::new(), short(b"", 4)),
            ("a table", b"x,y,z\n1,2,3\n".to_vec(), Unknown),
            ("a mesh", b"glTF\x02\0\0\0".to_vec(), Unknown),
            ("malformed", b"ply\nformat ascii 7.0\n".to_vec(), Unknown),
            ("anything", b"\0\x01\x02".to_vec(), Unknown),
        ];
        for (case, bytes, expected) in table {
            assert_eq!(of(bytes, "a.dat"), *expected, "{case}");
        }
    }

    #[test]
    fn truncated_header_is_incomplete() {
        let file = ply("binary_little_endian", TWO_POINTS, &[0; 24]);
        let geometry = bgeo(3, 0);
        for file in [&file, &geometry] {
            for length in 0..file.len() {
                let found = of(&file[..length], "a");
                let is_incomplete =
                    matches!(found, Completeness::Incomplete { expected, found } if found < expected);
                assert!(is_incomplete, "{found:?} at {length} of {}", file.len());
            }
        }
    }

    #[test]
    fn gzip_needs_reading() {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        encoder.write_all(&bgeo(100, 0)).unwrap();
        let bytes = encoder.finish().unwrap();
        assert_eq!(of(&bytes, "a.bgeo"), Completeness::NeedsReading);
        assert_eq!(of(&bytes[..bytes.len() / 2], "a.bgeo"), Completeness::NeedsReading);
        for length in [1, 2, 10, 19] {
            assert!(matches!(of(&bytes[..length], "a"), Completeness::Incomplete { .. }), "{length}");
        }
        let empty = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast()).finish().unwrap();
        assert!(Codec::Gzip.file_bytes_min() <= empty.len() as u64, "{}", empty.len());
    }

    #[test]
    fn long_header_is_read_further() {
        let comments = "comment as long as can be\n".repeat(4000);
        let file = ply("binary_little_endian", &format!("{comments}{TWO_POINTS}"), &[0; 24]);
        assert_eq!(of(&file, "a"), Completeness::Complete);
        let half = &file[..60_000];
        let expected = Completeness::Incomplete { expected: 60_001, found: 60_000 };
        assert_eq!(of(half, "a"), expected);
        let endless = ply("ascii", &"comment and no end\n".repeat(100_000), b"");
        assert_eq!(of(&endless, "a"), Completeness::Unknown);
    }
}
