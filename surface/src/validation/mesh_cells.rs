//! Finds the cells that the triangles of a mesh pass through.
//!
//! ```text
//!   ┌───┬───┬───┬───┐       ▒  a triangle passes through: rays decide what is inside
//!   │   │   │▒▒▒│▒▒▒│
//!   ├───┼───┼─╱─┼───┤          the others are *clear*: if the mesh is closed, all points of a clear cell are
//!   │   │▒▒▒│▒▒▒│   │          on one side, and two clear cells with a common face are on the same side
//!   ├───┼─╱─┼───┼───┤
//!   │   │▒▒▒│   │   │
//!   └───┴───┴───┴───┘
//! ```
//!
//! In a clear cell φ has one sign at all corners, unless decimation or rounding moved the mesh a little. If φ
//! has both signs at the corners of a clear cell, and no triangle is within two cells of it, the mesh may
//! lack a part of the surface. Then the cells within two cells of it decide, except those where φ has both
//! signs. If some of these are inside and some outside, the mesh *leaks*: φ does not describe it there. If
//! all are on one side, the mesh only lacks a drop, a hole or a sheet thinner than two cells, and all these
//! cells are on the same side of the mesh, too.

use std::sync::atomic::{AtomicU64, Ordering};

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use crate::grid::{LEAF_EDGE, LeafMask, Topology, negative_masks, offset_in_leaf, voxel_in_leaf};
use crate::level_set::NarrowBand;
use crate::mesh::Mesh;
use crate::parallel::Loops as _;
use crate::simd::{self, Kernel, Lanes};
use crate::space::Lattice;

/// The cells that a mesh passes through, and the signs of φ around them. A cell is identified by its lowest
/// voxel.
#[derive(Debug)]
pub struct MeshCells {
    /// For each leaf of the band, the cells that a triangle passes through.
    touched: Vec<LeafMask>,
    /// For each leaf of the band, the voxels inside.
    pub(super) signs: Vec<LeafMask>,
    /// The leaves where the mesh leaks, and their neighbours.
    leaking: FxHashSet<IVec3>,
}

/// Number of triangles per task.
const CHUNK: usize = 4096;

/// A point this close to a face of a cell, in voxels, belongs to the cells on both sides.
const FACE_MARGIN: f64 = 1e-6;

/// Upper limit of the distance between the mesh and a sign change of φ, in cells.
const LEAK_CELLS: i32 = 2;

impl MeshCells {
    /// Finds the cells of a mesh that was contoured from a band.
    pub fn new(mesh: &Mesh, band: &NarrowBand, lattice: &Lattice) -> MeshCells {
        let topology = &*band.topology;
        let masks: Vec<[AtomicU64; 8]> = (0..topology.len()).map(|_| Default::default()).collect();
        mesh.triangles.par_chunks(CHUNK).halved().for_each(|triangles| {
            let marker = Marker { topology, masks: &masks, found: None };
            simd::dispatch(MarkTriangles { mesh, lattice, triangles, marker });
        });
        let touched = masks.into_par_iter();
        let touched = touched.map(|words| LeafMask { words: words.map(AtomicU64::into_inner) }).collect();
        let signs = negative_masks(&band.phi);
        let mut cells = MeshCells { touched, signs, leaking: FxHashSet::default() };
        let leaks = topology.origins().par_iter().halved().filter(|&&origin| cells.leaks(topology, origin));
        let leaks: Vec<IVec3> = leaks.copied().collect();
        let around = |origin: &IVec3| {
            let origin = *origin;
            (0..27).map(move |number| origin + LEAF_EDGE * step_of(number, 3))
        };
        cells.leaking = leaks.iter().flat_map(around).collect();
        cells
    }

    /// The cells of a leaf of the band that a triangle passes through.
    pub(super) fn of_leaf(&self, leaf: usize) -> &LeafMask {
        &self.touched[leaf]
    }

    /// Whether a triangle passes through a cell.
    pub(super) fn contains(&self, topology: &Topology, cell: IVec3) -> bool {
        let found = topology.find_voxel(cell);
        found.is_some_and(|(leaf, local)| self.touched[leaf].contains(offset_in_leaf(local)))
    }

    /// Whether the mesh leaks in a leaf or in one of its neighbours.
    pub(super) fn is_leaking(&self, origin: IVec3) -> bool {
        self.leaking.contains(&origin)
    }

    fn leaks(&self, topology: &Topology, origin: IVec3) -> bool {
        let leaves: [Option<usize>; 8] =
            std::array::from_fn(|number| topology.find(origin + corner(number) * LEAF_EDGE));
        let Some(leaf) = leaves[0] else { return false };
        let all_corners = |of_leaf: &dyn Fn(usize) -> LeafMask| {
            with_all_corners(leaves.map(|leaf| leaf.map_or(LeafMask::EMPTY, of_leaf)))
        };
        let stored = all_corners(&|_| LeafMask::FULL);
        let inside = all_corners(&|leaf| self.signs[leaf]);
        let outside = all_corners(&|leaf| self.signs[leaf].complement());
        let doubtful = stored.and(&inside.or(&outside).or(&self.touched[leaf]).complement());
        let leaks_around = |offset: usize| {
            let cell = origin + voxel_in_leaf(offset);
            let width = 2 * LEAK_CELLS + 1;
            let around = || (0..width.pow(3)).map(|number| cell + step_of(number, width));
            if around().any(|cell| self.contains(topology, cell)) {
                return false;
            }
            let mut sides: Vec<bool> = around().filter_map(|cell| self.clear_side(topology, cell)).collect();
            sides.dedup();
            // If no cell around has one sign at all corners, the missing part may be large.
            sides.len() != 1
        };
        doubtful.iter().any(leaks_around)
    }

    /// Whether a cell is inside according to φ; `None` if φ is not stored at all of its corners, or changes
    /// its sign.
    fn clear_side(&self, topology: &Topology, cell: IVec3) -> Option<bool> {
        let is_inside = |number: usize| {
            let (leaf, local) = topology.find_voxel(cell + corner(number))?;
            Some(self.signs[leaf].contains(offset_in_leaf(local)))
        };
        let first = is_inside(0)?;
        (1..8).all(|number| is_inside(number) == Some(first)).then_some(first)
    }
}

/// Converts an index in a cube of `width`³ cells to a step from its middle.
fn step_of(number: i32, width: i32) -> IVec3 {
    IVec3::new(number / (width * width), number / width % width, number % width) - width / 2
}

/// The corners of a triangle, in voxels.
#[inline(always)]
pub(super) fn corners(mesh: &Mesh, triangle: [u32; 3], lattice: &Lattice) -> [DVec3; 3] {
    let [a, b, c] = triangle;
    // Written out, because the closure of `map` is not inlined.
    let corner =
        |vertex: u32| (mesh.origin + mesh.positions[vertex as usize].as_dvec3()) / lattice.voxel_size;
    [corner(a), corner(b), corner(c)]
}

/// The first and the last cell of a triangle's bounding box.
#[inline(always)]
pub(super) fn cells_of_box(corners: &[DVec3; 3]) -> [IVec3; 2] {
    let [a, b, c] = *corners;
    let (low, high) = (a.min(b).min(c) - FACE_MARGIN, a.max(b).max(c) + FACE_MARGIN);
    [low.floor().as_ivec3(), high.floor().as_ivec3()]
}

/// Marks cells in the masks of their leaves.
struct Marker<'a> {
    topology: &'a Topology,
    masks: &'a [[AtomicU64; 8]],
    /// The leaf that was found last, by its origin.
    found: Option<(IVec3, Option<usize>)>,
}

impl Marker<'_> {
    #[inline(always)]
    fn mark(&mut self, cell: IVec3) {
        let local = cell & IVec3::splat(LEAF_EDGE - 1);
        let origin = cell - local;
        let leaf = match self.found {
            Some((at, leaf)) if at == origin => leaf,
            _ => {
                let leaf = self.topology.find(origin);
                self.found = Some((origin, leaf));
                leaf
            }
        };
        // Cells beyond the band are never queried.
        let Some(leaf) = leaf else { return };
        let (word, bit) = (&self.masks[leaf][local.x as usize], 1 << (local.y * LEAF_EDGE + local.z));
        if word.load(Ordering::Relaxed) & bit == 0 {
            word.fetch_or(bit, Ordering::Relaxed);
        }
    }
}

/// Kernel: marks the cells that some triangles pass through.
struct MarkTriangles<'a> {
    mesh: &'a Mesh,
    lattice: &'a Lattice,
    triangles: &'a [[u32; 3]],
    marker: Marker<'a>,
}

impl Kernel for MarkTriangles<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(mut self) {
        for &triangle in self.triangles {
            passed_cells(&corners(self.mesh, triangle, self.lattice), |cell| self.marker.mark(cell));
        }
    }
}

/// Calls `each` for each cell that a triangle passes through, and for some cells beside these.
#[inline(always)]
fn passed_cells(corners: &[DVec3; 3], mut each: impl FnMut(IVec3)) {
    let [a, b, c] = *corners;
    let [first, last] = cells_of_box(corners);
    let size = last - first + 1;
    let normal = (b - a).cross(c - a);
    let axis = normal.abs().max_position();
    if size.max_element() <= 2 || normal[axis] == 0.0 {
        for x in first.x..=last.x {
            for y in first.y..=last.y {
                for z in first.z..=last.z {
                    each(IVec3::new(x, y, z));
                }
            }
        }
        return;
    }
    // Projected along its dominant axis, a triangle covers columns of cells, and at most three cells in each.
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let [slope_u, slope_v] = [u, v].map(|along| normal[along] / normal[axis]);
    let side = normal[axis].signum();
    let half_depth = 0.5 * (slope_u.abs() + slope_v.abs()) + FACE_MARGIN;
    let (low, high) = (a[axis].min(b[axis]).min(c[axis]), a[axis].max(b[axis]).max(c[axis]));
    let is_past_edge = |from: DVec3, to: DVec3, [at_u, at_v]: [f64; 2]| {
        let (along_u, along_v) = (to[u] - from[u], to[v] - from[v]);
        let distance = side * (along_u * (at_v - from[v]) - along_v * (at_u - from[u]));
        distance < -(0.5 + FACE_MARGIN) * (along_u.abs() + along_v.abs())
    };
    for cell_u in first[u]..=last[u] {
        for cell_v in first[v]..=last[v] {
            let middle = [f64::from(cell_u) + 0.5, f64::from(cell_v) + 0.5];
            if is_past_edge(a, b, middle) || is_past_edge(b, c, middle) || is_past_edge(c, a, middle) {
                continue;
            }
            let depth = a[axis] - slope_u * (middle[0] - a[u]) - slope_v * (middle[1] - a[v]);
            let from = (depth - half_depth).max(low - FACE_MARGIN).floor() as i32;
            let to = (depth + half_depth).min(high + FACE_MARGIN).floor() as i32;
            for cell_axis in from..=to {
                let mut cell = IVec3::ZERO;
                (cell[axis], cell[u], cell[v]) = (cell_axis, cell_u, cell_v);
                each(cell);
            }
        }
    }
}

/// The last voxel along z of each row in a word.
const LAST_Z: u64 = 0x8080_8080_8080_8080;

/// Corner `4x + 2y + z` of a cell.
pub(super) fn corner(number: usize) -> IVec3 {
    IVec3::new((number >> 2) as i32, (number >> 1 & 1) as i32, (number & 1) as i32)
}

/// The cells of a leaf whose corners are all in a mask. The masks are those of the leaf and of the leaves
/// after it, by [`corner`].
#[inline(always)]
pub(super) fn with_all_corners(mut masks: [LeafMask; 8]) -> LeafMask {
    // Along z, then y, then x. Of the following leaves, only the voxels next to this leaf count.
    for number in [0, 2, 4, 6] {
        let after = masks[number + 1].words;
        masks[number].words.iter_mut().zip(after).for_each(|(word, after)| {
            *word &= *word >> 1 & !LAST_Z | after << 7 & LAST_Z;
        });
    }
    for number in [0, 4] {
        let after = masks[number + 2].words;
        masks[number].words.iter_mut().zip(after).for_each(|(word, after)| *word &= *word >> 8 | after << 56);
    }
    let [mut cells, .., after, _, _, _] = masks;
    for x in 0..8 {
        cells.words[x] &= if x < 7 { cells.words[x + 1] } else { after.words[0] };
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{Field, Leaf};

    /// Whether an empty mesh leaks anywhere if the voxels inside are those of `is_inside`.
    fn leaks(is_inside: impl Fn(IVec3) -> bool) -> bool {
        let leaf_origins =
            (0..64).map(|number| LEAF_EDGE * (IVec3::new(number / 16, number / 4 % 4, number % 4) - 2));
        let topology = Topology::new(leaf_origins.collect());
        let leaf =
            |origin: &IVec3| Leaf {
                values: std::array::from_fn(|offset| {
                    if is_inside(*origin + voxel_in_leaf(offset)) { -1.0 } else { 1.0 }
                }),
            };
        let phi = Field { leaves: topology.origins().iter().map(leaf).collect() };
        let band = NarrowBand { topology: topology.into(), phi, half_width: 3.0 };
        let cells = MeshCells::new(&Mesh::default(), &band, &Lattice { voxel_size: 1.0 });
        !cells.leaking.is_empty()
    }

    #[test]
    fn mesh_that_lacks_more_than_a_thin_piece_leaks() {
        assert!(!leaks(|_| false), "nothing is missing");
        assert!(!leaks(|voxel| voxel == IVec3::ZERO), "a drop of one voxel");
        assert!(!leaks(|voxel| voxel != IVec3::ZERO), "a hole of one voxel");
        assert!(!leaks(|voxel| voxel.x == 3), "a sheet of one voxel");
        assert!(leaks(|voxel| voxel.x == 3 || voxel.x == 4), "a sheet of two voxels");
        assert!(leaks(|voxel| voxel.length_squared() < 25), "a ball");
        assert!(leaks(|voxel| voxel.x < 0), "a plane");
        assert!(leaks(|voxel| voxel.element_sum() & 1 == 0), "no clear cell at all");
    }

    /// Random points on large and small triangles lie in cells that were passed to the callback.
    #[test]
    fn every_point_of_a_triangle_is_in_a_passed_cell() {
        let mut seed = 7u32;
        let mut random = |range: f64| {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            range * (f64::from(seed >> 8) / f64::from(1 << 24) - 0.5)
        };
        for round in 0..300 {
            let range = [0.5, 3.0, 40.0][round % 3];
            let mut corners = [0; 3].map(|_| DVec3::new(random(range), random(range), random(range)));
            if round % 5 == 0 {
                // A triangle in a plane between cells.
                corners.iter_mut().for_each(|corner| corner[round % 3] = 2.0);
            }
            let mut cells = FxHashSet::default();
            passed_cells(&corners, |cell| {
                cells.insert(cell);
            });
            let [a, b, c] = corners;
            for i in 0..=60 {
                for j in 0..=60 - i {
                    let point = a + (b - a) * (f64::from(i) / 60.0) + (c - a) * (f64::from(j) / 60.0);
                    assert!(cells.contains(&point.floor().as_ivec3()), "{point} of {corners:?}");
                }
            }
            let area = (b - a).cross(c - a).length() / 2.0;
            assert!((cells.len() as f64) < 20.0 + 8.0 * area + 12.0 * range, "{} for {area}", cells.len());
        }
    }
}
