//! Writes the mesh of one frame.
//!
//! ```text
//!   batch 0: head │ batch 1: points .. │ batch 2: points .. normals .. │ .. last line
//!                            └───┴ one task each
//! ```
//!
//! As in other text formats, each batch can be encoded independently, so the writer need not hold the whole
//! text. A 64-bit translation stores the mesh's origin, and the layer stores the up axis; vertices are
//! written unchanged.

use rayon::prelude::*;

use crate::data::{MeshView, Provenance};
use crate::error::Result;
use crate::mesh_options::MeshOptions;
use crate::quads::{check_quads, quad_count};
use crate::usd::{
    Elements, FORMAT, LayerInfo, MeshProperty, PropertyValue, SAMPLE_CODE, SampledProperty, properties,
};
use crate::vertex_attributes::plain_name;

use super::head::{LAST_LINE, head, quoted};
use super::numbers::triple;

/// Number of tasks whose text is held at a time.
const TASKS_AT_ONCE: usize = 64;

/// The number of batches for a layer with one mesh.
pub(super) fn batch_count(mesh: &MeshView, options: &MeshOptions) -> usize {
    1 + tasks(&sections(mesh, options)).len().div_ceil(TASKS_AT_ONCE)
}

/// Encodes a batch.
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
    if !options.time_samples {
        return Vec::new();
    }
    let varying =
        properties(mesh, &options.quads, true).into_iter().filter(|property| !property.is_uniform());
    varying.map(|MeshProperty { kind, name, .. }| SampledProperty { kind, name }).collect()
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
        let MeshProperty { kind, name, is_per_vertex, element_size, .. } = property;
        let uniform = if property.is_uniform() { "uniform " } else { "" };
        let about = about(*is_per_vertex, *element_size);
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
            PropertyValue::Strings(table) => {
                let distinct: Vec<String> =
                    table.iter().map(|text| quoted(text)).chain([quoted("")]).collect();
                format!("[{}]", distinct.join(", "))
            }
        };
        PropertyText { open: before + &value + &after, elements: None, close: String::new() }
    }
}

/// The metadata of a property in parentheses, preceded by a space; empty if it has none.
pub(super) fn about(is_per_vertex: bool, element_size: usize) -> String {
    if !is_per_vertex {
        return String::new();
    }
    let size = match element_size {
        1 => String::new(),
        size => format!("            elementSize = {size}\n"),
    };
    format!(" (\n{size}            interpolation = \"vertex\"\n        )")
}

fn sections<'a>(mesh: &MeshView<'a>, options: &'a MeshOptions) -> Vec<PropertyText<'a>> {
    let mut sections = Vec::new();
    for property in &properties(mesh, &options.quads, options.time_samples) {
        sections.push(PropertyText::of(property));
        if options.time_samples && !property.is_uniform() {
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
