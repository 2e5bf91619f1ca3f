//! USD as text, `.usda`: writes the mesh of a frame, and stages.
//!
//! ```text
//!   #usda 1.0
//!   (
//!       customLayerData = { dictionary meniscus = { string radius = "0.025" .. } .. }     provenance
//!           for a stage, also dictionary meniscus_samples: the properties that have time samples
//!       defaultPrim, metersPerUnit, upAxis
//!   )
//!   def Xform "root"
//!       def Mesh "surface"
//!   {
//!       int[] faceVertexCounts = [3, 3, ..]        for a stage, also int[] faceVertexCounts.timeSamples = { 0: [3, ..] }
//!       point3f[] points = [(0.5, 1, 2), ..]
//!       ..
//!   }
//!   # end: 642 vertices, 1280 faces
//! ```
//!
//! Every program that reads USD reads its text form; the [binary form](crate::usd::usdc) takes a quarter to a
//! third of the size. A [stage](UsdStage) lists the files of the frames, which may still be arriving.

mod head;
mod parse;
mod stage;

use std::io::Write;
use std::ops::Range;

use rayon::prelude::*;

pub use crate::usd::{LayerInfo, SampledProperty};
pub use head::{read_layer_info, read_sampled_properties, read_times};
pub(crate) use parse::{read_array, read_layer};
pub use stage::{ClipFile, StageClips, UsdStage, stage_text};

use crate::core::data::{MeshView, ParticleFrame, Provenance};
use crate::core::error::Result;
use crate::core::narrow_points::{NarrowPoints, not_finite_notes};
use crate::core::options::{MeshOptions, WriteOption};
use crate::core::row::{Content, FormatRow, Integrity, MeshEncoder, MeshWriter, OutputRow};
use crate::core::text::{NumberWriter, ends_with_line};
use crate::core::vertex_attributes::{check_quads, faces, plain_name, quad_count, string_index};
use crate::usd::mesh::read_alone;
use crate::usd::points::READER;
use crate::usd::{
    Elements, FORMAT, MeshProperty, POINTS_KIND, POINTS_PRIM, PropertyValue, SAMPLE_CODE, point_properties,
    properties, renamed,
};
pub(crate) use head::read_provenance;
use head::{LAST_LINE, head, quoted};

/// The row in the table of formats.
pub(crate) static ROW: OutputRow = OutputRow {
    format: FormatRow {
        signatures: &[b"#usda"],
        beginnings: &[b"#usda"],
        particles: Some(READER),
        read_mesh: Some(read_alone),
        ..FormatRow::new("USD text", &["usda"])
    },
    help: "USD as text",
    content: Content::Mesh(MeshWriter {
        attribute_notes: |attributes| renamed(attributes, "usda"),
        ..MeshWriter::new(MeshEncoder::Batches { count: batch_count, encode: encode_batch })
    }),
    write_particles: None,
    has_attributes: true,
    options: &[WriteOption::Quads, WriteOption::Up, WriteOption::MetersPerUnit, WriteOption::TimeSamples],
    read_provenance,
    integrity: Integrity::Tail(|tail| ends_with_line(tail, LAST_LINE)),
};

// Writes the mesh of one frame.
//
//   batch 0: head │ batch 1: points .. │ batch 2: points .. normals .. │ .. last line
//                            └───┴ one task each
//
// As in other text formats, each batch can be encoded independently, so the writer need not hold the whole
// text. A 64-bit translation stores the mesh's origin, and the layer stores the up axis; vertices are
// written unchanged.

/// Number of tasks whose text is held at a time.
const TASKS_AT_ONCE: usize = 64;

/// The number of batches for a layer with one mesh.
fn batch_count(mesh: &MeshView, options: &MeshOptions) -> usize {
    1 + tasks(&sections(mesh, options)).len().div_ceil(TASKS_AT_ONCE)
}

/// Encodes a batch.
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
    let vertices = mesh.positions.len() as u64;
    let faces = (mesh.triangles.len() - quad_count(&options.quads).min(mesh.triangles.len())) as u64;
    let Some(index) = index.checked_sub(1) else {
        mesh.check(FORMAT)?;
        check_quads(FORMAT, mesh.triangles, &options.quads)?;
        let info = LayerInfo { vertices, faces };
        let name = plain_name(&options.name);
        let sampled = sampled_properties(mesh, options);
        let head = head(provenance, (Some(&info), &sampled), (options.up, options.meters_per_unit), "");
        return Ok(vec![format!("{head}    def Mesh \"{name}\"\n    {{\n").into_bytes()]);
    };
    let sections = sections(mesh, options);
    let tasks = tasks(&sections);
    let first = index.saturating_mul(TASKS_AT_ONCE).min(tasks.len());
    let end = (first + TASKS_AT_ONCE).min(tasks.len());
    let mut texts: Vec<Vec<u8>> = tasks[first..end].par_iter().map(|task| task.text(&sections)).collect();
    if end == tasks.len() {
        texts.push(format!("    }}\n}}\n\n{LAST_LINE}{vertices} vertices, {faces} faces\n").into_bytes());
    }
    Ok(texts)
}

/// The properties that are also written as time samples.
fn sampled_properties(mesh: &MeshView, options: &MeshOptions) -> Vec<SampledProperty> {
    if options.time_samples { varying(properties(mesh, &options.quads, true)) } else { Vec::new() }
}

/// Those of the properties that can have time samples.
fn varying(properties: Vec<MeshProperty>) -> Vec<SampledProperty> {
    let varying = properties.into_iter().filter(|property| !property.is_uniform());
    varying.map(|MeshProperty { kind, name, .. }| SampledProperty { kind, name }).collect()
}

// Writes points.

/// Writes particles as a prim of the type `Points`.
///
/// # Errors
///
/// [`crate::Error::Io`] if `out` fails; [`crate::Error::Invalid`] if an attribute has the wrong number of values, or a
/// position is not finite.
pub fn write_particles(
    frame: &ParticleFrame,
    options: &MeshOptions,
    provenance: &Provenance,
    out: &mut dyn Write,
) -> Result<()> {
    let points = NarrowPoints::of(frame, FORMAT)?;
    let others = points.others();
    let has_samples = options.time_samples;
    let properties = point_properties(&points, &others, has_samples);
    let sections = sections_of(&properties, has_samples);
    let texts = tasks(&sections);
    let sampled = if has_samples { varying(properties) } else { Vec::new() };
    let head = head(provenance, (None, &sampled), (options.up, options.meters_per_unit), "");
    write!(out, "{head}    def {POINTS_KIND} \"{POINTS_PRIM}\"\n    {{\n")?;
    for tasks in texts.chunks(TASKS_AT_ONCE) {
        let texts: Vec<Vec<u8>> = tasks.par_iter().map(|task| task.text(&sections)).collect();
        texts.iter().try_for_each(|text| out.write_all(text))?;
    }
    write!(out, "    }}\n}}\n\n{LAST_LINE}{} points\n", points.positions.len())?;
    Ok(())
}

/// Notes on attributes that a file does not hold exactly.
pub fn particle_notes(frame: &ParticleFrame) -> Vec<String> {
    notes_of_points(frame, "usda")
}

/// Notes on attributes that a file with this extension does not hold exactly.
pub(crate) fn notes_of_points(frame: &ParticleFrame, extension: &str) -> Vec<String> {
    let points = NarrowPoints::of(frame, FORMAT);
    let renamed = points.map(|points| renamed(&points.others(), extension)).unwrap_or_default();
    renamed.into_iter().chain(not_finite_notes(frame, extension)).collect()
}

/// The text of a property.
struct PropertyText<'a> {
    open: String,
    elements: Option<Elements<'a>>,
    close: String,
}

impl<'a> PropertyText<'a> {
    /// The declaration of a property, with its default.
    fn of(property: &MeshProperty<'a>) -> PropertyText<'a> {
        let MeshProperty { kind, name, interpolation, element_size, .. } = property;
        let uniform = if property.is_uniform() { "uniform " } else { "" };
        let about = about(*interpolation, *element_size);
        PropertyText::between(format!("        {uniform}{kind} {name} = "), property, format!("{about}\n"))
    }

    /// The same value as a time sample.
    fn sample_of(property: &MeshProperty<'a>) -> PropertyText<'a> {
        let MeshProperty { kind, name, .. } = property;
        let open = format!("        {kind} {name}.timeSamples = {{\n            {SAMPLE_CODE}: ");
        PropertyText::between(open, property, ",\n        }\n".to_owned())
    }

    /// The value of a property between two texts.
    fn between(before: String, property: &MeshProperty<'a>, after: String) -> PropertyText<'a> {
        let value = match &property.value {
            PropertyValue::Array(elements) => {
                let (open, close) = (before + "[", "]".to_owned() + &after);
                return PropertyText { open, elements: Some(*elements), close };
            }
            PropertyValue::Extent([low, high]) => format!("[{}, {}]", triple(*low), triple(*high)),
            PropertyValue::Double3(values) => triple(*values),
            PropertyValue::Token(word) => format!("\"{word}\""),
            PropertyValue::TokenList(word) => format!("[\"{word}\"]"),
            PropertyValue::StringTable(table) => {
                let distinct: Vec<String> =
                    table.iter().map(|text| quoted(text)).chain([quoted("")]).collect();
                format!("[{}]", distinct.join(", "))
            }
        };
        PropertyText { open: before + &value + &after, elements: None, close: String::new() }
    }
}

/// The metadata of a property in parentheses, preceded by a space; empty if it has none.
fn about(interpolation: Option<&str>, element_size: usize) -> String {
    let Some(interpolation) = interpolation else { return String::new() };
    let size = match element_size {
        1 => String::new(),
        size => format!("            elementSize = {size}\n"),
    };
    format!(" (\n{size}            interpolation = \"{interpolation}\"\n        )")
}

fn sections<'a>(mesh: &MeshView<'a>, options: &'a MeshOptions) -> Vec<PropertyText<'a>> {
    sections_of(&properties(mesh, &options.quads, options.time_samples), options.time_samples)
}

fn sections_of<'a>(properties: &[MeshProperty<'a>], has_samples: bool) -> Vec<PropertyText<'a>> {
    let mut sections = Vec::new();
    for property in properties {
        sections.push(PropertyText::of(property));
        if has_samples && !property.is_uniform() {
            sections.push(PropertyText::sample_of(property));
        }
    }
    sections
}

/// A range of elements of a section.
struct TextTask {
    section: usize,
    run: usize,
    is_last: bool,
}

impl TextTask {
    fn text(&self, sections: &[PropertyText]) -> Vec<u8> {
        let PropertyText { open, elements, close } = &sections[self.section];
        let mut text = if self.run == 0 { open.clone().into_bytes() } else { Vec::new() };
        if let Some(elements) = elements {
            text.append(&mut elements.text_of(self.run));
        }
        if self.is_last {
            text.extend_from_slice(close.as_bytes());
        }
        text
    }
}

fn tasks(sections: &[PropertyText]) -> Vec<TextTask> {
    let runs_of = |(section, PropertyText { elements, .. }): (usize, &PropertyText)| {
        let count = elements.map_or(1, |elements| elements.task_count().max(1));
        (0..count).map(move |run| TextTask { section, run, is_last: run + 1 == count })
    };
    sections.iter().enumerate().flat_map(runs_of).collect()
}

// Formats arrays as text in chunks: `(0.5, 1, 2), (0.25, 1, 2), ..`.

/// Number of elements formatted per task.
const ELEMENTS_PER_TASK: usize = 1 << 13;

impl Elements<'_> {
    /// The number of elements; for faces, the number of triangles.
    fn count(&self) -> usize {
        match self {
            Elements::Reals { values, stride, .. } => values.len() / stride,
            Elements::Integers { values, arity, .. } => values.len() / arity,
            Elements::StringIndices { indices, .. } => indices.len(),
            Elements::FaceCounts { triangles, .. } | Elements::FaceCorners { triangles, .. } => {
                triangles.len()
            }
        }
    }

    /// The number of tasks for all elements.
    fn task_count(&self) -> usize {
        self.count().div_ceil(ELEMENTS_PER_TASK)
    }

    /// The text of one task.
    fn text_of(&self, task: usize) -> Vec<u8> {
        const ELEMENT_BYTES: usize = 40; // few are longer
        let start = (task * ELEMENTS_PER_TASK).min(self.count());
        let range = start..(start + ELEMENTS_PER_TASK).min(self.count());
        let mut numbers = NumberWriter::with_capacity(range.len() * ELEMENT_BYTES);
        self.append(range, &mut numbers);
        // A separator precedes each element, except the first one of the array.
        match task {
            0 => numbers.text.split_off(SEPARATOR_BYTES.min(numbers.text.len())),
            _ => numbers.text,
        }
    }

    fn append(&self, range: Range<usize>, numbers: &mut NumberWriter) {
        match *self {
            Elements::Reals { values, stride, first, arity } => {
                for element in values[range.start * stride..range.end * stride].chunks_exact(stride) {
                    numbers.separate();
                    numbers.tuple(&element[first..first + arity], NumberWriter::real);
                }
            }
            Elements::Integers { values, arity, .. } => {
                for element in values[range.start * arity..range.end * arity].chunks_exact(arity) {
                    numbers.separate();
                    numbers.tuple(element, NumberWriter::integer);
                }
            }
            Elements::StringIndices { table, indices } => {
                for &index in &indices[range] {
                    numbers.separate();
                    let index = usize::try_from(string_index(index, table)).unwrap_or(table.len());
                    numbers.integer(index);
                }
            }
            Elements::FaceCounts { triangles, quads } => {
                for face in faces(triangles, quads, range) {
                    numbers.separate();
                    numbers.integer(face.corners().len());
                }
            }
            Elements::FaceCorners { triangles, quads } => {
                for &corner in
                    faces(triangles, quads, range).collect::<Vec<_>>().iter().flat_map(|face| face.corners())
                {
                    numbers.separate();
                    numbers.integer(corner);
                }
            }
        }
    }
}

/// Length in bytes of the text that [`NumberWriter::separate`] writes.
const SEPARATOR_BYTES: usize = 2;

// Formats numbers as array values.

impl NumberWriter {
    /// Appends one number, or several in parentheses.
    fn tuple<T: Copy>(&mut self, values: &[T], mut number: impl FnMut(&mut NumberWriter, T)) {
        if let [value] = values {
            return number(self, *value);
        }
        self.text.push(b'(');
        for (index, value) in values.iter().enumerate() {
            if index > 0 {
                self.separate();
            }
            number(self, *value);
        }
        self.text.push(b')');
    }

    /// Appends the separator of values.
    fn separate(&mut self) {
        self.text.extend_from_slice(b", ");
    }
}

/// Formats three numbers as a tuple.
fn triple<T: zmij::Float + Copy>(values: [T; 3]) -> String {
    let mut numbers = NumberWriter::with_capacity(48);
    numbers.tuple(&values, NumberWriter::real);
    String::from_utf8(numbers.text).unwrap_or_default() // digits and signs
}
