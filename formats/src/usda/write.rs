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
//!
//! ```text
//!   velocity   velocities, for motion blur     colour     primvars:displayColor, displayOpacity
//!   others     primvars:name, vectors of up to four           integers   int, or int64 if a value needs it
//!   strings    primvars:name, the distinct strings, and primvars:name:indices
//! ```

use rayon::prelude::*;

use crate::data::{MeshView, Provenance, VertexAttribute, VertexValues};
use crate::error::Result;
use crate::mesh_options::MeshOptions;
use crate::quads::{check_quads, quad_count};
use crate::vertex_attributes::{Purpose, UsedNames, plain_name, purposes};

use super::FORMAT;
use super::arrays::Elements;
use super::head::{LAST_LINE, LayerInfo, head, quoted};
use super::numbers::triple;

/// Number of tasks whose text is held at a time.
const TASKS_AT_ONCE: usize = 64;

/// The widest vector type.
const TUPLE_MAX: usize = 4;

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
        let head = head(provenance, &info, (options.up, options.meters_per_unit), "");
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

/// A property of the prim.
struct PropertyText<'a> {
    open: String,
    elements: Option<Elements<'a>>,
    close: String,
}

impl<'a> PropertyText<'a> {
    /// A single-line property.
    fn line(text: String) -> PropertyText<'a> {
        PropertyText { open: format!("        {text}\n"), elements: None, close: String::new() }
    }

    /// A property with a value per vertex or face.
    fn array(name: &str, elements: Elements<'a>, about: &str) -> PropertyText<'a> {
        let about = if about.is_empty() { String::new() } else { format!(" (\n{about}        )") };
        PropertyText {
            open: format!("        {name} = ["),
            elements: Some(elements),
            close: format!("]{about}\n"),
        }
    }
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

const OF_VERTICES: &str = "            interpolation = \"vertex\"\n";

fn sections<'a>(mesh: &MeshView<'a>, options: &'a MeshOptions) -> Vec<PropertyText<'a>> {
    let (triangles, quads) = (mesh.triangles, &*options.quads);
    let mut sections = Vec::new();
    if let Some([low, high]) = extent(mesh) {
        sections.push(PropertyText::line(format!("float3[] extent = [{}, {}]", triple(low), triple(high))));
    }
    sections.extend([
        PropertyText::array("int[] faceVertexCounts", Elements::FaceCounts { triangles, quads }, ""),
        PropertyText::array("int[] faceVertexIndices", Elements::FaceCorners { triangles, quads }, ""),
        PropertyText::array(
            "normal3f[] normals",
            Elements::reals(mesh.normals.as_flattened(), 3),
            OF_VERTICES,
        ),
        PropertyText::line("uniform token orientation = \"rightHanded\"".to_owned()),
        PropertyText::array("point3f[] points", Elements::reals(mesh.positions.as_flattened(), 3), ""),
    ]);
    for (attribute, place) in mesh.attributes.iter().zip(properties(mesh.attributes)) {
        sections.extend(of_attribute(attribute, &place));
    }
    sections.push(PropertyText::line("uniform token subdivisionScheme = \"none\"".to_owned()));
    if mesh.origin != [0.0; 3] {
        sections.push(PropertyText::line(format!("double3 xformOp:translate = {}", triple(mesh.origin))));
        sections
            .push(PropertyText::line("uniform token[] xformOpOrder = [\"xformOp:translate\"]".to_owned()));
    }
    sections
}

/// The minimum and maximum corner; `None` without vertices.
fn extent(mesh: &MeshView) -> Option<[[f32; 3]; 2]> {
    let first = *mesh.positions.first()?;
    Some(mesh.positions.iter().fold([first, first], |[low, high], position| {
        [
            std::array::from_fn(|axis| low[axis].min(position[axis])),
            std::array::from_fn(|axis| high[axis].max(position[axis])),
        ]
    }))
}

/// The property that an attribute is written to.
enum UsdProperty {
    Velocities,
    Color,
    Primvar(String),
}

/// Names with a meaning for renderers.
pub(super) const RESERVED: [&str; 3] = ["displayColor", "displayOpacity", "normals"];

/// The property of each attribute.
fn properties(attributes: &[VertexAttribute]) -> Vec<UsdProperty> {
    let mut taken = UsedNames::new(&RESERVED);
    let place = |(attribute, purpose): (&VertexAttribute, Purpose)| match purpose {
        Purpose::Velocity => UsdProperty::Velocities,
        Purpose::Color(_) => UsdProperty::Color,
        Purpose::Other => UsdProperty::Primvar(
            taken.take(&identifier(attribute.name), |stem| vec![stem.to_owned()]).concat(),
        ),
    };
    attributes.iter().zip(purposes(attributes)).map(place).collect()
}

/// A valid USD identifier for a name.
pub(super) fn identifier(name: &str) -> String {
    let plain = plain_name(name);
    if plain.starts_with(|c: char| c.is_ascii_digit()) { format!("_{plain}") } else { plain }
}

/// Notes on vertex attributes that are renamed in a .usda file.
pub fn attribute_notes(attributes: &[VertexAttribute]) -> Vec<String> {
    let renamed =
        attributes.iter().zip(properties(attributes)).filter_map(|(attribute, place)| match place {
            UsdProperty::Primvar(name) if name != attribute.name => {
                Some(format!("{} is named primvars:{name} in the .usda", attribute.name))
            }
            _ => None,
        });
    renamed.collect()
}

fn of_attribute<'a>(attribute: &VertexAttribute<'a>, place: &UsdProperty) -> Vec<PropertyText<'a>> {
    let arity = attribute.arity;
    match (place, attribute.values) {
        (UsdProperty::Velocities, VertexValues::Numbers(values)) => {
            vec![PropertyText::array("vector3f[] velocities", Elements::reals(values, 3), "")]
        }
        (UsdProperty::Color, VertexValues::Numbers(values)) => {
            let part = |first, arity| Elements::Reals { values, stride: attribute.arity, first, arity };
            let mut sections =
                vec![PropertyText::array("color3f[] primvars:displayColor", part(0, 3), OF_VERTICES)];
            if arity == 4 {
                sections.push(PropertyText::array(
                    "float[] primvars:displayOpacity",
                    part(3, 1),
                    OF_VERTICES,
                ));
            }
            sections
        }
        (UsdProperty::Primvar(name), VertexValues::Strings { table, indices }) => {
            strings(name, arity, table, indices)
        }
        (UsdProperty::Primvar(name), VertexValues::Integers(values)) => {
            let is_narrow = values.iter().all(|&value| i32::try_from(value).is_ok());
            let width = if is_narrow && arity <= TUPLE_MAX { arity } else { 1 };
            let kind = if is_narrow { vector("int", width) } else { "int64".to_owned() };
            vec![primvar(&kind, name, Elements::Integers { values, arity: width }, arity / width)]
        }
        (UsdProperty::Primvar(name), VertexValues::Numbers(values)) => {
            let width = if arity <= TUPLE_MAX { arity } else { 1 };
            vec![primvar(&vector("float", width), name, Elements::reals(values, width), arity / width)]
        }
        // Velocities and colours are always numbers, so strings never get here.
        (UsdProperty::Velocities | UsdProperty::Color, _) => Vec::new(),
    }
}

fn vector(kind: &str, width: usize) -> String {
    if width == 1 { kind.to_owned() } else { format!("{kind}{width}") }
}

/// A primvar; each vertex has `element_size` values of the array.
fn primvar<'a>(kind: &str, name: &str, elements: Elements<'a>, element_size: usize) -> PropertyText<'a> {
    PropertyText::array(&format!("{kind}[] primvars:{name}"), elements, &about(element_size))
}

fn about(element_size: usize) -> String {
    match element_size {
        1 => OF_VERTICES.to_owned(),
        size => format!("            elementSize = {size}\n{OF_VERTICES}"),
    }
}

/// The distinct strings, with an empty one at the end for missing strings, and the index of each value.
fn strings<'a>(name: &str, arity: usize, table: &'a [String], indices: &'a [i32]) -> Vec<PropertyText<'a>> {
    let distinct: Vec<String> = table.iter().map(|text| quoted(text)).chain([quoted("")]).collect();
    let (values, about) = (distinct.join(", "), about(arity));
    vec![
        PropertyText::line(format!("string[] primvars:{name} = [{values}] (\n{about}        )")),
        PropertyText::array(
            &format!("int[] primvars:{name}:indices"),
            Elements::Strings { table, indices },
            "",
        ),
    ]
}
