//! The geometry of an archive in world space: its objects, their transforms, and whether they are visible.
//!
//! ```text
//!   /a         Xform      world of a = its operations, last one first · world of its parent
//!   /a/b       Xform      a new root if it does not inherit
//!   /a/b/c     Points     visible unless c, or the nearest parent that says so, is hidden
//! ```

use std::collections::BTreeMap;

use super::FORMAT;
use super::archive::{Archive, ObjectHeader, PropertyHeader, TIME_TOLERANCE, entry};
use super::document::Pod;
use super::mesh::names;
use crate::core::batches::ReadAt;
use crate::core::data::Values;
use crate::core::error::{Error, Position, Result};
use crate::core::limits::Limits;
use crate::core::matrix::{IDENTITY, Matrix, product, rotation};
use crate::core::number::wide;
use crate::core::text::{excerpt, listed};

/// The limit of objects inside one another: more than any scene has.
const DEPTH_MAX: usize = 1024;

/// A kind of geometry, and the schema of its objects.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum GeometryKind {
    Points,
    Mesh,
}

impl GeometryKind {
    fn of_schema(schema: &str) -> Option<GeometryKind> {
        match schema {
            "AbcGeom_Points_v1" => Some(GeometryKind::Points),
            "AbcGeom_PolyMesh_v1" => Some(GeometryKind::Mesh),
            _ => None,
        }
    }
}

/// An object of an archive: a transform, a geometry or another one.
struct SceneNode {
    parent: Option<usize>,
    depth: usize,
    /// The properties of its transform; empty for other objects.
    transform: Vec<PropertyHeader>,
    visible: Option<PropertyHeader>,
}

/// An object with points or a mesh.
pub(super) struct Geometry {
    pub(super) name: String,
    pub(super) kind: GeometryKind,
    node: usize,
    /// The properties of its schema.
    pub(super) properties: Vec<PropertyHeader>,
}

impl Geometry {
    pub(super) fn property(&self, name: &str) -> Option<&PropertyHeader> {
        self.properties.iter().find(|property| property.name == name)
    }

    pub(super) fn required(&self, name: &str) -> Result<&PropertyHeader> {
        self.property(name).ok_or_else(|| {
            let what = format!("{} has no property {name}", excerpt(&self.name));
            Error::invalid(FORMAT, Position::File, what)
        })
    }
}

/// The objects of an open archive.
pub(super) struct Scene<'a> {
    pub(super) archive: Archive<'a>,
    nodes: Vec<SceneNode>,
    geometries: Vec<Geometry>,
    /// The schemas of other geometry, with the number of objects of each.
    others: BTreeMap<String, usize>,
}

impl<'a> Scene<'a> {
    pub(super) fn open(file: &'a dyn ReadAt, limits: &'a Limits) -> Result<Scene<'a>> {
        let archive = Archive::open(file, limits)?;
        let top = ObjectHeader { name: String::new(), metadata: "".into(), reference: archive.top };
        let mut scene = Scene { archive, nodes: Vec::new(), geometries: Vec::new(), others: BTreeMap::new() };
        // The archive counts the bytes of all objects, so this ends even for references that form a cycle.
        let mut rest = vec![(top, None)];
        while let Some((object, parent)) = rest.pop() {
            let children = scene.push(object, parent)?;
            let node = scene.nodes.len() - 1;
            rest.extend(children.into_iter().rev().map(|child| (child, Some(node))));
        }
        Ok(scene)
    }

    fn push(&mut self, object: ObjectHeader, parent: Option<usize>) -> Result<Vec<ObjectHeader>> {
        let depth = parent.map_or(0, |parent| self.nodes[parent].depth + 1);
        if depth > DEPTH_MAX {
            let what = format!("the archive has more than {DEPTH_MAX} objects inside one another");
            return Err(Error::too_large(FORMAT, what));
        }
        let (properties, children) = self.archive.object(object.reference)?;
        let schema = entry(&object.metadata, "schema");
        let compound = |name: &str| match properties.iter().find(|property| property.name == name) {
            Some(property) => self.archive.compound(property),
            None => Ok(Vec::new()),
        };
        let is_transform = schema.starts_with("AbcGeom_Xform_");
        let transform = if is_transform { compound(names::TRANSFORM)? } else { Vec::new() };
        let kind = GeometryKind::of_schema(schema);
        let node = self.nodes.len();
        if entry(&object.metadata, "isInstance") == "1" {
            *self.others.entry("instance".to_owned()).or_default() += 1;
        } else if let Some(kind) = kind {
            let properties = compound(names::GEOMETRY)?;
            self.geometries.push(Geometry { name: object.name, kind, node, properties });
        } else if let Some(schema) = schema.strip_prefix("AbcGeom_").filter(|_| !is_transform)
            && schema != "FaceSet_v1"
        {
            *self.others.entry(excerpt(schema)).or_default() += 1;
        }
        let visible = properties.into_iter().find(|property| property.name == names::VISIBLE);
        self.nodes.push(SceneNode { parent, depth, transform, visible });
        Ok(children)
    }

    /// The geometry of a kind.
    pub(super) fn of_kind(&self, kind: GeometryKind) -> impl Iterator<Item = &Geometry> {
        self.geometries.iter().filter(move |geometry| geometry.kind == kind)
    }

    /// Describes all objects of other kinds, such as `2 PolyMesh`; empty if there are none.
    pub(super) fn others_than(&self, kind: GeometryKind) -> String {
        let count = self.geometries.iter().filter(|geometry| geometry.kind != kind).count();
        let name = if kind == GeometryKind::Points { "PolyMesh" } else { "Points" };
        let geometry = (count > 0).then(|| format!("{count} {name}"));
        let others = self.others.iter().map(|(schema, count)| {
            let stem = schema.split_once("_v").map_or(schema.as_str(), |(stem, _)| stem);
            format!("{count} {stem}")
        });
        listed(geometry.into_iter().chain(others).take(8).collect(), "and")
    }

    /// An object and its parents, from the inside out.
    fn chain(&self, geometry: &Geometry) -> impl Iterator<Item = &SceneNode> {
        let first = self.nodes.get(geometry.node);
        std::iter::successors(first, |node| self.nodes.get(node.parent?))
    }

    /// The times at which the geometry of a kind changes, in seconds; its only time,
    /// if the archive states one, if it never changes.
    pub(super) fn times(&self, kind: GeometryKind, limits: &Limits) -> Result<Vec<f64>> {
        let mut counts: BTreeMap<u32, u32> = BTreeMap::new();
        let mut still = None;
        for geometry in self.of_kind(kind) {
            let sampled = geometry.property(names::POSITIONS);
            let positions = sampled.filter(|positions| positions.sample_count > 1);
            for property in positions.into_iter().chain(self.changing(geometry)) {
                let count = counts.entry(property.sampling).or_default();
                *count = property.sample_count.max(*count);
            }
            let stated = sampled.filter(|positions| positions.sampling > 0);
            still = still.or(stated.map(|positions| self.archive.time(positions.sampling, 0)));
        }
        let mut times: Vec<f64> = Vec::new();
        for (sampling, count) in counts {
            limits.check_step(FORMAT, (times.len() + count as usize).saturating_sub(1))?;
            times.extend((0..count).map(|index| self.archive.time(sampling, index)));
        }
        times.sort_by(f64::total_cmp);
        times.dedup_by(|later, first| (*later - *first).abs() < TIME_TOLERANCE);
        if times.is_empty() {
            times.extend(still);
        }
        Ok(times)
    }

    /// Whether an object is visible at a time.
    pub(super) fn is_visible(&self, geometry: &Geometry, time: Option<f64>) -> Result<bool> {
        for property in self.chain(geometry).filter_map(|node| node.visible.as_ref()) {
            match wide(&self.archive.param(property, time)?.1).first() {
                Some(0.0) => return Ok(false),
                Some(value) if *value > 0.0 => return Ok(true),
                _ => {} // −1: as the parent
            }
        }
        Ok(true)
    }

    /// The properties of the transforms of an object that change, and those that show or hide it.
    fn changing(&self, geometry: &Geometry) -> impl Iterator<Item = &PropertyHeader> {
        let properties = self.chain(geometry).flat_map(|node| node.transform.iter().chain(&node.visible));
        let names = [names::MATRIX, names::INHERITS, names::VISIBLE];
        properties.filter(move |property| property.is_changing() && names.contains(&&*property.name))
    }

    /// Whether the transform of an object depends on the time.
    pub(super) fn is_moving(&self, geometry: &Geometry) -> bool {
        self.changing(geometry).any(|property| property.name != names::VISIBLE)
    }

    /// The transform of an object into the world.
    pub(super) fn world(&self, geometry: &Geometry, time: Option<f64>) -> Result<Matrix> {
        let mut world = IDENTITY;
        for node in self.chain(geometry) {
            world = product(&world, &self.local(node, time)?);
            if let Some(inherits) = node.transform.iter().find(|property| property.name == names::INHERITS)
                && matches!(self.archive.param(inherits, time)?.1, Values::U8(values) if values == [0])
            {
                break;
            }
        }
        Ok(world)
    }

    /// The transform of an object relative to its parent.
    fn local(&self, node: &SceneNode, time: Option<f64>) -> Result<Matrix> {
        let property = |name: &str| node.transform.iter().find(|property| property.name == name);
        let Some(numbers) = property(names::MATRIX) else { return Ok(IDENTITY) };
        let invalid = |what: String| Error::invalid(FORMAT, Position::File, what);
        let Values::F64(numbers) = self.archive.param(numbers, time)?.1 else {
            return Err(invalid("a transform has values that are not 64-bit floats".to_owned()));
        };
        let operations = property(names::OPERATIONS).map(|property| self.archive.param(property, time));
        let operations = match operations.transpose()? {
            None => Vec::new(),
            Some((_, Values::U8(operations))) => operations,
            Some(_) => return Err(invalid("a transform has operations that are not bytes".to_owned())),
        };
        let (mut matrix, mut rest) = (IDENTITY, &*numbers);
        for operation in operations {
            let operation = operation >> 4;
            let count = match operation {
                0 | 1 => 3,
                2 => 4,
                3 => 16,
                4..=6 => 1,
                _ => return Err(invalid(format!("a transform has the unknown operation {operation}"))),
            };
            let Some((values, others)) = rest.split_at_checked(count) else {
                let what =
                    format!("a transform has {} numbers, fewer than its operations need", numbers.len());
                return Err(invalid(what));
            };
            // The first operation is applied last.
            matrix = product(&operation_matrix(operation, values), &matrix);
            rest = others;
        }
        Ok(matrix)
    }

    /// The error for an archive without geometry of a kind.
    pub(super) fn without(&self, kind: GeometryKind) -> Error {
        let has_other = self.geometries.iter().any(|geometry| geometry.kind != kind);
        let others = self.others_than(kind);
        let has = if others.is_empty() { String::new() } else { format!(" (it has {others})") };
        let what = match kind {
            GeometryKind::Points if has_other => format!(
                "this is a mesh, not particles{has}: use the particle file, or save the mesh's vertices as PLY"
            ),
            GeometryKind::Points => format!("the archive has no Points{has}"),
            GeometryKind::Mesh => format!("the archive has no PolyMesh{has}"),
        };
        Error::unsupported(FORMAT, what)
    }
}

/// The matrix of an operation: scale, translation, rotation by degrees about an axis, matrix, and rotations
/// about x, y and z.
pub(super) fn operation_matrix(operation: u8, values: &[f64]) -> Matrix {
    let mut matrix = IDENTITY;
    match (operation, values) {
        (0, &[x, y, z]) => (matrix[0][0], matrix[1][1], matrix[2][2]) = (x, y, z),
        (1, &[x, y, z]) => matrix[3] = [x, y, z, 1.0],
        (2, &[x, y, z, degrees]) => {
            let length = (x * x + y * y + z * z).sqrt();
            return rotation(
                [x, y, z].map(|along| if length == 0.0 { 0.0 } else { along / length }),
                degrees,
            );
        }
        (4, &[degrees]) => return rotation([1.0, 0.0, 0.0], degrees),
        (5, &[degrees]) => return rotation([0.0, 1.0, 0.0], degrees),
        (6, &[degrees]) => return rotation([0.0, 0.0, 1.0], degrees),
        _ => matrix.as_flattened_mut().copy_from_slice(values),
    }
    matrix
}

/// Reads the vectors of a sample.
pub(super) fn vectors(scene: &Scene, property: &PropertyHeader, index: u32) -> Result<Vec<[f32; 3]>> {
    let vectors = scene.archive.elements::<12>(property, (Pod::F32, 3), index)?;
    let decoded = |bytes: &[u8; 12]| {
        let [a, b, c, d, e, f, g, h, rest @ ..] = *bytes;
        [[a, b, c, d], [e, f, g, h], rest].map(f32::from_le_bytes)
    };
    Ok(vectors.iter().map(decoded).collect())
}
