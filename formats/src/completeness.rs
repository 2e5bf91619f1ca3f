//! Whether a file of particles is all there, as far as its own format can tell.
//!
//! ```text
//!   what the header declares      declared │      binary PLY, classic BGEO that ends with its points
//!   the file  ▏▏▏▏▏▏▏▏▏▏▏▏▏▏               │      Incomplete
//!             ▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏│      Complete
//!             ▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏▏│▏▏▏▏  Unproven: the header may yet be corrected
//! ```
//!
//! Some writers do not know the number of particles when they begin: they write a number, often 0,
//! append the records, and go back to the header in the end. So a file that has more than it declares,
//! or that declares nothing at all, proves nothing. Nor can a length tell of bytes that were reserved
//! and are still to be filled: whoever asks should also see that the file is left alone.

use std::io::{Read, Seek, SeekFrom};

use crate::error::Result;
use crate::limits::Limits;
use crate::packing::Packing;
use crate::ply::Encoding;
use crate::probe::{Kind, Probe, probe};
use crate::{bgeo, npy, ply};

/// What the format says of a file that may still be growing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Completeness {
    /// It has all that it declares.
    Complete,
    /// It declares more than there is.
    Incomplete {
        /// Bytes that it declares, at least.
        expected: u64,
        /// Bytes that there are.
        found: u64,
    },
    /// A cheap look does not tell, but reading it does: text with a count, and what is packed.
    ByReading,
    /// The format has no way of telling: a table may always have another row.
    Unproven,
}

/// Looks at the head of a file, a mebibyte at most, and at its length. `file_name` has the same part in
/// it as in [`probe()`]. What no reader takes, or what is malformed, is `Unproven`: the reader will say
/// what it is.
///
/// # Errors
///
/// [`crate::Error::Io`] if reading fails.
pub fn completeness(file: &mut (impl Read + Seek), file_name: &str) -> Result<Completeness> {
    let mut told = Told::ByMoreOfTheHead;
    for head_bytes in HEADS_BYTES {
        let head = head(file, head_bytes)?;
        // Asked for last: a file that grows meanwhile has more than was seen, never less.
        let file_bytes = file.seek(SeekFrom::End(0))?;
        told = told_by_head(&head, file_bytes, file_name);
        if !matches!(told, Told::ByMoreOfTheHead) {
            break;
        }
    }
    match told {
        Told::Now(completeness) => Ok(completeness),
        Told::ByTheLastByte => Ok(match ends_a_word(file)? {
            true => Completeness::ByReading,
            false => Completeness::Unproven,
        }),
        // No header that is read is longer.
        Told::ByMoreOfTheHead => Ok(Completeness::Unproven),
    }
}

/// What the head of a file tells.
enum Told {
    Now(Completeness),
    /// The header does not end within the head, but the file goes on.
    ByMoreOfTheHead,
    /// Whether the last number of a text is whole.
    ByTheLastByte,
}

fn told_by_head(head: &[u8], file_bytes: u64, file_name: &str) -> Told {
    let Probe { kind, packing } = probe(head, file_name);
    if let Some(signature) = signature_cut_off(head) {
        return Told::Now(at_least(signature.len() as u64, file_bytes, Completeness::ByReading));
    }
    match packing {
        Some(Packing::Gzip) => {
            return Told::Now(at_least(GZIP_BYTES_MIN, file_bytes, Completeness::ByReading));
        }
        Some(Packing::Zstd) => {
            return Told::Now(at_least(ZSTD_BYTES_MIN, file_bytes, Completeness::ByReading));
        }
        None => {}
    }
    let told = match kind {
        Kind::Ply => told_by_ply(head, file_bytes),
        Kind::ClassicBgeo => told_by_bgeo(head, file_bytes),
        Kind::Npy => told_by_npy(head, file_bytes),
        Kind::Npz | Kind::VtkXml | Kind::HoudiniJsonBinary | Kind::HoudiniJsonText | Kind::HoudiniSc => {
            Ok(Told::Now(Completeness::ByReading))
        }
        _ => Ok(Told::Now(Completeness::Unproven)),
    };
    told.unwrap_or_else(|error| match error.is_short() {
        true if (head.len() as u64) < file_bytes => Told::ByMoreOfTheHead,
        true => Told::Now(Completeness::Incomplete { expected: file_bytes + 1, found: file_bytes }),
        false => Told::Now(Completeness::Unproven),
    })
}

/// The signature that these bytes are the beginning of, if they are no more than that.
pub(crate) fn signature_cut_off(head: &[u8]) -> Option<&'static [u8]> {
    let is_beginning = |signature: &&[u8]| signature.starts_with(head) && head.len() < signature.len();
    SIGNATURES.into_iter().find(is_beginning)
}

fn told_by_ply(head: &[u8], file_bytes: u64) -> Result<Told> {
    let header = ply::read_header(head, &Limits::default())?;
    let Some(declared) = header.file_size_min() else { return Ok(Told::Now(Completeness::Unproven)) };
    Ok(Told::Now(match header.encoding {
        _ if declared == header.body_offset as u64 => Completeness::Unproven,
        Encoding::Ascii if declared <= file_bytes => return Ok(Told::ByTheLastByte),
        Encoding::Ascii => at_least(declared, file_bytes, Completeness::ByReading),
        _ if header.elements.iter().any(ply::Element::has_list) => {
            at_least(declared, file_bytes, Completeness::ByReading)
        }
        _ => exactly(declared, file_bytes),
    }))
}

fn told_by_bgeo(head: &[u8], file_bytes: u64) -> Result<Told> {
    let header = bgeo::header(head)?;
    Ok(Told::Now(match header.point_count {
        0 => Completeness::Unproven,
        _ if header.expected_bytes_is_exact => exactly(header.expected_bytes, file_bytes),
        _ => at_least(header.expected_bytes, file_bytes, Completeness::ByReading),
    }))
}

fn told_by_npy(head: &[u8], file_bytes: u64) -> Result<Told> {
    let declared = npy::bytes_claimed(head, &Limits::default())?;
    Ok(Told::Now(declared.map_or(Completeness::Unproven, |declared| exactly(declared, file_bytes))))
}

fn exactly(expected: u64, found: u64) -> Completeness {
    let beyond = if expected < found { Completeness::Unproven } else { Completeness::Complete };
    at_least(expected, found, beyond)
}

fn at_least(expected: u64, found: u64, then: Completeness) -> Completeness {
    if found < expected { Completeness::Incomplete { expected, found } } else { then }
}

fn head(file: &mut (impl Read + Seek), head_bytes: u64) -> Result<Vec<u8>> {
    let mut head = Vec::new();
    file.seek(SeekFrom::Start(0))?;
    file.take(head_bytes).read_to_end(&mut head)?;
    Ok(head)
}

/// Whether the file ends behind a word: a number that is the last thing in it may lack its last digits.
fn ends_a_word(file: &mut (impl Read + Seek)) -> Result<bool> {
    let mut last = [0];
    file.seek(SeekFrom::End(-1))?;
    file.read_exact(&mut last)?;
    Ok(last[0].is_ascii_whitespace())
}

/// Bytes of the head that are looked at: enough for nearly every header, then for any.
const HEADS_BYTES: [u64; 2] = [16 << 10, 1 << 20];

/// Bytes of a gzip file of nothing: header, an empty block, checksum and length.
const GZIP_BYTES_MIN: u64 = 20;

/// Bytes of a Zstandard file of nothing: signature, header, an empty block.
const ZSTD_BYTES_MIN: u64 = 9;

/// What files that can be read begin with. The beginning of one of these is no file of any kind, yet.
const SIGNATURES: [&[u8]; 13] = [
    b"ply\n",
    b"ply\r",
    b"BgeoV",
    b"\x1f\x8b",
    b"\x28\xb5\x2f\xfd",
    b"\x93NUMPY",
    b"PK\x03\x04",
    b"# vtk DataFile Version ",
    b"ITEM: TIMESTEP\n",
    b"\x7fNSJb",
    b"\x7fbJSN",
    b"scf1",
    b"PGEOMETRY",
];

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Cursor, Write};

    const TWO_POINTS: &str = "element vertex 2\nproperty float x\nproperty float y\nproperty float z\n";

    fn of(bytes: &[u8], name: &str) -> Completeness {
        completeness(&mut Cursor::new(bytes), name).unwrap()
    }

    fn ply(encoding: &str, declared: &str, body: &[u8]) -> Vec<u8> {
        [format!("ply\nformat {encoding} 1.0\n{declared}end_header\n").as_bytes(), body].concat()
    }

    fn bgeo(point_count: usize, primitive_count: i32) -> Vec<u8> {
        let positions = crate::Positions::F32(vec![[1.0; 3]; point_count]);
        let frame = crate::ParticleFrame { positions, attributes: Vec::new(), notes: Vec::new() };
        let mut bytes = Vec::new();
        bgeo::write(&frame, &mut bytes).unwrap();
        bytes[13..17].copy_from_slice(&primitive_count.to_be_bytes());
        bytes
    }

    #[test]
    fn declared_lengths_decide() {
        use Completeness::{ByReading, Complete, Incomplete, Unproven};
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
            ("more than declared", binary(36), Unproven),
            (
                "nothing declared",
                ply("binary_little_endian", "element vertex 0\nproperty int x\n", b""),
                Unproven,
            ),
            (
                "too much declared",
                ply("binary_little_endian", "element vertex 18446744073709551615\nproperty int x\n", b""),
                Unproven,
            ),
            ("faces, enough", with_faces(26), ByReading),
            ("faces, too few bytes", with_faces(25), short(&with_faces(25), 1)),
            ("text", ascii("0 0 0\n1 1 1\n"), ByReading),
            ("text, last number open", ascii("0 0 0\n1 1 1"), Unproven),
            ("text, half", ascii("0 0 0\n"), short(&ascii("0 0 0\n"), 5)),
            ("points", points.clone(), Complete),
            (
                "points without the end",
                points[..points.len() - 1].to_vec(),
                short(&points[..points.len() - 1], 1),
            ),
            ("points and more", [&points[..], b"more"].concat(), Unproven),
            ("no points", bgeo(0, 0), Unproven),
            ("points and primitives", bgeo(3, 1), ByReading),
            ("empty", Vec::new(), short(b"", 4)),
            ("a table", b"x,y,z\n1,2,3\n".to_vec(), Unproven),
            ("a mesh", b"glTF\x02\0\0\0".to_vec(), Unproven),
            ("malformed", b"ply\nformat ascii 7.0\n".to_vec(), Unproven),
            ("anything", b"\0\x01\x02".to_vec(), Unproven),
        ];
        for (case, bytes, expected) in table {
            assert_eq!(of(bytes, "a.dat"), *expected, "{case}");
        }
    }

    #[test]
    fn a_header_that_is_cut_off_is_incomplete() {
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
    fn gzip_is_told_by_reading() {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        encoder.write_all(&bgeo(100, 0)).unwrap();
        let bytes = encoder.finish().unwrap();
        assert_eq!(of(&bytes, "a.bgeo"), Completeness::ByReading);
        assert_eq!(of(&bytes[..bytes.len() / 2], "a.bgeo"), Completeness::ByReading);
        for length in [1, 2, 10, 19] {
            assert!(matches!(of(&bytes[..length], "a"), Completeness::Incomplete { .. }), "{length}");
        }
        let empty = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast()).finish().unwrap();
        assert!(GZIP_BYTES_MIN <= empty.len() as u64, "{}", empty.len());
    }

    #[test]
    fn long_headers_are_read_on() {
        let comments = "comment as long as can be\n".repeat(4000);
        let file = ply("binary_little_endian", &format!("{comments}{TWO_POINTS}"), &[0; 24]);
        assert_eq!(of(&file, "a"), Completeness::Complete);
        let half = &file[..60_000];
        let expected = Completeness::Incomplete { expected: 60_001, found: 60_000 };
        assert_eq!(of(half, "a"), expected);
        let endless = ply("ascii", &"comment and no end\n".repeat(100_000), b"");
        assert_eq!(of(&endless, "a"), Completeness::Unproven);
    }
}
