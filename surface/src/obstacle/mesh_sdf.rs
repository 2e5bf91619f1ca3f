//! A mesh as an obstacle: signed distances, leaf by leaf.

use std::sync::Arc;

use glam::{DVec3, IVec3};

use super::inside_test::{WindingField, sign};
use super::leaf::ObstacleLeaf;
use super::surface::{MeshFindings, RepairedMesh};
use super::triangle8::{Triangle8, TriangleDistances};
use super::winding::{WINDING_ERROR, winding, winding_gradient};
use crate::grid::LEAF_EDGE;
use crate::simd;
use crate::space::Lattice;

/// Signed distances to a repaired mesh, negative inside.
pub struct MeshSdf {
    surface: RepairedMesh,
}

/// From the centre of a leaf to its outermost voxels along an axis, in voxels.
const HALF_EDGE: f64 = 0.5 * (LEAF_EDGE - 1) as f64;

/// From the centre of a leaf to its farthest voxel, in voxels.
const RADIUS: f64 = HALF_EDGE * 1.732_050_807_568_877_2;

/// More than the rounding error of distances, in voxels.
const ROUNDING: f64 = 1e-3;

impl MeshSdf {
    /// Repairs a mesh of these triangles, in world units. Triangles that cannot be part of a surface are left
    /// out and counted in [`MeshSdf::findings`].
    pub fn new(positions: &[[f64; 3]], triangles: &[[u32; 3]]) -> MeshSdf {
        MeshSdf { surface: RepairedMesh::new(positions, triangles) }
    }

    /// The problems of the mesh.
    pub fn findings(&self) -> &MeshFindings {
        &self.surface.findings
    }

    /// The bounding box of the mesh, which also contains the patches over its holes.
    pub(super) fn bounds(&self) -> Option<[DVec3; 2]> {
        self.surface.tree.root().map(|node| [node.min, node.max])
    }

    /// The finite corner of the mesh with the largest coordinate, world units.
    pub(super) fn farthest(&self) -> DVec3 {
        self.surface.farthest
    }

    /// The memory of the mesh and its trees, in bytes.
    pub fn size_bytes(&self) -> usize {
        self.surface.tree.size_bytes() + self.surface.boundary.size_bytes()
    }

    /// The signed distances of a leaf.
    pub(super) fn leaf(&self, origin: IVec3, lattice: &Lattice, half_width: f32) -> ObstacleLeaf {
        let view = LeafView::new(&self.surface, origin, lattice);
        let far = f64::from(half_width);
        let nearest = view.nearest(far + RADIUS);
        if nearest.is_none()
            && let Some(side) = view.side(far)
        {
            return side;
        }
        let packets = nearest.map_or(Vec::new(), |nearest| view.near(far, nearest + 2.0 * RADIUS));
        let mut leaf = simd::dispatch(TriangleDistances { packets: &packets, most: half_width });
        sign(&mut leaf, &view, view.slope_bound(RADIUS));
        ObstacleLeaf::of_values(Arc::new(leaf), half_width)
    }

    /// How deep a point is inside, world units, and the nearest point on the surface. `None` if the point is
    /// outside.
    pub(super) fn depth(&self, point: DVec3) -> Option<(f64, DVec3)> {
        let tree = &self.surface.tree;
        let beyond = winding(tree, point) - 0.5;
        if beyond <= 0.0 {
            return None;
        }
        let outside = tree.nearest(point, f64::INFINITY)?;
        let depth = outside.distance(point);
        if !self.surface.boundary.is_empty() {
            let gradient = winding_gradient(tree, point);
            let to_patch = beyond / gradient.length();
            if to_patch < depth {
                return Some((to_patch, point - gradient.normalize_or_zero() * to_patch));
            }
        }
        Some((depth, outside))
    }

    /// The signed distance of a point, world units: negative inside. `None` if the mesh has no triangles.
    ///
    /// Patches over holes affect the sign only.
    pub fn distance(&self, point: DVec3) -> Option<f64> {
        let tree = &self.surface.tree;
        let distance = tree.nearest(point, f64::INFINITY)?.distance(point);
        Some(if winding(tree, point) > 0.5 { -distance } else { distance })
    }

    /// Whether the surface may come within `margin_voxels` of a leaf's voxels.
    pub(super) fn touches(&self, origin: IVec3, lattice: &Lattice, margin_voxels: f32) -> bool {
        let view = LeafView::new(&self.surface, origin, lattice);
        let margin = f64::from(margin_voxels);
        let has_patches = !self.surface.boundary.is_empty();
        view.nearest(margin + RADIUS + ROUNDING).is_some() || has_patches && view.side(margin).is_none()
    }
}

/// The surface relative to a leaf.
struct LeafView<'a> {
    surface: &'a RepairedMesh,
    /// The centre of the leaf, and the edge length of a voxel, world units.
    center: DVec3,
    voxel_size: f64,
}

impl LeafView<'_> {
    fn new<'a>(surface: &'a RepairedMesh, origin: IVec3, lattice: &Lattice) -> LeafView<'a> {
        let voxel_size = lattice.voxel_size;
        LeafView { surface, center: (origin.as_dvec3() + HALF_EDGE) * voxel_size, voxel_size }
    }

    /// The distance from the centre to the nearest triangle, in voxels, if less than `limit`.
    fn nearest(&self, limit: f64) -> Option<f64> {
        let limit = limit * self.voxel_size;
        let squared = self.surface.tree.nearest_squared(self.center, limit * limit)?;
        Some(squared.sqrt() / self.voxel_size)
    }

    /// The side of the whole leaf, if certainly no patch over a hole is within `far` voxels of the leaf. The
    /// caller must ensure that no triangle is within this distance.
    fn side(&self, far: f64) -> Option<ObstacleLeaf> {
        let slope = self.slope_bound(RADIUS + far);
        if slope == f64::INFINITY {
            return None;
        }
        let beyond = winding(&self.surface.tree, self.center) - 0.5;
        let is_certain = slope == 0.0 || beyond.abs() - WINDING_ERROR > slope * (RADIUS + far);
        is_certain.then_some(if beyond > 0.0 { ObstacleLeaf::Inside } else { ObstacleLeaf::Outside })
    }

    /// Upper bound of the change of the winding number per voxel, within `radius` voxels of the centre,
    /// between triangles. (Across a triangle, the number jumps.)
    fn slope_bound(&self, radius: f64) -> f64 {
        self.surface.boundary.slope_bound(self.center, radius * self.voxel_size) * self.voxel_size
    }

    /// All triangles within `far` of the leaf's box and within `reach` of its centre, in voxels, and some
    /// that are farther away: whole nodes of the triangle tree, of up to eight triangles, are tested by their
    /// boxes.
    fn near(&self, far: f64, reach: f64) -> Vec<Triangle8> {
        let mut packets = Vec::new();
        let [half_edge, far, reach] =
            [HALF_EDGE, far + ROUNDING, reach + ROUNDING].map(|voxels| voxels * self.voxel_size);
        self.surface.tree.leaves_near(self.center, half_edge, far, reach, |triangles| {
            packets.push(Triangle8::new(triangles, self.center, 1.0 / self.voxel_size));
        });
        packets
    }

    fn position(&self, voxel: IVec3) -> DVec3 {
        self.center + (voxel.as_dvec3() - HALF_EDGE) * self.voxel_size
    }
}

impl WindingField for LeafView<'_> {
    fn winding(&self, voxel: IVec3) -> f64 {
        winding(&self.surface.tree, self.position(voxel))
    }

    fn slope(&self, voxel: IVec3) -> f64 {
        winding_gradient(&self.surface.tree, self.position(voxel)).length() * self.voxel_size
    }
}
