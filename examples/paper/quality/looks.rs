//! Scores that agree with eyes: the waists of pairs, the facets of drops, and the dashes along ridges.

use std::collections::HashMap;

use glam::{DVec3, IVec3};
use meniscus::surface::obstacle::MeshSdf;
use meniscus_formats::MeshData;
use rayon::prelude::*;

use super::scores::mean;

/// Points by cells of a grid: all points within an edge of a point are in its cell or in the 26 around it.
pub(super) struct Cells<'a> {
    points: &'a [DVec3],
    edge: f64,
    indices: HashMap<IVec3, Vec<usize>>,
}

impl<'a> Cells<'a> {
    pub(super) fn new(points: &'a [DVec3], edge: f64) -> Cells<'a> {
        let mut indices: HashMap<IVec3, Vec<usize>> = HashMap::new();
        for (index, point) in points.iter().enumerate() {
            indices.entry((point / edge).floor().as_ivec3()).or_default().push(index);
        }
        Cells { points, edge, indices }
    }

    /// The points that are nearer to `at` than an edge: their indices and distances.
    pub(super) fn near(&self, at: DVec3) -> impl Iterator<Item = (usize, f64)> {
        let middle = (at / self.edge).floor().as_ivec3();
        let around = (0..27).map(move |side| middle + IVec3::new(side % 3, side / 3 % 3, side / 9) - 1);
        let indices = around.filter_map(|cell| self.indices.get(&cell)).flatten();
        let with_distance = indices.map(move |&index| (index, self.points[index].distance(at)));
        with_distance.filter(|(_, distance)| *distance < self.edge)
    }
}

/// How far the neighbours of a particle count for its company, in spacings.
const REACH: f64 = 2.8;

/// How much fluid there is around each particle, from 0 in spray to 1 in a body or a sheet: as meniscus has it, but
/// for a middling flatness of all neighbourhoods.
pub(super) fn companies(points: &[DVec3], spacing: f64) -> Vec<f64> {
    let cells = Cells::new(points, REACH * spacing);
    let company = |(index, at): (usize, &DVec3)| {
        let others = cells.near(*at).filter(|(other, _)| *other != index);
        let weight: f64 = others.map(|(_, r)| (1.0 - (r / cells.edge).powi(3)).powi(2)).sum();
        let u = ((weight * (2.6 / REACH).powi(3) * 1.3 - 3.0) / 9.0).clamp(0.0, 1.0);
        u * u * (3.0 - 2.0 * u)
    };
    points.par_iter().enumerate().map(company).collect()
}

/// The waist of pairs: for every two particles with a company below 0.5 that are 0.7 d to 1.8 d apart, the depth of
/// the point between them in the surface, at least 0, over the mean depth of the two. The mean over the pairs is 1 if
/// a tube joins them, and 0 if they are apart; `None` without such pairs. A particle outside has a depth of 0, too; a
/// pair of which both are outside has a waist of 0.
pub(super) fn waist(points: &[DVec3], spacing: f64, solid: &MeshSdf) -> Option<f64> {
    let companies = companies(points, spacing);
    let alone: Vec<DVec3> =
        points.iter().zip(companies).filter(|(_, company)| *company < 0.5).map(|(at, _)| *at).collect();
    let depth = |at: DVec3| (-solid.distance(at).unwrap_or(0.0)).max(0.0);
    let depths: Vec<f64> = alone.par_iter().map(|at| depth(*at)).collect();
    let cells = Cells::new(&alone, 1.8 * spacing);
    let of_pairs = |(index, at): (usize, &DVec3)| -> Vec<f64> {
        let others = cells.near(*at).filter(|(other, r)| *other > index && *r >= 0.7 * spacing);
        let waist = |(other, _): (usize, f64)| match 0.5 * (depths[index] + depths[other]) {
            0.0 => 0.0,
            mean => depth(at.midpoint(alone[other])) / mean,
        };
        others.map(waist).collect()
    };
    let waists: Vec<f64> = alone.par_iter().enumerate().flat_map_iter(of_pairs).collect();
    (!waists.is_empty()).then(|| mean(&waists))
}

/// The angles between the normals of a surface and the directions from a point in its middle, in degrees.
#[derive(Default)]
pub(super) struct Facets {
    pub(super) of_faces: Vec<f64>,
    /// Empty if the program gives no normals.
    pub(super) of_vertices: Vec<f64>,
}

impl Facets {
    /// Adds the angles of a surface. Triangles without an area are left out.
    pub(super) fn add(&mut self, mesh: &MeshData, middle: DVec3) {
        let angle = |normal: DVec3, at: DVec3| normal.angle_between(at - middle).to_degrees();
        for triangle in &mesh.triangles {
            let [a, b, c] = triangle.map(|vertex| DVec3::from(mesh.positions[vertex as usize]));
            let normal = (b - a).cross(c - a);
            if normal != DVec3::ZERO {
                self.of_faces.push(angle(normal, (a + b + c) / 3.0));
            }
        }
        let vertices = mesh.normals.iter().zip(&mesh.positions);
        self.of_vertices.extend(vertices.map(|(normal, at)| {
            let [x, y, z] = normal.map(f64::from);
            angle(DVec3::new(x, y, z), DVec3::from(*at))
        }));
    }
}

/// The number that 95 % of some numbers do not exceed.
pub(super) fn percentile_95(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get((0.95 * values.len() as f64).ceil() as usize - usize::from(!values.is_empty())).copied()
}

/// How far edges and vertices count for the curvature at a point, in spacings, with weights (1 − r²/R²)²: so meshes of
/// different resolutions compare.
const SMOOTHED: f64 = 0.4;

/// The distance along a ridge over which its curvature is compared, in spacings: half of a period of beads.
const STEP: f64 = 0.5;

/// Dashes: how much the curvature of ridges varies along them, which breaks their highlights into dashes.
///
/// The curvature at a vertex is the sum over the edges around it of angle times length times the square e eᵀ of the
/// direction, over the area there, in the tangent plane: its larger eigenvalue is the curvature across a ridge, in the
/// direction along the ridge (Cohen-Steiner and Morvan, Restricted Delaunay triangulations and normal cycle, 2003).
/// Ridges are the vertices where it is above 0.5/d and more than twice the smaller one. The sum of both is averaged around
/// the vertex, and around the two points 0.5 d from it along the ridge. The score is the root mean square of the
/// differences between those points and the vertex over the mean of the larger curvature at the vertices, both weighted
/// by area. A tube or a rim of steady curvature has about 0, a row of beads much: across, necks and beads curve alike, but
/// along the row, beads are convex and necks concave, and the sum tells them apart. `None` without ridges.
pub(super) fn dashes(mesh: &MeshData, spacing: f64) -> Option<f64> {
    let points: Vec<DVec3> = mesh.positions.iter().map(|at| DVec3::from(*at) / spacing).collect();
    let mut normals = vec![DVec3::ZERO; points.len()];
    // The normal of the face on the left of each directed edge.
    let mut left: HashMap<[u32; 2], DVec3> = HashMap::new();
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|vertex| points[vertex as usize]);
        let normal = (b - a).cross(c - a);
        triangle.iter().for_each(|vertex| normals[*vertex as usize] += normal);
        left.extend(
            (0..3).map(|side| ([triangle[side], triangle[(side + 1) % 3]], normal.normalize_or_zero())),
        );
    }
    let areas: Vec<f64> = normals.iter().map(|normal| normal.length() / 6.0).collect();
    normals.iter_mut().for_each(|normal| *normal = normal.normalize_or_zero());
    let (mut middles, mut edges) = (Vec::new(), Vec::new());
    for triangle in &mesh.triangles {
        for [from, to] in [[0, 1], [1, 2], [2, 0]].map(|side| side.map(|corner: usize| triangle[corner])) {
            let normal_of = |edge: [u32; 2]| left.get(&edge).copied().unwrap_or_default();
            let (one, other) = (normal_of([from, to]), normal_of([to, from]));
            if from < to && other != DVec3::ZERO {
                let [from, to] = [from, to].map(|vertex| points[vertex as usize]);
                let edge = to - from;
                // Positive where the surface is convex.
                let angle = one.cross(other).dot(edge.normalize_or_zero()).atan2(one.dot(other));
                middles.push(from.midpoint(to));
                edges.push((one + other, edge, angle / edge.length().max(f64::MIN_POSITIVE)));
            }
        }
    }
    let (of_edges, of_points) = (Cells::new(&middles, SMOOTHED), Cells::new(&points, SMOOTHED));
    let weight = |r: f64| (1.0 - (r / SMOOTHED).powi(2)).powi(2);
    // The vertices on the same side of the fluid, with their weights.
    let near = |at: DVec3, normal: DVec3| -> Vec<(usize, f64)> {
        let facing = of_points.near(at).filter(|(other, _)| normals[*other].dot(normal) > 0.0);
        facing.map(|(other, r)| (other, areas[other] * weight(r))).collect()
    };
    // The larger and the smaller curvature, and the direction along the ridge.
    let bend = |(&at, &normal): (&DVec3, &DVec3)| {
        let (across, up) = normal.any_orthonormal_pair();
        let [mut xx, mut xy, mut yy] = [0.0; 3];
        for (edge, r) in of_edges.near(at) {
            let (facing, edge, angle) = edges[edge];
            if facing.dot(normal) > 0.0 {
                let (x, y) = (edge.dot(across), edge.dot(up));
                [xx, xy, yy] =
                    [[xx, x * x], [xy, x * y], [yy, y * y]].map(|[sum, of]| sum + weight(r) * angle * of);
            }
        }
        let area: f64 = near(at, normal).iter().map(|(_, weight)| weight).sum();
        let (middle, half) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
        let (sin, cos) = (0.5 * (2.0 * xy).atan2(xx - yy)).sin_cos();
        ((middle + half) / area, (middle - half) / area, cos * across + sin * up)
    };
    let bends: Vec<(f64, f64, DVec3)> = points.par_iter().zip(&normals).map(bend).collect();
    let averaged = |at: DVec3, normal: DVec3| {
        let around = near(at, normal);
        let total: f64 = around.iter().map(|(_, weight)| weight).sum();
        let sum: f64 =
            around.iter().map(|(other, weight)| weight * (bends[*other].0 + bends[*other].1)).sum();
        (total > 0.0).then(|| sum / total)
    };
    let of_vertex = |vertex: usize| {
        let (at, normal, (larger, smaller, along)) = (points[vertex], normals[vertex], bends[vertex]);
        let here = averaged(at, normal).filter(|_| larger > 0.5_f64.max(2.0 * smaller))?;
        let sides = [-STEP, STEP].map(|step| averaged(at + step * along, normal));
        let squares: Vec<f64> = sides.into_iter().flatten().map(|there| (there - here).powi(2)).collect();
        (!squares.is_empty()).then(|| [1.0, larger, mean(&squares)].map(|of| areas[vertex] * of))
    };
    let ridges: Vec<[f64; 3]> = (0..points.len()).into_par_iter().filter_map(of_vertex).collect();
    let [area, curvature, squares] = [0, 1, 2].map(|part| ridges.iter().map(|of| of[part]).sum::<f64>());
    (!ridges.is_empty()).then(|| (squares / area).sqrt() / (curvature / area))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;

    /// A tube around the z axis with this radius, whose ends are open or closed, with vertices about `edge` apart.
    fn tube(length: f64, edge: f64, radius: impl Fn(f64) -> f64) -> MeshData {
        let (around, along) = ((TAU * radius(0.0) / edge).ceil() as u32, (length / edge).ceil() as u32);
        let at = |index: u32| {
            let (angle, z) = (
                TAU * f64::from(index % around) / f64::from(around),
                length * f64::from(index / around) / f64::from(along),
            );
            [radius(z) * angle.cos(), radius(z) * angle.sin(), z]
        };
        let positions = (0..around * (along + 1)).map(at).collect();
        let mut triangles = Vec::new();
        for row in 0..along {
            for column in 0..around {
                let [a, b] = [column, (column + 1) % around].map(|column| row * around + column);
                triangles.extend([[a, b, b + around], [a, b + around, a + around]]);
            }
        }
        MeshData { positions, normals: Vec::new(), triangles }
    }

    fn waist_of(points: &[DVec3], radius: impl Fn(f64) -> f64) -> Option<f64> {
        let mesh = tube(8.0, 0.1, radius);
        waist(points, 1.0, &MeshSdf::new(&mesh.positions, &mesh.triangles))
    }

    /// Tubes have a waist of 1, beads one below; pairs that are apart have none.
    #[test]
    fn waists() {
        let row: Vec<DVec3> = (1..8).map(|z| DVec3::new(0.0, 0.0, z.into())).collect();
        let tube = waist_of(&row, |_| 0.5).unwrap();
        let beads = waist_of(&row, |z| 0.4 + 0.1 * (TAU * z).cos()).unwrap();
        assert!((tube - 1.0).abs() < 0.02, "{tube}");
        assert!((beads - 0.6).abs() < 0.1, "{beads}");
        let far: Vec<DVec3> = row.iter().map(|at| 2.0 * *at).collect();
        assert_eq!(waist_of(&far, |_| 0.5), None);
        let outside: Vec<DVec3> = row.iter().map(|at| *at + DVec3::X).collect();
        assert_eq!(waist_of(&outside, |_| 0.5), Some(0.0));
    }

    /// A tube has no dashes, in whatever mesh; a row of beads has many, about as many in all meshes. Waves along a tube that
    /// are longer than particles are apart have less.
    #[test]
    fn dashes_of_tubes() {
        for edge in [0.1, 0.2, 0.3] {
            let score = |radius: &dyn Fn(f64) -> f64| dashes(&tube(12.0, edge, radius), 1.0).unwrap();
            let plain = score(&|_| 0.5);
            let beads = score(&|z| 0.4 + 0.1 * (TAU * z).cos());
            let waves = score(&|z| 0.45 + 0.05 * (0.25 * TAU * z).cos());
            assert!(plain < 0.02, "{edge}: {plain}");
            assert!((0.4..0.8).contains(&beads), "{edge}: {beads}");
            assert!(waves < 0.2 * beads, "{edge}: {waves} {beads}");
        }
        assert_eq!(dashes(&tube(12.0, 0.5, |_| 3.0), 1.0), None);
    }

    /// A lattice is in full company inside, and its corners, like a row, are in less.
    #[test]
    fn company() {
        let lattice: Vec<DVec3> =
            (0..343).map(|index| IVec3::new(index % 7, index / 7 % 7, index / 49).as_dvec3()).collect();
        let of_lattice = companies(&lattice, 1.0);
        assert!(of_lattice[171] == 1.0 && of_lattice[0] < 0.9, "{} {}", of_lattice[171], of_lattice[0]);
        assert_eq!(companies(&lattice[..7], 1.0), [0.0; 7]);
    }

    /// The angles of an octahedron: its faces point away from the middle, and its vertices, with these normals, turn
    /// by 45 degrees.
    #[test]
    fn facets() {
        let axes = [DVec3::X, DVec3::Y, DVec3::Z];
        let positions = axes.iter().flat_map(|axis| [axis.to_array(), (-*axis).to_array()]).collect();
        let triangles = (0..8u32)
            .map(|side| {
                let [x, y, z] = [side & 1, 2 + (side >> 1 & 1), 4 + (side >> 2)];
                if side.count_ones().is_multiple_of(2) { [x, y, z] } else { [y, x, z] }
            })
            .collect();
        let diagonal = |sign: f32| [sign * 0.5f32.sqrt(), 0.0, 0.5f32.sqrt()];
        let normals = [1.0, -1.0, 1.0, 1.0, 1.0, 1.0].map(diagonal);
        let mut mesh = MeshData { positions, normals: Vec::new(), triangles };
        let mut found = Facets::default();
        found.add(&mesh, DVec3::ZERO);
        assert!(percentile_95(found.of_faces).unwrap() < 1e-5);
        assert_eq!(percentile_95(found.of_vertices), None);
        mesh.normals = normals.to_vec();
        let mut found = Facets::default();
        found.add(&mesh, DVec3::new(0.0, 0.0, 0.5));
        assert!((found.of_vertices[4] - 45.0).abs() < 1e-4, "{}", found.of_vertices[4]);
        assert!(percentile_95(found.of_faces).unwrap() > 10.0);
    }
}
