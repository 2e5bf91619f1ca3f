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

use glam::DVec3;
use rustc_hash::{FxHashMap, FxHashSet};

use super::boundary::BoundaryEdges;
use super::sheet::{close_sheets, find_sheets};
use super::tree::TriangleTree;
use super::winding::{WINDING_ERROR, winding};

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
pub(super) struct Parts<'a> {
    /// The part of each triangle.
    pub(super) of_face: &'a [u32],
    /// Whether each part is a sheet.
    pub(super) is_sheet: &'a [bool],
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
pub(super) struct EdgeTriangles {
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
pub(super) const PARTS_MAX: usize = 4096;

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
        let is_cavity = are_cavities(points, faces, parts, (&volumes, is_inside_out));
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
    (volumes, inside_out): (&[f64], bool),
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

pub(super) fn is_flat(corners: &[DVec3; 3]) -> bool {
    let [a, b, c] = *corners;
    let longest = (b - a).length_squared().max((c - b).length_squared()).max((a - c).length_squared());
    let has_area = 2.0 * area_vector(corners).length() > FLAT * longest;
    // A NaN counts as flat.
    !has_area
}
