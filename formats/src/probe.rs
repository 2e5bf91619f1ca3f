//! What a file is, by its content.
//!
//! Names lie: `.bgeo` alone stands for three unrelated formats, any of them gzipped or not. So the
//! content decides, from the surest sign to the vaguest: a signature in the first bytes, then what
//! a text starts with, then whether its lines look like a table. The name has a say only where the
//! content has none.

use std::fmt;

use crate::csv;
use crate::gzip::{inflate_head, is_gzip};
use crate::text::{Lines, parse_number};

/// What a file was recognised as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Polygon file, with points or a mesh.
    Ply,
    /// Houdini's geometry before version 12, binary; what simulators write.
    ClassicBgeo,
    /// The same as text.
    ClassicGeo,
    /// Houdini's geometry from version 12 on, binary.
    HoudiniJsonBinary,
    /// The same as text.
    HoudiniJsonText,
    /// The same, compressed with Blosc.
    HoudiniSc,
    /// VTK's old format, text or binary.
    VtkLegacy,
    /// VTK's XML formats.
    VtkXml,
    /// Sparse volumes.
    OpenVdb,
    /// glTF, binary.
    Glb,
    /// glTF, text.
    GltfJson,
    /// Wavefront's mesh as text.
    Obj,
    /// A table as text: CSV, tab- or space-separated.
    Delimited,
    /// One NumPy array.
    Npy,
    /// A format that is recognised only to name it.
    Foreign(&'static str),
    /// No bytes at all.
    Empty,
    /// Text that is none of the above.
    UnknownText,
    /// Anything else.
    Unknown,
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Kind {
    /// The name that users know.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Ply => "PLY",
            Kind::ClassicBgeo => "classic BGEO",
            Kind::ClassicGeo => "classic Houdini GEO (text)",
            Kind::HoudiniJsonBinary => "Houdini geometry (binary JSON)",
            Kind::HoudiniJsonText => "Houdini geometry (JSON text)",
            Kind::HoudiniSc => "Houdini geometry (.sc, Blosc-compressed)",
            Kind::VtkLegacy => "legacy VTK",
            Kind::VtkXml => "VTK XML",
            Kind::OpenVdb => "OpenVDB",
            Kind::Glb => "binary glTF",
            Kind::GltfJson => "glTF",
            Kind::Obj => "OBJ",
            Kind::Delimited => "delimited text",
            Kind::Npy => "NumPy array",
            Kind::Foreign(name) => name,
            Kind::Empty => "empty file",
            Kind::UnknownText => "text of an unknown kind",
            Kind::Unknown => "unknown binary file",
        }
    }
}

/// What a file is, and how it is packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Probe {
    /// What it is, or what is packed in it.
    pub kind: Kind,
    /// Whether it is packed with gzip.
    pub gzipped: bool,
}

impl fmt::Display for Probe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.kind, if self.gzipped { ", gzipped" } else { "" })
    }
}

/// Bytes that are looked at.
const HEAD_BYTES: usize = 8 << 10;

/// Tells what the file is from its first bytes; `file_name` decides only between texts that could be
/// either of two things. The file need not be whole: a few kilobytes are enough.
pub fn probe(bytes: &[u8], file_name: &str) -> Probe {
    let name = file_name.to_ascii_lowercase();
    if is_gzip(bytes) {
        let head = inflate_head(bytes, HEAD_BYTES);
        let kind = if is_gzip(&head) { Kind::Foreign("gzip within gzip") } else { kind_of(&head, &name) };
        return Probe { kind, gzipped: true };
    }
    Probe { kind: kind_of(&bytes[..bytes.len().min(HEAD_BYTES)], &name), gzipped: false }
}

/// Whether a file is worth reading for its particles, told from its first bytes: for the listing of
/// a folder, in which notes, logs and scripts lie beside the frames.
///
/// Formats of particles are told by [`probe()`], be they read or not. A text must be a table: a
/// header that names a position and fits the row below it, or a row of three numbers or more. `head`
/// should have 8 KiB, unless the file is shorter; it may be packed with gzip.
pub fn looks_like_particles(head: &[u8], file_name: &str) -> bool {
    match probe(head, file_name).kind {
        Kind::Ply
        | Kind::ClassicBgeo
        | Kind::ClassicGeo
        | Kind::HoudiniJsonBinary
        | Kind::HoudiniJsonText
        | Kind::HoudiniSc
        | Kind::VtkLegacy
        | Kind::VtkXml
        | Kind::Npy => true,
        Kind::Delimited if is_gzip(head) => csv::looks_like_particles(&inflate_head(head, HEAD_BYTES)),
        Kind::Delimited => csv::looks_like_particles(head),
        Kind::OpenVdb
        | Kind::Glb
        | Kind::GltfJson
        | Kind::Obj
        | Kind::Foreign(_)
        | Kind::Empty
        | Kind::UnknownText
        | Kind::Unknown => false,
    }
}

fn kind_of(head: &[u8], name: &str) -> Kind {
    if head.is_empty() {
        return Kind::Empty;
    }
    if let Some(&(_, kind)) = SIGNATURES.iter().find(|(signature, _)| head.starts_with(signature)) {
        return kind;
    }
    if head.starts_with(b"ply") && head.get(3).is_some_and(u8::is_ascii_whitespace) {
        return Kind::Ply;
    }
    let text = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head).trim_ascii_start();
    // Before the question whether this is text: VTK appends raw bytes to its XML.
    if text.starts_with(b"<") && contains(text, b"<VTKFile") {
        return Kind::VtkXml;
    }
    if !is_text(head) {
        return Kind::Unknown;
    }
    match text.first() {
        Some(b'{' | b'[') => json_kind(text, name),
        Some(b'<') => Kind::Foreign("XML"),
        _ if looks_like_obj(text, name) => Kind::Obj,
        _ if looks_like_table(text) || csv::looks_like_particles(text) => Kind::Delimited,
        _ => Kind::UnknownText,
    }
}

fn json_kind(text: &[u8], name: &str) -> Kind {
    if contains(text, b"\"fileversion\"") || contains(text, b"\"pointcount\"") {
        return Kind::HoudiniJsonText;
    }
    let gltf_keys: [&[u8]; 4] = [b"\"asset\"", b"\"accessors\"", b"\"bufferViews\"", b"\"meshes\""];
    if name.ends_with(".gltf") || gltf_keys.iter().any(|key| contains(text, key)) {
        return Kind::GltfJson;
    }
    Kind::Foreign("JSON")
}

/// Text holds no control characters but those that lay it out. Bytes above 127 may be any encoding.
fn is_text(head: &[u8]) -> bool {
    head.iter().all(|&byte| byte >= b' ' || matches!(byte, b'\t' | b'\n' | b'\r' | 0x0b | 0x0c | 0x1a))
}

/// Whether every line that says something starts with a word of the OBJ format, and one has a vertex.
fn looks_like_obj(text: &[u8], name: &str) -> bool {
    let mut vertex_seen = false;
    let mut line_count = 0;
    for line in telling_lines(text) {
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let keyword = words.next().unwrap_or_default();
        if !OBJ_KEYWORDS.contains(&keyword) {
            return false;
        }
        let numbers = words.filter(|word| parse_number::<f64>(word).is_some()).count();
        vertex_seen |= keyword == b"v" && numbers >= 3;
        line_count += 1;
    }
    vertex_seen || (name.ends_with(".obj") && line_count > 0)
}

/// Whether the first lines hold numbers between delimiters, or a name over every column of them.
fn looks_like_table(text: &[u8]) -> bool {
    let mut lines = telling_lines(text);
    let Some(header) = lines.next() else { return false };
    // At least half of the cells are numbers: names may stand among them.
    let is_numeric = |line: &[u8]| {
        let cells = line.split(|byte| b",;|\t ".contains(byte)).map(<[u8]>::trim_ascii);
        let (mut cell_count, mut number_count) = (0, 0);
        for cell in cells.filter(|cell| !cell.is_empty()) {
            cell_count += 1;
            number_count += usize::from(parse_number::<f64>(cell).is_some());
        }
        cell_count > 0 && 2 * number_count >= cell_count
    };
    // Some programs write several lines of free text before the table.
    is_numeric(header) || lines.any(is_numeric) || header.iter().any(|byte| b",;\t".contains(byte))
}

/// The lines that are neither empty nor comments; the last, which may be cut off, only if it is alone.
fn telling_lines(text: &[u8]) -> impl Iterator<Item = &[u8]> {
    let whole = match text.iter().rposition(|byte| matches!(byte, b'\n' | b'\r')) {
        Some(end) if text.len() + 16 > HEAD_BYTES => &text[..end],
        _ => text,
    };
    Lines::new(whole).map(<[u8]>::trim_ascii).filter(|line| !line.is_empty() && !line.starts_with(b"#"))
}

fn contains(text: &[u8], word: &[u8]) -> bool {
    text.windows(word.len()).any(|window| window == word)
}

/// Words that lines of an OBJ file start with.
const OBJ_KEYWORDS: &[&[u8]] =
    &[b"v", b"vn", b"vt", b"vp", b"f", b"l", b"p", b"o", b"g", b"s", b"mtllib", b"usemtl"];

/// First bytes that say what the file is.
const SIGNATURES: &[(&[u8], Kind)] = &[
    (b"Bgeo", Kind::ClassicBgeo),
    (b"PGEOMETRY", Kind::ClassicGeo),
    (b"\x7fNSJb", Kind::HoudiniJsonBinary),
    (b"\x7fbJSN", Kind::HoudiniJsonBinary), // written by a big-endian machine
    (b"scf1", Kind::HoudiniSc),
    (b"# vtk DataFile", Kind::VtkLegacy),
    (b" BDV\0\0\0\0", Kind::OpenVdb),
    (b"glTF", Kind::Glb),
    (b"\x93NUMPY", Kind::Npy),
    (b"PK\x03\x04", Kind::Foreign("ZIP archive, perhaps NumPy's .npz")),
    (b"\x89HDF\r\n\x1a\n", Kind::Foreign("HDF5")),
    (b"Ogawa", Kind::Foreign("Alembic")),
    (b"PXR-USDC", Kind::Foreign("USD")),
    (b"#usda", Kind::Foreign("USD")),
    (b"NanoVDB", Kind::Foreign("NanoVDB")),
    (b"\xc0PRT\r\n\x1a\n", Kind::Foreign("Krakatoa PRT")),
    (b"\x28\xb5\x2f\xfd", Kind::Foreign("Zstandard archive")),
    (b"\xfd7zXZ\0", Kind::Foreign("XZ archive")),
    (b"BZh", Kind::Foreign("bzip2 archive")),
    (b"\xff\xfe", Kind::Foreign("UTF-16 text: save it as UTF-8")),
    (b"\xfe\xff", Kind::Foreign("UTF-16 text: save it as UTF-8")),
    (b"\x76\x2f\x31\x01", Kind::Foreign("OpenEXR image")),
    (b"\x89PNG", Kind::Foreign("PNG image")),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn content_decides() {
        let table: &[(&[u8], &str, Kind)] = &[
            (b"", "a.ply", Kind::Empty),
            (b"ply\nformat ascii 1.0\n", "a.txt", Kind::Ply),
            (b"ply\r\n", "a", Kind::Ply),
            (b"plywood,x,y\n1,2,3\n", "a", Kind::Delimited),
            (b"BgeoV\0\0\0\x05", "a.ply", Kind::ClassicBgeo),
            (b"PGEOMETRY V5\n", "a.geo", Kind::ClassicGeo),
            (b"\x7fNSJb\x5b", "a.bgeo", Kind::HoudiniJsonBinary),
            (b"scf1\0\0\0\0", "a.bgeo.sc", Kind::HoudiniSc),
            (b"[\n\t\"fileversion\",\"19.5.303\",", "a.geo", Kind::HoudiniJsonText),
            (b"# vtk DataFile Version 5.1\nx\nASCII\n", "a.csv", Kind::VtkLegacy),
            (b"<?xml version=\"1.0\"?>\n<VTKFile type=\"PolyData\">", "a.vtp", Kind::VtkXml),
            (b"<html>", "a.vtp", Kind::Foreign("XML")),
            (b" BDV\0\0\0\0\xe0\0\0\0", "a", Kind::OpenVdb),
            (b"glTF\x02\0\0\0", "a", Kind::Glb),
            (b"{\"asset\":{\"version\":\"2.0\"}}", "a", Kind::GltfJson),
            (b"{\"scene\":0,\n\"asset\":{}, 1 2 3\n", "a", Kind::GltfJson),
            (b"{\"x\":1}", "a.json", Kind::Foreign("JSON")),
            (b"# made by hand\no cube\nv 1 2 3\nvn 0 0 1\nf 1//1 2//1 3//1\n", "a.txt", Kind::Obj),
            (b"v x y z\n1 2 3 4\n", "a.obj", Kind::Delimited),
            (b"o empty\n", "a.obj", Kind::Obj),
            (b"x,y,z\n1,2,3\n", "a", Kind::Delimited),
            (b"\xef\xbb\xbf\"x\";\"y\";\"z\"\n", "a", Kind::Delimited),
            (b"1 2 3\n4 5 6\n", "a.xyz", Kind::Delimited),
            (b"# x y z\n0.5 2 3", "a.xyz", Kind::Delimited),
            (b"x y z radius\n", "a.txt", Kind::Delimited),
            (b"# made by hand\n# x y z\n", "a.xyz", Kind::Delimited),
            (b"ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n", "a.dump", Kind::Delimited),
            (b"Dear reader,\nthere is nothing here\n", "a", Kind::Delimited), // has a comma: told by the reader
            (b"plyx\nformat ascii 1.0\nelement vertex 0\nend_header\n", "a.ply", Kind::UnknownText),
            (b"Dear reader\n", "a", Kind::UnknownText),
            (b"\x93NUMPY\x01\0", "a.npy", Kind::Npy),
            (b"PK\x03\x04", "a.npz", Kind::Foreign("ZIP archive, perhaps NumPy's .npz")),
            (b"\x00\x00\x80\x3f\x00\x00\x80\x3f", "a.xyz", Kind::Unknown),
            (b"\xff", "a", Kind::UnknownText),
            (b"\x1f\x8b", "a.bgeo", Kind::Empty),
        ];
        for (bytes, name, kind) in table {
            let found = probe(bytes, name);
            assert_eq!(found.kind, *kind, "of {:?} as {name}", String::from_utf8_lossy(bytes));
        }
    }

    #[test]
    fn only_tables_of_particles_are_listed() {
        let table: &[(&[u8], &str, bool)] = &[
            (b"Things to do, in this order:\n1. eat\n2. sleep, or x, y and z\n", "notes.txt", false),
            (b"the x y z positions are wrong\nsee below\n", "notes.txt", false),
            (b"step 10\nstep 20\n", "run.log", false),
            (b"10\n20\n", "run.log", false),
            (b"t, residual\n0.1, 2e-3\n", "run.csv", false),
            (b"import os, sys\nx, y, z = 1, 2, 3\n", "sim.py", false),
            (b"# x y z\nprint(1)\n", "sim.py", false),
            (b"{\"x\": [1, 2, 3]}", "settings.json", false),
            (b"v 1 2 3\nv 4 5 6\n", "mesh.obj", false),
            (b"", "empty.csv", false),
            (b"x,y,z\n", "a.csv", true),
            (b"# x y z", "a.xyz", true),
            (b"type;x;y;z\nwater;1,5;2,5;3,5\n", "a.csv", true), // told by the reader what is wrong
            (b"made by hand\n\n\"x\",\"y\",\"z\",\r\n1,2,nan,\r\n", "a.txt", true),
            (b"1 2 3\n", "a", true),
            (b"1\t2\t3", "a.log", true),
            (b"ITEM: TIMESTEP\n0\nITEM: ATOMS id type x y z\n1 1 0.5 0.5 0.5\n", "a.dump", true),
            (b"ply\nformat ascii 1.0\n", "a.ply", true),
        ];
        for (bytes, name, expected) in table {
            let found = looks_like_particles(bytes, name);
            assert_eq!(found, *expected, "of {:?} as {name}", String::from_utf8_lossy(bytes));
        }
        let long = [b"x,y,z\n".to_vec(), b"0.25,0.5,0.75\n".repeat(1000)].concat();
        for length in [HEAD_BYTES - 3, HEAD_BYTES, long.len()] {
            assert!(looks_like_particles(&long[..length], "a.csv"), "of {length} bytes");
        }
    }
}
