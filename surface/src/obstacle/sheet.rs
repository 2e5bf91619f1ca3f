//! Open sheets, such as a plane as a floor: finds them, and closes them behind their normals.
//!
//! A part of a mesh is a sheet if it is open, all its triangles face one way, and neither it nor the mesh
//! around it encloses anything on its sides. So a dome is no sheet, because the winding number shows what it
//! encloses, and neither is a side of a box whose sides share no vertices.

use std::collections::BTreeMap;

use glam::DVec3;
use rustc_hash::FxHashMap;

use super::surface::{EdgeTriangles, PARTS_MAX, Parts, area_vector, corners, is_flat};
use super::tree::TriangleTree;
use super::winding::winding;

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
pub(super) fn find_sheets(points: &[DVec3], faces: &[[u32; 3]], parts: &[u32]) -> Vec<bool> {
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
pub(super) fn close_sheets(points: &mut Vec<DVec3>, faces: &mut Vec<[u32; 3]>, parts: Parts) {
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
