//! The triangles of an obstacle, repaired as far as possible without guessing a shape.
//!
//! The meshes of a scene are made for rendering: vertices are repeated along seams, parts are duplicated,
//! some triangles face the wrong way. Here vertices at the same position are merged, duplicate triangles are
//! removed, and the orientation of neighbours is made consistent:
//!
//! ```text
//!    ──▶ ◀──        two triangles agree if they traverse their common edge in opposite
//!    │ 1 │ 2 │      directions. Among connected triangles, those with the smaller total area are flipped
//!
//!    ┌─────────┐    a part with negative volume is flipped as a whole,
//!    │  ┌───┐  │    unless it lies within another part: then it bounds a cavity
//!    │  └───┘  │
//!    └─────────┘
//! ```
//!
//! Holes stay open: the [boundary](RepairedMesh::boundary) locates them, and the winding number closes them.
//! But an open sheet, such as a plane, encloses nothing that its patches could close. It becomes a solid as
//! deep as the sheet is wide, behind its normals:
//!
//! ```text
//!          ↑ ↑ ↑ ↑
//!    ──────────────────      the sheet
//!    │                │
//!    │                │      its boundary edges, swept
//!    ──────────────────      the sheet, moved and turned
//! ```

use std::collections::BTreeMap;
use std::f64::consts::PI;

use glam::DVec3;
use rustc_hash::{FxHashMap, FxHashSet};

use super::mesh_sdf::{WINDING_ERROR, winding};
use super::tree::TriangleTree;

/// Problems of the mesh of an obstacle: triangles that were left out or flipped, and holes. The winding
/// number closes an obstacle with open edges; an obstacle that [encloses nothing](Self::encloses_nothing)
/// displaces no fluid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct MeshFindings {
    /// Number of triangles that bound the obstacle.
    pub triangle_count: usize,
    /// Triangles left out because a corner is not finite, or its index is out of range.
    pub invalid_count: usize,
    /// Triangles left out because they have no area.
    pub degenerate_count: usize,
    /// Triangles left out because they are duplicates.
    pub duplicate_count: usize,
    /// Triangles flipped to agree with their neighbours, or because their part had negative volume.
    pub flipped_count: usize,
    /// Boundary edges of the surface, as at a hole, without those of sheets.
    pub open_edge_count: usize,
    /// Open sheets, such as planes: each was closed behind its normals, as deep as it is wide.
    pub sheet_count: usize,
    /// Whether the mesh is so open that it encloses nothing, and not a sheet that faces one way.
    pub encloses_nothing: bool,
    /// Parts with negative volume that were not flipped: with this many parts, it would take too long to find
    /// out which of them are cavities.
    pub unchecked_part_count: usize,
}

/// Consistently oriented triangles.
pub(super) struct RepairedMesh {
    pub(super) tree: TriangleTree,
    /// The boundary edges: only near these does the winding number change gradually.
    pub(super) boundary: BoundaryEdges,
    pub(super) findings: MeshFindings,
    /// The finite corner of a triangle with the largest coordinate.
    pub(super) farthest: DVec3,
}

/// Positions with a larger coordinate are invalid: the squares of their squares would overflow.
const FARTHEST: f64 = 1e60;

/// A triangle is flat if its height is below this fraction of its longest edge.
const FLAT: f64 = 1e-12;

impl RepairedMesh {
    /// Repairs these triangles, in world units.
    pub(super) fn new(positions: &[[f64; 3]], triangles: &[[u32; 3]]) -> RepairedMesh {
        let mut findings = MeshFindings::default();
        let farthest = farthest_corner(positions, triangles);
        let (mut points, welded) = weld(positions);
        let mut faces = distinct_faces(&points, &welded, triangles, &mut findings);
        let edges = EdgeTriangles::new(&faces);
        let mut flipped = vec![false; faces.len()];
        let parts = orient(&points, &faces, &edges, &mut flipped);
        flip(&mut faces, &flipped);
        let sheets = find_sheets(&points, &faces, &parts);
        let parts = Parts { of_face: &parts, is_sheet: &sheets };
        findings.unchecked_part_count = flip_parts(&points, &mut faces, parts, &mut flipped);
        findings.flipped_count = flipped.iter().filter(|&&flipped| flipped).count();
        findings.sheet_count = sheets.iter().filter(|&&is_sheet| is_sheet).count();
        close_sheets(&mut points, &mut faces, parts);
        let boundary = BoundaryEdges::new(boundary(&points, &faces));
        findings.open_edge_count = boundary.len();
        let corners: Vec<[DVec3; 3]> = faces
            .iter()
            .map(|face| face.map(|corner| points[corner as usize]))
            .filter(|corners| !is_flat(corners))
            .collect();
        findings.triangle_count = corners.len();
        findings.degenerate_count += faces.len() - corners.len();
        let tree = TriangleTree::new(corners);
        findings.encloses_nothing = findings.open_edge_count > 0 && encloses_nothing(&tree);
        RepairedMesh { tree, boundary, findings, farthest }
    }
}

/// The finite corner of these triangles with the largest coordinate; 0 without any.
fn farthest_corner(positions: &[[f64; 3]], triangles: &[[u32; 3]]) -> DVec3 {
    let corners = triangles.iter().flatten().filter_map(|&corner| positions.get(corner as usize));
    let finite = corners.map(|&corner| DVec3::from(corner)).filter(|corner| corner.is_finite());
    let size = |corner: DVec3| corner.abs().max_element();
    finite.fold(DVec3::ZERO, |far, corner| if size(corner) > size(far) { corner } else { far })
}

/// The connected parts of a mesh.
#[derive(Clone, Copy)]
struct Parts<'a> {
    /// The part of each triangle.
    of_face: &'a [u32],
    /// Whether each part is a sheet.
    is_sheet: &'a [bool],
}

/// The triangles with an area and finite corners, in their original orientation.
pub(super) fn valid_triangles(positions: &[[f64; 3]], triangles: &[[u32; 3]]) -> Vec<[DVec3; 3]> {
    let corner = |index: u32| {
        let position = positions.get(index as usize);
        position
            .filter(|position| position.iter().all(|c| c.abs() < FARTHEST))
            .map(|&position| position.into())
    };
    let corners = |&[a, b, c]: &[u32; 3]| Some([corner(a)?, corner(b)?, corner(c)?]);
    triangles.iter().filter_map(corners).filter(|corners| !is_flat(corners)).collect()
}

/// The number of boundary edges of these triangles; vertices at the same position count as one.
pub(super) fn open_edge_count(positions: &[[f64; 3]], triangles: &[[u32; 3]]) -> usize {
    let (points, welded) = weld(positions);
    let faces = distinct_faces(&points, &welded, triangles, &mut MeshFindings::default());
    boundary(&points, &faces).len()
}

/// Whether the winding number is at most 1/2 everywhere. It is evaluated just behind some of the triangles,
/// where it is largest.
fn encloses_nothing(tree: &TriangleTree) -> bool {
    let triangles = tree.triangles();
    let every = triangles.len().div_ceil(TEST_COUNT).max(1);
    triangles.iter().step_by(every).all(|triangle| {
        let area = area_vector(triangle);
        let behind = area.normalize_or_zero() * (BEHIND * area.length().sqrt());
        let [a, b, c] = triangle;
        winding(tree, (a + b + c) / 3.0 - behind) < 0.5 + WINDING_ERROR
    })
}

/// Approximate number of triangles that are tested.
const TEST_COUNT: usize = 500;

/// Distance of the evaluation point behind a triangle, in units of the square root of its area.
const BEHIND: f64 = 1e-3;

/// The distinct positions, and for each vertex the index of its position; `None` if the position is invalid.
fn weld(positions: &[[f64; 3]]) -> (Vec<DVec3>, Vec<Option<u32>>) {
    let mut index_of: FxHashMap<[u64; 3], u32> = FxHashMap::default();
    let mut points = Vec::new();
    let welded = positions
        .iter()
        .map(|position| {
            if !position.iter().all(|c| c.abs() < FARTHEST) {
                return None;
            }
            let next = u32::try_from(points.len()).ok()?;
            // Adding 0 turns −0 into 0.
            let index = *index_of.entry(position.map(|c| (c + 0.0).to_bits())).or_insert(next);
            if index == next {
                points.push(DVec3::from(*position));
            }
            Some(index)
        })
        .collect();
    (points, welded)
}

/// The triangles as indices of distinct positions, without duplicates. Flat triangles stay, because they
/// connect their neighbours.
fn distinct_faces(
    points: &[DVec3],
    welded: &[Option<u32>],
    triangles: &[[u32; 3]],
    findings: &mut MeshFindings,
) -> Vec<[u32; 3]> {
    let corner = |index: u32| welded.get(index as usize).copied().flatten();
    let mut seen: FxHashSet<[u32; 3]> = FxHashSet::default();
    let mut faces = Vec::with_capacity(triangles.len());
    for &[a, b, c] in triangles {
        let (Some(a), Some(b), Some(c)) = (corner(a), corner(b), corner(c)) else {
            findings.invalid_count += 1;
            continue;
        };
        if a == b || b == c || c == a {
            findings.degenerate_count += 1;
            continue;
        }
        let mut sorted = [a, b, c];
        sorted.sort_unstable();
        if seen.insert(sorted) {
            faces.push([a, b, c]);
        } else {
            findings.duplicate_count += 1;
        }
    }
    debug_assert!(faces.iter().flatten().all(|&corner| (corner as usize) < points.len()));
    faces
}

/// The triangles at each edge.
struct EdgeTriangles {
    /// The edge's ends, the lower index first; a triangle at the edge; whether the triangle traverses the
    /// edge from the lower to the higher index.
    uses: Vec<([u32; 2], u32, bool)>,
}

impl EdgeTriangles {
    pub(super) fn new(faces: &[[u32; 3]]) -> EdgeTriangles {
        let mut uses: Vec<([u32; 2], u32, bool)> = Vec::with_capacity(3 * faces.len());
        for (face, &[a, b, c]) in faces.iter().enumerate() {
            for [from, to] in [[a, b], [b, c], [c, a]] {
                uses.push(([from.min(to), from.max(to)], face as u32, from < to));
            }
        }
        uses.sort_unstable();
        EdgeTriangles { uses }
    }

    /// The boundary edges: those not traversed equally often in both directions. Each begins and ends as most
    /// of its triangles traverse it.
    pub(super) fn boundary(&self) -> impl Iterator<Item = [u32; 2]> {
        self.iter().filter_map(|uses| {
            let [low, high] = uses[0].0;
            match uses.iter().map(|(_, _, up)| if *up { 1 } else { -1 }).sum::<i32>() {
                0 => None,
                1.. => Some([low, high]),
                _ => Some([high, low]),
            }
        })
    }

    /// The edges, each with the triangles at it.
    fn iter(&self) -> impl Iterator<Item = &[([u32; 2], u32, bool)]> {
        self.uses.chunk_by(|one, other| one.0 == other.0)
    }
}

/// Decides which triangles to flip so that neighbours agree. Returns the index of each triangle's part.
fn orient(points: &[DVec3], faces: &[[u32; 3]], edges: &EdgeTriangles, flipped: &mut [bool]) -> Vec<u32> {
    const NONE: u32 = u32::MAX;
    let mut neighbors = vec![[(NONE, false); 3]; faces.len()];
    for uses in edges.iter() {
        // If more than two triangles meet, it is unknown which of them belong together.
        let &[(_, one, one_up), (_, other, other_up)] = uses else { continue };
        for (from, to) in [(one, other), (other, one)] {
            if let Some(free) = neighbors[from as usize].iter_mut().find(|slot| slot.0 == NONE) {
                *free = (to, one_up == other_up);
            }
        }
    }
    let mut parts = vec![NONE; faces.len()];
    let mut part_count = 0;
    for start in 0..faces.len() {
        if parts[start] != NONE {
            continue;
        }
        parts[start] = part_count;
        let mut members = vec![start as u32];
        let mut done = 0;
        while let Some(&face) = members.get(done) {
            done += 1;
            for (neighbor, disagrees) in neighbors[face as usize] {
                if neighbor != NONE && parts[neighbor as usize] == NONE {
                    parts[neighbor as usize] = part_count;
                    flipped[neighbor as usize] = flipped[face as usize] != disagrees;
                    members.push(neighbor);
                }
            }
        }
        let area = |wanted: bool| -> f64 {
            let members = members.iter().filter(|&&face| flipped[face as usize] == wanted);
            members.map(|&face| area_vector(&corners(points, faces[face as usize])).length()).sum()
        };
        if area(true) > area(false) {
            members.iter().for_each(|&face| flipped[face as usize] ^= true);
        }
        part_count += 1;
    }
    parts
}

fn flip(faces: &mut [[u32; 3]], flipped: &[bool]) {
    faces.iter_mut().zip(flipped).filter(|(_, flipped)| **flipped).for_each(|(face, _)| face.swap(1, 2));
}

/// If a mesh has more parts than this, no single part is flipped or is a sheet: the mesh is rubble, or its
/// triangles share no vertices.
const PARTS_MAX: usize = 4096;

/// Number of corners of a part to test; the part is a cavity if all of them are inside other parts.
const CORNERS_TESTED: usize = 64;

/// Flips parts with negative volume, except cavities and sheets. Returns how many such parts were left
/// unchanged because there are too many parts.
fn flip_parts(
    points: &[DVec3],
    faces: &mut [[u32; 3]],
    Parts { of_face: parts, is_sheet }: Parts,
    flipped: &mut [bool],
) -> usize {
    let part_count = is_sheet.len();
    // The sides of a box that share no vertices are parts, too: seen from the middle, they have volumes.
    let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for corner in faces.iter().flat_map(|face| corners(points, *face)) {
        (min, max) = (min.min(corner), max.max(corner));
    }
    let anchor = 0.5 * (min + max);
    let mut volumes = vec![0.0; part_count];
    for (face, &part) in faces.iter().zip(parts).filter(|&(_, &part)| !is_sheet[part as usize]) {
        let [a, b, c] = corners(points, *face).map(|corner| corner - anchor);
        volumes[part as usize] += a.dot(b.cross(c)) / 6.0;
    }
    let is_inside_out = volumes.iter().sum::<f64>() < 0.0;
    let mut wrong: Vec<bool> = is_sheet.iter().map(|is_sheet| is_inside_out && !is_sheet).collect();
    if is_inside_out {
        volumes.iter_mut().for_each(|volume| *volume = -*volume);
    }
    let suspect_count = volumes.iter().filter(|&&volume| volume < 0.0).count();
    let is_tested = part_count <= PARTS_MAX;
    if suspect_count > 0 && is_tested {
        let is_cavity = are_cavities(points, faces, parts, &volumes, is_inside_out);
        for ((wrong, volume), is_cavity) in wrong.iter_mut().zip(&volumes).zip(is_cavity) {
            *wrong ^= *volume < 0.0 && !is_cavity;
        }
    }
    for ((face, &part), flipped) in faces.iter_mut().zip(parts).zip(flipped) {
        if wrong[part as usize] {
            face.swap(1, 2);
            *flipped ^= true;
        }
    }
    if is_tested { 0 } else { suspect_count }
}

/// For each part, whether its volume is negative and it lies within parts of positive volume. If `inside_out`
/// is true, all triangles are treated as flipped.
fn are_cavities(
    points: &[DVec3],
    faces: &[[u32; 3]],
    parts: &[u32],
    volumes: &[f64],
    inside_out: bool,
) -> Vec<bool> {
    let outward = |[a, b, c]: [DVec3; 3]| if inside_out { [a, c, b] } else { [a, b, c] };
    let of_sound = faces.iter().zip(parts).filter(|&(_, &part)| volumes[part as usize] > 0.0);
    let of_sound = of_sound.map(|(face, _)| corners(points, *face)).filter(|corners| !is_flat(corners));
    let sound = TriangleTree::new(of_sound.map(outward).collect());
    let mut part_corners: Vec<Vec<DVec3>> = vec![Vec::new(); volumes.len()];
    for (face, &part) in faces.iter().zip(parts).filter(|&(_, &part)| volumes[part as usize] < 0.0) {
        part_corners[part as usize].push(points[face[0] as usize]);
    }
    let is_cavity = |corners: &Vec<DVec3>| {
        let every = corners.len().div_ceil(CORNERS_TESTED).max(1);
        !corners.is_empty() && corners.iter().step_by(every).all(|&corner| winding(&sound, corner) > 0.5)
    };
    part_corners.iter().map(is_cavity).collect()
}

/// The boundary edges of these triangles.
fn boundary(points: &[DVec3], faces: &[[u32; 3]]) -> Vec<[DVec3; 2]> {
    EdgeTriangles::new(faces).boundary().map(|ends| ends.map(|end| points[end as usize])).collect()
}

pub(super) fn corners(points: &[DVec3], face: [u32; 3]) -> [DVec3; 3] {
    face.map(|corner| points[corner as usize])
}

/// The normal, with the area as its length.
pub(super) fn area_vector([a, b, c]: &[DVec3; 3]) -> DVec3 {
    0.5 * (b - a).cross(c - a)
}

fn is_flat(corners: &[DVec3; 3]) -> bool {
    let [a, b, c] = *corners;
    let longest = (b - a).length_squared().max((c - b).length_squared()).max((a - c).length_squared());
    let has_area = 2.0 * area_vector(corners).length() > FLAT * longest;
    // A NaN counts as flat.
    !has_area
}

// Open sheets, such as a plane as a floor: finds them, and closes them behind their normals.
//
// A part of a mesh is a sheet if it is open, all its triangles face one way, and neither it nor the mesh
// around it encloses anything on its sides. So a dome is no sheet, because the winding number shows what it
// encloses, and neither is a side of a box whose sides share no vertices.

/// Approximate number of triangles of a part that are tested, at least one.
const TRIANGLES_TESTED: usize = 64;

/// The same for all parts.
const TRIANGLES_TESTED_IN_ALL: usize = 4096;

/// Points of a triangle that are tested: their weights at its corners.
const TESTED: [[f64; 3]; 4] = [[1.0 / 3.0; 3], [0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]];

/// Distance of the tested points from the triangle, in units of the square root of its area.
const APART: f64 = 1e-3;

/// A point with a larger winding number is enclosed. It is 0.5 beside a plane, up to 0.6 in the valleys and
/// under the hills of a terrain, at least 0.75 in half a ball or half a pipe, and 1 in a body.
const ENCLOSED: f64 = 0.65;

/// For each part, whether it is a sheet. `parts` is the part of each triangle.
fn find_sheets(points: &[DVec3], faces: &[[u32; 3]], parts: &[u32]) -> Vec<bool> {
    let part_count = parts.iter().max().map_or(0, |&last| last as usize + 1);
    if part_count > PARTS_MAX {
        return vec![false; part_count];
    }
    let triangles =
        || faces.iter().map(|face| corners(points, *face)).zip(parts.iter().map(|&part| part as usize));
    let solid_triangles = || triangles().filter(|(triangle, _)| !is_flat(triangle));
    let mut normals = vec![DVec3::ZERO; part_count];
    solid_triangles().for_each(|(triangle, part)| normals[part] += area_vector(&triangle));
    // A closed part faces all ways.
    let mut is_sheet: Vec<bool> = normals.iter().map(|normal| *normal != DVec3::ZERO).collect();
    for (triangle, part) in solid_triangles() {
        is_sheet[part] &= area_vector(&triangle).dot(normals[part]) > 0.0;
    }
    if !is_sheet.contains(&true) {
        return is_sheet;
    }
    let tree = TriangleTree::new(solid_triangles().map(|(triangle, _)| triangle).collect());
    let mut of_sheets: Vec<Vec<[DVec3; 3]>> = vec![Vec::new(); part_count];
    for (triangle, part) in solid_triangles().filter(|&(_, part)| is_sheet[part]) {
        of_sheets[part].push(triangle);
    }
    let sheet_count = is_sheet.iter().filter(|&&is_sheet| is_sheet).count();
    let tested = (TRIANGLES_TESTED_IN_ALL / sheet_count).clamp(1, TRIANGLES_TESTED);
    is_sheet
        .iter()
        .zip(of_sheets)
        .map(|(&is_sheet, triangles)| is_sheet && !is_wall(&tree, &triangles, tested))
        .collect()
}

/// Whether something is enclosed on one side of most of about `tested` of these triangles, however they are
/// oriented.
fn is_wall(tree: &TriangleTree, triangles: &[[DVec3; 3]], tested: usize) -> bool {
    let (mut enclosed_count, mut tested_count) = (0, 0);
    for triangle in triangles.iter().step_by(triangles.len().div_ceil(tested).max(1)) {
        let area = area_vector(triangle);
        let apart = area.normalize_or_zero() * (APART * area.length().sqrt());
        let [a, b, c] = *triangle;
        for [of_a, of_b, of_c] in TESTED {
            let point = a * of_a + b * of_b + c * of_c;
            let enclosed = |point: DVec3| winding(tree, point).abs() > ENCLOSED;
            enclosed_count += usize::from(enclosed(point - apart) || enclosed(point + apart));
            tested_count += 1;
        }
    }
    2 * enclosed_count > tested_count
}

/// Closes each sheet: adds its boundary edges, swept against its mean normal, and the sheet at the end of the
/// sweep.
fn close_sheets(points: &mut Vec<DVec3>, faces: &mut Vec<[u32; 3]>, parts: Parts) {
    let mut sheets: BTreeMap<u32, Vec<[u32; 3]>> = BTreeMap::new();
    for (face, &part) in faces.iter().zip(parts.of_face).filter(|&(_, &part)| parts.is_sheet[part as usize]) {
        sheets.entry(part).or_default().push(*face);
    }
    for sheet in sheets.into_values() {
        let corner = |index: &u32| points[*index as usize];
        let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for point in sheet.iter().flatten().map(corner) {
            (min, max) = (min.min(point), max.max(point));
        }
        let normal: DVec3 = sheet.iter().map(|face| area_vector(&corners(points, *face))).sum();
        let sweep = -normal.normalize_or_zero() * (max - min).length();
        let mut moved: FxHashMap<u32, u32> = FxHashMap::default();
        for &index in sheet.iter().flatten() {
            moved.entry(index).or_insert_with(|| {
                let point = points[index as usize] + sweep;
                points.push(point);
                points.len() as u32 - 1
            });
        }
        faces.extend(sheet.iter().map(|[a, b, c]| [moved[a], moved[c], moved[b]]));
        for [a, b] in EdgeTriangles::new(&sheet).boundary() {
            faces.extend([[b, a, moved[&a]], [b, moved[&a], moved[&b]]]);
        }
    }
}

// A bounding-box tree of the boundary edges of a surface. It bounds how fast the winding number w can change
// near a point:
//
//   |∇w| ≤ 1/4π · Σ length / distance²        over the boundary edges
//
// If a box is far away for its size, all its edges are counted with the distance of the box, which is at
// most the distance of the edges. So even a mesh whose triangles share no edges takes little longer than a
// mesh with a hole.

/// The boundary edges of a surface.
pub(super) struct BoundaryEdges {
    nodes: Vec<EdgeNode>,
    edges: Vec<[DVec3; 2]>,
}

/// A range of edges.
struct EdgeNode {
    /// The bounding box of the edges.
    min: DVec3,
    max: DVec3,
    /// The sum of the edges' lengths.
    length: f64,
    /// The first edge, and the number of edges.
    first: u32,
    count: u32,
    /// Index of the second child; the first child is the next node. 0 for a leaf.
    second: u32,
}

/// Maximum number of edges in a leaf.
const LEAF_EDGES: usize = 8;

/// A box is far away if its distance exceeds this many times its diagonal. The distance of an edge is then
/// underestimated by at most a quarter.
const FAR: f64 = 3.0;

impl BoundaryEdges {
    pub(super) fn new(edges: Vec<[DVec3; 2]>) -> BoundaryEdges {
        let mut order: Vec<(DVec3, u32)> =
            edges.iter().zip(0..).map(|([from, to], index)| (0.5 * (from + to), index)).collect();
        let mut nodes = Vec::with_capacity(4 * edges.len().div_ceil(LEAF_EDGES));
        if !order.is_empty() {
            split(&mut order, 0, &edges, &mut nodes);
        }
        let edges = order.iter().map(|&(_, index)| edges[index as usize]).collect();
        BoundaryEdges { nodes, edges }
    }

    /// The number of edges.
    pub(super) fn len(&self) -> usize {
        self.edges.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.edges.is_empty()
    }

    /// The memory of the tree, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        size_of_val(&*self.nodes) + size_of_val(&*self.edges)
    }

    /// Upper bound of |∇w| within `radius` of a point, between triangles. (Across a triangle, w jumps.)
    pub(super) fn slope_bound(&self, center: DVec3, radius: f64) -> f64 {
        let mut sum = 0.0;
        let mut pending: Vec<u32> = self.nodes.first().map(|_| 0).into_iter().collect();
        while let Some(index) = pending.pop() {
            let node = &self.nodes[index as usize];
            let distance = node.distance(center) - radius;
            if distance > FAR * (node.max - node.min).length() {
                sum += node.length / (distance * distance);
            } else if node.second != 0 {
                // The nearer child is pushed last, so it is visited first and may end the search.
                let both = [index + 1, node.second];
                let [one, other] = both.map(|node| self.nodes[node as usize].distance(center));
                pending.extend(if one < other { [both[1], both[0]] } else { both });
            } else {
                let edges = &self.edges[node.first as usize..][..node.count as usize];
                sum += edges.iter().map(|edge| edge_slope(edge, center, radius)).sum::<f64>();
                if sum == f64::INFINITY {
                    break;
                }
            }
        }
        sum / (4.0 * PI)
    }
}

impl EdgeNode {
    /// The distance from a point to the box.
    fn distance(&self, point: DVec3) -> f64 {
        (self.min - point).max(point - self.max).max(DVec3::ZERO).length()
    }
}

/// The contribution of one edge to the sum.
fn edge_slope(&[from, to]: &[DVec3; 2], center: DVec3, radius: f64) -> f64 {
    let along = to - from;
    let t = ((center - from).dot(along) / along.length_squared()).clamp(0.0, 1.0);
    let distance = (from + along * t - center).length() - radius;
    if distance <= 0.0 { f64::INFINITY } else { along.length() / (distance * distance) }
}

/// Builds the node of a range of edges, given by their midpoints and indices, and the nodes below it.
fn split(order: &mut [(DVec3, u32)], first: u32, edges: &[[DVec3; 2]], nodes: &mut Vec<EdgeNode>) {
    let index = nodes.len();
    let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for &(_, edge) in &*order {
        let [from, to] = edges[edge as usize];
        (min, max) = (min.min(from).min(to), max.max(from).max(to));
    }
    nodes.push(EdgeNode { min, max, length: 0.0, first, count: order.len() as u32, second: 0 });
    if order.len() <= LEAF_EDGES {
        order.sort_unstable_by_key(|&(_, edge)| edge);
        let lengths =
            order.iter().map(|&(_, edge)| edges[edge as usize][0].distance(edges[edge as usize][1]));
        nodes[index].length = lengths.sum();
        return;
    }
    let axis = (max - min).max_position();
    let half = order.len() / 2;
    order.select_nth_unstable_by(half, |one, other| {
        one.0[axis].total_cmp(&other.0[axis]).then(one.1.cmp(&other.1))
    });
    let (one, other) = order.split_at_mut(half);
    split(one, first, edges, nodes);
    let second = nodes.len();
    split(other, first + half as u32, edges, nodes);
    nodes[index].second = second as u32;
    nodes[index].length = nodes[index + 1].length + nodes[second].length;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The bound is at least the sum over all edges, and not much more.
    #[test]
    fn slope_bound_is_tight_against_the_sum_over_all_edges() {
        let random = |seed: usize| (seed as f64 * 12.9898).sin().mul_add(43758.5453, 0.0).rem_euclid(1.0);
        let random_point = |seed: usize| DVec3::new(random(seed), random(seed + 1), random(seed + 2));
        for count in [0, 1, 8, 9, 100, 5000] {
            let edge = |index: usize| {
                let from = 10.0 * random_point(9 * index);
                [from, from + 0.2 * (random_point(9 * index + 3) - 0.5)]
            };
            let edges: Vec<[DVec3; 2]> = (0..count).map(edge).collect();
            let boundary = BoundaryEdges::new(edges.clone());
            assert_eq!(boundary.len(), count);
            for query in 0..60 {
                let center = 60.0 * (random_point(7 * query + 5) - 0.5);
                let radius = random(query + 100);
                let all: f64 =
                    edges.iter().map(|edge| edge_slope(edge, center, radius)).sum::<f64>() / (4.0 * PI);
                let bound = boundary.slope_bound(center, radius);
                let slack = (4.0f64 / 3.0).powi(2) + 1e-9;
                let is_tight = all * (1.0 - 1e-9) <= bound && (bound <= all * slack || all == f64::INFINITY);
                assert!(is_tight, "{count} edges at {center}: {bound} for {all}");
            }
        }
    }

    /// A box that is far away counts as one edge, so only few of many edges are visited.
    #[test]
    fn distant_box_counts_as_one_edge() {
        let edges =
            (0..1000).map(|x| [DVec3::new(f64::from(x), 0.0, 0.0), DVec3::new(f64::from(x), 1.0, 0.0)]);
        let boundary = BoundaryEdges::new(edges.collect());
        assert_eq!(boundary.slope_bound(DVec3::new(0.0, 0.0, 4000.0), 0.0), 1000.0 / 16e6 / (4.0 * PI));
    }
}
