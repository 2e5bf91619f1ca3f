//! Recognises the format of a file by its content.
//!
//! File names are unreliable: `.bgeo` alone is used for three unrelated formats, each compressed or not. The
//! content therefore decides, from the most to the least reliable evidence: a signature in the first bytes,
//! then the beginning of a text, then whether its lines look like a table. The name matters only where the
//! content is ambiguous.

use std::borrow::Cow;
use std::fmt;

use crate::abc;
use crate::arrays::hdf5;
use crate::arrays::json;
use crate::arrays::xdmf::looks_like_xdmf;
use crate::core::compression::{Codec, name_without_compression};
use crate::core::text::{Lines, parse_number};
use crate::houdini::TEXT_REFUSAL;
use crate::meshes::gltf;
use crate::meshes::obj_points;
use crate::table::Format;
use crate::table::neighbor::Neighbor;
use crate::tables::csv;
use crate::tables::xyz_ext::looks_like_atoms;
use crate::usd::{declares_mesh, has_clips};
use crate::vdb;
use crate::vtk;

/// What a file was recognised as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProbedKind {
    /// A format in the table of formats.
    Format(Format),
    /// A format without a reader, recognised only for error messages.
    Foreign(&'static str),
    /// An empty file.
    Empty,
    /// Text in an unknown format.
    UnknownText,
    /// Any other file.
    Unknown,
}

impl fmt::Display for ProbedKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl ProbedKind {
    /// The name shown to users.
    pub fn name(self) -> &'static str {
        match self {
            ProbedKind::Format(format) => format.name(),
            ProbedKind::Foreign(name) => name,
            ProbedKind::Empty => "empty file",
            ProbedKind::UnknownText => "text in an unknown format",
            ProbedKind::Unknown => "unknown binary file",
        }
    }

    /// The entry in the table of formats, if there is one.
    pub fn format(self) -> Option<Format> {
        match self {
            ProbedKind::Format(format) => Some(format),
            ProbedKind::Foreign(_) | ProbedKind::Empty | ProbedKind::UnknownText | ProbedKind::Unknown => {
                None
            }
        }
    }
}

/// A file's format and compression.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Probe {
    /// The format of the (decompressed) content.
    pub kind: ProbedKind,
    /// The compression, if any.
    pub codec: Option<Codec>,
}

impl fmt::Display for Probe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.codec {
            Some(codec) => write!(f, "{}, {}", self.kind, codec.adjective()),
            None => self.kind.fmt(f),
        }
    }
}

/// Number of bytes to examine.
pub(crate) const HEAD_BYTES: usize = 8 << 10;

/// Recognises a file by its first bytes; a few kilobytes are enough. `file_name` only resolves ambiguities
/// between formats.
pub fn probe(bytes: &[u8], file_name: &str) -> Probe {
    let name = file_name.to_ascii_lowercase();
    let codec = Codec::of(bytes);
    let Some(outer) = codec else {
        return Probe { kind: kind_of(&bytes[..bytes.len().min(HEAD_BYTES)], &name), codec };
    };
    let head = outer.decompress_head(bytes, HEAD_BYTES);
    let kind = match (outer, Codec::of(&head)) {
        (_, None) => kind_of(&head, name_without_compression(&name)),
        (Codec::Gzip, Some(Codec::Gzip)) => ProbedKind::Foreign("gzip within gzip"),
        (_, Some(_)) => ProbedKind::Foreign("a compressed file that is compressed again"),
    };
    Probe { kind, codec }
}

/// Whether a file probably contains particles, judged by its first bytes. Used to list a folder in which
/// notes, logs and scripts lie next to the frames.
///
/// The answer is yes if [`probe()`] recognises a particle format, even if the file turns out to be invalid.
/// Delimited text must also start like a table: with a header that names a position and fits the row below
/// it, or with a row of at least three numbers. JSON must have positions. `head` should have 8 KiB unless the
/// file is shorter; it may be compressed.
pub fn looks_like_particles(head: &[u8], file_name: &str) -> bool {
    let looks: fn(&[u8]) -> bool = match probe(head, file_name).kind {
        ProbedKind::Format(Format::Delimited) => csv::looks_like_particles,
        ProbedKind::Format(Format::Json) => json::looks_like_particles,
        ProbedKind::Format(Format::Obj) => |head| !obj_points::has_faces(head),
        // The content of other archives is known only from their end.
        ProbedKind::Format(Format::Abc) => |head| !abc::is_own_mesh(head),
        ProbedKind::Format(Format::Usda | Format::Usdc) => |head| !declares_mesh(head) && !has_clips(head),
        kind => return kind.format().is_some_and(Format::has_particles),
    };
    match Codec::of(head) {
        Some(codec) => looks(&codec.decompress_head(head, HEAD_BYTES)),
        None => looks(head),
    }
}

fn kind_of(head: &[u8], name: &str) -> ProbedKind {
    if head.is_empty() {
        return ProbedKind::Empty;
    }
    if name.ends_with(".abc") && head.starts_with(abc::HDF5) {
        return ProbedKind::Format(Format::Abc);
    }
    let has_signature = |format: &Format| format.row().signatures.iter().any(|bytes| head.starts_with(bytes));
    match Format::ALL.into_iter().find(has_signature) {
        Some(Format::Vdb) if vdb::starts_with_points(head) => return ProbedKind::Format(Format::VdbPoints),
        Some(Format::Glb) if gltf::declares_points(head) => return ProbedKind::Format(Format::GltfPoints),
        Some(format) => return ProbedKind::Format(format),
        None if hdf5::has_user_block(head) => return ProbedKind::Format(Format::Hdf5),
        None => {}
    }
    if let Cow::Owned(text) = csv::decoded(head) {
        return match kind_of(&text, name) {
            ProbedKind::Format(Format::Delimited) => ProbedKind::Format(Format::Delimited),
            _ => ProbedKind::Foreign("UTF-16 text: save it as UTF-8"),
        };
    }
    if let Some(&(_, name)) = FOREIGN_SIGNATURES.iter().find(|(signature, _)| head.starts_with(signature)) {
        return ProbedKind::Foreign(name);
    }
    if head.starts_with(b"PK\x03\x04") {
        let member = first_member(head).unwrap_or_default();
        let is_layer = |ending: &&[u8]| member.ends_with(ending);
        return if name.ends_with(".npz") || member.ends_with(b".npy") {
            ProbedKind::Format(Format::Npz)
        } else if name.ends_with(".usdz") || [&b".usdc"[..], b".usda", b".usd"].iter().any(is_layer) {
            ProbedKind::Format(Format::Usdz)
        } else {
            ProbedKind::Foreign(ZIP)
        };
    }
    if head.get(TAR_OFFSET..).is_some_and(|rest| rest.starts_with(b"ustar")) {
        return ProbedKind::Foreign(TAR);
    }
    let text = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head).trim_ascii_start();
    // This check comes before the check for text, because VTK appends raw bytes to its XML.
    if text.starts_with(b"<")
        && let Some(format) = vtk_kind(text, name)
    {
        return ProbedKind::Format(format);
    }
    if looks_like_xdmf(text) {
        return ProbedKind::Format(Format::Xdmf);
    }
    if !is_text(head) {
        // A binary STL file has no signature: only its name, or this program's own header, identifies it.
        if name.ends_with(".stl") || head.starts_with(b"meniscus ") {
            return ProbedKind::Format(Format::Stl);
        }
        let first_line = Lines::new(text).next().unwrap_or_default();
        return match name {
            // The reader reports the byte that is not text.
            _ if is_text(first_line) && csv::names_position(first_line) => {
                ProbedKind::Format(Format::Delimited)
            }
            _ => ProbedKind::Unknown,
        };
    }
    // Its rows would be a table.
    if looks_like_lammps_data(text) {
        return ProbedKind::Foreign(LAMMPS_DATA);
    }
    match text.first() {
        Some(b'{' | b'[') if !starts_with_section(text) => json_kind(text, name),
        Some(b'<') => ProbedKind::UnknownText,
        _ if text.starts_with(b"solid") && name.ends_with(".stl") => {
            ProbedKind::Foreign("STL text: save it as binary STL")
        }
        _ if text.starts_with(b"ITEM:") => ProbedKind::Format(Format::LammpsDump),
        _ if looks_like_atoms(text, name) => ProbedKind::Format(Format::XyzAtoms),
        _ if looks_like_obj(text, name) => ProbedKind::Format(Format::Obj),
        _ if looks_like_table(text, name) || csv::looks_like_particles(text) => {
            ProbedKind::Format(Format::Delimited)
        }
        _ => ProbedKind::UnknownText,
    }
}

/// The format of a VTK XML file; the name decides if the head ends before its first tag.
fn vtk_kind(text: &[u8], name: &str) -> Option<Format> {
    let is_named = |format: Format| {
        let mut extensions = format.extensions().iter();
        extensions.any(|extension| name.strip_suffix(extension).is_some_and(|stem| stem.ends_with('.')))
    };
    if contains(text, b"<VTKFile") {
        let is_index = vtk::xml_neighbor(text) == Some(Neighbor::Index);
        return Some(if is_index { Format::VtkIndex } else { Format::Vtp });
    }
    let formats = [Format::Vtp, Format::VtkIndex].into_iter();
    formats.filter(|_| !contains(text, b"<html")).find(|format| is_named(*format))
}

/// The name of the first member of a ZIP archive.
fn first_member(head: &[u8]) -> Option<&[u8]> {
    let length = u16::from_le_bytes(*head.get(26..)?.first_chunk()?);
    head.get(30..)?.get(..length.into())
}

/// Whether a text starts with the header of a section: a name in single or double brackets, which is not a
/// value of JSON, and at most a comment after it.
fn starts_with_section(text: &[u8]) -> bool {
    let line = Lines::new(text).next().unwrap_or_default();
    let name = line.strip_prefix(b"[[").or_else(|| line.strip_prefix(b"[")).unwrap_or_default();
    let (name, rest) = name.split_at(name.iter().position(|&byte| byte == b']').unwrap_or(name.len()));
    let rest = rest.iter().find(|byte| !b"] \t\r".contains(byte));
    if rest.is_some_and(|byte| !b"#;".contains(byte)) {
        return false;
    }
    let name = name.trim_ascii();
    let is_name = |byte: &u8| byte.is_ascii_alphanumeric() || b"_-.".contains(byte);
    let is_value = [&b"true"[..], b"false", b"null"].contains(&name);
    name.first().is_some_and(u8::is_ascii_alphabetic) && name.iter().all(is_name) && !is_value
}

fn json_kind(text: &[u8], name: &str) -> ProbedKind {
    if contains(text, b"\"file-series-version\"") {
        return ProbedKind::Format(Format::VtkIndex);
    }
    let is_named_geo = || name.ends_with(".geo") || name.ends_with(".bgeo");
    if contains(text, b"\"fileversion\"") || contains(text, b"\"pointcount\"") || is_named_geo() {
        return ProbedKind::Foreign(HOUDINI_TEXT);
    }
    let gltf_keys: [&[u8]; 4] = [b"\"asset\"", b"\"accessors\"", b"\"bufferViews\"", b"\"meshes\""];
    if name.ends_with(".gltf") || gltf_keys.iter().any(|key| contains(text, key)) {
        let has_points = gltf::declares_points(text);
        return ProbedKind::Format(if has_points { Format::GltfPoints } else { Format::Gltf });
    }
    ProbedKind::Format(Format::Json)
}

/// Text contains no control characters except white space. Bytes above 127 can belong to any encoding.
fn is_text(head: &[u8]) -> bool {
    head.iter().all(|&byte| byte >= b' ' || matches!(byte, b'\t' | b'\n' | b'\r' | 0x0b | 0x0c | 0x1a))
}

/// Whether a text has the header of a `write_data` file, with its lines in any order: the number of atoms,
/// and the number of atom types or the bounds of the box along x. The first line can contain anything.
fn looks_like_lammps_data(text: &[u8]) -> bool {
    let (mut has_count, mut has_more) = (false, false);
    for line in Lines::new(text).skip(1) {
        let line = line.split(|&byte| byte == b'#').next().unwrap_or_default();
        if line.trim_ascii().is_empty() {
            continue;
        }
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        if words.next().and_then(parse_number::<f64>).is_none() {
            break; // the first section
        }
        let names: Vec<&[u8]> = words.filter(|word| parse_number::<f64>(word).is_none()).collect();
        has_count |= names == [b"atoms"];
        has_more |= names == [&b"atom"[..], b"types"] || names == [b"xlo", b"xhi"];
    }
    has_count && has_more
}

/// Whether every non-comment line starts with an OBJ keyword, and at least one is a vertex. If the file name
/// ends in `.obj`, no vertex is necessary.
fn looks_like_obj(text: &[u8], name: &str) -> bool {
    let mut vertex_seen = false;
    let mut line_count = 0;
    let mut is_continued = false;
    for line in content_lines(text) {
        if std::mem::replace(&mut is_continued, line.ends_with(b"\\")) {
            continue;
        }
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

/// Whether a line is like a row: it has two or more numbers, and at least half of its cells are numbers; or
/// the first line has a delimiter and can thus be a header, and the name of the file is that of a table.
fn looks_like_table(text: &[u8], name: &str) -> bool {
    let mut lines = content_lines(text);
    let Some(header) = lines.next() else { return false };
    // The other cells may be names.
    let is_numeric = |line: &[u8]| {
        let cells = line.split(|byte| b",;|\t ".contains(byte)).map(<[u8]>::trim_ascii);
        let (mut cell_count, mut number_count) = (0, 0);
        for cell in cells.filter(|cell| !cell.is_empty()) {
            cell_count += 1;
            number_count += usize::from(parse_number::<f64>(cell).is_some());
        }
        number_count > 1 && 2 * number_count >= cell_count
    };
    let can_be_header = header.iter().any(|byte| b",;\t".contains(byte));
    let is_named_table = name.ends_with(".csv") || name.ends_with(".tsv");
    // Some programs write several lines of free text before the table.
    is_numeric(header) || lines.any(is_numeric) || can_be_header && is_named_table
}

/// Lines that are neither empty nor comments. If the head may be only a part of the file, skips the last
/// line, which may be truncated, unless it is the only one.
fn content_lines(text: &[u8]) -> impl Iterator<Item = &[u8]> {
    let whole = match text.iter().rposition(|byte| matches!(byte, b'\n' | b'\r')) {
        Some(end) if text.len() + 16 > HEAD_BYTES => &text[..end],
        _ => text,
    };
    Lines::new(whole).map(<[u8]>::trim_ascii).filter(|line| !line.is_empty() && !line.starts_with(b"#"))
}

fn contains(text: &[u8], word: &[u8]) -> bool {
    text.windows(word.len()).any(|window| window == word)
}

/// Keywords at the start of lines in OBJ files.
const OBJ_KEYWORDS: &[&[u8]] =
    &[b"v", b"vn", b"vt", b"vp", b"f", b"l", b"p", b"o", b"g", b"s", b"mtllib", b"usemtl"];

/// Signatures of files that are recognised only for error messages.
const FOREIGN_SIGNATURES: &[(&[u8], &str)] = &[
    (b"PGEOMETRY", HOUDINI_TEXT),
    (b"7z\xbc\xaf\x27\x1c", SEVEN_ZIP),
    (b"\xfd7zXZ\0", XZ),
    (b"BZh", BZIP2),
    (b"Rar!\x1a\x07", RAR),
    (b"version https://git-lfs.github.com/spec/", GIT_LFS),
];

/// What to do with these files.
pub(crate) const REMEDIES: &[(&str, &str)] = &[
    (HOUDINI_TEXT, TEXT_REFUSAL),
    (
        LAMMPS_DATA,
        "this is a `write_data` file, and only dumps are supported: write one with `write_dump all custom FILE id type x y z`",
    ),
    (ZIP, ARCHIVE),
    (TAR, ARCHIVE),
    (SEVEN_ZIP, ARCHIVE),
    (RAR, ARCHIVE),
    (XZ, "this compression is not supported: unpack the file with xz -d, or compress it with gzip or zstd"),
    (
        BZIP2,
        "this compression is not supported: unpack the file with bzip2 -d, or compress it with gzip or zstd",
    ),
    (GIT_LFS, "this is only the reference to a file in Git LFS: get the file itself with `git lfs pull`"),
];

const ARCHIVE: &str = "archives are not supported: unpack it, and give the files in it or their folder";

/// The output of LAMMPS's `write_data` command.
const LAMMPS_DATA: &str = "LAMMPS data";
const HOUDINI_TEXT: &str = "Houdini geometry as text";
const ZIP: &str = "ZIP archive";
const XZ: &str = "xz";
const BZIP2: &str = "bzip2";
const TAR: &str = "tar archive";
/// The offset of the signature of a tar archive.
const TAR_OFFSET: usize = 257;
const SEVEN_ZIP: &str = "7z archive";
const RAR: &str = "RAR archive";
const GIT_LFS: &str = "Git LFS pointer";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_signature_gives_its_format() {
        for format in Format::ALL {
            for signature in format.row().signatures {
                assert_eq!(probe(signature, "a").kind, ProbedKind::Format(format), "{signature:?}");
            }
        }
    }

    #[test]
    fn content_and_name_give_the_format() {
        let table: &[(&[u8], &str, ProbedKind)] = &[
            (b"", "a.ply", ProbedKind::Empty),
            (b"ply\nformat ascii 1.0\n", "a.txt", ProbedKind::Format(Format::Ply)),
            (b"ply\r\n", "a", ProbedKind::Format(Format::Ply)),
            (b"plywood,x,y\n1,2,3\n", "a", ProbedKind::Format(Format::Delimited)),
            (b"BgeoV\0\0\0\x05", "a.ply", ProbedKind::Format(Format::ClassicBgeo)),
            (b"[\n\t\"fileversion\",\"19.5.303\",", "a.geo", ProbedKind::Foreign(HOUDINI_TEXT)),
            (b"PGEOMETRY V5\nNPoints 1", "a.geo", ProbedKind::Foreign(HOUDINI_TEXT)),
            (b"# vtk DataFile Version 5.1\nx\nASCII\n", "a.csv", ProbedKind::Format(Format::VtkLegacy)),
            (
                b"<?xml version=\"1.0\"?>\n<VTKFile type=\"PolyData\">",
                "a.vtp",
                ProbedKind::Format(Format::Vtp),
            ),
            (b"<VTKFile type=\"Collection\"><Coll", "a.xml", ProbedKind::Format(Format::VtkIndex)),
            (b"<VTKFile type=\"PPolyData\">", "a.pvtp", ProbedKind::Format(Format::VtkIndex)),
            (b"<VTKFile type=\"PImageData\">", "a.pvti", ProbedKind::Format(Format::Vtp)),
            (b"<?xml version=\"1.0\"?>\n", "a.pvd", ProbedKind::Format(Format::VtkIndex)),
            (
                b"{\n  \"file-series-version\" : \"1.0\",\n",
                "a.vtk.series",
                ProbedKind::Format(Format::VtkIndex),
            ),
            (b"<html>", "a.vtp", ProbedKind::UnknownText),
            (b"{\"asset\":{\"version\":\"2.0\"}}", "a", ProbedKind::Format(Format::Gltf)),
            (b"{\"scene\":0,\n\"asset\":{}, 1 2 3\n", "a", ProbedKind::Format(Format::Gltf)),
            (b"{\"x\":1}", "a.json", ProbedKind::Format(Format::Json)),
            (b"[[1,2,3]", "a", ProbedKind::Format(Format::Json)),
            (b"[", "a", ProbedKind::Format(Format::Json)),
            (b"\xef\xbb\xbf {\"positions\": []}", "a", ProbedKind::Format(Format::Json)),
            (b"\xc0PRT\r\n\x1a\n\x38", "a", ProbedKind::Format(Format::Prt)),
            (
                b"# made by hand\no cube\nv 1 2 3\nvn 0 0 1\nf 1//1 2//1 3//1\n",
                "a.txt",
                ProbedKind::Format(Format::Obj),
            ),
            (b"v x y z\n1 2 3 4\n", "a.obj", ProbedKind::Format(Format::Delimited)),
            (b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 \\\n2 3\n", "a.obj", ProbedKind::Format(Format::Obj)),
            (b"x,y,z,Mk\n1,2,3,\x01\n", "a.csv", ProbedKind::Format(Format::Delimited)),
            (b"o empty\n", "a.obj", ProbedKind::Format(Format::Obj)),
            (b"x,y,z\n1,2,3\n", "a", ProbedKind::Format(Format::Delimited)),
            (b"\xef\xbb\xbf\"x\";\"y\";\"z\"\n", "a", ProbedKind::Format(Format::Delimited)),
            (b"1 2 3\n4 5 6\n", "a.xyz", ProbedKind::Format(Format::Delimited)),
            (b"# x y z\n0.5 2 3", "a.xyz", ProbedKind::Format(Format::Delimited)),
            (b"x y z radius\n", "a.txt", ProbedKind::Format(Format::Delimited)),
            (b"# made by hand\n# x y z\n", "a.xyz", ProbedKind::Format(Format::Delimited)),
            (b"ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n", "a.dump", ProbedKind::Format(Format::LammpsDump)),
            (b"LAMMPS data file\n\n2 atoms\n0 1 xlo xhi\n\nAtoms\n\n", "a", ProbedKind::Foreign(LAMMPS_DATA)),
            (b"# by hand\n2 atoms\n1 atom types # He\n", "a.xyz", ProbedKind::Foreign(LAMMPS_DATA)),
            (b"box\n2 atoms\n0 1 2\n", "a.xyz", ProbedKind::Format(Format::Delimited)),
            (b"2\nwater\nO 0 0 0\nH 1 0 0\n", "a.xyz", ProbedKind::Format(Format::XyzAtoms)),
            (b"2\nwater\n8 0 0 0\n1 1 0 0\n", "a.xyz", ProbedKind::Format(Format::XyzAtoms)),
            (
                b"2\n\n8 0 0 0 5\n1 1 0 0 5\n2\n\n8 0 0 0 5\n1 1 0 0 5",
                "a.xyz",
                ProbedKind::Format(Format::XyzAtoms),
            ),
            (b"3\nwater\n8 0 0 0\n1 1 0", "a.xyz", ProbedKind::Format(Format::XyzAtoms)),
            (b"1\nwater\n8 0 0 0\n1 1 0 0\n", "a.xyz", ProbedKind::Format(Format::Delimited)), // the count does not match
            (b"2\nx y z r\n8 0 0 1\n1 1 0 1\n", "a.xyz", ProbedKind::Format(Format::Delimited)),
            (b"2\nwater\n8 0 0\n1 1 0\n", "a.xyz", ProbedKind::Format(Format::Delimited)),
            (b"2\nwater\n8 0 0 0\n1.5 1 0 0\n", "a.xyz", ProbedKind::Format(Format::Delimited)),
            (b"2\nwater\n8 0 0 0\n119 1 0 0\n", "a.xyz", ProbedKind::Format(Format::Delimited)),
            (b"2\n\nH1 0 0 0 1 1", "a.txt", ProbedKind::Format(Format::XyzAtoms)),
            (b"2\n1 2 3\n4 5 6\n", "a.xyz", ProbedKind::Format(Format::Delimited)),
            (b"Dear reader,\nthere is nothing here\n", "a.txt", ProbedKind::UnknownText),
            (b"# Notes\n\nFirst, read this:\n\n1. eat\n2. sleep\n", "a.md", ProbedKind::UnknownText),
            // The reader reports what is missing.
            (b"Name;Phase\nwater;liquid\n", "A.CSV", ProbedKind::Format(Format::Delimited)),
            (b"plyx\nformat ascii 1.0\nelement vertex 0\nend_header\n", "a.ply", ProbedKind::UnknownText),
            (b"Dear reader\n", "a", ProbedKind::UnknownText),
            (b"0\n\n1\n\nO 1 2 3\n", "a.xyz", ProbedKind::Format(Format::XyzAtoms)),
            (b"0\nstep 1\n0\n\n", "a.xyz", ProbedKind::Format(Format::XyzAtoms)),
            (b"0\n0.5\n", "a.dat", ProbedKind::UnknownText),
            (b"0\nstep 1\nother text\n", "a.dat", ProbedKind::UnknownText),
            (b"\xff\xfex\0,\0y\0,\0z\0\n\0", "a.csv", ProbedKind::Format(Format::Delimited)),
            (b"\xfe\xff\0{\0}", "a.json", ProbedKind::Foreign("UTF-16 text: save it as UTF-8")),
            (
                b"[Name]\nWater\n\n[Data]\nX [ m ], Y [ m ], Z [ m ]\n1,2,3\n",
                "a.csv",
                ProbedKind::Format(Format::Delimited),
            ),
            (b"[watch]\n\ninput = 1\n", "a.toml", ProbedKind::UnknownText),
            (
                b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n",
                "a.ply",
                ProbedKind::Foreign(GIT_LFS),
            ),
            (b"VERSION .7\nFIELDS x y z\n", "a.pcd", ProbedKind::Format(Format::Pcd)),
            (b"<?xml version=\"1.0\" ?>\n<Xdmf Version=\"3.0\">", "a", ProbedKind::Format(Format::Xdmf)),
            (b"\x89HDF\r\n\x1a\n\0", "a", ProbedKind::Format(Format::Hdf5)),
            (abc::HDF5, "a.abc", ProbedKind::Format(Format::Abc)),
            (b"PK\x03\x04", "a.npz", ProbedKind::Format(Format::Npz)),
            (b"PK\x03\x04", "a.zip", ProbedKind::Foreign(ZIP)),
            (&[&[0; TAR_OFFSET][..], b"ustar\0"].concat(), "a.tar", ProbedKind::Foreign(TAR)),
            (b"7z\xbc\xaf\x27\x1c\0\x04", "a.7z", ProbedKind::Foreign(SEVEN_ZIP)),
            (b"Rar!\x1a\x07\x01\0", "a.rar", ProbedKind::Foreign(RAR)),
            (b"\xfd7zXZ\0\0\x04", "a.ply.xz", ProbedKind::Foreign(XZ)),
            (b"BZh91AY&SY", "a.ply.bz2", ProbedKind::Foreign(BZIP2)),
            (
                b"PK\x03\x04\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x05\0\0\0a.npy",
                "a",
                ProbedKind::Format(Format::Npz),
            ),
            (b"\x00\x00\x80\x3f\x00\x00\x80\x3f", "a.xyz", ProbedKind::Unknown),
            (b"\x00\x00\x80\x3f\x00\x00\x80\x3f", "a.bin", ProbedKind::Unknown),
            (b"\xff", "a", ProbedKind::UnknownText),
            (b"\x1f\x8b", "a.bgeo", ProbedKind::Empty),
            (b"\x28\xb5\x2f\xfd", "a.bgeo", ProbedKind::Empty),
        ];
        for (bytes, name, kind) in table {
            let found = probe(bytes, name);
            assert_eq!(found.kind, *kind, "of {:?} as {name}", String::from_utf8_lossy(bytes));
        }
    }

    #[test]
    fn only_particle_tables_look_like_particles() {
        let table: &[(&[u8], &str, bool)] = &[
            (b"Things to do, in this order:\n1. eat\n2. sleep, or x, y and z\n", "notes.txt", false),
            (b"the x y z positions are wrong\nsee below\n", "notes.txt", false),
            (b"step 10\nstep 20\n", "run.log", false),
            (b"10\n20\n", "run.log", false),
            (b"t, residual\n0.1, 2e-3\n", "run.csv", false),
            (b"import os, sys\nx, y, z = 1, 2, 3\n", "sim.py", false),
            (b"# x y z\nprint(1)\n", "sim.py", false),
            (b"{\"x\": [1, 2, 3]}", "settings.json", false),
            (b"{\"camera\": {\"position\": [[1, 2, 3]]}, \"position\": [1, 2, 3]}", "scene.json", false),
            (b"{\"position\": [0, 0, 5], \"weights\": [1, 2], \"name\": \"a\"}", "settings.json", false),
            (b"[]", "a.json", false),
            (b"[1, 2, 3]", "a.json", false),
            (b"[[1, 2], [3, 4]]", "a.json", false),
            (b"[[1, 0, 0, 0], [0, 1, 0, 0]]", "matrix.json", false),
            (b"[\"a\", \"b\"]", "names.json", false),
            (b"[{\"id\": 0, \"img_name\": \"1\", \"position\": [1, 2, 3]}]", "cameras.json", false),
            (b"[\n{ \"rank\": 0, \"start\": \"Sat\", \"threads\": 1 }]", "profiling.json", false),
            (b"{\"y\": [1], \"z\": [2], \"x\": [3]", "a.json", true),
            (b"[[1, 2, 3], [4, ", "a.json", true),
            (b"[[1, 2, 3], [4, 5, 6]] more", "a.json", false),
            (b"[{\"x\": 1, \"y\": 2, \"z\": 3, \"v\": [0, 0, 0]}, {\"x\"", "a.json", true),
            (b"{\"time\": 0.5, \"particles\": [[1, 2, 3]]}", "a.json", true),
            (b"{\"positions\": [1, 2, 3, 4, 5, 6]}", "a.json", true),
            (b"{\"fluid\": {}, \"points\": [[1, 2, 3]]}", "a.json", true),
            (b"v 1 2 3\nv 4 5 6\n", "points.obj", true),
            (b"v 1 2 3\nv 4 5 6\nv 7 8 8\nf 1 2 3\n", "mesh.obj", false),
            (b"by hand\n2 atoms\n1 atom types\n\nAtoms\n\n1 1 0.5 0.5 0.5\n", "a.data", false),
            (b"", "empty.csv", false),
            (b"x,y,z\n", "a.csv", true),
            (b"# x y z", "a.xyz", true),
            (b"type;x;y;z\nwater;1,5;2,5;3,5\n", "a.csv", true), // the reader reports what is wrong
            (b"# made by hand\n\n\"x\",\"y\",\"z\",\r\n1,2,nan,\r\n", "a.txt", true),
            (b"1 2 3\n", "a", true),
            (b"1\t2\t3", "a.log", true),
            (b"ITEM: TIMESTEP\n0\nITEM: ATOMS id type x y z\n1 1 0.5 0.5 0.5\n", "a.dump", true),
            (b"1\nhelium\nHe 0.5 0.5 0.5\n", "a.xyz", true),
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
        // The positions, or the rest of them, are beyond the head.
        for (start, expected) in [
            ("{\"velocities\": [[0.5, 1, 2]", true),
            ("{\"id\": [1", true),
            ("{\"x\": [1", true),
            ("{\"loss\": [1", false),
            ("{\"max\": [1", false),
        ] {
            let more = if start.ends_with(']') { ", [0.5, 1, 2]" } else { ", 2.5" };
            let text = start.to_owned() + &more.repeat(1000);
            assert_eq!(looks_like_particles(text.as_bytes(), "a.json"), expected, "of {start}");
        }
    }
}
