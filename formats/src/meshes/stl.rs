//! Binary STL: triangles and nothing else, for 3D printing and CAD programs.
//!
//! ```text
//!   meniscus 0.1.0 i=9f3c.. s=02d1..      80 free bytes, padded with spaces
//!   count                                  of triangles, 32 bits
//!   normal, a, b, c, 0                     12 floats of 32 bits, and 16 unused bits; 50 bytes per triangle
//! ```
//!
//! Text STL starts with the word `solid`, so the header of a binary file must not. The format has no units,
//! axes or shared vertices: corners are repeated. Positions are 32-bit world coordinates, so they lose
//! precision if the mesh is far from the origin.

use std::io::Write;

use crate::core::data::{MeshData, MeshView, Provenance, world};
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::provenance::GENERATOR;
use crate::core::row::{Content, FormatRow, Integrity, MeshEncoder, MeshWriter, OutputRow};

const FORMAT: &str = "STL";

const TITLE_BYTES: usize = 80;
const HEAD_BYTES: usize = TITLE_BYTES + 4;
const TRIANGLE_BYTES: usize = 50;

/// Number of triangles encoded at a time.
const PIECE: usize = 4096;

/// Writes triangles, each with its face normal. The title (the 80 free bytes) stores the values `input_hash`,
/// `settings` and `obstacles` of the provenance; a value that does not fit is omitted.
///
/// # Errors
///
/// [`Error::Io`] if `out` fails; [`Error::TooLarge`] for 2³² triangles or more; [`Error::Invalid`] if the
/// mesh is inconsistent or not finite.
pub fn write(mesh: &MeshView, provenance: &Provenance, out: &mut dyn Write) -> Result<()> {
    mesh.check(FORMAT)?;
    let count = count_of(mesh.triangles.len())?;
    out.write_all(&title(provenance))?;
    out.write_all(&count.to_le_bytes())?;
    let mut bytes = Vec::with_capacity(PIECE * TRIANGLE_BYTES);
    for piece in mesh.triangles.chunks(PIECE) {
        bytes.clear();
        for triangle in piece {
            let corners = triangle.map(|corner| corner_of(mesh, corner));
            for vector in
                [normal_of(triangle.map(|corner| mesh.positions[corner as usize]))].iter().chain(&corners)
            {
                bytes.extend_from_slice(vector.map(f32::to_le_bytes).as_flattened());
            }
            bytes.extend_from_slice(&[0, 0]);
        }
        out.write_all(&bytes)?;
    }
    Ok(())
}

fn count_of(triangle_count: usize) -> Result<u32> {
    u32::try_from(triangle_count).map_err(|_| {
        let what = format!(
            "the mesh has {triangle_count} triangles; the limit is 2³² − 1: write .ply, or use a larger voxel size"
        );
        Error::too_large(FORMAT, what)
    })
}

/// The world position of a corner. A mesh without an origin keeps its positions, and their negative zeros.
#[expect(clippy::cast_possible_truncation, reason = "the format has 32 bits")]
fn corner_of(mesh: &MeshView, corner: u32) -> [f32; 3] {
    let position = mesh.positions[corner as usize];
    match mesh.origin {
        [0.0, 0.0, 0.0] => position,
        origin => world(origin, position).map(|along| along as f32),
    }
}

/// The unit normal of a triangle; zero for a degenerate one, as the format specifies.
#[expect(clippy::cast_possible_truncation, reason = "directions need no more than 24 bits")]
fn normal_of(corners: [[f32; 3]; 3]) -> [f32; 3] {
    let [a, b, c] = corners.map(|corner| corner.map(f64::from));
    let [u, v]: [[f64; 3]; 2] = [b, c].map(|end| std::array::from_fn(|axis| end[axis] - a[axis]));
    let normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    let length = normal.iter().map(|x| x * x).sum::<f64>().sqrt();
    if length > 0.0 { normal.map(|x| (x / length) as f32) } else { [0.0; 3] }
}

/// The one-letter abbreviation of a provenance name, because the title is short. Values whose names have no
/// abbreviation are omitted.
struct Abbreviation {
    name: &'static str,
    letter: &'static str,
    /// The common prefix of all values, which is not written.
    lead: &'static str,
}

const ABBREVIATIONS: [Abbreviation; 3] = [
    Abbreviation { name: "input_hash", letter: "i", lead: "xxh3-128:" },
    Abbreviation { name: "settings", letter: "s", lead: "" },
    Abbreviation { name: "obstacles", letter: "o", lead: "" },
];

/// The provenance name of the generator, which starts the title.
const GENERATOR_NAME: &str = "generator";

fn title(provenance: &Provenance) -> [u8; TITLE_BYTES] {
    let mut text = GENERATOR.to_owned();
    for (name, value) in provenance {
        let short = ABBREVIATIONS.iter().find(|short| short.name == name);
        let Some((letter, rest)) =
            short.and_then(|short| Some((short.letter, value.strip_prefix(short.lead)?)))
        else {
            continue;
        };
        let entry = format!(" {letter}={rest}");
        if rest.bytes().all(|byte| byte.is_ascii_graphic()) && text.len() + entry.len() <= TITLE_BYTES {
            text += &entry;
        }
    }
    let mut title = [b' '; TITLE_BYTES];
    let length = text.len().min(TITLE_BYTES);
    title[..length].copy_from_slice(&text.as_bytes()[..length]);
    title
}

/// Reads the provenance that [`write()`] stored in the title.
fn read_provenance(head: &[u8]) -> Result<Vec<(String, String)>> {
    let title = head.get(..TITLE_BYTES).ok_or_else(|| abbreviation(head))?;
    let text = std::str::from_utf8(title).unwrap_or_default();
    let mut words = text.split_ascii_whitespace();
    let (Some("meniscus"), Some(version)) = (words.next(), words.next()) else { return Ok(Vec::new()) };
    let mut pairs = vec![(GENERATOR_NAME.to_owned(), format!("meniscus {version}"))];
    for word in words {
        let entry = word.split_once('=').and_then(|(letter, value)| {
            let Abbreviation { name, lead, .. } =
                ABBREVIATIONS.iter().find(|short| short.letter == letter)?;
            Some(((*name).to_owned(), format!("{lead}{value}")))
        });
        pairs.extend(entry);
    }
    Ok(pairs)
}

fn abbreviation(bytes: &[u8]) -> Error {
    let what = format!("the file has {} bytes, fewer than its header of {HEAD_BYTES}", bytes.len());
    Error::truncated(FORMAT, Position::File, what)
}

/// The size of a file with this header.
fn bytes_declared(head: &[u8]) -> Option<u64> {
    Some(bytes_with(triangles_declared(head)?))
}

/// The number of triangles of a file with this header.
fn triangles_declared(head: &[u8]) -> Option<u32> {
    Some(u32::from_le_bytes(*head.get(TITLE_BYTES..)?.first_chunk()?))
}

fn bytes_with(triangle_count: u32) -> u64 {
    HEAD_BYTES as u64 + u64::from(triangle_count) * TRIANGLE_BYTES as u64
}

/// Reads as many triangles as the header declares. Bytes after them, which some programs append, are ignored.
/// Triangles do not share vertices. The stored normals, which are face normals, are dropped.
///
/// # Errors
///
/// [`Error::Truncated`] if triangles are missing, [`Error::TooLarge`] beyond `limits`, [`Error::Unsupported`]
/// for text STL.
pub fn read_mesh(bytes: &[u8], limits: &Limits) -> Result<MeshData> {
    let triangle_count = triangles_declared(bytes).ok_or_else(|| abbreviation(bytes))?;
    let claimed = bytes_with(triangle_count);
    let is_complete_file = claimed == bytes.len() as u64;
    if !is_complete_file && bytes.starts_with(b"solid") {
        return Err(Error::unsupported(FORMAT, "this is text STL: save it as binary STL"));
    }
    if claimed > bytes.len() as u64 {
        let what = format!("expected {claimed} bytes, found {}", bytes.len());
        return Err(Error::truncated(FORMAT, Position::Offset(bytes.len() as u64), what));
    }
    let vertex_count = 3 * u64::from(triangle_count);
    let limit = limits.particle_count.min(u64::from(u32::MAX));
    if vertex_count > limit {
        let what =
            format!("the file has {vertex_count} vertices (3 per triangle), more than the limit of {limit}");
        return Err(Error::too_large(FORMAT, what));
    }
    let mut mesh = MeshData::default();
    mesh.positions.reserve_exact(3 * triangle_count as usize);
    mesh.triangles.reserve_exact(triangle_count as usize);
    let records = bytes[HEAD_BYTES..].as_chunks::<TRIANGLE_BYTES>().0.iter().take(triangle_count as usize);
    for (record, first) in records.zip((0..).step_by(3)) {
        for corner in record[12..48].as_chunks::<12>().0 {
            let axis =
                |at: usize| f32::from_le_bytes([corner[at], corner[at + 1], corner[at + 2], corner[at + 3]]);
            mesh.positions.push([axis(0), axis(4), axis(8)].map(f64::from));
        }
        mesh.triangles.push([first, first + 1, first + 2]);
    }
    Ok(mesh)
}

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        read_mesh: Some(|bytes, limits, _| read_mesh(bytes, limits)),
        ..FormatRow::new(FORMAT, &["stl"])
    },
    help: "Binary STL: triangles only",
    content: Content::Mesh(MeshWriter {
        attribute_notes: |attributes| match attributes {
            [] => Vec::new(),
            _ => vec!["vertex attributes are missing in the .stl, which stores triangles only".to_owned()],
        },
        lacks_origin: true,
        ..MeshWriter::new(MeshEncoder::Stream(|mesh, _, provenance, out| write(mesh, provenance, out)))
    }),
    write_particles: None,
    has_attributes: false,
    options: &[],
    read_provenance,
    integrity: Integrity::Length(|head, _| Ok(bytes_declared(head))),
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triangle_count_beyond_32_bits_is_an_error() {
        assert_eq!(count_of(u32::MAX as usize).ok(), Some(u32::MAX));
        assert!(matches!(count_of(u32::MAX as usize + 1), Err(Error::TooLarge { .. })));
    }

    #[test]
    fn declared_number_of_triangles_is_read() {
        let record = |x: f32| [x.to_le_bytes().repeat(12), vec![0; 2]].concat();
        let file =
            |count: u32, records: &[u8]| [&[b' '; TITLE_BYTES][..], &count.to_le_bytes(), records].concat();
        let records = [record(1.0), record(2.0), record(3.0)].concat();
        let limits = Limits { particle_count: 6, ..Limits::default() };
        let mesh = read_mesh(&file(2, &records), &limits).expect("two triangles");
        assert_eq!(mesh.triangles, [[0, 1, 2], [3, 4, 5]]);
        assert_eq!(mesh.positions, [[[1.0; 3]; 3], [[2.0; 3]; 3]].concat());
        assert!(read_mesh(&file(0, &records), &limits).expect("none").positions.is_empty());
        assert!(matches!(read_mesh(&file(3, &records), &limits), Err(Error::TooLarge { .. })));
        assert!(matches!(read_mesh(&file(4, &records), &Limits::default()), Err(Error::Truncated { .. })));
    }

    #[test]
    fn titles_store_what_fits_and_never_start_with_solid() {
        let pair = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        let all = [
            pair("generator", GENERATOR),
            pair("input", "solid.bgeo"),
            pair("input_hash", &format!("xxh3-128:{}", "9".repeat(32))),
            pair("settings", &"0".repeat(12)),
            pair("obstacles", &"f".repeat(8)),
        ];
        let title = title(&all);
        assert!(title.starts_with(GENERATOR.as_bytes()) && title.is_ascii());
        let kept = [&all[..1], &all[2..]].concat();
        assert_eq!(read_provenance(&title).expect("a title"), kept);
        // A value that does not fit is omitted, not truncated.
        let long = [all[2].clone(), pair("settings", &"0".repeat(80)), all[4].clone()];
        let read = read_provenance(&super::title(&long)).expect("a title");
        assert_eq!(read[1..], [long[0].clone(), long[2].clone()]);
        assert!(read_provenance(&title[..79]).is_err());
        assert_eq!(read_provenance(&[b' '; 84]).expect("a title"), []);
    }
}
