//! Measurements of a mesh for `meniscus info`.

use std::collections::HashMap;
use std::fmt;

use glam::DVec3;
use meniscus_formats::{AttributeRole, FileAttribute, MeshData};
use serde::Serialize;

use crate::cli::wording::{shortest, significant};

use super::particles::{AttributeInfo, attributes_of, fmt_attributes};
use super::{BoundingBox, row, vector};

/// A triangle mesh; larger polygons count as the triangles they are cut into.
#[derive(Debug, Serialize)]
pub(super) struct MeshInfo {
    vertices: usize,
    triangles: usize,
    has_normals: bool,
    /// Vertices whose position is not finite; triangles with such a vertex are not measured.
    not_finite: usize,
    #[serde(skip)]
    first_not_finite: Option<[f64; 3]>,
    bounds: Option<BoundingBox>,
    area: f64,
    /// Signed: negative if triangles are clockwise seen from outside. Meaningless for a mesh with boundary
    /// edges.
    volume: f64,
    /// Vertices at the same position count as one here: many formats store a vertex once for each of its
    /// normals.
    boundary_edges: usize,
    non_manifold_edges: usize,
    /// Attributes of the vertices beyond positions and normals.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    attributes: Vec<AttributeInfo>,
}

impl MeshInfo {
    pub(super) fn of(mesh: &MeshData) -> MeshInfo {
        let bounds = BoundingBox::of(mesh.positions.iter().copied());
        // The volume is the sum of signed tetrahedra whose apex is the centre of the mesh. With the origin as
        // the apex, large volumes of opposite sign would cancel if the mesh is far from it, and precision
        // would be lost.
        let center = bounds.map_or(DVec3::ZERO, |b| 0.5 * (DVec3::from(b.min) + DVec3::from(b.max)));
        let corner = |index: u32| {
            let position = mesh.positions.get(index as usize);
            position.map_or(DVec3::NAN, |&position| DVec3::from(position) - center)
        };
        let (mut area, mut volume) = (0.0, 0.0);
        for triangle in &mesh.triangles {
            let [a, b, c] = triangle.map(corner);
            if !(a.is_finite() && b.is_finite() && c.is_finite()) {
                continue;
            }
            area += 0.5 * (b - a).cross(c - a).length();
            volume += a.dot(b.cross(c)) / 6.0;
        }
        let mut not_finite = mesh.positions.iter().filter(|position| !position.iter().all(|x| x.is_finite()));
        let (first_not_finite, others) = (not_finite.next().copied(), not_finite.count());
        let (boundary_edges, non_manifold_edges) = odd_edges(&welded(mesh));
        MeshInfo {
            vertices: mesh.positions.len(),
            triangles: mesh.triangles.len(),
            has_normals: !mesh.normals.is_empty(),
            not_finite: usize::from(first_not_finite.is_some()) + others,
            first_not_finite,
            bounds,
            area,
            volume,
            boundary_edges,
            non_manifold_edges,
            attributes: Vec::new(),
        }
    }

    /// The same mesh, with the attributes of its vertices.
    pub(super) fn with_attributes(self, attributes: &[FileAttribute]) -> MeshInfo {
        let has_more = attributes.iter().any(|attribute| attribute.role != Some(AttributeRole::Normal));
        let attributes = if has_more { attributes_of(attributes) } else { Vec::new() };
        MeshInfo { attributes, ..self }
    }
}

/// The triangles, with each vertex replaced by the first one at the same position.
fn welded(mesh: &MeshData) -> Vec<[u32; 3]> {
    let mut first_at = HashMap::new();
    let first: Vec<u32> = (0u32..)
        .zip(&mesh.positions)
        // Adding zero turns −0 into 0, so that equal positions have equal bits.
        .map(|(index, position)| *first_at.entry(position.map(|x| (x + 0.0).to_bits())).or_insert(index))
        .collect();
    let first_of = |index: u32| first.get(index as usize).copied().unwrap_or(index);
    mesh.triangles.iter().map(|triangle| triangle.map(first_of)).collect()
}

/// The number of edges with one triangle, and the number of edges with more than two.
fn odd_edges(triangles: &[[u32; 3]]) -> (usize, usize) {
    let mut edges: Vec<[u32; 2]> = triangles
        .iter()
        .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
        .map(|[a, b]| [a.min(b), a.max(b)])
        .collect();
    edges.sort_unstable();
    let counts = || edges.chunk_by(|a, b| a == b).map(<[_]>::len);
    (counts().filter(|&count| count == 1).count(), counts().filter(|&count| count > 2).count())
}

impl fmt::Display for MeshInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let normals = if self.has_normals { ", with normals" } else { "" };
        row(f, "vertices", format_args!("{}{normals}", self.vertices))?;
        row(f, "triangles", self.triangles)?;
        if let Some(position) = self.first_not_finite {
            let first = format_args!(
                "{}, the first at {}; triangles with them are not in the area and volume",
                self.not_finite,
                vector(&position.map(shortest))
            );
            row(f, "vertices not finite", first)?;
        }
        if let Some(bounds) = self.bounds {
            row(f, "bounds", bounds.short())?;
        }
        row(f, "area", significant(self.area))?;
        row(f, "volume", significant(self.volume))?;
        row(f, "boundary edges", self.boundary_edges)?;
        row(f, "non-manifold edges", self.non_manifold_edges)?;
        fmt_attributes(&self.attributes, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tetrahedron_is_measured_at_any_distance_from_the_origin() {
        let positions = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let triangles = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        for shift in [0.0, 1e6] {
            let positions = positions.iter().map(|p| p.map(|x| x + shift)).collect();
            let mesh = MeshData { positions, normals: Vec::new(), triangles: triangles.clone() };
            let info = MeshInfo::of(&mesh);
            assert!((info.volume - 1.0 / 6.0).abs() < 1e-9);
            assert!((info.area - (1.5 + 0.75f64.sqrt())).abs() < 1e-9);
            assert_eq!((info.boundary_edges, info.non_manifold_edges), (0, 0));
        }
        let open = MeshData {
            positions: positions.to_vec(),
            triangles: triangles[..3].to_vec(),
            ..MeshData::default()
        };
        assert_eq!(MeshInfo::of(&open).boundary_edges, 3);
        let doubled = MeshData {
            positions: positions.to_vec(),
            triangles: [triangles.clone(), triangles].concat(),
            ..MeshData::default()
        };
        assert_eq!(MeshInfo::of(&doubled).non_manifold_edges, 6);
    }
}
