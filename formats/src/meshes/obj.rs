//! Wavefront OBJ: reads and writes meshes as text.

use std::io::{self, BufRead, Read};
use std::ops::Range;

use rayon::prelude::*;

use crate::core::data::{MeshData, MeshView, Provenance, VertexAttribute, VertexValues, world};
use crate::core::error::{Error, Position, Result};
use crate::core::options::{MeshOptions, WriteOption};
use crate::core::provenance::{GENERATOR, comments, from_comments};
use crate::core::row::{Content, FormatRow, Integrity, MeshEncoder, MeshWriter, OutputRow, ParticleReader};
use crate::core::text::{NumberWriter, ends_with_line, excerpt};
use crate::core::vertex_attributes::{Face, Purpose, check_quads, clamp_note, faces, purposes, quad_count};
use crate::meshes::obj_points;

/// The format's name in errors.
pub(crate) const FORMAT: &str = "OBJ";

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        particles: Some(ParticleReader::new(obj_points::read)),
        read_mesh: Some(|bytes, _, _| read_mesh(bytes)),
        ..FormatRow::new(FORMAT, &["obj"])
    },
    help: "Wavefront OBJ",
    content: Content::Mesh(MeshWriter {
        attribute_notes,
        ..MeshWriter::new(MeshEncoder::Batches { count: batch_count, encode: encode_batch })
    }),
    write_particles: None,
    has_attributes: false,
    options: &[WriteOption::Quads],
    read_provenance: |head| Ok(from_comments(head, "# ")),
    integrity: Integrity::Tail(|tail| ends_with_line(tail, LAST_LINE)),
};

// Writes a triangle mesh as OBJ text.
//
// Numbers are the shortest decimals that parse back to the same value. Lines are formatted in parallel, a
// range of elements per task, and written in order. The last line is a comment with the element counts,
// because nothing else in the format distinguishes a complete file from a truncated one. The only vertex
// attributes that can be stored are texture coordinates and the colour. It follows the position, an unofficial
// extension that most readers support.
//
//   batch 0: header │ batch 1: v v ‥ v vt ‥ vt vn ‥ vn │ batch 2: vn ‥ vn f ‥ f │ f ‥ f, last line
//                              └┴ one task each, up to 8192 lines
//
// Each batch can be encoded independently, so the writer need not hold the whole text.

/// Elements formatted per task.
const ELEMENTS_PER_TASK: usize = 1 << 13;
/// Tasks per batch. The writer holds the text of one batch at a time.
const TASKS_AT_ONCE: usize = 64;

/// The beginning of the last line.
const LAST_LINE: &str = "# end: ";

/// The number of batches for a mesh.
fn batch_count(mesh: &MeshView, _options: &MeshOptions) -> usize {
    1 + task_counts(mesh).iter().sum::<usize>().div_ceil(TASKS_AT_ONCE).max(1)
}

/// Encodes a batch: positions, with colours if there are any, normals and faces. If the mesh has an
/// origin, adds it to the positions in 64 bits. Does not convert axes.
///
/// # Errors
///
/// [`crate::Error::Invalid`], for the first batch, if the mesh is inconsistent or not finite, or if two
/// triangles marked as a quad do not form one.
fn encode_batch(
    mesh: &MeshView,
    options: &MeshOptions,
    provenance: &Provenance,
    index: usize,
) -> Result<Vec<Vec<u8>>> {
    let Some(index) = index.checked_sub(1) else {
        mesh.check(FORMAT)?;
        check_quads(FORMAT, mesh.triangles, &options.quads)?;
        let name = options.name.replace(char::is_control, "_");
        let header = format!("# {GENERATOR}\n{}o {name}\n", comments(provenance, "# "));
        return Ok(vec![header.into_bytes()]);
    };
    let task_count = task_counts(mesh).iter().sum();
    let first = index.saturating_mul(TASKS_AT_ONCE).min(task_count);
    let end = (first + TASKS_AT_ONCE).min(task_count);
    let mut texts: Vec<Vec<u8>> =
        (first..end).into_par_iter().map(|task| text_of(mesh, &options.quads, task)).collect();
    if end == task_count {
        let quads = quad_count(&options.quads);
        let (vertices, triangles) = (mesh.positions.len(), mesh.triangles.len() - 2 * quads);
        let quads = if quads > 0 { format!(", {quads} quads") } else { String::new() };
        texts.push(format!("{LAST_LINE}{vertices} vertices, {triangles} triangles{quads}\n").into_bytes());
    }
    Ok(texts)
}

/// The number of tasks for positions, texture coordinates, normals and triangles.
fn task_counts(mesh: &MeshView) -> [usize; 4] {
    let texture = texture_of(mesh).map_or(0, <[_]>::len);
    [mesh.positions.len(), texture, mesh.normals.len(), mesh.triangles.len()]
        .map(|count| count.div_ceil(ELEMENTS_PER_TASK))
}

/// The lines of one task.
fn text_of(mesh: &MeshView, quads: &[bool], task: usize) -> Vec<u8> {
    let [position_tasks, texture_tasks, normal_tasks, _] = task_counts(mesh);
    let texture = texture_of(mesh);
    if let Some(task) = task.checked_sub(position_tasks + texture_tasks + normal_tasks) {
        return faces_of(mesh.triangles, texture.is_some(), quads, task);
    }
    if let Some(task) = task.checked_sub(position_tasks + texture_tasks) {
        return lines_of(run_of(mesh.normals, task), |line, normal| line.reals("vn", *normal));
    }
    if let (Some(task), Some(texture)) = (task.checked_sub(position_tasks), texture) {
        return lines_of(run_of(texture, task), |line, row| line.reals("vt", *row));
    }
    let positions = run_of(mesh.positions, task);
    let Some(color) = colors_of(mesh) else {
        return match mesh.origin {
            [0.0, 0.0, 0.0] => lines_of(positions, |line, position| line.reals("v", *position)),
            origin => lines_of(positions, |line, position| line.reals("v", world(origin, *position))),
        };
    };
    let vertices: Vec<(&[f32; 3], [f32; 3])> =
        positions.iter().zip(task * ELEMENTS_PER_TASK..).map(|(p, vertex)| (p, color(vertex))).collect();
    lines_of(&vertices, |line, (position, color)| {
        match mesh.origin {
            [0.0, 0.0, 0.0] => line.reals_open("v", **position),
            origin => line.reals_open("v", world(origin, **position)),
        }
        line.reals("", *color);
    })
}

/// The texture coordinates of the vertices; `None` without texture coordinates.
fn texture_of<'a>(mesh: &MeshView<'a>) -> Option<&'a [[f32; 2]]> {
    let found = purposes(mesh.attributes).into_iter().position(|purpose| purpose == Purpose::Texture)?;
    match mesh.attributes[found].values {
        VertexValues::Numbers(values) => Some(values.as_chunks().0),
        VertexValues::Integers(_) | VertexValues::Strings { .. } => None,
    }
}

/// Returns a function that gives red, green and blue of a vertex, clamped to 0 to 1, the only range that
/// readers support; `None` if there is no colour.
fn colors_of<'a>(mesh: &MeshView<'a>) -> Option<impl Fn(usize) -> [f32; 3] + 'a> {
    let found =
        purposes(mesh.attributes).into_iter().zip(mesh.attributes).find_map(|(purpose, attribute)| {
            match purpose {
                Purpose::Color(values) => Some((values, attribute.arity)),
                Purpose::Velocity | Purpose::Acceleration | Purpose::Texture | Purpose::Other => None,
            }
        });
    let (values, arity) = found?;
    let channel_of = move |vertex: usize, channel: usize| -> f32 { values[vertex * arity + channel] };
    Some(move |vertex| std::array::from_fn(|channel| channel_of(vertex, channel).clamp(0.0, 1.0)))
}

/// Notes on vertex attributes that an OBJ file cannot store exactly.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let mut notes = Vec::new();
    for (VertexAttribute { name, arity, .. }, purpose) in attributes.iter().zip(purposes(attributes)) {
        match purpose {
            Purpose::Color(values) => {
                if *arity == 4 {
                    notes.push(format!("the alpha of {name} is missing in the .obj"));
                }
                let channels = values.chunks_exact(*arity).flat_map(|color| &color[..3]);
                notes.extend(clamp_note(name, channels, "the .obj"));
            }
            Purpose::Texture => {}
            Purpose::Velocity | Purpose::Acceleration | Purpose::Other => {
                notes.push(format!(
                    "{name} is missing in the .obj, which can only store colours and one set of texture coordinates"
                ));
            }
        }
    }
    notes
}

/// The elements of one task.
fn run_of<T>(elements: &[T], task: usize) -> &[T] {
    &elements[range_of(elements.len(), task)]
}

/// The index range of one task.
fn range_of(count: usize, task: usize) -> Range<usize> {
    let start = (task * ELEMENTS_PER_TASK).min(count);
    start..(start + ELEMENTS_PER_TASK).min(count)
}

/// The face lines of one task, including quads.
fn faces_of(triangles: &[[u32; 3]], has_texture: bool, quads: &[bool], task: usize) -> Vec<u8> {
    let faces: Vec<Face> = faces(triangles, quads, range_of(triangles.len(), task)).collect();
    lines_of(&faces, |line, face| line.face(face.corners(), has_texture))
}

impl NumberWriter {
    /// Writes a line with a keyword and some numbers.
    fn reals<T: zmij::Float, const N: usize>(&mut self, keyword: &str, numbers: [T; N]) {
        self.reals_open(keyword, numbers);
        self.text.push(b'\n');
    }

    /// Writes a keyword and some numbers, without the end of the line.
    fn reals_open<T: zmij::Float, const N: usize>(&mut self, keyword: &str, numbers: [T; N]) {
        self.text.extend_from_slice(keyword.as_bytes());
        for number in numbers {
            self.text.push(b' ');
            self.real(number);
        }
    }

    /// Writes a face whose corners have the same index as their normals and their texture coordinates, if any.
    fn face(&mut self, corners: &[u32], has_texture: bool) {
        self.text.push(b'f');
        for &index in corners {
            self.text.push(b' ');
            self.integer(u64::from(index) + 1);
            self.text.push(b'/');
            if has_texture {
                self.integer(u64::from(index) + 1);
            }
            self.text.push(b'/');
            self.integer(u64::from(index) + 1);
        }
        self.text.push(b'\n');
    }
}

/// Formats one line per element.
fn lines_of<T>(elements: &[T], format: impl Fn(&mut NumberWriter, &T)) -> Vec<u8> {
    const LINE_BYTES: usize = 48; // few lines are longer
    let mut lines = NumberWriter::with_capacity(elements.len() * LINE_BYTES);
    elements.iter().for_each(|element| format(&mut lines, element));
    lines.text
}

// Reads the triangles of an OBJ file, using the crate tobj on normalised lines.

/// Reads all objects of a file as one mesh. Polygons become triangle fans; materials and textures are
/// ignored. Normals are kept if every corner has one.
///
/// # Errors
///
/// [`Error::Invalid`], with the line, if the text is not valid OBJ.
pub fn read_mesh(bytes: &[u8]) -> Result<MeshData> {
    let options =
        tobj::LoadOptions { triangulate: true, single_index: true, ignore_points: true, ignore_lines: true };
    let invalid = |what: String| Error::invalid(FORMAT, Position::File, what);
    let too_many = || Error::too_large(FORMAT, "the mesh has more than 2³² vertices");
    let no_materials = |_: &std::path::Path| Ok(Default::default());
    let mut lines = MeshLines::new(bytes);
    // tobj drops vertices that no face uses, so the mesh consists of its faces.
    let (models, _) = tobj::load_obj_buf(&mut lines, &options, no_materials).map_err(|error| {
        let (line, what) = lines.position();
        Error::invalid(FORMAT, Position::Line(line), what.unwrap_or_else(|| error.to_string()))
    })?;
    let mut mesh = MeshData::default();
    let mut has_normals = true;
    for model in models {
        let part = model.mesh;
        let first = u32::try_from(mesh.positions.len());
        let (Ok(first), Ok(count)) = (first, u32::try_from(part.positions.len() / 3)) else {
            return Err(too_many());
        };
        if first.checked_add(count).is_none() {
            return Err(too_many());
        }
        if part.indices.iter().any(|&index| index >= count) {
            return Err(invalid("a face has a vertex that does not exist".into()));
        }
        has_normals &= part.normals.len() == part.positions.len();
        mesh.positions.extend_from_slice(part.positions.as_chunks::<3>().0);
        #[expect(clippy::cast_possible_truncation, reason = "normals are kept in 32 bits")]
        mesh.normals.extend(part.normals.as_chunks::<3>().0.iter().map(|normal| normal.map(|c| c as f32)));
        mesh.triangles.extend(part.indices.as_chunks::<3>().0.iter().map(|face| face.map(|i| first + i)));
    }
    if !has_normals {
        mesh.normals.clear();
    }
    Ok(mesh)
}

// Extracts the lines of an OBJ file that define a mesh, and normalises them.
//
// This adapter sits between the file and the tobj crate, which parses the result:
//
//   in the file               for the parser
//   v 1 2 3 0.5 0.5 0.5       v 1 2 3              vertex colours are dropped
//   vt 0 1                                         dropped, as are materials, objects, groups, comments
//   f 1/1/1 2/2/2 \           f 1//1 2//2 3//3     a continued line is joined
//   3/3/3
//
// This module checks indices, because relative indices can only be resolved at their line, and so that an
// error can name the line. It ignores text that is not valid UTF-8, which old programs write into names.

/// The normalised lines, as the parser sees them.
struct MeshLines<'a> {
    rest: &'a [u8],
    /// The current line.
    line: Vec<u8>,
    /// Number of bytes of the current line that the parser has consumed.
    read: usize,
    line_number: u64,
    vertex_count: u64,
    normal_count: u64,
    /// Forward references, to vertices and to normals: their lines and indices. Only those larger than all before are
    /// kept, which are enough to find the first that exceeds the final count.
    awaited: [Vec<(u64, u64)>; 2],
    is_at_end: bool,
    /// The error in the current line.
    error: Option<String>,
}

impl<'a> MeshLines<'a> {
    fn new(text: &'a [u8]) -> MeshLines<'a> {
        MeshLines {
            rest: text,
            line: Vec::new(),
            read: 0,
            line_number: 0,
            vertex_count: 0,
            normal_count: 0,
            awaited: [Vec::new(), Vec::new()],
            is_at_end: false,
            error: None,
        }
    }

    /// The line number of an error, starting at 1, and its message if this module found the error. The line
    /// is the last line read or, at the end of the file, the first with an unresolved forward reference.
    fn position(&mut self) -> (u64, Option<String>) {
        if !self.is_at_end {
            return (self.line_number, self.error.take());
        }
        let [vertices, normals] = &self.awaited;
        let first = |awaited: &[(u64, u64)], count: u64, kind: &'static str| {
            let beyond = awaited.iter().find(|(_, number)| *number > count);
            beyond.map(|(line, number)| {
                (*line, format!("a face refers to {kind} {number}, but the file has only {count}"))
            })
        };
        let vertex = first(vertices, self.vertex_count, "vertex");
        let normal = first(normals, self.normal_count, "normal");
        let missing = vertex.into_iter().chain(normal).min_by_key(|(line, _)| *line);
        missing.map_or((self.line_number, None), |(line, what)| (line, Some(what)))
    }

    /// Prepares the next line; false at the end.
    fn advance(&mut self) -> io::Result<bool> {
        self.read = 0;
        self.line.clear();
        if self.rest.is_empty() {
            self.is_at_end = true;
            return Ok(false);
        }
        self.line_number += 1;
        let text = self.take_line();
        if let Err(what) = self.prepare(&text) {
            self.error = Some(what);
            return Err(io::ErrorKind::InvalidData.into());
        }
        self.line.push(b'\n');
        Ok(true)
    }

    /// Takes the next line, including its continuation lines.
    fn take_line(&mut self) -> Vec<u8> {
        let mut text = Vec::new();
        loop {
            let end = self.rest.iter().position(|&byte| byte == b'\n');
            let (line, rest) = self.rest.split_at(end.map_or(self.rest.len(), |end| end + 1));
            self.rest = rest;
            let line = line.trim_ascii();
            // A comment is not continued: it may end with the path of a folder.
            let is_comment = line.split(u8::is_ascii_whitespace).any(|word| word.starts_with(b"#"));
            match line.strip_suffix(b"\\") {
                Some(start) if !rest.is_empty() && !is_comment => {
                    text.extend_from_slice(start);
                    text.push(b' ');
                    self.line_number += 1;
                }
                _ => {
                    text.extend_from_slice(line);
                    return text;
                }
            }
        }
    }

    fn prepare(&mut self, text: &[u8]) -> std::result::Result<(), String> {
        let mut words = text
            .split(u8::is_ascii_whitespace)
            .filter(|word| !word.is_empty())
            .take_while(|word| !word.starts_with(b"#"));
        let keyword = words.next().unwrap_or_default();
        match keyword {
            b"v" => {
                self.vertex_count += 1;
                self.numbers("v", words)
            }
            b"vn" => {
                self.normal_count += 1;
                self.numbers("vn", words)
            }
            b"f" => {
                self.line.push(b'f');
                words.try_for_each(|corner| self.corner(corner))
            }
            _ => Ok(()),
        }
    }

    /// Appends the three numbers of a position or normal. Drops a weight or a colour after them.
    fn numbers<'t>(
        &mut self,
        keyword: &str,
        words: impl Iterator<Item = &'t [u8]>,
    ) -> std::result::Result<(), String> {
        self.line.extend_from_slice(keyword.as_bytes());
        for word in words.take(3) {
            if !word.is_ascii() {
                return Err(format!("`{}` is not a number", excerpt(word)));
            }
            self.line.push(b' ');
            self.line.extend_from_slice(word);
        }
        Ok(())
    }

    /// Appends the corner of a face: its vertex and, if present, its normal.
    fn corner(&mut self, corner: &[u8]) -> std::result::Result<(), String> {
        let mut parts = corner.split(|&byte| byte == b'/');
        let vertex = index(parts.next().unwrap_or_default(), self.vertex_count, corner)?;
        await_element(&mut self.awaited[0], self.line_number, vertex, self.vertex_count);
        self.line.push(b' ');
        self.line.extend_from_slice(vertex.to_string().as_bytes());
        let normal = parts.nth(1).filter(|normal| !normal.is_empty());
        if let Some(normal) = normal {
            let normal = index(normal, self.normal_count, corner)?;
            await_element(&mut self.awaited[1], self.line_number, normal, self.normal_count);
            self.line.extend_from_slice(format!("//{normal}").as_bytes());
        }
        Ok(())
    }
}

/// Records a forward reference if it is larger than all recorded ones.
fn await_element(awaited: &mut Vec<(u64, u64)>, line: u64, number: u64, count: u64) {
    if number > count && awaited.last().is_none_or(|(_, most)| number > *most) {
        awaited.push((line, number));
    }
}

/// Converts an index to one that counts from 1. A negative index counts backwards from the last element
/// before the line. Only the end of the file shows whether the element exists: see [`MeshLines::position`].
fn index(text: &[u8], count: u64, corner: &[u8]) -> std::result::Result<u64, String> {
    let wrong = || {
        format!(
            "a face has an invalid corner `{}`: expected a nonzero index, such as 3, 3//3 or -1",
            excerpt(corner)
        )
    };
    let number: i64 = std::str::from_utf8(text).ok().and_then(|text| text.parse().ok()).ok_or_else(wrong)?;
    let index = match number {
        ..0 => count.checked_sub(number.unsigned_abs()).map(|before| before + 1),
        _ => u64::try_from(number).ok(),
    };
    index.filter(|index| (1..=u64::from(u32::MAX)).contains(index)).ok_or_else(wrong)
}

impl Read for MeshLines<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let mut line = self.fill_buf()?;
        let count = line.read(out)?;
        self.consume(count);
        Ok(count)
    }
}

impl BufRead for MeshLines<'_> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        if self.read == self.line.len() {
            self.advance()?;
        }
        Ok(&self.line[self.read..])
    }

    fn consume(&mut self, count: usize) {
        self.read = (self.read + count).min(self.line.len());
    }
}
