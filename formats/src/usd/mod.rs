//! USD: what the text form and the binary form have in common. For the writers, the content of a mesh; for the
//! readers, [layers](layer), the [stage](composed) of several, and its [particles](points) and [meshes](mesh).
//!
//! ```text
//!   def Xform "root"
//!       def Mesh "surface"
//!           extent, faceVertexCounts, faceVertexIndices, normals, orientation, points,
//!           velocities, accelerations, primvars:NAME .., subdivisionScheme, xformOp:translate
//! ```

pub(crate) mod composed;
pub(crate) mod layer;
pub(crate) mod mesh;
pub(crate) mod package;
mod place;
pub(crate) mod points;
#[cfg(test)]
mod tests;
pub mod usda;
pub mod usdc;

use crate::core::data::{MeshView, VertexAttribute, VertexValues, bounds_of};
use crate::core::narrow_points::NarrowPoints;
use crate::core::provenance::are_points;
use crate::core::vertex_attributes::{Purpose, UsedNames, plain_name, purposes};

/// The format's name in errors.
pub(crate) const FORMAT: &str = "USD";

/// The root prim. It is the `defaultPrim` of the layer: a reference to the layer that names no prim refers to
/// this one.
pub(crate) const ROOT: &str = "root";

/// The name of the mesh.
pub(crate) const PRIM: &str = "surface";

/// The name of the points beside a mesh.
pub(crate) const POINTS_PRIM: &str = "spray";

/// The type of the prims of points.
pub(crate) const POINTS_KIND: &str = "Points";

/// The property with the origin of the mesh.
pub(crate) const TRANSLATE: &str = "xformOp:translate";

/// Properties for motion blur, sampled at the times of the points.
pub(crate) const VELOCITIES: &str = "velocities";
pub(crate) const ACCELERATIONS: &str = "accelerations";

/// The suffix in the name of the property that has the indices of an indexed primvar.
pub(crate) const INDICES: &str = ":indices";

/// The time code of the samples in the file of a frame. It is the same in the files of all frames: a stage
/// maps the times of the shot to it.
pub(crate) const SAMPLE_CODE: u64 = 0;

/// The name of the vertex attribute in a property; `None` for other properties.
pub(crate) fn attribute_of(property: &str) -> Option<&str> {
    match property.strip_prefix("primvars:") {
        Some(name) => Some(name).filter(|name| !name.ends_with(INDICES)),
        None => Some(property).filter(|name| [VELOCITIES, ACCELERATIONS].contains(name)),
    }
}

/// Whether a layer has a mesh and no points, judged by its first bytes: this crate wrote it, or it is a text in
/// which a mesh comes first.
pub(crate) fn declares_mesh(head: &[u8]) -> bool {
    let contains = |word: &[u8]| head.windows(word.len()).any(|part| part == word);
    let (is_ours, recorded) = match head {
        [b'#', ..] => (contains(b"dictionary meniscus = {"), crate::usd::usda::read_provenance(head)),
        _ => {
            let has_comment = |rest: &[u8]| rest.starts_with(b"# ") || rest.starts_with(b"end_header\n");
            (head.get(88..).is_some_and(has_comment), crate::usd::usdc::read_provenance(head))
        }
    };
    let has_points = are_points(&recorded.unwrap_or_default());
    !has_clips(head)
        && (is_ours && !has_points
            || head.starts_with(b"#usda") && contains(b"def Mesh ") && !contains(b"def Points "))
}

/// Whether a text has value clips, judged by its first bytes: what it shows is in other layers, which are not read.
pub(crate) fn has_clips(head: &[u8]) -> bool {
    head.starts_with(b"#usda") && head.windows(9).any(|part| part == b"clips = {")
}

/// A property of a mesh that has time samples. A [stage](crate::usd::usda::UsdStage) declares these properties.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SampledProperty {
    /// Its type in USD, such as `point3f[]`.
    pub kind: String,
    /// Its name, such as `points` or `primvars:id`.
    pub name: String,
}

impl SampledProperty {
    /// A property from a file; `None` if the texts are not a type and a name. The file may be damaged, and
    /// stages repeat the texts.
    pub(crate) fn checked(kind: &str, name: &str) -> Option<SampledProperty> {
        let has_only = |text: &str, others: &str| {
            !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || others.contains(c))
        };
        let is_valid = has_only(kind, "[]") && has_only(name, "_:");
        is_valid.then(|| SampledProperty { kind: kind.to_owned(), name: name.to_owned() })
    }
}

/// A summary of the content of a file that this crate wrote.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LayerInfo {
    /// Number of vertices.
    pub vertices: u64,
    /// Number of faces.
    pub faces: u64,
}

/// The elements of an array.
#[derive(Clone, Copy)]
pub(crate) enum Elements<'a> {
    /// `arity` numbers starting at `first` in each group of `stride`.
    Reals { values: &'a [f32], stride: usize, first: usize, arity: usize },
    Integers {
        values: &'a [i64],
        arity: usize,
        /// Whether all values fit into 32 bits; otherwise the array has 64-bit values.
        is_narrow: bool,
    },
    /// Indices into a table of strings; a missing string gets the index after the last one.
    StringIndices { table: &'a [String], indices: &'a [i32] },
    /// The number of corners of each face.
    FaceCounts { triangles: &'a [[u32; 3]], quads: &'a [bool] },
    /// The vertex indices of the faces' corners.
    FaceCorners { triangles: &'a [[u32; 3]], quads: &'a [bool] },
}

impl<'a> Elements<'a> {
    /// Vectors of `arity` numbers each.
    pub(crate) fn reals(values: &'a [f32], arity: usize) -> Elements<'a> {
        Elements::Reals { values, stride: arity, first: 0, arity }
    }
}

/// A property of the prim.
pub(crate) struct MeshProperty<'a> {
    /// Its type in USD, such as `point3f[]`.
    pub(crate) kind: String,
    pub(crate) name: String,
    pub(crate) value: PropertyValue<'a>,
    /// Its interpolation, if it needs one.
    pub(crate) interpolation: Option<&'static str>,
    /// Number of elements of the array per vertex.
    pub(crate) element_size: usize,
}

/// The interpolation that the property with this name needs: the schema has it for points, velocities and accelerations,
/// and other properties than those of [`properties_of`] have none.
fn interpolation(name: &str) -> Option<&'static str> {
    let is_per_vertex = name == "normals" || name.starts_with("primvars:") && !name.ends_with(INDICES);
    is_per_vertex.then_some("vertex")
}

/// The value of a property.
pub(crate) enum PropertyValue<'a> {
    Array(Elements<'a>),
    /// The minimum and maximum corner.
    Extent([[f32; 3]; 2]),
    Double3([f64; 3]),
    /// A token with uniform variability.
    Token(&'static str),
    /// A list of one token, with uniform variability.
    TokenList(&'static str),
    /// The table of an indexed primvar, to which the writer adds an empty string for missing values.
    StringTable(&'a [String]),
}

impl<'a> MeshProperty<'a> {
    fn new(kind: &str, name: &str, value: PropertyValue<'a>) -> MeshProperty<'a> {
        MeshProperty {
            kind: kind.to_owned(),
            name: name.to_owned(),
            value,
            interpolation: interpolation(name),
            element_size: 1,
        }
    }

    fn array(kind: &str, name: &str, elements: Elements<'a>) -> MeshProperty<'a> {
        MeshProperty::new(kind, name, PropertyValue::Array(elements))
    }

    /// Whether its value never depends on the time.
    pub(crate) fn is_uniform(&self) -> bool {
        matches!(self.value, PropertyValue::Token(_) | PropertyValue::TokenList(_))
    }
}

/// The properties of a mesh, in the order of the file. `is_clip`: a stage may use the file as a value clip.
/// The stage takes the translation from the file of each frame, so the file has one even if it is zero. A
/// zero translation has no `xformOpOrder`, and thus no effect if the file is opened without the stage.
pub(crate) fn properties<'a>(mesh: &MeshView<'a>, quads: &'a [bool], is_clip: bool) -> Vec<MeshProperty<'a>> {
    let triangles = mesh.triangles;
    let mut found = Vec::new();
    if let Some(extent) = bounds_of(mesh.positions) {
        found.push(MeshProperty::new("float3[]", "extent", PropertyValue::Extent(extent)));
    }
    found.extend([
        MeshProperty::array("int[]", "faceVertexCounts", Elements::FaceCounts { triangles, quads }),
        MeshProperty::array("int[]", "faceVertexIndices", Elements::FaceCorners { triangles, quads }),
        MeshProperty::array("normal3f[]", "normals", Elements::reals(mesh.normals.as_flattened(), 3)),
        MeshProperty::new("token", "orientation", PropertyValue::Token("rightHanded")),
        MeshProperty::array("point3f[]", "points", Elements::reals(mesh.positions.as_flattened(), 3)),
    ]);
    for (attribute, property) in mesh.attributes.iter().zip(usd_properties(mesh.attributes)) {
        found.extend(properties_of(attribute, &property));
    }
    found.push(MeshProperty::new("token", "subdivisionScheme", PropertyValue::Token("none")));
    found.extend(translation(mesh.origin, is_clip));
    found
}

/// The properties of a prim whose points are relative to an origin.
fn translation<'a>(origin: [f64; 3], is_clip: bool) -> impl Iterator<Item = MeshProperty<'a>> {
    let is_moved = origin != [0.0; 3];
    let translate = MeshProperty::new("double3", TRANSLATE, PropertyValue::Double3(origin));
    let order = MeshProperty::new("token[]", "xformOpOrder", PropertyValue::TokenList(TRANSLATE));
    (is_moved || is_clip).then_some(translate).into_iter().chain(is_moved.then_some(order))
}

/// The properties of points, in the order of the file; `others` are their attributes except ids and widths. `is_clip` as
/// for [`properties`].
pub(crate) fn point_properties<'a>(
    points: &'a NarrowPoints<'_>,
    others: &[VertexAttribute<'a>],
    is_clip: bool,
) -> Vec<MeshProperty<'a>> {
    let mut found = Vec::new();
    let radius = points.radius();
    if let Some([low, high]) = bounds_of(&points.positions) {
        let extent = [low.map(|along| along - radius), high.map(|along| along + radius)];
        found.push(MeshProperty::new("float3[]", "extent", PropertyValue::Extent(extent)));
    }
    found.extend(points.ids.as_ref().map(|ids| {
        MeshProperty::array("int64[]", "ids", Elements::Integers { values: ids, arity: 1, is_narrow: false })
    }));
    let positions = Elements::reals(points.positions.as_flattened(), 3);
    found.push(MeshProperty::array("point3f[]", "points", positions));
    let of_others = usd_properties(others);
    found.extend(points.ids.as_deref().and_then(|ids| narrow_ids(ids, &of_others)));
    for (attribute, property) in others.iter().zip(of_others) {
        found.extend(properties_of(attribute, &property));
    }
    let widths = points.widths.as_deref();
    found.extend(widths.map(|widths| MeshProperty::array("float[]", "widths", Elements::reals(widths, 1))));
    found.extend(translation(points.origin, is_clip));
    found
}

/// The primvar by which Blender, which does not read `ids`, finds the ids of points: its nodes take random values from an
/// attribute of this name.
const ID: &str = "id";

/// The ids once more, as the primvar [`ID`] of the type that Blender reads; `None` if they need 64 bits, or another
/// attribute has the name.
fn narrow_ids<'a>(ids: &'a [i64], of_others: &[UsdProperty]) -> Option<MeshProperty<'a>> {
    let is_taken = of_others.iter().any(|other| matches!(other, UsdProperty::Primvar(name) if name == ID));
    let fits = ids.iter().all(|id| i32::try_from(*id).is_ok());
    let elements = Elements::Integers { values: ids, arity: 1, is_narrow: true };
    (fits && !is_taken).then(|| primvar("int", ID, elements, 1))
}

/// The property that an attribute is written to.
enum UsdProperty {
    Velocities,
    Accelerations,
    Color,
    Texture,
    Primvar(String),
}

/// The name of texture coordinates, and their type.
pub(crate) const TEXTURE: &str = "st";
pub(crate) const TEXTURE_KIND: &str = "texCoord2f[]";

/// Names of primvars that have a meaning for renderers, so other attributes cannot have them.
const RESERVED: [&str; 3] = ["displayColor", "displayOpacity", "normals"];

/// The number of components of the widest vector type.
const TUPLE_MAX: usize = 4;

/// The property of each attribute.
fn usd_properties(attributes: &[VertexAttribute]) -> Vec<UsdProperty> {
    let mut used = UsedNames::new(&RESERVED);
    let purposes = purposes(attributes);
    if purposes.contains(&Purpose::Texture) {
        used.take(TEXTURE);
    }
    let property = |(attribute, purpose): (&VertexAttribute, Purpose)| match purpose {
        Purpose::Velocity => UsdProperty::Velocities,
        Purpose::Acceleration => UsdProperty::Accelerations,
        Purpose::Color(_) => UsdProperty::Color,
        Purpose::Texture => UsdProperty::Texture,
        Purpose::Other => UsdProperty::Primvar(used.take(&identifier(attribute.name))),
    };
    attributes.iter().zip(purposes).map(property).collect()
}

/// A valid USD identifier for a name.
pub(crate) fn identifier(name: &str) -> String {
    let plain = plain_name(name);
    if plain.starts_with(|c: char| c.is_ascii_digit()) { format!("_{plain}") } else { plain }
}

/// Notes on vertex attributes that are renamed in a file with this extension.
pub(crate) fn renamed(attributes: &[VertexAttribute], extension: &str) -> Vec<String> {
    let renamed =
        attributes.iter().zip(usd_properties(attributes)).filter_map(
            |(attribute, property)| match property {
                UsdProperty::Primvar(name) if name != attribute.name => {
                    Some(format!("{} is named primvars:{name} in the .{extension}", attribute.name))
                }
                _ => None,
            },
        );
    renamed.collect()
}

/// The properties of an attribute:
///
/// ```text
///   velocity   velocities, for motion blur     colour     primvars:displayColor, displayOpacity
///   acceleration  accelerations, which renderers use together with the velocities
///   texture coordinates  primvars:st
///   floats     primvars:NAME, as vectors if a vertex has two to four values
///   integers   the same with the type int; if a value needs 64 bits, scalars of the type int64 instead of
///              vectors, of which elementSize says how many belong to a vertex
///   strings    primvars:NAME, the distinct strings, and primvars:NAME:indices
/// ```
fn properties_of<'a>(attribute: &VertexAttribute<'a>, property: &UsdProperty) -> Vec<MeshProperty<'a>> {
    let arity = attribute.arity;
    match (property, attribute.values) {
        (UsdProperty::Velocities, VertexValues::Numbers(values)) => {
            vec![MeshProperty::array("vector3f[]", VELOCITIES, Elements::reals(values, 3))]
        }
        (UsdProperty::Accelerations, VertexValues::Numbers(values)) => {
            vec![MeshProperty::array("vector3f[]", ACCELERATIONS, Elements::reals(values, 3))]
        }
        (UsdProperty::Color, VertexValues::Numbers(values)) => {
            let part = |kind, name, first, arity| {
                let elements = Elements::Reals { values, stride: attribute.arity, first, arity };
                MeshProperty::array(kind, name, elements)
            };
            let mut found = vec![part("color3f[]", "primvars:displayColor", 0, 3)];
            found.extend((arity == 4).then(|| part("float[]", "primvars:displayOpacity", 3, 1)));
            found
        }
        (UsdProperty::Texture, VertexValues::Numbers(values)) => {
            let name = format!("primvars:{TEXTURE}");
            vec![MeshProperty::array(TEXTURE_KIND, &name, Elements::reals(values, 2))]
        }
        (UsdProperty::Primvar(name), VertexValues::Strings { table, indices }) => {
            let name = format!("primvars:{name}");
            let indexed = MeshProperty::new("string[]", &name, PropertyValue::StringTable(table));
            let indices = Elements::StringIndices { table, indices };
            vec![
                MeshProperty { element_size: arity, ..indexed },
                MeshProperty::array("int[]", &format!("{name}{INDICES}"), indices),
            ]
        }
        (UsdProperty::Primvar(name), VertexValues::Integers(values)) => {
            let is_narrow = values.iter().all(|&value| i32::try_from(value).is_ok());
            let width = if is_narrow && arity <= TUPLE_MAX { arity } else { 1 };
            let kind = if is_narrow { vector("int", width) } else { "int64".to_owned() };
            vec![primvar(&kind, name, Elements::Integers { values, arity: width, is_narrow }, arity / width)]
        }
        (UsdProperty::Primvar(name), VertexValues::Numbers(values)) => {
            let width = if arity <= TUPLE_MAX { arity } else { 1 };
            vec![primvar(&vector("float", width), name, Elements::reals(values, width), arity / width)]
        }
        // `purposes` gives these roles only to floats.
        (
            UsdProperty::Velocities | UsdProperty::Accelerations | UsdProperty::Color | UsdProperty::Texture,
            _,
        ) => Vec::new(),
    }
}

fn vector(kind: &str, width: usize) -> String {
    if width == 1 { kind.to_owned() } else { format!("{kind}{width}") }
}

/// A primvar; each vertex has `element_size` values of the array.
fn primvar<'a>(kind: &str, name: &str, elements: Elements<'a>, element_size: usize) -> MeshProperty<'a> {
    let primvar = MeshProperty::array(&format!("{kind}[]"), &format!("primvars:{name}"), elements);
    MeshProperty { element_size, ..primvar }
}
