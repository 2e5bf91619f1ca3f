//! USD as text, `.usda`: writes meshes, of one frame or of a sequence as time samples.
//!
//! ```text
//!   #usda 1.0
//!   (
//!       customLayerData = { dictionary meniscus = { string radius = "0.025" .. } .. }     provenance
//!           for a stage, also dictionary meniscus_samples: the properties that have time samples
//!       defaultPrim, metersPerUnit, upAxis; for a sequence, its time codes
//!   )
//!   def Xform "root"
//!       def Mesh "surface"
//!   {
//!       int[] faceVertexCounts = [3, 3, ..]        or  int[] faceVertexCounts.timeSamples = { 1: [3, ..], 2: [..] }
//!       point3f[] points = [(0.5, 1, 2), ..]
//!       ..
//!   }
//!   # end: 642 vertices, 1280 faces
//! ```
//!
//! Every program that reads USD reads its text form; the [binary form](crate::usdc) takes a quarter to a
//! third of the size. A sequence is one file with a single mesh, whose attributes all have a sample per
//! frame, so it is easy to move and can be replaced atomically. A [stage](UsdStage) is the alternative: a
//! file that lists those of the frames, which may still be arriving.

mod head;
mod parse;
mod stage;

use std::io::{self, Read, Seek, Write};
use std::ops::Range;

use rayon::prelude::*;

pub use crate::usd::{LayerInfo, SampledProperty};
pub use head::{read_layer_info, read_sampled_properties, read_times};
pub(crate) use parse::{read_array, read_layer};
pub use stage::{ClipFile, StageClips, UsdStage, stage_text};

use crate::data::{MeshView, ParticleFrame, Provenance};
use crate::error::Result;
use crate::gltf::SequenceFrame;
use crate::narrow_points::{NarrowPoints, not_finite_notes};
use crate::options::{MeshOptions, WriteOption};
use crate::row::{Content, FormatRow, Integrity, MeshEncoder, MeshWriter, OutputRow};
use crate::sequence_points::SequencePoints;
use crate::text::{NumberWriter, ends_with_line};
use crate::usd::mesh::read_alone;
use crate::usd::points::READER;
use crate::usd::{
    Elements, FORMAT, MeshProperty, POINTS_KIND, POINTS_PRIM, PRIM, PropertyValue, SAMPLE_CODE,
    SEQUENCE_POINTS_PRIM, SequenceAttribute, TRANSLATE, UsdSequence, UsdSequencePoints, attribute_of,
    point_properties, properties, renamed,
};
use crate::vertex_attributes::{check_quads, faces, plain_name, quad_count, string_index};
pub(crate) use head::read_provenance;
use head::{LAST_LINE, head, quoted, times};

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
        let info = LayerInfo { vertices, faces, frames: None };
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
            PropertyValue::StringTable(table) => format!("[{}]", distinct(table)),
        };
        PropertyText { open: before + &value + &after, elements: None, close: String::new() }
    }
}

/// The elements of the table of an indexed primvar.
fn distinct(table: &[String]) -> String {
    let distinct: Vec<String> = table.iter().map(|text| quoted(text)).chain([quoted("")]).collect();
    distinct.join(", ")
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

// Writes a sequence as one mesh whose attributes have a sample per frame.
//
//   point3f[] points.timeSamples = {
//       1001: [(0.5, 1, 2), ..],
//       1002: [..],
//   }
//
// The samples of an attribute are contiguous, so the writer visits all frames once per attribute. From the
// files of the frames, which are `.glb` files of this crate, it reads only the required data. At any time,
// only one attribute of one frame and its text are in memory.
//
// USD allows samples with different numbers of vertices, and holds such a sample until the next. If the next
// frame has the same number of vertices, the sample is repeated just before it, so that USD does not blend
// them.

/// Writes a sequence of frames, whose numbers become the time codes and must increase, and the points beside
/// their meshes. `open` opens the file of the frame with the given index. Returns notes on attributes that are
/// omitted because the frames differ in them.
///
/// # Errors
///
/// [`Error::Io`](crate::Error::Io) if a file cannot be read or `out` fails;
/// [`Error::Invalid`](crate::Error::Invalid) if a document is damaged, numbers do not increase, or frames
/// differ in their up axis; those of reading the points; [`Error::Unsupported`](crate::Error::Unsupported) for numbers beyond 2⁵³.
pub fn write_sequence<R: Read + Seek>(
    frames: &[SequenceFrame],
    points: Option<&SequencePoints>,
    (fps, meters_per_unit): (f64, f64),
    provenance: &Provenance,
    open: impl Fn(usize) -> io::Result<R>,
    out: &mut impl Write,
) -> Result<Vec<String>> {
    let shot = UsdSequence::of(frames, points.is_some())?;
    let info = shot.layer_info()?;
    let (attributes, mut notes) = shot.attributes()?;
    let head = head(
        provenance,
        (Some(&info), &[]),
        (shot.placement.up, meters_per_unit),
        &times(shot.code_range(), fps),
    );
    write!(out, "{head}    def Mesh \"{PRIM}\"\n    {{\n")?;

    let extent = |index| Ok((extent_text(shot.extent(index)?), shot.held_codes(index)));
    write_lines("float3[] extent", 0..frames.len(), out, extent)?;
    write_samples(&shot, "int[] faceVertexCounts", out, |index| {
        let triangles = vec![[0; 3]; frames[index].file.triangle_count()?];
        Ok(Elements::FaceCounts { triangles: &triangles, quads: &[] }.texts())
    })?;
    let mut triangles = Vec::new();
    write_samples(&shot, "int[] faceVertexIndices", out, |index| {
        frames[index].file.read_triangles(&mut open(index)?, &mut triangles)?;
        Ok(Elements::FaceCorners { triangles: &triangles, quads: &[] }.texts())
    })?;
    out.write_all(b"        uniform token orientation = \"rightHanded\"\n")?;
    let mut values = Vec::new();
    for attribute in &attributes {
        let SequenceAttribute { semantic, kind, name, first, arity, interpolation } = attribute;
        if interpolation.is_some() {
            writeln!(out, "        {kind} {name}{}", about(*interpolation, 1))?;
        }
        write_samples(&shot, &format!("{kind} {name}"), out, |index| {
            let (frame, shift) = (&frames[index].file, shot.shift(index)?);
            let found = frame.read_attribute(semantic, shift, &mut open(index)?, &mut values)?;
            let Some(stride) = found else { return Ok(Vec::new()) };
            Ok(Elements::Reals { values: &values, stride, first: *first, arity: *arity }.texts())
        })?;
    }
    out.write_all(b"        uniform token subdivisionScheme = \"none\"\n")?;
    write_origin(shot.origin(), out)?;
    out.write_all(b"    }\n")?;
    let mut counted = String::new();
    if let Some(points) = points.map(|points| UsdSequencePoints::of(&shot, points)) {
        write_points(&points, out)?;
        notes.extend_from_slice(points.notes());
        counted = format!(", {} points", points.total());
    }
    let (count, vertices, faces) = (frames.len(), info.vertices, info.faces);
    write!(out, "}}\n\n{LAST_LINE}{count} frames, {vertices} vertices, {faces} faces{counted}\n")?;
    Ok(notes)
}

/// Writes the prim of the points beside the meshes, whose properties have a sample per frame, like those of the mesh.
fn write_points(points: &UsdSequencePoints, out: &mut impl Write) -> Result<()> {
    write!(out, "\n    def {POINTS_KIND} \"{SEQUENCE_POINTS_PRIM}\"\n    {{\n")?;
    let extent = |index| Ok((extent_text(points.extent(index)), points.held_codes(index)));
    write_lines("float3[] extent", points.frames(), out, extent)?;
    points.with_template(|properties| {
        for (place, MeshProperty { kind, name, interpolation, element_size, .. }) in
            properties.iter().enumerate()
        {
            if interpolation.is_some() {
                writeln!(out, "        {kind} {name}{}", about(*interpolation, *element_size))?;
            }
            write_arrays(&format!("{kind} {name}"), points.frames(), out, |index| {
                let texts = points.with_properties(index, |properties| Ok(texts_of(&properties[place])))?;
                Ok((texts, points.point_codes(index)))
            })?;
        }
        Ok(())
    })?;
    write_origin(points.origin(), out)?;
    Ok(out.write_all(b"    }\n")?)
}

/// The text of the elements of a property with a value per point, in pieces.
fn texts_of(property: &MeshProperty) -> Vec<Vec<u8>> {
    match &property.value {
        PropertyValue::Array(elements) => elements.texts(),
        PropertyValue::StringTable(table) => vec![distinct(table).into_bytes()],
        // Points have no others.
        _ => Vec::new(),
    }
}

fn extent_text([low, high]: [[f32; 3]; 2]) -> String {
    format!("[{}, {}]", triple(low), triple(high))
}

/// Writes the translation to the origin, if there is one.
fn write_origin(origin: Option<[f64; 3]>, out: &mut impl Write) -> Result<()> {
    if let Some(origin) = origin {
        writeln!(out, "        double3 {TRANSLATE} = {}", triple(origin))?;
        writeln!(out, "        uniform token[] xformOpOrder = [\"{TRANSLATE}\"]")?;
    }
    Ok(())
}

/// The end of the line before the samples of a property.
const SAMPLES: &str = ".timeSamples = {";

/// The names of the vertex attributes of a sequence of this crate, except normals and those of points.
pub fn read_attribute_names(bytes: &[u8]) -> Vec<String> {
    let name = |line: &[u8]| {
        let property = line.strip_suffix(SAMPLES.as_bytes())?;
        let (_, name) = std::str::from_utf8(property).ok()?.rsplit_once(' ')?;
        Some(attribute_of(name)?.to_owned())
    };
    let lines = bytes.split(|&byte| byte == b'\n');
    let of_mesh =
        lines.skip_while(|line| !line.starts_with(b"    def Mesh ")).take_while(|line| *line != b"    }");
    of_mesh.filter_map(name).collect()
}

/// Writes an array with samples of each frame, formatted by `texts`; they are empty for a frame without a
/// mesh.
fn write_samples(
    shot: &UsdSequence,
    name: &str,
    out: &mut impl Write,
    mut texts: impl FnMut(usize) -> Result<Vec<Vec<u8>>>,
) -> Result<()> {
    write_arrays(name, 0..shot.frames.len(), out, |index| {
        let texts = if shot.frames[index].file.has_mesh() { texts(index)? } else { Vec::new() };
        Ok((texts, shot.vertex_codes(index)))
    })
}

/// Writes an array with samples of each frame: its text in pieces, at these time codes.
fn write_arrays<C: Iterator<Item = f64>>(
    name: &str,
    frames: Range<usize>,
    out: &mut impl Write,
    mut texts: impl FnMut(usize) -> Result<(Vec<Vec<u8>>, C)>,
) -> Result<()> {
    writeln!(out, "        {name}{SAMPLES}")?;
    for index in frames {
        let (texts, codes) = texts(index)?;
        for code in codes {
            write!(out, "            {code}: [")?;
            texts.iter().try_for_each(|text| out.write_all(text))?;
            out.write_all(b"],\n")?;
        }
    }
    out.write_all(b"        }\n")?;
    Ok(())
}

/// Writes a property with a line for each sample: its text, at the time codes of each frame.
fn write_lines<C: Iterator<Item = f64>>(
    name: &str,
    frames: Range<usize>,
    out: &mut impl Write,
    line: impl Fn(usize) -> Result<(String, C)>,
) -> Result<()> {
    writeln!(out, "        {name}{SAMPLES}")?;
    for index in frames {
        let (line, codes) = line(index)?;
        for code in codes {
            writeln!(out, "            {code}: {line},")?;
        }
    }
    out.write_all(b"        }\n")?;
    Ok(())
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

    /// The text of all elements, in pieces.
    fn texts(&self) -> Vec<Vec<u8>> {
        (0..self.task_count()).into_par_iter().map(|task| self.text_of(task)).collect()
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
