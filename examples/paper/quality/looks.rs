//! Scores that agree with eyes: the waists of pairs and the facets of drops.

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
