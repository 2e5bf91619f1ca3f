//! Extracts a triangle mesh from φ.
//!
//! ```text
//!   signs of all voxels ──▶ LeafNeighborhood ──▶ crossed cells ──▶ vertex and triangle ──▶ index ranges
//!                           SignRows             and edges         counts                  per leaf
//!
//!                                    PhiBlock ──▶ crossings, gradients ──▶ vertices  ─┐ written to
//!                                                                         triangles ─┴▶ their ranges
//! ```
//!
//! Both methods (see [`Contouring`]) guarantee for any φ: the mesh is closed; every edge is in two triangles
//! with opposite directions; the triangles around a vertex form one ring; all triangles face outward; none is
//! degenerate; and the three vertices of a triangle are distinct. Each leaf is processed independently and
//! has a fixed range in the mesh, so the mesh is bit-identical on any number of threads.
//!
//! Inside is φ < 0; zero is outside. A band must store the voxels next to a sign change together with all
//! their neighbors. Cells with a corner that is not stored are treated as empty.

mod cell_vertex;
mod dual_contouring;
mod marching_tetrahedra;
mod neighborhood;
mod quads;
mod refine;

use glam::{DVec3, IVec3, Vec3};

pub use refine::refine;

use crate::grid::{LEAF_EDGE, Topology};
use crate::level_set::NarrowBand;
use crate::mesh::Mesh;
use crate::space::{CoordBox, Lattice};
use crate::words::word_enum;

word_enum! {
    /// How the level set becomes triangles.
    #[derive(Default)]
    pub enum Contouring {
        /// Dual contouring: fewer and better shaped triangles
        #[default]
        Dual = "dual",
        /// Marching tetrahedra, as in the paper: about four times as many triangles
        Tetrahedra = "tetrahedra",
    }
}

/// The surface φ = 0 as a closed triangle mesh in world units, oriented outward, with unit normals.
pub fn contour(band: &NarrowBand, lattice: &Lattice, contouring: Contouring) -> Mesh {
    assert_eq!(
        band.phi.leaves.len(),
        band.topology.len(),
        "φ must have one leaf of values per leaf of the topology"
    );
    let placement = MeshPlacement::new(&band.topology, lattice);
    let mut mesh = match contouring {
        Contouring::Dual => dual_contouring::dual_contour(band, &placement),
        Contouring::Tetrahedra => marching_tetrahedra::march_tetrahedra(band, &placement),
    };
    fill_zero_normals(&mut mesh);
    mesh
}

/// The origin of the mesh and the voxel size.
struct MeshPlacement {
    origin_index: IVec3,
    voxel_size: f64,
}

/// Up to this index, 32-bit positions resolve 1/1024 voxel.
const NEAR_ORIGIN: i32 = 16384;

/// Mesh origins other than the world origin are multiples of this many voxels, so that consecutive frames of
/// a moving sequence often share one.
const ORIGIN_STEP: i32 = 1024;

impl MeshPlacement {
    /// Places the mesh's origin at the world origin if all leaves are near it, and otherwise at the median
    /// leaf. With the median, a single stray particle does not reduce the precision of all others.
    fn new(topology: &Topology, lattice: &Lattice) -> MeshPlacement {
        let mut extent = CoordBox::EMPTY;
        for &origin in topology.origins() {
            extent.include(origin);
            extent.include(origin + IVec3::splat(LEAF_EDGE - 1));
        }
        let is_near = extent.is_empty()
            || extent.min.cmpge(IVec3::splat(-NEAR_ORIGIN)).all()
                && extent.max.cmple(IVec3::splat(NEAR_ORIGIN)).all();
        let origin_index =
            if is_near { IVec3::ZERO } else { (median(topology) + ORIGIN_STEP / 2) & !(ORIGIN_STEP - 1) };
        MeshPlacement { origin_index, voxel_size: lattice.voxel_size }
    }

    /// The world position that mesh positions are relative to.
    fn world_origin(&self) -> DVec3 {
        self.origin_index.as_dvec3() * self.voxel_size
    }

    /// The mesh position of a point given relative to a cell; rounded once.
    #[inline(always)]
    fn position(&self, cell: IVec3, local: Vec3) -> Vec3 {
        (((cell - self.origin_index).as_dvec3() + local.as_dvec3()) * self.voxel_size).as_vec3()
    }
}

/// The median of the leaves' origins, axis by axis. There is at least one leaf.
fn median(topology: &Topology) -> IVec3 {
    let axis = |axis: usize| {
        let mut values: Vec<i32> = topology.origins().iter().map(|origin| origin[axis]).collect();
        let middle = values.len() / 2;
        *values.select_nth_unstable(middle).1
    };
    IVec3::new(axis(0), axis(1), axis(2))
}

/// Splits a slice into consecutive parts of these lengths.
fn split<T>(whole: &mut [T], counts: impl Iterator<Item = usize>) -> Vec<&mut [T]> {
    let mut rest = whole;
    let part = |count: usize| {
        let (part, after) = std::mem::take(&mut rest).split_at_mut(count);
        rest = after;
        part
    };
    counts.map(part).collect()
}

// Vertex normals from φ.
//
// φ grows outward, so its gradient points along the normal, and is smoother and more accurate than normals
// computed from triangles. Midway between two sheets, the gradient vanishes and has no direction. There, the
// normal comes from the triangles.

/// Gradients shorter than this are mostly rounding error. (The gradient of a distance has length one.)
const SLOPE_MIN: f32 = 1e-3;

/// The direction of a gradient, or zero if the gradient is too short.
#[inline(always)]
fn unit_or_zero(gradient: Vec3) -> Vec3 {
    let length = gradient.length();
    let unit = gradient / length;
    // Comparison with NaN is false, so values that are not finite give zero, too.
    if (length > SLOPE_MIN) & (length < f32::INFINITY) { unit } else { Vec3::ZERO }
}

/// Replaces each zero normal by the area-weighted mean of the vertex's triangle normals, or by the z axis if
/// these cancel, as on a sheet that is folded flat.
pub fn fill_zero_normals(mesh: &mut Mesh) {
    if mesh.normals.iter().all(|&normal| normal != Vec3::ZERO) {
        return;
    }
    let mut sums = vec![DVec3::ZERO; mesh.positions.len()];
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|vertex| mesh.positions[vertex as usize].as_dvec3());
        let doubled_area = (b - a).cross(c - a);
        triangle.iter().for_each(|&vertex| sums[vertex as usize] += doubled_area);
    }
    for (normal, sum) in mesh.normals.iter_mut().zip(sums) {
        if *normal == Vec3::ZERO {
            *normal = sum.try_normalize().unwrap_or(DVec3::Z).as_vec3();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zero_normal_becomes_mean_of_triangle_normals() {
        let mut mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            normals: vec![
                unit_or_zero(Vec3::splat(1e-9)),
                unit_or_zero(Vec3::NAN),
                unit_or_zero(2.0 * Vec3::X),
            ],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        };
        fill_zero_normals(&mut mesh);
        assert_eq!(mesh.normals, [Vec3::Z, Vec3::Z, Vec3::X]);
    }

    #[test]
    fn folded_sheet_gets_unit_normals() {
        let mut mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            normals: vec![Vec3::ZERO; 3],
            triangles: vec![[0, 1, 2], [0, 2, 1]],
            ..Mesh::default()
        };
        fill_zero_normals(&mut mesh);
        assert_eq!(mesh.normals, [Vec3::Z; 3]);
    }
}
