//! Writes a triangle mesh as OBJ text.
//!
//! Numbers are the shortest decimals that parse back to the same value. Lines are formatted in parallel, a
//! range of elements per task, and written in order. The last line is a comment with the element counts,
//! because nothing else in the format distinguishes a complete file from a truncated one. The only vertex
//! attribute that can be stored is the colour. It follows the position, an unofficial extension that most
//! readers support.
//!
//! ```text
//!   batch 0: header │ batch 1: v v ‥ v vn ‥ vn │ batch 2: vn ‥ vn f ‥ f │ f ‥ f, last line
//!                              └┴ one task each, up to 8192 lines
//! ```
//!
//! Each batch can be encoded independently, so the writer need not hold the whole text.

use std::ops::Range;

use rayon::prelude::*;

use super::FORMAT;
use crate::data::{MeshView, Provenance, VertexAttribute};
use crate::error::Result;
use crate::mesh_options::MeshOptions;
use crate::provenance::{GENERATOR, comments};
use crate::quads::{Face, check_quads, faces, quad_count};
use crate::vertex_attributes::{Purpose, clamp_note, purposes};

/// Elements formatted per task.
const ELEMENTS_PER_TASK: usize = 1 << 13;
/// Tasks per batch. The writer holds the text of one batch at a time.
const TASKS_AT_ONCE: usize = 64;

/// The beginning of the last line.
const LAST_LINE: &str = "# end: ";

/// The number of batches for a mesh.
pub(super) fn batch_count(mesh: &MeshView, _options: &MeshOptions) -> usize {
    1 + task_counts(mesh).iter().sum::<usize>().div_ceil(TASKS_AT_ONCE).max(1)
}

/// Encodes a batch: positions, with colours if there are any, normals and faces. If the mesh has an
/// origin, adds it to the positions in 64 bits. Does not convert axes.
///
/// # Errors
///
/// [`crate::Error::Invalid`], for the first batch, if the mesh is inconsistent or not finite, or if two
/// triangles marked as a quad do not form one.
pub(super) fn encode_batch(
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

/// The number of tasks for positions, normals and triangles.
fn task_counts(mesh: &MeshView) -> [usize; 3] {
    [mesh.positions.len(), mesh.normals.len(), mesh.triangles.len()]
        .map(|count| count.div_ceil(ELEMENTS_PER_TASK))
}

/// The lines of one task.
fn text_of(mesh: &MeshView, quads: &[bool], task: usize) -> Vec<u8> {
    let [position_tasks, normal_tasks, _] = task_counts(mesh);
    if position_tasks + normal_tasks <= task {
        let task = task - position_tasks - normal_tasks;
        if !quads.is_empty() {
            return faces_of(mesh.triangles, quads, task);
        }
        return lines_of(run_of(mesh.triangles, task), |line, triangle| line.face(triangle));
    }
    if position_tasks <= task {
        return lines_of(run_of(mesh.normals, task - position_tasks), |line, normal| {
            line.reals("vn", *normal)
        });
    }
    let positions = run_of(mesh.positions, task);
    let Some(color) = colors_of(mesh) else {
        return match mesh.origin {
            [0.0, 0.0, 0.0] => lines_of(positions, |line, position| line.reals("v", *position)),
            origin => lines_of(positions, |line, position| line.reals("v", world(origin, position))),
        };
    };
    let vertices: Vec<(&[f32; 3], [f32; 3])> =
        positions.iter().zip(task * ELEMENTS_PER_TASK..).map(|(p, vertex)| (p, color(vertex))).collect();
    lines_of(&vertices, |line, (position, color)| {
        match mesh.origin {
            [0.0, 0.0, 0.0] => line.reals_open("v", **position),
            origin => line.reals_open("v", world(origin, position)),
        }
        line.reals("", *color);
    })
}

fn world(origin: [f64; 3], position: &[f32; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| origin[axis] + f64::from(position[axis]))
}

/// Returns a function that gives red, green and blue of a vertex, clamped to 0 to 1, the only range that
/// readers support; `None` if there is no colour.
fn colors_of<'a>(mesh: &MeshView<'a>) -> Option<impl Fn(usize) -> [f32; 3] + 'a> {
    let found =
        purposes(mesh.attributes).into_iter().zip(mesh.attributes).find_map(|(purpose, attribute)| {
            match purpose {
                Purpose::Color(values) => Some((values, attribute.arity)),
                Purpose::Velocity | Purpose::Acceleration | Purpose::Other => None,
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
                let opaque = values.chunks_exact(*arity).flat_map(|color| &color[..3]);
                notes.extend(clamp_note(name, opaque, "the .obj"));
            }
            Purpose::Velocity | Purpose::Acceleration | Purpose::Other => {
                notes.push(format!("{name} is missing in the .obj, which can only store colours"));
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
fn faces_of(triangles: &[[u32; 3]], quads: &[bool], task: usize) -> Vec<u8> {
    let faces: Vec<Face> = faces(triangles, quads, range_of(triangles.len(), task)).collect();
    lines_of(&faces, |line, face| line.face(face.corners()))
}

/// Whether the last bytes of a file are those of a complete file of this writer.
pub(crate) fn ends_as_written(tail: &[u8]) -> bool {
    let Some(lines) = tail.strip_suffix(b"\n") else { return false };
    let start = lines.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
    lines[start..].starts_with(LAST_LINE.as_bytes())
}

/// Text under construction, with a buffer for formatting numbers.
struct LineWriter {
    text: Vec<u8>,
    real: zmij::Buffer,
    integer: itoa::Buffer,
}

impl LineWriter {
    /// Appends a line, or the rest of one.
    fn reals<T: zmij::Float>(&mut self, keyword: &str, numbers: [T; 3]) {
        self.reals_open(keyword, numbers);
        self.text.push(b'\n');
    }

    /// Appends numbers without ending the line.
    fn reals_open<T: zmij::Float>(&mut self, keyword: &str, numbers: [T; 3]) {
        self.text.extend_from_slice(keyword.as_bytes());
        for number in numbers {
            let digits = self.real.format_finite(number);
            self.text.push(b' ');
            self.text.extend_from_slice(digits.strip_suffix(".0").unwrap_or(digits).as_bytes());
        }
    }

    /// Appends a face. Vertex numbers start at one; each vertex has the normal with the same number.
    fn face(&mut self, corners: &[u32]) {
        self.text.push(b'f');
        for &index in corners {
            let digits = self.integer.format(u64::from(index) + 1).as_bytes();
            self.text.push(b' ');
            self.text.extend_from_slice(digits);
            self.text.extend_from_slice(b"//");
            self.text.extend_from_slice(digits);
        }
        self.text.push(b'\n');
    }
}

/// Formats one line per element.
fn lines_of<T>(elements: &[T], format: impl Fn(&mut LineWriter, &T)) -> Vec<u8> {
    const LINE_BYTES: usize = 48; // few lines are longer
    let text = Vec::with_capacity(elements.len() * LINE_BYTES);
    let mut lines = LineWriter { text, real: zmij::Buffer::new(), integer: itoa::Buffer::new() };
    elements.iter().for_each(|element| format(&mut lines, element));
    lines.text
}
